"""Fitting the room: quality against seconds and against the number of Gaussians, and what the fit is worth for lifting.

    SGWARP_DATA=FOLDER python -m benchmarks.fit [PIECE ...] [--work fit_work] [--out benchmarks/fit.json] [--pictures F]

The folder holds room/: 60 posed views of 480 x 360 with points, depth and label images; every eighth is held out. Each
piece is measured once and added to the file; without names all are, and those that are there already are skipped. A
fit that was stopped goes on from its checkpoint. Scenes, checkpoints and contact sheets go into the folder `--work`.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable
from dataclasses import asdict
from functools import cached_property
from pathlib import Path
from statistics import median

import numpy as np
import torch

import sgwarp as sg
from benchmarks.room import FullRoom, label_iou
from sgwarp.files.atomic import atomic_path
from sgwarp.ops.launcher import get_threads
from sgwarp.ops.photometric import photometric_loss
from sgwarp.reconstruction.fitting.photographs import read_photographs
from sgwarp.reconstruction.fitting.report import write_contact_sheet
from sgwarp.reconstruction.fitting.settings import FitSettings
from sgwarp.reconstruction.fitting.trainer import Fitted
from sgwarp.runs.log import RunLog
from tools.build_demo_room import SETTINGS as DEMO

HOLD_OUT = 8
STEPS = 10_000
MARKS = (1000, 3000, 7000, 10_000)  # steps whose quality is quoted
SPEED_STEPS = 200
SHORT = 1000  # steps of the comparison of sparse and dense updates
CAPS = (10_000, 30_000)  # beside the 100,000 of the long runs
FITS = {
    "mcmc": FitSettings(steps=STEPS, strategy="mcmc", cap=100_000),
    "default": FitSettings(steps=STEPS, strategy="default", cap=100_000),
    **{f"cap {cap}": FitSettings(steps=STEPS, strategy="mcmc", cap=cap) for cap in CAPS},
    "sparse": FitSettings(steps=SHORT, strategy="mcmc", sparse=True),
    "dense": FitSettings(steps=SHORT, strategy="mcmc", sparse=False),
    "demo": DEMO,
}
COLOURS = {"mcmc": "#2d6cb5", "default": "#d1495b"}


class Bench:
    """The room, and where results go."""

    def __init__(self, folder: Path, work: Path) -> None:
        self.folder, self.work = folder, work
        work.mkdir(parents=True, exist_ok=True)
        views = sg.load_views(folder)
        self.held_out = views[::HOLD_OUT]
        self.views = [view for index, view in enumerate(views) if index % HOLD_OUT]

    def scene(self, name: str) -> Path:
        return self.work / f"{name.replace(' ', '_')}.ply"

    def fit(self, name: str) -> dict[str, object]:
        """One run, from the points of the data set."""
        checkpoint, log = self.scene(name).with_suffix(".checkpoint"), RunLog()
        last = time.monotonic()

        def show(done: int, total: int, text: str) -> None:
            nonlocal last
            if time.monotonic() - last > 60 or done == total:
                last = time.monotonic()
                print(f"{name}: {done}/{total} {text}", flush=True)

        fitted = sg.fit(
            self.views,
            sg.load_points(self.folder),
            self.held_out,
            FITS[name],
            checkpoint=checkpoint,
            checkpoint_every=500,
            resume=checkpoint.exists(),
            progress=show,
            log=log,
        )
        if not fitted.complete:
            raise KeyboardInterrupt
        sg.save_gaussians(fitted.gaussians, self.scene(name))
        write_contact_sheet(fitted.gaussians, read_photographs(self.held_out), self.scene(name).with_suffix(".png"))
        return self.summary(fitted, log)

    @staticmethod
    def summary(fitted: Fitted, log: RunLog) -> dict[str, object]:
        last = fitted.curve[-1]
        updates = log.left_out.get("updates_of_unseen_gaussians", 0)
        return {
            "threads": get_threads(),
            "Gaussians": last.count,
            "seconds": last.seconds,
            "milliseconds per step": 1e3 * last.seconds / last.step,
            "held-out PSNR": last.psnr,
            "PSNR by view": fitted.held_out,
            "at": {str(point.step): asdict(point) for point in fitted.curve if point.step in MARKS},
            "curve": [asdict(point) for point in fitted.curve],
            "updates of unseen Gaussians left out, since the last start": updates,
        }

    @cached_property
    def room(self) -> FullRoom:
        """With the scene made from depth, which the fitted ones are compared with."""
        return FullRoom.build(self.folder, 200_000)

    def lifting(self) -> dict[str, object]:
        """True labels lifted into each scene, and compared with those of the held-out views."""
        results: dict[str, object] = {}
        scenes = {"from depth": self.room.gaussians}
        scenes |= {name: sg.load_gaussians(self.scene(name)) for name in FITS if self.scene(name).is_file()}
        for name, scene in scenes.items():
            room = FullRoom(self.folder, scene, self.views, self.held_out, self.room.names)
            semantics = sg.lift(scene, room.views, room.label_map)
            iou = label_iou(room, semantics)
            results[name] = {"Gaussians": len(scene), "coverage": semantics.coverage, "IoU": iou}
            print(f"{name}: mIoU {iou['mIoU']:.3f} of {len(scene):,} Gaussians", flush=True)
        return results

    def speed(self) -> dict[str, float]:
        """Milliseconds per step where a run is slowest, at its end: all Gaussians, all colours."""
        results = {}
        for name in ("mcmc", "default"):
            scene = sg.load_gaussians(self.scene(name))
            settings = FitSettings(steps=SPEED_STEPS, strategy=FITS[name].strategy, cap=len(scene), refine_every=10**6)
            fitted = sg.fit(self.views, scene, (), settings)
            results[name] = 1e3 * fitted.curve[-1].seconds / SPEED_STEPS
            print(f"{name}: {results[name]:.1f} ms per step with {len(scene):,} Gaussians", flush=True)
        return results

    def loss(self) -> dict[str, float]:
        """Milliseconds of the loss with its gradient, beside the same by torch's convolutions, in turn."""
        image = read_photographs(self.views[:1])[0].image()
        noisy = (image + 0.05 * torch.randn(image.shape, generator=torch.Generator().manual_seed(0))).clamp(0, 1)
        times: dict[str, list[float]] = {"kernels": [], "torch": []}
        for _ in range(12):
            for name, function in (("kernels", photometric_loss), ("torch", by_convolutions)):
                leaf = noisy.clone().requires_grad_()
                start = time.perf_counter()
                function(leaf, image).backward()
                times[name].append(1e3 * (time.perf_counter() - start))
        return {name: median(values[2:]) for name, values in times.items()}


