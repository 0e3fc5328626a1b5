"""Shared C++ of the innermost loops of the lane schedule, in the compiler's vector types.

Warp builds these snippets into its CPU kernels as they stand. Written in Warp, what a loop carries from one step to the
next would go through memory; here it stays in registers. Where AVX-512 has an instruction for a step it is used, and
the tests hold both ways to the same oracle.
"""

from functools import cache

import warp as wp

from sgwarp.kernels.gaussian import LEVEL_SLACK, Splat
from sgwarp.kernels.transmittance import Lanes

BATCH = wp.constant(32)  # fragments of a tile that the lanes walk row by row


@wp.struct
class Seen:
    """A splat as a tile sees it: at row r and column i, alpha = 2^(top[r] - u^2) with u = middle[r] + a (i - 7.5)."""

    middle: Lanes  # by row
    top: Lanes
    splat: Splat


# Aligned like a float: views of a caller's tensors start anywhere.
HELPERS = """
    typedef float Row __attribute__((ext_vector_type(16), aligned(4)));
    typedef int Ints __attribute__((ext_vector_type(16), aligned(4)));
    const Row offsets = {-7.5f, -6.5f, -5.5f, -4.5f, -3.5f, -2.5f, -1.5f, -0.5f,
                         0.5f, 1.5f, 2.5f, 3.5f, 4.5f, 5.5f, 6.5f, 7.5f};
    const Row zero = 0.0f, one = 1.0f;
    // One bit per lane in which a comparison holds.
    const auto bits = [](Ints holds) -> unsigned {
        using Bits = bool __attribute__((ext_vector_type(16)));
        return __builtin_bit_cast(unsigned short, __builtin_convertvector(holds, Bits));
    };
    const auto sum = [](Row x) -> float {
        const auto eight = x.lo + x.hi;
        const auto four = eight.lo + eight.hi;
        const auto two = four.lo + four.hi;
        return two.x + two.y;
    };
    // 2^x for -100 <= x <= 0, 2e-7 relative, anything below: the part after the integer goes into a minimax polynomial,
    // the integer into the exponent.
    const auto exp2 = [&](Row x) -> Row {
#if defined(__AVX512DQ__) && !defined(SGWARP_PORTABLE)
        const Row t = __builtin_ia32_reduceps512_mask(x, 1, zero, -1, 4);  // x - floor(x)
#else
        const Row whole = __builtin_elementwise_floor(x), t = x - whole;
#endif
        Row p = 1.8775767e-3f * t + 8.9893397e-3f;
        p = p * t + 5.5826318e-2f;
        p = p * t + 2.4015361e-1f;
        p = p * t + 6.9315308e-1f;
        p = p * t + 9.9999994e-1f;
#if defined(__AVX512DQ__) && !defined(SGWARP_PORTABLE)
        return __builtin_ia32_scalefps512_mask(p, x, zero, -1, 4);
#else
        return reinterpret_cast<Row>(reinterpret_cast<Ints>(p) + (__builtin_convertvector(whole, Ints) << 23));
#endif
    };
    // 1 / x to 2e-7 relative, x neither tiny nor huge.
    const auto reciprocal = [&](Row x) -> Row {
#if defined(__AVX512F__) && !defined(SGWARP_PORTABLE)
        const Row guess = __builtin_ia32_rcp14ps512_mask(x, zero, -1);
        return guess * (2.0f - x * guess);
#else
        return one / x;
#endif
    };
    // Rows and columns of 16 x 16 values change places: squares of 8, 4, 2 and 1 across the diagonal.
#define EXCHANGE(step, low, high)                                    \\
    _Pragma("clang loop unroll(full)")                               \\
    for (int i = 0; i < 16; ++i)                                     \\
        if (!(i & step)) {                                           \\
            const Row a = square[i], b = square[i + step];           \\
            square[i] = __builtin_shufflevector(a, b, low);          \\
            square[i + step] = __builtin_shufflevector(a, b, high);  \\
        }
#define LOW_8 0, 1, 2, 3, 4, 5, 6, 7, 16, 17, 18, 19, 20, 21, 22, 23
#define HIGH_8 8, 9, 10, 11, 12, 13, 14, 15, 24, 25, 26, 27, 28, 29, 30, 31
#define LOW_4 0, 1, 2, 3, 16, 17, 18, 19, 8, 9, 10, 11, 24, 25, 26, 27
#define HIGH_4 4, 5, 6, 7, 20, 21, 22, 23, 12, 13, 14, 15, 28, 29, 30, 31
#define LOW_2 0, 1, 16, 17, 4, 5, 20, 21, 8, 9, 24, 25, 12, 13, 28, 29
#define HIGH_2 2, 3, 18, 19, 6, 7, 22, 23, 10, 11, 26, 27, 14, 15, 30, 31
#define LOW_1 0, 16, 2, 18, 4, 20, 6, 22, 8, 24, 10, 26, 12, 28, 14, 30
#define HIGH_1 1, 17, 3, 19, 5, 21, 7, 23, 9, 25, 11, 27, 13, 29, 15, 31
    const auto transpose = [](Row (&square)[16]) {
        EXCHANGE(8, LOW_8, HIGH_8)
        EXCHANGE(4, LOW_4, HIGH_4)
        EXCHANGE(2, LOW_2, HIGH_2)
        EXCHANGE(1, LOW_1, HIGH_1)
    };
    // A splat as the tile at (x0, y0) sees it; returns a bit for each row in which some pixel may pass alpha_min.
    const auto see = [&](const auto& s, int x0, int y0, const auto& knobs, Row& middle, Row& top) -> unsigned {
        const float left = x0, above = y0;
        const float x = s.mean[0] - left - 0.5f, y = s.mean[1] - above - 0.5f;
        const Row dy = offsets + (7.5f - y), v = s.c * dy;
        middle = s.b * dy + s.a * (7.5f - x);
        top = s.level - v * v;
        const Row nearest = __builtin_elementwise_max(__builtin_elementwise_abs(middle) - 7.5f * s.a, zero);
        return bits(nearest * nearest <= top - (knobs.alpha_min_level - LEVEL_SLACK));
    };
    // Opacity at 16 pixels.
    const auto opacity = [&](Row u, float top, const auto& knobs) -> Row {
        const Row level = top - u * u;
        return level < knobs.alpha_min_level ? zero : __builtin_elementwise_min(exp2(level), one * knobs.alpha_max);
    };
    // alpha T, zero where a pixel is closed (T < 0) or would close, as in `transmittance.py`; T becomes what is left.
    const auto take = [&](Row alpha, const auto& knobs, Row& T) -> Row {
        const Row weight = alpha * T, behind = T - weight;
        const Row w = behind > knobs.transmittance_min ? weight : zero;
        T = behind > knobs.transmittance_min ? behind : -__builtin_elementwise_abs(T);
        return w;
    };
    // The same for a splat that was seen before.
    const auto take_seen = [&](const auto& seen, int row, const auto& knobs, Row& T) -> Row {
        const float middle = reinterpret_cast<const float*>(&seen.middle)[row];
        const float top = reinterpret_cast<const float*>(&seen.top)[row];
        return take(opacity(offsets * seen.splat.a + middle, top, knobs), knobs, T);
    };
"""


