"""Where cameras, maps and instances begin to count: limits, defaults, and what is refused."""

import math
from dataclasses import fields, replace

import pytest
import torch

from sgwarp.errors import InputError
from sgwarp.scene import Camera, FeatureMap, Gaussians, Instance, InstanceMap, Semantics, View
from sgwarp.scene.checks import require_finite
from sgwarp.scene.extent import camera_extent, near_plane, with_near_plane, with_near_plane_of

K = torch.tensor([[40.0, 0, 20], [0, 40, 15], [0, 0, 1]])


def camera(place=(0.0, 0.0, 0.0), **changes) -> Camera:
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = -torch.tensor(place, dtype=torch.float64)
    return replace(Camera(K, pose, 40, 30), **changes)


def test_defaults_of_cameras_and_views():
    defaults = {field.name: field.default for field in fields(Camera)}
    assert (defaults["near"], defaults["far"]) == (0.01, 1e10)  # gsplat's
    defaults = {field.name: field.default for field in fields(View)}
    assert (defaults["depth_unit"], defaults["origin"], defaults["undistort"]) == (1e-3, None, None)


@pytest.mark.parametrize(
    ("near", "far", "fine"), [(1.0, 1.001, True), (1.0, 1.0, False), (2.0, 1.0, False), (0, 1, False)]
)
def test_near_lies_before_far(near, far, fine):
    if fine:
        assert camera(near=near, far=far).near == near
        return
    with pytest.raises(InputError, match="expected 0 < near < far"):
        camera(near=near, far=far)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_numbers_and_tensors_must_be_finite(value):
    require_finite("x", 1.0)
    require_finite("x", torch.zeros(3))
    for bad in (value, torch.tensor([0.0, value])):
        with pytest.raises(InputError, match="x: holds NaN or infinity"):
            require_finite("x", bad)


@pytest.mark.parametrize("shape", [(4, 5), (5, 4), (1, 4, 5), (4,)])
def test_valid_pixels_fit_their_features(shape):
    def made() -> FeatureMap:
        return FeatureMap("s", dense=torch.zeros(4, 5, 2), valid=torch.ones(shape))

    if shape == (4, 5):
        assert made().valid.shape == shape
        return
    with pytest.raises(InputError, match=r"valid: expected \[4, 5\]"):
        made()


@pytest.mark.parametrize(("lowest", "highest", "fine"), [(-1, 2, True), (-2, 2, False), (-1, 3, False)])
def test_ids_name_a_row(lowest, highest, fine):
    ids = torch.tensor([[lowest, highest]])
    for other in ({"vectors": torch.zeros(3, 2)}, {"labels": ("a", "b", "c")}):
        if fine:
            assert FeatureMap("s", ids=ids, **other).size == (1, 2)
            continue
        with pytest.raises(InputError, match="ids: expected -1 to 2"):
            FeatureMap("s", ids=ids, **other)


def instances(ids=(1, 2), levels=("part", "object")) -> InstanceMap:
    table = tuple(Instance(**{f.name: 1 for f in fields(Instance)} | {"id": k, "level": "object"}) for k in ids)
    blank = torch.ones(2, 4, 1, dtype=torch.int32)
    shares = torch.tensor([0.0, 0.5, 0.6, 1.0]).expand(2, 4)[..., None]
    return InstanceMap(blank, shares, torch.tensor([8.0, 8, 8, 8]), table, levels, "f")


def test_instances_are_numbered_from_one_and_levels_known():
    found = instances()
    assert (found.level_index(), found.level_index("part")) == (1, 0)  # the coarsest is the last
    # (n s + 1) / (n + 2) with n = 8: 0.1, 0.5, 0.58, 0.9, of which 0.55 and more are decided.
    assert found.confidence().tolist() == pytest.approx([0.1, 0.5, 0.58, 0.9])
    assert found.instance().tolist() == [-1, -1, 1, 1]
    with pytest.raises(InputError, match=r"table: expected ids 1 to 2 in this order"):
        instances((2, 1))
    with pytest.raises(InputError, match="level 'x' is not one of part, object"):
        found.level_index("x")
    for unknown in (0, 3):
        with pytest.raises(InputError, match=f"instance {unknown}: unknown id; this scene has 1 to 2"):
            found.members(unknown)


def test_faint_weights_count_as_unseen():
    weight = torch.tensor([0.0, 0.2, 0.5, 0.6])
    semantics = Semantics(torch.zeros(4, 2), weight, weight, "s", "f")
    assert semantics.without_faint(0.5).seen.tolist() == [False, False, True, True]
    assert semantics.coverage == 0.75
    assert semantics.without_faint(0.0) is semantics


# How far cameras reach.


@pytest.mark.parametrize("unit", [1.0, 1000.0])
def test_extent_and_planes_are_those_published(unit):
    """1.1 radii about the mean (getNerfppNorm of 3DGS); near a hundredth of it, or of ten steps; far 10,000."""
    views = [View(str(k), camera((unit * x, 0, 0))) for k, x in enumerate((-2.0, 0.0, 2.0))]
    assert camera_extent(views) == pytest.approx(2.2 * unit)
    assert near_plane(views) == pytest.approx(0.022 * unit)
    (moved, *_) = with_near_plane(views)
    assert (moved.camera.near, moved.camera.far) == (pytest.approx(0.022 * unit), max(1e10, 22_000 * unit))
    walk = [View(str(k), camera((unit * x, 0, 0))) for k, x in enumerate(range(101))]
    assert camera_extent(walk) == pytest.approx(55 * unit)
    assert near_plane(walk) == pytest.approx(0.1 * unit)
    assert near_plane(views[:1]) is None
    assert camera_extent(views[:1]) == 1.0


def test_planes_of_a_lone_camera_are_those_of_a_small_scene():
    views = [View("a", camera()), View("b", camera(near=0.5))]
    shapes = {"quats": (4,), "scales": (3,), "opacities": (), "sh": (1, 3)}
    blank = {name: torch.full((3, *shape), 0.5) for name, shape in shapes.items()}
    small, large = (Gaussians(torch.tensor([[0.0, 0, size]] * 3), **blank) for size in (0.1, 10.0))
    assert [view.camera.near for view in with_near_plane_of(views, small)] == [pytest.approx(0.001), 0.5]
    assert [view.camera.near for view in with_near_plane_of(views, large)] == [0.01, 0.5]
