"""Captures as people have them: any unit and origin, masks that hide all, photographs of nothing, large ones."""

import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from sgwarp.cli import main
from sgwarp.errors import InputError
from sgwarp.io.points import load_points
from sgwarp.reconstruction.fitting.coverage import in_view, seen_by_any
from sgwarp.reconstruction.fitting.frame import Frame
from sgwarp.reconstruction.fitting.initial import gaussians_from_photographs
from sgwarp.reconstruction.fitting.photographs import read_photographs, require_overlap
from sgwarp.reconstruction.fitting.pixels import PixelStore
from sgwarp.reconstruction.fitting.settings import FitSettings
from sgwarp.reconstruction.fitting.trainer import fit
from sgwarp.scene import Camera, Gaussians, View
from sgwarp.scene.extent import with_near_plane_of


def moved(view, scale, shift):
    pose = view.camera.world_to_camera.clone()
    pose[:3, 3] = scale * pose[:3, 3] - pose[:3, :3] @ shift
    return replace(view, camera=replace(view.camera, world_to_camera=pose))


@pytest.fixture(scope="module")
def plain(boards):
    return fit(boards.views[1:], load_points(boards.folder), boards.views[:1], SETTINGS)


SETTINGS = FitSettings(steps=25, cap=600, sh_degree=0, evaluate_every=25)


@pytest.mark.slow
@pytest.mark.parametrize(("scale", "offset"), [(1e-3, 0.0), (1e6, 0.0), (1.0, 5e6)])
def test_unit_and_origin_make_no_difference(boards, plain, scale, offset):
    shift = torch.tensor([offset, -offset, offset], dtype=torch.float64)
    views = [moved(view, scale, shift) for view in boards.views]
    positions = load_points(boards.folder)[0] * scale + shift.numpy()
    other = fit(views[1:], (positions, load_points(boards.folder)[1]), views[:1], SETTINGS)
    assert other.curve[-1].psnr == pytest.approx(plain.curve[-1].psnr, abs=0.3)
    if offset == 0:
        torch.testing.assert_close(
            other.gaussians.scales.median() / scale, plain.gaussians.scales.median(), rtol=0.1, atol=0
        )


def test_a_frame_goes_back_to_the_world(boards):
    frame = Frame.around(boards.views)
    random = torch.Generator().manual_seed(0)
    means = torch.randn(9, 3, generator=random)
    scene = Gaussians(
        means, torch.eye(4)[:1].expand(9, 4), torch.rand(9, 3, generator=random), torch.ones(9), torch.zeros(9, 1, 3)
    )
    back = frame.restored(frame.gaussians(scene))
    torch.testing.assert_close(back.means, scene.means)
    torch.testing.assert_close(back.scales, scene.scales)
    camera, inner = boards.views[0].camera, frame.camera(boards.views[0].camera)
    pixel, same = (
        c.K @ (c.world_to_camera[:3] @ torch.cat([p, torch.ones(1)]).double())
        for c, p in ((camera, means[0].double()), (inner, frame.points(means[:1])[0]))
    )
    torch.testing.assert_close(pixel[:2] / pixel[2], same[:2] / same[2])


def test_a_mask_that_hides_all_costs_its_photograph(boards, caplog):
    masks = {view.stem: np.full(view.camera.size, view.stem != "0003") for view in boards.views}
    photographs = read_photographs(boards.views, masks=lambda view: masks[view.stem])
    assert [p.stem for p in photographs] == [v.stem for v in boards.views if v.stem != "0003"]
    assert "left out 1 photographs whose mask leaves no pixel, first 0003" in caplog.text


def test_photographs_that_show_no_points_cost_a_notice(boards, caplog):
    photographs = read_photographs(boards.views)
    camera = photographs[0].camera
    turn = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0], dtype=torch.float64))
    photographs[0] = replace(photographs[0], camera=replace(camera, world_to_camera=turn @ camera.world_to_camera))
    points = torch.from_numpy(load_points(boards.folder)[0]).float()
    require_overlap(photographs, points)
    assert f"1 of {len(photographs)} photographs show none of the" in caplog.text
    with pytest.raises(InputError, match=r"nor does any other.*--init random"):
        require_overlap(photographs[:1], points)


