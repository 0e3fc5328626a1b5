"""Instances of a scene from the masks of its views."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from sgwarp.apps.instances.association import build_graph, join_masks, name_groups
from sgwarp.apps.instances.counts import best_candidates, count_groups, drop_small, refine
from sgwarp.apps.instances.description import GroupFacts, describe, find_doubts
from sgwarp.apps.instances.evidence import ViewEvidence, gather_evidence
from sgwarp.apps.instances.settings import InstanceSettings
from sgwarp.encoders.masks.sources import MaskSource
from sgwarp.encoders.registry import make_mask_source
from sgwarp.errors import InputError
from sgwarp.runs.log import RunLog
from sgwarp.runs.progress import Report
from sgwarp.scene import Gaussians, Instance, InstanceMap, Semantics, View

CHUNK = 65536  # Gaussians whose features are widened at a time


def instances(
    gaussians: Gaussians,
    views: Sequence[View],
    masks: MaskSource | str,
    settings: InstanceSettings | None = None,
    *,
    semantics: Semantics | None = None,
    progress: Report | None = None,
    log: RunLog | None = None,
) -> InstanceMap:
    """Join the masks of all views into instances and assign the Gaussians to them, without training.

    Args:
        gaussians: The scene.
        views: Posed views; those without masks are skipped.
        masks: Source of masks, or its name: "files:DIR", "masks:DIR", "graph", "sam:PATH", "vlpart:DIR", ...
        settings: Knobs.
        semantics: Lifted features of the scene, for the mean feature of each instance and for `least_cosine`.
        progress: Called as `progress(done, total, stem)`.
        log: Receives stage times and the error figures `undecided` and `nothing`, shares of the Gaussians.

    Returns:
        The instances, on the CPU.

    Raises:
        InputError: The scene or the views are empty, no view has a mask or sees a Gaussian, semantics of another scene,
            or names are asked for where the source has none.
    """
    return find(gaussians, views, masks, settings, semantics=semantics, progress=progress, log=log)[0]


def find(
    gaussians: Gaussians,
    views: Sequence[View],
    masks: MaskSource | str,
    settings: InstanceSettings | None = None,
    *,
    semantics: Semantics | None = None,
    progress: Report | None = None,
    log: RunLog | None = None,
) -> tuple[InstanceMap, list[ViewEvidence]]:
    """As `instances`, with the evidence behind it."""
    settings = settings or InstanceSettings()
    log = log if log is not None else RunLog(device=str(gaussians.device))
    if not len(gaussians) or not views:
        raise InputError("instances need a scene with Gaussians and at least one view")
    _require_scipy()
    if semantics is not None:
        semantics.require_scene(gaussians)
    if settings.least_cosine is not None and (semantics is None or semantics.labels is not None):
        raise InputError("least_cosine: compares lifted features; give semantics in an embedding space")
    source = make_mask_source(masks, views, gaussians.device) if isinstance(masks, str) else masks
    report = progress or (lambda done, total, stem: None)
    evidence = gather_evidence(gaussians, views, source, settings.raster, log, report)
    if settings.grouping == "name" and not all(view.names or not len(view.ranks) for view in evidence):
        raise InputError("grouping 'name': this source of masks gives no names; use 'association'")
    found = join_evidence(gaussians, evidence, settings, semantics, log)
    ids = found.instance()
    log.error["undecided"] = float((ids < 0).float().mean())
    log.error["nothing"] = float((ids == 0).float().mean())
    return found, evidence


def join_evidence(
    gaussians: Gaussians,
    evidence: Sequence[ViewEvidence],
    settings: InstanceSettings,
    semantics: Semantics | None = None,
    log: RunLog | None = None,
) -> InstanceMap:
    """Instances from evidence that was gathered before, so that other settings need no second pass over the views.

    Raises:
        InputError: No instance is left.
    """
    log = log if log is not None else RunLog()
    levels = [_find_level(gaussians, evidence, level, settings, semantics, log) for level in settings.levels]
    table: list[Instance] = []
    candidates = []
    for name, level in zip(settings.levels, levels, strict=True):
        shift = np.where(level.candidates > 0, len(table), 0).astype(np.int32)
        candidates.append(level.candidates + shift)
        table += [_blank(len(table) + number + 1, name) for number in range(len(level.facts.masks))]
    if not table:
        raise InputError(f"no instance of {settings.least_gaussians} Gaussians or more; the masks agree in nothing")
    found = InstanceMap(
        candidates=torch.from_numpy(np.stack(candidates)),
        shares=_as_stored(np.stack([level.shares for level in levels])),
        observations=_as_stored(np.max([level.observations for level in levels], axis=0)),
        table=tuple(table),
        levels=settings.levels,
        fingerprint=gaussians.fingerprint,
        least_confidence=settings.least_confidence,
    )
    with log.stage("describe"):
        facts = [level.facts for level in levels]
        rows = describe(gaussians, found, facts)
        features = None if semantics is None else mean_features(found, semantics)
        rows = tuple(find_doubts(rows, facts, features))
    space = "" if semantics is None else semantics.space
    return replace(found, table=rows, features=features, space=space)


def mean_features(found: InstanceMap, semantics: Semantics) -> torch.Tensor:
    """Mean lifted feature of each instance's Gaussians, weighted with the confidence, float32 [K, C]."""
    sums = torch.zeros(len(found.table) + 1, semantics.features.shape[1])
    weights = torch.zeros(len(found.table) + 1)
    seen = semantics.seen.cpu()
    for level in found.levels:
        ids, sure = found.instance(level).clamp(min=0), found.confidence(level)
        sure = torch.where(seen & (ids > 0), sure, 0.0)
        for start in range(0, len(ids), CHUNK):
            part = slice(start, start + CHUNK)
            rows = semantics.features[part].cpu().to(torch.float32)
            sums.index_add_(0, ids[part], rows * sure[part, None])
            weights.index_add_(0, ids[part], sure[part])
    return sums[1:] / weights[1:].clamp(min=1e-12)[:, None]


