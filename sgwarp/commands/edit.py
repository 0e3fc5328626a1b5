"""`sgwarp edit`: remove, move, turn, recolor or copy what a text names."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sgwarp.commands.inputs_kept import LOG, keep_photographs
from sgwarp.commands.options import SceneOptions, check_name, find_view, find_views, load_on, place_views
from sgwarp.errors import InputError

if TYPE_CHECKING:
    from sgwarp.apps.editing.picker import EditContext, EditState
    from sgwarp.apps.editing.script import EditStep
    from sgwarp.runs.log import RunLog
    from sgwarp.scene import Gaussians, View


@dataclass(kw_only=True)
class Edit(SceneOptions):
    """Edit a scene by language: select Gaussians, change them, write a new scene with the columns of the old one."""

    out: Path
    """Scene to write, .ply; {out}.ops.json, the steps to replay, and run.json go beside it."""

    select: tuple[str, ...] = ()
    """What to edit, any of: a text, id:3, box:x0,y0,z0,x1,y1,z1, click:VIEW,x,y, copy:1, all."""

    keep: tuple[str, ...] = ()
    """What to leave alone, in the same terms."""

    negatives: tuple[str, ...] = ()
    """Phrases that a Gaussian or instance must fit less than the text."""

    threshold: float = 0.5
    """Least score of a text without instances, where 0 is the scene's median score and 1 its best thousandth; what is
    connected with such Gaussians belongs to them from half of it on. For lifted label images, least share of one."""

    grow: float = 0.0
    """Add what lies within this distance of the selection; negative numbers shrink it [scene units]."""

    clean: bool = True
    """Leave out scattered pieces of the selection."""

    semantics: Path | None = None
    """What `sgwarp lift` wrote for this scene; needed for texts."""

    instances: Path | None = None
    """What `sgwarp instances` wrote for this scene: texts and clicks then select whole instances."""

    encoder: str | None = None
    """Encoder of the phrases; if not given, the one that the semantics were lifted with."""

    remove: bool = False
    """Take the selection away."""

    extract: bool = False
    """Write nothing but the selection."""

    isolate: float | None = None
    """Multiply the opacity of everything else by this."""

    duplicate: tuple[float, float, float] | None = None
    """Add a copy, shifted by this; further operations change the copy."""

    scale: float | None = None
    """Enlarge by this factor about the centroid."""

    rotate: tuple[float, float, float, float] | None = None
    """Axis and angle [degrees] of a turn about the centroid."""

    move: tuple[float, float, float] | None = None
    """Shift by this [scene units]."""

    recolor: str | None = None
    """Color to give, shading kept: a name such as green, #rrggbb, or "r,g,b" from 0 to 1."""

    plain: bool = False
    """Write nothing but the columns of the reference implementation."""

    script: Path | None = None
    """Steps to replay, instead of --select and an operation."""

    undo: int = 0
    """With --script: leave out so many of its last steps."""

    views: Path | None = None
    """Cameras, for click: and for the picture."""

    transform: Path | None = None
    """Where the views lie in another world than the scene: the transform between them, such as the
    dataparser_transforms.json of the trainer that moved the scene."""

    images: str | None = None
    """Name of a COLMAP model's folder of photographs, if it is not `images` nor the only one that holds them."""

    view: str | None = None
    """View to draw before and after from, to {out}.png; needs --views."""

    def written(self) -> Iterator[tuple[str, list[Path]]]:
        beside = [self.out.with_name(f"{self.out.stem}.ops.json"), self.out.parent / LOG]
        yield "--out", [self.out, *beside, *([] if self.view is None else [self.out.with_name(f"{self.out.stem}.png")])]

    def run(self) -> None:
        check_name("--out", self.out, ".ply")
        if self.view is not None and self.views is None:
            raise InputError(f"--view {self.view}: needs --views, the folder that holds it")
        if self.undo and self.script is None:
            raise InputError(f"--undo {self.undo}: needs --script, whose last steps it leaves out")
        if self.encoder is not None and self.semantics is None:
            raise InputError(f"--encoder {self.encoder}: needs --semantics, what `sgwarp lift` wrote for this scene")
        with self.logged(self.out.parent) as log:
            from sgwarp.apps.editing.script import load_script, save_script
            from sgwarp.apps.editing.session import edit

            gaussians = self.load_scene(log)
            steps = self._steps() if self.script is None else self._replayed(load_script(self.script, gaussians))
            context = self._context(gaussians, log)
            drawn = None
            if self.views is not None and self.view is not None:
                drawn = find_view(context.views, self.view, self.views)
                keep_photographs("--out", [self.out.with_name(f"{self.out.stem}.png")], context.views)
            with log.stage("edit"):
                state = edit(gaussians, steps, context)
            columns = None if self.plain else gaussians.extras
            with log.stage("write"):
                script = self.out.with_name(f"{self.out.stem}.ops.json")
                self._write(state, columns)
                save_script(steps, gaussians, script)
            log.outputs += [str(self.out), str(script)]
            self._draw(gaussians, state.gaussians, drawn, log)
            changed = len(gaussians) - len(state.gaussians)
            counted = f"{len(steps)} step" + "s" * (len(steps) != 1)
            print(f"{counted}; {len(gaussians)} Gaussians before, {len(state.gaussians)} after")
            log.leave_out("gaussians_removed", max(changed, 0))

    def _write(self, state: EditState, columns: Mapping[str, Any] | None) -> None:
        """The new scene, with the columns of the old one where the format has room for them."""
        from sgwarp.io.scenes import save_gaussians

        rows = state.rows.cpu().numpy()
        extras = {name: column[rows] for name, column in columns.items()} if columns else None
        save_gaussians(replace(state.gaussians.to("cpu"), extras=extras), self.out)

    def _replayed(self, steps: tuple[EditStep, ...]) -> tuple[EditStep, ...]:
        if self.select or self._operations():
            raise InputError("--script: already says what to do; leave out --select and the operations")
        for name in ("keep", "negatives", "threshold", "grow", "clean"):
            if getattr(self, name) != getattr(type(self), name):
                option = "--no-clean" if name == "clean" else f"--{name}"
                raise InputError(f"{option}: goes with --select; a script says for each step what it is applied to")
        if not 0 <= self.undo < len(steps):
            raise InputError(
                f"--undo {self.undo}: {self.script} has {len(steps)} steps; leave at least one, before it the scene is "
                f"{self.scene}"
            )
        return steps[: len(steps) - self.undo]

    def _steps(self) -> tuple[EditStep, ...]:
        """One step for each operation asked for, all of them applied to the same Gaussians."""
        from sgwarp.apps.editing.script import EditStep
        from sgwarp.apps.editing.selection import Selection

        operations = self._operations()
        if not self.select or not operations:
            names = "--remove, --extract, --isolate, --duplicate, --scale, --rotate, --move, --recolor"
            raise InputError(f"give --select and at least one of {names}, or --script")
        selection = Selection(
            self.select, self.keep, self.negatives, threshold=self.threshold, grow=self.grow, clean=self.clean
        )
        again = Selection(("last",), clean=False)
        return tuple(EditStep(again if number else selection, operation) for number, operation in enumerate(operations))

    def _operations(self) -> list[Any]:
        """The operations asked for, in the order in which they make sense together."""
        from sgwarp.apps.editing import operations as ops

        found: list[Any] = []
        if self.duplicate is not None:  # the others then change the copy
            found.append(ops.Duplicate(self.duplicate))
        if self.scale is not None:
            found.append(ops.Scale(self.scale))
        if self.rotate is not None:
            found.append(ops.Rotate(self.rotate[:3], self.rotate[3]))
        if self.recolor is not None:
            found.append(ops.Recolor(ops.parse_color(self.recolor)))
        if self.move is not None:
            found.append(ops.Move(self.move))
        if self.isolate is not None:
            found.append(ops.Isolate(self.isolate))
        if self.extract:
            found.append(ops.Extract())
        if self.remove:
            if found:
                raise InputError("--remove: leaves nothing that another operation could change; give it alone")
            found.append(ops.Remove())
        return found

    def _context(self, gaussians: Gaussians, log: RunLog) -> EditContext:
        from sgwarp.apps.editing.picker import EditContext
        from sgwarp.io.instances import load_instances

        semantics, encoder, instances = None, None, None
        with log.stage("read"):
            if self.semantics is not None:
                semantics = load_on(self.semantics, gaussians)
            if self.instances is not None:
                instances = load_instances(self.instances, gaussians)
            views = self._views(gaussians)
        if semantics is not None and semantics.labels is None:
            from sgwarp.encoders.registry import text_encoder_for
            from sgwarp.io.store import read_notes

            assert self.semantics is not None
            with log.stage("load_encoder"):
                name = self.encoder or read_notes(self.semantics).get("encoder")
                encoder = text_encoder_for(semantics.space, name, self.device)
        return EditContext(semantics, encoder, instances, views)

    def _views(self, gaussians: Gaussians) -> Sequence[View]:
        """Views in the world of the scene, for clicks and the picture."""
        if self.views is None:
            return ()
        return place_views(gaussians, self.scene, find_views(self.views, images=self.images), self.transform)

    def _draw(self, before: Gaussians, after: Gaussians, view: View | None, log: RunLog) -> None:
        """The view before and after, side by side."""
        if view is None:
            return
        import torch

        from sgwarp.files.images import write_rgb
        from sgwarp.rendering.renderer import render

        picture = self.out.with_name(f"{self.out.stem}.png")
        with log.stage("draw"):
            pair = [render(scene, view.camera).clamp(0, 1).cpu() for scene in (before, after)]
            write_rgb(picture, torch.cat(pair, dim=1))
        log.outputs.append(str(picture))
