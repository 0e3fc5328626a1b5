"""Odd and hostile uses of `sgwarp edit` and `sgwarp instances`: one line, exit code 2, and nothing written."""

import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from sgwarp.apps.editing.selection import Selection
from sgwarp.cli import main
from sgwarp.errors import InputError
from sgwarp.io.scenes import load_gaussians, save_gaussians
from sgwarp.io.store import save_semantics
from sgwarp.lifting.lifter import lift
from sgwarp.ops.reference.rasterizer import harmonics, rotation_matrices


def runs(*arguments) -> int:
    return main([str(a) for a in arguments])


@pytest.fixture(scope="module")
def files(stage, stage_files, tmp_path_factory):
    """Instances and semantics of the stage, and an edited scene."""
    folder = tmp_path_factory.mktemp("odd")
    instances, semantics, edited = folder / "i.safetensors", folder / "s.safetensors", folder / "edited.ply"
    views = ["--views", stage_files.views]
    assert not runs(
        "instances", stage_files.scene, *views, "--masks", f"files:{stage_files.labels}", "--out", instances
    )
    save_semantics(lift(stage_files.gaussians, stage.views, stage.dense), semantics)
    assert not runs("edit", stage_files.scene, "--out", edited, "--select", "box:-9,-9,2.9,9,9,3.1", "--scale", 2)
    return folder


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("--select id:-1 --remove", "expected a whole number from 1 on"),
        ("--select text: --remove", "write text:PHRASE"),
        ("--select click:0000,96,5 --remove --views VIEWS", "outside the image, which is 96 x 72"),
        ("--select click:0000,-1,5 --remove --views VIEWS", "outside the image"),
        ("--select click:0000,0,0 --remove --views VIEWS", "selects no Gaussian"),
        ("--select click:0000,5,5 --remove", "give --views"),
        ("--select id:1 --scale 0", "expected a positive factor"),
        ("--select id:1 --rotate 0 0 1 nan", "expected a finite number"),
        ("--select id:1 --rotate 0 0 0 9", "the axis has no direction"),
        ("--select id:1 --isolate 2", "a factor from 0 to less than 1"),
        ("--select id:1 --remove --grow nan", "expected a finite number"),
        ("--select id:1 --keep all --remove", "selects no Gaussian"),
        ("--select id:1 --keep id:77 --remove", "unknown id"),
        ("--select rows:0-99999999 --remove", "the scene has rows 0 to"),
        ("--select id:1 --remove --encoder conse", "needs --semantics"),
        ("--select lamp --remove --semantics FOLDER/i.safetensors", "holds no lifted semantics"),
        ("--script FOLDER", "is a folder"),
        ("--script FOLDER/edited.ops.json --keep id:2", "--keep: goes with --select"),
        ("--script FOLDER/edited.ops.json --negatives wall", "--negatives: goes with --select"),
        ("--script FOLDER/edited.ops.json --threshold 0.1", "--threshold: goes with --select"),
        ("--script FOLDER/edited.ops.json --grow 1", "--grow: goes with --select"),
        ("--script FOLDER/edited.ops.json --no-clean", "--no-clean: goes with --select"),
        ("--select id:1 --remove --semantics FOLDER", "is a folder; give the name of a file"),
        ("--select click:0000,5 --remove --views VIEWS", "write click:VIEW,x,y"),
        ("--script FOLDER/edited.ops.json --undo 1", "has 1 steps; leave at least one"),
        ("--script FOLDER/edited.ops.json --undo -1", "has 1 steps; leave at least one"),
        ("--select id:1 --remove --undo 1", "needs --script"),
        ("--select id:1 --remove --select id:2", "--select: is given 2 times; write all values after one --select"),
        ("--select id:1 --keep=id:2 --remove --keep id:3", "--keep: is given 2 times"),
    ],
)
def test_odd_edits(stage_files, files, tmp_path, capsys, options, message):
    words = [word.replace("VIEWS", str(stage_files.views)).replace("FOLDER", str(files)) for word in options.split()]
    capsys.readouterr()
    arguments = ["--instances", files / "i.safetensors", "--out", tmp_path / "o.ply"]
    assert runs("edit", stage_files.scene, *arguments, *words) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert message in line
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "steps",
    [
        '[{"select": ["id:1"], "do": "remove"}], "steps": [{"select": ["id:2"], "do": "remove"}]',
        '[{"select": ["id:1"], "select": ["id:2"], "do": "remove"}]',
    ],
)
def test_a_script_that_says_two_things_is_refused(stage_files, files, tmp_path, capsys, steps):
    script, out = tmp_path / "script.json", tmp_path / "o.ply"
    fingerprint = stage_files.gaussians.fingerprint
    script.write_text(f'{{"format": "sgwarp-edit", "version": 1, "scene": "{fingerprint}", "steps": {steps}}}')
    instances = ["--instances", files / "i.safetensors"]
    assert runs("edit", stage_files.scene, *instances, "--script", script, "--out", out) == 2
    assert "stands twice" in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.parametrize("term", ["all", "rows:0-4128"])
