"""The whole path on the room that ships with the package: from a scene and photographs to answers and pictures."""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import torch

from sgwarp.demo.data import FURNITURE, Room
from sgwarp.demo.measurement import measure
from sgwarp.demo.report import Table, print_report, write_report
from sgwarp.demo.sheets import (
    Trial,
    draw_queries,
    draw_renderings,
    draw_segmentation,
    draw_trials,
    require_matplotlib,
)
from sgwarp.encoders.base import MapSource, TextEncoder
from sgwarp.encoders.registry import make_encoder, text_encoder_for
from sgwarp.errors import InputError
from sgwarp.lifting.lifter import lift
from sgwarp.ops.launcher import get_threads, load_together, set_threads
from sgwarp.ops.splatting.forward import rasterize
from sgwarp.ops.splatting.lift_loading import lifting_kernels
from sgwarp.ops.splatting.loading import WIDE_PASS, rendering_kernels, wide_rendering_kernels
from sgwarp.runs.log import RunLog, Watch, ignore
from sgwarp.runs.progress import ShowProgress, hide_progress
from sgwarp.scene import FeatureMap, View

ENCODER = "conse"
SHARES = (0.25, 0.5, 1.0)  # of the views; the last is the run itself
SMALL = 64  # one Gaussian in so many is enough to have every kernel compiled
PICTURES = {
    "renderings.png": "held-out photographs beside the scene's rendering and depth",
    "queries.png": "where each text scores in a view that nothing was lifted from, and its best pixel",
    "segmentation.png": "classes of the held-out views: the encoder, true labels lifted the same way, truth",
    "time_and_error.png": "error against run time, for a quarter, half and all of the views",
}


def run_demo(
    out: Path,
    threads: int | None = None,
    device: str = "cpu",
    show: ShowProgress = hide_progress,
    watch: Watch = ignore,
) -> RunLog:
    """Lift the default encoder's semantics into the room, ask for its furniture, measure, draw and report.

    Writes the PICTURES, report.md and run.json, and prints the report.

    Args:
        out: Folder to write into.
        threads: Host threads; all cores if None.
        device: Where to compute.
        show: Shows the progress of its stages.
        watch: Is given the semantics as they grow, see RunLog.

    Returns:
        The log as written; its `error` holds `miou` (of the furniture), `localised` (of 11 objects), `coverage` and
        `residual`, and the first two again with true labels in place of the encoder.

    Raises:
        InputError: A package of the extra `demo` is not installed, or `out` cannot be written to.
    """
    require_matplotlib()
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{out}: cannot be written ({error.strerror or error}); choose another folder") from None
    threads_before = get_threads(), torch.get_num_threads()
    set_threads(threads or threads_before[0])
    # Views are encoded side by side, and Warp has its own threads. Those of torch wait for each other after every
    # layer, which on a busy machine takes longer than the layer.
    torch.set_num_threads(1)
    try:
        return _run(out, RunLog(command="sgwarp demo", device=device, threads=get_threads(), show=show, watch=watch))
    finally:
        set_threads(threads_before[0])
        torch.set_num_threads(threads_before[1])


def _run(out: Path, log: RunLog) -> RunLog:
    device = log.device
    with log.stage("read"):
        room = Room.load().to(device)
    with log.stage("load_encoder"):
        source = make_encoder(ENCODER, room.views, device)
        text = text_encoder_for(source.space, device=device)
        text.encode_text(room.furniture)
    maps = _encode(room, source, log)
    encode_seconds = log.stages["encode"] / len(room.views)
    with log.stage("compile"):
        _compile(room, maps, text)
    logs = {share: log if share == 1 else RunLog(device=device) for share in SHARES}
    trials = [_try(room, maps, encode_seconds, text, share, logs[share]) for share in SHARES]
    with log.stage("bound"):
        bound = _bound(room)
    for name, trial in (("", trials[-1]), ("_true_labels", bound)):
        log.error[f"miou{name}"] = trial.result.miou
        log.error[f"localised{name}"] = trial.result.localised
    with log.stage("draw"):
        _draw(room, trials, bound, out)
    log.outputs = [str(out / name) for name in (*PICTURES, "report.md")]
    headline = (
        f"{trials[-1].result.localised} of {FURNITURE} objects localised, furniture mIoU {trials[-1].result.miou:.3f}, "
        f"coverage {trials[-1].result.coverage:.1%}, in {sum(log.stages.values()):.0f} s"
    )
    tables = [_trade(trials, bound), _stages(log), _objects(room, trials[-1], bound)]
    write_report(out / "report.md", "A furnished room, asked in words", [headline, _about(room, log)], tables, PICTURES)
    log.write(out)
    print_report(headline, tables, PICTURES, out)
    return log


