"""A generated moving scene as files: Dynamic3DGaussians' layout, with label images per frame and view beside it."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import torch

from sgwarp.datasets.moving import MovingScene, with_label_noise
from sgwarp.files.atomic import atomic_path
from sgwarp.files.images import write_ids, write_rgb
from sgwarp.io.sequence_files import write_meta, write_params
from sgwarp.ops.splatting.forward import rasterize
from sgwarp.runs.progress import Report

BACKGROUND = 0.6  # gray behind the scene


def save_moving_scene(
    scene: MovingScene,
    folder: str | os.PathLike[str],
    *,
    held_out: int = 0,
    noise: float = 0.0,
    photographs: bool = True,
    progress: Report | None = None,
) -> None:
    """Write a scene.

    | file | holds |
    |---|---|
    | params.npz | the Gaussians of every frame |
    | train_meta.json, test_meta.json | cameras; the last `held_out` of them are for testing |
    | ims/{camera}/{frame:06d}.jpg | what the cameras see, rendered |
    | seg/{camera}/{frame:06d}.png | 255 where something that moves is seen |
    | labels/{frame:05d}/{camera}.png | labels of the pixels, 0 = nothing, with noise if asked for |
    | truth/{frame:05d}/{camera}.png | the same without noise |
    | labels.json | names of the labels from 1 on |

    Args:
        scene: What to write.
        folder: Created if needed.
        held_out: Cameras kept for testing.
        noise: Share of the regions of a label image that get a wrong label, see `with_label_noise`.
        photographs: Whether to render and write ims.
        progress: Called after each frame.
    """
    folder = Path(folder)
    frames, train = range(scene.frames), scene.cameras[: len(scene.cameras) - held_out]
    write_params(folder / "params.npz", [scene.gaussians(frame) for frame in frames], scene.moving)
    write_meta(folder / "train_meta.json", train, scene.frames)
    if held_out:
        write_meta(folder / "test_meta.json", scene.cameras[len(train) :], scene.frames)
    with atomic_path(folder / "labels.json") as temporary:
        temporary.write_text(json.dumps(list(scene.labels)), encoding="utf-8")
    random = torch.Generator().manual_seed(0)
    moving = torch.tensor([name not in ("floor", "pillar", "table", "lamp off", "lamp on") for name in scene.labels])
    moves = torch.cat([torch.zeros(1, dtype=torch.bool), moving])
    for frame in frames:
        gaussians = scene.gaussians(frame)
        for view in scene.cameras:
            truth = scene.truth(frame, view.camera)
            name = f"{frame:05d}/{view.stem}.png"
            write_ids(folder / "truth" / name, truth.numpy().astype(np.uint8))
            labels = with_label_noise(truth, noise, random) if noise else truth
            write_ids(folder / "labels" / name, labels.numpy().astype(np.uint8))
            write_ids(folder / "seg" / view.stem / f"{frame:06d}.png", (255 * moves[truth].numpy()).astype(np.uint8))
            if photographs:
                picture = rasterize(gaussians, view.camera, background=torch.full((3,), BACKGROUND)).features
                write_rgb(folder / "ims" / view.stem / f"{frame:06d}.jpg", picture.clamp(0, 1))
        if progress is not None:
            progress(frame + 1, scene.frames, f"frame {frame}")
