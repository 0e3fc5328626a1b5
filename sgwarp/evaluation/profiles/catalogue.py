"""Profiles by name."""

from __future__ import annotations

from importlib import import_module

from sgwarp.errors import InputError
from sgwarp.evaluation.profiles.base import Profile

PLACES = {
    "room": "room:ROOM",
    "room-instances": "instances:ROOM",
    "scannet12-2d": "scannet:FRAMES",
    "scannet-3d": "scannet:POINTS",
    "scannet-instances": "instances:SCANNET",
    "lerf-ovs-loc": "lerf_ovs:LOCATION",
    "lerf-ovs-seg": "lerf_ovs:SEGMENTATION",
    "lerf-ovs-3d": "lerf_ovs:SELECTION",
    "lerf-mask": "masks:LERF_MASK",
    "nvos": "masks:NVOS",
    "spin-nerf": "masks:SPIN_NERF",
    "parts": "parts:PARTS",
    "panoptic-4d": "panoptic:PANOPTIC",
}


def find_profile(name: str) -> Profile:
    """The profile of a name.

    Raises:
        InputError: There is none.
    """
    if name not in PLACES:
        raise InputError(f"profile '{name}' does not exist; there are {', '.join(PLACES)}")
    module, _, variable = PLACES[name].partition(":")
    profile: Profile = getattr(import_module(f"sgwarp.evaluation.profiles.{module}"), variable)
    return profile
