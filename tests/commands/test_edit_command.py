"""What `sgwarp edit` makes of its options, and what it writes, prints and counts."""

import json

import numpy as np
import pytest
import torch

from sgwarp.apps.editing import operations as ops
from sgwarp.apps.editing.script import EditStep
from sgwarp.apps.editing.selection import Selection
from sgwarp.cli import main
from sgwarp.commands.edit import Edit
from sgwarp.errors import InputError
from sgwarp.files.images import read_rgb
from sgwarp.io.scenes import load_gaussians, save_gaussians
from sgwarp.io.store import save_semantics
from sgwarp.lifting.lifter import lift
from sgwarp.rendering.renderer import render
from sgwarp.runs.log import RunLog
from sgwarp.scene import Gaussians


def command(tmp_path, **options) -> Edit:
    return Edit(scene=tmp_path / "s.ply", out=tmp_path / "o.ply", **options)


OPERATIONS = [
    ({"duplicate": (1.0, 2.0, 3.0)}, ops.Duplicate((1.0, 2.0, 3.0))),
    ({"scale": 2.0}, ops.Scale(2.0)),
    ({"rotate": (0.0, 1.0, 0.0, 30.0)}, ops.Rotate((0.0, 1.0, 0.0), 30.0)),
    ({"recolor": "1,0,0.5"}, ops.Recolor((1.0, 0.0, 0.5))),
    ({"move": (0.0, 0.0, 4.0)}, ops.Move((0.0, 0.0, 4.0))),
    ({"isolate": 0.25}, ops.Isolate(0.25)),
    ({"extract": True}, ops.Extract()),
]


@pytest.mark.parametrize(("options", "operation"), [*OPERATIONS, ({"remove": True}, ops.Remove())])
def test_each_option_is_its_operation(tmp_path, options, operation):
    asked = {"keep": ("book",), "negatives": ("wall",), "threshold": 0.7, "grow": 0.2, "clean": False}
    (step,) = command(tmp_path, select=("lamp", "id:3"), **asked, **options)._steps()
    selection = Selection(("lamp", "id:3"), ("book",), ("wall",), threshold=0.7, grow=0.2, clean=False)
    assert step == EditStep(selection, operation)
    (plain,) = command(tmp_path, select=("lamp",), **options)._steps()
    assert plain.selection == Selection(("lamp",), clean=True)


def test_operations_are_applied_in_the_order_that_makes_sense_to_the_same_gaussians(tmp_path):
    options = {name: value for given, _ in reversed(OPERATIONS) for name, value in given.items()}
    steps = command(tmp_path, select=("lamp",), **options)._steps()
    assert [step.operation for step in steps] == [operation for _, operation in OPERATIONS]
    assert steps[0].selection == Selection(("lamp",))
    assert {step.selection for step in steps[1:]} == {Selection(("last",), clean=False)}


def test_nothing_is_removed_beside_another_change(tmp_path):
    with pytest.raises(InputError, match="--remove: leaves nothing that another operation could change"):
        command(tmp_path, select=("lamp",), remove=True, scale=2.0)._steps()
    for options in ({"select": ("lamp",)}, {"scale": 2.0}):
        with pytest.raises(InputError, match="give --select and at least one of --remove, "):
            command(tmp_path, **options)._steps()


STEPS = tuple(EditStep(Selection(("all",)), ops.Scale(factor)) for factor in (2.0, 3.0, 4.0))


@pytest.mark.parametrize(("undo", "left"), [(0, 3), (1, 2), (2, 1), (3, None), (-1, None), (9, None)])
def test_a_script_is_replayed_without_its_last_steps(tmp_path, undo, left):
    edit = command(tmp_path, script=tmp_path / "a.json", undo=undo)
    if left is not None:
        assert edit._replayed(STEPS) == STEPS[:left]
        return
    with pytest.raises(InputError, match=rf"--undo {undo}: .*a\.json has 3 steps"):
        edit._replayed(STEPS)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"select": ("a",)}, "--script: already says what to do"),
        ({"scale": 2.0}, "--script: already says what to do"),
        ({"keep": ("a",)}, "--keep: goes with --select"),
        ({"negatives": ("a",)}, "--negatives: goes with --select"),
        ({"threshold": 0.4}, "--threshold: goes with --select"),
        ({"grow": 0.1}, "--grow: goes with --select"),
        ({"clean": False}, "--no-clean: goes with --select"),
    ],
)
def test_a_script_says_all_that_is_done(tmp_path, options, message):
    with pytest.raises(InputError, match=message):
        command(tmp_path, script=tmp_path / "a.json", **options)._replayed(STEPS)


