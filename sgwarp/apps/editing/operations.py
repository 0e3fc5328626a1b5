"""What an edit does, as plain data: one frozen dataclass per operation, and how it changes Gaussians.

Every operation takes the scene and the selection, and gives the new Gaussians, the row of the scene that each of them
comes from, and how many are new copies. Turning and scaling are about the selection's centroid, weighted with opacity.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import Any, ClassVar

import torch
from torch import Tensor

from sgwarp.apps.editing.selection import is_number
from sgwarp.errors import InputError
from sgwarp.ops.planar.harmonics_rotation import rotate_harmonics
from sgwarp.scene import Gaussians

SH_C0 = 0.28209479177387814  # of the constant harmonic: color = 1/2 + SH_C0 sh_0
LUMA = (0.2126, 0.7152, 0.0722)  # Rec. 709
COLORS = {
    "black": (0.02, 0.02, 0.02),
    "blue": (0.1, 0.2, 0.9),
    "brown": (0.45, 0.27, 0.12),
    "cyan": (0.1, 0.8, 0.85),
    "gray": (0.5, 0.5, 0.5),
    "green": (0.1, 0.6, 0.15),
    "magenta": (0.85, 0.15, 0.8),
    "orange": (0.95, 0.5, 0.1),
    "purple": (0.5, 0.15, 0.7),
    "red": (0.85, 0.1, 0.1),
    "white": (0.95, 0.95, 0.95),
    "yellow": (0.95, 0.85, 0.1),
}
Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Change:
    """What an operation made of a scene.

    Attributes:
        gaussians: The new scene.
        rows: Row of the old scene that each comes from, int64; None if rows stayed as they were.
        added: How many at the end are new copies.
    """

    gaussians: Gaussians
    rows: Tensor | None = None
    added: int = 0


@dataclass(frozen=True)
class Remove:
    """Take the selection away."""

    name: ClassVar[str] = "remove"

    def apply(self, gaussians: Gaussians, chosen: Tensor) -> Change:
        return _only(gaussians, ~chosen, "remove")


@dataclass(frozen=True)
class Extract:
    """Leave nothing but the selection."""

    name: ClassVar[str] = "extract"

    def apply(self, gaussians: Gaussians, chosen: Tensor) -> Change:
        return _only(gaussians, chosen, "extract")


@dataclass(frozen=True)
class Isolate:
    """Fade everything but the selection: opacities are multiplied by `fade`, which can be undone by dividing."""

    name: ClassVar[str] = "isolate"
    fade: float = 0.1

    def __post_init__(self) -> None:
        _number("isolate", "fade", self.fade)
        if not 0.0 <= self.fade < 1.0:
            raise InputError(f"isolate: fade is a factor from 0 to less than 1, got {self.fade}")

    def apply(self, gaussians: Gaussians, chosen: Tensor) -> Change:
        opacities = torch.where(chosen, gaussians.opacities, gaussians.opacities * self.fade)
        return Change(replace(gaussians, opacities=opacities))


@dataclass(frozen=True)
class Fade:
    """Multiply the selection's opacities by a factor; 0 hides it."""

    name: ClassVar[str] = "fade"
    factor: float = 0.0

    def __post_init__(self) -> None:
        _number("fade", "factor", self.factor)
        if not 0.0 <= self.factor <= 1.0:
            raise InputError(f"fade: factor is a number from 0 to 1, got {self.factor}")

    def apply(self, gaussians: Gaussians, chosen: Tensor) -> Change:
        opacities = torch.where(chosen, gaussians.opacities * self.factor, gaussians.opacities)
        return Change(replace(gaussians, opacities=opacities))


@dataclass(frozen=True)
class Move:
    """Shift the selection [m]."""

    name: ClassVar[str] = "move"
    by: Vector = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        object.__setattr__(self, "by", _vector("move", "by", self.by))

    def apply(self, gaussians: Gaussians, chosen: Tensor) -> Change:
        shift = torch.tensor(self.by, dtype=torch.float64, device=gaussians.device)
        moved = (gaussians.means[chosen].double() + shift).to(torch.float32)
        return Change(replace(gaussians, means=_put(gaussians.means, chosen, moved)))


