"""gsplat 1.5.3's functions: `from sgwarp.compat import gsplat`, on the CPU as on CUDA.

Names, arguments, shapes and the keys of `meta` are gsplat's. What differs: tile lists hold exactly the tiles that a
footprint reaches instead of those of its bounding box, Gaussians that are not finite are left out, and everything is
deterministic on the CPU.
"""

from sgwarp.compat.gsplat.facade import RollingShutterType as RollingShutterType
from sgwarp.compat.gsplat.facade import rasterization as rasterization
from sgwarp.compat.gsplat.pixels import accumulate as accumulate
from sgwarp.compat.gsplat.pixels import isect_offset_encode as isect_offset_encode
from sgwarp.compat.gsplat.pixels import isect_tiles as isect_tiles
from sgwarp.compat.gsplat.pixels import rasterize_to_indices_in_range as rasterize_to_indices_in_range
from sgwarp.compat.gsplat.pixels import rasterize_to_pixels as rasterize_to_pixels
from sgwarp.compat.gsplat.pixels import spherical_harmonics as spherical_harmonics
from sgwarp.compat.gsplat.projection import fully_fused_projection as fully_fused_projection
from sgwarp.compat.gsplat.projection import quat_scale_to_covar_preci as quat_scale_to_covar_preci
from sgwarp.compat.gsplat.relocation import compute_relocation as compute_relocation
from sgwarp.compat.gsplat.surfels import fully_fused_projection_2dgs as fully_fused_projection_2dgs
from sgwarp.compat.gsplat.surfels import rasterization_2dgs as rasterization_2dgs
from sgwarp.compat.gsplat.surfels import rasterize_to_pixels_2dgs as rasterize_to_pixels_2dgs
