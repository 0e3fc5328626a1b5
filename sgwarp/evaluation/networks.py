"""Networks for an ablation of their inputs: trained on lifted scenes, and what they predict."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from sgwarp.datasets.catalogue import find_reader
from sgwarp.evaluation.cases import prepare
from sgwarp.evaluation.profiles.base import Profile
from sgwarp.evaluation.settings import Settings
from sgwarp.files.atomic import atomic_path
from sgwarp.files.documents import read_json
from sgwarp.io.scenes import save_gaussians
from sgwarp.io.store import save_semantics
from sgwarp.network.inputs import InputMode
from sgwarp.network.prediction import predict
from sgwarp.network.semantic_network import load_network, save_network
from sgwarp.network.training.data import scenes_in
from sgwarp.network.training.settings import DistillSettings
from sgwarp.network.training.trainer import distill
from sgwarp.runs.log import RunLog

STATE, TIME = "network.state.pt", "seconds.json"


@dataclass(frozen=True)
class NetworkSettings:
    """How networks are trained.

    Attributes:
        epochs: Times that every scene is seen.
        arch: Architecture.
        voxel: Side of a voxel [m].
        train: Root of a data set to train on; the evaluated scenes themselves if None.
    """

    epochs: int = 30
    arch: str = "14A"
    voxel: float = 0.05
    train: Path | None = None


def train_and_predict(
    profile: Profile,
    data: Path,
    folder: Path,
    settings: Settings,
    scenes: Sequence[str],
    inputs: InputMode,
    network: NetworkSettings,
) -> tuple[str, float]:
    """Pattern of the files with what a network with these inputs predicts, and the seconds that its training took.

    What is there already is kept, and an interrupted training goes on: the folder belongs to one set of choices.

    Raises:
        InputError: A scene cannot be lifted, or there is nothing to learn from.
    """
    own = network.train is None
    root = data if network.train is None else network.train
    names = list(scenes) if own else find_reader(profile.reader).list_scenes(root)
    lifted = folder.parent / "lifted"
    for name in names:
        _lift(profile, root, lifted, settings, name)
    net = folder / "network.safetensors"
    if not net.is_file():
        chosen = DistillSettings(
            arch=network.arch,
            inputs=inputs,
            voxel=network.voxel,
            epochs=network.epochs,
            augment=None,
        )
        folder.mkdir(parents=True, exist_ok=True)
        paths = [lifted / f"{_file(name)}.ply" for name in names]
        trained, history = distill(scenes_in(paths), chosen, state=folder / STATE, device=settings.device)
        with atomic_path(folder / TIME) as temporary:
            temporary.write_text(json.dumps(sum(epoch.seconds for epoch in history)), encoding="utf-8")
        save_network(trained, net, {"inputs": inputs})
        (folder / STATE).unlink(missing_ok=True)
    for name in scenes:
        path = folder / f"{_file(name)}.safetensors"
        if not path.is_file():
            case = prepare(find_reader(profile.reader).open_scene(data, name), settings, profile.split, RunLog())
            predicted = predict(case.gaussians, load_network(net).to(settings.device)).semantics()
            save_semantics(predicted, path, {"network": str(net)})
    return f"{folder}/{{file}}.safetensors", float(read_json(folder / TIME))


def _lift(profile: Profile, root: Path, folder: Path, settings: Settings, name: str) -> None:
    path = folder / f"{_file(name)}.safetensors"
    if path.is_file():
        return
    case = prepare(find_reader(profile.reader).open_scene(root, name), settings, profile.split, RunLog())
    save_gaussians(case.gaussians, folder / f"{_file(name)}.ply")
    save_semantics(case.semantics[0], path, {"encoder": settings.encoder})


def _file(name: str) -> str:
    return name.replace("/", "__")
