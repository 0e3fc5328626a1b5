"""Poses that are refined along with the scene."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from sgwarp.io.points import load_points
from sgwarp.reconstruction.fitting.frame import Frame
from sgwarp.reconstruction.fitting.held_out_poses import refine_held_out_poses
from sgwarp.reconstruction.fitting.photographs import read_photographs
from sgwarp.reconstruction.fitting.pose_refinement import LAST_RATE, RATE, PoseRefinement
from sgwarp.reconstruction.fitting.settings import FitSettings
from sgwarp.reconstruction.fitting.trainer import fit
from sgwarp.scene import Camera, Gaussians

CPU = torch.device("cpu")


def turned(camera: Camera, axis, degrees: float, shift) -> Camera:
    """The camera turned about its center by Rodrigues' formula, and its center moved."""
    axis = np.asarray(axis, np.float64) / np.linalg.norm(axis)
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = math.radians(degrees)
    turn = np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
    camera_to_world = torch.linalg.inv(camera.world_to_camera).numpy()
    camera_to_world[:3, :3] = turn @ camera_to_world[:3, :3]
    camera_to_world[:3, 3] += shift
    return replace(camera, world_to_camera=torch.from_numpy(np.linalg.inv(camera_to_world)))


def test_a_motion_is_a_turn_about_the_center_and_a_shift(boards):
    camera = boards.views[0].camera
    refinement = PoseRefinement([camera], CPU)
    axis, degrees, shift = (1.0, -2.0, 0.5), 7.0, (0.1, -0.2, 0.3)
    vector = np.asarray(axis) / np.linalg.norm(axis) * math.radians(degrees)
    motion = torch.tensor([*vector, *shift], dtype=torch.float64)
    expected = turned(camera, axis, degrees, shift).world_to_camera
    torch.testing.assert_close(refinement.world_to_camera(0, motion), expected, rtol=0, atol=1e-12)
    torch.testing.assert_close(refinement.cameras()[0].world_to_camera, camera.world_to_camera, rtol=0, atol=1e-12)


def test_gradients_of_a_motion(boards):
    refinement = PoseRefinement([view.camera for view in boards.views], CPU)
    motion = torch.tensor([0.1, -0.2, 0.3, 0.4, 0.5, -0.6], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda m: refinement.world_to_camera(2, m), (motion,))


def test_the_mean_motion_is_held_and_the_rate_falls(boards):
    refinement = PoseRefinement([view.camera for view in boards.views], CPU)
    refinement.update(0, torch.ones(6), 0.0)
    torch.testing.assert_close(refinement.group.parameters[0], torch.full((6,), -RATE))
    refinement.update(1, torch.ones(6), 1.0)
    torch.testing.assert_close(refinement.group.parameters[1], torch.full((6,), -LAST_RATE))
    motions = torch.stack([refinement.leaf(index).detach() for index in range(len(boards.views))])
    torch.testing.assert_close(motions.mean(dim=0), torch.zeros(6), rtol=0, atol=1e-9)
    assert motions.abs().max() > RATE / 2


def mean_error(views, truth, points) -> float:
    """Mean distance between where the true camera and this one see the points [pixels]."""
    distances = []
    for view, true in zip(views, truth, strict=True):
        seen = []
        for camera in (view.camera, true.camera):
            pose = camera.world_to_camera
            pixels = (points @ pose[:3, :3].T + pose[:3, 3]) @ camera.K.T
            seen.append(pixels[:, :2] / pixels[:, 2:])
        distances.append((seen[0] - seen[1]).norm(dim=1).mean().item())
    return sum(distances) / len(distances)


def test_wrong_poses_are_mended(boards):
    """Poses 0.7 degrees and a centimeter off: the scene gets sharper, and the poses better."""
    truth = boards.views
    random = np.random.default_rng(0)
    wrong = [
        replace(view, camera=turned(view.camera, random.normal(size=3), 0.7, random.normal(0, 0.01, 3)))
        for view in truth
    ]
    start = load_points(boards.folder)
    settings = FitSettings(steps=400, cap=1500, sh_degree=0, evaluate_every=400)
    plain = fit(wrong, start, (), settings)
    refined = fit(wrong, start, (), replace(settings, refine_poses=True))
    assert [view.stem for view in refined.views] == [view.stem for view in truth]
    assert all(
        torch.equal(a.camera.world_to_camera, b.camera.world_to_camera) for a, b in zip(plain.views, wrong, strict=True)
    )
    assert refined.fitted_psnr > plain.fitted_psnr + 1.5
    points = torch.as_tensor(start[0], dtype=torch.float64)
    assert mean_error(refined.views, truth, points) < 0.7 * mean_error(wrong, truth, points)


