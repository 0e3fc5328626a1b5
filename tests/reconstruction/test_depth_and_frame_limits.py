"""Small steps of reconstruction by closed forms: grids, windows, planes, frames, fingerprints, pictures of a fit."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from sgwarp.reconstruction import depth
from sgwarp.reconstruction.fitting import loop, report
from sgwarp.reconstruction.fitting.checkpoint import fingerprint
from sgwarp.reconstruction.fitting.coverage import in_view
from sgwarp.reconstruction.fitting.frame import Frame
from sgwarp.reconstruction.fitting.photographs import Photograph
from sgwarp.reconstruction.rgbd import _uniform_window
from sgwarp.reconstruction.sfm import triangulation
from sgwarp.scene import Camera, Gaussians, View

CAMERA = Camera(torch.tensor([[40.0, 0, 20], [0, 40, 15], [0, 0, 1]]), torch.eye(4), 40, 30, near=0.5, far=100.0)


def scene(means) -> Gaussians:
    shapes = {"quats": (4,), "scales": (3,), "opacities": (), "sh": (1, 3)}
    return Gaussians(means, **{name: torch.full((len(means), *shape), 0.01) for name, shape in shapes.items()})


def test_cells_are_as_small_as_the_finest_twentieth_of_the_pixels():
    values = np.full((30, 40), 10.0, np.float32)
    values[:3] = 1.0  # a tenth
    assert depth._Grid.around([View("a", CAMERA)], lambda view: values).cell == pytest.approx(1 / 40)


def test_depth_that_is_none_is_zero():
    values = np.tile(np.array([-1.0, np.nan, np.inf, 2.0], np.float32), (30, 10))
    assert depth._depth(View("a", CAMERA), lambda view: values)[0, :4].tolist() == [0, 0, 0, 2]


@pytest.mark.parametrize(("planarity", "side"), [(0.05, 1), (0.3, 2), (0.5, 4), (1.7, 8)])
def test_a_window_is_planar_to_its_sag(planarity, side):
    """An inverse depth of 1 + x^2 / 10 sags by r^2 / 10 footprints over half a side r: 0.1, 0.4, 1.6, 6.4."""
    inverse = np.tile(1 + 0.1 * (np.arange(41.0) - 20) ** 2, (41, 1))
    found = _uniform_window(inverse, np.ones((41, 41)), np.zeros((41, 41, 3), np.float32), planarity, 0.1)
    assert found[20, 20] == side


@pytest.mark.parametrize(("z", "seen"), [(0.49, False), (0.51, True), (99.0, True), (101.0, False), (-1.0, False)])
def test_what_lies_between_near_and_far_is_in_view(z, seen):
    assert in_view(CAMERA, torch.tensor([[0.0, 0, z]])).tolist() == [seen]


@pytest.mark.parametrize(("scale", "far"), [(0.5, 200.0), (5.0, 100.0)])
def test_far_planes_of_a_frame_hide_nothing(scale, far):
    frame = Frame(torch.zeros(3, dtype=torch.float64), scale, None)
    assert (frame.camera(CAMERA).near, frame.camera(CAMERA).far) == (0.5 / scale, far)


def test_a_fingerprint_is_of_both_groups():
    one, other = (Photograph("a", CAMERA, torch.full((30, 40, 3), k, dtype=torch.uint8)) for k in (1, 2))
    found = {
        fingerprint([one], [one]),
        fingerprint([one], [other]),
        fingerprint([other], [one]),
        fingerprint([one], []),
    }
    assert len(found) == 4


def test_what_no_camera_sees_is_counted_and_removed():
    kept, counts = [], {}
    run = SimpleNamespace(
        model=SimpleNamespace(
            gaussians=lambda: scene(torch.tensor([[0.0, 0, 5], [0, 0, -5], [0, 0, 6]])), keep=kept.append
        ),
        cameras=lambda: [CAMERA],
        log=SimpleNamespace(leave_out=counts.__setitem__),
    )
    loop.Loop.remove_unseen(run)
    assert counts == {"gaussians_no_camera_sees": 1}
    assert kept[0].tolist() == [True, False, True]


@pytest.mark.parametrize("white", [True, False])
def test_a_contact_sheet_has_the_background_of_the_fit_and_its_scale(monkeypatch, white):
    """A difference of a quarter and more is drawn alike; one of an eighth is not."""
    given = []

    def rasterize(gaussians, camera, background):
        given.append(background)
        return SimpleNamespace(features=torch.full((30, 40, 3), shade))

    monkeypatch.setattr(report, "rasterize", rasterize)
    drawn = {}
    for shade in (0.125, 0.25, 0.5):
        photograph = Photograph("a", CAMERA, torch.zeros(30, 40, 3, dtype=torch.uint8))
        drawn[shade] = report._row(scene(torch.zeros(1, 3)), photograph, white)[-20:, -20:].astype(int)
    assert all((background is not None and bool((background == 1).all())) == white for background in given)
    assert np.array_equal(drawn[0.25], drawn[0.5])
    assert not np.array_equal(drawn[0.125], drawn[0.25])


def test_triangulated_points_go_back_to_the_world(monkeypatch):
    views = [View(str(k), replace(CAMERA, world_to_camera=torch.eye(4, dtype=torch.float64))) for k in range(2)]
    points = [SimpleNamespace(xyz=[1.0, 2, 3], color=[0, 51, 255], track=SimpleNamespace(length=lambda: 3))]
    model = SimpleNamespace(extract=lambda: None, match=lambda: None)
    model.triangulate = lambda: SimpleNamespace(points3D={1: points[0]})
    library = SimpleNamespace(set_random_seed=lambda seed: None)
    monkeypatch.setattr(triangulation, "require_pycolmap", lambda: library)
    monkeypatch.setattr(triangulation, "_store", lambda view, *rest: view.camera)
    monkeypatch.setattr(triangulation, "_Model", lambda *rest: model)
    frame = Frame(torch.tensor([10.0, 20, 30], dtype=torch.float64), 5.0, None)
    monkeypatch.setattr(triangulation.Frame, "around", lambda views: frame)
    positions, colors = triangulation.triangulate(views)
    np.testing.assert_allclose(positions, [[15, 30, 45]])
    np.testing.assert_allclose(colors, [[0, 0.2, 1]], rtol=1e-6)