@pytest.fixture
def scene(tmp_path) -> tuple[Gaussians, str]:
    """Five Gaussians in a row with a column of their own."""
    gaussians = Gaussians(
        means=torch.tensor([[float(k), 0.0, 5.0] for k in range(5)]),
        quats=torch.tensor([1.0, 0, 0, 0]).expand(5, 4),
        scales=torch.full((5, 3), 0.2),
        opacities=torch.full((5,), 0.9),
        sh=torch.rand(5, 1, 3, generator=torch.Generator().manual_seed(0)),
        extras={"heat": np.arange(5, dtype=np.float32)},
    )
    save_gaussians(gaussians, tmp_path / "s.ply")
    return gaussians, str(tmp_path / "s.ply")


def run(*words) -> int:
    return main([str(word) for word in words])


@pytest.mark.parametrize(
    ("operation", "heat", "removed", "said"),
    [
        (["--remove"], [0, 2, 4], 2, "1 step; 5 Gaussians before, 3 after"),
        (["--extract"], [1, 3], 3, "1 step; 5 Gaussians before, 2 after"),
        (["--duplicate", 0, 1, 0], [0, 1, 2, 3, 4, 1, 3], 0, "1 step; 5 Gaussians before, 7 after"),
        (["--scale", 2, "--move", 0, 0, 1], [0, 1, 2, 3, 4], 0, "2 steps; 5 Gaussians before, 5 after"),
    ],
)
def test_rows_keep_their_columns_and_are_counted(scene, tmp_path, capsys, operation, heat, removed, said):
    _, path = scene
    out = tmp_path / "o" / "e.v2.ply"
    select = ["--select", "box:0.5,-1,4,1.5,1,6", "box:2.5,-1,4,3.5,1,6"]
    assert run("edit", path, "--out", out, *select, "--no-clean", *operation) == 0
    assert said in capsys.readouterr().out.splitlines()
    log = json.loads((out.parent / "run.json").read_text())
    assert log["left_out"] == ({"gaussians_removed": removed} if removed else {})
    assert log["outputs"] == [str(out), str(out.with_name("e.v2.ops.json"))]
    assert set(log["stages"]) >= {"read", "edit", "write"}
    found = load_gaussians(out)
    assert found.extras["heat"].tolist() == heat
    assert run("edit", path, "--out", out, *select, "--no-clean", *operation, "--plain") == 0
    assert load_gaussians(out).extras is None


def test_the_view_is_drawn_before_and_after(stage, stage_files, tmp_path):
    out = tmp_path / "e.ply"
    words = ["edit", stage_files.scene, "--out", out, "--select", "box:0.2,-0.9,3,0.9,0,3.5", "--no-clean", "--remove"]
    assert run(*words, "--views", stage_files.views, "--view", "0002") == 0
    picture = read_rgb(tmp_path / "e.png").astype(float) / 255
    assert picture.shape == (72, 192, 3)
    camera = stage.views[2].camera
    for half, gaussians in ((picture[:, :96], stage_files.gaussians), (picture[:, 96:], load_gaussians(out))):
        assert np.abs(half - render(gaussians, camera).clamp(0, 1).numpy()).max() < 0.01
    assert np.abs(picture[:, :96] - picture[:, 96:]).max() > 0.3
    log = json.loads((tmp_path / "run.json").read_text())
    assert log["outputs"][2:] == [str(tmp_path / "e.png")]
    assert log["stages"]["draw"] > 0
    assert run(*words, "--views", stage_files.views, "--view", "0009") == 2


def test_labels_need_no_encoder_and_all_else_has_that_of_its_lift(stage, stage_files, toy_text, tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr("sgwarp.encoders.registry.text_encoder_for", lambda *given: asked.append(given) or toy_text)
    for name, maps in (("labels", stage.one_hot), ("features", stage.dense)):
        path = tmp_path / f"{name}.safetensors"
        save_semantics(lift(stage_files.gaussians, stage.views[:1], maps), path, {"encoder": "clip:first"})
        edit = Edit(scene=stage_files.scene, out=tmp_path / "o.ply", semantics=path)
        context = edit._context(stage_files.gaussians, RunLog())
        assert context.semantics.space == ("labels" if name == "labels" else "toy")
        assert context.encoder is (None if name == "labels" else toy_text)
        assert (context.instances, context.views) == (None, ())
    assert asked == [("toy", "clip:first", "cpu")]
    edit.encoder = "clip:other"
    edit._context(stage_files.gaussians, RunLog())
    assert asked[1:] == [("toy", "clip:other", "cpu")]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--view", "1"], "--view 1: needs --views"),
        (["--undo", 1], "--undo 1: needs --script"),
        (["--encoder", "clip"], "--encoder clip: needs --semantics"),
    ],
)
def test_options_that_need_another(scene, tmp_path, capsys, options, message):
    words = ["edit", scene[1], "--out", tmp_path / "e.ply", "--select", "all", "--scale", 2]
    assert run(*words, *options) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "e.ply").exists()
