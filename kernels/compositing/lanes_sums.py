"""Sums over the tiles of each Gaussian, lane schedule (CPU): `sum_intersections` without the rows that are zero.

Rows lie by place, so those of one Gaussian are far apart, and fetching them is all that this costs.
"""

import warp as wp

from sgwarp.kernels.native import snippet
from sgwarp.kernels.projection.backward import SEEN
from sgwarp.kernels.transmittance import LANE_OPTIONS, Lanes

wp.set_module_options(LANE_OPTIONS)

AHEAD = 16  # entries between the one that is added and the one that is fetched

SUM = """
    const int first = entries.data[rank], last = entries.data[rank + 1], count = places.shape[0];
    if (first == last) return;
    const Row nothing = zero;
    Row total = zero;
    for (int entry = first; entry < last; ++entry) {
        const int ahead = entry + AHEAD;
        if (ahead < count) {
            const int next = places.data[ahead];
            __builtin_prefetch(used.data[next] ? rows.data + next : rows.data);
        }
        const int place = places.data[entry];
        total += *(used.data[place] ? reinterpret_cast<const Row*>(rows.data + place) : &nothing);
    }
    total[SEEN] = 1.0f;
    *reinterpret_cast<Row*>(sums.data + order.data[rank]) = total;
"""


@wp.func_native(snippet(SUM, AHEAD=AHEAD, SEEN=int(SEEN)))
def sum_rank(
    rank: int,
    order: wp.array[int],
    entries: wp.array[int],
    places: wp.array[int],
    used: wp.array[wp.uint8],
    rows: wp.array[Lanes],
    sums: wp.array[Lanes],
): ...


@wp.kernel
def sum_used_rows(
    # In:
    base: int,  # first rank of this launch
    order: wp.array[int],  # [V] Gaussians
    entries: wp.array[int],  # [V + 1] first entry of each
    places: wp.array[int],  # [I] place of each entry in the tile lists
    used: wp.array[wp.uint8],  # [I] by place: whether there is a row; where not, it would be zero
    rows: wp.array[Lanes],  # [I] by place
    # Out:
    sums_out: wp.array[Lanes],  # [N] zeroed
):
    """Add the rows of each Gaussian's entries, in order, and mark the Gaussian as seen."""
    sum_rank(base + wp.tid(), order, entries, places, used, rows, sums_out)
