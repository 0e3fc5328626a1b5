"""Does the network learn what it is lifted? Procedural rooms: trained on some, measured on others.

    python benchmarks/distill.py [--train 12] [--test 4] [--epochs 40] [--loss cosine] [--out benchmarks/distill.json]

The stand-in for a 2D encoder sees the rooms' true pieces of furniture and names them with errors, in the words of a toy
text space: in every view a piece is taken for something else with probability 0.25, and some pieces (0.15) are taken
for the same wrong thing in all views of their room, which no averaging over views can repair. Lifted into 12 rooms this
trains a MinkUNet14A; measured is the mIoU over the Gaussians of the unseen rooms, against the true classes, of the
projection (2D), the network (3D) and their ensembles, and of a network that sees colours alone. --loss contrastive
trains on the masks of the same views instead, whose rendered features have to be nearest to the mask's own vector.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from sgwarp.datasets.synthetic import CLASSES, Room, make_room, room_cameras
from sgwarp.lifting.lifter import lift
from sgwarp.metrics.segmentation import ConfusionMatrix
from sgwarp.network.augmentation import Augmentation
from sgwarp.network.inputs import InputMode
from sgwarp.network.prediction import predict
from sgwarp.network.quality import projection_quality
from sgwarp.network.training.contrastive import MaskedView
from sgwarp.network.training.data import TrainingScene
from sgwarp.network.training.settings import DistillSettings
from sgwarp.network.training.trainer import distill
from sgwarp.querying.ensembles import seen_by
from sgwarp.querying.scores import class_votes
from sgwarp.rendering.renderer import render
from sgwarp.runs.log import RunLog
from sgwarp.scene import FeatureMap, Semantics, View

CHANNELS = 32
WRONG_IN_A_VIEW, WRONG_IN_A_ROOM = 0.25, 0.15
ENSEMBLES = ("2d", "3d", "max", "sum", "mean")


class ToyText:
    """A unit vector per class; any two have a cosine around 0.3, as those of a text encoder have."""

    space = "toy"

    def __init__(self) -> None:
        rng = torch.Generator().manual_seed(0)
        common, own = torch.randn(CHANNELS, generator=rng), torch.randn(len(CLASSES), CHANNELS, generator=rng)
        self.vectors = torch.nn.functional.normalize(0.65 * common + own, dim=1)

    def encode_text(self, texts: list[str]) -> Tensor:
        return self.vectors[[CLASSES.index(text) for text in texts]]


def noisy_classes(truth: Tensor, share: float, rng: torch.Generator) -> Tensor:
    """Classes with a share of them replaced at random."""
    wrong = torch.rand(len(truth), generator=rng) < share
    return torch.where(wrong, torch.randint(len(CLASSES), truth.shape, generator=rng), truth)


def lifted_room(seed: int, count: int, views: int) -> tuple[Room, Semantics, list[MaskedView]]:
    """A room, what the erring encoder's maps say of it, and those maps."""
    room, text = make_room(seed, count), ToyText()
    rng = torch.Generator().manual_seed(seed + 10_000)
    believed = noisy_classes(room.class_of_piece, WRONG_IN_A_ROOM, rng)
    one_hot = torch.eye(len(room.class_of_piece))[room.pieces]
    maps, posed = {}, []
    for number, camera in enumerate(room_cameras(room, seed, views)):
        view = View(f"{number:02d}", camera)
        ids = render(room.gaussians, camera, "features", one_hot).argmax(dim=2)
        named = text.vectors[noisy_classes(believed, WRONG_IN_A_VIEW, rng)]
        vectors = named + 0.1 * torch.randn(named.shape, generator=rng)
        maps[view.stem] = FeatureMap("toy", ids=ids, vectors=vectors)
        posed.append(view)
    semantics = lift(room.gaussians, posed, maps)
    return room, semantics, [MaskedView(view.camera, maps[view.stem]) for view in posed]


