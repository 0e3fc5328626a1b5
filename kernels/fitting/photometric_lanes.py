"""Structural similarity of two images and its gradient: separable Gaussian windows over lanes of interleaved channels.

An image [H, W, 3] is a matrix of H rows of 3 W floats. Sixteen neighbouring floats are one vector, so the vertical pass
reads whole vectors, and the horizontal pass vectors that start 3 floats apart: `planes` and `shifted` are the same
memory, the second one with a vector at every float. Rows begin and end with MARGIN vectors of zeros, what lies beyond
the image is zero.
"""

import math

import warp as wp

from sgwarp.kernels.transmittance import LANE_OPTIONS, LANES, Lanes

# Unrolled, sums over the window stay in registers.
wp.set_module_options({**LANE_OPTIONS, "max_unroll": 16})

RADIUS = 5  # of the window [pixels]
DEVIATION = 1.5  # of its Gaussian [pixels]
CHANNELS = 3
MARGIN = 1  # vectors; RADIUS * CHANNELS floats fit
MOMENTS = 5  # means of x, y, x^2, y^2, x y
ADJOINTS = 3  # derivatives by the means of x, x^2, x y
TAPS = wp.constant(2 * RADIUS + 1)
REACH = wp.constant(RADIUS)
FLOATS = wp.constant(LANES)
STEP = wp.constant(CHANNELS)

_bell = [math.exp(-0.5 * (k - RADIUS) ** 2 / DEVIATION**2) for k in range(2 * RADIUS + 1)]
Window = wp.types.vector(length=2 * RADIUS + 1, dtype=wp.float32)
WINDOW = wp.constant(Window(*[value / sum(_bell) for value in _bell]))
C1 = wp.constant(0.01**2)  # of images in [0, 1]
C2 = wp.constant(0.03**2)


@wp.func
def weight_in(row: int, tap: int, rows: int) -> float:
    """Weight of a row of the window, zero beyond the image; without a branch, so that sums stay in registers."""
    return wp.where(row >= 0 and row < rows, WINDOW[tap], 0.0)


@wp.kernel
def average_down(
    # In:
    base: int,  # first vector of this launch, row by row
    first: wp.array2d[Lanes],  # [H, columns] image x, zero beyond its width
    second: wp.array2d[Lanes],  # [H, columns] image y
    # Out:
    planes_out: wp.array3d[Lanes],  # [5, H, columns + 2 MARGIN] windows of x, y, x^2, y^2, x y along columns
):
    """The vertical half of the window."""
    i = base + wp.tid()
    column = i % first.shape[1]
    row = i / first.shape[1]
    x_mean = Lanes()
    y_mean = Lanes()
    xx_mean = Lanes()
    yy_mean = Lanes()
    xy_mean = Lanes()
    for k in range(TAPS):
        r = row + k - REACH
        weight = weight_in(r, k, first.shape[0])
        r = wp.clamp(r, 0, first.shape[0] - 1)
        x = first[r, column]
        y = second[r, column]
        wx = weight * x
        wy = weight * y
        x_mean += wx
        y_mean += wy
        xx_mean += wp.cw_mul(wx, x)
        yy_mean += wp.cw_mul(wy, y)
        xy_mean += wp.cw_mul(wx, y)
    planes_out[0, row, column + 1] = x_mean
    planes_out[1, row, column + 1] = y_mean
    planes_out[2, row, column + 1] = xx_mean
    planes_out[3, row, column + 1] = yy_mean
    planes_out[4, row, column + 1] = xy_mean


@wp.func
def average_across(shifted: wp.array3d[Lanes], plane: int, row: int, start: int) -> Lanes:
    """The horizontal half of the window, for the vector that begins at float `start` of the row."""
    total = Lanes()
    for k in range(TAPS):
        total += WINDOW[k] * shifted[plane, row, start + STEP * (k - REACH)]
    return total


