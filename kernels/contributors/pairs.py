"""Explicit lists of (pixel, Gaussian) pairs, front to back. One thread per pixel.

The lists are long, so they are counted first and written second; rendering never needs them.
"""

from functools import cache

import warp as wp

from sgwarp.kernels.gaussian import EXACT_OPTIONS
from sgwarp.kernels.projection.forward import Knobs

wp.set_module_options(EXACT_OPTIONS)


@cache
def make_list_contributors(write: bool) -> wp.Kernel:
    """Kernel that counts the contributing Gaussians of each pixel, or with `write` lists them."""

    @wp.kernel(module="unique", module_options=EXACT_OPTIONS, enable_backward=False)
    def list_contributors(
        # In:
        base: int,  # first pixel of this launch
        first_listed: int,  # of a tile's list, the first place to look at
        last_listed: int,  # and the first not to look at
        transmittances: wp.array[float],  # [images * H * W] before that place
        means: wp.array[wp.vec2],  # [M] [pixels]
        conics: wp.array[wp.vec3],  # [M] (A, B, C) [1 / pixels^2]
        opacities: wp.array[float],  # [M]
        knobs: Knobs,
        width: int,  # [pixels]
        height: int,
        tile_size: int,  # [pixels]
        tile_columns: int,
        tile_rows: int,
        offsets: wp.array[int],  # [images * tiles + 1] first place of each tile
        listed: wp.array[int],  # [I] splats, tile by tile, front to back
        places: wp.array[wp.int64],  # [images * H * W] where the pixel's pairs go
        # Out:
        counts_out: wp.array[int],  # [images * H * W]; not written with `write`
        splats_out: wp.array[int],  # [pairs]; only with `write`
        pixels_out: wp.array[int],  # [pairs]; only with `write`
    ):
        """Walk a tile's list at one pixel, with the arithmetic of compositing."""
        pixel = base + wp.tid()
        image = pixel / (width * height)
        within = pixel % (width * height)
        row = within / width
        column = within % width
        tile = (image * tile_rows + row / tile_size) * tile_columns + column / tile_size
        at = wp.vec2(float(column) + 0.5, float(row) + 0.5)
        start = offsets[tile] + first_listed
        stop = wp.min(offsets[tile + 1], offsets[tile] + last_listed)
        T = transmittances[pixel]
        count = int(0)
        for k in range(start, stop):
            i = listed[k]
            d = means[i] - at
            conic = conics[i]
            power = 0.5 * (conic[0] * d[0] * d[0] + conic[2] * d[1] * d[1]) + conic[1] * d[0] * d[1]
            alpha = wp.min(opacities[i] * wp.exp(-power), knobs.alpha_max)
            if power >= 0.0 and alpha >= knobs.alpha_min:
                T = T * (1.0 - alpha)
                if T <= knobs.transmittance_min:
                    break
                if wp.static(write):
                    place = places[pixel] + wp.int64(count)
                    splats_out[place] = i
                    pixels_out[place] = pixel
                count += 1
        if wp.static(not write):
            counts_out[pixel] = count

    return list_contributors
