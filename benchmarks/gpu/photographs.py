"""Photographs to fit to: renderings of the room from a few places, as files."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

import sgwarp as sg
from benchmarks.gpu.bench import Bench

PLACES = 4


def photographs_of(bench: Bench, count: str, size: str) -> list[sg.View]:
    """Posed photographs in the folder of the results."""
    camera, views = bench.camera(size), []
    for number in range(PLACES):
        pose = camera.world_to_camera.clone()
        pose[:2, 3] += pose.new_tensor([0.1, 0.05]) * number
        moved = replace(camera, world_to_camera=pose)
        picture = sg.render(bench.scene(count), moved).clamp(0, 1).cpu().numpy()[..., ::-1]
        path = bench.folder / f"{count}_{size}_{number}.png"
        cv2.imwrite(str(path), (255 * picture + 0.5).astype(np.uint8))
        views.append(sg.View(path.stem, moved, path))
    return views
