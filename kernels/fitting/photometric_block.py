"""Structural similarity of two images and its gradient, block schedule (CUDA): 256 threads own 16 x 16 pixels.

The mathematics is that of `photometric_lanes.py`. An image [H, W, 3] is a matrix of H rows of 3 W floats, so a tile has
16 rows of 48. A block stages its tile and what the window reaches beyond it, 26 x 78 floats, in shared memory, averages
along rows into shared memory, and then along columns. Neighbouring threads read and write neighbouring floats.

The value of the loss stays on the device: every block writes its sums, and the first block of the second kernel adds
them up in double precision, in a fixed order.
"""

import warp as wp

from sgwarp.kernels.blocks import BLOCK, barrier, put
from sgwarp.kernels.fitting.photometric_lanes import ADJOINTS, C1, C2, CHANNELS, MOMENTS, RADIUS, WINDOW
from sgwarp.kernels.transmittance import BLOCK_OPTIONS

wp.set_module_options(BLOCK_OPTIONS)

SIDE = 16  # of a tile [pixels]
ROW = SIDE * CHANNELS  # floats of a tile's row
FLOATS = SIDE * ROW  # of a tile
MARGIN = RADIUS * CHANNELS  # floats that the window reaches to the side
STAGED_ROWS = SIDE + 2 * RADIUS
STAGED_ROW = ROW + 2 * MARGIN
STAGED = STAGED_ROWS * STAGED_ROW
AVERAGED = STAGED_ROWS * ROW  # floats that are averaged along their row
Sums = wp.types.vector(length=2, dtype=wp.float32)


@wp.func
def window_mean(values: wp.tile[float], start: int, step: int) -> float:
    """Weighted mean of the values under the window; the light ends come first, pair by pair, to round less."""
    total = float(0.0)
    for tap in range(RADIUS):
        total += WINDOW[tap] * (
            wp.tile_extract(values, start + step * tap) + wp.tile_extract(values, start + step * (2 * RADIUS - tap))
        )
    return total + WINDOW[RADIUS] * wp.tile_extract(values, start + step * RADIUS)


@wp.func
def stage(image: wp.array2d[float], y0: int, x0: int, t: int, staged: wp.tile[float, STAGED]):
    """Copy a tile and what surrounds it to shared memory, zero beyond the image."""
    for place in range(t, STAGED, BLOCK):
        row = y0 - RADIUS + place / STAGED_ROW
        column = x0 - MARGIN + place % STAGED_ROW
        value = float(0.0)
        if row >= 0 and row < image.shape[0] and column >= 0 and column < image.shape[1]:
            value = image[row, column]
        put(staged, place, value)


