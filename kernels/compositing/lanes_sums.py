"""Sums of a Gaussian's rows, lane schedule (CPU).

The rows of a splat lie one after the other, one for each patch of tiles that it may reach (`binning_lanes.py`).
"""

import warp as wp

from sgwarp.kernels.native import snippet
from sgwarp.kernels.projection.backward import SEEN
from sgwarp.kernels.transmittance import LANE_OPTIONS, Lanes

wp.set_module_options(LANE_OPTIONS)

AHEAD = 8  # Gaussians between the one that is added and the one that is fetched

SUM = """
    const int ahead = i + AHEAD < ranges.shape[0] ? i + AHEAD : i;
    __builtin_prefetch(rows.data + ranges.data[2 * ahead]);
    const int first = ranges.data[2 * i], last = first + ranges.data[2 * i + 1];
    Row total = zero;
    for (int row = first; row < last; ++row)
        if (used.data[row]) {
            total += *reinterpret_cast<const Row*>(rows.data + row);
            total[SEEN] = 1.0f;
        }
    *reinterpret_cast<Row*>(sums.data + i) = total;
"""

SUM_FEATURES = """
    const int slices = features.shape[1], first = ranges.data[2 * i], last = first + ranges.data[2 * i + 1];
    Row* const out = reinterpret_cast<Row*>(sums.data) + (long long)i * slices;
    for (int s = 0; s < slices; ++s) out[s] = zero;
    for (int row = first; row < last; ++row)
        if (used.data[row])
            for (int s = 0; s < slices; ++s)
                out[s] += reinterpret_cast<const Row*>(features.data)[(long long)row * slices + s];
"""


@wp.func_native(snippet(SUM, AHEAD=AHEAD, SEEN=int(SEEN)))
def sum_gaussian(
    i: int,
    ranges: wp.array2d[int],
    used: wp.array[wp.uint8],
    rows: wp.array[Lanes],
    sums: wp.array[Lanes],
): ...


@wp.func_native(snippet(SUM_FEATURES))
def sum_features_of(
    i: int,
    ranges: wp.array2d[int],
    used: wp.array[wp.uint8],
    features: wp.array2d[Lanes],
    sums: wp.array2d[Lanes],
): ...


@wp.kernel
def sum_used_rows(
    # In:
    base: int,  # first Gaussian of this launch
    ranges: wp.array2d[int],  # [N + 1, 2] first row of each Gaussian and their number
    used: wp.array[wp.uint8],  # [R] whether there is a row; where not, it would be zero
    rows: wp.array[Lanes],  # [R]
    # Out:
    sums_out: wp.array[Lanes],  # [N] zero where none was used
):
    """Add the rows of each Gaussian, in order, and mark who was seen."""
    sum_gaussian(base + wp.tid(), ranges, used, rows, sums_out)


@wp.kernel
def sum_used_features(
    # In:
    base: int,  # first Gaussian of this launch
    ranges: wp.array2d[int],  # [N + 1, 2] first row of each Gaussian and their number
    used: wp.array[wp.uint8],  # [R] whether there is a row
    features: wp.array2d[Lanes],  # [R, S] channels of the rows
    # Out:
    features_out: wp.array2d[Lanes],  # [N, S] zero where no row was used
):
    """Add the features of each Gaussian's rows, in order."""
    sum_features_of(base + wp.tid(), ranges, used, features, features_out)
