"""Shared by both lifting schedules: ids per tile, sums per Gaussian, and the paper's center mode."""

import warp as wp

from sgwarp.kernels.binning import TILE
from sgwarp.kernels.gaussian import EXACT_OPTIONS, Splat
from sgwarp.kernels.projection.forward import VISIBLE
from sgwarp.kernels.transmittance import LaneIds, Lanes

# Loops over the rows and pixels of a tile stay loops: unrolled they compile for seconds and run no faster.
wp.set_module_options({**EXACT_OPTIONS, "max_unroll": 1})

ROWS_AHEAD = wp.constant(16)  # entries between the one that is added and the one that is fetched
MAX_IDS = wp.constant(256)  # a tile has 256 pixels, so no more ids


@wp.kernel
def localize_ids(
    # In:
    base: int,  # first tile of this launch
    chosen: wp.array[int],  # tiles to do, or empty: all
    ids: wp.array2d[int],  # [h, w] id map, -1 = none; may be smaller than the image
    width: int,  # of the image [pixels]
    height: int,
    # Out:
    tile_ids_out: wp.array2d[int],  # [tiles, 256] distinct ids of each tile, in order of appearance
    tile_id_counts_out: wp.array[int],  # [tiles]
    local_ids_out: wp.array2d[LaneIds],  # [tiles, 16] place in that list, -1 = none
    uniform_out: wp.array2d[int],  # [tiles, 16] the place all 16 pixels of a row share, else -2
):
    """List the distinct ids of each tile, reading the map at the nearest position. One thread per tile."""
    tile = base + wp.tid()
    if chosen.shape[0] > 0:
        tile = chosen[tile]
    columns = (width + TILE - 1) / TILE
    x0 = (tile % columns) * TILE
    y0 = (tile / columns) * TILE
    count = int(0)
    for row in range(TILE):
        places = LaneIds(-1)
        y = y0 + row
        shared = int(-1)
        for i in range(TILE):
            x = x0 + i
            place = int(-1)
            if x < width and y < height:
                # The centre of image pixel (x, y) lies in map pixel floor((x + 1/2) w / W), exactly in integers.
                value = ids[(2 * y + 1) * ids.shape[0] / (2 * height), (2 * x + 1) * ids.shape[1] / (2 * width)]
                if value >= 0:
                    for m in range(count):
                        if tile_ids_out[tile, m] == value:
                            place = m
                    if place < 0:
                        tile_ids_out[tile, count] = value
                        place = count
                        count += 1
                if i == 0:
                    shared = place
                elif place != shared:
                    shared = -2
            places[i] = place
        local_ids_out[tile, row] = places
        uniform_out[tile, row] = shared
    tile_id_counts_out[tile] = count


@wp.func_native("""
#if !defined(__CUDA_ARCH__)
    if (entry < places.shape[0])
        for (int s = 0; s < rows.shape[1]; ++s) __builtin_prefetch(rows.data + places.data[entry] * rows.shape[1] + s);
#endif
""")
def prefetch_rows(rows: wp.array2d[Lanes], places: wp.array[int], entry: int): ...  # a hint for the CPU's cache


@wp.kernel
def sum_rows(
    # In:
    base: int,  # first rank of this launch
    order: wp.array[int],  # [V] visible Gaussians
    entries: wp.array[int],  # [V + 1] first entry of each
    places: wp.array[int],  # [I] place of each entry in the tile lists
    rows: wp.array2d[Lanes],  # [I, slices] by place
    first_slice: int,  # of this pass
    slices: int,
    # Out:
    features_out: wp.array2d[Lanes],  # [N, S] added to
):
    """Add the rows of each Gaussian's entries, in order. One thread per visible Gaussian."""
    k = base + wp.tid()
    i = order[k]
    for s in range(slices):
        total = Lanes(0.0)
        for e in range(entries[k], entries[k + 1]):
            prefetch_rows(rows, places, e + wp.where(s == 0, ROWS_AHEAD, places.shape[0]))
            total += rows[places[e], s]
        features_out[i, first_slice + s] += total


@wp.kernel
def sum_weights(
    # In:
    base: int,
    order: wp.array[int],  # [V]
    entries: wp.array[int],  # [V + 1]
    places: wp.array[int],  # [I]
    weights: wp.array[float],  # [I] by place
    # Out:
    weight_out: wp.array[float],  # [N] added to
    weight_squared_out: wp.array[float],  # [N] added to: square of this view's total
):
    """Total weight of each Gaussian in one view."""
    k = base + wp.tid()
    i = order[k]
    total = float(0.0)
    for e in range(entries[k], entries[k + 1]):
        total += weights[places[e]]
    weight_out[i] += total
    weight_squared_out[i] += total * total


