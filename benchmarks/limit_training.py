"""The limit of a training step: the whole pipeline by hand in C++ (limit_training.cpp), forward and backward.

The same work as `rasterize_differentiable` with colours of degree 3, and the same results: image, alpha and the
gradients of every parameter. What it leaves out is what the package promises and a limit need not: sums in an order
that no number of threads changes, whitened moments for needles, the split centre for far origins, settings.
"""

from __future__ import annotations

import ctypes
import weakref
from dataclasses import dataclass, fields

import numpy as np
from limit import library, pointer

from sgwarp.scene import Camera, Gaussians

STAGES = (
    "project",
    "order",
    "shade",
    "bin",
    "composite",
    "composite backward",
    "sums",
    "project backward",
    "shade backward",
)
FORWARD = 5  # of them belong to the forward pass
COEFFICIENTS = 16


class _Camera(ctypes.Structure):
    _fields_ = (
        ("rotation", ctypes.c_float * 9),
        ("center", ctypes.c_float * 3),
        ("focal", ctypes.c_float * 2),
        ("principal", ctypes.c_float * 2),
        ("low", ctypes.c_float * 2),
        ("high", ctypes.c_float * 2),
        ("near", ctypes.c_float),
        ("far", ctypes.c_float),
        ("width", ctypes.c_int32),
        ("height", ctypes.c_int32),
    )


def _camera(camera: Camera) -> _Camera:
    fx, fy, cx, cy = (camera.K[i, j].item() for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    low = [-(cx + 0.15 * camera.width) / fx, -(cy + 0.15 * camera.height) / fy]
    high = [(1.15 * camera.width - cx) / fx, (1.15 * camera.height - cy) / fy]
    arrays = (camera.world_to_camera[:3, :3].flatten().tolist(), camera.position.tolist(), [fx, fy], [cx, cy], low, high)
    parts = (kind(*values) for (_, kind), values in zip(_Camera._fields_, arrays, strict=False))
    return _Camera(*parts, camera.near, camera.far, camera.width, camera.height)


@dataclass(frozen=True, eq=False)
class Gradients:
    """As Gaussians, float32: means [N, 3], quats [N, 4], scales [N, 3], opacities [N], sh [N, 16, 3]."""

    means: np.ndarray
    quats: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    sh: np.ndarray


def _aligned(shape: tuple[int, ...]) -> np.ndarray:
    """Float32 zeros at a multiple of 64 bytes."""
    count = int(np.prod(shape))
    memory = np.zeros(count + 16, np.float32)
    start = -memory.ctypes.data // 4 % 16
    return memory[start : start + count].reshape(shape)


class TrainingLimit:
    """One scene in one view. All memory is kept: only the first call pays for it.

    Args:
        gaussians: On the CPU, with 16 coefficients per colour.
        camera: The view.
        threads: Of OpenMP.

    Attributes:
        rgb, alpha: The image, float32 [H, W, 3] and [H, W], of the last forward pass.
        gradients: Of the last backward pass.
        seconds: Wall time of each stage of the last passes.
        intersections: Of splats and tiles.
    """

    def __init__(self, gaussians: Gaussians, camera: Camera, threads: int = 1) -> None:
        n = len(gaussians)
        if gaussians.sh.shape[1] != COEFFICIENTS:
            raise ValueError(f"sh: expected [{n}, {COEFFICIENTS}, 3], got {list(gaussians.sh.shape)}")
        self._library = library("limit_training")
        self._library.workspace_new.restype = ctypes.c_void_p
        self._workspace = ctypes.c_void_p(self._library.workspace_new())
        weakref.finalize(self, self._library.workspace_delete, self._workspace)
        self._inputs = [getattr(gaussians, field.name).numpy() for field in fields(Gradients)]
        self._camera, self._threads = _camera(camera), threads
        self.rgb, self.alpha = _aligned((*camera.size, 3)), _aligned(camera.size)
        self.gradients = Gradients(*(_aligned(array.shape) for array in self._inputs))
        self.seconds = np.zeros(len(STAGES))
        self.intersections = 0

    def forward(self) -> None:
        f = np.float32
        self.intersections = self._library.forward(
            self._workspace,
            ctypes.byref(self._camera),
            len(self._inputs[0]),
            *(pointer(array, f, array.shape) for array in self._inputs),
            self._threads,
            pointer(self.rgb, f, self.rgb.shape),
            pointer(self.alpha, f, self.alpha.shape),
            pointer(self.seconds, np.float64, (len(STAGES),)),
        )

    def backward(self, v_rgb: np.ndarray, v_alpha: np.ndarray) -> None:
        """Gradients of the loss with respect to the image, float32 [H, W, 3], and to alpha, [H, W]."""
        f = np.float32
        outputs = (getattr(self.gradients, field.name) for field in fields(Gradients))
        self._library.backward(
            self._workspace,
            pointer(v_rgb, f, self.rgb.shape),
            pointer(v_alpha, f, self.alpha.shape),
            *(pointer(array, f, array.shape) for array in outputs),
            pointer(self.seconds[FORWARD:], np.float64, (len(STAGES) - FORWARD,)),
        )


def self_check(threads: int = 2) -> dict[str, float]:
    """Compare image and gradients with the float64 oracle and autograd, on a small room that fills no number of tiles.

    Pixels near a threshold, where rounding may decide otherwise, are left out of the image's comparison and have no
    weight in the loss.

    Returns:
        Largest absolute difference of image and alpha; largest difference of each gradient over its largest entry.

    Raises:
        RuntimeError: One of them is not small.
    """
    import torch
    from scenes import room, with_harmonics

    from sgwarp.ops import reference

    gaussians, camera, _ = room(3000, seed=1)
    gaussians = with_harmonics(gaussians)
    camera = camera.resized(101, 150)
    limit = TrainingLimit(gaussians, camera, threads)
    limit.forward()
    leaves = {field.name: getattr(gaussians, field.name).double().requires_grad_() for field in fields(Gradients)}
    pose, size = camera.world_to_camera, (camera.width, camera.height)
    geometry = [leaves[name] for name in ("means", "quats", "scales", "opacities")]
    projection = reference.project(*geometry, pose, camera.K, *size, camera.near, camera.far)
    colors = reference.spherical_harmonics(leaves["means"], leaves["sh"], pose)
    raster = reference.composite(projection, colors, *size)
    clear = (raster.margin > 1e-4) & (raster.order_margin > 2e-6)
    generator = torch.Generator().manual_seed(0)
    v_rgb, v_alpha = (torch.randn(*camera.size, c, generator=generator) * clear[..., None] for c in (3, 1))
    (raster.features * v_rgb).sum().add((raster.alpha * v_alpha[..., 0]).sum()).backward()
    limit.backward(v_rgb.numpy(), v_alpha[..., 0].numpy())
    mask = clear.numpy()
    errors = {
        "image": float(np.abs(limit.rgb - raster.features.detach().numpy())[mask].max()),
        "alpha": float(np.abs(limit.alpha - raster.alpha.detach().numpy())[mask].max()),
    }
    for name, leaf in leaves.items():
        assert leaf.grad is not None
        expected = leaf.grad.numpy()
        errors[name] = float(np.abs(getattr(limit.gradients, name) - expected).max() / np.abs(expected).max())
    if max(errors["image"], errors["alpha"]) > 1e-4 or max(errors.values()) > 1e-3:
        raise RuntimeError(f"limit_training.cpp differs from the oracle: {errors}")
    return errors


if __name__ == "__main__":
    print({name: f"{error:.1e}" for name, error in self_check().items()})