def test_everything_is_everything(stage_files, tmp_path, term):
    """Scattered pieces too: the panels lie apart, and the smallest has a 25th of the largest one's Gaussians."""
    before = stage_files.gaussians.means
    assert len(before) == 4129
    assert not runs("edit", stage_files.scene, "--out", tmp_path / "o.ply", "--select", term, "--move", 0, 0, 2)
    torch.testing.assert_close(load_gaussians(tmp_path / "o.ply").means, before + torch.tensor([0.0, 0.0, 2.0]))


def test_a_click_into_a_view_whose_name_holds_commas(stage_files, files, tmp_path):
    """The same click at the same photograph under another name."""
    views = tmp_path / "views"
    shutil.copytree(stage_files.views, views)
    (views / "images" / "0000.png").rename(views / "images" / "küche, 7,5.png")
    text = (views / "transforms.json").read_text()
    (views / "transforms.json").write_text(text.replace("0000.png", "küche, 7,5.png"))
    edit = ["edit", stage_files.scene, "--instances", files / "i.safetensors", "--remove"]
    assert not runs(*edit, "--out", tmp_path / "a.ply", "--views", stage_files.views, "--select", "click:0000,40,40")
    named = ["--views", views, "--select", "click:küche, 7,5,40,40"]
    assert not runs(*edit, "--out", tmp_path / "b.ply", *named)
    assert (tmp_path / "b.ply").read_bytes() == (tmp_path / "a.ply").read_bytes()


@pytest.mark.parametrize("field", ["select", "keep", "negatives"])
def test_a_text_is_no_list_of_terms(field):
    """Taken letter by letter it would ask for nine things."""
    with pytest.raises(InputError, match=f"{field}: expected a list of terms"):
        Selection(**{"select": ("all",), field: "armchairs"})


def test_undo_leaves_out_the_last_steps(stage_files, tmp_path):
    box = ["--select", "box:-9,-9,2.9,9,9,3.1"]
    edit = ["edit", stage_files.scene, "--out"]
    assert not runs(*edit, tmp_path / "both.ply", *box, "--scale", 2, "--recolor", "red")
    assert not runs(*edit, tmp_path / "one.ply", *box, "--scale", 2)
    assert not runs(*edit, tmp_path / "undone.ply", "--script", tmp_path / "both.ops.json", "--undo", 1)
    assert (tmp_path / "undone.ply").read_bytes() == (tmp_path / "one.ply").read_bytes()
    assert (tmp_path / "undone.ops.json").read_text() == (tmp_path / "one.ops.json").read_text()


@pytest.mark.parametrize("option", ["--semantics FOLDER/s.safetensors", "--instances FOLDER/i.safetensors"])
def test_what_belongs_to_the_scene_before_an_edit(files, tmp_path, capsys, option):
    name, value = option.replace("FOLDER", str(files)).split()
    edited = files / "edited.ply"
    assert runs("edit", edited, "--out", tmp_path / "o.ply", name, value, "--select", "id:1", "--remove") == 2
    assert "belong to scene" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
    assert runs("edit", edited, "--out", tmp_path / "o.ply", "--select", "all", "--move", 0, 0, 1) == 0


