"""Exact nearest neighbours of points sorted along a space-filling curve, by boxes within boxes."""

import warp as wp

from sgwarp.kernels.gaussian import EXACT_OPTIONS

wp.set_module_options(EXACT_OPTIONS)

FAN = wp.constant(16)  # points in a box, boxes in a large box


@wp.func
def with_candidate(best: wp.vec3, d: float) -> wp.vec3:
    """The three smallest of four squared distances, in increasing order."""
    a = wp.min(best[0], d)
    b = wp.min(best[1], wp.max(best[0], d))
    c = wp.min(best[2], wp.max(best[1], d))
    return wp.vec3(a, b, c)


@wp.func
def distance_to_box(p: wp.vec3, low: wp.vec3, high: wp.vec3) -> float:
    """Squared distance from a point to a box, zero inside."""
    return wp.length_sq(wp.max(wp.max(low - p, p - high), wp.vec3(0.0, 0.0, 0.0)))


@wp.kernel
def nearest_three(
    # In:
    base: int,  # first point of this launch
    points: wp.array[wp.vec3],  # [N] sorted, finite
    low: wp.array[wp.vec3],  # [ceil(N / FAN)] corners of the boxes of FAN points
    high: wp.array[wp.vec3],
    large_low: wp.array[wp.vec3],  # [ceil(N / FAN^2)] corners of the boxes of FAN boxes
    large_high: wp.array[wp.vec3],
    largest_low: wp.array[wp.vec3],  # [ceil(N / FAN^3)]
    largest_high: wp.array[wp.vec3],
    # Out:
    distances_out: wp.array[wp.vec3],  # [N] squared distances to the three nearest others
):
    """Own box first, which bounds the search; then every box nearer than the third best so far."""
    i = base + wp.tid()
    p = points[i]
    n = points.shape[0]
    best = wp.vec3(wp.inf, wp.inf, wp.inf)
    own = i / FAN
    for j in range(own * FAN, wp.min((own + 1) * FAN, n)):
        if j != i:
            best = with_candidate(best, wp.length_sq(points[j] - p))
    for t in range(largest_low.shape[0]):
        if distance_to_box(p, largest_low[t], largest_high[t]) < best[2]:
            for s in range(t * FAN, wp.min((t + 1) * FAN, large_low.shape[0])):
                if distance_to_box(p, large_low[s], large_high[s]) < best[2]:
                    for b in range(s * FAN, wp.min((s + 1) * FAN, low.shape[0])):
                        if b != own and distance_to_box(p, low[b], high[b]) < best[2]:
                            for j in range(b * FAN, wp.min((b + 1) * FAN, n)):
                                best = with_candidate(best, wp.length_sq(points[j] - p))
    distances_out[i] = best