def test_a_refined_run_resumes_with_the_same_bits(boards, tmp_path):
    start = load_points(boards.folder)
    settings = FitSettings(steps=20, cap=1300, sh_degree=0, refine_poses=True, evaluate_every=20)
    whole = fit(boards.views, start, (), settings)
    path = tmp_path / "run.checkpoint"

    def stop(done, total, text):
        if done >= 10:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit(boards.views, start, (), settings, checkpoint=path, checkpoint_every=10, progress=stop)
    resumed = fit(boards.views, start, (), settings, checkpoint=path, resume=True)
    assert torch.equal(whole.gaussians.means, resumed.gaussians.means)
    for one, other in zip(whole.views, resumed.views, strict=True):
        assert torch.equal(one.camera.world_to_camera, other.camera.world_to_camera)


def test_poses_go_to_the_frame_and_back(boards):
    frame = Frame.around(boards.views)
    for view in boards.views:
        back = frame.with_pose(view, frame.camera(view.camera))
        torch.testing.assert_close(back.camera.world_to_camera, view.camera.world_to_camera, rtol=0, atol=1e-12)


@pytest.fixture(scope="module")
def finished(boards):
    """A scene fitted to all photographs with their true poses."""
    settings = FitSettings(steps=200, cap=1500, sh_degree=0, evaluate_every=200)
    return fit(boards.views, load_points(boards.folder), (), settings).gaussians


def test_held_out_poses_are_found_again(boards, finished):
    """Cameras turned by 1.5 degrees and moved by centimeters come back to where they were."""
    random = np.random.default_rng(1)
    truth, points = boards.views[:3], torch.as_tensor(load_points(boards.folder)[0], dtype=torch.float64)
    off = [
        replace(view, camera=turned(view.camera, random.normal(size=3), 1.5, random.normal(0, 0.02, 3)))
        for view in truth
    ]
    before = finished.means.clone()
    cameras = refine_held_out_poses(finished, read_photographs(off), None, 0.2)
    found = [replace(view, camera=camera) for view, camera in zip(truth, cameras, strict=True)]
    assert mean_error(off, truth, points) > 1
    assert mean_error(found, truth, points) < 0.2 * mean_error(off, truth, points)
    assert torch.equal(finished.means, before)


def test_masked_pixels_have_no_say_in_a_held_out_pose(boards, finished):
    """Half of the photograph is turned upside down and masked; its pose is found by the other half."""
    view, points = boards.views[0], torch.as_tensor(load_points(boards.folder)[0], dtype=torch.float64)
    off = replace(view, camera=turned(view.camera, (0.2, 1.0, 0.1), 1.0, (0.01, -0.01, 0.0)))
    (photograph,) = read_photographs([off])
    pixels, mask = photograph.pixels.clone(), torch.ones(view.camera.size, dtype=torch.bool)
    half = view.camera.width // 2
    pixels[:, :half], mask[:, :half] = pixels[:, :half].flip(0), False
    masked = replace(photograph, stored=pixels, stored_mask=mask.to(torch.uint8))
    (camera,) = refine_held_out_poses(finished, [masked], None, 0.2)
    assert mean_error([replace(view, camera=camera)], [view], points) < 0.5 * mean_error([off], [view], points)


def test_a_view_that_shows_nothing_keeps_its_pose(boards):
    """Without a gradient there is nowhere to go."""
    (photograph,) = read_photographs(boards.views[:1])
    behind = photograph.camera.position - 3 * photograph.camera.world_to_camera[2, :3]
    shapes = torch.eye(4)[:1], torch.full((1, 3), 0.01), torch.ones(1), torch.zeros(1, 1, 3)
    (found,) = refine_held_out_poses(Gaussians(behind[None].float(), *shapes), [photograph], None, 0.2)
    torch.testing.assert_close(found.world_to_camera, photograph.camera.world_to_camera, rtol=0, atol=1e-12)


def test_held_out_views_are_measured_from_given_and_from_refined_poses(boards):
    """The scene does not change by it, bit by bit."""
    start = load_points(boards.folder)
    held_out = [
        replace(view, camera=turned(view.camera, (0.0, 1.0, 0.0), 1.5, (0.0, 0.0, 0.0))) for view in boards.views[::4]
    ]
    kept = [view for index, view in enumerate(boards.views) if index % 4]
    settings = FitSettings(steps=60, cap=1300, sh_degree=0, evaluate_every=60)
    plain, refined = (fit(kept, start, held_out, replace(settings, refine_held_out=on)) for on in (False, True))
    assert torch.equal(plain.gaussians.means, refined.gaussians.means)
    assert plain.held_out == refined.held_out
    assert (plain.held_out_refined, len(plain.held_out_views)) == ({}, 2)
    assert all(refined.held_out_refined[stem] > psnr for stem, psnr in refined.held_out.items())
    for one, truth in zip(refined.held_out_views, boards.views[::4], strict=True):
        assert one.stem == truth.stem
        assert (one.camera.position - truth.camera.position).norm() < 0.1  # back in the world of the views