def test_a_copy_in_the_same_place_can_be_changed(stage, stage_files, files, tmp_path):
    out = tmp_path / "o.ply"
    chosen = ["--select", "box:-9,-9,2.9,9,9,3.1", "--no-clean"]
    assert not runs("edit", stage_files.scene, "--out", out, *chosen, "--duplicate", 0, 0, 0, "--recolor", "red")
    after, door = load_gaussians(out), stage.classes == 2
    count = len(stage.classes)
    assert len(after) == count + int(door.sum())
    torch.testing.assert_close(after.means[count:], stage_files.gaussians.means[door])
    torch.testing.assert_close(after.sh[:count], stage_files.gaussians.sh)
    assert bool((after.sh[count:] != stage_files.gaussians.sh[door]).any())


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_turned_file_shows_its_colors_from_the_turned_direction(stage_files, tmp_path, degree):
    """By files, for every degree that they hold."""
    gaussians = stage_files.gaussians.subset(torch.arange(200))
    sh = 0.2 * torch.randn(200, (degree + 1) ** 2, 3, generator=torch.Generator().manual_seed(degree))
    save_gaussians(replace(gaussians, sh=sh), tmp_path / "scene.ply")
    out = tmp_path / "o.ply"
    assert not runs("edit", tmp_path / "scene.ply", "--out", out, "--select", "all", "--rotate", 0, 1, 0, 33)
    half = torch.tensor(33.0, dtype=torch.float64).deg2rad() / 2
    turn = rotation_matrices(torch.stack([half.cos(), half * 0, half.sin(), half * 0])[None])[0]
    directions = torch.nn.functional.normalize(torch.randn(9, 3, dtype=torch.float64), dim=1)
    here = torch.einsum("dk,nkc->ndc", harmonics(directions, degree), sh.double())
    there = torch.einsum("dk,nkc->ndc", harmonics(directions @ turn.T, degree), load_gaussians(out).sh.double())
    torch.testing.assert_close(there, here, rtol=0, atol=1e-5)


def write_masks(stage, folder, change) -> None:
    folder.mkdir()
    for number, view in enumerate(stage.views):
        ids = change(number, stage.labels(view).numpy().astype(np.uint8))
        if ids is not None:
            cv2.imwrite(str(folder / f"{view.stem}.png"), ids)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda number, ids: ids[:30, :20], "not the shape of view 0000"),
        (lambda number, ids: ids * 0, "are 0 everywhere"),
        (lambda number, ids: None, "holds no map of any of the 6 views"),
    ],
)
def test_odd_masks(stage, stage_files, tmp_path, capsys, change, message):
    write_masks(stage, tmp_path / "masks", change)
    arguments = ["--views", stage_files.views, "--masks", f"files:{tmp_path / 'masks'}"]
    assert runs("instances", stage_files.scene, *arguments, "--out", tmp_path / "i.safetensors") == 2
    assert message in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["masks"]


@pytest.mark.parametrize(
    "change",
    [lambda number, ids: ids if number % 2 else None, lambda number, ids: ids[::2, ::2]],
    ids=["half of the views", "half the size"],
)
def test_fewer_and_smaller_masks_still_give_the_panels(stage, stage_files, tmp_path, change):
    from sgwarp.io.instances import load_instances

    write_masks(stage, tmp_path / "masks", change)
    out = tmp_path / "i.safetensors"
    arguments = ["--views", stage_files.views, "--masks", f"files:{tmp_path / 'masks'}"]
    assert runs("instances", stage_files.scene, *arguments, "--out", out) == 0
    ids = load_instances(out).instance()
    majority = [int(ids[(stage.classes == panel) & (ids > 0)].mode().values) for panel in range(1, 5)]
    assert sorted(majority) == [1, 2, 3, 4]


@pytest.mark.parametrize("hidden", ["far away", "transparent"])
def test_instances_of_what_no_view_sees(stage_files, tmp_path, capsys, hidden):
    gaussians = stage_files.gaussians
    if hidden == "far away":
        gaussians = replace(gaussians, means=gaussians.means - torch.tensor([0.0, 0.0, 500.0]))
    else:
        gaussians = replace(gaussians, opacities=torch.zeros(len(gaussians)))
    save_gaussians(gaussians, tmp_path / "scene.ply")
    arguments = ["--views", stage_files.views, "--masks", f"files:{stage_files.labels}"]
    assert runs("instances", tmp_path / "scene.ply", *arguments, "--out", tmp_path / "i.safetensors") == 2
    assert "no view sees any Gaussian" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["scene.ply"]
