"""The strongest contributors of every pixel, block schedule (CUDA): a thread keeps the sorted list of its pixel.

The list lies in the output, of any length. Few fragments touch it: those that weigh more than the least kept, which
is held in a register.
"""

import warp as wp

from sgwarp.kernels.binning import TILE
from sgwarp.kernels.compositing.block import STAGE, alpha_at
from sgwarp.kernels.gaussian import Splat
from sgwarp.kernels.projection.forward import Knobs
from sgwarp.kernels.transmittance import BLOCK_OPTIONS, attenuated, contribution

wp.set_module_options(BLOCK_OPTIONS)


@wp.func
def enter_list(
    w: float,
    gaussian: int,
    last: int,
    y: int,
    x: int,
    ids_out: wp.array3d[int],
    weights_out: wp.array3d[float],
):
    """Enter a Gaussian of weight w at `last` or in front of it; of equal weights the earlier stays in front."""
    place = last
    while place > 0:
        before = weights_out[y, x, place - 1]
        if before >= w:
            break
        weights_out[y, x, place] = before
        ids_out[y, x, place] = ids_out[y, x, place - 1]
        place -= 1
    weights_out[y, x, place] = w
    ids_out[y, x, place] = gaussian


@wp.kernel
def rank_contributors_block(
    # In:
    offsets: wp.array[int],  # [tiles + 1] first place of each tile
    listed: wp.array[int],  # [I] ranks, tile by tile, front to back
    splats: wp.array[Splat],  # [V] in depth order
    knobs: Knobs,
    width: int,  # [pixels]
    height: int,
    # Out:
    ids_out: wp.array3d[int],  # [H, W, K] Gaussians by descending alpha T, then by depth; -1 = none
    weights_out: wp.array3d[float],  # [H, W, K] their alpha T; 0 = none
):
    """The K largest alpha T of paper eq. 1 at each pixel; one block per tile."""
    tile, t = wp.tid()
    columns = (width + TILE - 1) / TILE
    x = (tile % columns) * TILE + t % TILE
    y = (tile / columns) * TILE + t / TILE
    inside = x < width and y < height
    places = ids_out.shape[2]
    if inside:
        for place in range(places):
            ids_out[y, x, place] = -1
            weights_out[y, x, place] = 0.0
    T = wp.where(inside, 1.0, 0.0)
    used = int(0)
    least = float(0.0)  # weight of the last place
    first = offsets[tile]
    stop = offsets[tile + 1]
    for start in range(first, stop, STAGE):
        ranks = wp.tile_load(listed, shape=STAGE, offset=start, storage="shared")
        staged = wp.tile_load_indexed(splats, indices=ranks, shape=(STAGE,), storage="shared")
        for j in range(wp.min(STAGE, stop - start)):
            f = staged[j]
            alpha = alpha_at(f, x, y, knobs)
            w = contribution(alpha, T, knobs)
            if w > least:
                enter_list(w, f.gaussian, wp.min(used, places - 1), y, x, ids_out, weights_out)
                used = wp.min(used + 1, places)
                least = weights_out[y, x, places - 1]
            T = attenuated(alpha, T, knobs)
        # No later weight exceeds T: a pixel is decided once its least is that large.
        undecided = wp.tile_sum(wp.tile(wp.where(T > least, 1, 0)))
        if undecided[0] == 0:
            break
