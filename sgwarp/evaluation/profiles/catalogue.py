"""Profiles by name."""

from __future__ import annotations

from importlib import import_module

from sgwarp.errors import InputError
from sgwarp.evaluation.profiles.base import Profile

PLACES = {
    "room": "room:ROOM",
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
