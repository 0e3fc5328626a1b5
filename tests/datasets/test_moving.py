"""The generated moving scene: its rays against closed forms, its Gaussians against its rays, its files."""

import math

import numpy as np
import pytest
import torch

from sgwarp.datasets.bodies import Body
from sgwarp.datasets.moving import LABELS, LAMP_OFF, LAMP_ON, make_moving_scene, with_label_noise
from sgwarp.datasets.moving_files import save_moving_scene
from sgwarp.errors import InputError
from sgwarp.files.images import read_ids, read_size
from sgwarp.io.moving_views import load_moving_views
from sgwarp.io.sequences import load_sequence
from sgwarp.ops.splatting.forward import rasterize

BALL = Body("ball", (0.5,), 0, (1, 1, 1))
BOX = Body("box", (1.0, 2.0, 3.0), 0, (1, 1, 1))
CAPSULE = Body("capsule", (0.5, 1.0), 0, (1, 1, 1))


def ray(body, origin, direction):
    found = body.hit(torch.tensor(origin, dtype=torch.float64), torch.tensor([direction], dtype=torch.float64))
    return float(found[0])


def test_rays_by_hand():
    assert ray(BALL, (0, 0, -2), (0, 0, 1)) == pytest.approx(1.5)
    assert ray(BALL, (0, 0.3, -2), (0, 0, 2)) == pytest.approx((2 - 0.4) / 2)
    assert ray(BALL, (0, 0.6, -2), (0, 0, 1)) == math.inf
    assert ray(BALL, (0, 0, 2), (0, 0, 1)) == math.inf  # behind
    assert ray(BALL, (0, 0, 0), (0, 0, 1)) == pytest.approx(0.5)  # from inside
    assert ray(BOX, (-5, 1, 1), (1, 0, 0)) == pytest.approx(4)
    assert ray(BOX, (-5, 2.1, 1), (1, 0, 0)) == math.inf
    assert ray(BOX, (0, 0, -7), (0, 0, 0.5)) == pytest.approx(8)
    assert ray(BOX, (0, 0, 0), (0, 1, 0)) == pytest.approx(2)
    assert ray(CAPSULE, (3, 0.9, 0), (-1, 0, 0)) == pytest.approx(2.5)  # its side
    assert ray(CAPSULE, (3, 1.4, 0), (-1, 0, 0)) == pytest.approx(3 - 0.3)  # its cap
    assert ray(CAPSULE, (0, -4, 0), (0, 1, 0)) == pytest.approx(2.5)
    assert ray(CAPSULE, (3, 1.6, 0), (-1, 0, 0)) == math.inf


@pytest.mark.parametrize("body", [BALL, BOX, CAPSULE], ids=["ball", "box", "capsule"])
def test_points_lie_on_the_surface(body):
    points, normals = body.surface(2000, torch.Generator().manual_seed(0))
    inward = torch.stack(
        [body.hit((p + 3 * n).double(), -n.double()[None])[0] for p, n in zip(points, normals, strict=True)]
    )
    assert torch.allclose(inward, torch.full_like(inward, 3.0), atol=1e-5)
    assert float(points.mean(dim=0).abs().max()) < 0.12 * body.reach  # symmetric


def test_points_are_uniform_by_area():
    points, _ = BOX.surface(40_000, torch.Generator().manual_seed(0))
    on_x = float((points[:, 0].abs() > 1 - 1e-6).float().mean())
    assert on_x == pytest.approx(6 / 11, abs=0.01)  # bc of ab + bc + ca
    points, _ = CAPSULE.surface(40_000, torch.Generator().manual_seed(0))
    assert float((points[:, 1].abs() <= 1).float().mean()) == pytest.approx(1 / 1.5, abs=0.01)


@pytest.fixture(scope="module")
def scene():
    return make_moving_scene(0, 20, 6000, cameras=4, width=96, height=72, moving_share=0.5)


