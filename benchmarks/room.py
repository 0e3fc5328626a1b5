"""The whole path on the full room: segmentation and localisation on held-out views, error beside run time.

    SGWARP_DATA=FOLDER python -m benchmarks.room [--count 200000] [--out benchmarks/room.json]

The folder holds room/: 60 posed views with depth and label images; every eighth is held out. Gaussians are made from
the RGB-D of the others. Lifting their true labels measures the projection alone (`weighted` and the paper's `center`);
lifting the default encoder's maps measures the whole.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

import sgwarp as sg
from sgwarp.demo.data import FURNITURE, Room
from sgwarp.demo.measurement import Measurement, measure
from sgwarp.demo.sheets import draw_queries, draw_segmentation
from sgwarp.files.images import read_ids
from sgwarp.metrics.segmentation import ConfusionMatrix
from sgwarp.querying.scores import class_votes
from sgwarp.querying.segmentation import segment_votes
from sgwarp.reconstruction.depth import gaussians_from_depth
from sgwarp.scene import FeatureMap, View
from tools.build_demo_room import SHOWN

HOLD_OUT = 8


@dataclass(frozen=True, eq=False)
class FullRoom(Room):
    """The room with all label images in one folder."""

    @classmethod
    def build(cls, folder: Path, count: int) -> FullRoom:
        views = sg.load_views(folder)
        train = [view for index, view in enumerate(views) if index % HOLD_OUT]

        def depth(view: View) -> np.ndarray:
            return read_ids(folder / "depth" / f"{view.stem}.png").astype(np.float32) * np.float32(0.001)

        names = json.loads((folder / "classes.json").read_text())
        named = tuple(names[str(number)] for number in range(1, len(names)))
        return cls(folder, gaussians_from_depth(train, depth, count=count), train, views[::HOLD_OUT], named)

    @property
    def truth(self) -> dict[str, Tensor]:
        return {view.stem: self._classes(self.folder, view).long() for view in self.held_out}

    def label_map(self, view: View) -> FeatureMap:
        return FeatureMap("labels", ids=self._classes(self.folder, view), labels=self.names)


def label_iou(room: FullRoom, semantics: sg.Semantics) -> dict[str, float]:
    """IoU of all fourteen classes over the held-out views, one confusion matrix."""
    votes = class_votes(semantics, room.names)
    confusion = ConfusionMatrix.empty(len(room.names))
    for view in room.held_out:
        channel, _ = segment_votes(room.gaussians, view.camera, votes, semantics.seen)
        confusion.add(channel, room.truth[view.stem])
    return {"mIoU": confusion.miou} | dict(zip(room.names, confusion.iou.tolist(), strict=True))


def psnr(room: FullRoom) -> float:
    """Mean over the held-out views [dB]."""
    values = []
    for view in room.held_out:
        error = (sg.render(room.gaussians, view.camera).clamp(0, 1) - view.image()).square().mean()
        values.append(-10 * float(torch.log10(error)))
    return float(np.mean(values))


def objects_found(result: Measurement) -> int:
    """Objects hit in at least half of the held-out views that show them."""
    sights: dict[str, list[bool]] = {}
    for finding in result.findings:
        sights.setdefault(finding.name, []).append(finding.hit)
    return sum(2 * sum(hits) >= len(hits) for hits in sights.values())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=200_000)
    parser.add_argument("--out", type=Path, default=Path(__file__).with_name("room.json"))
    parser.add_argument("--pictures", type=Path, help="folder to draw the queries and two segmented views into")
    options = parser.parse_args()
    data = os.environ.get("SGWARP_DATA")
    if data is None:
        raise SystemExit("set SGWARP_DATA to the folder that holds room/")
    start = time.perf_counter()
    room = FullRoom.build(Path(data) / "room", options.count)
    results: dict[str, object] = {"Gaussians": len(room.gaussians), "seconds to build": time.perf_counter() - start}
    results["PSNR of the held-out renders"] = psnr(room)
    for mode in ("weighted", "center"):
        start = time.perf_counter()
        semantics = sg.lift(room.gaussians, room.views, room.label_map, mode=mode)
        seconds = time.perf_counter() - start
        results[f"true labels, {mode}"] = {
            "seconds": seconds,
            "coverage": semantics.coverage,
            "IoU": label_iou(room, semantics),
        }
    encoder = sg.make_encoder("conse", room.views)
    start = time.perf_counter()
    semantics = sg.lift(room.gaussians, room.views, encoder)
    seconds = time.perf_counter() - start
    result = measure(room, semantics, encoder)
    results["encoder conse"] = {
        "seconds": seconds,
        "coverage": semantics.coverage,
        "objects found in half of their views or more": objects_found(result),
        "objects found where they are largest": result.localised,
        "sights": len(result.findings),
        "sights found": sum(finding.hit for finding in result.findings),
        "furniture mIoU": result.miou,
        "IoU": dict(zip(room.furniture, result.confusion.iou[:FURNITURE].tolist(), strict=True)),
    }
    if options.pictures is not None:
        options.pictures.mkdir(parents=True, exist_ok=True)
        draw_queries(room, result, options.pictures / "queries.png")
        shown = replace(room, held_out=[view for view in room.held_out if view.stem in SHOWN])
        draw_segmentation(shown, [("encoder conse", result)], options.pictures / "segmentation.png")
    options.out.write_text(json.dumps(results, indent=1) + "\n")
    print(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
