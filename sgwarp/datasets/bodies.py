"""Rigid bodies: points on their surfaces, and where rays hit them.

The rays know nothing of Gaussians, so that what they see can be the truth for everything that is rendered.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

Kind = Literal["ball", "box", "capsule"]


@dataclass(frozen=True)
class Body:
    """A body in its own axes, around the origin.

    Attributes:
        kind: "ball" of radius size[0]; "box" with half edges `size`; "capsule" along y of radius size[0] and, without
            its caps, half length size[1].
        size: [m].
        label: Index of what it is.
        color: Red, green, blue in 0 to 1.
    """

    kind: Kind
    size: tuple[float, ...]
    label: int
    color: tuple[float, float, float]

    @property
    def area(self) -> float:
        """Of the surface [m^2]."""
        if self.kind == "ball":
            return 4 * math.pi * self.size[0] ** 2
        if self.kind == "capsule":
            return 4 * math.pi * self.size[0] * (self.size[0] + self.size[1])
        a, b, c = self.size
        return 8 * (a * b + b * c + c * a)

    @property
    def reach(self) -> float:
        """Radius of a ball around it [m]."""
        if self.kind == "box":
            return math.sqrt(sum(edge * edge for edge in self.size))
        return sum(self.size)

    def surface(self, count: int, random: torch.Generator) -> tuple[Tensor, Tensor]:
        """Points on the surface, uniform by area, and unit normals, float32 [count, 3] each."""
        directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=random), dim=1)
        if self.kind == "ball":
            return self.size[0] * directions, directions
        if self.kind == "capsule":
            return self._capsule_surface(directions, random)
        half = torch.tensor(self.size)
        areas = torch.stack([half[1] * half[2], half[0] * half[2], half[0] * half[1]])
        axis = torch.multinomial(areas, count, replacement=True, generator=random)
        sign = torch.sign(torch.rand(count, generator=random) - 0.5)
        rows = torch.arange(count)
        normals = torch.zeros(count, 3)
        normals[rows, axis] = sign
        points = (2 * torch.rand(count, 3, generator=random) - 1) * half
        points[rows, axis] = sign * half[axis]
        return points, normals

    def _capsule_surface(self, directions: Tensor, random: torch.Generator) -> tuple[Tensor, Tensor]:
        radius, half = self.size
        count = len(directions)
        # Of the surface the side has the share half / (half + radius); the two caps are a ball cut in two.
        side = torch.rand(count, generator=random) < half / (half + radius)
        around = 2 * math.pi * torch.rand(count, generator=random)
        ring = torch.stack([torch.cos(around), torch.zeros(count), torch.sin(around)], dim=1)
        normals = torch.where(side[:, None], ring, directions)
        along = torch.where(
            side, half * (2 * torch.rand(count, generator=random) - 1), half * torch.sign(normals[:, 1])
        )
        points = radius * normals
        points[:, 1] += along
        return points, normals

    def hit(self, origin: Tensor, directions: Tensor) -> Tensor:
        """Length along each ray to the first hit from outside, infinity where there is none.

        Args:
            origin: In the body's axes, float64 [3].
            directions: Of any length, float64 [R, 3].
        """
        if self.kind == "box":
            return _hit_box(origin, directions, torch.tensor(self.size, dtype=torch.float64))
        if self.kind == "ball":
            return _hit_ball(origin, directions, self.size[0])
        radius, half = self.size
        along = torch.tensor([0.0, half, 0.0], dtype=torch.float64)
        caps = torch.minimum(
            _hit_ball(origin - along, directions, radius), _hit_ball(origin + along, directions, radius)
        )
        return torch.minimum(caps, _hit_side(origin, directions, radius, half))


def _first_root(a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    """Smallest positive t with a t^2 + 2 b t + c = 0, infinity if there is none."""
    inside = b * b - a * c
    root = torch.sqrt(inside.clamp(min=0.0))
    safe = torch.where(a > 0, a, 1.0)
    near, far = (-b - root) / safe, (-b + root) / safe
    first = torch.where(near > 0, near, far)
    return torch.where((inside >= 0) & (a > 0) & (first > 0), first, math.inf)


def _hit_ball(origin: Tensor, directions: Tensor, radius: float) -> Tensor:
    b, c = directions @ origin, origin @ origin - radius**2
    return _first_root(directions.square().sum(dim=1), b, c.expand(len(directions)))


def _hit_side(origin: Tensor, directions: Tensor, radius: float, half: float) -> Tensor:
    flat, at = directions[:, [0, 2]], origin[[0, 2]]
    c = (at @ at - radius**2).expand(len(directions))
    length = _first_root(flat.square().sum(dim=1), flat @ at, c)
    height = origin[1] + torch.where(torch.isfinite(length), length, 0.0) * directions[:, 1]
    return torch.where(height.abs() <= half, length, math.inf)


def _hit_box(origin: Tensor, directions: Tensor, half: Tensor) -> Tensor:
    safe = torch.where(directions.abs() > 1e-12, directions, 1e-12)
    one, other = (-half - origin) / safe, (half - origin) / safe
    enter = torch.minimum(one, other).amax(dim=1)
    leave = torch.maximum(one, other).amin(dim=1)
    first = torch.where(enter > 0, enter, leave)
    return torch.where((enter <= leave) & (first > 0), first, math.inf)
