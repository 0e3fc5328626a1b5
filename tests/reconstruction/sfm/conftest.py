"""Photographs of a room's corner, papered with noise, which features and plane sweeps like; a stand-in for pycolmap."""

from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch

from sgwarp.files.images import write_rgb
from sgwarp.reconstruction.sfm import features, poses, triangulation
from sgwarp.scene import Camera, View

WIDTH, HEIGHT, FOCAL, COUNT = 256, 192, 220.0, 8


def paper(seed: int) -> np.ndarray:
    """Smooth noise of three scales, [512, 512, 3] in [0, 1]."""
    random = np.random.default_rng(seed)
    scales = [cv2.resize(random.random((n, n, 3)), (512, 512), interpolation=cv2.INTER_CUBIC) for n in (16, 64, 160)]
    return np.clip(0.4 * scales[0] + 0.35 * scales[1] + 0.35 * scales[2] - 0.05, 0, 1)


def camera_at(index: int) -> Camera:
    angle = 0.9 * (index / (COUNT - 1) - 0.5)
    place = np.array([3.0 * np.sin(angle), -0.3 + 0.12 * (index % 3), 3.0 - 3.0 * np.cos(angle)])
    z = np.array([0.0, 0.1, 3.0]) - place
    z /= np.linalg.norm(z)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([x, np.cross(z, x), z])
    pose[:3, 3] = -pose[:3, :3] @ place
    K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1.0]])
    return Camera(torch.from_numpy(K), torch.from_numpy(pose), WIDTH, HEIGHT)


def photograph(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Colors and depth [m] of two walls, z = 3 + |x|, that meet in front of the cameras."""
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(camera.K.numpy()).T
    directions, origin = rays @ camera.world_to_camera[:3, :3].numpy(), camera.position.numpy()
    image, nearest = np.zeros((HEIGHT, WIDTH, 3)), np.full((HEIGHT, WIDTH), np.inf)
    for side, seed in ((1.0, 0), (-1.0, 1)):
        reach = (3.0 + side * origin[0] - origin[2]) / (directions[..., 2] - side * directions[..., 0])
        at = origin + reach[..., None] * directions
        hit = (reach > 0) & (side * at[..., 0] >= 0) & (reach < nearest)
        u, v = ((at[..., axis] * 90 + 256).astype(np.float32) for axis in (0, 1))
        color = cv2.remap(paper(seed), u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        image[hit], nearest[hit] = color[hit], reach[hit]
    return image.astype(np.float32), nearest


@pytest.fixture(scope="session")
def shots() -> list[tuple[Camera, np.ndarray, np.ndarray]]:
    """Camera, colors and depth of each photograph."""
    cameras = [camera_at(index) for index in range(COUNT)]
    return [(camera, *photograph(camera)) for camera in cameras]


@pytest.fixture(scope="session")
def corner(tmp_path_factory, shots) -> tuple[Path, list[View]]:
    """Folder of the photographs, and the views they are."""
    folder = tmp_path_factory.mktemp("corner")
    views = []
    for index, (camera, image, _) in enumerate(shots):
        path = folder / f"{index:02d}.png"
        write_rgb(path, image)
        views.append(View(path.stem, camera, path))
    return folder, views


class Options(SimpleNamespace):
    """Attributes that spring into being, as deep as they are asked for."""

    def __getattr__(self, name):
        if name.startswith("__"):
            raise AttributeError(name)
        value = Options()
        setattr(self, name, value)
        return value


class Library:
    """Notes the calls of functions, in order; options are `Options`."""

    def __init__(self):
        self.calls = []
        self.CameraMode = SimpleNamespace(SINGLE="single", PER_IMAGE="each")
        self.Device = SimpleNamespace(cpu="cpu")

    def __getattr__(self, name):
        if name.endswith("Options"):
            return Options
        if name.startswith("__"):
            raise AttributeError(name)

        def called(*arguments, **options):
            self.calls.append((name, arguments, options))

        return called


@pytest.fixture
def library(monkeypatch):
    found = Library()
    for module in (features, poses, triangulation):
        monkeypatch.setattr(module, "require_pycolmap", lambda: found)
    for module in (features, poses, triangulation):
        monkeypatch.setattr(module, "run_cancellable", lambda database, call, watch=None: (watch or int)() or call("t"))
    return found