def by_convolutions(image: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
    """The loss with separable depthwise convolutions and autograd, as fits commonly have it."""
    x = torch.arange(11) - 5.0
    bell = torch.exp(-0.5 * x**2 / 1.5**2)
    bell = (bell / bell.sum()).expand(3, 1, 1, 11).contiguous()

    def mean(values: torch.Tensor) -> torch.Tensor:
        across = torch.nn.functional.conv2d(values.permute(2, 0, 1)[None], bell, padding=(0, 5), groups=3)
        return torch.nn.functional.conv2d(across, bell.transpose(2, 3), padding=(5, 0), groups=3)

    a, b = mean(image), mean(truth)
    aa, bb, ab = mean(image * image) - a * a, mean(truth * truth) - b * b, mean(image * truth) - a * b
    similarity = (2 * a * b + 1e-4) * (2 * ab + 9e-4) / ((a * a + b * b + 1e-4) * (aa + bb + 9e-4))
    return 0.8 * (image - truth).abs().mean() + 0.2 * (1 - similarity.mean())


def draw(results: dict[str, dict], path: Path) -> None:
    """Quality and loss over seconds for both strategies, and quality over the number of Gaussians."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 4), dpi=130, layout="constrained", facecolor="white")
    over_time, loss, over_count = figure.subplots(1, 3)
    for name, colour in COLOURS.items():
        if name in results:
            curve = results[name]["curve"]
            over_time.plot([p["seconds"] for p in curve], [p["psnr"] for p in curve], color=colour, label=name)
            loss.plot([p["seconds"] for p in curve], [p["loss"] for p in curve], color=colour, label=name)
            marks = results[name]["at"].values()
            over_time.plot([p["seconds"] for p in marks], [p["psnr"] for p in marks], "o", color=colour, markersize=4)
    over_time.set(xlabel="seconds of fitting", ylabel="held-out PSNR [dB]", title="Both strategies, cap 100,000")
    over_time.legend(frameon=False, loc="lower right")
    loss.set(xlabel="seconds of fitting", ylabel="loss, running mean", title="0.8 L1 + 0.2 (1 - SSIM)", ylim=(0, None))
    over_count.margins(0.14)
    sizes = [results[name] for name in (*(f"cap {cap}" for cap in CAPS), "mcmc") if name in results]
    over_count.plot([s["Gaussians"] for s in sizes], [s["held-out PSNR"] for s in sizes], "o-", color=COLOURS["mcmc"])
    for size in sizes:
        label = f"{size['seconds']:.0f} s"
        place = (size["Gaussians"], size["held-out PSNR"])
        over_count.annotate(label, place, xytext=(4, -12), textcoords="offset points")
    over_count.set(xlabel="Gaussians", ylabel="held-out PSNR [dB]", title="mcmc, 10,000 steps", xscale="log")
    for axis in (over_time, loss, over_count):
        axis.grid(alpha=0.3)
        axis.spines[["top", "right"]].set_visible(False)
    with atomic_path(path) as temporary:
        figure.savefig(temporary)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    pieces = (*FITS, "speed", "loss", "lifting")
    parser.add_argument("pieces", nargs="*", metavar="PIECE", help=f"of: {', '.join(pieces)}")
    parser.add_argument("--work", type=Path, default=Path("fit_work"))
    parser.add_argument("--out", type=Path, default=Path(__file__).with_name("fit.json"))
    parser.add_argument("--pictures", type=Path, help="folder to draw fit_curves.png into")
    options = parser.parse_args()
    data = os.environ.get("SGWARP_DATA")
    if data is None:
        raise SystemExit("set SGWARP_DATA to the folder that holds room/")
    unknown = set(options.pieces) - set(pieces)
    if unknown:
        parser.error(f"unknown pieces: {', '.join(sorted(unknown))}")
    bench = Bench(Path(data) / "room", options.work)
    for piece in options.pieces or pieces:
        results = json.loads(options.out.read_text()) if options.out.is_file() else {}
        if piece in results and not options.pieces:
            continue
        others: dict[str, Callable[[], dict]] = {"speed": bench.speed, "loss": bench.loss, "lifting": bench.lifting}
        measured = others[piece]() if piece in others else bench.fit(piece)
        # Read again: another piece may have been measured at the same time.
        results = json.loads(options.out.read_text()) if options.out.is_file() else {}
        results[piece] = measured
        with atomic_path(options.out) as temporary:
            temporary.write_text(json.dumps(results, indent=1, default=np.ndarray.tolist) + "\n")
        print(f"{piece}: written to {options.out}", flush=True)
    if options.pictures is not None:
        draw(json.loads(options.out.read_text()), options.pictures / "fit_curves.png")


if __name__ == "__main__":
    main()
