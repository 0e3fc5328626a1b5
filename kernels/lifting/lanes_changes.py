"""Lifting again only what changed between two frames of a moving scene (CPU).

Of every view the tile lists and the weights of `lift_ids` are kept. A tile is stale where a changed Gaussian lies or
lay, or where the id map differs. Lists name Gaussians, not ranks: a depth order of all of them is never made again. A
stale list is the old one without the changed Gaussians, merged with theirs by (depth, index); everything else is
copied, because the flat arrays shift.
"""

import warp as wp

from sgwarp.kernels.gaussian import EXACT_OPTIONS, Splat

# Those of `shared.py`: the additions of both must round alike.
wp.set_module_options({**EXACT_OPTIONS, "max_unroll": 1})


# The loops over all places are plain C: through Warp's arrays, an element takes several times as long.
@wp.func_native("""
    const int first = offsets.data[tile], stop = offsets.data[tile + 1];
    const int added = added_offsets.data[tile + 1] - added_offsets.data[tile];
    int stays = 0;
    for (int k = first; k < stop; ++k) stays += 1 - changed.data[listed.data[k]];
    if (stays < stop - first || added) stale_out.data[tile] = 1;
    counts_out.data[tile] = stays + added;
""")
def count_list(
    tile: int,
    offsets: wp.array[int],
    listed: wp.array[int],
    changed: wp.array[wp.uint8],
    added_offsets: wp.array[int],
    stale_out: wp.array[wp.uint8],
    counts_out: wp.array[int],
): ...


@wp.kernel
def count_carried(
    # In:
    base: int,  # first tile of this launch
    offsets: wp.array[int],  # [tiles + 1] of the old lists
    listed: wp.array[int],  # [I] Gaussians of the old lists
    changed: wp.array[wp.uint8],  # [N] 1 or 0
    added_offsets: wp.array[int],  # [tiles + 1] of the lists of the changed Gaussians
    # Out:
    stale_out: wp.array[wp.uint8],  # [tiles] set to 1 where a changed Gaussian lies or lay
    counts_out: wp.array[int],  # [tiles] length of the new lists
):
    """Which lists change, and how long they become."""
    count_list(base + wp.tid(), offsets, listed, changed, added_offsets, stale_out, counts_out)


@wp.func_native("""
    int* out = listed_out.data + new_offsets.data[tile];
    const int stop = offsets.data[tile + 1];
    if (!stale.data[tile]) {
        for (int k = offsets.data[tile]; k < stop; ++k) *out++ = listed.data[k];
        return;
    }
    int j = added_offsets.data[tile];
    const int j_stop = added_offsets.data[tile + 1];
    for (int k = offsets.data[tile]; k < stop; ++k) {
        const int i = listed.data[k];
        if (changed.data[i]) continue;
        const float depth = splats.data[i].depth;
        for (; j < j_stop; ++j) {
            const int other = added.data[j];
            const float its_depth = splats.data[other].depth;
            if (its_depth > depth || (its_depth == depth && other > i)) break;
            *out++ = other;
        }
        *out++ = i;
    }
    for (; j < j_stop; ++j) *out++ = added.data[j];
""")
def merge_list(
    tile: int,
    offsets: wp.array[int],
    listed: wp.array[int],
    changed: wp.array[wp.uint8],
    stale: wp.array[wp.uint8],
    added_offsets: wp.array[int],
    added: wp.array[int],
    splats: wp.array[Splat],
    new_offsets: wp.array[int],
    listed_out: wp.array[int],
): ...


@wp.kernel
def merge_lists(
    # In:
    base: int,  # first tile of this launch
    offsets: wp.array[int],  # [tiles + 1] of the old lists
    listed: wp.array[int],  # [I] Gaussians of the old lists
    changed: wp.array[wp.uint8],  # [N]
    stale: wp.array[wp.uint8],  # [tiles]
    added_offsets: wp.array[int],  # [tiles + 1] of the lists of the changed Gaussians
    added: wp.array[int],  # [J] Gaussians of those
    splats: wp.array[Splat],  # [N] the new ones
    new_offsets: wp.array[int],  # [tiles + 1]
    # Out:
    listed_out: wp.array[int],  # [I'] Gaussians of the new lists
):
    """Copy the lists that stay, merge the others by (depth, index)."""
    merge_list(base + wp.tid(), offsets, listed, changed, stale, added_offsets, added, splats, new_offsets, listed_out)


@wp.func_native("""
    float* const out = weights_out.data + new_row_starts.data[tile];
    const int count = new_row_starts.data[tile + 1] - new_row_starts.data[tile];
    const float* const from = weights.data + row_starts.data[tile];
    const bool stays = !stale.data[tile];
    for (int k = 0; k < count; ++k) out[k] = stays ? from[k] : 0.0f;
    if (stays) return;
    for (int k = offsets.data[tile]; k < offsets.data[tile + 1]; ++k) affected_out.data[listed.data[k]] = 1;
""")
def carry_tile(
    tile: int,
    stale: wp.array[wp.uint8],
    row_starts: wp.array[int],
    weights: wp.array[float],
    new_row_starts: wp.array[int],
    offsets: wp.array[int],
    listed: wp.array[int],
    weights_out: wp.array[float],
    affected_out: wp.array[wp.uint8],
): ...