@dataclass(frozen=True)
class Rotate:
    """Turn the selection about an axis through its centroid: centers, shapes and how colors depend on direction."""

    name: ClassVar[str] = "rotate"
    axis: Vector = (0.0, 0.0, 1.0)
    degrees: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "axis", _vector("rotate", "axis", self.axis))
        _number("rotate", "degrees", self.degrees)
        if not any(self.axis):
            raise InputError("rotate: the axis has no direction")

    def apply(self, gaussians: Gaussians, chosen: Tensor) -> Change:
        quat = axis_quaternion(self.axis, math.radians(self.degrees)).to(gaussians.device)
        return Change(rotate_gaussians(gaussians, chosen, quat, centroid(gaussians, chosen)))


@dataclass(frozen=True)
class Scale:
    """Enlarge the selection about its centroid by a factor."""

    name: ClassVar[str] = "scale"
    factor: float = 1.0

    def __post_init__(self) -> None:
        _number("scale", "factor", self.factor)
        if not self.factor > 0:
            raise InputError(f"scale: expected a positive factor, got {self.factor}")

    def apply(self, gaussians: Gaussians, chosen: Tensor) -> Change:
        center = centroid(gaussians, chosen)
        means = center + (gaussians.means[chosen].double() - center) * self.factor
        scales = gaussians.scales[chosen] * self.factor
        return Change(
            replace(
                gaussians,
                means=_put(gaussians.means, chosen, means.to(torch.float32)),
                scales=_put(gaussians.scales, chosen, scales),
            )
        )


@dataclass(frozen=True)
class Recolor:
    """Give the selection a color and keep its shading.

    Every color c, seen from anywhere, becomes color * luma(c) / mean luma: a linear map, so it applies to the harmonics
    of all degrees and the dependence on direction stays.
    """

    name: ClassVar[str] = "recolor"
    color: Vector = (0.5, 0.5, 0.5)

    def __post_init__(self) -> None:
        object.__setattr__(self, "color", _vector("recolor", "color", self.color))
        if not all(0.0 <= part <= 1.0 for part in self.color):
            raise InputError(f"recolor: a color is red, green and blue from 0 to 1, got {self.color}")

    def apply(self, gaussians: Gaussians, chosen: Tensor) -> Change:
        sh = gaussians.sh[chosen].double()
        luma = torch.tensor(LUMA, dtype=torch.float64, device=sh.device)
        target = torch.tensor(self.color, dtype=torch.float64, device=sh.device)
        sh[:, 0] += 0.5 / SH_C0  # of the color itself, not of its distance from grey
        weight = _weights(gaussians, chosen)
        mean = ((sh[:, 0] @ luma) * SH_C0 * weight).sum() / weight.sum()
        if not bool(mean > 1e-6):
            raise InputError("recolor: the selection is black; it has no shading to keep")
        sh = (sh @ luma)[..., None] / mean * target
        sh[:, 0] -= 0.5 / SH_C0
        return Change(replace(gaussians, sh=_put(gaussians.sh, chosen, sh.to(torch.float32))))


@dataclass(frozen=True)
class Duplicate:
    """Add a copy of the selection, shifted [m]; the term copy:1 selects the first one."""

    name: ClassVar[str] = "duplicate"
    by: Vector = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        object.__setattr__(self, "by", _vector("duplicate", "by", self.by))

    def apply(self, gaussians: Gaussians, chosen: Tensor) -> Change:
        count = len(gaussians)
        copied = chosen.nonzero().flatten()
        rows = torch.cat([torch.arange(count, device=gaussians.device), copied])
        new = torch.zeros(len(rows), dtype=torch.bool, device=gaussians.device)
        new[count:] = True
        return Change(Move(self.by).apply(gaussians.subset(rows), new).gaussians, rows, len(copied))


Operation = Remove | Extract | Isolate | Fade | Move | Rotate | Scale | Recolor | Duplicate
OPERATIONS: dict[str, Any] = {
    kind.name: kind for kind in (Remove, Extract, Isolate, Fade, Move, Rotate, Scale, Recolor, Duplicate)
}


def operation_from(content: Mapping[str, Any]) -> Operation:
    """The operation that a step of a script names under "do".

    Raises:
        InputError: There is no such operation, or a value does not fit.
    """
    name = content.get("do")
    kind = OPERATIONS.get(name) if isinstance(name, str) else None
    if kind is None:
        raise InputError(f"do: expected one of {', '.join(OPERATIONS)}, got {content.get('do')!r}")
    given = {field.name: content[field.name] for field in fields(kind) if field.name in content}
    if isinstance(given.get("color"), str):
        given["color"] = parse_color(given["color"])
    operation: Operation = kind(**given)
    return operation