@wp.func_native(
    """
#if !defined(__CUDA_ARCH__)
    if (entry + 2 * ROWS_AHEAD < places.shape[0]) __builtin_prefetch(starts.data + places.data[entry + 2 * ROWS_AHEAD]);
    if (entry + ROWS_AHEAD < places.shape[0])
        __builtin_prefetch(weights.data + starts.data[places.data[entry + ROWS_AHEAD]]);
#endif
""".replace("ROWS_AHEAD", str(int(ROWS_AHEAD)))
)
def prefetch_weights(
    weights: wp.array[float], starts: wp.array[int], places: wp.array[int], entry: int
): ...  # a hint for the CPU's cache: first where the weights start, then they themselves


@wp.kernel
def sum_id_weights(
    # In:
    base: int,
    order: wp.array[int],  # [V]
    entries: wp.array[int],  # [V + 1]
    places: wp.array[int],  # [I]
    starts: wp.array[int],  # [I] first weight of each place
    tiles: wp.array[int],  # [I] tile of each entry
    tile_ids: wp.array2d[int],  # [tiles, 256]
    tile_id_counts: wp.array[int],  # [tiles]
    weights: wp.array[float],  # for each place one weight per id of its tile
    by_gaussian: int,  # 1: rows of id_weights_out are Gaussians, 0: they are ranks
    # Out:
    id_weights_out: wp.array2d[float],  # [V or N, M] added to
    weight_out: wp.array[float],  # [N] added to
    weight_squared_out: wp.array[float],  # [N] added to
):
    """Weight of every id for each Gaussian. One thread per visible Gaussian."""
    k = base + wp.tid()
    i = order[k]
    target = wp.where(by_gaussian != 0, i, k)
    total = float(0.0)
    run = int(-1)  # neighbouring tiles mostly show the same id: its weight is written once
    run_weight = float(0.0)
    for e in range(entries[k], entries[k + 1]):
        prefetch_weights(weights, starts, places, e)
        tile = tiles[e]
        start = starts[places[e]]
        for m in range(tile_id_counts[tile]):
            w = weights[start + m]
            if w > 0.0:
                total += w
                name = tile_ids[tile, m]
                if name == run:
                    run_weight += w
                else:
                    if run >= 0:
                        id_weights_out[target, run] += run_weight
                    run = name
                    run_weight = w
    if run >= 0:
        id_weights_out[target, run] += run_weight
    weight_out[i] += total
    weight_squared_out[i] += total * total


@wp.kernel
def add_id_features(
    # In:
    base: int,
    order: wp.array[int],  # [V]
    id_weights: wp.array2d[float],  # [V, M]
    vectors: wp.array2d[Lanes],  # [M, S] one feature per id, in slices of 16 channels
    # Out:
    features_out: wp.array2d[Lanes],  # [N, S] added to
):
    """Multiply the id weights by the vectors, skipping zeros: exact, and once per view instead of once per pixel."""
    k = base + wp.tid()
    i = order[k]
    for m in range(id_weights.shape[1]):
        w = id_weights[k, m]
        if w > 0.0:
            for s in range(vectors.shape[1]):
                features_out[i, s] += w * vectors[m, s]


@wp.kernel
def find_center_pixels(
    # In:
    base: int,
    splats: wp.array[Splat],  # [N]
    status: wp.array[wp.uint8],  # [N]
    surface: wp.array2d[float],  # [H, W] rendered depth [m], 0 = no hit
    tau: float,  # relative depth tolerance
    border: int,  # pixels cut at the image border
    # Out:
    pixels_out: wp.array[int],  # [N] y W + x of the pixel that holds the centre, or -1 if it is not seen
):
    """The paper's correspondence: the centre's pixel, where |d - z| <= tau d for the rendered depth d."""
    i = base + wp.tid()
    pixels_out[i] = -1
    if int(status[i]) != VISIBLE:
        return
    splat = splats[i]
    height = surface.shape[0]
    width = surface.shape[1]
    x = wp.floor(splat.mean[0])
    y = wp.floor(splat.mean[1])
    if x < float(border) or x >= float(width - border) or y < float(border) or y >= float(height - border):
        return
    d = surface[int(y), int(x)]
    if d > 0.0 and wp.abs(d - splat.depth) <= tau * d:
        pixels_out[i] = int(y) * width + int(x)
