"""Alpha and transmittance of one Gaussian at one pixel: shared by compositing and lifting, by both schedules."""

import warp as wp

from sgwarp.kernels.projection.forward import Knobs

# One vector register of the lane schedule holds 16 pixels of a row (AVX-512; narrower machines use two or four).
LANES = 16
Lanes = wp.types.vector(length=LANES, dtype=wp.float32)
LaneIds = wp.types.vector(length=LANES, dtype=wp.int32)

# Only for modules behind the non-finite cull: -ffast-math assumes that there is no NaN and no infinity.
LANE_FLAGS = (
    "-march=native -ffast-math -ffp-contract=fast -mprefer-vector-width=512"
    " -mllvm=-inline-threshold=9000 -Wno-nan-infinity-disabled"
)
# The loops over the 16 rows of a tile stay loops: unrolled, a module compiles three times as long and runs no faster.
LANE_OPTIONS = {"enable_backward": False, "fast_math": True, "cpu_compiler_flags": LANE_FLAGS, "max_unroll": 1}
BLOCK_OPTIONS = {"enable_backward": False, "fast_math": False}

wp.set_module_options({"enable_backward": False})


@wp.func
def contribution(alpha: float, T: float, knobs: Knobs) -> float:
    """alpha T, or zero once the pixel is closed (T < 0) or would close with this Gaussian."""
    w = alpha * T
    return wp.where(T - w > knobs.transmittance_min, w, 0.0)


@wp.func
def attenuated(alpha: float, T: float, knobs: Knobs) -> float:
    """Transmittance behind a Gaussian.

    A pixel whose transmittance would fall to the cut-off keeps it with the sign flipped: it is closed, and no later,
    fainter Gaussian can slip in. Its remaining transmittance is |T|.
    """
    next_T = T - alpha * T
    return wp.where(next_T > knobs.transmittance_min, next_T, -wp.abs(T))