@wp.kernel
def carry_weights(
    # In:
    base: int,  # first tile of this launch
    stale: wp.array[wp.uint8],  # [tiles]
    row_starts: wp.array[int],  # [tiles + 1] first weight of each tile
    weights: wp.array[float],  # for each place one weight per id of its tile
    new_row_starts: wp.array[int],  # [tiles + 1]
    offsets: wp.array[int],  # [tiles + 1] of the new lists
    listed: wp.array[int],  # [I] Gaussians of the new lists
    # Out:
    weights_out: wp.array[float],  # the same at their new places; zero in stale tiles, as `lift_ids` expects
    affected_out: wp.array[wp.uint8],  # [N] set to 1 for Gaussians in stale tiles; threads may write the same 1
):
    """Copy the weights of the tiles that stay, and mark the Gaussians of the others: their sums change."""
    carry_tile(base + wp.tid(), stale, row_starts, weights, new_row_starts, offsets, listed, weights_out, affected_out)


@wp.func_native("""
    const int first = slice * per_slice;
    const int stop = first + per_slice < affected.shape[0] ? first + per_slice : affected.shape[0];
    const int columns = id_weights_out.shape[1], named = tile_ids.shape[1];
    int* const run = runs.data;
    float* const run_weight = run_weights.data;
    float* const total = totals.data;
    for (int a = first; a < stop; ++a) run[a] = -1, run_weight[a] = 0.0f, total[a] = 0.0f;
    for (int tile = 0; tile < tile_id_counts.shape[0]; ++tile) {
        const int ids = tile_id_counts.data[tile];
        if (!ids) continue;
        const int* const names = tile_ids.data + tile * named;
        const float* w = weights.data + row_starts.data[tile];
        for (int k = offsets.data[tile]; k < offsets.data[tile + 1]; ++k, w += ids) {
            const int a = places.data[listed.data[k]];
            if (a < first || a >= stop) continue;
            for (int m = 0; m < ids; ++m) {
                if (!(w[m] > 0.0f)) continue;
                total[a] += w[m];
                if (names[m] == run[a]) {
                    run_weight[a] += w[m];
                    continue;
                }
                const int row = by_gaussian ? affected.data[a] : a;
                if (run[a] >= 0) id_weights_out.data[row * columns + run[a]] += run_weight[a];
                run[a] = names[m], run_weight[a] = w[m];
            }
        }
    }
""")
def scan_lists(
    slice: int,
    per_slice: int,
    affected: wp.array[int],
    places: wp.array[int],
    offsets: wp.array[int],
    listed: wp.array[int],
    row_starts: wp.array[int],
    tile_ids: wp.array2d[int],
    tile_id_counts: wp.array[int],
    weights: wp.array[float],
    by_gaussian: int,
    runs: wp.array[int],
    run_weights: wp.array[float],
    totals: wp.array[float],
    id_weights_out: wp.array2d[float],
): ...


@wp.kernel
def sum_listed_weights(
    # In:
    base: int,  # first slice of the affected Gaussians of this launch
    per_slice: int,  # affected Gaussians in a slice
    affected: wp.array[int],  # [A] Gaussians, ascending
    places: wp.array[int],  # [N] place among the affected, -1 = none
    offsets: wp.array[int],  # [tiles + 1]
    listed: wp.array[int],  # [I] Gaussians
    row_starts: wp.array[int],  # [tiles + 1]
    tile_ids: wp.array2d[int],  # [tiles, most ids]
    tile_id_counts: wp.array[int],  # [tiles]
    weights: wp.array[float],  # for each place of the lists one weight per id of its tile
    by_gaussian: int,  # 1: rows of id_weights_out are Gaussians, 0: they are places among the affected
    # In and out:
    runs: wp.array[int],  # [A] scratch: id at work
    run_weights: wp.array[float],  # [A] scratch: its weight so far
    totals: wp.array[float],  # [A] scratch: weight of the Gaussian in this view
    # Out:
    id_weights_out: wp.array2d[float],  # [A or N, M] added to
    weight_out: wp.array[float],  # [N] added to
    weight_squared_out: wp.array[float],  # [N] added to
):
    """`sum_id_weights` of some Gaussians, in the same order of additions: the same bits. One thread per slice.

    A Gaussian's tiles come in ascending order in the lists, as its entries do.
    """
    slice = base + wp.tid()
    scan_lists(
        slice,
        per_slice,
        affected,
        places,
        offsets,
        listed,
        row_starts,
        tile_ids,
        tile_id_counts,
        weights,
        by_gaussian,
        runs,
        run_weights,
        totals,
        id_weights_out,
    )
    for a in range(slice * per_slice, wp.min((slice + 1) * per_slice, affected.shape[0])):
        i = affected[a]
        if runs[a] >= 0:
            id_weights_out[wp.where(by_gaussian != 0, i, a), runs[a]] += run_weights[a]
        weight_out[i] += totals[a]
        weight_squared_out[i] += totals[a] * totals[a]
