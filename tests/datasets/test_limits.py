"""Which numbers of data sets are classes, and what a generated scene can be."""

import pytest
import torch

from sgwarp.datasets.moving import make_moving_scene
from sgwarp.datasets.scannet_classes import COCO20, NYU40, SCANNET20, coco_table, read_label_table, to_nyu40
from sgwarp.errors import InputError


def test_ids_that_are_no_class_are_not_scored():
    listed = {number for ids in COCO20.values() for number in ids}
    assert all((value < 0) == (number not in listed) for number, value in enumerate(coco_table().tolist()))
    last = ("curtain", "refrigerator", "shower curtain", "toilet", "sink", "bathtub", "otherfurniture")
    assert tuple(NYU40[number - 1] for number in SCANNET20[-7:]) == last  # of the benchmark's 20


def test_the_table_of_labels(tmp_path):
    table = tmp_path / "t.tsv"
    table.write_text("id\tx\tnyu40id\n3\ta\t40\n65535\tb\t\n")
    found = read_label_table(table)
    assert to_nyu40(torch.tensor([3, 4, 65535, 65536, -1]), found).tolist() == [40, 0, 0, 0, 0]
    for text, message in (
        ("a\tb\n", "has no columns id and nyu40id"),
        ("id\tnyu40id\n65536\t1\n", "line 2: id 65536 or nyu40id 1 is out of range"),
        ("id\tnyu40id\n1\t41\n", "line 2: id 1 or nyu40id 41 is out of range"),
        ("id\tnyu40id\n1\tx\n", "line 2: id and nyu40id must be whole numbers"),
    ):
        table.write_text(text)
        with pytest.raises(InputError, match=message):
            read_label_table(table)


@pytest.mark.parametrize("share", [0.25, 0.75])
def test_the_share_that_moves(share):
    scene = make_moving_scene(frames=1, count=4000, cameras=1, moving_share=share)
    assert len(scene.moving) == 4000
    assert scene.moving.double().mean().item() == pytest.approx(share, abs=1e-3)


@pytest.mark.parametrize(
    "bad", [{"frames": 0}, {"count": 0}, {"cameras": 0}, {"moving_share": 1.1}, {"moving_share": -0.1}]
)
def test_moving_scenes_that_cannot_be(bad):
    with pytest.raises(InputError, match="a moving scene needs frames, Gaussians and cameras, and a share of 0 to 1"):
        make_moving_scene(**bad)
