"""The limit of a training step: the whole pipeline by hand in C++ (limit_training.cpp), forward and backward.

The same work as `sg.rasterize`, with colours of degree 3 or with features, and the same results: image,
alpha and the gradients of every parameter. What it leaves out is what the package promises and a limit need not: sums
in an order that no number of threads changes, whitened moments for needles, the split centre for far origins, settings.
"""

from __future__ import annotations

import ctypes
import weakref
from dataclasses import dataclass

import numpy as np
import torch
from limit import library, pointer
from torch import Tensor

from sgwarp.ops.reference import rasterizer as reference
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
COEFFICIENTS = 16
CHANNELS = (16, 64)  # of features
PARAMETERS = ("means", "quats", "scales", "opacities")


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
    arrays = (
        camera.world_to_camera[:3, :3].flatten().tolist(),
        camera.position.tolist(),
        [fx, fy],
        [cx, cy],
        low,
        high,
    )
    parts = (kind(*values) for (_, kind), values in zip(_Camera._fields_, arrays, strict=False))
    return _Camera(*parts, camera.near, camera.far, camera.width, camera.height)


@dataclass(frozen=True, eq=False)
class Gradients:
    """Float32: means [N, 3], quats [N, 4], scales [N, 3], opacities [N], values [N, 16, 3] or [N, channels]."""

    means: np.ndarray
    quats: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    values: np.ndarray


def _aligned(shape: tuple[int, ...]) -> np.ndarray:
    """Float32 zeros at a multiple of 64 bytes."""
    count = int(np.prod(shape))
    memory = np.zeros(count + 16, np.float32)
    start = -memory.ctypes.data // 4 % 16
    return memory[start : start + count].reshape(shape)


class TrainingLimit:
    """One scene in one view. All memory is kept: only the first call pays for it.

    Args:
        gaussians: On the CPU; their coefficients are read unless there are features.
        camera: The view.
        threads: Of OpenMP.
        features: Float32 [N, 16] or [N, 64], composited in place of the colours.

    Attributes:
        image, alpha: Of the last forward pass, float32 [H, W, channels] and [H, W].
        gradients: Of the last backward pass.

    Raises:
        ValueError: Other numbers of coefficients or channels.
    """

    def __init__(self, gaussians: Gaussians, camera: Camera, threads: int = 1, features: Tensor | None = None) -> None:
        n = len(gaussians)
        values = gaussians.sh if features is None else features
        fits = values.shape[1] in CHANNELS if features is not None else values.shape[1] == COEFFICIENTS
        if not fits:
            raise ValueError(f"expected sh [{n}, {COEFFICIENTS}, 3] or {CHANNELS} channels, got {list(values.shape)}")
        self._library = library("limit_training")
        self._library.workspace_new.restype = ctypes.c_void_p
        self._workspace = ctypes.c_void_p(self._library.workspace_new())
        weakref.finalize(self, self._library.workspace_delete, self._workspace)
        self._inputs = [*(getattr(gaussians, name).numpy() for name in PARAMETERS), values.numpy()]
        self._camera, self._threads = _camera(camera), threads
        self._channels = 3 if features is None else values.shape[1]
        self.image, self.alpha = _aligned((*camera.size, self._channels)), _aligned(camera.size)
        self.gradients = Gradients(*(_aligned(array.shape) for array in self._inputs))

    def forward(self) -> int:
        """Render; returns how many splats touch how many tiles."""
        return self._library.forward(
            self._workspace,
            ctypes.byref(self._camera),
            len(self._inputs[0]),
            *(pointer(array, np.float32, array.shape) for array in self._inputs),
            self._channels,
            self._threads,
            pointer(self.image, np.float32, self.image.shape),
            pointer(self.alpha, np.float32, self.alpha.shape),
        )

    def backward(self, v_image: np.ndarray, v_alpha: np.ndarray) -> None:
        """Gradients of the loss with respect to the image, float32 [H, W, channels], and to alpha, [H, W]."""
        self._library.backward(
            self._workspace,
            pointer(v_image, np.float32, self.image.shape),
            pointer(v_alpha, np.float32, self.alpha.shape),
            self._channels,
            *(pointer(array, np.float32, array.shape) for array in vars(self.gradients).values()),
        )

    def seconds(self) -> dict[str, float]:
        """Wall time of each stage of the last passes."""
        times = np.zeros(len(STAGES))
        self._library.stage_seconds(self._workspace, pointer(times, np.float64, times.shape))
        return dict(zip(STAGES, times.tolist(), strict=True))


def self_check(threads: int = 2) -> dict[str, float]:
    """Compare image and gradients with the float64 oracle and autograd, on a small room that fills no number of tiles.

    Pixels near a threshold, where rounding may decide otherwise, are left out of the image's comparison and have no
    weight in the loss.

    Returns:
        Largest absolute difference of image and alpha; largest difference of each gradient over its largest entry.
        Each is the worst over colours and features.

    Raises:
        RuntimeError: One of them is not small.
    """
    from scenes import room, with_harmonics

    gaussians, camera, _ = room(3000, seed=1)
    gaussians = with_harmonics(gaussians)
    camera = camera.resized(101, 150)
    errors: dict[str, float] = {}
    for channels in (3, *CHANNELS):
        for name, error in _differences(gaussians, camera, channels, threads).items():
            errors[name] = max(errors.get(name, 0.0), error)
    if max(errors["image"], errors["alpha"]) > 1e-4 or max(errors.values()) > 1e-3:
        raise RuntimeError(f"limit_training.cpp differs from the oracle: {errors}")
    return errors


def _differences(gaussians: Gaussians, camera: Camera, channels: int, threads: int) -> dict[str, float]:
    generator = torch.Generator().manual_seed(0)
    features = torch.randn(len(gaussians), channels, generator=generator) if channels > 3 else None
    limit = TrainingLimit(gaussians, camera, threads, features)
    limit.forward()
    leaves = {name: getattr(gaussians, name).double().requires_grad_() for name in PARAMETERS}
    leaves["values"] = (gaussians.sh if features is None else features).double().requires_grad_()
    pose, size = camera.world_to_camera, (camera.width, camera.height)
    geometry = [leaves[name] for name in PARAMETERS]
    projection = reference.project(*geometry, pose, camera.K, *size, camera.near, camera.far)
    seen = leaves["values"]
    if features is None:
        seen = reference.spherical_harmonics(leaves["means"], seen, pose)
    raster = reference.composite(projection, seen, *size)
    clear = (raster.margin > 1e-4) & (raster.order_margin > 2e-6)
    v_image, v_alpha = (torch.randn(*camera.size, c, generator=generator) * clear[..., None] for c in (channels, 1))
    torch.autograd.backward([raster.features, raster.alpha], [v_image.double(), v_alpha[..., 0].double()])
    limit.backward(v_image.numpy(), v_alpha[..., 0].numpy())
    mask = clear.numpy()
    errors = {
        "image": float(np.abs(limit.image - raster.features.detach().numpy())[mask].max()),
        "alpha": float(np.abs(limit.alpha - raster.alpha.detach().numpy())[mask].max()),
    }
    for name, leaf in leaves.items():
        assert leaf.grad is not None
        expected = leaf.grad.numpy()
        errors[name] = float(np.abs(getattr(limit.gradients, name) - expected).max() / np.abs(expected).max())
    return errors


if __name__ == "__main__":
    print({name: f"{error:.1e}" for name, error in self_check().items()})
