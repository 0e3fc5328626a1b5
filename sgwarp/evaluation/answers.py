"""Answers of a case in a view: classes, and relevancy of phrases by level.

They come from the scene, or for the method that lifts nothing from the view's own 2D map.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.evaluation.cases import Case, named_labels
from sgwarp.querying.ensembles import score_together, seen_by
from sgwarp.querying.scores import class_votes, relevancy
from sgwarp.querying.segmentation import segment_votes, splat_scores
from sgwarp.rendering.renderer import render
from sgwarp.scene import FeatureMap, Semantics, View


class Answers:
    """What a case says; votes and scores of the Gaussians are made once for all views."""

    def __init__(self, case: Case) -> None:
        self.case = case
        self._votes: tuple[tuple[str, ...], Tensor] | None = None
        self._scores: tuple[tuple[str, ...], list[Tensor]] | None = None

    def labels(self, view: View, classes: Sequence[str]) -> Tensor:
        """Index into the classes at every pixel, -1 where unknown, int64 [H, W]."""
        case = self.case
        if not case.semantics:
            with case.log.stage("answer"):
                return self._labels_of_map(view, tuple(classes))
        first = case.semantics[0]
        asked = askable(first, classes)
        if self._votes is None or self._votes[0] != tuple(asked):
            with case.log.stage("query"):
                options = {"predicted": case.predicted, "ensemble": case.settings.ensemble}
                votes = class_votes(first, asked, case.text, scoring=case.settings.scoring, **options)  # type: ignore[arg-type]
                self._votes = tuple(asked), votes
        with case.log.stage("answer"):
            seen = seen_by(first, case.predicted, case.settings.ensemble)
            channel = segment_votes(case.gaussians, view.camera, self._votes[1], seen)[0].cpu()
        return torch.tensor([*(list(classes).index(name) for name in asked), -1])[channel]

    def relevancy(self, view: View, texts: Sequence[str], among: Sequence[str] | None = None) -> Tensor:
        """Relevancy of phrases by level, 0 where nothing is known, float32 [L, Q, H, W].

        Args:
            view: The view.
            texts: Q phrases.
            among: All phrases that the scene will be asked, so that Gaussians are scored once; `texts` if None.
        """
        case, every = self.case, tuple(among or texts)
        if not case.semantics:
            with case.log.stage("answer"):
                return torch.cat([self._relevancy_of_map(source, view, texts) for source in case.sources])
        if self._scores is None or self._scores[0] != every:
            with case.log.stage("query"):
                self._scores = every, [self._score(one, every) for one in case.semantics]
        columns = [every.index(text) for text in texts]
        with case.log.stage("answer"):
            maps = []
            for one, scores in zip(case.semantics, self._scores[1], strict=True):
                seen = seen_by(one, case.predicted, case.settings.ensemble)
                mean, known = splat_scores(case.gaussians, view.camera, scores[:, columns], seen)
                maps.append(torch.where(known[..., None], mean, 0.0).permute(2, 0, 1).cpu())
            return torch.stack(maps)

    def _score(self, semantics: Semantics, texts: Sequence[str]) -> Tensor:
        if semantics.labels is not None:
            return class_votes(semantics, texts, predicted=self.case.predicted, ensemble=self.case.settings.ensemble)
        encoder = self.case.text
        assert encoder is not None
        return score_together(
            lambda one: relevancy(one, texts, encoder), semantics, self.case.predicted, self.case.settings.ensemble
        )

    def _map(self, source: object, view: View) -> FeatureMap:
        from sgwarp.encoders.base import MapSource

        assert isinstance(source, MapSource)
        image = None
        if source.needs_image:
            rendered = view.image_path is None
            image = render(self.case.gaussians, view.camera).clamp(0, 1).cpu() if rendered else view.image()
        with self.case.log.stage("encode"):
            return source.encode(view, image)

    def _labels_of_map(self, view: View, classes: tuple[str, ...]) -> Tensor:
        found = self._map(self.case.sources[0], view)
        if found.labels is not None and found.ids is not None:
            names = named_labels(found.labels, self.case.scene.classes)
            place = torch.tensor([*(classes.index(name) if name in classes else -1 for name in names), -1])
            return _resized(place[found.ids[0].long()], view)
        rows, ids = _as_semantics(found)
        votes = class_votes(rows, classes, self.case.text, scoring=self.case.settings.scoring).cpu()
        shares = torch.cat([votes, torch.zeros_like(votes[:1])])[ids]  # the last row is id -1
        shares = shares.sum(dim=0) / (ids >= 0).sum(dim=0).clamp(min=1)[..., None]
        best, channel = shares.max(dim=2)
        return _resized(torch.where((best > 0) & (best >= 1.0 - shares.sum(dim=2)), channel, -1), view)

    def _relevancy_of_map(self, source: object, view: View, texts: Sequence[str]) -> Tensor:
        found = self._map(source, view)
        if found.labels is not None and found.ids is not None:
            index = torch.tensor([found.labels.index(text) if text in found.labels else -2 for text in texts])
            maps = (found.ids[:, None] == index[None, :, None, None]).float()
        else:
            if self.case.text is None:
                raise InputError(f"space '{found.space}' has no text encoder here; labels are asked by name")
            rows, ids = _as_semantics(found)
            table = relevancy(rows, texts, self.case.text).cpu()
            maps = torch.cat([table, torch.zeros_like(table[:1])])[ids].permute(0, 3, 1, 2)
        return torch.nn.functional.interpolate(maps, view.camera.size, mode="bilinear")


def askable(semantics: Semantics, classes: Sequence[str]) -> list[str]:
    """The classes that can be asked: of lifted labels those that some view showed, else all.

    Raises:
        InputError: None can.
    """
    asked = [name for name in classes if semantics.labels is None or name in semantics.labels]
    if not asked:
        there = ", ".join(semantics.labels or ())
        raise InputError(f"none of the classes ({', '.join(classes[:3])}, ..) is among the lifted labels: {there}")
    return asked


def _as_semantics(found: FeatureMap) -> tuple[Semantics, Tensor]:
    """The vectors of a map as if each were a Gaussian's, and which one each pixel has, -1 = none, int64 [L, h, w]."""
    if found.dense is not None:
        height, width = found.size
        ids = torch.arange(height * width).view(1, height, width)
        ids = ids if found.valid is None else torch.where(found.valid.cpu(), ids, -1)
        rows = found.dense.reshape(height * width, -1).float().cpu()
    else:
        assert found.ids is not None
        assert found.vectors is not None
        rows, ids = found.vectors.cpu(), found.ids.long().cpu()
    weight = torch.zeros(len(rows))
    weight[ids[ids >= 0]] = 1.0
    return Semantics(rows, weight, weight.clone(), found.space, "one view"), ids


def _resized(labels: Tensor, view: View) -> Tensor:
    from sgwarp.datasets.base import resize_nearest

    return resize_nearest(labels, view.camera.size)
