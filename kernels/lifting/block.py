"""Feature lifting, block schedule (CUDA): 256 threads own a tile; weights and features meet in shared memory.

For a batch of 16 fragments each thread computes the weight of its own pixel, then thread (fragment, channel)
multiplies the 16 x 256 weights by the 256 x 16 features. Its sum goes to the Gaussian by one atomic addition per
(tile, fragment, channel) or, in the ordered variant, to the row of its place in the lists; `shared.sum_rows` adds the
rows up in a fixed order.
"""

from functools import cache

import warp as wp

from sgwarp.kernels.binning import TILE
from sgwarp.kernels.compositing.block import BLOCK, alpha_at
from sgwarp.kernels.gaussian import Splat
from sgwarp.kernels.projection.forward import Knobs
from sgwarp.kernels.transmittance import BLOCK_OPTIONS, LANES, Lanes, attenuated, contribution

wp.set_module_options(BLOCK_OPTIONS)

BATCH = LANES  # fragments whose weights meet the features at a time


@cache
def make_lift_dense_block(ordered: bool) -> wp.Kernel:
    """Kernel that lifts a dense map: atomic additions, or one row for each place if `ordered`."""

    @wp.kernel(module="unique", module_options=BLOCK_OPTIONS, enable_backward=False)
    def lift_dense_block(
        # In:
        offsets: wp.array[int],  # [tiles + 1]
        listed: wp.array[int],  # [I]
        splats: wp.array[Splat],  # [V]
        features: wp.array3d[Lanes],  # [H, W, S] channels in slices of 16
        valid: wp.array2d[float],  # [H, W] 1 where the pixel carries semantics, else 0
        first_feature: int,  # slice of `features` that this pass starts with
        first_slice: int,  # slice of `sums_out` that this pass starts with (atomic variant)
        knobs: Knobs,
        width: int,
        height: int,
        # Out:
        sums_out: wp.array2d[float],  # [N, C] added to, or [I, C of this pass] by place
        weights_out: wp.array[float],  # [N] added to, or [I] by place; written in the first slice of a pass
    ):
        """A^T f; one block per (tile, slice)."""
        tile, s, t = wp.tid()
        columns = (width + TILE - 1) / TILE
        x = (tile % columns) * TILE + t % TILE
        y = (tile / columns) * TILE + t / TILE
        inside = x < width and y < height
        T = wp.where(inside, 1.0, 0.0)
        seen = float(0.0)
        values = Lanes(0.0)
        if inside:
            seen = valid[y, x]
            values = features[y, x, first_feature + s]
        pixels = wp.tile_zeros(shape=(LANES, BLOCK), dtype=float, storage="shared")
        wp.tile_assign(pixels, wp.tile(values), offset=(0, 0))
        shares = wp.tile_zeros(shape=(BATCH, BLOCK), dtype=float, storage="shared")
        j = t / LANES
        c = t % LANES
        last = offsets[tile + 1]
        for start in range(offsets[tile], last, BATCH):
            count = wp.min(BATCH, last - start)
            # The barriers of this load and of the assignment below keep readers and writers of `shares` apart.
            ranks = wp.tile_load(listed, shape=BATCH, offset=start, storage="shared")
            staged = wp.tile_load_indexed(splats, indices=ranks, shape=(BATCH,), storage="shared")
            weights = Lanes(0.0)
            for b in range(BATCH):
                if b < count:
                    alpha = alpha_at(staged[b], x, y, knobs)
                    weights[b] = contribution(alpha, T, knobs) * seen
                    T = attenuated(alpha, T, knobs)
            wp.tile_assign(shares, wp.tile(weights), offset=(0, 0))
            if j < count:
                total = float(0.0)
                weight = float(0.0)
                for step in range(BLOCK):
                    p = (step + c) % BLOCK  # start apart, so that 16 channels read 16 banks
                    total += shares[j, p] * pixels[c, p]
                    weight += shares[j, p]
                gaussian = staged[j].gaussian
                if wp.static(ordered):
                    sums_out[start + j, s * LANES + c] = total
                    if s == 0 and c == 0:
                        weights_out[start + j] = weight
                else:
                    wp.atomic_add(sums_out, gaussian, (first_slice + s) * LANES + c, total)
                    if s == 0 and c == 0:
                        wp.atomic_add(weights_out, gaussian, weight)

    return lift_dense_block


