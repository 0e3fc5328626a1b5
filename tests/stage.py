"""A stage of flat panels covered with small Gaussians, and what its cameras see by intersecting rays with rectangles.

The truth comes from geometry alone and shares nothing with the renderer. Panel p has class p + 1; 0 is the void around.
"""

import json
import math
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from sgwarp.io.scenes import load_gaussians, save_gaussians
from sgwarp.scene import Camera, FeatureMap, Gaussians, View

WIDTH, HEIGHT = 96, 72
NAMES = ("wall", "left door", "lamp", "book")
# z, x from, x to, y from, y to [m] of rectangles that face the cameras; y points down.
PANELS = (
    (4.0, -2.0, 2.0, -1.5, 1.5),
    (3.0, -1.2, -0.3, -0.8, 1.2),
    (3.2, 0.2, 0.9, -0.9, 0.0),
    (2.7, 0.3, 1.1, 0.4, 0.9),
)
COLOURS = ((0.8, 0.8, 0.7), (0.7, 0.2, 0.1), (0.9, 0.9, 0.1), (0.1, 0.3, 0.8))
STEP = 0.06  # between the centres of neighbouring Gaussians [m]


@dataclass(frozen=True)
class Stage:
    gaussians: Gaussians
    classes: torch.Tensor  # class of each Gaussian, 1 to 4, int64 [N]
    views: list[View]

    def labels(self, view: View) -> torch.Tensor:
        """Class at every pixel centre, 0 for the void, int64 [H, W]."""
        return trace(view.camera)[0]

    def depth(self, view: View) -> torch.Tensor:
        """z of the panel at every pixel centre, infinity for the void, float64 [H, W]."""
        return trace(view.camera)[1]

    def one_hot(self, view: View) -> FeatureMap:
        return FeatureMap("labels", ids=self.labels(view) - 1, labels=tuple(str(k + 1) for k in range(len(PANELS))))

    def dense(self, view: View) -> FeatureMap:
        """Axis vectors of the toy text space below, nothing in the void."""
        labels = self.labels(view)
        axes = torch.eye(len(PANELS) + 1)
        return FeatureMap("toy", dense=axes[(labels - 1).clamp(min=0)], valid=labels > 0)


class ToyText:
    """Every class name has an axis of its own, all other phrases share the last one."""

    space = "toy"

    def encode_text(self, texts):
        axes = torch.eye(len(PANELS) + 1)
        return torch.stack([axes[NAMES.index(text) if text in NAMES else -1] for text in texts])


def trace(camera: Camera) -> tuple[torch.Tensor, torch.Tensor]:
    """First panel hit by the ray through each pixel centre: class and z in the camera."""
    x = (torch.arange(camera.width) + 0.5 - camera.K[0, 2]) / camera.K[0, 0]
    y = (torch.arange(camera.height) + 0.5 - camera.K[1, 2]) / camera.K[1, 1]
    rays = torch.stack(
        [*torch.meshgrid(x.double(), y.double(), indexing="xy"), torch.ones(camera.size)], dim=-1
    ).double()
    directions = rays @ camera.world_to_camera[:3, :3]
    origin = camera.position
    best = torch.full(camera.size, math.inf, dtype=torch.float64)
    labels = torch.zeros(camera.size, dtype=torch.int64)
    for number, (z, x0, x1, y0, y1) in enumerate(PANELS, start=1):
        reach = (z - origin[2]) / directions[..., 2]  # rays have z = 1 in the camera, so this is depth
        at = origin + reach[..., None] * directions
        inside = (at[..., 0] >= x0) & (at[..., 0] <= x1) & (at[..., 1] >= y0) & (at[..., 1] <= y1)
        nearer = inside & (reach > 0) & (reach < best)
        best, labels = torch.where(nearer, reach, best), torch.where(nearer, number, labels)
    return labels, best


