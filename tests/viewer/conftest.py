"""The stage with true labels, toy semantics and instances in two levels, as a viewer is given them."""

import math

import pytest
import torch

from sgwarp.lifting.lifter import lift
from sgwarp.scene import Instance, InstanceMap
from sgwarp.viewer.tab import Tab
from sgwarp.viewer.workbench import Materials, Workbench

NAMES = ("wall", "left door", "lamp", "book")


@pytest.fixture(scope="session")
def toy_semantics(stage):
    """Features of the toy text space, lifted from exact maps."""
    return lift(stage.gaussians, stage.views, stage.dense)


@pytest.fixture(scope="session")
def label_semantics(stage):
    """One-hot labels 1 to 4, lifted from exact maps."""
    return lift(stage.gaussians, stage.views, stage.one_hot)


def instance(number: int, level: str, parent: int, count: int, label: str = "") -> Instance:
    box = {"centroid": (0.0, 0.0, 0.0), "rotation": (1.0, 0.0, 0.0, 0.0), "extent": (1.0, 1.0, 1.0)}
    return Instance(number, level, parent, count, 3, 3, 0.9, **box, label=label, label_score=0.8 if label else 0.0)


@pytest.fixture(scope="session")
def instances(stage) -> InstanceMap:
    """Objects 5 to 8 are the panels; parts 1 to 4 the upper and lower halves of the panels 2 and 3."""
    upper = stage.gaussians.means[:, 1] < torch.tensor([0.0, 0.0, 0.2, -0.45, 0.65])[stage.classes]
    parts = torch.zeros(len(stage.classes), dtype=torch.int64)
    for place, panel in enumerate((2, 3)):
        own = stage.classes == panel
        parts[own] = torch.where(upper[own], 2 * place + 1, 2 * place + 2)
    objects = stage.classes + 4
    counts = [int((parts == k).sum()) for k in range(1, 5)] + [int((objects == k).sum()) for k in range(5, 9)]
    table = [instance(k, "s", 6 + (k - 1) // 2, counts[k - 1]) for k in range(1, 5)]
    table += [instance(k, "m", 0, counts[k - 1], NAMES[k - 5] if k != 8 else "") for k in range(5, 9)]
    candidates = torch.stack([parts, objects])[..., None].int()
    return InstanceMap(
        candidates,
        torch.ones_like(candidates, dtype=torch.float32),
        torch.full((len(parts),), 10.0),
        tuple(table),
        ("s", "m"),
        stage.gaussians.fingerprint,
        0.5,
    )


@pytest.fixture
def bench(stage, toy_semantics, toy_text, instances) -> Workbench:
    given = Materials(stage.gaussians, toy_semantics, None, toy_text, None, instances, stage.views)
    return Workbench(given)


@pytest.fixture
def tab(bench, stage) -> Tab:
    """A tab that looks from the third view."""
    tab = Tab(bench)
    tab.camera = stage.views[2].camera
    return tab


def place_of(camera, point) -> tuple[float, float]:
    """Where a point of the world lies in the picture, from 0 to 1 on either side."""
    at = camera.world_to_camera[:3, :3] @ torch.tensor(point).double() + camera.world_to_camera[:3, 3]
    x, y, w = (camera.K @ at).tolist()
    assert w > 0
    assert math.isfinite(x)
    return x / w / camera.width, y / w / camera.height
