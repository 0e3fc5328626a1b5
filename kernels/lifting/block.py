"""Feature lifting, block schedule (CUDA): 256 threads own a tile; weights and features meet in shared memory.

For a batch of 16 fragments each thread puts the weight of its own pixel into shared memory. Dense maps are then a
product of 16 x 256 weights with 256 x 64 features (32 where a map has no more): a warp takes its own 32 pixels, a
thread 4 fragments and 8 channels. It keeps 32 sums in registers, three reads of four floats for 32 multiplications, and
the sums of the eight warps are added up in three steps. Id maps are sums of a row of pixels, which go to one id where
the whole row shows it.

A sum goes to the Gaussian by one atomic addition per (tile, fragment, channel) or, in the ordered variant, to the row
of its place in the lists; `shared.sum_rows` adds the rows up in a fixed order. A block ends when all its pixels are
closed. Shared memory is padded so that the threads of a warp meet no bank twice.
"""

from functools import cache

import warp as wp

from sgwarp.kernels.binning import TILE
from sgwarp.kernels.blocks import BLOCK, barrier, put
from sgwarp.kernels.compositing.block import alpha_at
from sgwarp.kernels.gaussian import Splat
from sgwarp.kernels.projection.forward import Knobs
from sgwarp.kernels.transmittance import BLOCK_OPTIONS, LANES, attenuated, contribution

wp.set_module_options(BLOCK_OPTIONS)

BATCH = LANES  # fragments whose weights meet the features at a time
WARP = 32  # threads, and pixels whose products one of them sums
CHANNELS, WIDE_CHANNELS = 2 * LANES, 4 * LANES  # that a block lifts
FRAGMENTS = 4  # that a thread multiplies by
WEIGHTS = BATCH + 4  # floats between the weights of two pixels (dense)
PADDED_ROW = TILE + 1  # floats between two rows of weights (ids)
FRAGMENT = TILE * PADDED_ROW


@wp.func
def four_floats(values: wp.tile[float], first: int) -> wp.vec4:
    """Four neighbors in shared memory; one read where `first` is a multiple of four."""
    a = wp.tile_extract(values, first)
    b = wp.tile_extract(values, first + 1)
    c = wp.tile_extract(values, first + 2)
    d = wp.tile_extract(values, first + 3)
    return wp.vec4(a, b, c, d)


