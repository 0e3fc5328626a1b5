"""The instances of a scene: which object, or part of one, every Gaussian belongs to."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.scene.checks import float32, require
from sgwarp.scene.gaussians import Gaussians

UNDECIDED = -1  # instance of a Gaussian about which the masks say too little, or contradict each other
NOTHING = 0  # instance of a Gaussian that was seen, and lies in no mask


@dataclass(frozen=True)
class Instance:
    """One object or part.

    Attributes:
        id: From 1 on; unique over all levels.
        level: Name of its level: "default", or "s", "m", "l" for subparts, parts and wholes.
        parent: Id of the instance of the next coarser level that holds it; 0 if none does.
        gaussians: How many Gaussians are assigned to it.
        masks, views: How many masks it was joined from, and how many views they come from.
        confidence: Mean confidence of its Gaussians, 0 to 1.
        centroid: Mean of their centers, weighted with opacity [m].
        rotation: Axes of the oriented box, as a quaternion (w, x, y, z).
        extent: Full side lengths of that box [m].
        label: What it is called; empty if nobody was asked.
        label_score: How sure that is: a share of the masks' names, or a probability among the given classes.
        may_be: Ids of instances that may be the same object: no view shows both, and none tells them apart.
    """

    id: int
    level: str
    parent: int
    gaussians: int
    masks: int
    views: int
    confidence: float
    centroid: tuple[float, float, float]
    rotation: tuple[float, float, float, float]
    extent: tuple[float, float, float]
    label: str = ""
    label_score: float = 0.0
    may_be: tuple[int, ...] = ()


@dataclass(frozen=True, eq=False)
class InstanceMap:
    """The instances of a scene's Gaussians, by level.

    Attributes:
        candidates: The T instances that speak most for each Gaussian, 0 for none of them, int32 [L, N, T]; -1 fills up.
        shares: Share of the evidence of each candidate, descending, float32 [L, N, T].
        observations: How many views' worth of evidence there is, float32 [N]; 0 where no view saw the Gaussian.
        table: The instances, in the order of their ids, which are 1, 2, ...
        levels: Names of the levels, the finest first.
        fingerprint: `Gaussians.fingerprint` of the scene.
        least_confidence: Where the confidence is smaller the instance is undecided.
        features: Mean feature of each instance, float32 [K, C], or None.
        space: Embedding space of the features, or empty.

    Raises:
        InputError: A field has the wrong shape, or names an instance that the table does not hold.
    """

    candidates: Tensor
    shares: Tensor
    observations: Tensor
    table: tuple[Instance, ...]
    levels: tuple[str, ...]
    fingerprint: str
    least_confidence: float = 0.55
    features: Tensor | None = None
    space: str = ""

    def __post_init__(self) -> None:
        put = object.__setattr__
        candidates = torch.as_tensor(self.candidates).to(torch.int32).contiguous()
        fits = candidates.ndim == 3 and len(candidates) == len(self.levels)
        require(fits, f"candidates: expected [{len(self.levels)}, N, T], got {list(candidates.shape)}")
        put(self, "candidates", candidates)
        put(self, "shares", float32("shares", self.shares, tuple(candidates.shape)))
        put(self, "observations", float32("observations", self.observations, (candidates.shape[1],)))
        numbered = [instance.id for instance in self.table] == list(range(1, len(self.table) + 1))
        require(numbered, f"table: expected ids 1 to {len(self.table)} in this order")
        low, high = (int(t) for t in candidates.aminmax()) if candidates.numel() else (0, 0)
        inside = low >= UNDECIDED and high <= len(self.table)
        require(inside, f"candidates: expected -1 to {len(self.table)}, the ids of the table, got {low} to {high}")
        if self.features is not None:
            put(self, "features", float32("features", self.features, (len(self.table), None)))

    def __len__(self) -> int:
        """Number of Gaussians."""
        return self.candidates.shape[1]

    def level_index(self, level: str | None = None) -> int:
        """Position of a level; the coarsest if None.

        Raises:
            InputError: There is no such level.
        """
        if level is None:
            return len(self.levels) - 1
        if level not in self.levels:
            raise InputError(f"level '{level}' is not one of {', '.join(self.levels)}")
        return self.levels.index(level)

    def confidence(self, level: str | None = None) -> Tensor:
        """Posterior mean of the best candidate against all others, float32 [N] in [0, 1].

        Under a Beta(1, 1) prior: (n s + 1) / (n + 2) for n observations and a share s; 1/2 where nothing was seen.
        """
        share = self.shares[self.level_index(level), :, 0]
        return (self.observations * share + 1.0) / (self.observations + 2.0)

    def instance(self, level: str | None = None) -> Tensor:
        """Id of every Gaussian's instance, int64 [N]; 0 = nothing, -1 = undecided."""
        best = self.candidates[self.level_index(level), :, 0].long()
        return torch.where(self.confidence(level) >= self.least_confidence, best, UNDECIDED)

    def members(self, instance: int) -> Tensor:
        """Gaussians of an instance, bool [N].

        Raises:
            InputError: There is no such id.
        """
        return self.instance(self.table[self._row(instance)].level) == instance

    def leaning(self, instance: int) -> Tensor:
        """Gaussians whose first candidate an instance is, decided or not, bool [N].

        Raises:
            InputError: There is no such id.
        """
        level = self.table[self._row(instance)].level
        return self.candidates[self.level_index(level), :, 0] == instance

    def _row(self, instance: int) -> int:
        if not 1 <= instance <= len(self.table):
            raise InputError(f"instance {instance}: unknown id; this scene has 1 to {len(self.table)}")
        return instance - 1

    def require_scene(self, gaussians: Gaussians) -> None:
        """Raise InputError if these instances belong to another scene."""
        same = self.fingerprint == gaussians.fingerprint and len(self) == len(gaussians)
        theirs = f"instances belong to scene {self.fingerprint}, this scene is {gaussians.fingerprint}"
        require(same, f"{theirs}; find them again")
