"""Weights of the ids of one view as a sparse matrix: only pairs of a Gaussian and an id that it shows are stored."""

import warp as wp

from sgwarp.kernels.gaussian import EXACT_OPTIONS

wp.set_module_options({**EXACT_OPTIONS, "max_unroll": 1})


@wp.kernel
def gather_id_weights(
    # In:
    base: int,  # first rank of this launch
    entries: wp.array[int],  # [V + 1] first entry of each rank
    places: wp.array[int],  # [I] place of each entry
    starts: wp.array[int],  # [I] first weight of each place
    tiles: wp.array[int],  # [I] tile of each entry
    tile_ids: wp.array2d[int],  # [tiles, 256]
    tile_id_counts: wp.array[int],  # [tiles]
    weights: wp.array[float],  # for each place one weight per id of its tile
    firsts: wp.array[int],  # [V + 1] first pair of each rank; room for all ids of all its tiles
    # Out:
    ids_out: wp.array[int],  # [B]
    weights_out: wp.array[float],  # [B] zeroed; stays 0 where a rank has fewer pairs than room
):
    """Distinct ids of each Gaussian with the sum of their weights. One thread per visible Gaussian."""
    k = base + wp.tid()
    first = firsts[k]
    stop = first
    at = first  # pair of the id before: neighboring tiles mostly show the same one
    for e in range(entries[k], entries[k + 1]):
        tile = tiles[e]
        start = starts[places[e]]
        for m in range(tile_id_counts[tile]):
            w = weights[start + m]
            if w > 0.0:
                name = tile_ids[tile, m]
                if at == stop or ids_out[at] != name:
                    at = first
                    while at < stop and ids_out[at] != name:
                        at += 1
                    if at == stop:
                        ids_out[at] = name
                        stop += 1
                weights_out[at] += w
