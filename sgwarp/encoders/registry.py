"""Encoders by name, as the command line and saved semantics know them."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from sgwarp.encoders.base import MapSource, TextEncoder
from sgwarp.encoders.class_space import SPACE as CONSE_SPACE
from sgwarp.encoders.files import LABEL_SPACE, open_files
from sgwarp.errors import InputError
from sgwarp.scene import View

NAMES = ("conse", "conse:regions", "conse:dense", "conse:slic", "conse:seeds", "conse:selective", "files:DIR")
SUPERPIXEL_SIDE = 24.0  # [pixels], of an image of 480


def make_encoder(name: str, views: Sequence[View] = (), device: str | torch.device = "cpu") -> MapSource:
    """The source of feature maps with a name.

    Args:
        name: "conse" (regions of the graph segmentation), "conse:dense", "conse:slic", "conse:seeds", "conse:selective"
            (other proposals), or "files:DIR" with options as in `open_files`.
        views: The views that will be asked for; needed for files.
        device: Where a network runs.

    Raises:
        InputError: There is no encoder of that name, or what it needs is missing.
    """
    kind, _, rest = name.partition(":")
    if kind == "files":
        return open_files(rest, views)
    if kind == "conse" and rest in ("", "regions", "dense", "slic", "seeds", "selective"):
        from sgwarp.encoders.conse import Conse, ConseSettings
        from sgwarp.encoders.regions import Proposals

        others: dict[str, Proposals] = {"slic": "slic", "seeds": "seeds", "selective": "selective"}
        settings = ConseSettings(proposals=others[rest], scales=(SUPERPIXEL_SIDE,)) if rest in others else None
        return Conse("dense" if rest == "dense" else "regions", settings, device=device)
    raise InputError(f"encoder '{name}' does not exist; there are {', '.join(NAMES)}")


def text_encoder_for(space: str) -> TextEncoder:
    """The encoder of phrases for a space, so that saved semantics can be asked without naming an encoder.

    Raises:
        InputError: The space has no text side here, or what it needs is missing.
    """
    if space == CONSE_SPACE:
        from sgwarp.encoders.conse_text import ConseText

        return ConseText()
    if space == LABEL_SPACE:
        raise InputError("space 'labels' holds lifted ids, not meanings: ask for the ids instead of phrases")
    raise InputError(f"no text encoder for space '{space}'; there is one for '{CONSE_SPACE}'")
