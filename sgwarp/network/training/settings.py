"""Settings of a training run."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal, get_args

from sgwarp.errors import InputError
from sgwarp.network.augmentation import Augmentation
from sgwarp.network.inputs import InputMode

Loss = Literal["cosine", "contrastive"]


@dataclass(frozen=True)
class DistillSettings:
    """The defaults are those of the paper and its release.

    Attributes:
        arch: Architecture, see `ARCHITECTURES`.
        inputs: What the network sees of a Gaussian, see `input_features`.
        voxel: Side of a voxel [m].
        epochs: Times that every scene is seen.
        learning_rate: Of AdamW in the first epoch; it falls to 0 along a cosine, epoch by epoch.
        weight_decay: Of AdamW.
        scenes_per_step: Scenes whose gradients are averaged before a step, over all processes.
        by_reliability: Weigh the loss of a voxel by how far its lifted features can be trusted.
        augment: Random changes of the scenes; None for none.
        half: Multiply in bfloat16; sums, weights and their gradients stay in float32.
        loss: "cosine" compares features of voxels with lifted ones (the paper); "contrastive" rendered features of
            masks with the masks' vectors, see `contrastive`.
        views_per_step: Views of a scene that the contrastive loss looks at in a step.
        contributors: Gaussians that a pixel has in it, the strongest ones.
        temperature: Of its softmax.
        validate_every: Epochs between two looks at the validation scenes.
        seed: Of the first weights, the order of the scenes and their changes.
    """

    arch: str = "34A"
    inputs: InputMode = "full"
    voxel: float = 0.02
    epochs: int = 100
    learning_rate: float = 1e-3
    weight_decay: float = 0.01
    scenes_per_step: int = 1
    by_reliability: bool = False
    augment: Augmentation | None = field(default_factory=Augmentation)
    half: bool = False
    loss: Loss = "cosine"
    views_per_step: int = 2
    contributors: int = 16
    temperature: float = 0.07
    validate_every: int = 1
    seed: int = 0

    def __post_init__(self) -> None:
        counts = ("epochs", "scenes_per_step", "validate_every", "views_per_step", "contributors")
        for name in ("voxel", "learning_rate", "temperature", *counts):
            value = getattr(self, name)
            if not 0 < value < math.inf:
                raise InputError(f"{name}: expected a number above 0, got {value}")
        for name in counts:
            if getattr(self, name) != int(getattr(self, name)):
                raise InputError(f"{name}: expected a whole number, got {getattr(self, name)}")
        if self.loss not in get_args(Loss):
            raise InputError(f"loss: expected one of {', '.join(get_args(Loss))}, got '{self.loss}'")
        if not 0 <= self.weight_decay < math.inf:
            raise InputError(f"weight_decay: expected a number that is not negative, got {self.weight_decay}")

    def rate(self, epoch: int) -> float:
        """Learning rate of an epoch, counted from 0."""
        return self.learning_rate * 0.5 * (1.0 + math.cos(math.pi * epoch / self.epochs))


@dataclass(frozen=True)
class Epoch:
    """Figures of one epoch; None where there was nothing to measure.

    Attributes:
        epoch: Counted from 1.
        learning_rate: Of its steps.
        loss: Mean over the scenes of the mean of 1 - cosine over their voxels, or of their views' contrastive loss.
        seconds: Wall time, validation included.
        cosine: Mean cosine of prediction and projection over the Gaussians of the validation scenes.
        miou: mIoU of the predicted class against the projected one, over those Gaussians.
    """

    epoch: int
    learning_rate: float
    loss: float | None
    seconds: float
    cosine: float | None = None
    miou: float | None = None