@wp.kernel
def compare_windows(
    # In:
    base: int,  # first row of this launch
    shifted: wp.array3d[Lanes],  # [5, H, floats] what `average_down` wrote, a vector at every float
    floats: int,  # of a row of the image, 3 W
    # Out:
    planes_out: wp.array3d[Lanes],  # [3, H, columns + 2 MARGIN] derivatives of the similarity by means of x, x^2, x y
    similarity_out: wp.array[float],  # [H] sum over each row
):
    """Structural similarity at each float, and what it changes by with the means of the window there."""
    row = base + wp.tid()
    columns = planes_out.shape[2] - 2
    total = Lanes()
    for column in range(columns):
        start = (column + 1) * FLOATS
        x = average_across(shifted, 0, row, start)
        y = average_across(shifted, 1, row, start)
        xx = average_across(shifted, 2, row, start)
        yy = average_across(shifted, 3, row, start)
        xy = average_across(shifted, 4, row, start)
        by_x = Lanes()
        by_xx = Lanes()
        by_xy = Lanes()
        for j in range(FLOATS):
            mean = 2.0 * x[j] * y[j] + C1
            spread = 2.0 * (xy[j] - x[j] * y[j]) + C2
            means = 1.0 / (x[j] * x[j] + y[j] * y[j] + C1)
            spreads = 1.0 / (xx[j] - x[j] * x[j] + yy[j] - y[j] * y[j] + C2)
            inside = wp.where(column * FLOATS + j < floats, means * spreads, 0.0)
            similar = mean * spread * inside
            total[j] = total[j] + similar
            by_x[j] = 2.0 * (y[j] * (spread - mean) * inside + x[j] * similar * (spreads - means))
            by_xx[j] = -similar * spreads
            by_xy[j] = 2.0 * mean * inside
        planes_out[0, row, column + 1] = by_x
        planes_out[1, row, column + 1] = by_xx
        planes_out[2, row, column + 1] = by_xy
    similarity = float(0.0)
    for j in range(FLOATS):
        similarity += total[j]
    similarity_out[row] = similarity


@wp.kernel
def average_adjoints_down(
    # In:
    base: int,  # first vector of this launch, row by row
    planes: wp.array3d[Lanes],  # [3, H, columns + 2 MARGIN] derivatives
    # Out:
    planes_out: wp.array3d[Lanes],  # [3, H, columns + 2 MARGIN] windows of them along columns
):
    """The vertical half of the window once more: it is symmetric, so it is its own adjoint."""
    i = base + wp.tid()
    columns = planes.shape[2] - 2
    column = i % columns + 1
    row = i / columns
    a = Lanes()
    b = Lanes()
    c = Lanes()
    for k in range(TAPS):
        r = row + k - REACH
        weight = weight_in(r, k, planes.shape[1])
        r = wp.clamp(r, 0, planes.shape[1] - 1)
        a += weight * planes[0, r, column]
        b += weight * planes[1, r, column]
        c += weight * planes[2, r, column]
    planes_out[0, row, column] = a
    planes_out[1, row, column] = b
    planes_out[2, row, column] = c


@wp.kernel
def gather_gradient(
    # In:
    base: int,  # first row of this launch
    shifted: wp.array3d[Lanes],  # [3, H, floats] what `average_adjoints_down` wrote, a vector at every float
    first: wp.array2d[Lanes],  # [H, columns] image x
    second: wp.array2d[Lanes],  # [H, columns] image y
    floats: int,  # of a row of the image, 3 W
    by_difference: float,  # weight of the sign of x - y
    by_similarity: float,  # weight of the derivative of the similarity
    # Out:
    gradient_out: wp.array2d[float],  # [H, 3 W]
    difference_out: wp.array[float],  # [H] sum of |x - y| over each row
):
    """Gradient of both losses by x: the sign of the difference, and the chain through x, x^2 and x y."""
    row = base + wp.tid()
    difference = Lanes()
    for column in range(first.shape[1]):
        start = (column + 1) * FLOATS
        x = first[row, column]
        y = second[row, column]
        chain = average_across(shifted, 0, row, start)
        chain += 2.0 * wp.cw_mul(x, average_across(shifted, 1, row, start))
        chain += wp.cw_mul(y, average_across(shifted, 2, row, start))
        for j in range(FLOATS):
            d = x[j] - y[j]
            difference[j] = difference[j] + wp.abs(d)
            chain[j] = by_similarity * chain[j] + by_difference * (
                wp.where(d > 0.0, 1.0, 0.0) - wp.where(d < 0.0, 1.0, 0.0)
            )
        for j in range(wp.min(FLOATS, floats - column * FLOATS)):
            gradient_out[row, column * FLOATS + j] = chain[j]
    total = float(0.0)
    for j in range(FLOATS):
        total += difference[j]
    difference_out[row] = total
