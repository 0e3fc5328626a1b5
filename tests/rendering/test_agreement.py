"""Whether scene and views belong together: the stage and its photographs, which ray tracing made, in several worlds."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from sgwarp.cli import main
from sgwarp.errors import InputError
from sgwarp.files.images import read_ids
from sgwarp.io.moving_views import load_moving_views
from sgwarp.io.scenes import save_gaussians
from sgwarp.io.views import load_views
from sgwarp.io.world_transforms import moved_views, read_world_transform
from sgwarp.rendering.agreement import compare, find_placement
from sgwarp.scene import Gaussians

SCALE = 2.5
TURN = Rotation.from_rotvec([0.4, -0.9, 0.3])
SHIFT = np.array([3.0, -1.0, 0.5])


def matrix() -> np.ndarray:
    """The world of the stage to that of the moved stage, float64 [4, 4]."""
    whole = np.eye(4)
    whole[:3, :3], whole[:3, 3] = SCALE * TURN.as_matrix(), SHIFT
    return whole


def moved(gaussians: Gaussians) -> Gaussians:
    """The stage after the transform; its colors have no direction that would turn with it."""
    means = SCALE * TURN.apply(gaussians.means.numpy()) + SHIFT
    turned = (TURN * Rotation.from_quat(gaussians.quats.numpy()[:, [1, 2, 3, 0]])).as_quat()[:, [3, 0, 1, 2]]
    means, quats = (torch.from_numpy(values).float() for values in (means, turned))
    return replace(gaussians, means=means, quats=quats, scales=SCALE * gaussians.scales)


@pytest.fixture
def elsewhere(stage_files, tmp_path):
    """The stage in a world that a trainer made, and the file that says so under another name than nerfstudio's."""
    save_gaussians(moved(stage_files.gaussians), tmp_path / "scene.ply")
    rows = matrix()[:3]
    rows[:, :3] /= SCALE
    rows[:, 3] /= SCALE  # nerfstudio scales what the transform has moved
    (tmp_path / "placed.json").write_text(json.dumps({"transform": rows.tolist(), "scale": SCALE}))
    return tmp_path


@pytest.fixture
def warned(caplog):
    """What was said by warnings, as one text."""
    return lambda: "\n".join(record.message for record in caplog.records)


def test_a_scene_matches_its_own_photographs_alone(stage_files, stage):
    views = load_views(stage_files.views)
    found = compare(stage_files.gaussians, views)
    assert found.views == 4
    assert found.correlation > 0.9
    assert compare(moved(stage_files.gaussians), views).correlation < 0.3
    assert not np.isfinite(compare(stage_files.gaussians, stage.views).correlation)  # no photographs


@pytest.mark.parametrize("color", [0, 90, 255])
def test_what_is_behind_the_scene_does_not_count(stage, stage_files, tmp_path, color):
    """Photographs with another background than black, of a scene that holds the foreground alone."""
    views = []
    for view in load_views(stage_files.views):
        picture = cv2.imread(str(view.image_path))
        front = stage.labels(view).numpy() > 1  # the wall is behind
        picture[~front] = color
        cv2.imwrite(str(tmp_path / view.image_path.name), picture)
        views.append(replace(view, image_path=tmp_path / view.image_path.name))
    front = stage_files.gaussians.subset((stage.classes > 1).nonzero().flatten())
    assert compare(front, views).correlation > 0.9
    assert compare(moved(front), views).correlation < 0.3


def test_other_photographs_are_named_as_the_reason(stage_files):
    views = load_views(stage_files.views)
    turned = [replace(view, image_path=views[-1 - place].image_path) for place, view in enumerate(views)]
    far = [turned[0], turned[-1]]  # neighbors look much alike
    found = compare(stage_files.gaussians, far)
    assert found.reordered > found.correlation + 0.1


