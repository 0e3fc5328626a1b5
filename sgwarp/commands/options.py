"""Options that every command takes, and how it starts and ends."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from sgwarp.errors import InputError
from sgwarp.runs.log import RunLog
from sgwarp.runs.progress import show_progress

if TYPE_CHECKING:
    from torch import Tensor

    from sgwarp.encoders.base import TextEncoder
    from sgwarp.scene import Gaussians, Semantics, View


@dataclass(kw_only=True)
class Options:
    device: str = "cpu"
    """Where to compute: cpu, cuda (its current device) or cuda:N."""

    threads: int | None = None
    """Host threads on the CPU; all cores if not given."""

    command_line: tyro.conf.Suppress[str] = field(default="", repr=False)

    def written(self) -> Iterator[tuple[str, list[Path]]]:
        """Options that name outputs, each with its files, as far as these are known before anything is read.

        A command with such an option says so itself; `inputs_kept.guarded` asks.
        """
        yield from ()

    @contextmanager
    def logged(self, folder: Path) -> Iterator[RunLog]:
        """Yield the log of this run. If the block succeeds, `run.json` goes into `folder`, and to stdout two lines:
        times and figures, and where the results lie."""
        log = self.start()
        yield log
        log.write(folder)
        print(log.summary())
        if log.where():
            print(log.where())

    def start(self) -> RunLog:
        """Set the threads and the device.

        Raises:
            InputError: There is no such device, or the number of threads is not positive.
        """
        import torch

        from sgwarp.ops.devices import find_device
        from sgwarp.ops.launcher import MAX_THREADS, get_threads, set_threads

        if self.threads is not None:
            if not 1 <= self.threads <= MAX_THREADS:
                raise InputError(f"--threads: expected 1 to {MAX_THREADS}, got {self.threads}")
            set_threads(self.threads)
            torch.set_num_threads(self.threads)
        try:
            find_device(self.device)
        except InputError as error:
            raise InputError(f"--{error}") from None
        return RunLog(command=self.command_line, device=self.device, threads=get_threads(), show=show_progress)


@dataclass(kw_only=True)
class SceneOptions(Options):
    scene: tyro.conf.Positional[Path]
    """The trained scene: .ply, .spz, .splat, .glb or .sog."""

    axes: str | None = None
    """Directions of the scene file's axes x, y, z, such as rdf or rub; if not given, what its format says: rdf for
    .ply, .splat and .sog, rub for .spz, luf for .glb."""

    def load_scene(self, log: RunLog) -> Gaussians:
        """The scene on the chosen device.

        Raises:
            InputError: It cannot be read, or is empty.
        """
        from sgwarp.io.scenes import load_gaussians

        with log.stage("read"):
            gaussians = load_gaussians(self.scene, self.axes).to(self.device)
        if not len(gaussians):
            raise InputError(f"{self.scene}: holds no Gaussians")
        return gaussians


@dataclass(kw_only=True)
class SemanticsOptions(SceneOptions):
    semantics: Path
    """What `sgwarp lift` wrote for this scene."""

    encoder: str | None = None
    """Encoder of the phrases; if not given, the one that the semantics were lifted with."""

    templates: tuple[str, ...] = ()
    """What phrases are put into, such as "a photo of a {}", or plain, photo, room; the encoder's own if not given."""

    min_weight: float = 0.0
    """Ignore Gaussians with a smaller weight, as if no view had seen them; a pixel that one fills alone weighs 1."""

    predicted: Path | None = None
    """What `sgwarp predict` wrote for this scene; it is then asked together with the lifted semantics."""

    ensemble: Literal["2d", "3d", "max", "sum", "mean"] = "max"
    """How the scores of the lifted (2d) and the predicted (3d) semantics become one; where only one of them has
    features of a Gaussian, its score is taken."""

    def text_encoder(self, semantics: Semantics) -> TextEncoder:
        """The encoder of phrases in the space of the semantics.

        Raises:
            InputError: There is none, or it speaks another space.
        """
        from sgwarp.encoders.registry import text_encoder_for
        from sgwarp.io.store import read_notes

        name = self.encoder or read_notes(self.semantics).get("encoder")
        return text_encoder_for(semantics.space, name, self.device, self.templates or None)

    def load_both(self, log: RunLog) -> tuple[Gaussians, Semantics]:
        """The scene and its semantics on the chosen device.

        Raises:
            InputError: One of them cannot be read, or they do not belong together.
        """
        gaussians = self.load_scene(log)
        with log.stage("read"):
            semantics = load_on(self.semantics, gaussians).without_faint(self.min_weight)
        if not bool(semantics.seen.any()):
            raise InputError(f"--min-weight {self.min_weight:g}: no Gaussian has as much; choose less")
        return gaussians, semantics

    def load_predicted(self, gaussians: Gaussians, log: RunLog) -> Semantics | None:
        """The predicted semantics on the chosen device, None if they were not given or are not asked.

        Raises:
            InputError: They cannot be read or belong to another scene, or the ensemble needs them and has none.
        """
        if self.predicted is None:
            if self.ensemble == "3d":
                raise InputError("--ensemble 3d: needs --predicted, what `sgwarp predict` wrote for this scene")
            return None
        if self.ensemble == "2d":
            log.leave_out("predicted_semantics")
            return None
        with log.stage("read"):
            return load_on(self.predicted, gaussians)


