"""Label images of a data set as a source of 2D semantics, with a stated share of them wrong."""

from __future__ import annotations

import zlib

import torch
from torch import Tensor

from sgwarp.datasets.base import SceneData
from sgwarp.datasets.moving import with_label_noise
from sgwarp.encoders.base import MissingMap
from sgwarp.encoders.maps.files import LABEL_SPACE
from sgwarp.errors import InputError
from sgwarp.scene import FeatureMap, View

NAME = "truth"


class TruthMaps:
    """True labels of the views, one-hot, as a MapSource.

    Noise model: in every view, each class turns into another one, drawn anew, with probability `noise`, as a 2D network
    mistakes whole objects.

    Args:
        scene: Its label images.
        noise: Share of the regions that are wrong, in [0, 1].
        seed: Of the noise; a view has the same noise whatever was asked before.
    """

    needs_image = False
    space = LABEL_SPACE

    def __init__(self, scene: SceneData, noise: float = 0.0, seed: int = 0) -> None:
        self.scene, self.noise, self.seed = scene, noise, seed
        self.read = scene.need("labels")

    def has_map(self, view: View) -> bool:
        """Whether the view is labelled."""
        return view.stem in self.scene.labelled

    def encode(self, view: View, image: Tensor | None = None) -> FeatureMap:
        """The labels of a view.

        Raises:
            MissingMap: It has none.
        """
        if not self.has_map(view):
            raise MissingMap(f"{self.scene.folder}: view {view.stem} is not labelled")
        labels = self.read(view.stem)
        if self.noise:
            random = torch.Generator().manual_seed(self.seed * 1_000_003 + zlib.crc32(view.stem.encode()))
            labels = with_label_noise(labels + 1, self.noise, random, len(self.scene.classes)) - 1
        return FeatureMap(self.space, ids=labels, labels=self.scene.classes)


def noise_of(encoder: str) -> float | None:
    """The noise that "truth" or "truth?noise=0.15" asks for; None for any other encoder.

    Raises:
        InputError: The option is another one, or out of range.
    """
    name, mark, option = encoder.partition("?")
    if name != NAME:
        return None
    if not mark:
        return 0.0
    key, _, value = option.partition("=")
    try:
        noise = float(value)
    except ValueError:
        noise = -1.0
    if key != "noise" or not 0 <= noise <= 1:
        raise InputError(f"encoder '{encoder}': write truth or truth?noise=SHARE, with a share from 0 to 1")
    return noise