def test_large_photographs_are_scaled_down_with_a_notice(boards, caplog):
    (small,) = read_photographs(boards.views[:1], largest=32)
    assert small.camera.size == (24, 32)
    assert small.pixels.shape == (24, 32, 3)
    assert "1 photographs are scaled down to 32 pixels (the first is 64 x 48); --max-size" in caplog.text


def test_reading_photographs_says_how_far_it_is(boards):
    said = []
    read_photographs(boards.views, progress=lambda *call: said.append(call))
    assert said[0] == (0, 8, "")
    assert said[1:] == [(done, 8, view.stem) for done, view in enumerate(boards.views, start=1)]


def test_photographs_beyond_the_memory_are_read_from_a_file():
    random = np.random.default_rng(0)
    images = [random.integers(0, 256, (5, 7, 3), np.uint8) for _ in range(4)]
    store = PixelStore(in_memory=2 * 5 * 7 * 3)
    kept = [store.put(image) for image in images]
    assert [isinstance(pixels, torch.Tensor) for pixels in kept] == [True, True, False, False]
    for pixels, image in zip(kept[2:], images[2:], strict=True):
        assert np.array_equal(pixels.read().numpy(), image)
        assert np.array_equal(pixels.read().numpy(), image)


@pytest.mark.slow
def test_a_fit_without_points_starts_on_surfaces_where_photographs_agree(boards):
    frame = Frame.around(boards.views)
    photographs = read_photographs([*map(frame.view, boards.views)])
    found = gaussians_from_photographs(photographs, FitSettings(cap=4000), 1.0)
    depth = (found.means.double() * frame.scale + frame.origin)[:, 2]
    off = torch.stack([(depth - z).abs() for z in (4.0, 3.0, 2.6)]).amin(dim=0)
    assert off.median() < 0.15


def test_gaussians_that_no_camera_sees_are_removed(boards):
    camera = boards.views[2].camera
    front = camera.world_to_camera.inverse()
    places = torch.stack(
        [
            (front @ torch.tensor([x, 0, z, 1.0], dtype=torch.float64))[:3]
            for x, z in ((0, 2), (9, 2), (0, -2), (2.0, 2))
        ]
    )
    assert in_view(camera, places).tolist() == [True, False, False, False]
    scene = Gaussians(
        places.float(), torch.eye(4)[:1].expand(4, 4), torch.full((4, 3), 0.4), torch.ones(4), torch.zeros(4, 1, 3)
    )
    assert seen_by_any(scene, [camera]).tolist() == [True, False, False, True]


def test_overfitting_is_measured_and_warned_of(boards, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("sgwarp.commands.fit.LARGEST_GAP", -50.0)
    out = tmp_path / "scene.ply"
    assert main(["fit", str(boards.folder), "--out", str(out), "--steps", "3", "--cap", "300"]) == 0
    error = json.loads((tmp_path / "run.json").read_text())["error"]
    assert error["overfitting_gap"] == pytest.approx(error["fitted_psnr"] - error["held_out_psnr"])
    said = capsys.readouterr().err
    assert "overfitted:" in said
    assert "cameras: 7 photographs of 64 x 48" in said
    assert "points: " in said


def test_without_points_and_features_a_fit_starts_at_random_and_says_so(boards, tmp_path, capsys):
    shutil.copytree(boards.folder, tmp_path / "stage")
    (tmp_path / "stage/points3D.ply").unlink()
    out = tmp_path / "scene.ply"
    assert main(["fit", str(tmp_path / "stage"), "--out", str(out), "--steps", "2", "--cap", "300"]) == 0
    assert "starts at random" in capsys.readouterr().err
    assert cv2.imread(str(tmp_path / "scene.held_out.jpg")) is not None


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e4])
def test_cameras_in_one_place_take_their_unit_from_the_points(boards, scale):
    """A turning camera has no extent: how far the points are says how long a meter is."""
    K, (height, width) = boards.views[0].camera.K, boards.views[0].camera.size
    views = [replace(view, camera=Camera(K, torch.eye(4).double(), width, height)) for view in boards.views]
    frame = Frame.around(views, load_points(boards.folder)[0] * scale)
    median = np.median(np.linalg.norm(load_points(boards.folder)[0], axis=1))
    assert frame.scale == pytest.approx(median * scale)
    assert frame.camera(views[0].camera).near == pytest.approx(0.01)


