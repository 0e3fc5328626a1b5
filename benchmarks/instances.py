"""Instances of the full room: quality on held-out views, association, how faults of masks degrade it, time and memory.

    SGWARP_DATA=FOLDER python -m benchmarks.instances [--out benchmarks/instances.json] [--pictures DIR] [--memory]

The folder holds room/. Masks are the true label images with their ids shuffled in every view, the same with a fifth of
the masks dropped, merged or split at random, and OpenCV's proposals alone. `--memory` instead joins 200 views of 60
masks in a scene of 1,000,000 Gaussians and reports the peak of the process.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree

import sgwarp as sg
from benchmarks.room import FullRoom
from sgwarp.apps.instances.association import build_graph, join_masks
from sgwarp.apps.instances.evidence import ViewEvidence
from sgwarp.apps.instances.finder import find
from sgwarp.apps.instances.maps import draw_ids, render_ids
from sgwarp.apps.instances.settings import InstanceSettings
from sgwarp.encoders.masks.sources import ViewMasks
from sgwarp.encoders.registry import make_mask_source
from sgwarp.files.images import read_ids, write_rgb
from sgwarp.runs.log import RunLog
from sgwarp.scene import Gaussians, InstanceMap, View

Mask = NDArray[np.bool_]
Faults = Callable[[list[Mask], np.random.Generator], list[Mask]]
CLASSES = 14


@dataclass
class Labels:
    """True label images as masks without ids, in random order, with faults of one kind."""

    folder: Path
    faults: Faults = lambda masks, random: masks
    needs_image: bool = False
    truth: dict[str, list[int]] = field(default_factory=dict)

    def read(self, view: View, image: torch.Tensor | None) -> ViewMasks:
        ids = read_ids(self.folder / "labels" / f"{view.stem}.png")
        random = np.random.default_rng([7, int(view.stem)])
        masks = self.faults([ids == k for k in random.permutation(np.unique(ids[ids > 0]))], random)
        masks = [mask for mask in masks if mask.any()]
        self.truth[view.stem] = [int(np.bincount(ids[mask]).argmax()) for mask in masks]
        return ViewMasks(torch.from_numpy(np.stack(masks)), torch.full((len(masks),), -1))


@dataclass
class Known:
    """Any source of masks, with the class that most pixels of each mask have."""

    source: object
    folder: Path
    needs_image: bool = True
    truth: dict[str, list[int]] = field(default_factory=dict)

    def read(self, view: View, image: torch.Tensor | None) -> ViewMasks:
        found = self.source.read(view, image)  # type: ignore[attr-defined]
        ids = read_ids(self.folder / "labels" / f"{view.stem}.png")
        self.truth[view.stem] = [int(np.bincount(ids[mask]).argmax()) for mask in found.masks.numpy()]
        return found


def drop(share: float) -> Faults:
    return lambda masks, random: [mask for mask in masks if random.random() >= share]


def merge(share: float) -> Faults:
    """Unite masks with another mask of the view."""

    def apply(masks: list[Mask], random: np.random.Generator) -> list[Mask]:
        kept, loose = [], []
        for mask in masks:
            (loose if random.random() < share else kept).append(mask)
        for mask in loose:
            if not kept:
                return loose
            place = int(random.integers(len(kept)))
            kept[place] = kept[place] | mask
        return kept

    return apply


def split(share: float) -> Faults:
    """Cut masks in two by a straight line."""

    def apply(masks: list[Mask], random: np.random.Generator) -> list[Mask]:
        parts = []
        for mask in masks:
            if random.random() >= share:
                parts.append(mask)
                continue
            angle = random.uniform(0, np.pi)
            y, x = np.indices(mask.shape)
            across = np.cos(angle) * x + np.sin(angle) * y
            side = across < np.quantile(across[mask], random.uniform(0.3, 0.7))
            parts += [mask & side, mask & ~side]
        return parts

    return apply


def in_turn(share: float) -> Faults:
    """A third of the faults of each kind."""
    kinds = [drop(share / 3), merge(share / 3), split(share / 3)]

    def apply(masks: list[Mask], random: np.random.Generator) -> list[Mask]:
        for kind in kinds:
            masks = kind(masks, random)
        return masks

    return apply


def matched_iou(room: FullRoom, found: InstanceMap) -> NDArray[np.float64]:
    """IoU over the held-out views of every class with the instance matched to it one to one, [14]."""
    counts = np.zeros((CLASSES + 1, len(found.table) + 1))
    for view in room.held_out:
        ids, _ = render_ids(room.gaussians, found, view.camera)
        truth = read_ids(room.folder / "labels" / f"{view.stem}.png")
        np.add.at(counts, (truth.ravel(), ids.numpy().ravel()), 1)
    both = counts[1:, 1:]
    iou = both / np.maximum(counts[1:].sum(1)[:, None] + counts[1:, 1:].sum(0)[None] - both, 1)
    rows, columns = linear_sum_assignment(-iou)
    matched = np.zeros(CLASSES)
    matched[rows] = iou[rows, columns]
    return matched


def pair_scores(evidence: list[ViewEvidence], truth: list[int], count: int) -> dict[str, float]:
    """How many pairs of masks that were joined belong together, and how many that belong together were joined."""
    groups, seconds = associate(evidence, count)
    table = np.zeros((CLASSES + 1, groups.max() + 1))
    np.add.at(table, (np.array(truth), groups), 1)

    def pairs(n: NDArray[np.float64]) -> float:
        return float((n * (n - 1) / 2).sum())

    together = pairs(table)
    return {
        "precision": together / max(pairs(table.sum(0)), 1.0),
        "recall": together / max(pairs(table.sum(1)), 1.0),
        "masks": len(truth),
        "groups": int(groups.max() + 1),
        "CPU seconds": seconds,
    }


def associate(evidence: list[ViewEvidence], count: int) -> tuple[NDArray[np.int64], float]:
    """Group of each mask, and the processor time it took, which other work on the machine hardly changes."""
    settings = InstanceSettings()
    start = time.process_time()
    groups = join_masks(build_graph(evidence, "default", count, settings), settings)
    return groups, time.process_time() - start


def measure(room: FullRoom, source: Labels | Known, pictures: Path | None) -> dict[str, object]:
    log = RunLog()
    start = time.perf_counter()
    found, evidence = find(room.gaussians, room.views, source, log=log)
    seconds = time.perf_counter() - start
    iou = matched_iou(room, found)
    truth = [label for view in evidence for label in source.truth[view.stem]]
    if pictures is not None:
        for view in room.held_out[:3]:
            ids, _ = render_ids(room.gaussians, found, view.camera)
            write_rgb(pictures / f"{view.stem}.png", draw_ids(view.image(), ids, found))
    stored = found.candidates.numel() * 2 + found.shares.numel() * 2 + found.observations.numel() * 2
    return {
        "mean IoU": float(iou.mean()),
        "IoU": dict(zip(room.names, iou.round(3).tolist(), strict=True)),
        "instances": len(found.table),
        "association": pair_scores(evidence, truth, len(room.gaussians)),
        "seconds": seconds,
        "stages": log.stages,
        "undecided": log.error["undecided"],
        "bytes per Gaussian stored": stored / len(room.gaussians),
        "bytes per Gaussian of evidence": sum(view.nbytes for view in evidence) / len(room.gaussians),
    }


@dataclass
class Cells:
    """Masks that show which of many cells of space the front-most Gaussian of a pixel lies in."""

    gaussians: Gaussians
    cell: NDArray[np.int64]
    needs_image: bool = False
    masks: int = 0

    def read(self, view: View, image: torch.Tensor | None) -> ViewMasks:
        front = sg.top_contributors(self.gaussians, view.camera, k=1)[0][..., 0].long()
        ids = torch.where(front >= 0, torch.from_numpy(self.cell)[front], -1)
        present = ids[ids >= 0].unique()
        self.masks += len(present)
        return ViewMasks(ids == present[:, None, None], torch.full((len(present),), -1))


def measure_memory(folder: Path) -> dict[str, object]:
    """200 views of about 60 masks in a scene of 1,000,000 Gaussians."""
    room = FullRoom.build(folder, 1_000_000)
    random = np.random.default_rng(0)
    means = room.gaussians.means.numpy()
    seeds = means[random.choice(len(means), 130, replace=False)]
    source = Cells(room.gaussians, cKDTree(seeds).query(means)[1].astype(np.int64))
    views = [
        replace(view, stem=f"{view.stem}_{turn}", camera=moved(view, 0.05 * turn), image_path=None)
        for turn in range(4)
        for view in room.views
    ][:200]
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    log = RunLog()
    found, evidence = find(room.gaussians, views, source, log=log)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return {
        "Gaussians": len(room.gaussians),
        "views": len(views),
        "masks per view": source.masks / len(views),
        "instances": len(found.table),
        "peak of the process [GB]": peak * 1024 / 1e9,
        "of it before [GB]": before * 1024 / 1e9,
        "evidence [GB]": sum(view.nbytes for view in evidence) / 1e9,
        "stages": log.stages,
        "association [CPU seconds]": associate(evidence, len(room.gaussians))[1],
    }


def moved(view: View, distance: float) -> sg.Camera:
    """The view's camera moved to its right [m]."""
    pose = view.camera.world_to_camera.clone()
    pose[0, 3] -= distance
    return replace(view.camera, world_to_camera=pose)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=200_000)
    parser.add_argument("--out", type=Path, default=Path(__file__).with_name("instances.json"))
    parser.add_argument("--pictures", type=Path, help="folder to draw three held-out views of each case into")
    parser.add_argument("--only", help="only this case")
    parser.add_argument("--memory", action="store_true")
    options = parser.parse_args()
    data = os.environ.get("SGWARP_DATA")
    if data is None:
        raise SystemExit("set SGWARP_DATA to the folder that holds room/")
    folder = Path(data) / "room"
    results = json.loads(options.out.read_text()) if options.out.is_file() else {}
    if options.memory:
        results["memory"] = measure_memory(folder)
        print(json.dumps(results["memory"], indent=1))
    else:
        room = FullRoom.build(folder, options.count)
        results["Gaussians"] = len(room.gaussians)
        cases: dict[str, Labels | Known] = {
            "shuffled ids": Labels(folder),
            "a fifth dropped": Labels(folder, drop(0.2)),
            "a fifth merged": Labels(folder, merge(0.2)),
            "a fifth split": Labels(folder, split(0.2)),
            "a fifth dropped, merged or split": Labels(folder, in_turn(0.2)),
            "graph proposals": Known(make_mask_source("graph"), folder),
            "graph proposals, coarse": Known(make_mask_source("graph?scales=1500"), folder),
        }
        for name, source in cases.items():
            if options.only in (None, name):
                pictures = options.pictures and options.pictures / name.replace(" ", "_")
                results[name] = measure(room, source, pictures)
                print(name, json.dumps(results[name], indent=1), flush=True)
                options.out.write_text(json.dumps(results, indent=1) + "\n")
    options.out.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