def _encode(room: Room, source: MapSource, log: RunLog) -> dict[str, FeatureMap]:
    """Feature map of each view."""
    maps = {}
    with log.stage("encode"), log.show("encode") as report, ThreadPoolExecutor(get_threads()) as pool:
        encoded = pool.map(lambda view: source.encode(view, view.image()), room.views)
        for done, (view, feature_map) in enumerate(zip(room.views, encoded, strict=True), start=1):
            maps[view.stem] = feature_map
            report(done, len(room.views), view.stem)
    return maps


def _compile(room: Room, maps: dict[str, FeatureMap], text: TextEncoder) -> None:
    """Run the path on a part of the scene: Warp compiles every kernel at its first use, which is no part of a run.

    On the CPU all of them are compiled before, side by side.
    """
    if room.gaussians.device.type == "cpu":
        load_together(
            [
                *lifting_kernels(0, ids=True, squared=False),
                *wide_rendering_kernels(16 * WIDE_PASS + 1, depth=False),  # passes of both widths
                *rendering_kernels(harmonics=False, depth=False),
                *rendering_kernels(harmonics=True, depth=True),
            ]
        )
    some = torch.arange(0, len(room.gaussians), SMALL, device=room.gaussians.device)
    small = replace(room, gaussians=room.gaussians.subset(some))
    measure(small, lift(small.gaussians, room.views[:2], maps), text)
    rasterize(small.gaussians, room.views[0].camera, expected_depth=True)


def _try(
    room: Room, maps: dict[str, FeatureMap], encode_seconds: float, text: TextEncoder, share: float, log: RunLog
) -> Trial:
    """Lift a share of the views and measure; the time is that of encoding them, lifting and answering."""
    used: list[View] = []

    def remembered(view: View) -> FeatureMap:
        used.append(view)
        return maps[view.stem]

    start = time.perf_counter()
    semantics = lift(room.gaussians, room.views, remembered, share_of_views=share, log=log)
    with log.stage("answer"):
        result = measure(room, semantics, text)
    spent = time.perf_counter() - start + len(used) * encode_seconds
    return Trial(f"encoder {ENCODER}", len(used), spent, result)


def _bound(room: Room) -> Trial:
    """The true labels of the same views, lifted the same way: what a perfect encoder would reach."""
    start = time.perf_counter()
    result = measure(room, lift(room.gaussians, room.views, room.label_map))
    return Trial("true labels", len(room.views), time.perf_counter() - start, result)


def _draw(room: Room, trials: list[Trial], bound: Trial, out: Path) -> None:
    renderings = {}
    for view in room.held_out:
        seen = rasterize(room.gaussians, view.camera, expected_depth=True)
        assert seen.expected_depth is not None
        renderings[view.stem] = seen.features.cpu(), seen.expected_depth.cpu()
    result = trials[-1].result
    columns = [(f"encoder {ENCODER}", result), ("true labels, lifted the same way", bound.result)]
    draw_renderings(room, renderings, out / "renderings.png")
    draw_queries(room, result, out / "queries.png")
    draw_segmentation(room, columns, out / "segmentation.png")
    draw_trials(trials, bound, out / "time_and_error.png")


def _about(room: Room, log: RunLog) -> str:
    device = "" if log.device == "cpu" else f"device: {log.device}, "
    return (
        f"{len(room.gaussians):,} Gaussians; {len(room.views)} photographs lifted with encoder {ENCODER}; measured on "
        f"{len(room.held_out)} held-out views; {device}host threads: {log.threads}. "
        "mIoU is that of the furniture, accuracy that of all pixels; an object is found if the best pixel lies on it, "
        "in the held-out view that shows most of it."
    )


def _trade(trials: list[Trial], bound: Trial) -> Table:
    rows = [
        (
            trial.name,
            str(trial.views),
            f"{trial.seconds:.1f}",
            f"{trial.result.miou:.3f}",
            f"{trial.result.localised} of {len(trial.result.best_sights)}",
            f"{trial.result.confusion.pixel_accuracy:.3f}",
            f"{trial.result.coverage:.1%}",
        )
        for trial in (*trials, bound)
    ]
    columns = ("lifted", "views", "seconds", "mIoU", "found", "accuracy", "coverage")
    return Table("Error against run time", columns, rows)


def _stages(log: RunLog) -> Table:
    rows = [(name.replace("_", " "), f"{seconds:.2f}") for name, seconds in log.stages.items()]
    return Table("Where the time went", ("stage", "seconds"), rows)


def _objects(room: Room, trial: Trial, bound: Trial) -> Table:
    found: dict[str, list[str]] = {name: [] for name in room.furniture}
    for finding in trial.result.findings:
        found[finding.name].append(f"{finding.stem} {'found' if finding.hit else 'missed'}")
    rows = [
        (name, ", ".join(found[name]), f"{mine:.3f}", f"{best:.3f}")
        for name, mine, best in zip(
            room.furniture, trial.result.confusion.iou.tolist(), bound.result.confusion.iou.tolist(), strict=False
        )
    ]
    return Table("Object by object", ("text", "held-out view", "IoU", "IoU, true labels"), rows)
