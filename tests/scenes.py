"""Small named scenes that every renderer here is held to: SCENES[name]() -> (Gaussians, Camera).

Deterministic, 1 to 500 Gaussians, images small enough for the float64 oracle. Between them they hold SH degrees 0 to 3.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from sgwarp.scene import Camera, Gaussians


def look_at(position: Tensor, target: Tensor) -> Tensor:
    """World-to-camera matrix, float64 [4, 4], of a camera at `position` facing `target`, world y pointing down."""
    forward = torch.nn.functional.normalize(target - position, dim=0)
    right = torch.nn.functional.normalize(torch.linalg.cross(torch.tensor([0.0, 1.0, 0.0]).double(), forward), dim=0)
    R = torch.stack([right, torch.linalg.cross(forward, right), forward])
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3], pose[:3, 3] = R, -R @ position
    return pose


def pinhole(
    width: int = 64,
    height: int = 48,
    focal: float = 60.0,
    principal: tuple[float, float] | None = None,
    position: tuple[float, float, float] = (0.0, 0.0, 0.0),
    target: tuple[float, float, float] = (0.0, 0.0, 1.0),
) -> Camera:
    """A camera with slightly different focal lengths; `principal` is the middle of the image by default [pixels]."""
    cx, cy = principal or (width / 2, height / 2)
    K = torch.tensor([[focal, 0.0, cx], [0.0, 1.03 * focal, cy], [0.0, 0.0, 1.0]], dtype=torch.float64)
    pose = look_at(torch.tensor(position).double(), torch.tensor(target).double())
    return Camera(K, pose, width, height)


def cloud(
    n: int,
    seed: int,
    low: tuple[float, float, float] = (-2.0, -1.6, 2.0),
    high: tuple[float, float, float] = (2.0, 1.6, 6.0),
    scale: tuple[float, float] = (0.03, 0.25),
    opacity: tuple[float, float] = (0.05, 0.95),
    degree: int = 0,
) -> Gaussians:
    """Independent Gaussians: uniform centres, opacities and rotations, log-uniform scales, random colours."""
    rng = torch.Generator().manual_seed(seed)

    def uniform(a: Tensor, b: Tensor, *shape: int) -> Tensor:
        return a + (b - a) * torch.rand(*shape, generator=rng)

    smallest, largest = (torch.tensor(math.log(s)) for s in scale)
    faintest, strongest = (torch.tensor(o) for o in opacity)
    sh = torch.randn(n, (degree + 1) ** 2, 3, generator=rng) * 0.25
    sh[:, 0] *= 4
    return Gaussians(
        means=uniform(torch.tensor(low), torch.tensor(high), n, 3),
        quats=torch.randn(n, 4, generator=rng),
        scales=uniform(smallest, largest, n, 3).exp(),
        opacities=uniform(faintest, strongest, n),
        sh=sh,
    )


def changed(gaussians: Gaussians, **fields: Tensor) -> Gaussians:
    """The same Gaussians with some fields replaced."""
    names = ("means", "quats", "scales", "opacities", "sh")
    return Gaussians(**{name: fields.get(name, getattr(gaussians, name)) for name in names})


def random_cloud() -> tuple[Gaussians, Camera]:
    """All around the camera: some behind it, some beside the image, some close to the near plane."""
    gaussians = cloud(500, seed=1, low=(-4.0, -3.0, -2.0), high=(4.0, 3.0, 6.0), degree=1)
    return gaussians, pinhole(position=(0.3, -0.2, -0.5), target=(0.1, 0.2, 3.0))


def needles() -> tuple[Gaussians, Camera]:
    """1000 times longer than thick, in all directions."""
    gaussians = cloud(150, seed=2, scale=(0.001, 0.003), degree=2)
    return changed(gaussians, scales=gaussians.scales * torch.tensor([1000.0, 1.0, 1.0])), pinhole()


def opaque_stack() -> tuple[Gaussians, Camera]:
    """Nearly opaque discs one behind the other: alpha is clamped and pixels close after two or three."""
    gaussians = cloud(60, seed=13, low=(-0.5, -0.5, 2.0), high=(0.5, 0.5, 6.0), scale=(0.3, 0.9), opacity=(0.97, 1.0))
    return gaussians, pinhole()


def overlapping() -> tuple[Gaussians, Camera]:
    """Long lists of faint, wide Gaussians at every pixel."""
    return cloud(300, seed=4, scale=(0.2, 0.8), opacity=(0.02, 0.2)), pinhole()


def off_centre() -> tuple[Gaussians, Camera]:
    """Principal point 30 % of the image away from the middle, content on both sides."""
    gaussians = cloud(300, seed=5, low=(-4.0, -3.0, 2.0), high=(4.0, 3.0, 6.0))
    return gaussians, pinhole(principal=(0.8 * 64, 0.2 * 48))


def one_pixel() -> tuple[Gaussians, Camera]:
    """An image of 1 x 1."""
    return cloud(50, seed=6, low=(-0.2, -0.2, 2.0), high=(0.2, 0.2, 6.0)), pinhole(1, 1, focal=2.0)


def odd_size() -> tuple[Gaussians, Camera]:
    """An image of 37 x 53, which fills no number of 16 x 16 tiles."""
    gaussians = cloud(300, seed=7, low=(-2.5, -3.0, 2.0), high=(2.5, 3.0, 6.0))
    return gaussians, pinhole(37, 53, focal=45.0, principal=(17.3, 28.9))


def sh3() -> tuple[Gaussians, Camera]:
    """Colours of degree 3, seen from an oblique direction; some are negative before the clamp."""
    return cloud(200, seed=8, degree=3), pinhole(position=(2.0, 1.0, 0.0), target=(0.0, 0.0, 4.0))


def big_splats() -> tuple[Gaussians, Camera]:
    """Each Gaussian covers more than the image, many have their centres outside it."""
    return cloud(50, seed=9, scale=(1.0, 8.0), opacity=(0.05, 0.6)), pinhole()


def thin_alpha() -> tuple[Gaussians, Camera]:
    """Opacities on both sides of the smallest that counts, 1/255."""
    return cloud(400, seed=10, scale=(0.2, 0.8), opacity=(0.5 / 255, 4 / 255)), pinhole()


def coincident() -> tuple[Gaussians, Camera]:
    """Groups of four with one centre: exact ties in depth, which go by index."""
    gaussians = cloud(80, seed=11, scale=(0.1, 0.4))
    return changed(gaussians, means=gaussians.means[torch.arange(80) % 20]), pinhole()


def far_coordinates() -> tuple[Gaussians, Camera]:
    """A georeferenced scene: 1e5 m from the origin, where float32 resolves 8 mm."""
    x, z = 1.0e5, -0.8e5
    gaussians = cloud(200, seed=12, low=(x - 8, -6.0, z + 8), high=(x + 8, 6.0, z + 24), scale=(0.3, 1.5))
    return gaussians, pinhole(position=(x + 0.123456, -0.5, z - 0.654321), target=(x + 1.0, 0.3, z + 16.0))


SCENES: dict[str, Callable[[], tuple[Gaussians, Camera]]] = {
    make.__name__: make
    for make in (
        random_cloud,
        needles,
        opaque_stack,
        overlapping,
        off_centre,
        one_pixel,
        odd_size,
        sh3,
        big_splats,
        thin_alpha,
        coincident,
        far_coordinates,
    )
}
