"""From the parts of a name to networks: what the builders in the catalogue are given, and how sources are composed.

An encoder is one row of `catalogue.KINDS` and one file in the folder of its role. The row names a function of it:

| role | function |
|---|---|
| images, pixels, instances, maps | `make_source(member: Member, request: Request) -> MapSource` |
| masks | `make_masks(part: Part, request: Request) -> MaskGenerator` |
| what has a text side, as `speak` | `make_text(part: Part, request: Request) -> TextEncoder` |
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from importlib import import_module
from typing import Any

import torch

from sgwarp.encoders.base import (
    ImageEncoder,
    InstanceEncoder,
    MapSource,
    MaskGenerator,
    PixelEncoder,
    RegionEncoder,
    TextEncoder,
)
from sgwarp.encoders.compose import Crops, MaskedImages, PaintedInstances, PlainPixels, RefinedPixels
from sgwarp.encoders.names import Member, Part, parse
from sgwarp.encoders.prompts import named_templates
from sgwarp.errors import InputError
from sgwarp.scene import View


@dataclass(frozen=True)
class Request:
    """What is asked for.

    Attributes:
        name: The whole name, for messages.
        device: Where networks run.
        views: The views that will be asked for.
        templates: Prompts of the text side, or names of sets of them; the encoder's own if None.
    """

    name: str
    device: str | torch.device = "cpu"
    views: Sequence[View] = ()
    templates: Sequence[str] | None = None

    def masks(self, part: Part | None) -> MaskGenerator | None:
        """The generator that a part names; None without a part."""
        return None if part is None else builder(part.kind.make)(part, self)

    def text(self, member: Member) -> TextEncoder:
        """The text side of a member.

        Raises:
            InputError: It has none.
        """
        if member.text is not None:
            return make_text_encoder(member.text, self.device, self.templates)
        kind = member.source.kind
        if not kind.speak:
            raise InputError(
                f"encoder '{self.name}': {kind.name} has no text side of its own; add one, such as +text:conse"
            )
        return builder(kind.speak)(member.source, self)

    def templates_of(self, part: Part) -> dict[str, Any]:
        """The keyword `templates` if prompts are asked for, else those that the part names, if any."""
        given = self.templates if self.templates is not None else part.options.get("templates")
        return {} if given is None else {"templates": named_templates(given)}


def builder(path: str) -> Callable[..., Any]:
    """The function behind "module:function"."""
    module, _, function = path.partition(":")
    return getattr(import_module(module), function)


def make_text_encoder(
    name: str, device: str | torch.device = "cpu", templates: Sequence[str] | None = None
) -> TextEncoder:
    """The text side alone of an encoder with a name.

    Raises:
        InputError: It has none.
    """
    from sgwarp.encoders.ensemble import TextEnsemble

    members, request = parse(name), Request(name, device, templates=templates)
    sides = [request.text(member) for member in members]
    return sides[0] if len(sides) == 1 else TextEnsemble(sides, [member.weight for member in members])


def some(part: Part, *names: str) -> dict[str, Any]:
    """The options of these names, as far as they are given."""
    return {name: part.options[name] for name in names if name in part.options}


def own(part: Part, settings: Any) -> dict[str, Any]:
    """The options of a part that are attributes of its settings."""
    return some(part, *(attribute.name for attribute in fields(settings)))


def levels_of(part: Part) -> tuple[str, ...]:
    """Levels of the masks that are asked for."""
    levels: tuple[str, ...] = part.options.get("levels", ("default",))
    return levels


def source_of_pixels(encoder: PixelEncoder, masks: Part | None, request: Request) -> MapSource:
    """A pixel-level network, refined by masks if there are some."""
    if masks is None:
        return PlainPixels(encoder)
    generator = request.masks(masks)
    assert generator is not None
    return RefinedPixels(encoder, generator, masks.options.get("rest", "cells"))


def source_of_regions(encoder: RegionEncoder, masks: Part, request: Request) -> MapSource:
    """A network that sees the masks of an image."""
    generator = request.masks(masks)
    assert generator is not None
    return MaskedImages(encoder, generator, levels_of(masks))


def source_of_images(encoder: ImageEncoder, masks: Part, request: Request) -> MapSource:
    """An image-level network, which is shown the square around each mask."""
    return source_of_regions(Crops(encoder, background=masks.options.get("background", True)), masks, request)


def source_of_instances(detector: InstanceEncoder, member: Member, request: Request) -> MapSource:
    """An instance-level network, whose boxes masks refine if there are some, and whose names a text side embeds."""
    return PaintedInstances(detector, request.text(member), request.masks(member.masks))
