"""What the block schedule shares: writes to shared memory, barriers, and the fast instructions of a GPU.

Warp's own assignment to an element of a shared tile ends in a barrier, so that it may stand in no loop over what one
thread does, nor in a branch. Here a write is a write, and barriers stand where memory changes hands. On the CPU, where
the threads of a block are fibers, the same lines run: `WP_TILE_SYNC` is Warp's own barrier on either device.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

BLOCK = 256  # threads, one per pixel of a tile


@wp.func_native("t.data.ptr[place] = value;")
def put(t: wp.tile[float], place: int, value: float): ...  # by one thread; the others see it after a barrier


@wp.func_native("t.data.ptr[place] = value;")
def put_vector(t: wp.tile[wp.vec4], place: int, value: wp.vec4): ...


@wp.func_native("t.data.ptr[place] = value;")
def put_int(t: wp.tile[int], place: int, value: int): ...


@wp.func_native("t.data.ptr[place] = value;")
def put_double(t: wp.tile[wp.float64], place: int, value: wp.float64): ...


@wp.func_native("WP_TILE_SYNC();")
def barrier(): ...  # all threads of the block come here before any goes on


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __threadfence();
#endif
""")
def fence(): ...  # other blocks see what this thread has written before they see what it writes from now on


@wp.func_native("return *(const volatile float*)(values.data + place);")
def latest(values: wp.array[float], place: int) -> float: ...  # as another block left it, past this one's cache


@wp.func_native("return *(const volatile double*)(values.data + place);")
def latest_double(values: wp.array[wp.float64], place: int) -> wp.float64: ...


@wp.func
def comes_last(arrived: wp.array[int], place: int, blocks: int, t: int, flag: wp.tile[int, 1]) -> bool:
    """Whether this block is the last of `blocks` to come here: it then sees what all of them wrote before.

    The counter is zero before, and again afterwards. What the last block adds up, it adds up in an order of its own, so
    that the sum does not depend on which block that is.
    """
    fence()
    barrier()
    if t == 0:
        before = wp.atomic_add(arrived, place, 1)
        if before == blocks - 1:
            arrived[place] = 0
        put_int(flag, 0, before)
    barrier()
    fence()
    return wp.tile_extract(flag, 0) == blocks - 1


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    float y;
    asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
    return y;
#else
    // The part after the integer goes into a minimax polynomial, the integer into the exponent, as in `native.py`.
    const float whole = __builtin_floorf(x), t = x - whole;
    float p = 1.8775767e-3f * t + 8.9893397e-3f;
    p = p * t + 5.5826318e-2f;
    p = p * t + 2.4015361e-1f;
    p = p * t + 6.9315308e-1f;
    p = p * t + 9.9999994e-1f;
    return __builtin_bit_cast(float, __builtin_bit_cast(int, p) + ((int)whole << 23));
#endif
""")
def power_of_two(x: float) -> float: ...  # 2^x for -100 <= x <= 0, 2.5e-7 relative


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    float y;
    asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
    return y;
#else
    return 1.0f / x;
#endif
""")
def reciprocal(x: float) -> float: ...  # 1 / x within one unit of the last place
