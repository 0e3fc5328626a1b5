"""Encoders by name, as the command line and saved semantics know them; `names` says how names are built."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

import torch

from sgwarp.encoders.base import ImageEncoder, MapSource, TextEncoder, require_same_space
from sgwarp.encoders.building import Request, builder
from sgwarp.encoders.building import make_text_encoder as make_text_encoder
from sgwarp.encoders.catalogue import KINDS
from sgwarp.encoders.compose import PaintedInstances
from sgwarp.encoders.maps.files import LABEL_SPACE
from sgwarp.encoders.masks.sources import DetectedMasks, GeneratedMasks, MappedMasks, MaskSource, NoText
from sgwarp.encoders.names import Member, parse, parse_part
from sgwarp.errors import InputError
from sgwarp.scene import View

Device = str | torch.device
_kept: dict[str, Any] | None = None  # sources and text sides, once `keep_encoders` was called


def make_encoder(
    name: str,
    views: Sequence[View] = (),
    device: Device = "cpu",
    cache: str | os.PathLike[str] | None = None,
    cache_limit: float | None = None,
) -> MapSource:
    """The source of feature maps with a name.

    Args:
        name: Such as "conse", "clip:PATH+sam:PATH", "lseg:PATH", "files:DIR", or an ensemble "conse@2++clip:PATH@1";
            `sgwarp encoders` lists them all.
        views: The views that will be asked for; needed for files.
        device: Where networks run.
        cache: Folder in which maps are kept for the next time; None for no cache. What reads no image needs none.
        cache_limit: Size of that folder, at most [gigabytes]; 10 if None.

    Raises:
        InputError: There is no encoder of that name, or what it needs is missing.
    """
    from sgwarp.encoders.ensemble import Ensemble

    members, request = parse(name), Request(name, device, views)
    sources = [_make_member(member, request) for member in members]
    source = sources[0] if len(sources) == 1 else Ensemble(sources, [member.weight for member in members])
    if cache is None or not source.needs_image:  # files are quick to read
        return source
    from sgwarp.encoders.cache import DEFAULT_LIMIT, CachedMaps

    return CachedMaps(source, cache, DEFAULT_LIMIT if cache_limit is None else cache_limit)


def keep_encoders() -> None:
    """From now on, what a name and a device make is kept for the next time: for a process that does many scenes.

    What is complete by itself, such as files, depends on the views and is made anew each time.
    """
    global _kept
    _kept = {} if _kept is None else _kept


@contextmanager
def kept_encoders() -> Iterator[None]:
    """The same within a block; what it kept is forgotten at its end, unless it was kept before."""
    global _kept
    before = _kept
    keep_encoders()
    try:
        yield
    finally:
        _kept = before


def _make_member(member: Member, request: Request) -> MapSource:
    make = builder(member.source.kind.make)
    if member.source.kind.role == "maps":
        return make(member, request)
    return _keep(repr((member, str(request.device))), lambda: make(member, request))


def _keep(key: str, make: Callable[[], Any]) -> Any:
    """What is kept under a key, or what `make` makes."""
    if _kept is None:
        return make()
    if key not in _kept:
        _kept[key] = make()
    return _kept[key]


def text_encoder_for(
    space: str, name: str | None = None, device: Device = "cpu", templates: Sequence[str] | None = None
) -> TextEncoder:
    """The encoder of phrases for a space, so that saved semantics can be asked.

    Args:
        space: Of the semantics.
        name: Of the encoder they were lifted with, or of another that shares its space; not needed for the default.
        device: Where it runs.
        templates: Prompts for the phrases, or names of sets of them ("plain", "photo", "room"); the encoder's own if
            None.

    Raises:
        InputError: The space has no text side here, what it needs is missing, or the named encoder speaks another.
    """
    if space == LABEL_SPACE:
        raise InputError("space 'labels' holds lifted ids, not meanings: ask for the ids instead of phrases")
    name = next((kind.name for kind in KINDS.values() if kind.space and kind.space == space), name)
    if name is None:
        raise InputError(f"no text encoder for space '{space}' is known; name the encoder it was lifted with")
    key = repr(("text", name, str(device), templates))
    encoder = _keep(key, partial(make_text_encoder, name, device, templates))
    require_same_space(space, encoder.space, f"encoder {name}")
    return encoder


def encoder_of_questions(name: str, space: str, device: Device = "cpu") -> TextEncoder | None:
    """What encodes phrases for the features that a source gives: its own text side, else that of their space.

    Args:
        name: Of the source.
        space: Of its features; None is returned for label ids, which have no meanings.
        device: Where it runs.

    Raises:
        InputError: Neither the source nor the space has a text side here.
    """
    if space == LABEL_SPACE:
        return None
    if all(member.text is not None or member.source.kind.speak for member in parse(name)):
        return make_text_encoder(name, device)
    return text_encoder_for(space, device=device)


def image_tower_for(space: str, device: Device = "cpu") -> Callable[[], ImageEncoder] | None:
    """What makes the encoder of images for a space whose text encoder takes none; None if there is none here."""
    see = next((kind.see for kind in KINDS.values() if kind.space == space), "")
    return (lambda: builder(see)(device=device)) if see else None


def make_mask_source(name: str, views: Sequence[View] = (), device: Device = "cpu") -> MaskSource:
    """The source of masks with a name.

    Args:
        name: A mask generator ("sam:PATH", "masks:DIR", "graph?scales=100,300,900"), id images ("files:DIR",
            "deva:DIR"), or a detector ("vlpart:DIR", "gdino:PATH?classes=couch,lamp+sam:PATH").
        views: The views that will be asked for; needed for files.
        device: Where networks run.

    Raises:
        InputError: There is no source of that name, it gives no masks, or what it needs is missing.
    """
    request = _MaskRequest(name, device, views)
    kind = KINDS.get(name.partition("?")[0].partition(":")[0])
    if kind is not None and kind.role == "masks":
        generator = request.masks(parse_part(name, name))
        assert generator is not None
        return GeneratedMasks(generator, needs_image=getattr(generator, "needs_image", True))
    members = parse(name)
    role = members[0].source.kind.role
    if len(members) == 1 and role == "maps":
        return MappedMasks(_make_member(members[0], request), name)
    if len(members) == 1 and role == "instances":
        source = _make_member(members[0], request)
        assert isinstance(source, PaintedInstances)
        needs_image = getattr(source.detector, "needs_image", True) or source.generator is not None
        return DetectedMasks(source.detector, source.generator, name, needs_image)
    makers = ", ".join(kind.name for kind in KINDS.values() if kind.role in ("masks", "maps", "instances"))
    raise InputError(f"'{name}' gives no masks; take one of {makers} (see: sgwarp encoders)")


class _MaskRequest(Request):
    """Asks for masks and names alone: a detector needs no text side to embed them."""

    def text(self, member: Member) -> TextEncoder:
        return NoText()