def load_on(path: Path, gaussians: Gaussians) -> Semantics:
    """Semantics of a scene, on its device.

    Raises:
        InputError: They cannot be read, or belong to another scene.
    """
    from dataclasses import replace

    from sgwarp.io.store import load_semantics

    semantics = load_semantics(path, gaussians)
    names = ("features", "weight", "effective_views")
    return replace(semantics, **{name: getattr(semantics, name).to(gaussians.device) for name in names})


def find_views(
    folder: Path, stem: str | None = None, photographs: bool = True, images: str | None = None
) -> list[View]:
    """All views of a folder, or the one named `stem`; `images` names a COLMAP model's folder of photographs.

    Raises:
        InputError: The folder holds no views, or none of that name.
    """
    from sgwarp.io.views import load_views

    views = load_views(folder, images, photographs)
    return views if stem is None else [find_view(views, stem, folder)]


def find_view(views: Sequence[View], stem: str, folder: Path) -> View:
    """The view of a folder that is named `stem`.

    Raises:
        InputError: There is none of that name.
    """
    chosen = next((view for view in views if view.stem == stem), None)
    if chosen is None:
        some = ", ".join(view.stem for view in views[:5])
        raise InputError(f"{folder}: has no view '{stem}'; its {len(views)} views are named {some}, ...")
    return chosen


def place_views(gaussians: Gaussians, scene: Path, views: list[View], transform: Path | None) -> list[View]:
    """The views in the world of the scene; says so where their photographs do not match it.

    Raises:
        InputError: The transform cannot be read.
    """
    from sgwarp.io.world_transforms import moved_views
    from sgwarp.rendering.agreement import find_placement
    from sgwarp.scene.extent import with_near_plane_of

    views = with_near_plane_of(views, gaussians)
    matrix = find_placement(gaussians, scene, views, transform)
    return views if matrix is None else moved_views(views, matrix)


@contextmanager
def notices_held_back() -> Iterator[None]:
    """Log nothing in the block."""
    logger = logging.getLogger("sgwarp")
    before = logger.disabled
    logger.disabled = True
    try:
        yield
    finally:
        logger.disabled = before


def photograph(gaussians: Gaussians, view: View) -> Tensor:
    """The view's photograph, or without one its rendering, float32 [H, W, 3] on the CPU."""
    if view.image_path is not None:
        return view.image()
    from sgwarp.rendering.renderer import render

    return render(gaussians, view.camera).clamp(0.0, 1.0).cpu()


def check_name(option: str, path: Path, suffix: str) -> None:
    """Refuse an output name before the work is done, not after.

    Raises:
        InputError: The name ends in something else, or its folder is a file.
    """
    if path.suffix != suffix:
        raise InputError(f"{option} {path}: the name must end in {suffix}")
    if path.is_dir():
        raise InputError(f"{option} {path}: is a folder; choose another name")
    check_folder(option, path.parent)


def require_no_lift(out: Path) -> None:
    """Refuse to write over semantics that were lifted from views: to make them again may take hours.

    Raises:
        InputError: `out` is such a file.
    """
    from sgwarp.files.inputs import own_files
    from sgwarp.io.store import read_notes

    if not out.is_file():
        return
    try:
        with own_files():  # a file of the same name that `predict` wrote is replaced
            lifted = "network" not in read_notes(out)
    except InputError:  # no semantics at all
        return
    if lifted:
        raise InputError(f"--out {out}: holds semantics that were lifted from views; choose another name or remove it")


def check_folder(option: str, folder: Path) -> None:
    """Refuse an output folder that cannot be written to.

    Raises:
        InputError: It is a file, lies below a file, or is write protected.
    """
    existing = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    if not existing.is_dir() or not os.access(existing, os.W_OK):
        raise InputError(f"{option} {folder}: {existing} is not a folder that can be written to; choose another")
    if (folder / "run.json").is_dir():
        raise InputError(f"{option} {folder}: its run.json is a folder, where the log of this run goes; choose another")