def test_views_follow_the_world(stage):
    """A moved camera sees a moved point at the same pixel, and depth, near and far in the new unit."""
    points = np.random.default_rng(0).normal((0, 0, 3.5), size=(50, 3))
    away = points @ matrix()[:3, :3].T + matrix()[:3, 3]
    for before, after in zip(stage.views, moved_views(stage.views, matrix()), strict=True):
        lenses = [view.camera.K.double().numpy() for view in (before, after)]
        np.testing.assert_array_equal(lenses[0], lenses[1])
        seen = []
        for view, where in ((before, points), (after, away)):
            pose = view.camera.world_to_camera.double().numpy()
            pixels, _ = cv2.projectPoints(where, pose[:3, :3], pose[:3, 3], lenses[0], None)
            seen.append(np.column_stack([pixels[:, 0], (where @ pose[:3, :3].T + pose[:3, 3])[:, 2]]))
        np.testing.assert_allclose(seen[0] * [1, 1, SCALE], seen[1], rtol=1e-9, atol=1e-7)
        assert after.camera.near == pytest.approx(SCALE * before.camera.near)
        assert after.camera.far == pytest.approx(SCALE * before.camera.far)
        assert np.linalg.det(after.camera.world_to_camera[:3, :3].numpy()) == pytest.approx(1)


@pytest.mark.parametrize("form", ["npy", "txt", "json"])
def test_the_transform_as_files_of_numbers(tmp_path, form):
    path = tmp_path / f"m.{form}"
    if form == "npy":
        np.save(path, matrix()[:3])
    elif form == "txt":
        np.savetxt(path, matrix())
    else:
        path.write_text(json.dumps(matrix().tolist()))
    np.testing.assert_allclose(read_world_transform(path), matrix(), rtol=1e-12)


@pytest.mark.parametrize("wrong", [np.diag([1.0, 1, -1, 1]), np.diag([1.0, 2, 1, 1]), np.zeros((4, 4)), np.eye(2)])
def test_what_is_no_similarity_is_refused(tmp_path, wrong):
    np.save(tmp_path / "m.npy", wrong)
    with pytest.raises(InputError, match=r"m\.npy: "):
        read_world_transform(tmp_path / "m.npy")


def test_a_placement_is_given_found_or_missed(elsewhere, stage_files, warned, caplog):
    scene, views, far = elsewhere / "scene.ply", load_views(stage_files.views), moved(stage_files.gaussians)
    assert find_placement(stage_files.gaussians, scene, views) is None
    np.testing.assert_allclose(find_placement(far, scene, views, elsewhere / "placed.json"), matrix(), rtol=1e-9)
    assert warned() == ""
    assert find_placement(far, scene, views) is None
    assert "do not match" in warned()
    assert "--transform FILE" in warned()
    caplog.clear()
    (elsewhere / "placed.json").rename(elsewhere / "dataparser_transforms.json")
    np.testing.assert_allclose(find_placement(far, scene, views), matrix(), rtol=1e-9)
    assert "the views are moved" in warned()
    caplog.clear()
    assert find_placement(stage_files.gaussians, scene, views) is None  # matches as it is: the file has no say
    assert find_placement(far.subset(torch.arange(0)), scene, views) is None
    assert warned() == ""


# Every command that reads a scene together with posed photographs


def runs(*arguments) -> None:
    assert main([str(a) for a in arguments]) == 0


def instances(stage_files, folder, *more):
    """Instances of the stage by the command line; their id maps."""
    parts = [
        "--masks",
        f"files:{stage_files.labels}",
        "--out",
        folder / "i.safetensors",
        "--render-out",
        folder / "maps",
    ]
    runs("instances", folder / "scene.ply", "--views", stage_files.views, *parts, *more)
    return {path.stem: read_ids(path) for path in sorted((folder / "maps").glob("*.png"))}


def test_instances_of_a_scene_elsewhere(stage, stage_files, elsewhere, warned):
    maps = instances(stage_files, elsewhere, "--transform", elsewhere / "placed.json")
    assert warned() == ""
    for view in stage.views:
        assert ((maps[view.stem] > 0) == (stage.labels(view).numpy() > 0)).mean() > 0.95
    maps = instances(stage_files, elsewhere)
    assert "do not match" in warned()
    assert all((ids > 0).mean() < 0.5 for ids in maps.values())