def test_a_lone_camera_takes_its_near_plane_from_a_small_scene(boards):
    view = boards.views[2]
    lone = replace(view, camera=Camera(view.camera.K, view.camera.world_to_camera, *view.camera.size[::-1]))
    positions = torch.from_numpy(load_points(boards.folder)[0]).float()
    assert with_near_plane_of([lone], _at(positions))[0].camera.near == 0.01
    small = moved(lone, 1e-3, torch.zeros(3, dtype=torch.float64))
    median = float((positions.double() - view.camera.position).norm(dim=1).median())
    assert with_near_plane_of([small], _at(positions * 1e-3))[0].camera.near == pytest.approx(1e-5 * median, rel=1e-4)
    assert with_near_plane_of([view], _at(positions))[0] is view  # of several cameras, it is known already


def _at(means):
    count = len(means)
    quats = torch.tensor([[1.0, 0, 0, 0]]).expand(count, 4)
    return Gaussians(means, quats, torch.full((count, 3), 0.1), torch.ones(count), torch.zeros(count, 1, 3))


def test_masks_and_alpha_count_as_pixels_do(boards, tmp_path, monkeypatch):
    """300 photographs of 1,600 pixels would else hold 2.3 GB of alpha in memory."""
    random = np.random.default_rng(0)
    pixels = random.integers(0, 256, (48, 64, 4), np.uint8)
    cv2.imwrite(str(tmp_path / "0000.png"), pixels)
    view, mask = View("0000", boards.views[0].camera, tmp_path / "0000.png"), random.random((48, 64)) < 0.5
    for in_memory in (0, 2**20):
        monkeypatch.setattr(PixelStore.__init__, "__defaults__", ("cpu", in_memory))
        (photograph,) = read_photographs([view], masks=lambda view: mask)
        kept = (photograph.stored, photograph.stored_mask, photograph.stored_alpha)
        assert [isinstance(part, torch.Tensor) for part in kept] == [in_memory > 0] * 3
        assert np.array_equal(photograph.pixels.numpy(), pixels[..., [2, 1, 0]])
        assert photograph.mask.dtype == torch.bool
        assert np.array_equal(photograph.mask.numpy(), mask)
        assert np.array_equal(photograph.alpha.numpy(), pixels[..., 3].astype(np.float32) / 255)


def test_groups_share_the_memory_of_their_store(boards):
    store = PixelStore(in_memory=48 * 64 * 3)
    groups = [read_photographs(boards.views[at : at + 1], store=store) for at in (0, 1)]
    assert [isinstance(photograph.stored, torch.Tensor) for (photograph,) in groups] == [True, False]


COPIES = """
import torch
from sgwarp.reconstruction import stereo
from sgwarp.runs.memory import resident
from sgwarp.scene import Camera

class Copied(Exception):
    pass

def stop(*given):
    raise Copied

stereo.choose_neighbors = stop
K = torch.tensor([[1400.0, 0, 800], [0, 1400, 600], [0, 0, 1]], dtype=torch.float64)
cameras = [Camera(K, torch.eye(4, dtype=torch.float64), 1600, 1200) for _ in range(60)]
pixels = torch.randint(0, 255, (1200, 1600, 3), dtype=torch.uint8)
before = resident()
try:
    stereo.estimate_depth(((pixels.to(torch.float32) / 255.0).numpy() for _ in cameras), cameras, 1.0)
except Copied:
    print(resident() - before)
"""


def test_small_copies_do_not_hold_the_memory_of_large_images():
    """60 images of 23 MB pass through; glibc kept nearly all of them where a copy was made between two."""
    heap = {**os.environ, "MALLOC_MMAP_THRESHOLD_": str(2**26)}  # images from the heap, as after some hundred of them
    ran = subprocess.run([sys.executable, "-c", COPIES], capture_output=True, text=True, check=True, env=heap)
    assert int(ran.stdout) < 20 * 1600 * 1200 * 3 * 4
