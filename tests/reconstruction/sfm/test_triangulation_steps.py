"""Photographs, cameras and pairs as triangulation gives them to COLMAP, for which a stand-in takes the calls."""

from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from sgwarp.reconstruction.fitting.frame import Frame
from sgwarp.reconstruction.sfm import triangulation
from sgwarp.reconstruction.sfm.features import SfmSettings
from sgwarp.scene import Camera, View

SETTINGS = SfmSettings(seed=17, threads=3)
COUNT = 11


def cameras() -> list[Camera]:
    """Eleven side by side; the third has another principal point, and so a lens of its own."""
    found = []
    for k in range(COUNT):
        pose = torch.eye(4, dtype=torch.float64)
        pose[0, 3] = -0.5 * k
        K = torch.tensor([[50.0, 0, 31 if k == 2 else 32], [0, 52, 24], [0, 0, 1]])
        found.append(Camera(K, pose, 64, 48))
    return found


@pytest.fixture
def model(library, tmp_path):
    """A model whose calls are noted; the database lists its photographs the other way round."""
    library.noted = []
    images = [SimpleNamespace(name=f"{k:06d}.png", camera_id=1 + (k == 2), image_id=100 + k) for k in range(COUNT)]
    data = SimpleNamespace(
        write_camera=lambda lens, use_camera_id: library.noted.append((lens, use_camera_id)),
        read_all_images=lambda: images[::-1],
    )
    library.Database = SimpleNamespace(open=lambda path: nullcontext(data))
    library.Camera, library.Image, library.Rigid3d = SimpleNamespace, SimpleNamespace, np.array
    reports = []
    made = triangulation._Model(tmp_path, SETTINGS, lambda *call: reports.append(call), cameras())
    made.reports = reports
    return made


def test_photographs_of_one_lens_are_read_eight_at_a_time(model, library, monkeypatch, tmp_path):
    stored = []
    monkeypatch.setattr(triangulation, "store_features", lambda *given: stored.append(given))
    model.extract()
    one, other = (lens for lens, own in library.noted if own)
    assert (one.model, one.width, one.height, one.params, one.camera_id) == ("PINHOLE", 64, 48, [50, 52, 32, 24], 1)
    assert (other.params, other.camera_id) == ([50, 52, 31, 24], 2)
    assert one.has_prior_focal_length
    assert other.has_prior_focal_length
    names = [f"{k:06d}.png" for k in range(COUNT)]
    rest = [name for k, name in enumerate(names) if k != 2]
    chunks = [(rest[:8], 1), (rest[8:], 1), ([names[2]], 2)]
    database = tmp_path / "database.db"
    assert stored == [(database, tmp_path, chunk, SETTINGS, number) for chunk, number in chunks]
    assert model.reports == [(done, COUNT, "finding features") for done in (0, 8, 10)]


def test_pairs_are_matched_by_name(model, monkeypatch, tmp_path):
    given = []
    monkeypatch.setattr(triangulation, "match_features", lambda *rest: given.append(rest))
    monkeypatch.setattr(triangulation, "_pairs", lambda found: {(1, 10), (0, 1)} if found is model.cameras else set())
    model.match()
    pairs = [("000000.png", "000001.png"), ("000001.png", "000010.png")]
    assert given == [(tmp_path / "database.db", pairs, SETTINGS, model.report)]


def test_points_are_triangulated_with_the_pose_of_each_photograph(model, library, monkeypatch, tmp_path):
    monkeypatch.setattr(triangulation, "store_features", lambda *given: None)
    model.extract()
    placed, rigs, calls = {}, [], []
    library.Reconstruction = lambda: SimpleNamespace(
        add_camera_with_trivial_rig=rigs.append,
        add_image_with_trivial_frame=lambda image, pose: placed.update({image.name: (image, pose)}),
    )
    library.triangulate_points = lambda *given, options, **rest: calls.append((given, options, rest)) or "points"
    assert model.triangulate() == "points"
    assert [lens.camera_id for lens in rigs] == [1, 2]
    for k, (name, (image, pose)) in enumerate(sorted(placed.items())):
        assert (name, image.image_id, image.camera_id) == (f"{k:06d}.png", 100 + k, 1 + (k == 2))
        np.testing.assert_array_equal(pose, cameras()[k].world_to_camera[:3])
    assert len(placed) == COUNT
    (((made, database, folder, out), options, rest),) = calls
    assert made.add_camera_with_trivial_rig == rigs.append
    assert (database, folder) == (tmp_path / "database.db", tmp_path)
    assert out.is_dir()
    assert (options.random_seed, options.num_threads, rest) == (17, 3, {"cancellation_token": "t"})
    assert model.reports[-1] == (0, 1, "triangulating")


def test_views_are_stored_by_number_and_placed_in_their_frame(library, monkeypatch):
    """In the order of steps; the points come back as they are, and what few photographs agree on stays behind."""
    views = [View(f"v{k}", replace(camera, near=0.02)) for k, camera in enumerate(cameras())]
    stored, made, order = [], [], []
    monkeypatch.setattr(triangulation, "_store", lambda view, folder, name: stored.append(name) or view.camera)
    points = {
        k: SimpleNamespace(xyz=[1.0, k, 3], color=[0, 51, 255], track=SimpleNamespace(length=lambda k=k: k))
        for k in (2, 3, 4)
    }
    steps = SimpleNamespace(
        extract=lambda: order.append("extract"),
        match=lambda: order.append("match"),
        triangulate=lambda: order.append("triangulate") or SimpleNamespace(points3D=points),
    )
    monkeypatch.setattr(triangulation, "_Model", lambda *given: made.append(given) or steps)
    positions, colors = triangulation.triangulate(views, SETTINGS, len)
    assert library.calls == [("set_random_seed", (17,), {})]
    assert stored == [f"{k:06d}.png" for k in range(COUNT)]
    ((folder, settings, report, placed),) = made
    assert not folder.exists()  # any more
    assert (settings, report, order) == (SETTINGS, len, ["extract", "match", "triangulate"])
    frame = Frame.around(views)
    for camera, view in zip(placed, views, strict=True):
        torch.testing.assert_close(camera.world_to_camera, frame.camera(view.camera).world_to_camera)
    expected = np.array([[1.0, 3, 3], [1, 4, 3]]) * frame.scale + frame.origin.numpy()
    np.testing.assert_allclose(positions, expected)
    assert colors.dtype == np.float32
    np.testing.assert_allclose(colors, [[0, 0.2, 1]] * 2, rtol=1e-6)


def test_where_nothing_is_found_there_are_no_points(library, monkeypatch):
    nothing = SimpleNamespace(points3D={})
    steps = SimpleNamespace(extract=lambda: None, match=lambda: None, triangulate=lambda: nothing)
    monkeypatch.setattr(triangulation, "_store", lambda view, *rest: view.camera)
    monkeypatch.setattr(triangulation, "_Model", lambda *given: steps)
    positions, colors = triangulation.triangulate([View("a", cameras()[0]), View("b", cameras()[1])])
    assert (positions.shape, colors.shape) == ((0, 3), (0, 3))
    assert library.calls == [("set_random_seed", (0,), {})]