@cache
def make_lift_dense_block(ordered: bool, squared: bool = False, wide: bool = True) -> wp.Kernel:
    """Kernel that lifts a dense map: atomic additions, or one row for each place if `ordered`; with weight alpha T, or
    its square; 64 channels a block, or 32 unless `wide`."""
    channels_of_block = WIDE_CHANNELS if wide else CHANNELS
    quads = channels_of_block // 4
    halves = quads // 8  # vectors of channels that a thread multiplies
    per_fragment = 4 * halves
    Products = wp.types.vector(length=FRAGMENTS * per_fragment, dtype=wp.float32)
    sums_of_warp = BATCH * channels_of_block

    @wp.kernel(module="unique", module_options=BLOCK_OPTIONS, enable_backward=False)
    def lift_dense_block(
        # In:
        offsets: wp.array[int],  # [tiles + 1]
        listed: wp.array[int],  # [I]
        splats: wp.array[Splat],  # [V]
        features: wp.array3d[float],  # [H, W, 16 S] channels
        valid: wp.array2d[float],  # [H, W] 1 where the pixel carries semantics, else 0
        first_feature: int,  # channel of `features` that this pass starts with
        first_channel: int,  # of `sums_out` that this pass starts with (atomic variant)
        channels: int,  # of this pass
        knobs: Knobs,
        width: int,
        height: int,
        # Out:
        sums_out: wp.array2d[float],  # [N, C] added to, or [I, C of this pass] by place
        weights_out: wp.array[float],  # [N] added to, or [I] by place; written by the first blocks of a pass
    ):
        """A^T f; one block per (tile, 64 channels)."""
        tile, part, t = wp.tid()
        columns = (width + TILE - 1) / TILE
        x0 = (tile % columns) * TILE
        y0 = (tile / columns) * TILE
        x = x0 + t % TILE
        y = y0 + t / TILE
        T = float(0.0)
        seen = float(0.0)
        if x < width and y < height:
            T = float(1.0)
            seen = valid[y, x]
        base = channels_of_block * part
        c = t % channels_of_block
        pixels = wp.tile_empty(shape=(wp.static(channels_of_block * BLOCK),), dtype=float, storage="shared")
        for p in range(t / channels_of_block, BLOCK, wp.static(BLOCK // channels_of_block)):
            value = float(0.0)
            inside = x0 + p % TILE < width and y0 + p / TILE < height
            if inside and base + c < channels:
                value = features[y0 + p / TILE, x0 + p % TILE, first_feature + base + c]
            put(pixels, channels_of_block * p + c, value)
        # Weights of a batch, pixel by pixel, then the sums of four warps.
        shares = wp.tile_empty(
            shape=(wp.static(max(WEIGHTS * BLOCK, 4 * sums_of_warp)),), dtype=float, storage="shared"
        )
        totals = wp.tile_empty(shape=(wp.static(BATCH * PADDED_ROW),), dtype=float, storage="shared")
        still_open = wp.tile_zeros(shape=(2,), dtype=float, storage="shared")
        row = t / TILE
        warp = t / WARP
        four = (t % WARP) / 8  # which four fragments are a thread's
        quad = t % 8  # which channels: these four, and as many 32 channels further on
        mine = wp.static(sums_of_warp) * (warp % 4) + wp.static(channels_of_block * FRAGMENTS) * four + 4 * quad
        first = offsets[tile]
        last = offsets[tile + 1]
        stop = last  # where no pixel is open any more
        for start in range(first, last, BATCH):
            turn = ((start - first) / BATCH) % 2
            size = wp.min(BATCH, last - start)
            # The barriers of these loads keep readers of the last batch and writers of this one apart.
            ranks = wp.tile_load(listed, shape=BATCH, offset=start, storage="shared")
            staged = wp.tile_load_indexed(splats, indices=ranks, shape=(BATCH,), storage="shared")
            # Up to three fragments behind the tile's last go along; nobody reads what they add up to.
            for b in range(0, size, FRAGMENTS):
                weights = wp.vec4(0.0, 0.0, 0.0, 0.0)
                for a in range(FRAGMENTS):
                    alpha = alpha_at(wp.tile_extract(staged, b + a), x, y, knobs)
                    weight = contribution(alpha, T, knobs)
                    if wp.static(squared):
                        weight *= weight
                    weights[a] = weight * seen
                    T = attenuated(alpha, T, knobs)
                for a in range(FRAGMENTS):
                    put(shares, WEIGHTS * t + b + a, weights[a])
            if T > 0.0:
                put(still_open, turn, 1.0)
            barrier()
            if t == 0:
                put(still_open, 1 - turn, 0.0)
            if part == 0:
                weight = float(0.0)
                for i in range(TILE):
                    weight += wp.tile_extract(shares, WEIGHTS * (TILE * row + i) + t % TILE)
                put(totals, PADDED_ROW * (t % TILE) + row, weight)
            products = Products(0.0)
            for p4 in range(WARP * warp, WARP * warp + WARP, 4):
                for k in range(4):
                    w = four_floats(shares, WEIGHTS * (p4 + k) + FRAGMENTS * four)
                    for h in range(halves):
                        f = four_floats(pixels, channels_of_block * (p4 + k) + 32 * h + 4 * quad)
                        for a in range(FRAGMENTS):
                            for e in range(4):
                                place = per_fragment * a + 4 * h + e
                                products[place] = products[place] + w[a] * f[e]
            barrier()
            if warp >= 4:
                for a in range(FRAGMENTS):
                    for h in range(halves):
                        for e in range(4):
                            at = mine + channels_of_block * a + 32 * h + e
                            put(shares, at, products[per_fragment * a + 4 * h + e])
            barrier()
            if warp < 4:
                for a in range(FRAGMENTS):
                    for h in range(halves):
                        before = four_floats(shares, mine + channels_of_block * a + 32 * h)
                        for e in range(4):
                            at = mine + channels_of_block * a + 32 * h + e
                            put(shares, at, products[per_fragment * a + 4 * h + e] + before[e])
            barrier()
            if base + c < channels:
                for j in range(t / channels_of_block, size, wp.static(BLOCK // channels_of_block)):
                    total = float(0.0)
                    for i in range(4):
                        total += wp.tile_extract(shares, wp.static(sums_of_warp) * i + channels_of_block * j + c)
                    if wp.static(ordered):
                        sums_out[start + j, base + c] = total
                    else:
                        wp.atomic_add(sums_out, wp.tile_extract(staged, j).gaussian, first_channel + base + c, total)
            if part == 0 and t < size:
                weight = float(0.0)
                for i in range(TILE):
                    weight += wp.tile_extract(totals, PADDED_ROW * t + i)
                if wp.static(ordered):
                    weights_out[start + t] = weight
                else:
                    wp.atomic_add(weights_out, wp.tile_extract(staged, t).gaussian, weight)
            if wp.tile_extract(still_open, turn) == 0.0:
                stop = start + size
                break
        if wp.static(ordered):
            for k in range(stop + t, last, BLOCK):
                for e in range(base, wp.min(base + channels_of_block, channels)):
                    sums_out[k, e] = 0.0
                if part == 0:
                    weights_out[k] = 0.0

    return lift_dense_block


@cache
def make_lift_ids_block(ordered: bool, squared: bool = False) -> wp.Kernel:
    """Kernel that lifts an id map: atomic additions per (Gaussian, id), or weights for each place if `ordered`; with
    weight alpha T, or its square."""

    @wp.kernel(module="unique", module_options=BLOCK_OPTIONS, enable_backward=False)
    def lift_ids_block(
        # In:
        offsets: wp.array[int],  # [tiles + 1]
        listed: wp.array[int],  # [I]
        splats: wp.array[Splat],  # [V]
        local_ids: wp.array3d[int],  # [tiles, 16, 16] place of each pixel's id in its tile's list, -1 = none
        uniform: wp.array2d[int],  # [tiles, 16] the place all pixels of a row share, else -2
        tile_ids: wp.array2d[int],  # [tiles, 256]
        tile_id_counts: wp.array[int],  # [tiles]
        row_starts: wp.array[int],  # [tiles + 1] first weight of each tile
        knobs: Knobs,
        width: int,
        height: int,
        # Out:
        id_weights_out: wp.array2d[float],  # [N, M] added to (atomic variant)
        view_weights_out: wp.array[float],  # [N] added to (atomic variant)
        weights_out: wp.array[float],  # for each place one weight per id of its tile, zeroed (ordered variant)
        starts_out: wp.array[int],  # [I] first weight of each place (ordered variant)
    ):
        """Sum of alpha T by id; one block per tile, 16 ids at a time."""
        tile, t = wp.tid()
        columns = (width + TILE - 1) / TILE
        x = (tile % columns) * TILE + t % TILE
        y = (tile / columns) * TILE + t / TILE
        T = wp.where(x < width and y < height, 1.0, 0.0)
        ids = tile_id_counts[tile]
        shares = wp.tile_empty(shape=(wp.static(BATCH * FRAGMENT),), dtype=float, storage="shared")
        sums = wp.tile_empty(shape=(wp.static(LANES * (BLOCK + 1)),), dtype=float, storage="shared")
        still_open = wp.tile_zeros(shape=(2,), dtype=float, storage="shared")
        mine = PADDED_ROW * (t / TILE) + t % TILE  # place of this pixel among the weights of a fragment
        j = t / TILE
        c = t % TILE  # a row of pixels, and then an id
        shared_id = uniform[tile, c]
        first = offsets[tile]
        last = offsets[tile + 1]
        if wp.static(ordered):
            for k in range(first + t, last, BLOCK):
                starts_out[k] = row_starts[tile] + (k - first) * ids
        for start in range(first, last, BATCH):
            turn = ((start - first) / BATCH) % 2
            size = wp.min(BATCH, last - start)
            # The barriers of these loads keep readers of the last batch and writers of this one apart.
            ranks = wp.tile_load(listed, shape=BATCH, offset=start, storage="shared")
            staged = wp.tile_load_indexed(splats, indices=ranks, shape=(BATCH,), storage="shared")
            for b in range(size):
                alpha = alpha_at(wp.tile_extract(staged, b), x, y, knobs)
                weight = contribution(alpha, T, knobs)
                if wp.static(squared):
                    weight *= weight
                put(shares, FRAGMENT * b + mine, weight)
                T = attenuated(alpha, T, knobs)
            if T > 0.0:
                put(still_open, turn, 1.0)
            barrier()
            if t == 0:
                put(still_open, 1 - turn, 0.0)
            of_row = float(0.0)
            if j < size:
                for i in range(TILE):
                    of_row += wp.tile_extract(shares, FRAGMENT * j + PADDED_ROW * c + i)
            for chunk in range(0, ids, LANES):
                count = wp.min(LANES, ids - chunk)
                for m in range(count):
                    total = wp.where(shared_id == chunk + m, of_row, 0.0)
                    if shared_id == -2 and j < size and of_row > 0.0:
                        for i in range(TILE):
                            if local_ids[tile, c, i] == chunk + m:
                                total += wp.tile_extract(shares, FRAGMENT * j + PADDED_ROW * c + i)
                    put(sums, (BLOCK + 1) * m + t, total)
                barrier()
                if j < size and c < count:
                    total = float(0.0)
                    for i in range(TILE):
                        total += wp.tile_extract(sums, (BLOCK + 1) * c + TILE * j + i)
                    if wp.static(ordered):
                        weights_out[row_starts[tile] + (start + j - first) * ids + chunk + c] = total
                    elif total > 0.0:
                        gaussian = wp.tile_extract(staged, j).gaussian
                        wp.atomic_add(id_weights_out, gaussian, tile_ids[tile, chunk + c], total)
                        wp.atomic_add(view_weights_out, gaussian, total)
                barrier()
            if wp.tile_extract(still_open, turn) == 0.0:
                break

    return lift_ids_block


@wp.kernel
def add_id_channels(
    # In:
    id_weights: wp.array2d[float],  # [N, M]
    vectors: wp.array2d[float],  # [M, 16 S] one feature per id
    # Out:
    features_out: wp.array2d[float],  # [N, 16 S] added to
):
    """Multiply the id weights by the vectors, skipping zeros; 32 threads per Gaussian share its channels."""
    thread = wp.tid()
    i = thread / 32
    for c in range(thread % 32, vectors.shape[1], 32):
        total = float(0.0)
        for m in range(id_weights.shape[1]):
            w = id_weights[i, m]
            if w > 0.0:
                total += w * vectors[m, c]
        if total != 0.0:
            features_out[i, c] = features_out[i, c] + total


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