def panel_gaussians() -> tuple[Gaussians, torch.Tensor]:
    means, colours, classes = [], [], []
    for number, (z, x0, x1, y0, y1) in enumerate(PANELS, start=1):
        xs = torch.linspace(x0 + STEP / 2, x1 - STEP / 2, round((x1 - x0) / STEP))
        ys = torch.linspace(y0 + STEP / 2, y1 - STEP / 2, round((y1 - y0) / STEP))
        grid = torch.cartesian_prod(xs, ys)
        means.append(torch.cat([grid, torch.full((len(grid), 1), z)], dim=1))
        colours.append(torch.tensor(COLOURS[number - 1]).expand(len(grid), 3))
        classes.append(torch.full((len(grid),), number))
    centres, rgb = torch.cat(means), torch.cat(colours)
    n = len(centres)
    gaussians = Gaussians(
        means=centres,
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(n, 4),
        scales=torch.tensor([0.55 * STEP, 0.55 * STEP, 0.001]).expand(n, 3),
        opacities=torch.full((n,), 0.95),
        sh=((rgb - 0.5) / 0.28209479177387814)[:, None, :],
    )
    return gaussians, torch.cat(classes)


def stage_camera(x: float, y: float) -> Camera:
    """From (x, y, 0) towards the middle of the stage; the principal point is off centre."""
    position, target = torch.tensor([x, y, 0.0]).double(), torch.tensor([0.0, 0.0, 3.5]).double()
    forward = torch.nn.functional.normalize(target - position, dim=0)
    right = torch.nn.functional.normalize(torch.linalg.cross(torch.tensor([0.0, 1.0, 0.0]).double(), forward), dim=0)
    rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ position
    K = torch.tensor([[80.0, 0.0, WIDTH / 2 + 3], [0.0, 82.0, HEIGHT / 2 - 2], [0.0, 0.0, 1.0]])
    return Camera(K, pose, WIDTH, HEIGHT)


@pytest.fixture(scope="session")
def stage() -> Stage:
    gaussians, classes = panel_gaussians()
    places = [(-0.8, -0.3), (-0.4, 0.3), (0.0, 0.0), (0.3, -0.4), (0.6, 0.2), (0.9, -0.1)]
    views = [View(f"{k:04d}", stage_camera(*place)) for k, place in enumerate(places)]
    return Stage(gaussians, classes, views)


@pytest.fixture(scope="session")
def toy_text() -> ToyText:
    return ToyText()


@dataclass(frozen=True)
class StageFiles:
    scene: Path  # PLY
    views: Path  # folder with transforms.json and photographs
    labels: Path  # folder with one label image per view but the last
    gaussians: Gaussians  # as read from the PLY


@pytest.fixture(scope="session")
def stage_files(stage: Stage, tmp_path_factory: pytest.TempPathFactory) -> StageFiles:
    """The stage as a user would have it on disk."""
    folder = tmp_path_factory.mktemp("stage")
    scene, views, labels = folder / "scene.ply", folder / "views", folder / "labels"
    (views / "images").mkdir(parents=True)
    labels.mkdir()
    save_gaussians(stage.gaussians, scene)
    frames = []
    palette = np.array([(0.0, 0.0, 0.0), *COLOURS])
    for view in stage.views:
        ids = stage.labels(view).numpy()
        cv2.imwrite(str(views / "images" / f"{view.stem}.png"), (palette[ids][..., ::-1] * 255).astype(np.uint8))
        if view is not stage.views[-1]:
            cv2.imwrite(str(labels / f"{view.stem}.png"), ids.astype(np.uint8))
        to_world = torch.linalg.inv(view.camera.world_to_camera) @ torch.diag(torch.tensor([1.0, -1, -1, 1]).double())
        frames.append({"file_path": f"images/{view.stem}.png", "transform_matrix": to_world.tolist()})
    K = stage.views[0].camera.K
    intrinsics = {"fl_x": K[0, 0].item(), "fl_y": K[1, 1].item(), "cx": K[0, 2].item(), "cy": K[1, 2].item()}
    meta = {"w": WIDTH, "h": HEIGHT, **intrinsics, "frames": frames}
    (views / "transforms.json").write_text(json.dumps(meta))
    return StageFiles(scene, views, labels, load_gaussians(scene))