def test_gaussians_show_what_the_rays_hit(scene):
    for frame in (3, 14):
        gaussians = scene.gaussians(frame)
        one_hot = torch.nn.functional.one_hot(scene.classes(frame), len(LABELS)).float()
        for view in scene.cameras[:2]:
            truth = scene.truth(frame, view.camera)
            rendered = rasterize(gaussians, view.camera, one_hot)
            found = torch.where(rendered.alpha > 0.5, rendered.features.argmax(dim=2) + 1, 0)
            assert float((found == truth).float().mean()) > 0.9


def test_turns_move_points_as_quaternions_say(scene):
    """Rotating a Gaussian's axes by its quaternion gives the axes of its body, turned."""
    gaussians = scene.gaussians(7)
    rotations, _ = scene.poses(7)
    w, x, y, z = torch.nn.functional.normalize(gaussians.quats, dim=1).unbind(1)
    axis = torch.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], dim=1)  # of local z
    w, x, y, z = scene.local_quats.unbind(1)
    local = torch.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], dim=1)
    wanted = torch.einsum("nij,nj->ni", rotations.float()[scene.owner], local)
    assert torch.allclose(axis, wanted, atol=1e-5)


def test_some_stay_some_move_one_comes_and_goes_and_the_lamp_goes_on(scene):
    first, later = scene.gaussians(0), scene.gaussians(9)
    moved = (first.means != later.means).any(dim=1)
    assert torch.equal(moved, scene.moving)
    assert float(scene.moving.float().mean()) == pytest.approx(0.5, abs=0.01)
    cart = LABELS.index("cart") + 1
    seen = [any(bool((scene.truth(t, v.camera) == cart).any()) for v in scene.cameras) for t in range(20)]
    assert not seen[0]
    assert all(seen[7:14])
    assert not seen[19]
    assert scene.switch == 10
    for frame, there, gone in ((9, LAMP_OFF, LAMP_ON), (10, LAMP_ON, LAMP_OFF)):
        labels = torch.cat([scene.truth(frame, view.camera).flatten() for view in scene.cameras]).unique().tolist()
        assert there + 1 in labels
        assert gone + 1 not in labels
        assert gone not in scene.classes(frame).tolist()


def test_principal_points_lie_off_centre(scene):
    for view in scene.cameras:
        assert abs(float(view.camera.K[0, 2]) - 48) > 1


def test_a_scene_in_which_nothing_moves():
    still = make_moving_scene(0, 5, 500, moving_share=0.0)
    assert torch.equal(still.gaussians(0).means, still.gaussians(4).means)
    with pytest.raises(InputError, match="a moving scene needs"):
        make_moving_scene(0, 0)


def test_noise_changes_whole_regions_to_other_labels():
    truth = torch.arange(15).repeat_interleave(10)
    random = torch.Generator().manual_seed(0)
    wrong = 0
    for _ in range(300):
        found = with_label_noise(truth, 0.2, random).view(15, 10)
        assert bool((found == found[:, :1]).all())
        assert int(found[0, 0]) == 0
        assert int(found[1:].min()) >= 1
        assert int(found.max()) <= 14
        wrong += int((found[1:, 0] != torch.arange(1, 15)).sum())
    assert wrong / (300 * 14) == pytest.approx(0.2, abs=0.02)


def test_files_have_the_published_layout(tmp_path):
    scene = make_moving_scene(1, 2, 400, cameras=3, width=32, height=24)
    save_moving_scene(scene, tmp_path, held_out=1)
    frame = load_sequence(tmp_path).frame(1)
    assert torch.allclose(frame.gaussians.means, scene.gaussians(1).means)
    assert torch.equal(frame.foreground, scene.moving)
    views = load_moving_views(tmp_path).at(1)
    assert [one.view.stem for one in views] == ["0", "1"]
    assert views[1].file == "1/000001.jpg"
    assert read_size(views[1].view.image_path) == (24, 32)
    assert [one.view.stem for one in load_moving_views(tmp_path, "test").at(0)] == ["2"]
    truth = scene.truth(1, scene.cameras[2].camera).numpy()
    assert np.array_equal(read_ids(tmp_path / "truth" / "00001" / "2.png"), truth)
    assert np.array_equal(read_ids(tmp_path / "labels" / "00001" / "2.png"), truth)
    assert set(np.unique(read_ids(tmp_path / "seg" / "2" / "000001.png")).tolist()) == {0, 255}
