"""The baseline: the usual CUDA shape of compositing carried over to Warp, one thread per pixel, on one CPU thread."""

import numpy as np
import warp as wp

wp.set_module_options({"enable_backward": False})

ALPHA_MIN = wp.constant(1.0 / 255.0)
ALPHA_MAX = wp.constant(0.999)
TRANSMITTANCE_MIN = wp.constant(1.0e-4)
TILE = wp.constant(16)


@wp.kernel
def composite_pixels(
    # In:
    mean2d: wp.array[wp.vec2],  # [M] projected centres [pixels]
    conic: wp.array[wp.vec3],  # [M] a, b, c [1 / pixels^2]
    opacity: wp.array[float],  # [M]
    color: wp.array[wp.vec3],  # [M]
    offsets: wp.array[int],  # [tiles + 1] first entry of each tile
    ids: wp.array[int],  # [intersections] front to back in each tile
    tiles_across: int,
    # Out:
    rgb_out: wp.array2d[wp.vec3],  # [H, W]
    alpha_out: wp.array2d[float],  # [H, W]
):
    row, column = wp.tid()
    tile = (row // TILE) * tiles_across + column // TILE
    pixel = wp.vec2(float(column) + 0.5, float(row) + 0.5)
    transmittance = wp.float32(1.0)
    total = wp.vec3(0.0, 0.0, 0.0)
    for k in range(offsets[tile], offsets[tile + 1]):
        j = ids[k]
        d = pixel - mean2d[j]
        q = conic[j]
        power = 0.5 * (q[0] * d[0] * d[0] + q[2] * d[1] * d[1]) + q[1] * d[0] * d[1]
        alpha = wp.min(ALPHA_MAX, opacity[j] * wp.exp(-power))
        if alpha < ALPHA_MIN:
            continue
        following = transmittance * (1.0 - alpha)
        if following <= TRANSMITTANCE_MIN:
            break
        total += color[j] * (alpha * transmittance)
        transmittance = following
    rgb_out[row, column] = total
    alpha_out[row, column] = 1.0 - transmittance


def composite(
    mean2d: np.ndarray,
    conic: np.ndarray,
    opacity: np.ndarray,
    color: np.ndarray,
    offsets: np.ndarray,
    ids: np.ndarray,
    width: int,
    height: int,
    out: tuple[np.ndarray, np.ndarray] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Composite colours float32 [M, 3] over black; arguments and results as in limit.composite, always one thread."""
    rgb, alpha = out or (np.empty((height, width, 3), np.float32), np.empty((height, width), np.float32))

    def shared(array: np.ndarray, dtype: type) -> wp.array:
        return wp.array(array, dtype=dtype, device="cpu", copy=False)

    wp.launch(
        composite_pixels,
        dim=(height, width),
        inputs=[
            shared(mean2d, wp.vec2),
            shared(conic, wp.vec3),
            shared(opacity, float),
            shared(color, wp.vec3),
            shared(offsets, int),
            shared(ids, int),
            -(-width // 16),
        ],
        outputs=[shared(rgb, wp.vec3), shared(alpha, float)],
        device="cpu",
    )
    return rgb, alpha
