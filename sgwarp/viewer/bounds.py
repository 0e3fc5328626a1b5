"""Bounds on every value that a browser sends: out of them a message is refused, and nothing else happens."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch

from sgwarp.apps.editing.operations import rotation_matrix
from sgwarp.errors import InputError
from sgwarp.scene import Camera

LEAST_SIZE, MOST_SIZE = 16, 4096  # sides of a picture [pixels]
LEAST_FOV, MOST_FOV = math.radians(1), math.radians(170)
FAR_AWAY = 1e12  # of a camera or a shift [world units], which may be micrometers
MOST_TEXT = 2000  # letters of a text box
MOST_PHRASES = 16  # of one text box
MOST_PHRASE = 200  # letters of a phrase


def number(name: str, value: Any, low: float, high: float) -> float:
    """A finite number within the bounds.

    Raises:
        InputError: It is something else.
    """
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not low <= value <= high:
        raise InputError(f"{name}: expected a number from {low:g} to {high:g}, got {str(value)[:40]}")
    return float(value)


def whole(name: str, value: Any, low: int, high: int) -> int:
    """A whole number within the bounds.

    Raises:
        InputError: It is something else.
    """
    found = number(name, value, low, high)
    if found != int(found):
        raise InputError(f"{name}: expected a whole number, got {found:g}")
    return int(found)


def numbers(name: str, values: Any, count: int, bound: float) -> tuple[float, ...]:
    """So many finite numbers, none larger than the bound.

    Raises:
        InputError: They are something else.
    """
    try:
        found = tuple(float(value) for value in values)
    except (TypeError, ValueError):
        found = ()
    if len(found) != count or not all(math.isfinite(value) and abs(value) <= bound for value in found):
        raise InputError(f"{name}: expected {count} numbers of at most {bound:g}, got {str(values)[:80]}")
    return found


def choice(name: str, value: Any, choices: Sequence[str]) -> str:
    """One of the choices.

    Raises:
        InputError: It is none of them.
    """
    if value not in choices:
        raise InputError(f"{name}: expected one of {', '.join(choices)}, got {str(value)[:40]!r}")
    return str(value)


def text(name: str, value: Any, most: int = MOST_TEXT) -> str:
    """A text of printable letters.

    Raises:
        InputError: It is none, or too long.
    """
    if not isinstance(value, str) or len(value) > most:
        raise InputError(f"{name}: expected a text of at most {most} letters")
    return "".join(letter if letter.isprintable() else " " for letter in value).strip()


def phrases(name: str, value: Any) -> tuple[str, ...]:
    """What stands between the semicolons, each once.

    Raises:
        InputError: It is no text, or there are too many phrases or too long ones.
    """
    found = tuple(dict.fromkeys(part.strip() for part in text(name, value).split(";") if part.strip()))
    if len(found) > MOST_PHRASES:
        raise InputError(f"{name}: at most {MOST_PHRASES} phrases at a time, got {len(found)}")
    long = [phrase for phrase in found if len(phrase) > MOST_PHRASE]
    if long:
        raise InputError(f"{name}: a phrase has at most {MOST_PHRASE} letters, '{long[0][:20]}...' has {len(long[0])}")
    return found


def viewpoint(wxyz: Any, position: Any, fov: Any, width: Any, height: Any, near: float, far: float) -> Camera:
    """The camera of a browser.

    Args:
        wxyz: Camera-to-world rotation, OpenCV axes.
        position: Of the camera [world units].
        fov: Vertical field of view [radians].
        width, height: Of the canvas [pixels]; a canvas that is larger than MOST_SIZE is taken at that size.
        near, far: Range of depth [world units].

    Raises:
        InputError: A value is not finite or out of bounds.
    """
    w, x, y, z = numbers("camera rotation", wxyz, 4, 2.0)
    place = numbers("camera position", position, 3, FAR_AWAY)
    fov = number("field of view", fov, LEAST_FOV, MOST_FOV)
    width, height = (
        min(max(whole(name, side, 1, 10**6), LEAST_SIZE), MOST_SIZE)
        for name, side in (("width", width), ("height", height))
    )
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    if norm < 1e-3:
        raise InputError("camera rotation: has no direction")
    to_world = rotation_matrix(torch.tensor([w, x, y, z], dtype=torch.float64) / norm)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = to_world.T
    pose[:3, 3] = -to_world.T @ torch.tensor(place, dtype=torch.float64)
    focal = height / (2 * math.tan(fov / 2))
    K = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]], dtype=torch.float64)
    return Camera(K, pose, width, height, near=near, far=far)


def pixel(position: Any, camera: Camera) -> tuple[int, int]:
    """The pixel (x, y) at a place of the picture, given from 0 to 1 on either side.

    Raises:
        InputError: The numbers are not finite.
    """
    x, y = numbers("place in the picture", position, 2, 1e3)
    return (
        min(max(int(x * camera.width), 0), camera.width - 1),
        min(max(int(y * camera.height), 0), camera.height - 1),
    )
