"""What is at a pixel, or in a rectangle: which object, what it is called, and how sure that is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from sgwarp.apps.editing.picker import EditContext, EditState, pick_at
from sgwarp.errors import InputError
from sgwarp.ops.splatting.forward import rasterize
from sgwarp.querying.scores import class_votes
from sgwarp.scene import Camera, InstanceMap, Semantics
from sgwarp.viewer.questions import Asker

BEHIND = 0.02  # of the surface's depth by which a center may lie behind it and still count as visible
NAMED = 3  # words for an object, at most
# What objects are asked for by when nobody asks for anything: furniture and things of rooms, streets and gardens.
WORDS = (
    *("table", "chair", "couch", "bed", "shelf", "cabinet", "desk", "lamp", "door", "window", "curtain", "rug"),
    *("plant", "picture", "mirror", "screen", "book", "bag", "box", "bottle", "cup", "bowl", "toy", "clothes"),
    *("wall", "floor", "ceiling", "sink", "toilet", "bathtub", "stove", "refrigerator", "person", "animal"),
    *("car", "bicycle", "tree", "grass", "road", "building", "sky", "rock", "water"),
)


@dataclass(frozen=True, eq=False)
class Found:
    """What a click or a rectangle selected.

    Attributes:
        selected: bool [N], of the scene as it is now.
        instance: Its id; 0 if it is none.
        level: Of the instance, or empty.
        words: What it may be called, and how sure that is, the best first.
        confidence: Mean confidence that its Gaussians belong to the instance, 0 to 1; NaN if it is none.
    """

    selected: Tensor
    instance: int = 0
    level: str = ""
    words: tuple[tuple[str, float], ...] = ()
    confidence: float = float("nan")

    @property
    def sentence(self) -> str:
        """One line for people."""
        count = int(self.selected.sum())
        what = f"object {self.instance}" if self.instance else "selection"
        named = ", ".join(f"{word} ({share:.0%})" for word, share in self.words)
        parts = [f"{what}: {named}" if named else what, f"{count:,} Gaussians"]
        if self.level and self.level != "default":
            parts.append(f"level {self.level}")
        if self.confidence == self.confidence:
            parts.append(f"membership {self.confidence:.0%} sure")
        return ", ".join(parts)


def click(
    state: EditState, context: EditContext, asker: Asker, camera: Camera, pixel: tuple[int, int], before: Found | None
) -> Found:
    """The object at a pixel; a click at the one that is selected goes to its part there, and from the finest level
    back to the whole.

    Args:
        state: The scene.
        context: Instances or semantics.
        asker: For words.
        camera: The view.
        pixel: x and y.
        before: What is selected now.

    Raises:
        InputError: There are neither instances nor semantics.
    """
    instances = context.instances
    if instances is None:
        if context.semantics is None:
            raise InputError("a click needs --instances or --semantics, to tell what belongs together")
        return describe(state, asker, None, pick_at(state, context, camera, pixel))
    levels = list(reversed(instances.levels))  # the coarsest first
    if before is not None and before.instance:
        here = levels.index(before.level)
        at = {level: pick_at(state, context, camera, pixel, level) for level in levels[here:]}
        ids = {level: _instance(state, instances, selected, level) for level, selected in at.items()}
        if ids[before.level] == before.instance:
            finer = next((level for level in levels[here + 1 :] if ids[level]), None)
            if finer is not None:
                return describe(state, asker, instances, at[finer], finer)
    return describe(state, asker, instances, pick_at(state, context, camera, pixel, levels[0]), levels[0])


def _instance(state: EditState, instances: InstanceMap, selected: Tensor, level: str) -> int:
    """The instance that most of a selection belongs to, 0 if to none."""
    rows = state.rows[selected].cpu()
    return max(int(instances.instance(level).cpu()[rows].mode().values), 0) if len(rows) else 0


def describe(state: EditState, asker: Asker, instances: InstanceMap | None, selected: Tensor, level: str = "") -> Found:
    """Words for a selection, and how sure they are."""
    rows = state.rows[selected].cpu()
    if not len(rows):
        return Found(selected)
    instance, confidence = 0, float("nan")
    words: tuple[tuple[str, float], ...] = ()
    if instances is not None:
        level = level or instances.levels[-1]
        instance = _instance(state, instances, selected, level)
        if instance:
            confidence = float(instances.confidence(level).cpu()[rows].mean())
            row = instances.table[instance - 1]
            words = ((row.label, row.label_score),) if row.label else ()
    return Found(selected, instance, level if instance else "", words or name(asker, rows), confidence)


def name(asker: Asker, rows: Tensor, words: Sequence[str] = WORDS) -> tuple[tuple[str, float], ...]:
    """The words that fit some Gaussians best, with the mean of their shares; none without semantics."""
    semantics = asker.semantics
    if semantics is None:
        return ()
    if semantics.labels is not None:
        words, votes = semantics.labels, semantics.features
    else:
        if asker.encoder is None:
            return ()
        votes = class_votes(_of(semantics, rows), list(words), asker.encoder)
        rows = torch.arange(len(rows))
    seen = semantics.seen if semantics.labels is not None else torch.ones(len(votes), dtype=torch.bool)
    known = rows[seen[rows].cpu()]
    if not len(known):
        return ()
    shares = votes[known].float().mean(dim=0)
    best = shares.argsort(descending=True)[:NAMED].tolist()
    return tuple((words[k], float(shares[k])) for k in best if float(shares[k]) > 0)


def _of(semantics: Semantics, rows: Tensor) -> Semantics:
    """The semantics of some Gaussians, as one of a scene of its own."""
    from dataclasses import replace

    parts = {part: getattr(semantics, part)[rows] for part in ("features", "weight", "effective_views")}
    return replace(semantics, **parts)


def in_rectangle(
    state: EditState, camera: Camera, corners: tuple[tuple[int, int], tuple[int, int]], through: bool = False
) -> Tensor:
    """Gaussians whose centers lie in a rectangle of the picture, bool [N].

    Args:
        state: The scene.
        camera: The view.
        corners: Two opposite pixels (x, y), both inside.
        through: Also what is hidden.
    """
    gaussians = state.gaussians
    (x0, y0), (x1, y1) = _sorted(corners)
    pose, K = camera.world_to_camera.to(gaussians.device), camera.K.to(gaussians.device)
    at = gaussians.means.double() @ pose[:3, :3].T + pose[:3, 3]
    depth = at[:, 2]
    ahead = (depth > camera.near) & (depth < camera.far)
    safe = torch.where(ahead, depth, 1.0)
    x, y = (K[axis, axis] * at[:, axis] / safe + K[axis, 2] for axis in (0, 1))
    chosen = ahead & (x >= x0) & (x < x1 + 1) & (y >= y0) & (y < y1 + 1) & gaussians.finite
    if through or not bool(chosen.any()):
        return chosen
    chosen &= gaussians.opacities > 0
    surface = rasterize(gaussians, camera, depth=True).depth
    assert surface is not None
    rows = chosen.nonzero().flatten()
    shown = surface[y[rows].long(), x[rows].long()].double()
    hidden = (shown > 0) & (depth[rows] > shown * (1 + BEHIND))
    chosen[rows[hidden]] = False
    return chosen


def _sorted(corners: tuple[tuple[int, int], tuple[int, int]]) -> tuple[tuple[int, int], tuple[int, int]]:
    (a, b), (c, d) = corners
    return (min(a, c), min(b, d)), (max(a, c), max(b, d))
