"""`sgwarp fit`: a scene from photographs, with poses or without."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import tyro

from sgwarp.commands.inputs_kept import LOG
from sgwarp.commands.options import Options, check_name, find_views, notices_held_back
from sgwarp.commands.poses import find_poses
from sgwarp.errors import InputError
from sgwarp.runs.progress import show_progress

if TYPE_CHECKING:
    from sgwarp.reconstruction.fitting.belongings import OfView
    from sgwarp.reconstruction.fitting.photographs import Masks
    from sgwarp.reconstruction.fitting.settings import FitSettings
    from sgwarp.reconstruction.fitting.trainer import Fitted
    from sgwarp.runs.log import RunLog
    from sgwarp.scene import View
    from sgwarp.viewer.live import Live

logger = logging.getLogger("sgwarp")
DEGREE_EVERY = 1000  # steps between two rises of the degree of the colours
LARGEST_GAP = 6.0  # between the quality of fitted and held-out photographs before it is warned of [dB]
EVALUATE_EVERY = 500  # steps between two measurements, less in short runs


@dataclass(kw_only=True)
class Fit(Options):
    """Fit Gaussians to photographs.

    A folder of photographs without poses, or a video, first goes through structure from motion (`sgwarp poses`), whose
    COLMAP model is kept in OUT.sfm: give that folder as --views to other commands.
    Beside the scene go run.json (with the curve of quality over time), a contact sheet of the held-out views and, if
    matplotlib is installed, a plot. Ctrl-C stops after the step at hand and writes the scene as it is then.
    """

    views: tyro.conf.Positional[Path]
    """Posed photographs (a folder with transforms.json or a COLMAP model), a folder of photographs, or a video."""

    out: Path
    """Scene to write, .ply (or .compressed.ply, quantised)."""

    steps: int = 10_000
    """Training steps, one photograph each. All schedules scale with them; the degree of the colors rises every 1,000
    steps, sooner in a short run."""

    hold_out: int = 8
    """Measure on every n-th view, from the first on, and fit to the others; 0 fits to all."""

    strategy: Literal["mcmc", "default"] = "mcmc"
    """Density control. mcmc: transparent Gaussians move to opaque ones, and their number grows to the cap. default: as
    in 3DGS, clone, split, remove and reset opacities."""

    cap: int = 100_000
    """Largest number of Gaussians: trades quality for time and size. Of more points to start from, so many are taken;
    --strategy default then adds none."""

    sh_degree: Literal[0, 1, 2, 3] = 3
    """Highest degree of the view-dependent colors; 0 gives small files."""

    downscale: int = 1
    """Divide width and height of the photographs by this."""

    max_size: int = 1600
    """Photographs wider or higher than this are then scaled down to it [pixels]; 0 for none."""

    background: Literal["black", "white", "random"] = "black"
    """Color behind the scene."""

    init: Literal["auto", "points", "depth", "triangulated", "random"] = "auto"
    """What to start from; auto: depth if --depth is given or the data set names some, else the data set's points if it
    has some, else points triangulated with its poses (pycolmap), else random ones where the photographs agree. Few
    points are added to in the same way."""

    points: Path | None = None
    """File of points to start from (.ply or COLMAP's points3D), if not the data set's own."""

    depth: Path | None = None
    """Folder of depth along the optical axis: {stem}.png in millimetres or {stem}.npy in metres, 0 for none; if the
    views agree on it in another unit only, that is taken and said."""

    masks: Path | None = None
    """Folder of {stem}.png, or of folders and names as the photographs'; what is black there does not count. If not
    given, the masks that the data set names; none for none at all."""

    mask_hides: Literal["black", "white"] = "black"
    """What the masks of --masks leave out."""

    exposure: bool = False
    """Also fit an affine map of the colours for every photograph."""

    refine_poses: bool = False
    """Also fit a small motion of every camera. The poses go to OUT.refined: give that folder as --views to other
    commands."""

    held_out_poses: Literal["auto", "given", "refined"] = "auto"
    """Poses that held-out views are measured from. refined: also measure after the six numbers of each such pose were
    fitted to the finished scene, which stays as it is. auto: refined with --refine-poses, and where `sgwarp fit` or
    `sgwarp poses` has found the poses; given otherwise."""

    sparse: bool = True
    """Update only what a step's view has seen."""

    checkpoint_every: int = 1000
    """Steps between checkpoints, which --resume goes on from."""

    resume: bool = False
    """Go on from the checkpoint beside the output."""

    seed: int = 0
    """Seed of everything random; on the CPU the same seed gives the same scene, bit by bit."""

    images: str | None = None
    """Name of a COLMAP model's folder of photographs, if it is not `images` nor the only one that holds them."""

    view: bool = False
    """Show the scene in the browser while it is fitted, and the result until Ctrl-C."""

    def written(self) -> Iterator[tuple[str, list[Path]]]:
        name, stem, folder = self.out.name, self.out.stem, self.out.parent
        names = [name, f"{name}.checkpoint", f"{stem}.held_out.jpg", f"{stem}.curve.png", LOG]
        names += [f"{name}.refined/transforms.json"] * self.refine_poses
        yield "--out", [folder / one for one in names]

    def run(self) -> None:
        with ExitStack() as stack:
            live = self._run(stack)
            if live is not None:
                live.finish()

    def _run(self, stack: ExitStack) -> Live | None:
        """Fit and write; the viewer that shows it, if one was asked for, closes with the stack."""
        from sgwarp.io.points import PLY_NAMES

        check_name("--out", self.out, ".ply")
        if self.out.name in PLY_NAMES and self.out.parent.resolve() == self.views.resolve():
            raise InputError(f"--out {self.out}: is a name of the points that a fit starts from; choose another")
        if self.hold_out < 0:
            raise InputError(f"--hold-out: expected 0 or more, got {self.hold_out}")
        with self.logged(self.out.parent) as log:
            from sgwarp.reconstruction.fitting.photographs import require_enough
            from sgwarp.reconstruction.fitting.settings import FitSettings
            from sgwarp.reconstruction.fitting.trainer import fit

            source = self._posed(log)
            views = find_views(source, images=self.images)
            held_out = views[:: self.hold_out] if self.hold_out else []
            kept = [view for index, view in enumerate(views) if not self.hold_out or index % self.hold_out]
            require_enough(kept)
            settings = FitSettings(
                steps=self.steps,
                strategy=self.strategy,
                cap=self.cap,
                sh_degree=self.sh_degree,
                background=self.background,
                exposure=self.exposure,
                refine_poses=self.refine_poses,
                refine_held_out=self._refines_held_out(source),
                sparse=self.sparse,
                seed=self.seed,
                evaluate_every=min(EVALUATE_EVERY, max(1, self.steps // 10)),
                degree_every=min(DEGREE_EVERY, max(1, self.steps // (self.sh_degree + 1))),
            )
            masks = self._masks(views)
            start = self._start(source, kept, settings, log)
            checkpoint = self.out.with_name(f"{self.out.name}.checkpoint")
            live = self._live(kept) if self.view else None
            if live is not None:
                stack.callback(live.close)
                log.watch = live.watch
            with show_progress("fit") as progress:
                fitted = fit(
                    kept,
                    start,
                    held_out,
                    settings,
                    downscale=self.downscale,
                    largest=self.max_size,
                    masks=masks,
                    checkpoint=checkpoint,
                    checkpoint_every=self.checkpoint_every,
                    keep_checkpoint=True,
                    resume=self.resume,
                    device=self.device,
                    progress=progress,
                    log=log,
                )
            self._write(fitted, held_out, masks, log)
            if fitted.complete:
                checkpoint.unlink(missing_ok=True)
        if not fitted.complete:
            raise KeyboardInterrupt
        return live

    def _refines_held_out(self, source: Path) -> bool:
        """Whether the poses of held-out views are estimates, which carry an error of their own."""
        from sgwarp.reconstruction.sfm.poses import NOTES

        estimated = self.refine_poses or (source / NOTES).is_file()
        return bool(self.hold_out) and (
            estimated if self.held_out_poses == "auto" else self.held_out_poses == "refined"
        )

    @staticmethod
    def _live(views: list[View]) -> Live:
        """A viewer that opens with the scene that the fit starts from."""
        from sgwarp.viewer.live import Live
        from sgwarp.viewer.workbench import Materials, Workbench

        return Live(lambda gaussians: Workbench(Materials(gaussians, views=views)), Workbench.replace_scene)

    def _masks(self, views: list[View]) -> Masks | None:
        """Masks that were given, or that the data set names."""
        from sgwarp.reconstruction.fitting.belongings import masks_from_folder, masks_of_views

        if self.masks is None:
            return masks_of_views(views)
        return None if str(self.masks) == "none" else masks_from_folder(self.masks, views, self.mask_hides)

    def _posed(self, log: RunLog) -> Path:
        """The data set: what was given, or what structure from motion makes of it."""
        from sgwarp.io.world import TRANSFORMS

        given = self.views
        if not given.exists():
            raise InputError(f"{given}: no such file or folder; check the path")
        from sgwarp.io.colmap_model import find_model
        from sgwarp.io.foreign_captures import describe_capture
        from sgwarp.reconstruction.sfm.poses import photographs_in
        from sgwarp.reconstruction.sfm.video import is_video

        if not is_video(given):
            posed = given.is_file() or any((given / name).is_file() for name in TRANSFORMS) or find_model(given)
            if posed or not photographs_in(given):
                return given
        if given.is_dir() and (known := describe_capture(given)):
            logger.warning("%s: %s", given, known)
        made = self.out.with_name(f"{self.out.name}.sfm")
        logger.info(
            "%s: holds no poses that are read; they are found by structure from motion, and kept in %s", given, made
        )
        find_poses(given, made, log, seed=self.seed)
        log.outputs.append(str(made))
        return made

    def _start(self, source: Path, views: list[View], settings: FitSettings, log: RunLog) -> Any:
        """Points, a scene, or None for random points."""
        if self.resume or self.init == "random":  # a checkpoint holds the whole scene
            return None
        with log.stage("start"):
            if self.init in ("auto", "depth") and (depth := self._depth(views)) is not None:
                from sgwarp.reconstruction.depth import gaussians_from_depth

                return gaussians_from_depth(views, depth, count=settings.cap)
            if self.init in ("auto", "points") and (points := self._points(source)) is not None:
                return points
            return self._triangulated(views, log)

    def _depth(self, views: list[View]) -> OfView | None:
        """The depth given or that the data set names; None if --init auto finds none that it can use."""
        from sgwarp.reconstruction.fitting.belongings import depth_from_folder, depth_of_views
        from sgwarp.reconstruction.fitting.depth_start import usable_depth

        if self.depth is not None:
            return usable_depth(f"--depth {self.depth}", depth_from_folder(self.depth, views), views)
        declared = depth_of_views(views)
        if declared is None:
            if self.init == "depth":
                raise InputError("--init depth: needs --depth, the folder of the depth images")
            return None
        try:
            depth = usable_depth(f"{self.views}: depth that it names", declared, views)
        except InputError as error:
            if self.init == "depth":
                raise
            logger.warning("%s", error)
            return None
        logger.info("start: from the depth images that the data set names; --init points starts without them")
        return depth

    def _points(self, source: Path) -> Any:
        """Those given or the data set's own; None if --init auto finds none."""
        from sgwarp.io.points import find_points, load_points

        if self.points is None and self.init == "auto":
            try:
                if find_points(source) is None:
                    return None
                return load_points(source)
            except InputError as error:
                logger.warning("%s", error)
                return None
        return load_points(self.points or source, source)

    def _triangulated(self, views: list[View], log: RunLog) -> Any:
        """Points of the poses, or None where --init auto cannot triangulate."""
        from sgwarp.reconstruction.sfm.features import SfmSettings
        from sgwarp.reconstruction.sfm.library import has_pycolmap
        from sgwarp.reconstruction.sfm.triangulation import LEAST_POINTS, triangulate

        if self.init == "auto" and not has_pycolmap():
            logger.warning("start: no points, and pycolmap is not installed to triangulate some; starts at random")
            return None
        with show_progress("triangulate") as progress:
            points = triangulate(views, SfmSettings(seed=self.seed, threads=log.threads), progress)
        if len(points[0]) >= LEAST_POINTS:
            logger.info("start: no points; %s were triangulated with the poses given", f"{len(points[0]):,}")
            return points
        if self.init == "triangulated":
            raise InputError(
                f"--init triangulated: only {len(points[0])} points fit the poses; are they right? Or use --init random"
            )
        logger.warning("start: no points, and only %d can be triangulated; starts at random", len(points[0]))
        return None

    def _write(self, fitted: Fitted, held_out: list[View], masks: Masks | None, log: RunLog) -> None:
        from sgwarp.io.posed_photographs import write_posed_photographs
        from sgwarp.io.scenes import save_gaussians
        from sgwarp.reconstruction.fitting.photographs import read_photographs
        from sgwarp.reconstruction.fitting.report import draw_curve, sheet_rows, write_contact_sheet

        last = fitted.curve[-1]
        with log.stage("write"):
            save_gaussians(fitted.gaussians, self.out)
            log.outputs.append(str(self.out))
            if self.refine_poses:
                folder = self.out.with_name(f"{self.out.name}.refined")
                log.outputs.append(str(write_posed_photographs(folder, fitted.views)))
            if held_out:
                sheet = self.out.with_name(f"{self.out.stem}.held_out.jpg")
                shown = list(fitted.held_out_views or held_out)
                with notices_held_back():  # they were said when the fit read them
                    photographs = read_photographs(
                        [shown[index] for index in sheet_rows(len(shown))],
                        downscale=self.downscale,
                        largest=self.max_size,
                        masks=masks,
                        device=self.device,
                    )
                write_contact_sheet(fitted.gaussians, photographs, sheet, white=self.background == "white")
                log.outputs.append(str(sheet))
            if held_out and _has_matplotlib():
                plot = self.out.with_name(f"{self.out.stem}.curve.png")
                draw_curve(fitted.curve, plot)
                log.outputs.append(str(plot))
        log.error["held_out_psnr"] = last.psnr
        log.error["fitted_psnr"] = fitted.fitted_psnr
        measured = last.psnr
        if fitted.held_out_refined:
            measured = sum(fitted.held_out_refined.values()) / len(fitted.held_out_refined)
            log.error["held_out_psnr_refined_poses"] = measured
            logger.info(
                "held out: %.2f dB from the poses given, %.2f dB from poses refined to the finished scene",
                *(last.psnr, measured),
            )
        gap = fitted.fitted_psnr - measured
        if not math.isnan(gap):
            log.error["overfitting_gap"] = gap
        if gap > LARGEST_GAP:
            logger.warning(
                "overfitted: %.1f dB on the photographs that were fitted, %.1f dB on those held out; away from the "
                "photographs the scene will look worse still. Take more photographs, from more places; start from "
                "points; or use a smaller --cap",
                *(fitted.fitted_psnr, measured),
            )
        log.error["loss"] = last.loss
        log.curve = [asdict(point) for point in fitted.curve]


def _has_matplotlib() -> bool:
    from sgwarp.reconstruction.fitting.report import require_matplotlib

    try:
        require_matplotlib()
    except InputError:
        return False
    return True
