"""Encoders by name, as the command line and saved semantics know them; `names` says how names are built."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import torch

from sgwarp.encoders.base import MapSource, MaskGenerator, TextEncoder, require_same_space
from sgwarp.encoders.images.conse.class_space import SPACE as CONSE_SPACE
from sgwarp.encoders.maps.files import LABEL_SPACE, open_files
from sgwarp.encoders.names import Member, Part, parse, parse_part
from sgwarp.encoders.prompts import named_templates
from sgwarp.errors import InputError
from sgwarp.scene import View

Device = str | torch.device
CONSE_MODES = ("", "regions", "crops", "dense", "slic", "seeds", "selective")
JOINT = ("clip", "siglip", "siglip2")


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

    members = parse(name)
    sources = [_make_member(member, views, device, name) for member in members]
    source = sources[0] if len(sources) == 1 else Ensemble(sources, [member.weight for member in members])
    if cache is None or not source.needs_image:  # files are quick to read
        return source
    from sgwarp.encoders.cache import DEFAULT_LIMIT, CachedMaps

    return CachedMaps(source, cache, DEFAULT_LIMIT if cache_limit is None else cache_limit)


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
    if space == CONSE_SPACE:
        name = "conse"
    if name is None:
        raise InputError(f"no text encoder for space '{space}' is known; name the encoder it was lifted with")
    encoder = make_text_encoder(name, device, templates)
    require_same_space(space, encoder.space, f"encoder {name}")
    return encoder


def make_text_encoder(name: str, device: Device = "cpu", templates: Sequence[str] | None = None) -> TextEncoder:
    """The text side alone of an encoder with a name.

    Raises:
        InputError: It has none.
    """
    from sgwarp.encoders.ensemble import TextEnsemble

    members = parse(name)
    sides = [_text_side(member, device, name, templates) for member in members]
    return sides[0] if len(sides) == 1 else TextEnsemble(sides, [member.weight for member in members])


def _text_side(member: Member, device: Device, whole: str, templates: Sequence[str] | None = None) -> TextEncoder:
    if member.text is not None:
        return make_text_encoder(member.text, device, templates)
    part = member.source
    chosen = {} if templates is None else {"templates": named_templates(templates)}
    if part.kind.name == "conse":
        from sgwarp.encoders.images.conse.text import ConseText

        return ConseText(**{**_templates(part), **chosen})
    if part.kind.name in JOINT:
        return _joint(part, device, **chosen)
    if part.kind.name == "lseg":
        return _lseg(part, device, **chosen)
    raise InputError(f"encoder '{whole}': {part.kind.name} has no text side of its own; add one, such as +text:conse")


def _make_member(member: Member, views: Sequence[View], device: Device, whole: str) -> MapSource:
    part, kind = member.source, member.source.kind
    if kind.role == "maps":
        return _make_maps(part, views, device)
    if kind.role == "instances":
        from sgwarp.encoders.compose import PaintedInstances

        text = _text_side(member, device, whole)
        return PaintedInstances(_make_detector(part, device), text, _make_masks(member.masks, device))
    if kind.name == "conse":
        return _make_conse(member, device, whole)
    from sgwarp.encoders.compose import Crops, MaskedImages, PlainPixels, RefinedPixels

    rule = part.options.get("rule", "images")
    if rule not in ("images", "pixels"):
        raise InputError(f"encoder '{whole}': rule is images or pixels, not '{rule}'")
    encoder: Any
    if kind.name in JOINT:
        encoder = _joint(part, device)
    elif kind.name == "lseg":
        encoder = _lseg(part, device)
    elif kind.name == "openseg":
        from sgwarp.encoders.pixels.openseg import OpenSeg

        encoder = OpenSeg(part.argument, _text_side(member, device, whole), part.options.get("pooled", True))
    else:
        from sgwarp.encoders.pixels.clipseg import ClipSeg

        options = _templates(part)
        encoder = ClipSeg(part.argument, part.options.get("classes", ()), device=device, **options)
    generator = _make_masks(member.masks, device)
    if generator is None:
        return PlainPixels(encoder)
    assert member.masks is not None
    if kind.role == "images" and rule == "images":
        background = member.masks.options.get("background", True)
        return MaskedImages(Crops(encoder, background=background), generator, _levels(member.masks))
    return RefinedPixels(encoder, generator, member.masks.options.get("rest", "cells"))


def _make_conse(member: Member, device: Device, whole: str) -> MapSource:
    from sgwarp.encoders.compose import Crops, MaskedImages, PlainPixels, RefinedPixels
    from sgwarp.encoders.images.conse.encoder import Conse

    mode = member.source.argument
    if mode not in CONSE_MODES:
        modes = ", ".join(f"conse:{mode}" for mode in CONSE_MODES[1:])
        raise InputError(f"encoder '{whole}' does not exist; there are conse, {modes}")
    masks = member.masks
    if mode in ("slic", "seeds", "selective"):  # conse:slic is short for conse+slic
        masks, mode = masks or parse_part(mode, whole), ""
    encoder = Conse(device=device, **_templates(member.source))
    if mode == "dense" and masks is None:
        return PlainPixels(encoder)
    masks = masks or parse_part("graph", whole)
    generator = _make_masks(masks, device)
    assert generator is not None
    if mode == "dense":
        return RefinedPixels(encoder, generator, masks.options.get("rest", "cells"))
    if mode == "crops":
        background = masks.options.get("background", True)
        return MaskedImages(Crops(encoder, background=background), generator, _levels(masks))
    return MaskedImages(encoder, generator, _levels(masks))


def _make_maps(part: Part, views: Sequence[View], device: Device) -> MapSource:
    if part.kind.name == "files":
        return open_files(part.argument, views, **part.options)
    if part.kind.name == "openscene":
        raise InputError(f"{part.name}: holds features per Gaussian, not per view; read it with sg.load_openscene")
    if part.kind.name == "deva":
        from sgwarp.encoders.maps.deva import DevaMaps

        return DevaMaps(part.argument, views, **part.options)
    from sgwarp.encoders.maps.closed_set import ClosedSet

    return ClosedSet(part.argument, device=device, **part.options)


def _make_detector(part: Part, device: Device) -> Any:
    if part.kind.name == "vlpart":
        from sgwarp.encoders.instances.vlpart import VLPartFiles

        return VLPartFiles(part.argument, **part.options)
    from sgwarp.encoders.instances.detections import DetectorSettings

    classes = part.options.get("classes", ())
    least = 0.25 if part.kind.name == "gdino" else 0.1
    settings = DetectorSettings(**{"least_score": least, **_own(part, DetectorSettings)})
    if part.kind.name == "gdino":
        from sgwarp.encoders.instances.grounding_dino import GroundingDino

        return GroundingDino(part.argument, classes, settings, device)
    from sgwarp.encoders.instances.owlv2 import Owlv2

    return Owlv2(part.argument, classes, settings=settings, device=device, **_templates(part))


def _make_masks(part: Part | None, device: Device) -> MaskGenerator | None:
    if part is None:
        return None
    if part.kind.name == "masks":
        from sgwarp.encoders.masks.files import FileMasks

        return FileMasks(part.argument)
    if part.kind.name in ("sam", "sam2", "sam3"):
        from sgwarp.encoders.masks.sam import Sam, SamSettings

        by_rank = _levels(part) != ("default",)
        return Sam(part.argument, SamSettings(by_rank=by_rank, **_own(part, SamSettings)), device)
    from sgwarp.encoders.masks.proposals import Proposals

    return Proposals(part.kind.name, **_own(part, Proposals))  # type: ignore[arg-type]


def _own(part: Part, settings: Any) -> dict[str, Any]:
    """The options of a part that are attributes of its settings."""
    return _some(part, *(attribute.name for attribute in fields(settings)))


def _some(part: Part, *names: str) -> dict[str, Any]:
    """The options of these names, as far as they are given."""
    return {name: part.options[name] for name in names if name in part.options}


def _levels(part: Part) -> tuple[str, ...]:
    return tuple(part.options.get("levels", ("default",)))


def _templates(part: Part) -> dict[str, Any]:
    given = part.options.get("templates")
    return {} if given is None else {"templates": named_templates(given)}


def _joint(part: Part, device: Device, **chosen: Any) -> Any:
    from sgwarp.encoders.images.clip import JointEncoder

    return JointEncoder(part.argument, device=device, **(_some(part, "longest") | _templates(part) | chosen))


def _lseg(part: Part, device: Device, **chosen: Any) -> Any:
    from sgwarp.encoders.pixels.lseg import LSeg

    return LSeg(part.argument, device=device, **(_some(part, "longest", "tokenizer") | _templates(part) | chosen))