def measure(rooms: list[tuple[Room, Semantics]], predicted: list[Semantics]) -> dict[str, dict[str, float]]:
    """Figures of every ensemble over the Gaussians of all rooms together, and over those that some view saw."""
    text, results = ToyText(), {}
    for how in ENSEMBLES:
        everywhere, where_seen = ConfusionMatrix.empty(len(CLASSES)), ConfusionMatrix.empty(len(CLASSES))
        for (room, projected), other in zip(rooms, predicted, strict=True):
            votes = class_votes(projected, CLASSES, text, predicted=other, ensemble=how)  # type: ignore[arg-type]
            known = seen_by(projected, other, how)  # type: ignore[arg-type]
            answer = torch.where(known, votes.argmax(dim=1), -1)
            everywhere.add(answer, room.classes)
            where_seen.add(answer[projected.seen], room.classes[projected.seen])
        results[how] = {
            "mIoU": everywhere.miou,
            "mAcc": everywhere.macc,
            "accuracy": everywhere.pixel_accuracy,
            "unknown": everywhere.unknown,
            "mIoU where a view saw it": where_seen.miou,
        }
    return results


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--train", type=int, default=12)
    parser.add_argument("--test", type=int, default=4)
    parser.add_argument("--epochs", type=int, default=40)
    parser.add_argument("--count", type=int, default=20_000, help="Gaussians in a room")
    parser.add_argument("--views", type=int, default=8, help="views lifted into a room")
    parser.add_argument("--voxel", type=float, default=0.1)
    parser.add_argument("--arch", default="14A")
    parser.add_argument("--inputs", nargs="+", default=["full", "xyz-rgb"])
    parser.add_argument("--loss", choices=["cosine", "contrastive"], default="cosine")
    parser.add_argument("--out", type=Path, default=Path(__file__).with_name("distill.json"))
    options = parser.parse_args()
    rooms = [lifted_room(seed, options.count, options.views) for seed in range(options.train + options.test)]
    train, test = rooms[: options.train], [(room, semantics) for room, semantics, _ in rooms[options.train :]]
    quality = [projection_quality(semantics) for _, semantics in test]
    results: dict[str, object] = json.loads(options.out.read_text()) if options.out.exists() else {}
    results |= {name: value for name, value in vars(options).items() if name not in ("out", "inputs", "loss", "epochs")}
    results["coverage of the test rooms"] = sum(q.coverage for q in quality) / len(quality)
    results["reliability of the test rooms"] = sum(q.reliability for q in quality) / len(quality)
    scenes = [
        TrainingScene(
            f"room {k}",
            lambda room=room, semantics=semantics: (room.gaussians, semantics),  # type: ignore[misc]
            masks=lambda views=views: [lambda view=view: view for view in views],  # type: ignore[misc]
        )
        for k, (room, semantics, views) in enumerate(train)
    ]
    settings = DistillSettings(
        arch=options.arch,
        voxel=options.voxel,
        epochs=options.epochs,
        scenes_per_step=2,
        augment=Augmentation(up=1, elastic=()),
        loss=options.loss,
    )
    for inputs in options.inputs:
        mode: InputMode = inputs
        start, log = time.perf_counter(), RunLog()
        network, history = distill(scenes, replace(settings, inputs=mode), log=log)
        seconds = time.perf_counter() - start
        predicted = [predict(room.gaussians, network).semantics() for room, _ in test]
        figures = measure(test, predicted)
        name = inputs if options.loss == "cosine" else f"{inputs}, {options.loss}"
        results[name] = {
            "epochs": options.epochs,
            "seconds": seconds,
            "loss": [epoch.loss for epoch in history],
            **figures,
        }
        print(f"{name}: {seconds:.0f} s, loss {history[0].loss:.3f} to {history[-1].loss:.3f}")
        for how, row in figures.items():
            print(
                f"  {how:5s} mIoU {row['mIoU']:.3f}  mAcc {row['mAcc']:.3f}  unknown {row['unknown']:.3f}", flush=True
            )
    options.out.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
