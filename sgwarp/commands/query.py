"""`sgwarp query`: where in a view is what a text names?"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from sgwarp.commands.effects import LABELS, say_unused
from sgwarp.commands.inputs_kept import LOG
from sgwarp.commands.options import SemanticsOptions, check_name, find_view, find_views, photograph, place_views
from sgwarp.errors import InputError

if TYPE_CHECKING:
    from sgwarp.querying.scoring import TextScores
    from sgwarp.runs.log import RunLog
    from sgwarp.scene import Semantics


@dataclass(kw_only=True)
class Query(SemanticsOptions):
    """Find what a text names: prints the best pixel of a view, writes a mask and a heat map."""

    views: Path
    """Posed photographs: a folder with transforms.json or a COLMAP model."""

    transform: Path | None = None
    """Where the views lie in another world than the scene: the transform between them, such as the
    dataparser_transforms.json of the trainer that moved the scene."""

    text: str
    """What to look for; for semantics lifted from label images, one of their labels."""

    view: str
    """Name of the view to look at."""

    out: Path
    """Mask to write, .png, 255 on what was found and 0 elsewhere; the heat map {out}_heat.png goes beside it."""

    score: Literal["cosine", "relevancy"] | None = None
    """If not given, what the encoder is calibrated for. relevancy: how much better the text fits than any of
    --canonical."""

    canonical: tuple[str, ...] = ("object", "things", "stuff", "texture")
    """What the text has to beat with --score relevancy."""

    threshold: float = 0.5
    """Pixels of the mask score more than this, where 0 is the scene's median score and 1 its best thousandth."""

    box: int = 9
    """Side of the box over which scores are averaged before the best pixel is taken [pixels]."""

    images: str | None = None
    """Name of a COLMAP model's folder of photographs, if it is not `images` nor the only one that holds them."""

    def written(self) -> Iterator[tuple[str, list[Path]]]:
        heat = self.out.with_name(f"{self.out.stem}_heat.png")
        yield "--out", [self.out, heat, self.out.parent / LOG]

    def run(self) -> None:
        check_name("--out", self.out, ".png")
        if not self.text.strip():
            raise InputError("--text: is empty; say what to look for")
        if not math.isfinite(self.threshold):
            raise InputError(f"--threshold: expected a finite number, got {self.threshold}")
        if self.box < 1:
            raise InputError(f"--box: expected a side of 1 pixel or more, got {self.box}")
        with self.logged(self.out.parent) as log:
            from sgwarp.files.images import write_ids, write_rgb
            from sgwarp.querying.segmentation import localize
            from sgwarp.visualization.pictures import heat_map, mark_pixel

            gaussians, semantics = self.load_both(log)
            if semantics.labels is not None:
                say_unused(self, ("encoder", "templates", "score", "canonical"), LABELS)
            predicted = self.load_predicted(gaussians, log)
            views = find_views(self.views, images=self.images)
            views = [find_view(views, self.view, self.views)]
            (view,) = place_views(gaussians, self.scene, views, self.transform)
            scores = self._scores(semantics, predicted, log)
            with log.stage("splat"):
                (x, y), score_map = localize(
                    scores.values[:, 0], gaussians, view.camera, seen=scores.seen, box=self.box
                )
            mask = score_map > self.threshold
            print(f"{self.text}: best pixel ({x}, {y}), score {score_map[y, x]:.3f}; mask {mask.float().mean():.2%}")
            heat = self.out.with_name(f"{self.out.stem}_heat.png")
            with log.stage("write"):
                picture = heat_map(photograph(gaussians, view), score_map, low=0.0, high=1.0)
                write_ids(self.out, mask.byte().mul(255).cpu())
                write_rgb(heat, mark_pixel(picture, (x, y)))
            log.outputs += [str(self.out), str(heat)]

    def _scores(self, semantics: Semantics, predicted: Semantics | None, log: RunLog) -> TextScores:
        from sgwarp.querying.scoring import score_texts

        encoder = None
        if semantics.labels is None:
            with log.stage("load_encoder"):
                encoder = self.text_encoder(semantics)
        with log.stage("query"):
            return score_texts(
                semantics,
                [self.text],
                encoder,
                measure=self.score,
                canonical=self.canonical,
                predicted=predicted,
                ensemble=self.ensemble,
            )
