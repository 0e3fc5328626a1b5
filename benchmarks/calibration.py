"""What answers paint that is not there: scorings of the default encoder, on the room they were chosen on and elsewhere.

    SGWARP_DATA=FOLDER python -m benchmarks.calibration [room] [generated] [--castle SCENE.ply VIEWS]

room: furniture mIoU, precision and recall over the pixels of four held-out views of the rendered room, and the share of
pixels painted with one of twelve things that are not there; also for other settings of the calibration. generated: the
same on a room of the generator. castle: a fitted scene of photographs and its views, without truth.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import sgwarp as sg
from benchmarks.room import FullRoom
from sgwarp.datasets.synthetic import CLASSES, make_room, room_cameras
from sgwarp.encoders.cache import CachedMaps, default_folder
from sgwarp.encoders.calibration import PLAIN, Calibration
from sgwarp.encoders.catalogue import CONSE
from sgwarp.encoders.registry import text_encoder_for
from sgwarp.querying.scores import class_votes
from sgwarp.querying.segmentation import segment_votes
from sgwarp.scene import Camera, Gaussians, Semantics, View

ABSENT = "fox bookcase desk zebra airliner banana television toaster castle sports_car dog umbrella"
ELSEWHERE = "fox zebra airliner banana toaster sports_car dog umbrella"
WALLS = ("fox", "bookcase", "wall", "desk")
WAYS = {"cosine": PLAIN["cosine"], "evidence, before": PLAIN["evidence"], "calibrated": CONSE}
SETTINGS = {
    f"deviation {least}, certain {certain}": replace(CONSE, least_deviation=least, certain=certain)
    for least, certain in ((0.0, 0.5), (0.01, 0.5), (0.04, 0.5), (0.02, 0.2), (0.02, 0.1))
}


@dataclass
class Speaker:
    """The default encoder's text side with another calibration."""

    calibration: Calibration

    def __post_init__(self) -> None:
        self.text = text_encoder_for(CONSE_SPACE)
        self.space = self.text.space

    def encode_text(self, texts: Sequence[str]) -> Tensor:
        return self.text.encode_text(texts)


CONSE_SPACE = "conse-efficientnet-lite2-minilm-512"


@dataclass(frozen=True, eq=False)
class Scene:
    """Lifted semantics, cameras to answer in, and truth by class name where there is some."""

    gaussians: Gaussians
    semantics: Semantics
    cameras: list[Camera]
    truth: list[dict[str, Tensor]]

    def answer(self, names: Sequence[str], way: Calibration) -> dict[str, float]:
        """Share of pixels painted, and against the truth precision, recall and mIoU of the names."""
        votes = class_votes(self.semantics, names, Speaker(way))
        found = [segment_votes(self.gaussians, camera, votes, self.semantics.seen)[0] for camera in self.cameras]
        figures = {"painted": sum(float((image >= 0).float().mean()) for image in found) / len(found)}
        if not self.truth or not all(name in self.truth[0] for name in names):
            return figures
        hits = torch.zeros(3, len(names), dtype=torch.float64)  # both, found, true
        for image, truth in zip(found, self.truth, strict=True):
            for k, name in enumerate(names):
                both = (image == k) & truth[name]
                hits[:, k] += torch.tensor([both.sum(), (image == k).sum(), truth[name].sum()])
        both, mine, true = hits
        shown = true > 0
        return figures | {
            "mIoU": float((both / (mine + true - both))[shown].mean()),
            "precision": float(both.sum() / mine.sum()),
            "recall": float(both.sum() / true.sum()),
        }


def lifted(gaussians: Gaussians, views: list[View]) -> Semantics:
    return sg.lift(gaussians, views, CachedMaps(sg.make_encoder("conse", views), default_folder()))


def room(folder: Path, count: int) -> tuple[Scene, tuple[str, ...]]:
    full = FullRoom.build(folder, count)
    held = full.held_out[::2]
    cameras = [view.camera.resized(view.camera.height // 2, view.camera.width // 2) for view in held]
    truth = [{n: full.truth[v.stem][::2, ::2] == k for k, n in enumerate(full.furniture)} for v in held]
    return Scene(full.gaussians, lifted(full.gaussians, full.views), cameras, truth), full.furniture


def generated(seed: int = 1, count: int = 40_000) -> Scene:
    one = make_room(seed, count)
    views = [View(f"{k:04d}", camera) for k, camera in enumerate(room_cameras(one, seed, 32, 320, 240))]
    cameras = [view.camera for view in views[::8]]
    shares = torch.nn.functional.one_hot(one.classes, len(CLASSES)).float()
    seen = torch.ones(len(shares), dtype=torch.bool)
    images = [segment_votes(one.gaussians, camera, shares, seen)[0] for camera in cameras]
    truth = [{name: image == k for k, name in enumerate(CLASSES)} for image in images]
    return Scene(one.gaussians, lifted(one.gaussians, [v for k, v in enumerate(views) if k % 8]), cameras, truth)


def castle(scene: Path, folder: Path) -> Scene:
    gaussians, views = sg.load_gaussians(scene), sg.load_views(folder)
    cameras = [view.camera.resized(view.camera.height * 320 // view.camera.width, 320) for view in views[::3]]
    return Scene(gaussians, lifted(gaussians, views), cameras, [])


def words(text: str) -> list[str]:
    return [word.replace("_", " ") for word in text.split()]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", choices=["room", "generated", []], help="both if none is named")
    parser.add_argument("--castle", type=Path, nargs=2, metavar=("SCENE", "VIEWS"))
    parser.add_argument("--count", type=int, default=60_000, help="Gaussians of the rendered room")
    parser.add_argument("--out", type=Path, default=Path(__file__).with_name("calibration.json"))
    options = parser.parse_args()
    data = os.environ.get("SGWARP_DATA")
    if data is None:
        raise SystemExit("set SGWARP_DATA to the folder that holds room/")
    results: dict[str, Any] = json.loads(options.out.read_text()) if options.out.is_file() else {}
    asked = options.parts or ["room", "generated"]

    def ask(title: str, scene: Scene, questions: dict[str, Sequence[str]], ways: dict[str, Calibration]) -> None:
        for what, names in questions.items():
            for way, calibration in ways.items():
                row = results[f"{title} | {what} | {way}"] = scene.answer(names, calibration)
                print(f"{title} | {what} | {way}:", {k: round(v, 4) for k, v in row.items()}, flush=True)
        options.out.write_text(json.dumps(results, indent=1) + "\n")

    if "room" in asked:
        scene, furniture = room(Path(data) / "room", options.count)
        ask("room", scene, {"furniture": furniture, "absent": words(ABSENT)}, WAYS | SETTINGS)
    kinds = [name for name in CLASSES if name not in ("floor", "ceiling", "wall")]
    elsewhere: dict[str, Sequence[str]] = {"absent": words(ELSEWHERE), "fox, bookcase, wall, desk": WALLS}
    if "generated" in asked:
        ask("generated", generated(), {"furniture": kinds} | elsewhere, WAYS)
    if options.castle:
        ask("castle", castle(*options.castle), elsewhere | {"palace": ["palace"]}, WAYS)


if __name__ == "__main__":
    main()
