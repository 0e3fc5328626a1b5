"""`sgwarp segment`: a class for every pixel of the views."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from sgwarp.commands.effects import LABELS, say_unused
from sgwarp.commands.inputs_kept import LOG, keep_maps, keep_photographs
from sgwarp.commands.options import SemanticsOptions, check_folder, find_views, photograph, place_views
from sgwarp.errors import InputError
from sgwarp.runs.progress import show_progress

if TYPE_CHECKING:
    from torch import Tensor

    from sgwarp.encoders.base import TextEncoder
    from sgwarp.runs.log import RunLog
    from sgwarp.scene import Semantics, View


@dataclass(kw_only=True)
class Segment(SemanticsOptions):
    """Write label images of the views, and the same in colour over the photographs."""

    views: Path
    """Posed photographs: a folder with transforms.json or a COLMAP model."""

    transform: Path | None = None
    """Where the views lie in another world than the scene: the transform between them, such as the
    dataparser_transforms.json of the trainer that moved the scene."""

    out: Path
    """Folder for {stem}.png, the index in the list of classes per pixel, 255 where unknown; and overlays/{stem}.png."""

    classes: str | None = None
    """Names separated by commas: "couch,potted plant,floor". Semantics lifted from label or id images need none: the
    pixels then hold the ids of those images, 0 where unknown."""

    view: str | None = None
    """Only the view of this name."""

    scoring: Literal["evidence", "cosine", "relevancy"] | None = None
    """How a class is chosen; if not given, what the encoder is calibrated for. "cosine" gives every pixel one of the
    classes, so name all; "evidence" and "relevancy" leave what fits none of them unknown."""

    temperature: float | None = None
    """Temperature of the softmax over the classes, per Gaussian; the encoder's own if not given."""

    unknown_below: float = 0.0
    """Pixels whose best class has a smaller confidence are unknown, 0 to 1."""

    images: str | None = None
    """Name of a COLMAP model's folder of photographs, if it is not `images` nor the only one that holds them."""

    def written(self) -> Iterator[tuple[str, list[Path]]]:
        yield "--out", [self.out / LOG]

    def run(self) -> None:
        check_folder("--out", self.out)
        if not 0.0 <= self.unknown_below <= 1.0:
            raise InputError(f"--unknown-below: expected a confidence from 0 to 1, got {self.unknown_below}")
        classes = None if self.classes is None else class_names(self.classes)
        with self.logged(self.out) as log:
            from sgwarp.querying.ensembles import seen_by
            from sgwarp.querying.scores import class_votes
            from sgwarp.querying.segmentation import segment_votes

            gaussians, semantics = self.load_both(log)
            if semantics.labels is not None and classes is not None:
                say_unused(self, ("encoder", "templates", "scoring", "temperature"), LABELS)
            predicted = self.load_predicted(gaussians, log)
            views = find_views(self.views, self.view, images=self.images)
            self._keep_inputs(views)
            views = place_views(gaussians, self.scene, views, self.transform)
            encoder = None
            if classes is not None and semantics.labels is None:
                with log.stage("load_encoder"):
                    encoder = self.text_encoder(semantics)
                self._warn(classes, encoder, log)
            with log.stage("query"):
                scoring = (self.temperature, self.scoring)
                votes = class_votes(semantics, classes, encoder, *scoring, predicted=predicted, ensemble=self.ensemble)
                seen = seen_by(semantics, predicted, self.ensemble)
            lifted = semantics if classes is None else None
            unknown = 0.0
            with show_progress("segment") as progress:
                progress(0, len(views), "")
                for done, view in enumerate(views, start=1):
                    with log.stage("segment"):
                        channel, _ = segment_votes(
                            gaussians, view.camera, votes, seen, unknown_below=self.unknown_below
                        )
                    with log.stage("write"):
                        log.outputs += self._write(view, photograph(gaussians, view), channel.cpu(), classes, lifted)
                    unknown += float((channel < 0).float().mean())
                    progress(done, len(views), view.stem)
            log.error["unknown"] = unknown / len(views)

    def _keep_inputs(self, views: list[View]) -> None:
        """No label image takes the place of a photograph, or of a label image that the semantics were lifted from."""
        from sgwarp.io.store import read_notes

        keep_maps("--out", self.out, read_notes(self.semantics).get("encoder"))
        folders = (self.out, self.out / "overlays")
        keep_photographs("--out", (folder / f"{view.stem}.png" for folder in folders for view in views), views)

    def _warn(self, classes: list[str], encoder: TextEncoder, log: RunLog) -> None:
        """Say which classes the encoder cannot tell, unless another scoring is asked for, which asks it anyway."""
        from sgwarp.querying.scoring import without_counterpart

        foreign = without_counterpart(classes, encoder) if self.scoring in (None, "evidence") else []
        if foreign:
            print(f"the encoder knows nothing like {', '.join(foreign)}: what they name stays unknown")
            log.leave_out("classes_without_counterpart", len(foreign))

    def _write(
        self, view: View, image: Tensor, channel: Tensor, classes: list[str] | None, lifted: Semantics | None
    ) -> list[str]:
        """Label image and overlay of one view; returns their paths."""
        import numpy as np

        from sgwarp.files.images import write_ids, write_rgb
        from sgwarp.querying.segmentation import label_image
        from sgwarp.visualization.pictures import class_colours, overlay, with_legend

        labels = label_image(channel, lifted).numpy()
        path = self.out / f"{view.stem}.png"
        if labels.max() > 65535:
            raise InputError(f"view {view.stem}: id {labels.max()} does not fit a 16-bit image")
        write_ids(path, labels.astype(np.uint8 if labels.max() <= 255 else np.uint16))
        names = classes or list(lifted.labels or () if lifted else ())
        colours = class_colours(len(names))
        picture = overlay(image, channel, colours)
        if classes is not None:
            picture = with_legend(picture, classes, colours)
        picture_path = self.out / "overlays" / f"{view.stem}.png"
        write_rgb(picture_path, picture)
        return [str(path), str(picture_path)]


def class_names(text: str, option: str = "--classes") -> list[str]:
    """The names between the commas.

    Raises:
        InputError: A name is empty or stands twice.
    """
    names = [name.strip() for name in text.split(",")]
    if not all(names):
        raise InputError(f"{option} {text!r}: name {names.index('') + 1} is empty")
    twice = [name for name in names if names.count(name) > 1]
    if twice:
        raise InputError(f"{option} {text!r}: '{twice[0]}' stands there twice")
    return names
