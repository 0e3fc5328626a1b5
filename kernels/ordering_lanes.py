"""Depth order on the CPU: a radix sort of what is visible, 11 bits at a time, in one C++ loop."""

import warp as wp

from sgwarp.kernels.gaussian import EXACT_OPTIONS
from sgwarp.kernels.projection.forward import STATUS_NAMES, VISIBLE

wp.set_module_options(EXACT_OPTIONS)

SORT = f"""
    typedef unsigned long long Pair;  // bits of the depth, in order, above the Gaussian
    constexpr int DIGITS = 3, BITS = 11, BINS = 1 << BITS;
    const int n = status.shape[0];
    Pair* from = reinterpret_cast<Pair*>(pairs.data);
    Pair* to = from + n;
    int total = 0, seen[4][{len(STATUS_NAMES)}] = {{}};
    for (int i = 0; i < n; ++i) {{
        const unsigned bits = reinterpret_cast<const unsigned*>(depths.data)[i];
        const unsigned key = bits ^ (bits >> 31 ? 0xffffffffu : 0x80000000u);
        from[total] = (Pair)key << 32 | (unsigned)i;
        total += status.data[i] == {int(VISIBLE)};
        ++seen[i & 3][status.data[i]];  // one table would wait for itself
    }}
    for (int k = 0; k < {len(STATUS_NAMES)}; ++k)
        counts_out.data[k] = seen[0][k] + seen[1][k] + seen[2][k] + seen[3][k];
    int counts[DIGITS][BINS] = {{}};
    for (int k = 0; k < total; ++k)
        for (int digit = 0; digit < DIGITS; ++digit) ++counts[digit][from[k] >> (32 + BITS * digit) & (BINS - 1)];
    for (int digit = 0; digit < DIGITS; ++digit) {{
        int* const places = counts[digit];
        const int shift = 32 + BITS * digit;
        int place = 0;
        for (int bin = 0; bin < BINS; ++bin) {{
            const int here = places[bin];
            places[bin] = place, place += here;
        }}
        if (digit + 1 < DIGITS) {{
            for (int k = 0; k < total; ++k) to[places[from[k] >> shift & (BINS - 1)]++] = from[k];
            Pair* const other = from;
            from = to, to = other;
        }} else
            for (int k = 0; k < total; ++k) order.data[places[from[k] >> shift & (BINS - 1)]++] = (int)from[k];
    }}
"""


@wp.func_native(SORT)
def sort_visible(
    status: wp.array[wp.uint8],
    depths: wp.array[float],
    pairs: wp.array[wp.uint64],
    order: wp.array[int],
    counts_out: wp.array[wp.int64],
): ...


@wp.kernel
def sort_depths(
    # In:
    base: int,  # 0: one thread does it all
    status: wp.array[wp.uint8],  # [N] of the projection
    depths: wp.array[float],  # [N] z [m], where visible
    pairs: wp.array[wp.uint64],  # [2 N] scratch
    # Out:
    order_out: wp.array[int],  # [N] visible Gaussians by (depth, index); what follows them is not written
    counts_out: wp.array[wp.int64],  # [statuses] how many Gaussians have each
):
    """Sort the visible Gaussians."""
    sort_visible(status, depths, pairs, order_out, counts_out)
