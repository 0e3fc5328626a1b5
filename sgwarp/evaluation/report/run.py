"""The whole report on a scene: sweeps, extremes, page and plot."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch

from sgwarp.encoders.maps.files import FileMaps
from sgwarp.errors import InputError
from sgwarp.evaluation.report.extremes import EXTREMES
from sgwarp.evaluation.report.oracle import LIMIT, SAME, SIDE, see_patches
from sgwarp.evaluation.report.page import PLOT, Findings, Stability, write_json, write_page
from sgwarp.evaluation.report.plot import draw_trials, require_matplotlib
from sgwarp.evaluation.report.stability import Schedule, check, check_gradients
from sgwarp.evaluation.report.sweep import Trial, rendering_variants, sweep_lifting, sweep_rendering
from sgwarp.ops.launcher import get_threads
from sgwarp.runs.log import RunLog
from sgwarp.runs.progress import ShowProgress, hide_progress
from sgwarp.scene import FeatureMap, Gaussians, View


def split_views(views: Sequence[View], held_out: int) -> tuple[list[View], list[View]]:
    """Views to lift from, and those to measure on, evenly spread.

    Raises:
        InputError: Nothing would be held out, or nothing left.
    """
    if not 0 < held_out < len(views):
        raise InputError(f"--held-out {held_out}: expected 1 to {len(views) - 1}, fewer than the {len(views)} views")
    chosen = {(2 * k + 1) * len(views) // (2 * held_out) for k in range(held_out)}
    return (
        [view for number, view in enumerate(views) if number not in chosen],
        [view for number, view in enumerate(views) if number in chosen],
    )


def make_report(
    gaussians: Gaussians,
    views: Sequence[View],
    out: Path,
    name: str,
    *,
    labels: Path | None = None,
    held_out: int = 2,
    patches: int = 60,
    repeats: int = 5,
    seed: int = 0,
    extremes: Sequence[str] = tuple(EXTREMES),
    log: RunLog,
) -> Findings:
    """Sweep every knob, check the extreme scenes, and write report.md, report.json and the plot into `out`.

    Args:
        gaussians: The scene.
        views: Posed views; with labels, only those that have a label image are used.
        out: Folder for the results.
        name: Of the scene, for the title.
        labels: Folder of label images, {stem}.png; without it, lifting is left out.
        held_out: How many views are measured on and not lifted from.
        patches: How many patches of each of them the oracle composites.
        repeats: Runs of which the median time is taken.
        seed: Of the patches and of the random share of Gaussians.
        extremes: Names of the extreme scenes to check.
        log: Receives the stages, error figures and outputs.

    Raises:
        InputError: An argument is out of range, there are no labels where some are promised, or no matplotlib.
    """
    require_matplotlib()
    for option, value in (("--patches", patches), ("--repeats", repeats)):
        if value < 1:
            raise InputError(f"{option} {value}: expected 1 or more")
    maps = _label_maps(labels, views) if labels is not None else {}
    views = [view for view in views if view.stem in maps] if maps else views
    train, measured = split_views(views, held_out)

    with log.stage("oracle"), log.show("oracle") as progress:
        on_cpu, limit, rounding = gaussians.to("cpu"), [], 0.0
        _, _, draw = rendering_variants(gaussians, seed)[0]
        progress(0, len(measured), "")
        for done, view in enumerate(measured, start=1):
            limit.append(see_patches(on_cpu, view, patches, LIMIT, seed))
            same = see_patches(on_cpu, view, patches, SAME, seed).rounding(draw(view.camera).cpu())
            rounding = max(rounding, float(same.max()) if same.numel() else 0.0)
            progress(done, len(measured), view.stem)
    with log.stage("rendering"), log.show("rendering") as progress:
        rendering = sweep_rendering(gaussians, measured, limit, repeats, seed, progress)
    lifting: list[Trial] = []
    if maps:
        with log.stage("lifting"), log.show("lifting") as progress:
            lifting = sweep_lifting(gaussians, train, measured, maps, repeats, progress)
    about = {
        "scene": name,
        "version": log.version,
        "device": "CPU" if gaussians.device.type == "cpu" else str(gaussians.device),
        "threads": get_threads(),
        "gaussians": len(gaussians),
        "width": measured[0].camera.width,
        "height": measured[0].camera.height,
        "held_out": [view.stem for view in measured],
        "lifted": len(train) if maps else 0,
        "pixels": sum(seen.pixels for seen in limit),
        "patch": SIDE,
        "repeats": repeats,
        "seed": seed,
    }
    findings = Findings(about, rounding, rendering, lifting)
    with log.stage("extremes"):
        findings.stability = check_extremes(extremes, gaussians.device, log.show)

    log.error |= {f"default_{key}": value for key, value in rendering[0].errors.items()}
    log.error["rounding"] = rounding
    if lifting:
        log.error["default_miou"] = lifting[0].errors["miou"]
    if findings.stability:
        log.error["extremes_out_of_bounds"] = sum(not result.within for result in findings.stability)
    with log.stage("write"):
        draw_trials(rendering, lifting, out / PLOT)
        write_json(findings, out / "report.json")
        write_page(findings, out / "report.md")
    log.outputs += [str(out / file) for file in ("report.md", "report.json", PLOT)]
    return findings


def check_extremes(
    names: Sequence[str], device: torch.device | str = "cpu", show: ShowProgress = hide_progress
) -> list[Stability]:
    """Images and gradients of the extreme scenes: on the CPU in both schedules, elsewhere in that of the device."""
    results = []
    schedules: tuple[Schedule, ...] = ("lanes", "block") if torch.device(device).type == "cpu" else ("block",)
    with show("extremes") as progress:
        progress(0, len(names), "")
        for done, name in enumerate(names, start=1):
            extreme = EXTREMES[name]
            count = len(extreme.build()[0])
            for schedule in schedules:
                bounded = extreme.gradient_bound is not None
                gradient = check_gradients(extreme, schedule, device) if bounded else None
                results.append(Stability(extreme, schedule, count, check(extreme, schedule, device), gradient))
            progress(done, len(names), name)
    return results


def _label_maps(folder: Path, views: Sequence[View]) -> dict[str, FeatureMap]:
    """One-hot labels of the views that have a label image, by stem."""
    source = FileMaps(folder, views)
    if source.kind != "labels":
        raise InputError(f"{folder}: holds {source.kind} maps; the report compares with label images, {{stem}}.png")
    return {view.stem: source.encode(view) for view in views if source.has_map(view)}
