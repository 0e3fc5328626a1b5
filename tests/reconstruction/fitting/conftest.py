"""A small stage to photograph: a wall and two boards with stripes, seen by eight cameras."""

import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from sgwarp.io.views import load_views
from sgwarp.scene import Camera, View

WIDTH, HEIGHT = 64, 48
# z, x from, x to, y from, y to [m], and stripes per metre of rectangles that face the cameras; y points down.
BOARDS = ((4.0, -4.0, 4.0, -3.0, 3.0, 1.0), (3.0, -1.2, -0.2, -0.8, 0.8, 3.0), (2.6, 0.3, 1.2, -0.5, 0.9, 2.0))
COLOURS = np.array([(0.75, 0.7, 0.6), (0.8, 0.2, 0.15), (0.15, 0.35, 0.8)])
PLACES = ((-0.8, -0.3), (-0.4, 0.3), (0.0, 0.0), (0.3, -0.4), (0.6, 0.2), (0.9, -0.1), (-0.2, -0.2), (0.1, 0.4))


def camera_at(x: float, y: float) -> Camera:
    """From (x, y, 0) towards the middle of the stage."""
    position = torch.tensor([x, y, 0.0], dtype=torch.float64)
    forward = torch.nn.functional.normalize(torch.tensor([0.0, 0.0, 3.3], dtype=torch.float64) - position, dim=0)
    right = torch.linalg.cross(torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64), forward)
    right = torch.nn.functional.normalize(right, dim=0)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ position
    K = torch.tensor([[60.0, 0.0, WIDTH / 2], [0.0, 60.0, HEIGHT / 2], [0.0, 0.0, 1.0]])
    return Camera(K, pose, WIDTH, HEIGHT)


def colour_at(board: int, x: np.ndarray) -> np.ndarray:
    """Soft stripes, [..., 3]."""
    wave = 0.75 + 0.25 * np.sin(2 * np.pi * BOARDS[board][5] * x)
    return COLOURS[board] * wave[..., None]


def photograph(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """What the camera sees, uint8 [H, W, 3] and z [m], float32 [H, W], by rays through the pixel centres."""
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(camera.K.numpy()).T
    directions, origin = rays @ camera.world_to_camera[:3, :3].numpy(), camera.position.numpy()
    image, nearest = np.zeros((HEIGHT, WIDTH, 3)), np.full((HEIGHT, WIDTH), np.inf)
    for board, (z, x0, x1, y0, y1, _) in enumerate(BOARDS):
        reach = (z - origin[2]) / directions[..., 2]
        at = origin + reach[..., None] * directions
        inside = (at[..., 0] >= x0) & (at[..., 0] <= x1) & (at[..., 1] >= y0) & (at[..., 1] <= y1) & (reach < nearest)
        nearest = np.where(inside, reach, nearest)
        image[inside] = colour_at(board, at[..., 0])[inside]
    return (image * 255).round().astype(np.uint8), nearest.astype(np.float32)


def points_on_boards() -> tuple[np.ndarray, np.ndarray]:
    """Positions [N, 3] and colours [N, 3] as structure from motion would give them, 3 mm off."""
    random = np.random.default_rng(0)
    positions, colours = [], []
    for board, (z, x0, x1, y0, y1, _) in enumerate(BOARDS):
        count = int(60 * (x1 - x0) * (y1 - y0) * (1 if board else 0.3))
        x, y = random.uniform(x0, x1, count), random.uniform(y0, y1, count)
        positions.append(np.stack([x, y, np.full(count, z)], axis=1) + random.normal(0, 0.003, (count, 3)))
        colours.append(colour_at(board, x))
    return np.concatenate(positions), np.concatenate(colours).astype(np.float32)


@dataclass(frozen=True)
class Boards:
    """The stage on disk.

    Attributes:
        folder: With transforms.json, images/, depth/ (npy, metres) and points3D.ply.
    """

    folder: Path

    @property
    def views(self) -> list[View]:
        return load_views(self.folder)


def write_stage(folder: Path) -> Boards:
    from plyfile import PlyData, PlyElement

    frames = []
    for name in ("images", "depth"):
        (folder / name).mkdir(parents=True)
    for index, place in enumerate(PLACES):
        camera = camera_at(*place)
        pixels, depth = photograph(camera)
        cv2.imwrite(str(folder / "images" / f"{index:04d}.png"), pixels[..., ::-1])
        np.save(folder / "depth" / f"{index:04d}.npy", depth)
        to_world = torch.linalg.inv(camera.world_to_camera) @ torch.diag(torch.tensor([1.0, -1, -1, 1]).double())
        frames.append({"file_path": f"images/{index:04d}.png", "transform_matrix": to_world.tolist()})
    meta = {"w": WIDTH, "h": HEIGHT, "fl_x": 60.0, "fl_y": 60.0, "cx": WIDTH / 2, "cy": HEIGHT / 2, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(meta))
    positions, colours = points_on_boards()
    kinds = [(axis, "<f4") for axis in "xyz"] + [(name, "u1") for name in ("red", "green", "blue")]
    rows = np.empty(len(positions), dtype=kinds)
    for column, axis in enumerate("xyz"):
        rows[axis] = positions[:, column]
    for column, name in enumerate(("red", "green", "blue")):
        rows[name] = (colours[:, column] * 255).round()
    PlyData([PlyElement.describe(rows, "vertex")]).write(str(folder / "points3D.ply"))
    return Boards(folder)


@pytest.fixture(scope="session")
def boards(tmp_path_factory: pytest.TempPathFactory) -> Boards:
    return write_stage(tmp_path_factory.mktemp("boards"))