def test_a_click_at_a_scene_elsewhere(stage, stage_files, elsewhere):
    placed = ["--views", stage_files.views, "--transform", elsewhere / "placed.json"]
    instances(stage_files, elsewhere, "--transform", elsewhere / "placed.json")
    view = stage.views[2]
    row, column = (int(at[len(at) // 2]) for at in np.nonzero(stage.labels(view).numpy() == 3))
    out = elsewhere / "edited.ply"
    edit = ["edit", elsewhere / "scene.ply", "--out", out, "--instances", elsewhere / "i.safetensors"]
    click = f"click:{view.stem},{column},{row}"
    runs(*edit, *placed, "--select", click, "--no-clean", "--extract", "--view", view.stem)
    rows = json.loads((elsewhere / "edited.ops.json").read_text())["steps"]
    assert rows[0]["select"] == [click]
    picture = cv2.imread(str(elsewhere / "edited.png")).astype(float)
    before, after = picture[:, : view.camera.width], picture[:, view.camera.width :]
    lamp = stage.labels(view).numpy() == 3
    assert np.abs(before - cv2.imread(str(stage_files.views / "images" / f"{view.stem}.png"))).mean() < 12
    assert after[lamp].mean() > 100 > 20 > after[~lamp].mean()  # the lamp alone is left


def test_a_moving_scene_elsewhere(stage, stage_files, elsewhere, warned):
    """The stage as a folder with one frame, its labels as those of the frame."""
    (elsewhere / "frames").mkdir()
    (elsewhere / "scene.ply").rename(elsewhere / "frames" / "0.ply")
    views = elsewhere / "views"
    (views / "images").mkdir(parents=True)
    (views / "transforms.json").write_bytes((stage_files.views / "transforms.json").read_bytes())
    (views / "images" / "00000").symlink_to(stage_files.views / "images")
    (elsewhere / "labels").mkdir()
    (elsewhere / "labels" / "00000").symlink_to(stage_files.labels)
    parts = ["track", elsewhere / "frames", "--views", views, "--encoder", f"files:{elsewhere / 'labels'}"]
    parts += ["--out", elsewhere / "out", "--no-pictures"]
    assert load_moving_views(views).at(0)[0].view.image_path is not None
    runs(*parts, "--transform", elsewhere / "placed.json")
    assert warned() == ""
    view = stage.views[-1]
    found = read_ids(elsewhere / "out" / "00000" / f"{view.stem}.png")
    assert (found == stage.labels(view).numpy()).mean() > 0.9
    runs(*parts)
    assert "do not match" in warned()


@pytest.mark.parametrize("left_there", [True, False])
def test_a_scene_may_be_left_far_from_the_origin(stage_files, tmp_path, warned, left_there):
    """Views are moved near the origin; a scene of another trainer is not, one of `sgwarp fit` is."""
    far = np.array([5000.0, -7000.0, 300.0])
    meta = json.loads((stage_files.views / "transforms.json").read_text())
    for frame in meta["frames"]:
        pose = np.array(frame["transform_matrix"])
        pose[:3, 3] += far
        frame["transform_matrix"] = pose.tolist()
    (tmp_path / "transforms.json").write_text(json.dumps(meta))
    for path in stage_files.views.iterdir():
        if path.name != "transforms.json":
            (tmp_path / path.name).symlink_to(path)
    views = load_views(tmp_path)
    origin = np.array(views[0].origin)
    shift = torch.from_numpy(far - (0 if left_there else origin)).float()
    scene = replace(stage_files.gaussians, means=stage_files.gaussians.means + shift)
    placed = find_placement(scene, tmp_path / "scene.ply", views)
    expected = np.eye(4)
    expected[:3, 3] = origin
    if left_there:
        np.testing.assert_allclose(placed, expected)
    else:
        assert placed is None
    assert compare(scene, views if placed is None else moved_views(views, placed)).correlation > 0.9
    assert "do not match" not in warned()
