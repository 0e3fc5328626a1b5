"""`sgwarp track`: semantics of a moving scene, frame by frame."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import tyro

from sgwarp.commands.effects import IDS, say_unused
from sgwarp.commands.inputs_kept import LOG
from sgwarp.commands.options import Options, check_folder
from sgwarp.commands.segment import class_names
from sgwarp.errors import InputError
from sgwarp.runs.progress import show_progress

if TYPE_CHECKING:
    from sgwarp.apps.tracking.answers import Questions
    from sgwarp.apps.tracking.tracker import Tracker
    from sgwarp.io.moving_views import MovingViews
    from sgwarp.io.sequences import GaussianSequence
    from sgwarp.runs.log import RunLog

logger = logging.getLogger("sgwarp")


@dataclass(kw_only=True)
class Track(Options):
    """Follow the objects of a moving scene: a label per pixel, frame and view, and a trajectory per object."""

    scene: tyro.conf.Positional[Path]
    """The moving scene: params.npz of Dynamic3DGaussians, or a folder with one .ply file per frame."""

    views: Path
    """Its cameras: a folder with {split}_meta.json of Dynamic3DGaussians, one folder per frame, or cameras that stay
    (transforms.json or COLMAP)."""

    out: Path
    """Folder for {frame}/{view}.png, tracks.json, contact_sheet.jpg, video.mp4, trajectories.png."""

    encoder: str = "conse"
    """Where the 2D semantics come from, as for `sgwarp lift`; files:DIR are files in one folder per frame."""

    transform: Path | None = None
    """Where the cameras lie in another world than the scene: the transform between them, such as the
    dataparser_transforms.json of the trainer that moved the scene."""

    split: Literal["train", "test"] = "train"
    """Which cameras of Dynamic3DGaussians are lifted."""

    mask_views: Path | None = None
    """Cameras of the label images, if others than those that are lifted."""

    mask_split: Literal["train", "test"] = "test"
    """Which cameras of Dynamic3DGaussians `--mask-views` means."""

    classes: str | None = None
    """Names separated by commas. Label images need none: the pixels then hold their ids, 0 where unknown."""

    text: str | None = None
    """Phrases separated by commas whose scores are followed over time, such as "open,closed"."""

    forgetting: float = 0.9
    """Weight of the past after one more frame: 0 takes every frame alone, as the paper does, 1 forgets nothing."""

    patience: int = 3
    """Frames in a row that must contradict a Gaussian's past before that is dropped."""

    change: float | None = None
    """Cosine distance that is a contradiction; 0.5 for labels, else 4 times the scene's median if not given."""

    associate: bool = False
    """The ids of the images mean nothing across views and frames: find out which masks belong together."""

    foreground: bool = False
    """Only Gaussians that params.npz calls foreground have a say."""

    frames: int | None = None
    """Only so many frames, from the first."""

    scoring: Literal["evidence", "cosine", "relevancy"] | None = None
    """As for `sgwarp segment`."""

    temperature: float | None = None
    """As for `sgwarp segment`."""

    unknown_below: float = 0.0
    """Pixels whose best class has a smaller confidence are unknown, 0 to 1."""

    photographs: bool = True
    """Off: ignore the photographs and render the views from the scene."""

    incremental: bool = True
    """Off: lift everything anew in every frame; the result is the same."""

    features: bool = False
    """Store the features of every frame in features/, only where they change."""

    pictures: bool = True
    """Overlays, contact sheet, video and plot."""

    resume: bool = False
    """Go on where an interrupted run with the same options stopped."""

    cache: str = ""
    """As for `sgwarp lift`."""

    cache_limit: float = 10.0
    """As for `sgwarp lift`."""

    def written(self) -> Iterator[tuple[str, list[Path]]]:
        names = ("tracks.json", "state.pt", "contact_sheet.jpg", "video.mp4", "trajectories.png", LOG)
        yield "--out", [self.out / name for name in names]

    def run(self) -> None:
        check_folder("--out", self.out)
        if not 0.0 <= self.unknown_below <= 1.0:
            raise InputError(f"--unknown-below: expected a confidence from 0 to 1, got {self.unknown_below}")
        with self.logged(self.out) as log:
            from sgwarp.apps.tracking.run import Output, run_tracking
            from sgwarp.io.moving_views import load_moving_views
            from sgwarp.io.sequences import load_sequence

            sequence = load_sequence(self.scene)
            views = load_moving_views(self.views, self.split, self.photographs)
            masks = None
            if self.mask_views is not None:
                masks = load_moving_views(self.mask_views, self.mask_split, self.photographs)
            with log.stage("compare"):
                views, masks = self._placed(sequence, views, masks)
            with log.stage("load_encoder"):
                tracker, questions = self._prepare(views, log)
            output = Output(self.out, masks, self.features, self.pictures, settings=self._settings())
            with show_progress("track") as progress:
                tracks = run_tracking(
                    *(sequence, views, tracker, questions, output),
                    frames=self.frames,
                    resume=self.resume,
                    progress=progress,
                )
            self._summarize(tracks, log)

    def _placed(
        self, sequence: GaussianSequence, views: MovingViews, masks: MovingViews | None
    ) -> tuple[MovingViews, MovingViews | None]:
        """The cameras in the world of the scene; says so where the photographs of the first frame do not match it."""
        from sgwarp.io.moving_views import MovedViews
        from sgwarp.rendering.agreement import find_placement

        first = sequence.frame(0).gaussians.to(self.device)
        matrix = find_placement(first, self.scene, [one.view for one in views.at(0)], self.transform)
        if matrix is None:
            return views, masks
        return MovedViews(views, matrix), None if masks is None else MovedViews(masks, matrix)

    def _prepare(self, views: MovingViews, log: RunLog) -> tuple[Tracker, Questions]:
        from sgwarp.apps.tracking.answers import Questions
        from sgwarp.apps.tracking.association import Associated
        from sgwarp.apps.tracking.fusion import FusionSettings
        from sgwarp.apps.tracking.sources import NamedSource, open_source
        from sgwarp.apps.tracking.tracker import Tracker, TrackSettings
        from sgwarp.encoders.cache import default_folder
        from sgwarp.encoders.registry import encoder_of_questions, make_encoder

        folder = None if self.cache == "none" else self.cache or default_folder()
        source: NamedSource = open_source(
            self.encoder,
            views.at(0),
            lambda name, first: make_encoder(name, first, self.device, folder, self.cache_limit),
        )
        if self.associate:
            if self.resume:
                raise InputError("--associate: keeps no state to resume from; start anew")
            source = Associated(source)
        fusion = FusionSettings(self.forgetting, self.patience, self.change)
        settings = TrackSettings(fusion, self.incremental, self.foreground, device=self.device)
        classes = None if self.classes is None else tuple(class_names(self.classes))
        texts = () if self.text is None else tuple(class_names(self.text, "--text"))
        encoder = encoder_of_questions(self.encoder, source.of_space, self.device) if classes or texts else None
        if classes and encoder is None:
            say_unused(self, ("scoring", "temperature"), IDS)
        questions = Questions(classes, texts, encoder, self.scoring, self.temperature, self.unknown_below)
        return Tracker(source, settings, log), questions

    def _settings(self) -> dict[str, Any]:
        """What two runs must have in common for the second to go on from the first."""
        names = ("encoder", "split", "classes", "text", "forgetting", "patience", "change", "foreground", "scoring")
        chosen = {name: getattr(self, name) for name in (*names, "temperature", "unknown_below", "photographs")}
        masks = None if self.mask_views is None else [str(self.mask_views.resolve()), self.mask_split]
        chosen["transform"] = None if self.transform is None else str(self.transform.resolve())
        return {**chosen, "mask_views": masks, "scene": str(self.scene.resolve()), "views": str(self.views.resolve())}

    def _summarize(self, tracks: dict[str, Any], log: RunLog) -> None:
        for name in class_names(self.classes) if self.classes is not None else ():
            if not any(tracks["objects"][name]["gaussians"]):
                logger.warning("--classes: '%s' was found in no frame; check the name", name)
        known = [value for value in tracks["switches"] if value is not None]
        log.error["gaussians_that_changed_object_per_frame"] = sum(known) / max(1, len(known))
        log.error["share_of_tiles_left_out"] = sum(tracks["left_out"]) / len(tracks["left_out"])