@dataclass(frozen=True, eq=False)
class _Level:
    candidates: NDArray[np.int32]
    shares: NDArray[np.float32]
    observations: NDArray[np.float32]
    facts: GroupFacts


def _find_level(
    gaussians: Gaussians,
    evidence: Sequence[ViewEvidence],
    level: str,
    settings: InstanceSettings,
    semantics: Semantics | None,
    log: RunLog,
) -> _Level:
    count = len(gaussians)
    if not sum(len(view.masks_of(level)) for view in evidence):
        raise InputError(f"level '{level}': the source has no mask of it; SAM and three scales of graph have s, m, l")
    features = None
    if settings.least_cosine is not None and semantics is not None:
        features = semantics.features.to(torch.float32).cpu().numpy()
    with log.stage("associate"):
        names: tuple[str, ...] = ()
        graph = build_graph(evidence, level, count, settings, features)
        if settings.grouping == "name":
            groups, names = name_groups(evidence, level)
        else:
            groups = join_masks(graph, settings)
    with log.stage("count"):
        counts = count_groups(evidence, level, groups, count, settings.pixel_weight)
        if settings.neighbors:
            means, scales = (tensor.cpu().numpy() for tensor in (gaussians.means, gaussians.scales))
            counts = refine(counts, means, scales, settings.neighbors)
        columns, shares, observations = best_candidates(counts, settings.candidates)
        candidates, kept = drop_small(columns, shares, observations, counts.shape[1] - 1, settings)
    facts = _facts(evidence, level, groups, kept, graph.view_of, graph.visible, names)
    return _Level(candidates, shares, observations, facts)


def _facts(
    evidence: Sequence[ViewEvidence],
    level: str,
    groups: NDArray[np.int64],
    kept: NDArray[np.int64],
    view_of: NDArray[np.int64],
    visible: NDArray[np.float64],
    names: tuple[str, ...],
) -> GroupFacts:
    """Facts of the groups that became instances."""
    place = np.full(int(groups.max()) + 1, -1)
    place[kept] = np.arange(len(kept))
    of_mask = place[groups]
    used = np.flatnonzero(of_mask >= 0)
    shows = np.zeros((len(kept), visible.shape[1]), bool)
    shows[of_mask[used], view_of[used]] = True
    mass = np.zeros((len(kept), visible.shape[1]))
    np.add.at(mass, of_mask[used], visible[used])
    own = np.zeros(len(kept))
    np.add.at(own, of_mask[used], visible[used, view_of[used]])
    masks = np.bincount(of_mask[used], minlength=len(kept))
    # A view compares two instances if it has a mask of one and shows a tenth of a mask of the other.
    reach = mass >= 0.1 * own[:, None]
    compared = shows @ reach.T  # of booleans: whether some view does
    compared = compared | compared.T
    together = shows @ shows.T
    if names:
        called, sure = [names[group] for group in kept], [1.0] * len(kept)
    else:
        called, sure = _called(evidence, level, of_mask, len(kept))
    return GroupFacts(masks, shows.sum(axis=1), together, compared, tuple(called), np.array(sure))


def _called(
    evidence: Sequence[ViewEvidence], level: str, of_mask: NDArray[np.int64], count: int
) -> tuple[list[str], list[float]]:
    """The name that most masks of each instance bear, and the share that do; numbers are no names."""
    votes: list[Counter[str]] = [Counter() for _ in range(count)]
    first = 0
    for view in evidence:
        for mask in view.masks_of(level):
            if of_mask[first] >= 0 and view.names and not view.names[mask].isdecimal():
                votes[of_mask[first]][view.names[mask]] += 1
            first += 1
    best = [min(vote.items(), key=lambda item: (-item[1], item[0])) if vote else ("", 0) for vote in votes]
    shares = [hits / max(1, vote.total()) for (_, hits), vote in zip(best, votes, strict=True)]
    return [name for name, _ in best], shares


def _as_stored(values: NDArray[np.float32]) -> torch.Tensor:
    """Rounded as files hold them, so that a file says the same as what it was written from."""
    return torch.from_numpy(values).half().float()


def _blank(number: int, level: str) -> Instance:
    zero = (0.0, 0.0, 0.0)
    return Instance(number, level, 0, 0, 0, 0, 0.0, zero, (1.0, 0.0, 0.0, 0.0), zero)


def _require_scipy() -> None:
    try:
        import scipy  # noqa: F401
    except ImportError:
        raise InputError("instances need scipy; run: pip install 'sgwarp[apps]'") from None
