"""What a fit starts from, and what that is worth: the room with points, without, and without poses.

    SGWARP_DATA=FOLDER python -m benchmarks.starts [START ...] [--steps N] [--cap N] [--downscale N] [--repeats N]

Each start is fitted and added to benchmarks/starts.json: PSNR of the held-out views, the gap to the fitted ones, mIoU
of true labels lifted into the scene, and seconds. `photographs` finds the poses as well, those of held-out views too,
which are then also refined to the finished scene (`PSNR_refined_poses`). `noisy` starts from points, with the poses of
the fitted photographs half a degree and two centimeters off; `refined` also refines them.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

import sgwarp as sg
from benchmarks.room import HOLD_OUT, FullRoom, label_iou
from sgwarp.files.atomic import atomic_path
from sgwarp.ops.launcher import get_threads
from sgwarp.reconstruction.fitting.initial import depth_from_folder
from sgwarp.reconstruction.fitting.settings import FitSettings
from sgwarp.reconstruction.sfm.features import SfmSettings
from sgwarp.reconstruction.sfm.poses import estimate_poses
from sgwarp.reconstruction.sfm.triangulation import triangulate

STARTS = ("depth", "points", "photographs", "triangulated", "random", "noisy", "refined")
DEGREES, METERS = 0.5, 0.02  # of noise
EVALUATIONS = 5


def begin(start: str, folder: Path, work: Path, settings: FitSettings) -> tuple[list[sg.View], Any]:
    """Views, and what to start from."""
    sfm = SfmSettings(threads=get_threads())
    if start == "photographs":
        print(estimate_poses(folder / "images", work, sfm).summary())
        return sg.load_views(work), sg.load_points(work)
    views = sg.load_views(folder)
    kept = [view for index, view in enumerate(views) if index % HOLD_OUT]
    if start == "depth":
        return views, sg.gaussians_from_depth(kept, depth_from_folder(folder / "depth"), count=settings.cap)
    if start in ("points", "noisy", "refined"):
        return views, sg.load_points(folder)
    return views, triangulate(kept, sfm) if start == "triangulated" else None


def shaken(views: list[sg.View], seed: int = 0) -> list[sg.View]:
    """The views with every camera turned by DEGREES about a random axis, and moved METERS in a random direction."""
    random = np.random.default_rng(seed)
    found = []
    for view in views:
        axis, shift = (vector / np.linalg.norm(vector) for vector in random.normal(size=(2, 3)))
        noise = np.eye(4)
        noise[:3, :3], noise[:3, 3] = cv2.Rodrigues(np.radians(DEGREES) * axis)[0], METERS * shift
        pose = torch.from_numpy(noise) @ view.camera.world_to_camera
        found.append(replace(view, camera=replace(view.camera, world_to_camera=pose)))
    return found


def measure(start: str, folder: Path, settings: FitSettings, downscale: int) -> dict[str, float]:
    """One row of the table."""
    began = time.perf_counter()
    with tempfile.TemporaryDirectory() as work:
        views, first = begin(start, folder, Path(work), settings)
        held_out = views[::HOLD_OUT]
        kept = [view for index, view in enumerate(views) if index % HOLD_OUT]
        if start in ("noisy", "refined"):
            kept = shaken(kept)
        settings = replace(settings, refine_poses=start == "refined", refine_held_out=start == "photographs")
        fitted = sg.fit(kept, first, held_out, settings, downscale=downscale)
        kept = list(fitted.views)
        seconds = time.perf_counter() - began
        names = json.loads((folder / "classes.json").read_text())
        named = tuple(names[str(number)] for number in range(1, len(names)))
        room = FullRoom(folder, fitted.gaussians, kept, held_out, named)
        iou = label_iou(room, sg.lift(fitted.gaussians, kept, room.label_map))["mIoU"]
    last = fitted.curve[-1].psnr
    row = {"PSNR": last, "gap": fitted.fitted_psnr - last, "mIoU": iou, "seconds": seconds}
    if fitted.held_out_refined:
        row["PSNR_refined_poses"] = float(np.mean(list(fitted.held_out_refined.values())))
    return row


def mean_of(rows: list[dict[str, float]]) -> dict[str, Any]:
    """Means of the figures, and each PSNR where there are several: structure from motion is not the same twice."""
    means: dict[str, Any] = {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
    return means | ({"PSNR_of_each": [row["PSNR"] for row in rows]} if len(rows) > 1 else {})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("starts", nargs="*", choices=[*STARTS, []], default=STARTS)
    parser.add_argument("--steps", type=int, default=1500)
    parser.add_argument("--cap", type=int, default=30_000)
    parser.add_argument("--downscale", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path(__file__).with_name("starts.json"))
    options = parser.parse_args()
    data = os.environ.get("SGWARP_DATA")
    if data is None:
        raise SystemExit("set SGWARP_DATA to the folder that holds room/")
    steps = options.steps
    settings = FitSettings(
        steps=steps, cap=options.cap, evaluate_every=max(1, steps // EVALUATIONS), degree_every=max(1, steps // 4)
    )
    for start in options.starts:
        row = mean_of(
            [measure(start, Path(data) / "room", settings, options.downscale) for _ in range(options.repeats)]
        )
        results = json.loads(options.out.read_text()) if options.out.is_file() else {}
        results[start] = row | {"steps": steps, "cap": options.cap, "downscale": options.downscale}
        with atomic_path(options.out) as temporary:
            temporary.write_text(json.dumps(results, indent=1) + "\n")
        print(start, row, flush=True)


if __name__ == "__main__":
    main()
