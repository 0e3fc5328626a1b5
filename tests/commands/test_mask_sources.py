"""`sgwarp instances` from the files that other tools write: ids of a video tracker, stacks of masks at levels."""

import json

import cv2
import numpy as np
import pytest

from sgwarp.cli import main
from sgwarp.io.instances import load_instances
from sgwarp.io.scenes import load_gaussians


def find(stage_files, folder, masks: str, *options: str):
    out = folder / "found" / "i.safetensors"
    arguments = [str(stage_files.scene), "--views", str(stage_files.views), "--masks", masks, "--out", str(out)]
    assert main(["instances", *arguments, *options]) == 0
    return load_instances(out), json.loads(out.with_suffix(".table.json").read_text())["instances"]


def of_panel(stage, found, level=None) -> list[int]:
    """The instance that most decided Gaussians of each panel belong to, 0 for nothing."""
    ids = found.instance(level)
    return [int(ids[(stage.classes == panel) & (ids >= 0)].bincount().argmax()) for panel in range(1, 5)]


def write_deva(stage, folder, ids_of) -> None:
    (folder / "Annotations").mkdir(parents=True)
    frames = []
    for number, view in enumerate(stage.views):
        shown = np.append(0, ids_of(number))[stage.labels(view).numpy()]
        colors = np.stack([shown >> 16, shown >> 8 & 255, shown & 255], -1).astype(np.uint8)
        cv2.imwrite(str(folder / "Annotations" / f"{view.stem}.png"), colors)
        segments = [{"id": int(k), "category_id": 1, "score": 1.0} for k in np.unique(shown) if k]
        frames.append({"file_name": f"{view.stem}.jpg", "segments_info": segments})
    (folder / "pred.json").write_text(json.dumps({"annotations": frames}))


def test_ids_of_a_tracker_are_joined_whether_they_last_or_not(stage, stage_files, tmp_path):
    """The same ids in all frames are trusted by name; drawn anew in every frame they still give the four panels."""
    lasting = np.array([513, 70000, 7, 300])
    write_deva(stage, tmp_path / "lasting", lambda number: lasting)
    found, rows = find(stage_files, tmp_path, f"deva:{tmp_path / 'lasting'}", "--group", "name")
    assert [rows[number - 1]["label"] for number in of_panel(stage, found)] == ["513", "70000", "7", "300"]
    random = np.random.default_rng(5)
    drawn = [random.choice(100_000, 4, replace=False) + 1 for _ in stage.views]
    write_deva(stage, tmp_path / "shuffled", lambda number: drawn[number])
    found, rows = find(stage_files, tmp_path, f"deva:{tmp_path / 'shuffled'}")
    assert sorted(of_panel(stage, found)) == [1, 2, 3, 4]
    assert len(rows) == 4
    assert {row["views"] for row in rows} == {6}


@pytest.mark.parametrize("levels", ["s,l", "l"])
def test_stacks_of_masks_at_levels_give_a_tree(stage, stage_files, tmp_path, levels):
    """Door and lamp together are a large mask, wall and book another; door and lamp alone are small ones."""
    folder = tmp_path / "masks"
    folder.mkdir()
    for number, view in enumerate(stage.views):
        labels = stage.labels(view).numpy()
        masks = np.stack([labels == 2, labels == 3, (labels == 2) | (labels == 3), (labels == 1) | (labels == 4)])
        ranks = np.array([0, 0, 2, 2])
        order = np.random.default_rng(number).permutation(4)
        np.savez(folder / f"{view.stem}.npz", masks=masks[order], ranks=ranks[order], scores=np.ones(4))
    found, rows = find(stage_files, tmp_path, f"masks:{folder}", "--levels", levels)
    wall, door, lamp, book = of_panel(stage, found, "l")
    assert door == lamp != wall == book
    assert found.levels == tuple(levels.split(","))
    if levels == "s,l":
        small_wall, small_door, small_lamp, _ = of_panel(stage, found, "s")
        assert 0 == small_wall != small_door != small_lamp != 0
        assert [rows[number - 1]["parent"] for number in (small_door, small_lamp)] == [door, door]


def test_three_levels_of_nested_masks_give_the_tree_and_its_parts_can_be_edited(stage, stage_files, tmp_path):
    """Door and lamp are parts of a group, group and book of a whole; the wall is a whole without parts."""
    folder = tmp_path / "masks"
    folder.mkdir()
    for number, view in enumerate(stage.views):
        wall, door, lamp, book = (stage.labels(view).numpy() == panel for panel in range(1, 5))
        masks = np.stack([door, lamp, door | lamp, book, door | lamp | book, wall])
        order = np.random.default_rng(number).permutation(6)
        np.savez(folder / f"{view.stem}.npz", masks=masks[order], ranks=np.array([0, 0, 1, 1, 2, 2])[order])
    found, rows = find(stage_files, tmp_path, f"masks:{folder}", "--levels", "s,m,l")
    parents = {row["id"]: row["parent"] for row in rows}
    _, door, lamp, _ = of_panel(stage, found, "s")
    _, group, same, book = of_panel(stage, found, "m")
    wall, *wholes = of_panel(stage, found, "l")
    (whole,) = set(wholes)
    assert group == same
    assert len({wall, whole, group, book, door, lamp}) == 6
    assert parents == {door: group, lamp: group, group: whole, book: whole, whole: 0, wall: 0}
    assert {row["id"]: row["level"] for row in rows} == {
        **{door: "s", lamp: "s"},
        **{group: "m", book: "m"},
        **{whole: "l", wall: "l"},
    }
    for chosen, panels in ((door, {2}), (group, {2, 3}), (whole, {2, 3, 4})):
        out = tmp_path / "edited.ply"
        words = ["edit", stage_files.scene, "--instances", tmp_path / "found" / "i.safetensors", "--out", out]
        assert main([str(word) for word in (*words, "--select", f"id:{chosen}", "--extract")]) == 0
        centers = {tuple(center) for center in load_gaussians(out).means.tolist()}
        taken = np.array([tuple(center) in centers for center in stage_files.gaussians.means.tolist()])
        shares = [taken[(stage.classes == panel).numpy()].mean() for panel in range(1, 5)]
        assert all((share > 0.9) if number in panels else (share < 0.05) for number, share in enumerate(shares, 1))
