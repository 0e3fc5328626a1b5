"""`sgwarp instances`: which object every Gaussian belongs to, from the masks of the views."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from sgwarp.commands.inputs_kept import LOG, keep_maps, keep_photographs
from sgwarp.commands.options import (
    SceneOptions,
    check_folder,
    check_name,
    find_views,
    photograph,
    place_views,
    require_no_lift,
)
from sgwarp.errors import InputError
from sgwarp.runs.progress import show_progress

if TYPE_CHECKING:
    from sgwarp.apps.instances.settings import InstanceSettings
    from sgwarp.runs.log import RunLog
    from sgwarp.scene import Gaussians, InstanceMap, Semantics, View

LISTED = 15  # instances, the largest


@dataclass(kw_only=True)
class Instances(SceneOptions):
    """Find the instances of a scene, or the parts of objects, from masks that need not agree between views."""

    views: Path
    """Posed photographs: a folder with transforms.json or a COLMAP model."""

    transform: Path | None = None
    """Where the views lie in another world than the scene: the transform between them, such as the
    dataparser_transforms.json of the trainer that moved the scene."""

    images: str | None = None
    """Name of a COLMAP model's folder of photographs, if it is not `images` nor the only one that holds them."""

    masks: str
    """Where masks come from: files:DIR (id images), masks:DIR, deva:DIR, graph, sam:PATH, vlpart:DIR, ...;
    `sgwarp encoders` lists all."""

    out: Path
    """Instances file to write, .safetensors; {out}.table.json and run.json go beside it."""

    group: Literal["association", "name"] = "association"
    """association joins masks that show the same Gaussians; name trusts the names or ids of the source: those of a
    video tracker (deva), or the parts that a detector names (vlpart)."""

    levels: str = "default"
    """Levels of the masks, the finest first, such as s,m,l: each is joined on its own, and parts form a tree."""

    least_iou: float = 0.3
    """Share of what two views show that masks must have in common to be joined."""

    least_gaussians: int = 10
    """Instances with fewer Gaussians are dropped."""

    least_confidence: float = 0.55
    """Gaussians whose instance is less sure than this stay undecided."""

    neighbors: int = 8
    """Nearest neighbors that speak for unsure Gaussians; 0 for none."""

    semantics: Path | None = None
    """What `sgwarp lift` wrote for this scene: gives every instance a mean feature, and with --classes a name."""

    classes: str | None = None
    """Names to choose from, separated by commas; needs --semantics."""

    least_cosine: float | None = None
    """Join masks only if their mean features agree this much; needs --semantics."""

    ply: Path | None = None
    """Scene to write with the columns instance, label and confidence, .ply."""

    render_views: Path | None = None
    """Cameras to render id maps from; those of --views if only --render-out is given."""

    render_out: Path | None = None
    """Folder for id maps {stem}.png, 16 bits, 0 = none or undecided, and pictures/{stem}.png with a legend."""

    def written(self) -> Iterator[tuple[str, list[Path]]]:
        yield "--out", [self.out, self.out.with_name(f"{self.out.stem}.table.json"), self.out.parent / LOG]
        if self.ply is not None:
            yield "--ply", [self.ply]

    def run(self) -> None:
        self._check()
        settings = self._settings()
        with self.logged(self.out.parent) as log:
            from sgwarp.apps.instances.finder import find
            from sgwarp.apps.instances.naming import name_instances
            from sgwarp.encoders.registry import make_mask_source
            from sgwarp.io.instances import save_instances, save_table

            gaussians = self.load_scene(log)
            semantics = self._semantics(gaussians, log)
            views = find_views(self.views, images=self.images)
            drawn = self._drawn(views)
            with log.stage("compare"):
                views = place_views(gaussians, self.scene, views, self.transform)
            with log.stage("load_masks"):
                source = make_mask_source(self.masks, views, self.device)
            with show_progress("instances") as progress:
                found, evidence = find(
                    gaussians, views, source, settings, semantics=semantics, progress=progress, log=log
                )
            if self.classes is not None and semantics is not None:
                found = name_instances(found, self._names(), self._text_encoder(semantics))
            if self.group == "name":
                self._measure_consistency(gaussians, views, evidence, found, settings, log)
            notes: dict[str, Any] = {"masks": self.masks, "views": len(views), "group": self.group}
            with log.stage("write"):
                save_instances(found, self.out, notes)
                table = self.out.with_name(f"{self.out.stem}.table.json")
                save_table(found, table)
            log.outputs += [str(self.out), str(table)]
            log.error["instances"] = len(found.table)
            log.error["bytes_per_gaussian"] = self.out.stat().st_size / len(gaussians)
            self._write_scene(gaussians, found, log)
            self._render(gaussians, views if self.render_views is None else drawn, found, log)
            print(listing(found))

    def _check(self) -> None:
        """Refuse what cannot be written or does not go together, before the work is done."""
        check_name("--out", self.out, ".safetensors")
        require_no_lift(self.out)
        if self.ply is not None:
            check_name("--ply", self.ply, ".ply")
        if self.render_views is not None and self.render_out is None:
            raise InputError("--render-views: needs --render-out, the folder for the id maps")
        if self.render_out is not None:
            check_folder("--render-out", self.render_out)
            keep_maps("--render-out", self.render_out, self.masks)
        if self.semantics is None and (self.classes is not None or self.least_cosine is not None):
            raise InputError("--classes and --least-cosine need --semantics, what `sgwarp lift` wrote for this scene")

    def _settings(self) -> InstanceSettings:
        from sgwarp.apps.instances.settings import InstanceSettings

        return InstanceSettings(
            grouping=self.group,
            levels=tuple(level.strip() for level in self.levels.split(",")),
            least_iou=self.least_iou,
            least_cosine=self.least_cosine,
            least_confidence=self.least_confidence,
            least_gaussians=self.least_gaussians,
            neighbors=self.neighbors,
        )

    def _names(self) -> list[str]:
        from sgwarp.commands.segment import class_names

        return class_names(self.classes or "")

    def _semantics(self, gaussians: Gaussians, log: RunLog) -> Semantics | None:
        from sgwarp.commands.options import load_on

        if self.semantics is None:
            return None
        with log.stage("read"):
            return load_on(self.semantics, gaussians)

    def _text_encoder(self, semantics: Semantics) -> Any:
        from sgwarp.encoders.registry import text_encoder_for
        from sgwarp.io.store import read_notes

        assert self.semantics is not None
        return text_encoder_for(semantics.space, read_notes(self.semantics).get("encoder"), self.device)

    def _measure_consistency(
        self,
        gaussians: Gaussians,
        views: list[View],
        evidence: Any,
        found: InstanceMap,
        settings: InstanceSettings,
        log: RunLog,
    ) -> None:
        from sgwarp.apps.instances.view_agreement import consistency

        with log.stage("consistency"):
            before, after = consistency(gaussians, views, evidence, found, settings.raster)
        log.error["consistency_before"], log.error["consistency_after"] = before, after

    def _write_scene(self, gaussians: Gaussians, found: InstanceMap, log: RunLog) -> None:
        if self.ply is None:
            return
        from sgwarp.io.instances import save_instance_scene

        with log.stage("write"):
            save_instance_scene(gaussians.to("cpu"), found, self.ply)
        log.outputs.append(str(self.ply))

    def _drawn(self, views: list[View]) -> list[View]:
        """The views to draw maps of, before the work is done: no map takes the place of a photograph."""
        if self.render_out is None:
            return []
        drawn = views if self.render_views is None else find_views(self.render_views, images=self.images)
        folders = (self.render_out, self.render_out / "pictures")
        maps = (folder / f"{view.stem}.png" for folder in folders for view in drawn)
        keep_photographs("--render-out", maps, [*views, *drawn])
        return drawn

    def _render(self, gaussians: Gaussians, views: list[View], found: InstanceMap, log: RunLog) -> None:
        """Id maps and pictures of the views asked for, or of those that gave the masks."""
        if self.render_out is None:
            return
        import numpy as np

        from sgwarp.apps.instances.maps import draw_ids, render_ids
        from sgwarp.files.images import write_ids, write_rgb

        if len(found.table) > 65535:
            raise InputError(f"--render-out: {len(found.table)} instances do not fit 16-bit images")
        if self.render_views is not None:
            views = place_views(gaussians, self.scene, views, self.transform)
        with show_progress("render") as progress:
            progress(0, len(views), "")
            for done, view in enumerate(views, start=1):
                with log.stage("render_ids"):
                    ids, _ = render_ids(gaussians, found, view.camera)
                path = self.render_out / f"{view.stem}.png"
                picture = self.render_out / "pictures" / f"{view.stem}.png"
                with log.stage("write"):
                    write_ids(path, ids.cpu().numpy().astype(np.uint16))
                    write_rgb(picture, draw_ids(photograph(gaussians, view), ids, found))
                log.outputs += [str(path), str(picture)]
                progress(done, len(views), view.stem)


def listing(found: InstanceMap) -> str:
    """The largest instances, a line each."""
    rows = sorted(found.table, key=lambda row: -row.gaussians)
    lines = [f"{'id':>5} {'Gaussians':>10} {'views':>6} {'sure':>5}  {'size [scene units]':<22} label"]
    for row in rows[:LISTED]:
        size = " x ".join(f"{side:.3g}" for side in row.extent)
        name = row.label + (f" ({row.label_score:.2f})" if row.label else "")
        level = "" if row.level == "default" else f" level {row.level}"
        line = f"{row.id:>5} {row.gaussians:>10,} {row.views:>6} {row.confidence:>5.2f}  {size:<22} {name}{level}"
        lines.append(line.rstrip())
    if len(rows) > LISTED:
        lines.append(f"{len(rows) - LISTED} smaller ones are in the table")
    return "\n".join(lines)