def operation_content(operation: Operation) -> dict[str, Any]:
    """The entries of a step of a script."""
    return {"do": operation.name} | {name: _plain(value) for name, value in asdict(operation).items()}


def parse_color(text: str) -> Vector:
    """A name of COLORS, #rrggbb, or three numbers from 0 to 1.

    Raises:
        InputError: It is none of them.
    """
    if text in COLORS:
        return COLORS[text]
    try:
        if text.startswith("#") and len(text) == 7:
            red, green, blue = (int(text[at : at + 2], 16) / 255 for at in (1, 3, 5))
        else:
            red, green, blue = (float(part) for part in text.replace(",", " ").split())
    except ValueError:
        raise InputError(f"color '{text}': give #rrggbb, three numbers, or one of {', '.join(COLORS)}") from None
    return red, green, blue


def axis_quaternion(axis: Vector, angle: float) -> Tensor:
    """(w, x, y, z) of a turn by `angle` [rad], counterclockwise seen against the axis, float64 [4]."""
    direction = torch.tensor(axis, dtype=torch.float64)
    direction = direction / direction.abs().max()  # its square may overflow
    direction = direction / direction.norm()
    return torch.cat([torch.tensor([math.cos(angle / 2)], dtype=torch.float64), math.sin(angle / 2) * direction])


def rotation_matrix(quat: Tensor) -> Tensor:
    """Rotation matrix of a unit quaternion, float64 [3, 3]."""
    w, x, y, z = (float(part) for part in quat)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.tensor(rows, dtype=torch.float64, device=quat.device)


def rotate_gaussians(gaussians: Gaussians, chosen: Tensor, quat: Tensor, center: Tensor) -> Gaussians:
    """Turn some Gaussians about a point, harmonics included; in float64, rounded once."""
    turn = rotation_matrix(quat)
    means = center + (gaussians.means[chosen].double() - center) @ turn.T
    quats = multiply_quaternions(quat, gaussians.quats[chosen].double())
    sh = rotate_harmonics(gaussians.sh[chosen], turn)
    return replace(
        gaussians,
        means=_put(gaussians.means, chosen, means.to(torch.float32)),
        quats=_put(gaussians.quats, chosen, quats.to(torch.float32)),
        sh=_put(gaussians.sh, chosen, sh),
    )


def multiply_quaternions(first: Tensor, second: Tensor) -> Tensor:
    """Hamilton product of [4] with [N, 4]: first turns what second has turned."""
    w, x, y, z = first.unbind()
    a, b, c, d = second.unbind(-1)
    return torch.stack(
        [
            w * a - x * b - y * c - z * d,
            w * b + x * a + y * d - z * c,
            w * c - x * d + y * a + z * b,
            w * d + x * c - y * b + z * a,
        ],
        dim=-1,
    )


def centroid(gaussians: Gaussians, chosen: Tensor) -> Tensor:
    """Mean of the chosen centers, weighted with opacity [m], float64 [3]."""
    weight = _weights(gaussians, chosen)[:, None]
    finite = torch.isfinite(gaussians.means[chosen]).all(dim=1, keepdim=True)
    means = torch.where(finite, gaussians.means[chosen].double(), 0.0)
    return (means * weight * finite).sum(dim=0) / (weight * finite).sum().clamp(min=1e-30)


def _weights(gaussians: Gaussians, chosen: Tensor) -> Tensor:
    return torch.nan_to_num(gaussians.opacities[chosen].double()) + 1e-9


def _only(gaussians: Gaussians, kept: Tensor, what: str) -> Change:
    if not bool(kept.any()):
        raise InputError(f"{what}: would leave no Gaussian; select less")
    rows = kept.nonzero().flatten()
    return Change(gaussians.subset(rows), rows)


def _put(values: Tensor, chosen: Tensor, new: Tensor) -> Tensor:
    """A copy of the values with new ones at the chosen rows."""
    values = values.clone()
    values[chosen] = new
    return values


def _vector(what: str, name: str, value: Any) -> Vector:
    fits = isinstance(value, (list, tuple)) and len(value) == 3
    if not fits:
        raise InputError(f"{what}: {name} is three numbers, got {value!r}")
    for part in value:
        _number(what, name, part)
    return float(value[0]), float(value[1]), float(value[2])


def _number(what: str, name: str, value: Any) -> None:
    if not is_number(value):
        raise InputError(f"{what}: {name}: expected a finite number, got {str(value)[:40]}")


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value
