"""Procedural rooms: repeatable, varied, and labelled as they are built."""

from dataclasses import replace

import pytest
import torch

from sgwarp.datasets.labelled_folder import open_scene
from sgwarp.datasets.synthetic import CLASSES, FURNITURE, make_room, room_cameras
from sgwarp.datasets.synthetic_files import room_truth, save_room
from sgwarp.io.scenes import load_gaussians
from sgwarp.ops.reference.rasterizer import rotation_matrices
from sgwarp.rendering.renderer import render

COUNT = 6000


@pytest.fixture(scope="module")
def rooms():
    return [make_room(seed, COUNT) for seed in range(4)]


def test_a_seed_is_a_room(rooms):
    again = make_room(1, COUNT)
    assert torch.equal(again.gaussians.means, rooms[1].gaussians.means)
    assert torch.equal(again.classes, rooms[1].classes)
    assert len({room.size for room in rooms}) == 4


def test_labels_belong_to_pieces(rooms):
    for room in rooms:
        assert len(room.gaussians) == len(room.classes) == COUNT
        assert torch.equal(room.class_of_piece[room.pieces], room.classes)
        assert bool(room.gaussians.finite.all())
    kinds = {CLASSES[k] for room in rooms for k in room.classes.unique().tolist()}
    assert kinds == {*FURNITURE, "floor", "ceiling", "wall"} == set(CLASSES)


def test_everything_stands_in_the_room(rooms):
    """y points down: the ceiling is at 0, the floor at the room's height."""
    for room in rooms:
        size = torch.tensor(room.size)
        assert bool((room.gaussians.means > -0.1).all())
        assert bool((room.gaussians.means < size + 0.1).all())
        for name, y in (("ceiling", 0.0), ("floor", room.size[1])):
            level = room.gaussians.means[room.classes == CLASSES.index(name), 1]
            assert float((level - y).abs().max()) < 0.1


def test_gaussians_lie_flat_on_their_surface(rooms):
    room = rooms[0]
    floor = room.classes == CLASSES.index("floor")
    normals = rotation_matrices(room.gaussians.quats[floor].double())[:, :, 2]
    assert float(normals[:, 1].abs().min()) > 1 - 1e-6
    assert bool((room.gaussians.scales[:, 2] < room.gaussians.scales[:, :2].amin(dim=1)).all())


def test_cameras_see_the_room(rooms):
    for camera in room_cameras(rooms[0], 0, 4, 64, 48):
        assert bool((camera.position > 0).all())
        assert bool((camera.position < torch.tensor(rooms[0].size)).all())
        assert float(render(rooms[0].gaussians, camera, "alpha").mean()) > 0.8


def test_truth_of_a_ray_is_the_first_thing_on_it(rooms):
    """Rays through centers of Gaussians, one camera of one pixel each: a face lies there, or something before it."""
    room = rooms[2]
    camera = room_cameras(room, 5, 3, 80, 60)[1]
    points = room.gaussians.means.double() @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    chosen = (points[:, 2] > 0.3).nonzero().flatten()[::60]
    same = []
    for index in chosen.tolist():
        K = camera.K.clone()
        K[:2, 2] = 0.5 - K[[0, 1], [0, 1]] * points[index, :2] / points[index, 2]
        classes, depth = room_truth(room, replace(camera, K=K, width=1, height=1))
        behind = float(points[index, 2] - depth[0, 0])
        assert behind > -0.1  # centers lie on faces, but for their noise along the normal and grazing rays
        if abs(behind) < 0.02:  # the noise has a deviation of 8 mm
            same.append(int(classes[0, 0]) == int(room.classes[index]))
    assert len(same) > 15
    assert all(same)
    classes, depth = room_truth(room, camera)
    assert bool((classes >= 0).all())  # the room is closed
    assert float(depth.min()) > 0


def test_a_saved_room_reads_back(rooms, tmp_path):
    save_room(rooms[0], tmp_path, 2, 32, 24)
    scene = open_scene(tmp_path, tmp_path.name)
    views = scene.load_views()
    classes, depth = room_truth(rooms[0], views[1].camera)
    assert torch.equal(scene.load_labels("0001"), classes)
    pieces = scene.load_instances("0001") - 1
    assert len(pieces.unique()) > len(classes.unique())  # several of a class
    assert torch.equal(rooms[0].class_of_piece[pieces], classes)
    assert torch.allclose(torch.from_numpy(scene.load_depth(views[1])).double(), depth, atol=6e-4)
    assert scene.classes == CLASSES
    assert load_gaussians(scene.gaussians).extras["label"].tolist() == rooms[0].classes.tolist()