def _shuffled(vectors: list[str], lanes: list[tuple[int, int]]) -> str:
    """C++ that picks lane i of the result from (vector, lane) number i, one shuffle of two vectors after the other."""
    result = vectors[0]
    for step in range(1, len(vectors)):
        kept = [lane if step == 1 else i for i, (_, lane) in enumerate(lanes)]
        taken = [16 + lane if vector == step else kept[i] for i, (vector, lane) in enumerate(lanes)]
        result = f"__builtin_shufflevector({result}, {vectors[step]}, {', '.join(map(str, taken))})"
    return result


def columns(*widths: int) -> str:
    """C++ between 16 consecutive structures of some floats each and vectors of one float of all of them.

    Defines `split_W(from, to)`, which reads 16 W floats and writes W vectors, and `join_W(from, to)`, the way back.
    """
    code = ""
    for width in widths:
        memory, vectors = ([f"{name}{k}" for k in range(width)] for name in "mv")
        split = [_shuffled(memory, [divmod(width * i + k, 16) for i in range(16)]) for k in range(width)]
        join = [_shuffled(vectors, [divmod(16 * k + i, width)[::-1] for i in range(16)]) for k in range(width)]
        for name, given, made, source, target in (
            ("split", memory, split, "const float* from, Row* to", "to[{}]"),
            ("join", vectors, join, "const Row* from, float* to", "reinterpret_cast<Row*>(to)[{}]"),
        ):
            read = "reinterpret_cast<const Row*>(from)[{}]" if name == "split" else "from[{}]"
            code += f"    const auto {name}_{width} = []({source}) {{\n"
            code += "".join(f"        const Row {x} = {read.format(k)};\n" for k, x in enumerate(given))
            code += "".join(f"        {target.format(k)} = {x};\n" for k, x in enumerate(made))
            code += "    };\n"
    return code


def by_groups(*bodies: str, count: str) -> str:
    """C++ that runs a body for each `group` of 16 elements that a kernel thread, `block`, takes; then the next body.

    Warp copies the arguments of a kernel for each of its threads, and what is copied has to arrive in memory first.

    Args:
        bodies: They take 16 of the elements, or what there is, from 16 `group` on.
        count: How many elements there are.
    """
    code = ""
    for k, body in enumerate(bodies):
        code += f"    const auto run_{k} = [&](int group) {{\n{body}    }};\n"
        code += f"    for (int group = GROUPS * block; group < GROUPS * (block + 1) && 16 * group < {count}; ++group)\n"
        code += f"        run_{k}(group);\n"
    return code


GROUP = 64  # Gaussians of a kernel thread, 16 at a time


def snippet(body: str, **constants: bool | int | float) -> str:
    """The C++ of a loop. Its options come first as `constexpr`; what they switch off the compiler removes."""
    shared = {"LEVEL_SLACK": float(LEVEL_SLACK), "BATCH": int(BATCH), "GROUPS": GROUP // 16}
    return "".join(_declaration(name, value) for name, value in {**shared, **constants}.items()) + HELPERS + body


def _declaration(name: str, value: bool | int | float) -> str:
    kind, text = ("bool", str(int(value))) if isinstance(value, bool) else (type(value).__name__, repr(value))
    return f"    [[maybe_unused]] constexpr {kind} {name} = {text}{'f' if kind == 'float' else ''};\n"


@cache
def power_and_reciprocal(portable: bool) -> wp.Function:
    """Device function that writes 2^x and 1 / x, with what the machine has or as any machine can (for the tests)."""
    switch = "#define SGWARP_PORTABLE" if portable else "#undef SGWARP_PORTABLE"
    store = """
    reinterpret_cast<Row*>(powers.data)[i] = exp2(reinterpret_cast<const Row*>(x.data)[i]);
    reinterpret_cast<Row*>(reciprocals.data)[i] = reciprocal(reinterpret_cast<const Row*>(x.data)[i]);
    """

    @wp.func_native(f"\n{switch}\n{snippet(store)}\n#undef SGWARP_PORTABLE\n")
    def evaluate(i: int, x: wp.array[Lanes], powers: wp.array[Lanes], reciprocals: wp.array[Lanes]): ...

    return evaluate
