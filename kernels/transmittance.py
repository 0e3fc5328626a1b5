"""Alpha and transmittance of one Gaussian at one pixel: shared by compositing and lifting, by both schedules."""

import warp as wp

from sgwarp.kernels.projection.forward import Knobs

# One vector register of the lane schedule holds 16 pixels of a row (AVX-512; narrower machines use two or four).
LANES = 16
Lanes = wp.types.vector(length=LANES, dtype=wp.float32)
HALF_ROW = wp.constant(0.5 * float(LANES - 1))
# Lane positions from the middle of the row: none is 0 or 1, so the compiler cannot take products apart lane by lane.
LANE_OFFSETS = wp.constant(Lanes(*[i - 0.5 * (LANES - 1) for i in range(LANES)]))
LaneIds = wp.types.vector(length=LANES, dtype=wp.int32)

# Only for modules behind the non-finite cull: -ffast-math assumes that there is no NaN and no infinity.
LANE_FLAGS = (
    "-march=native -ffast-math -ffp-contract=fast -mprefer-vector-width=512"
    " -mllvm=-inline-threshold=9000 -Wno-nan-infinity-disabled"
)
LANE_OPTIONS = {"enable_backward": False, "fast_math": True, "cpu_compiler_flags": LANE_FLAGS}
BLOCK_OPTIONS = {"enable_backward": False, "fast_math": False}

wp.set_module_options({"enable_backward": False})


@wp.func
def exp2_falling(x: float) -> float:
    """2^x for -16 <= x <= 0, free of branches and library calls so that lanes stay vectors; nonsense below.

    A degree-6 minimax polynomial of 2^t on [-1, 0] with p(0) = 1 (2e-9 relative), squared four times.
    """
    t = x * 0.0625
    p = 1.2747483491e-03 + t * 1.0902324732e-04
    p = 9.5791797294e-03 + t * p
    p = 5.5490757104e-02 + t * p
    p = 2.4022436783e-01 + t * p
    p = 6.9314706433e-01 + t * p
    p = 1.0 + t * p
    p = p * p
    p = p * p
    p = p * p
    return p * p


@wp.func
def alpha_from_level(level: float, knobs: Knobs) -> float:
    """Opacity at a pixel from its log2; zero below alpha_min, which is 2^-16 or more, at most alpha_max."""
    alpha = wp.min(exp2_falling(level), knobs.alpha_max)
    return wp.where(level < knobs.alpha_min_level, 0.0, alpha)


@wp.func
def contribution(alpha: float, T: float, knobs: Knobs) -> float:
    """alpha T, or zero once the pixel is closed (T < 0) or would close with this Gaussian."""
    w = alpha * T
    return wp.where(T - w > knobs.transmittance_min, w, 0.0)


@wp.func
def attenuated(alpha: float, T: float, knobs: Knobs) -> float:
    """Transmittance behind a Gaussian.

    A pixel whose transmittance would fall to the cut-off keeps it with the sign flipped: it is closed, and no later,
    fainter Gaussian can slip in. Its remaining transmittance is |T|.
    """
    next_T = T - alpha * T
    return wp.where(next_T > knobs.transmittance_min, next_T, -wp.abs(T))
