"""OpenScene's features per Gaussian are no maps of views: `sgwarp lift` and `sg.load_openscene` read them directly."""

from __future__ import annotations

from sgwarp.encoders.base import MapSource
from sgwarp.encoders.building import Request
from sgwarp.encoders.names import Member
from sgwarp.errors import InputError


def make_source(member: Member, request: Request) -> MapSource:
    """Say so.

    Raises:
        InputError: Always.
    """
    raise InputError(f"{member.source.name}: holds features per Gaussian, not per view; read it with sg.load_openscene")