@wp.kernel
def compare_tiles(
    # In:
    first: wp.array2d[float],  # [H, 3 W] image x
    second: wp.array2d[float],  # [H, 3 W] image y
    tile_columns: int,
    # Out:
    planes_out: wp.array3d[float],  # [3, H, 3 W] derivatives of the similarity by the means of x, x^2, x y
    sums_out: wp.array[Sums],  # [tiles] of |x - y| and of the similarity
):
    """Structural similarity at each float, and what it changes by with the means of the window there."""
    tile, t = wp.tid()
    y0 = (tile / tile_columns) * SIDE
    x0 = (tile % tile_columns) * ROW
    xs = wp.tile_empty(shape=(STAGED,), dtype=float, storage="shared")
    ys = wp.tile_empty(shape=(STAGED,), dtype=float, storage="shared")
    stage(first, y0, x0, t, xs)
    stage(second, y0, x0, t, ys)
    barrier()
    averages = wp.tile_empty(shape=(wp.static(MOMENTS * AVERAGED),), dtype=float, storage="shared")
    for place in range(t, AVERAGED, BLOCK):
        start = (place / ROW) * STAGED_ROW + place % ROW
        x = wp.tile_extract(xs, start + MARGIN)
        y = wp.tile_extract(ys, start + MARGIN)
        xx_mean = float(0.0)
        yy_mean = float(0.0)
        xy_mean = float(0.0)
        for tap in range(RADIUS):
            x_left = wp.tile_extract(xs, start + CHANNELS * tap)
            y_left = wp.tile_extract(ys, start + CHANNELS * tap)
            x_right = wp.tile_extract(xs, start + CHANNELS * (2 * RADIUS - tap))
            y_right = wp.tile_extract(ys, start + CHANNELS * (2 * RADIUS - tap))
            xx_mean += WINDOW[tap] * (x_left * x_left + x_right * x_right)
            yy_mean += WINDOW[tap] * (y_left * y_left + y_right * y_right)
            xy_mean += WINDOW[tap] * (x_left * y_left + x_right * y_right)
        put(averages, place, window_mean(xs, start, CHANNELS))
        put(averages, place + AVERAGED, window_mean(ys, start, CHANNELS))
        put(averages, place + 2 * AVERAGED, xx_mean + WINDOW[RADIUS] * (x * x))
        put(averages, place + 3 * AVERAGED, yy_mean + WINDOW[RADIUS] * (y * y))
        put(averages, place + 4 * AVERAGED, xy_mean + WINDOW[RADIUS] * (x * y))
    barrier()
    difference = float(0.0)
    similarity = float(0.0)
    for place in range(t, FLOATS, BLOCK):
        row = y0 + place / ROW
        column = x0 + place % ROW
        if row < first.shape[0] and column < first.shape[1]:
            x = window_mean(averages, place, ROW)
            y = window_mean(averages, place + AVERAGED, ROW)
            xx = window_mean(averages, place + 2 * AVERAGED, ROW)
            yy = window_mean(averages, place + 3 * AVERAGED, ROW)
            xy = window_mean(averages, place + 4 * AVERAGED, ROW)
            mean = 2.0 * x * y + C1
            spread = 2.0 * (xy - x * y) + C2
            inv_means = 1.0 / (x * x + y * y + C1)
            inv_spreads = 1.0 / (xx - x * x + yy - y * y + C2)
            inverse = inv_means * inv_spreads
            similar = mean * spread * inverse
            similarity += similar
            planes_out[0, row, column] = 2.0 * (y * (spread - mean) * inverse + x * similar * (inv_spreads - inv_means))
            planes_out[1, row, column] = -similar * inv_spreads
            planes_out[2, row, column] = 2.0 * mean * inverse
            center = (place / ROW + RADIUS) * STAGED_ROW + place % ROW + MARGIN
            difference += wp.abs(wp.tile_extract(xs, center) - wp.tile_extract(ys, center))
    total = wp.tile_sum(wp.tile(Sums(difference, similarity), preserve_type=True))
    if t == 0:
        sums_out[tile] = total[0]


@wp.kernel
def gather_tiles(
    # In:
    planes: wp.array3d[float],  # [3, H, 3 W] derivatives, as `compare_tiles` wrote them
    first: wp.array2d[float],  # [H, 3 W] image x
    second: wp.array2d[float],  # [H, 3 W] image y
    sums: wp.array[Sums],  # [tiles] of |x - y| and of the similarity
    tile_columns: int,
    share: float,  # of the similarity in the loss
    # Out:
    gradient_out: wp.array2d[float],  # [H, 3 W] of the loss by x
    loss_out: wp.array[float],  # [1]
):
    """Gradient of both losses by x: the sign of the difference, and the chain through x, x^2 and x y; and the loss."""
    tile, t = wp.tid()
    y0 = (tile / tile_columns) * SIDE
    x0 = (tile % tile_columns) * ROW
    count = float(first.shape[0]) * float(first.shape[1])
    if tile == 0:
        part = wp.float64(0.0)
        for i in range(t, sums.shape[0], BLOCK):
            part += wp.float64(1.0 - share) * wp.float64(sums[i][0]) - wp.float64(share) * wp.float64(sums[i][1])
        loss = wp.tile_sum(wp.tile(part))
        if t == 0:
            loss_out[0] = float(loss[0] / wp.float64(count) + wp.float64(share))
    staged = wp.tile_empty(shape=(STAGED,), dtype=float, storage="shared")
    averages = wp.tile_empty(shape=(wp.static(ADJOINTS * AVERAGED),), dtype=float, storage="shared")
    for plane in range(ADJOINTS):
        stage(planes[plane], y0, x0, t, staged)
        barrier()
        for place in range(t, AVERAGED, BLOCK):
            start = (place / ROW) * STAGED_ROW + place % ROW
            put(averages, place + plane * AVERAGED, window_mean(staged, start, CHANNELS))
        barrier()  # `staged` is read by now, `averages` written
    for place in range(t, FLOATS, BLOCK):
        row = y0 + place / ROW
        column = x0 + place % ROW
        if row < first.shape[0] and column < first.shape[1]:
            by_x = window_mean(averages, place, ROW)
            by_xx = window_mean(averages, place + AVERAGED, ROW)
            by_xy = window_mean(averages, place + 2 * AVERAGED, ROW)
            x = first[row, column]
            y = second[row, column]
            chain = by_x + 2.0 * x * by_xx + y * by_xy
            sign = wp.where(x > y, 1.0, 0.0) - wp.where(x < y, 1.0, 0.0)
            gradient_out[row, column] = ((1.0 - share) * sign - share * chain) / count
