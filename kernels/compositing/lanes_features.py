"""Front-to-back compositing of feature vectors, lane schedule (CPU): passes of 16 or 64 channels.

Fragments come in batches, as in `lanes.py`. For a row of 16 pixels the weights of a batch are computed
first; then they are multiplied by the features as small matrices are, 16 channels by 16 pixels in registers.
"""

from functools import cache

import warp as wp

from sgwarp.kernels.binning import TILE
from sgwarp.kernels.compositing.lanes import open_tile
from sgwarp.kernels.compositing.loops import REACHING, gather_batch, write_last
from sgwarp.kernels.gaussian import Splat
from sgwarp.kernels.native import BATCH, Seen, snippet
from sgwarp.kernels.projection.forward import Knobs
from sgwarp.kernels.transmittance import LANE_OPTIONS, LANES, Lanes

wp.set_module_options(LANE_OPTIONS)

PASS = 16  # channels accumulated in registers at a time

PREFETCH = """
    for (int b = 0; b < count; ++b) {
        const auto* const x = features.data + batch.data[slot * BATCH + b].splat.gaussian * features.shape[1];
        for (int s = 0; s < SLICES; ++s) __builtin_prefetch(x + first_slice + s);
    }
"""

FORWARD = (
    REACHING
    + """
    if (!left) return true;
    const int planes = state.shape[2];
    Row* const row_state = reinterpret_cast<Row*>(state.data + (slot * 16 + row) * planes);
    Row T = row_state[0], last = zero, weights[BATCH] __attribute__((aligned(64)));
    const float* owners[BATCH];
    if (RECORD) last = row_state[planes - 1];
    int count = 0;
    for (; left; left &= left - 1) {
        const int b = __builtin_ctz(left);
        const auto& seen = batch.data[slot * BATCH + b];
        const Row w = take_seen(seen, row, knobs, T);
        if (RECORD) {
            const float place = order + b;
            last = w > zero ? one * place : last;
        }
        weights[count] = w;
        const auto* const x = features.data + seen.splat.gaussian * features.shape[1] + first_slice;
        owners[count] = reinterpret_cast<const float*>(x);
        count += bits(w > zero) != 0;
    }
    row_state[0] = T;
    if (RECORD) row_state[planes - 1] = last;
    for (int s = 0; s < SLICES; ++s) {
        Row sums[16], * const kept = row_state + 1 + 16 * s;
#pragma clang loop unroll(full)
        for (int c = 0; c < 16; ++c) sums[c] = kept[c];
        for (int i = 0; i < count; ++i) {
            const float* const x = owners[i] + 16 * s;
            const Row w = weights[i];
#pragma clang loop unroll(full)
            for (int c = 0; c < 16; ++c) sums[c] += w * x[c];
        }
#pragma clang loop unroll(full)
        for (int c = 0; c < 16; ++c) kept[c] = sums[c];
    }
    return bits(T > zero) != 0;
"""
)

# A row of the scratch as pixels of the image.
WRITE = """
    const Row* const row_state = reinterpret_cast<const Row*>(state.data + (slot * 16 + row) * state.shape[2]);
    const Row T = __builtin_elementwise_abs(row_state[0]);
    const int width = features_out.shape[1], channels = features_out.shape[2];
    float* const left = transmittance_out.data + y * width + x0;
    float* const held = alpha_out.data + y * width + x0;
    for (int i = 0; i < inside; ++i) left[i] = T[i], held[i] = 1.0f - T[i];
    for (int s = 0; s < SLICES; ++s) {
        Row square[16];
#pragma clang loop unroll(full)
        for (int i = 0; i < 16; ++i) square[i] = row_state[1 + 16 * s + i];
        transpose(square);
        const int first = 16 * (first_slice + s);
        float* out = features_out.data + (y * width + x0) * channels + first;
        for (int i = 0; i < inside; ++i, out += channels) {
            if (first + 16 <= channels) *reinterpret_cast<Row*>(out) = square[i];
            else for (int c = 0; first + c < channels; ++c) out[c] = square[i][c];
        }
    }
"""


