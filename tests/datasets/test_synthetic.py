"""Procedural rooms: repeatable, varied, and labelled as they are built."""

import pytest
import torch

from sgwarp.datasets.synthetic import CLASSES, FURNITURE, make_room, room_cameras
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
