"""`sgwarp report`: error against run time, knob by knob, and stability at the extremes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from sgwarp.commands.inputs_kept import LOG
from sgwarp.commands.options import SceneOptions, check_folder, find_views, place_views


@dataclass(kw_only=True)
class Report(SceneOptions):
    """Turn every knob on a scene, measure run time and error side by side, and check the extreme scenes."""

    views: Path
    """Posed photographs: a folder with transforms.json or a COLMAP model."""

    transform: Path | None = None
    """Where the views lie in another world than the scene: the transform between them, such as the
    dataparser_transforms.json of the trainer that moved the scene."""

    images: str | None = None
    """Name of a COLMAP model's folder of photographs, if it is not `images` nor the only one that holds them."""

    out: Path
    """Folder for report.md, report.json and the plot."""

    labels: Path | None = None
    """Folder of label images {stem}.png; with it, lifting is measured too, by mIoU on the held-out views."""

    held_out: int = 2
    """Views, evenly spread, that are measured on and not lifted from."""

    patches: int = 60
    """Patches of 16 x 16 pixels of each held-out view that the float64 oracle composites."""

    repeats: int = 5
    """Runs of which the median time is taken."""

    seed: int = 0
    """Seed of the patches and of the random share of Gaussians."""

    extremes: bool = True
    """Off: leave the extreme scenes out; they do not depend on the scene."""

    def written(self) -> Iterator[tuple[str, list[Path]]]:
        from sgwarp.evaluation.report.page import PLOT

        yield "--out", [self.out / name for name in ("report.md", "report.json", PLOT, LOG)]

    def run(self) -> None:
        check_folder("--out", self.out)
        with self.logged(self.out) as log:
            from sgwarp.evaluation.report.extremes import EXTREMES
            from sgwarp.evaluation.report.run import make_report

            gaussians = self.load_scene(log)
            make_report(
                gaussians,
                place_views(gaussians, self.scene, find_views(self.views, images=self.images), self.transform),
                self.out,
                self.scene.name.split(".")[0],
                labels=self.labels,
                held_out=self.held_out,
                patches=self.patches,
                repeats=self.repeats,
                seed=self.seed,
                extremes=tuple(EXTREMES) if self.extremes else (),
                log=log,
            )