@cache
def make_lift_ids_block(ordered: bool) -> wp.Kernel:
    """Kernel that lifts an id map: atomic additions per (Gaussian, id), or weights for each place if `ordered`."""

    @wp.kernel(module="unique", module_options=BLOCK_OPTIONS, enable_backward=False)
    def lift_ids_block(
        # In:
        offsets: wp.array[int],  # [tiles + 1]
        listed: wp.array[int],  # [I]
        splats: wp.array[Splat],  # [V]
        local_ids: wp.array3d[int],  # [tiles, 16, 16] place of each pixel's id in its tile's list, -1 = none
        tile_ids: wp.array2d[int],  # [tiles, 256]
        tile_id_counts: wp.array[int],  # [tiles]
        row_starts: wp.array[int],  # [tiles + 1] first weight of each tile
        knobs: Knobs,
        width: int,
        height: int,
        # Out:
        id_weights_out: wp.array2d[float],  # [N, M] added to (atomic variant)
        view_weights_out: wp.array[float],  # [N] added to (atomic variant)
        weights_out: wp.array[float],  # for each place one weight per id of its tile (ordered variant)
        starts_out: wp.array[int],  # [I] first weight of each place (ordered variant)
    ):
        """Sum of alpha T by id; one block per tile, 16 ids at a time."""
        tile, t = wp.tid()
        columns = (width + TILE - 1) / TILE
        column = t % TILE
        row = t / TILE
        x = (tile % columns) * TILE + column
        y = (tile / columns) * TILE + row
        T = wp.where(x < width and y < height, 1.0, 0.0)
        place = local_ids[tile, row, column]
        ids = tile_id_counts[tile]
        owners = wp.tile_zeros(shape=BLOCK, dtype=int, storage="shared")
        wp.tile_assign(owners, wp.tile(place), offset=(0,))
        shares = wp.tile_zeros(shape=(BATCH, BLOCK), dtype=float, storage="shared")
        j = t / LANES
        c = t % LANES
        first = offsets[tile]
        last = offsets[tile + 1]
        for start in range(first, last, BATCH):
            count = wp.min(BATCH, last - start)
            # The barriers of this load and of the assignment below keep readers and writers of `shares` apart.
            ranks = wp.tile_load(listed, shape=BATCH, offset=start, storage="shared")
            staged = wp.tile_load_indexed(splats, indices=ranks, shape=(BATCH,), storage="shared")
            weights = Lanes(0.0)
            for b in range(BATCH):
                if b < count:
                    alpha = alpha_at(staged[b], x, y, knobs)
                    weights[b] = contribution(alpha, T, knobs)
                    T = attenuated(alpha, T, knobs)
            wp.tile_assign(shares, wp.tile(weights), offset=(0, 0))
            if j < count:
                gaussian = staged[j].gaussian
                if wp.static(ordered) and c == 0:
                    starts_out[start + j] = row_starts[tile] + (start + j - first) * ids
                for m in range(c, ids, LANES):
                    total = float(0.0)
                    for step in range(BLOCK):
                        p = (step + c) % BLOCK
                        if owners[p] == m:
                            total += shares[j, p]
                    if wp.static(ordered):
                        weights_out[row_starts[tile] + (start + j - first) * ids + m] = total
                    elif total > 0.0:
                        wp.atomic_add(id_weights_out, gaussian, tile_ids[tile, m], total)
                        wp.atomic_add(view_weights_out, gaussian, total)

    return lift_ids_block


@wp.kernel
def fold_view_weights(
    # In:
    view_weights: wp.array[float],  # [N] total weight of each Gaussian in one view
    # Out:
    weight_out: wp.array[float],  # [N] added to
    weight_squared_out: wp.array[float],  # [N] added to
):
    """Add one view's total weights and their squares."""
    i = wp.tid()
    w = view_weights[i]
    weight_out[i] += w
    weight_squared_out[i] += w * w
