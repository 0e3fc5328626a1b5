"""`sgwarp evaluate`: published protocols on data sets, with the ablations of the paper."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from sgwarp.commands.inputs_kept import LOG
from sgwarp.commands.options import Options, check_folder, notices_held_back
from sgwarp.errors import InputError
from sgwarp.runs.progress import show_progress

if TYPE_CHECKING:
    from sgwarp.evaluation.ablation import Axis
    from sgwarp.evaluation.evaluator import Evaluation
    from sgwarp.evaluation.profiles.base import Profile
    from sgwarp.evaluation.settings import Settings
    from sgwarp.evaluation.tables import Table
    from sgwarp.runs.log import RunLog


@dataclass(kw_only=True)
class Evaluate(Options):
    """Score the scenes of a data set by a protocol, beside published figures; a killed run goes on where it was.

    In names of files and encoders, {scene} is a scene's name and {path} its folder.
    """

    profile: tyro.conf.Positional[
        Literal[
            "room",
            "room-instances",
            "scannet12-2d",
            "scannet-3d",
            "scannet-instances",
            "lerf-ovs-loc",
            "lerf-ovs-seg",
            "lerf-ovs-3d",
            "lerf-mask",
            "nvos",
            "spin-nerf",
            "parts",
            "panoptic-4d",
        ]
    ]
    """The protocol."""

    data: Path
    """Root of the data set; `sgwarp info DATA` says what is there and what is missing."""

    out: Path
    """Folder for results.md, results.json, results.tex and scenes/{scene}/."""

    scenes: tuple[str, ...] = ()
    """Names; if not given, those of the published list that are there."""

    encoder: str | None = None
    """As for `sgwarp lift`; or truth, truth?noise=0.15: the data's own label images, with a share of regions wrong."""

    levels: tuple[str, ...] = ()
    """What {level} in --encoder stands for, one after the other: maps of several levels that are lifted apart."""

    method: str = "weighted"
    """A lift mode, a rival, or 2d: the encoder on the scored view itself."""

    gaussians: str = ""
    """Trained scenes, such as fitted/{scene}/scene.ply; if not given, what lies with the data, or made of depth."""

    semantics: str = ""
    """What `sgwarp lift` wrote, such as lifted/{scene}.safetensors; then nothing is lifted."""

    predicted: str = ""
    """What `sgwarp predict` wrote, to be asked together with the lifted semantics."""

    ensemble: Literal["2d", "3d", "max", "sum", "mean"] = "max"
    """As for `sgwarp segment`."""

    scoring: Literal["evidence", "cosine", "relevancy"] | None = None
    """As for `sgwarp segment`."""

    classes: tuple[str, ...] = ()
    """Names to ask for, where the data set names none."""

    threshold: float | None = None
    """Score above which a Gaussian is selected by a phrase: 0 is the scene's median, 1 its best thousandth."""

    views: Literal["released", "strict"] | None = None
    """strict: views that are scored are not lifted; released: all are, as in the published scripts."""

    hold_out: int | None = None
    """Score every so many views, where the data set does not say which."""

    every: int | None = None
    """Lift every so many of the training views."""

    share_of_views: float = 1.0
    """Lift this share of them."""

    share_of_gaussians: float = 1.0
    """Keep this share of the Gaussians, at random, enlarged so that surfaces stay closed."""

    count: int = 100_000
    """Gaussians that are made of depth images, where there is no trained scene."""

    forgetting: float = 0.9
    """In moving scenes, the weight of the past after one more frame; 0 takes every frame alone, as the paper does."""

    ablate: str | None = None
    """Evaluate again with one thing changed: inputs, gaussians, views, modes, separated by commas. "inputs" trains
    networks."""

    epochs: int = 30
    """Epochs of the networks of --ablate inputs."""

    train: Path | None = None
    """Root of a data set that those networks learn from; the evaluated scenes themselves if not given."""

    sheets: int = 3
    """Views to draw per scene."""

    seed: int = 0
    """Seed of noise and shares."""

    cache: str = ""
    """As for `sgwarp lift`."""

    def written(self) -> Iterator[tuple[str, list[Path]]]:
        names = [f"results.{kind}" for kind in ("md", "json", "tex")]
        names += [] if self.ablate is None else ["ablation.json", "ablation.png"]
        yield "--out", [self.out / name for name in (*names, LOG)]

    def run(self) -> int:
        """Returns the exit code, 1 if a scene failed."""
        check_folder("--out", self.out)
        with self.logged(self.out) as log:
            from sgwarp.evaluation.evaluator import evaluate
            from sgwarp.evaluation.profiles.catalogue import find_profile
            from sgwarp.evaluation.report_files import headline, write_tables

            axes = None if self.ablate is None else self._axes()
            if self.epochs < 1:
                raise InputError(f"--epochs: expected 1 or more, got {self.epochs}")
            if self.train is not None and "inputs" not in (axes or ()):
                raise InputError(f"--train {self.train}: goes with --ablate inputs, whose networks learn from it")
            profile = find_profile(self.profile)
            settings = self._settings(profile)
            with show_progress("evaluate") as progress:
                found = evaluate(
                    profile, self.data, self.out, settings, scenes=self.scenes or None, log=log, progress=progress
                )
            extra = [] if axes is None else self._ablate(found, axes, log)
            paths = write_tables(found, self.out, extra)
            log.error |= {name: value for name, value in found.figures.items()}
            log.error["failed"] = len(found.failed)
            log.outputs += [str(path) for path in paths]
            for table in (headline(found), *extra):
                print(table.markdown())
            self._say_failed(found)
        return 1 if found.failed else 0

    def _settings(self, profile: Profile) -> Settings:
        """The profile's defaults, and what was said on the command line.

        Raises:
            InputError: A value is out of range.
        """
        from dataclasses import fields

        from sgwarp.encoders.cache import default_folder
        from sgwarp.evaluation.methods import find_method
        from sgwarp.evaluation.settings import Settings

        given = {name: getattr(self, name) for name in (one.name for one in fields(Settings)) if hasattr(self, name)}
        chosen = {**profile.defaults, **{name: value for name, value in given.items() if value is not None}}
        chosen["cache"] = None if self.cache == "none" else self.cache or str(default_folder())
        self._require_encoder(chosen.get("encoder", ""))
        try:
            settings = Settings(**chosen)
        except InputError as error:
            raise InputError(f"--{error}") from None
        find_method(settings.method)
        return settings

    def _axes(self) -> tuple[Axis, ...]:
        from sgwarp.evaluation.ablation import parse_axes

        if self.semantics:
            raise InputError("--ablate: lifts anew each time; leave --semantics out")
        return parse_axes(self.ablate or "")

    def _ablate(self, found: Evaluation, axes: tuple[Axis, ...], log: RunLog) -> list[Table]:
        """Table of the variants; ablation.json and, with matplotlib, ablation.png are written."""
        import json

        from sgwarp.evaluation.ablation import ablate, ablation_table, as_rows, draw_ablation
        from sgwarp.evaluation.networks import NetworkSettings
        from sgwarp.evaluation.results import finite
        from sgwarp.files.atomic import atomic_path

        network = NetworkSettings(epochs=self.epochs, train=self.train)
        with notices_held_back(), show_progress("ablate") as progress:
            ablation = ablate(found, self.data, self.out, axes, network, log=log, progress=progress)
        path = self.out / "ablation.json"
        with atomic_path(path) as temporary:
            temporary.write_text(json.dumps(finite(as_rows(ablation)), indent=1) + "\n", encoding="utf-8")
        log.outputs.append(str(path))
        if draw_ablation(ablation, self.out / "ablation.png"):
            log.outputs.append(str(self.out / "ablation.png"))
        for trial in ablation.trials:
            if trial.error:
                print(f"{trial.variant.axis} {trial.variant.value}: {trial.error}")
        return [ablation_table(ablation)]

    def _require_encoder(self, name: str) -> None:
        """Refuse an encoder that stands for weights that nobody named.

        Raises:
            InputError: It was not given, and the protocol's own needs weights.
        """
        if not self.semantics and name.rpartition(":")[2] in ("PATH", "DIR"):
            raise InputError(f"--encoder: profile {self.profile} is published with {name}; name one, with its weights")

    @staticmethod
    def _say_failed(found: Evaluation) -> None:
        for name, error in found.failed.items():
            print(f"{name}: {error}")
