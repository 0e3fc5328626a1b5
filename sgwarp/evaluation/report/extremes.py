"""Stiff and extreme scenes by name: what each puts to the test, and how it is built.

Deterministic and small. Each comes with a bound on the error against the float64 oracle, outside the pixels and
gradients that hang on a decision which float32 cannot take (`sgwarp.evaluation.report.oracle.decidable`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from sgwarp.scene import Camera, Gaussians

COUNT = 200  # Gaussians of most scenes
FAR = 1.0e5  # distance from the origin of georeferenced coordinates [m]
ON_ONE_TILE = 100_000
NEAR = 0.01  # near plane [m]


@dataclass(frozen=True)
class Extreme:
    """A scene at the edge of what can be rendered.

    Attributes:
        name: Short and unique.
        what: What is extreme about it.
        build: Makes the scene and its camera.
        note: How the renderer treats it.
        image_bound: Largest error of colour and opacity against the oracle, outside the undecidable pixels.
        gradient_bound: Largest error of a gradient, that of the camera's pose among them, relative to the largest entry
            of that gradient; None where nothing can be seen, so that every gradient is zero.
    """

    name: str
    what: str
    build: Callable[[], tuple[Gaussians, Camera]]
    note: str
    image_bound: float = 2e-5
    gradient_bound: float | None = 1e-4


def _camera(width: int = 64, height: int = 48, focal: float = 60.0, position: float = 0.0) -> Camera:
    """At (p, p, p), facing +z."""
    K = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]], dtype=torch.float64)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = -position
    return Camera(K, pose, width, height, near=NEAR)


def _cloud(seed: int, count: int = COUNT, scale: float = 0.1) -> dict[str, Tensor]:
    """Fields of Gaussians in front of the camera, 1 to 3 m away, whose colours depend on the direction."""
    rng = torch.Generator().manual_seed(seed)

    def spread(*shape: int) -> Tensor:
        return 2.0 * torch.rand(*shape, generator=rng) - 1.0

    return {
        "means": spread(count, 3) * torch.tensor([0.8, 0.6, 1.0]) + torch.tensor([0.0, 0.0, 2.0]),
        "quats": torch.randn(count, 4, generator=rng),
        "scales": scale * (1.0 + 0.5 * spread(count, 3)),
        "opacities": 0.5 + 0.45 * spread(count),
        "sh": spread(count, 4, 3),
    }


def _needles() -> tuple[Gaussians, Camera]:
    fields = _cloud(1)
    fields["scales"] = torch.tensor([1.0, 1e-6, 1e-6]).expand(COUNT, 3) * fields["opacities"][:, None]
    return Gaussians(**fields), _camera()


def _flat() -> tuple[Gaussians, Camera]:
    fields = _cloud(2)
    fields["scales"][:, 2] = 0.0
    return Gaussians(**fields), _camera()


def _coincident_depths() -> tuple[Gaussians, Camera]:
    fields = _cloud(3)
    means = fields["means"][torch.arange(COUNT) % 20].clone()
    means[:, 2] = 2.0 + torch.arange(COUNT).remainder(4) * 0.25  # 50 to a depth, in a camera that adds no rounding
    fields["means"] = means
    return Gaussians(**fields), _camera()


def _opaque_stack() -> tuple[Gaussians, Camera]:
    fields = _cloud(4, 2000, 0.02)
    fields["means"] = torch.zeros(2000, 3)
    fields["means"][:, 2] = 2.0 + 1e-3 * torch.arange(2000)
    fields["opacities"] = 0.9 + 0.1 * fields["opacities"]
    return Gaussians(**fields), _camera()


def _near_plane() -> tuple[Gaussians, Camera]:
    fields = _cloud(5, scale=0.05)
    depth = NEAR * (1.0 + torch.linspace(-0.1, 0.1, COUNT))  # COUNT is even: none on the plane
    means = fields["means"] * torch.tensor([1.0, 1.0, 0.0])
    means[:, 2] = depth
    fields["means"] = means
    return Gaussians(**fields), _camera()


def _camera_inside() -> tuple[Gaussians, Camera]:
    fields = _cloud(6, scale=2.0)
    fields["means"] = fields["means"] - torch.tensor([0.0, 0.0, 2.0])
    fields["opacities"] = 0.3 * fields["opacities"]
    return Gaussians(**fields), _camera()


def _far_coordinates() -> tuple[Gaussians, Camera]:
    fields = _cloud(7)
    fields["means"] = fields["means"] + FAR
    return Gaussians(**fields), _camera(position=FAR)


def _sized(scale: float) -> Callable[[], tuple[Gaussians, Camera]]:
    def build() -> tuple[Gaussians, Camera]:
        return Gaussians(**_cloud(8, scale=scale)), _camera()

    return build


def _opacity_zero_and_one() -> tuple[Gaussians, Camera]:
    fields = _cloud(9)
    fields["opacities"] = torch.arange(COUNT).remainder(2).float()
    return Gaussians(**fields), _camera()


def _zero_quaternions() -> tuple[Gaussians, Camera]:
    fields = _cloud(10)
    fields["quats"][::2] = 0.0
    fields["quats"][1::4] *= 1e15  # any other length is normalised away
    return Gaussians(**fields), _camera()


def _non_finite(*names: str) -> Callable[[], tuple[Gaussians, Camera]]:
    """NaN and infinity in every column of some fields, one row each."""

    def build() -> tuple[Gaussians, Camera]:
        fields = _cloud(11)
        row = 0
        for name in names:
            # Gaussians itself refuses negative scales and opacities outside [0, 1].
            values = {"opacities": (math.nan,), "scales": (math.nan, math.inf)}.get(
                name, (math.nan, math.inf, -math.inf)
            )
            columns = fields[name].view(COUNT, -1)
            for column in range(columns.shape[1]):
                for value in values:
                    columns[row, column] = value
                    row += 1
        return Gaussians(**fields), _camera()

    return build


def _wide_focal() -> tuple[Gaussians, Camera]:
    return Gaussians(**_cloud(12)), _camera(focal=1e-2)


def _long_focal() -> tuple[Gaussians, Camera]:
    fields = _cloud(13, scale=1e-5)
    fields["means"] = fields["means"] * torch.tensor([5e-5, 5e-5, 1.0])
    return Gaussians(**fields), _camera(focal=1e6)


def _empty() -> tuple[Gaussians, Camera]:
    return Gaussians(**_cloud(14, count=0)), _camera()


def _one_pixel() -> tuple[Gaussians, Camera]:
    return Gaussians(**_cloud(15)), _camera(1, 1, focal=1.0)


def _one_tile() -> tuple[Gaussians, Camera]:
    fields = _cloud(16, ON_ONE_TILE, 1.0)
    shuffled = torch.randperm(ON_ONE_TILE, generator=torch.Generator().manual_seed(16))
    fields["means"] = fields["means"] * torch.tensor([0.05, 0.05, 0.0])
    fields["means"][:, 2] = 2.0 + 4.0 * shuffled / ON_ONE_TILE
    fields["opacities"] = 0.005 + 0.001 * fields["opacities"]
    return Gaussians(**fields), _camera(4, 4)


_GEOMETRY = ("means", "quats", "scales", "opacities")

EXTREMES: dict[str, Extreme] = {
    extreme.name: extreme
    for extreme in (
        Extreme("needles", "a million times longer than thick", _needles, note="no difference of large numbers"),
        Extreme("flat", "one scale is exactly 0", _flat, note="the dilation widens them, as it does all"),
        Extreme("coincident depths", "fifty at each of four depths", _coincident_depths, note="ties go by index"),
        Extreme("opaque stack", "2,000 nearly opaque, 1 mm apart", _opaque_stack, note="a pixel closes after a few"),
        Extreme("near plane", "within 10 % of it, on both sides", _near_plane, note="culled by the centre"),
        Extreme("camera inside", "the camera lies within 200 Gaussians", _camera_inside, note="culled by the centre"),
        Extreme("far coordinates", "100 km from the origin", _far_coordinates, note="camera position in two parts"),
        Extreme("scales 1e-7", "a ten-thousandth of a millimetre", _sized(1e-7), note="only the dilation is seen"),
        Extreme("scales 1e4", "10 km wide, 2 m away", _sized(1e4), note="the same opacity at every pixel"),
        Extreme("opacity 0 and 1", "in turn", _opacity_zero_and_one, note="0 is culled, 1 is clamped to 0.999"),
        Extreme("zero quaternions", "every second; others 1e15 long", _zero_quaternions, note="culled; normalised"),
        Extreme("non-finite geometry", "NaN and infinity, one per row", _non_finite(*_GEOMETRY), note="culled"),
        Extreme("non-finite colours", "NaN and infinity, one per row", _non_finite("sh"), note="culled"),
        Extreme("focal 1e-2", "a view of 179.96 degrees", _wide_focal, note="all within one pixel"),
        Extreme("focal 1e6", "64 pixels see 64 millionths", _long_focal, note="rows may lie nearer than float32 tells"),
        Extreme("empty scene", "no Gaussians", _empty, image_bound=0.0, gradient_bound=None, note="the background"),
        Extreme("one pixel", "an image of 1 x 1", _one_pixel, note="one tile, cut to a pixel"),
        Extreme("one tile", "100,000 on one tile", _one_tile, note="a pixel closes after about 2,000"),
    )
}