@cache
def feature_walk(slices: int, record: bool) -> wp.Function:
    """Device function that composites 16 `slices` channels of a tile into its scratch.

    Planes of the scratch: transmittance, the channels, with `record` the last contributor.
    """
    last_plane = 1 + PASS * slices
    planes = last_plane + int(record)

    @wp.func_native(snippet(PREFETCH, SLICES=slices))
    def prefetch_features(
        slot: int, count: int, first_slice: int, batch: wp.array2d[Seen], features: wp.array3d[Lanes]
    ): ...

    @wp.func_native(snippet(FORWARD, SLICES=slices, RECORD=record))
    def composite_row(
        slot: int,
        row: int,
        order: int,  # of the batch's first fragment in the tile's list
        first_slice: int,
        batch: wp.array2d[Seen],  # [slots, BATCH]
        reached: wp.array2d[int],  # [slots, 16]
        features: wp.array3d[Lanes],  # [N, S, 1]
        knobs: Knobs,
        state: wp.array3d[Lanes],
    ) -> bool: ...

    @wp.func
    def walk(
        tile: int,
        slot: int,
        offsets: wp.array[int],
        listed: wp.array[int],
        splats: wp.array[Splat],
        features: wp.array3d[Lanes],
        first_slice: int,
        knobs: Knobs,
        width: int,
        height: int,
        state: wp.array3d[Lanes],
        batch: wp.array2d[Seen],
        reached: wp.array2d[int],
    ):
        columns = (width + TILE - 1) / TILE
        x0 = (tile % columns) * TILE
        y0 = (tile / columns) * TILE
        open_rows = open_tile(slot, x0, y0, width, height, planes, last_plane, state)
        first = offsets[tile]
        stop = offsets[tile + 1]
        for start in range(first, stop, BATCH):
            gather_batch(slot, start, stop, x0, y0, listed, splats, knobs, batch, reached)
            prefetch_features(slot, wp.min(stop - start, BATCH), first_slice, batch, features)
            for row in range(TILE):
                if (open_rows >> row) & 1 != 0:  # noqa: SIM102 - Warp evaluates both sides of an `and`
                    if not composite_row(slot, row, start - first, first_slice, batch, reached, features, knobs, state):
                        open_rows = open_rows & ~(1 << row)
            if open_rows == 0:
                break

    return walk


@cache
def feature_writer(slices: int) -> wp.Function:
    """Device function that writes a row of what `feature_walk` left in the scratch."""

    @wp.func_native(snippet(WRITE, SLICES=slices))
    def write_row(
        slot: int,
        row: int,
        y: int,  # of the row in the image
        x0: int,  # its first pixel
        inside: int,  # pixels of the row that lie in the image
        first_slice: int,
        state: wp.array3d[Lanes],
        features_out: wp.array3d[float],  # [H, W, C]
        transmittance_out: wp.array2d[float],  # [H, W]
        alpha_out: wp.array2d[float],  # [H, W]
    ): ...

    return write_row


@cache
def make_composite_features(slices: int, record: bool) -> wp.Kernel:
    """Kernel that composites passes of `16 slices` channels; with `record` also what the backward pass starts from."""
    walk = feature_walk(slices, record)
    write_row = feature_writer(slices)

    @wp.kernel(module="unique", module_options=LANE_OPTIONS, enable_backward=False)
    def composite_features(
        # In:
        base: int,
        slot: int,
        offsets: wp.array[int],  # [tiles + 1]
        listed: wp.array[int],  # [I]
        splats: wp.array[Splat],  # [V]
        features: wp.array3d[Lanes],  # [N, S, 1] channels in slices of 16
        first_slice: int,  # of this pass
        knobs: Knobs,
        width: int,
        height: int,
        state: wp.array3d[Lanes],  # [slots, 16, 1 + 16 slices (+ 1)] scratch
        batch: wp.array2d[Seen],  # [slots, BATCH] scratch
        reached: wp.array2d[int],  # [slots, 16] scratch
        # Out:
        features_out: wp.array3d[float],  # [H, W, C] sum of alpha T x
        transmittance_out: wp.array2d[float],  # [H, W]
        alpha_out: wp.array2d[float],  # [H, W] accumulated opacity, 1 - transmittance
        last_out: wp.array2d[int],  # [H, W] last contributor, counted from its tile's first, -1 = none (record)
    ):
        """Paper eq. 1 for any number of channels."""
        tile = base + wp.tid()
        columns = (width + TILE - 1) / TILE
        x0 = (tile % columns) * TILE
        y0 = (tile / columns) * TILE
        walk(tile, slot, offsets, listed, splats, features, first_slice, knobs, width, height, state, batch, reached)
        inside = wp.min(LANES, width - x0)
        for row in range(wp.min(TILE, height - y0)):
            write_row(slot, row, y0 + row, x0, inside, first_slice, state, features_out, transmittance_out, alpha_out)
        if wp.static(record):
            write_last(slot, x0, y0, width, height, state, wp.static(1 + PASS * slices), last_out)

    return composite_features
