"""The same evaluation with one thing changed: inputs of the network, Gaussians, views, method (paper, Table III)."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, get_args

from sgwarp.errors import InputError
from sgwarp.evaluation.evaluator import Evaluation, evaluate
from sgwarp.evaluation.methods import list_methods
from sgwarp.evaluation.networks import NetworkSettings, train_and_predict
from sgwarp.evaluation.profiles.base import Profile
from sgwarp.evaluation.report_files import ask_seconds, cell, method_seconds
from sgwarp.evaluation.settings import Settings
from sgwarp.evaluation.tables import NOTHING, Table, number, seconds_of, size
from sgwarp.metrics.overlap import mean
from sgwarp.network.inputs import InputMode
from sgwarp.runs.log import RunLog
from sgwarp.runs.progress import Report

Axis = Literal["inputs", "gaussians", "views", "modes"]
SHARES = (1.0, 0.5, 0.2, 0.1)
INPUTS: tuple[InputMode, ...] = ("full", "xyz-rgb")


@dataclass(frozen=True)
class Variant:
    """One changed thing.

    Attributes:
        axis: What is changed.
        value: To what, as in the table.
        folder: Of its results, below `ablations`; "" for what was evaluated already.
        settings: The choices.
        inputs: Of the network that has to be trained first; None if none has.
    """

    axis: Axis
    value: str
    folder: str
    settings: Settings
    inputs: InputMode | None = None


@dataclass
class Trial:
    """A variant with what it gave; `error` if it could not be evaluated, `training` seconds of a network."""

    variant: Variant
    found: Evaluation | None = None
    error: str = ""
    training: float = 0.0

    @property
    def seconds(self) -> float:
        """Of lifting or training, a scene."""
        if self.found is None:
            return float("nan")
        return (method_seconds(self.found.seconds) + self.training) / max(1, len(self.found.results))


@dataclass
class Ablation:
    """All trials, in order."""

    profile: Profile
    trials: list[Trial] = field(default_factory=list)


def parse_axes(text: str) -> tuple[Axis, ...]:
    """Axes between commas.

    Raises:
        InputError: One is unknown.
    """
    names = [name.strip() for name in text.split(",") if name.strip()]
    unknown = [name for name in names if name not in get_args(Axis)]
    if unknown or not names:
        raise InputError(f"--ablate {text!r}: expected some of {', '.join(get_args(Axis))}, separated by commas")
    return tuple(dict.fromkeys(names))  # type: ignore[arg-type]


def variants(base: Settings, axes: Sequence[Axis]) -> Iterator[Variant]:
    """What is to be evaluated; the first of each axis is as evaluated, where that is on the axis."""
    for axis in axes:
        if axis in ("views", "gaussians"):
            name = f"share_of_{axis}"
            for share in SHARES:
                changed = replace(base, **{name: share}, sheets=0)  # type: ignore[arg-type]
                same = getattr(base, name) == share
                yield Variant(
                    axis, f"{100 * share:g} %", "" if same else f"{axis}_{share:g}", base if same else changed
                )
        elif axis == "modes":
            for method in list_methods():
                same = method.name == base.method
                changed = base if same else replace(base, method=method.name, sheets=0)
                yield Variant(axis, method.name, "" if same else f"modes_{method.name}", changed)
        else:
            yield Variant(axis, "2D alone, no network", "", base)
            for inputs in INPUTS:
                for ensemble, name in (("3d", "3D"), ("max", "2D+3D")):
                    changed = replace(base, ensemble=ensemble, sheets=0)  # type: ignore[arg-type]
                    yield Variant(axis, f"{name}, inputs {inputs}", f"inputs_{inputs}_{ensemble}", changed, inputs)


def ablate(
    found: Evaluation,
    data: Path,
    out: Path,
    axes: Sequence[Axis],
    network: NetworkSettings,
    *,
    log: RunLog | None = None,
    progress: Report | None = None,
) -> Ablation:
    """Evaluate every variant; those done before are taken over, what fails is noted and stops nothing.

    Args:
        found: The evaluation as it is.
        data: Root of the data set.
        out: Folder of the results; variants go below `out/ablations`.
        axes: What to change.
        network: How networks are trained.
        log: Receives what was left out.
        progress: Called before the first variant and after each.
    """
    log = log if log is not None else RunLog(device=found.settings.device)
    report = progress or (lambda done, total, name: None)
    listed = list(variants(found.settings, axes))
    result = Ablation(found.profile)
    scenes = [one.scene for one in found.results]
    report(0, len(listed), "")
    for done, variant in enumerate(listed, start=1):
        result.trials.append(_try(variant, found, data, out, scenes, network))
        report(done, len(listed), f"{variant.axis} {variant.value}")
    log.leave_out("variants_that_failed", sum(bool(trial.error) for trial in result.trials))
    return result


def _try(
    variant: Variant, found: Evaluation, data: Path, out: Path, scenes: list[str], network: NetworkSettings
) -> Trial:
    if not variant.folder:
        return Trial(variant, found)
    folder, settings, training = out / "ablations" / variant.folder, variant.settings, 0.0
    try:
        if variant.inputs:
            place = out / "ablations" / f"network_{_key(found, network)}" / variant.inputs
            pattern, training = train_and_predict(found.profile, data, place, settings, scenes, variant.inputs, network)
            settings = replace(settings, predicted=pattern)
        return Trial(variant, evaluate(found.profile, data, folder, settings, scenes=scenes), "", training)
    except InputError as error:
        return Trial(variant, None, str(error))


def _key(found: Evaluation, network: NetworkSettings) -> str:
    """Of all that lifted features and networks depend on: other choices get a folder of their own."""
    choices = [
        found.profile.name,
        found.settings.identity,
        network.epochs,
        network.arch,
        network.voxel,
        str(network.train),
    ]
    return hashlib.sha256(json.dumps(choices, sort_keys=True).encode()).hexdigest()[:8]


def ablation_table(ablation: Ablation) -> Table:
    """Every variant in a row: accuracy beside seconds, memory and bytes."""
    names = [*ablation.profile.headline]
    names += [name for name in ("accuracy_3d", "held_out_residual") if _has(ablation, name)]
    rows: list[list[str]] = []
    rules: set[int] = set()
    before = ""
    for trial in ablation.trials:
        axis = trial.variant.axis
        if before and axis != before:
            rules.add(len(rows) - 1)
        before = axis
        rows.append([f"{axis}: {trial.variant.value}", *_cells(trial, names)])
    columns = ["changed", *names, "lifting [s]", "asking [s]", "memory", "B/Gaussian"]
    return Table("Ablations", columns, rows, rule_after=frozenset(rules))


def _has(ablation: Ablation, name: str) -> bool:
    return any(trial.found is not None and name in trial.found.figures for trial in ablation.trials)


def _cells(trial: Trial, names: Sequence[str]) -> list[str]:
    found = trial.found
    if found is None:
        return [NOTHING] * (len(names) + 4)
    count = max(1, len(found.results))
    return [
        *(cell(name, found.figures.get(name)) for name in names),
        seconds_of(trial.seconds),
        seconds_of(ask_seconds(found.seconds) / count),
        size(max(result.peak_memory for result in found.results)),
        number(mean(result.bytes_per_gaussian for result in found.results)),
    ]


def as_rows(ablation: Ablation) -> list[dict[str, object]]:
    """For machines."""
    return [
        {
            "axis": trial.variant.axis,
            "value": trial.variant.value,
            "figures": trial.found.figures if trial.found else None,
            "seconds": trial.found.seconds if trial.found else None,
            "lifting_or_training": trial.seconds,
            "error": trial.error or None,
        }
        for trial in ablation.trials
    ]


def draw_ablation(ablation: Ablation, path: Path) -> bool:
    """The first headline figure over seconds of lifting, one color per axis; False without matplotlib."""
    try:
        from matplotlib.figure import Figure
    except ImportError:
        return False
    from sgwarp.files.atomic import atomic_path

    figure = Figure(figsize=(7.5, 4.8), dpi=140, layout="constrained")
    axes, name = figure.subplots(), ablation.profile.headline[0]
    # A log scale has no zero: what takes no time stands at its left edge.
    least = 0.3 * min((trial.seconds for trial in ablation.trials if trial.seconds > 0), default=1.0)
    for axis in dict.fromkeys(trial.variant.axis for trial in ablation.trials):
        trials = [t for t in ablation.trials if t.variant.axis == axis and t.found is not None]
        seconds = [max(t.seconds, least) for t in trials]
        values = [100 * t.found.figures.get(name, float("nan")) for t in trials if t.found]
        axes.plot(seconds, values, "o", label=axis)
        for x, y, trial in zip(seconds, values, trials, strict=True):
            axes.annotate(trial.variant.value, (x, y), textcoords="offset points", xytext=(5, 4), fontsize=7)
    axes.set_xscale("log")
    axes.margins(x=0.14, y=0.08)
    axes.set_xlabel("seconds of lifting or training, a scene")
    axes.set_ylabel(f"{name} [%]")
    axes.grid(alpha=0.3)
    axes.legend()
    with atomic_path(path) as temporary:
        figure.savefig(temporary)
    return True
