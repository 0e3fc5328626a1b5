"""Every option of a command reaches the function that does the work, and what that returns is what is written.

The work itself is replaced by a function that notes how it was called and stops the command.
"""

import json
from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from sgwarp.cli import main
from sgwarp.commands import COMMANDS
from sgwarp.files.images import read_ids, read_rgb, write_ids
from sgwarp.io.points import load_points
from sgwarp.io.store import load_semantics, read_notes, save_semantics
from sgwarp.lifting.lifter import lift
from sgwarp.lifting.settings import LiftSettings
from sgwarp.ops.launcher import get_threads, set_threads
from sgwarp.querying.scoring import score_texts
from sgwarp.querying.segmentation import localize, segment
from sgwarp.rendering.renderer import render

NAMES = ["wall", "left door", "lamp", "book"]


def run(*arguments) -> int:
    return main([str(argument) for argument in arguments])


@pytest.fixture
def semantics(stage, stage_files, tmp_path):
    """Lifted features whose weights differ, and label shares, on disk."""
    path = {name: tmp_path / f"{name}.safetensors" for name in ("text", "labels", "predicted")}
    dense = lift(stage_files.gaussians, stage.views, stage.dense)
    save_semantics(dense, path["text"], {"encoder": "clip:somewhere"})
    wrong = replace(dense, features=dense.features.roll(1, dims=1), weight=dense.weight.flip(0))
    save_semantics(wrong, path["predicted"])
    save_semantics(lift(stage_files.gaussians, stage.views, stage.one_hot), path["labels"])
    return SimpleNamespace(**path)


@pytest.fixture
def speaks(toy_text, monkeypatch):
    """The toy text encoder in the place of all others; holds how it was asked for."""
    asked = []

    def encoder(*arguments):
        asked.append(arguments)
        return toy_text

    monkeypatch.setattr("sgwarp.encoders.registry.text_encoder_for", encoder)
    return asked


# fit

FIT = "sgwarp.reconstruction.fitting.trainer.fit"


@pytest.fixture
def photographs(stage_files, tmp_path):
    """The views of the stage with points, depth, and masks."""
    for name in ("depth", "masks"):
        (tmp_path / name).mkdir()
    for k in range(6):
        np.save(tmp_path / "depth" / f"{k:04d}.npy", np.full((72, 96), 3.0, np.float32))
        mask = torch.ones(72, 96, dtype=torch.uint8)
        mask[k] = 0
        write_ids(tmp_path / "masks" / f"{k:04d}.png", mask)
    return SimpleNamespace(views=stage_files.views, depth=tmp_path / "depth", masks=tmp_path / "masks")


@pytest.mark.parametrize(("every", "held_out"), [(8, [0]), (4, [0, 4]), (2, [0, 2, 4]), (0, [])])
def test_fit_holds_out_every_nth_view(stopped, photographs, tmp_path, every, held_out):
    call = stopped(FIT, "fit", photographs.views, "--out", tmp_path / "s.ply", "--hold-out", every)
    kept, start, shown, _ = call.positional
    assert [view.stem for view in shown] == [f"{k:04d}" for k in held_out]
    assert [view.stem for view in kept] == [f"{k:04d}" for k in range(6) if k not in held_out]
    assert start is None  # random: the views have no points


FIT_OPTIONS = {
    "steps": 77,
    "strategy": "default",
    "cap": 1234,
    "sh_degree": 2,
    "background": "white",
    "seed": 5,
    "exposure": True,
    "sparse": False,
}


@pytest.mark.parametrize(("name", "value"), FIT_OPTIONS.items())
def test_fit_settings(stopped, photographs, tmp_path, name, value):
    option = f"--{name.replace('_', '-')}"
    given = [option, value] if not isinstance(value, bool) else [option if value else f"--no-{name}"]
    arguments = ["fit", photographs.views, "--out", tmp_path / "s.ply"]
    plain, changed = (stopped(FIT, *arguments, *more).positional[3] for more in ([], given))
    assert getattr(plain, name) != value
    assert getattr(changed, name) == value
    others = {field.name for field in fields(plain)} - {name, "evaluate_every", "degree_every"}
    assert all(getattr(plain, other) == getattr(changed, other) for other in others)


@pytest.mark.parametrize(
    ("steps", "degree", "evaluate_every", "degree_every"),
    [(10_000, 3, 500, 1000), (2_000, 3, 200, 500), (2_000, 1, 200, 1000), (3, 3, 1, 1)],
)
def test_fit_schedules_of_short_runs(stopped, photographs, tmp_path, steps, degree, evaluate_every, degree_every):
    options = ["--out", tmp_path / "s.ply", "--steps", steps, "--sh-degree", degree]
    settings = stopped(FIT, "fit", photographs.views, *options).positional[3]
    assert (settings.evaluate_every, settings.degree_every) == (evaluate_every, degree_every)


def test_fit_arguments(stopped, photographs, tmp_path):
    arguments = ["fit", photographs.views, "--out", tmp_path / "s.ply"]
    call = stopped(FIT, *arguments)
    assert (call.downscale, call.masks, call.checkpoint_every, call.resume) == (1, None, 1000, False)
    assert (call.keep_checkpoint, call.checkpoint, call.device) == (True, tmp_path / "s.ply.checkpoint", "cpu")
    more = ["--downscale", 2, "--masks", photographs.masks, "--checkpoint-every", 50, "--resume"]
    call = stopped(FIT, *arguments, *more)
    assert (call.downscale, call.checkpoint_every, call.resume) == (2, 50, True)
    for view in (*call.positional[0], *call.positional[2]):
        assert (np.flatnonzero(call.masks(view)[:, 0] == 0) == int(view.stem)).all()


def test_fit_starts(stopped, photographs, boards_points, tmp_path):
    arguments = ["fit", photographs.views, "--out", tmp_path / "s.ply", "--cap", 500]
    start = stopped(FIT, *arguments, "--points", boards_points).positional[1]
    np.testing.assert_array_equal(start[0], load_points(boards_points)[0])
    start = stopped(FIT, *arguments, "--depth", photographs.depth, "--points", boards_points).positional[1]
    assert 0 < len(start) <= 500
    assert 2.9 < start.means[:, 2].median() < 3.2
    assert stopped(FIT, *arguments, "--points", boards_points, "--init", "random").positional[1] is None
    chosen = stopped(FIT, *arguments, "--points", boards_points, "--depth", photographs.depth, "--init", "points")
    assert isinstance(chosen.positional[1], tuple)
    assert stopped(FIT, *arguments, "--points", boards_points, "--resume").positional[1] is None
    made = stopped("sgwarp.reconstruction.depth.gaussians_from_depth", *arguments, "--depth", photographs.depth)
    assert made.count == 500
    assert [view.stem for view in made.positional[0]] == ["0001", "0002", "0003", "0004", "0005"]


def test_fit_writes_the_sheet_of_what_it_held_out(stopped, photographs, tmp_path):
    """At the size, with the masks and before the background that the fit had."""
    target = "sgwarp.reconstruction.fitting.report.write_contact_sheet"
    options = ["--steps", 2, "--cap", 200, "--out", tmp_path / "s.ply", "--hold-out", 2, "--background", "white"]
    call = stopped(target, "fit", photographs.views, *options, "--downscale", 2, "--masks", photographs.masks)
    gaussians, shown, path = call.positional
    assert 0 < len(gaussians) <= 200
    assert [photograph.stem for photograph in shown] == ["0000", "0002", "0004"]
    assert all(photograph.camera.size == (36, 48) for photograph in shown)
    assert all(photograph.mask is not None for photograph in shown)
    assert (path, call.white) == (tmp_path / "s.held_out.jpg", True)


@pytest.mark.parametrize("hides", ["black", "white"])
def test_fit_masks_hide_what_is_asked_for(stopped, photographs, tmp_path, hides):
    target = "sgwarp.reconstruction.fitting.belongings.masks_from_folder"
    options = ["--out", tmp_path / "s.ply", "--masks", photographs.masks, "--mask-hides", hides]
    folder, views, asked = stopped(target, "fit", photographs.views, *options).positional
    assert (folder, len(views), asked) == (photographs.masks, 6, hides)


@pytest.fixture
def boards_points(tmp_path):
    from plyfile import PlyData, PlyElement

    rows = np.zeros(50, dtype=[*((axis, "<f4") for axis in "xyz"), *((c, "u1") for c in ("red", "green", "blue"))])
    rows["x"], rows["z"] = np.linspace(-1, 1, 50), 3.0
    path = tmp_path / "some_points.ply"
    PlyData([PlyElement.describe(rows, "vertex")]).write(str(path))
    return path


# lift

LIFT = "sgwarp.lifting.lifter.lift"


def test_lift_arguments(stopped, stage_files, tmp_path):
    arguments = ["lift", stage_files.scene, "--views", stage_files.views, "--out", tmp_path / "s.safetensors"]
    arguments += ["--encoder", f"files:{stage_files.labels}"]
    call = stopped(LIFT, *arguments)
    gaussians, views, _, mode = call.positional
    assert gaussians.fingerprint == stage_files.gaussians.fingerprint
    assert [view.stem for view in views] == [f"{k:04d}" for k in range(6)]
    assert all(view.image_path is not None for view in views)
    assert (mode, call.lift_settings, call.share_of_views, call.deterministic) == (
        "weighted",
        LiftSettings(),
        1.0,
        None,
    )
    more = ["--mode", "center", "--tau", 0.2, "--border", 3, "--share-of-views", 0.5, "--deterministic"]
    more += ["--passes", 7, "--ridge", 2.5, "--iterations", 9, "--reliability", "--fill", 2]
    call = stopped(LIFT, *arguments, *more, "--no-photographs")
    assert call.positional[3] == "center"
    chosen = LiftSettings(tau=0.2, border=3, passes=7, ridge=2.5, iterations=9, reliability=True, fill=2)
    assert (call.lift_settings, call.share_of_views, call.deterministic) == (chosen, 0.5, True)
    assert all(view.image_path is None for view in call.positional[1])


def test_lift_makes_its_encoder(stopped, stage_files, tmp_path, monkeypatch):
    monkeypatch.setenv("SGWARP_CACHE", str(tmp_path / "own"))
    target = "sgwarp.encoders.registry.make_encoder"
    arguments = ["lift", stage_files.scene, "--views", stage_files.views, "--out", tmp_path / "s.safetensors"]
    name, views, device, cache, limit = stopped(target, *arguments).positional
    assert (name, len(views), device, limit) == ("conse", 6, "cpu", 10.0)
    assert Path(cache) == tmp_path / "own"
    for given, expected in (("none", None), (tmp_path / "here", str(tmp_path / "here"))):
        more = ["--cache", given, "--cache-limit", 2.5, "--encoder", "conse:dense"]
        call = stopped(target, *arguments, *more).positional
        assert (call[0], call[3], call[4]) == ("conse:dense", expected, 2.5)


@pytest.mark.slow
def test_lift_notes_how_it_was_done(stage, stage_files, tmp_path):
    out = tmp_path / "s.safetensors"
    name = f"files:{stage_files.labels}"
    options = ["--encoder", name, "--mode", "center", "--border", 3]
    assert run("lift", stage_files.scene, "--views", stage_files.views, "--out", out, *options) == 0
    assert read_notes(out) == {"encoder": name, "mode": "center", "views": 6}
    mine = lift(stage_files.gaussians, stage.views[:5], stage.one_hot, "center", border=3)
    torch.testing.assert_close(load_semantics(out).weight, mine.weight)


# query and segment


def test_faint_gaussians_have_no_say(stopped, stage_files, semantics, speaks, tmp_path, capsys):
    """--min-weight takes the weight from those below it, in every command that asks semantics."""
    weight = load_semantics(semantics.text).weight
    least = float(weight[weight > 0].median())
    more = ["--semantics", semantics.text, "--views", stage_files.views, "--min-weight", least]
    target = "sgwarp.querying.scores.class_votes"
    call = stopped(target, "segment", stage_files.scene, *more, "--classes", "lamp", "--out", tmp_path / "maps")
    asked = call.positional[0]
    assert torch.equal(asked.weight, torch.where(weight >= least, weight, 0.0))
    assert 0.4 < asked.seen.float().mean() < 0.6
    more[-1] = 1e9
    assert run("segment", stage_files.scene, *more, "--classes", "lamp", "--out", tmp_path / "maps") == 2
    assert "--min-weight 1e+09: no Gaussian has as much" in capsys.readouterr().err


def test_query_scores_what_it_is_told(stopped, stage_files, semantics, speaks, tmp_path):
    target = "sgwarp.querying.scoring.score_texts"
    arguments = ["query", stage_files.scene, "--views", stage_files.views, "--view", "0002", "--text", "lamp"]
    arguments += ["--out", tmp_path / "mask.png", "--semantics"]
    call = stopped(target, *arguments, semantics.text)
    assert (call.positional[1], call.measure, call.ensemble, call.predicted) == (["lamp"], None, "max", None)
    assert call.canonical == ("object", "things", "stuff", "texture")
    assert speaks.pop() == ("toy", "clip:somewhere", "cpu", None)
    more = ["--score", "relevancy", "--canonical", "x", "y", "--predicted", semantics.predicted, "--ensemble", "sum"]
    call = stopped(target, *arguments, semantics.text, *more, "--encoder", "other", "--templates", "a {}")
    assert (call.measure, call.canonical, call.ensemble) == ("relevancy", ("x", "y"), "sum")
    assert torch.equal(call.predicted.features, load_semantics(semantics.predicted).features)
    assert speaks.pop() == ("toy", "other", "cpu", ("a {}",))
    assert stopped(target, *arguments, semantics.labels).positional[2] is None  # labels need no encoder
    assert not speaks


@pytest.mark.parametrize("options", [{}, {"threshold": 0.9}, {"threshold": 0.1, "box": 1}, {"score": "relevancy"}])
def test_query_writes_what_is_above_the_threshold(
    stage, stage_files, semantics, toy_text, speaks, tmp_path, capsys, options
):
    more = [piece for name, value in options.items() for piece in (f"--{name}", value)]
    out = tmp_path / "mask.png"
    arguments = ["query", stage_files.scene, "--views", stage_files.views, "--view", "0003", "--text", "lamp"]
    assert run(*arguments, "--semantics", semantics.text, "--out", out, *more) == 0
    measure = options.get("score", "cosine")
    scores = score_texts(load_semantics(semantics.text), ["lamp"], toy_text, measure=measure)
    view = stage.views[3]
    place, score_map = localize(
        scores.values[:, 0], stage_files.gaussians, view.camera, seen=scores.seen, box=options.get("box", 9)
    )
    expected = score_map > options.get("threshold", 0.5)
    assert 0 < expected.float().mean() < 0.5
    assert (torch.from_numpy(read_ids(out).astype("int64")) > 0).eq(expected).float().mean() > 0.999
    assert f"lamp: best pixel {place}, score {score_map[place[1], place[0]]:.3f};" in capsys.readouterr().out
    heat = read_rgb(tmp_path / "mask_heat.png")
    assert heat.shape == (*view.camera.size, 3)
    assert len(np.unique(heat.reshape(-1, 3), axis=0)) > 50


def test_segment_votes_as_it_is_told(stopped, stage_files, semantics, speaks, tmp_path):
    target = "sgwarp.querying.scores.class_votes"
    arguments = ["segment", stage_files.scene, "--views", stage_files.views, "--out", tmp_path / "o"]
    arguments += ["--semantics", semantics.text, "--classes", "lamp,wall"]
    call = stopped(target, *arguments)
    assert call.positional[1] == ["lamp", "wall"]
    assert call.positional[3:] == (None, None)
    assert (call.predicted, call.ensemble) == (None, "max")
    more = ["--scoring", "evidence", "--temperature", 0.7, "--predicted", semantics.predicted, "--ensemble", "mean"]
    call = stopped(target, *arguments, *more)
    assert call.positional[3:] == (0.7, "evidence")
    assert call.ensemble == "mean"
    assert torch.equal(call.predicted.features, load_semantics(semantics.predicted).features)


@pytest.mark.parametrize("options", [{}, {"unknown_below": 0.97}, {"scoring": "evidence"}, {"temperature": 3.0}])
def test_segment_writes_what_python_says(stage, stage_files, semantics, toy_text, speaks, tmp_path, options):
    more = [piece for name, value in options.items() for piece in (f"--{name.replace('_', '-')}", value)]
    out, view = tmp_path / "o", stage.views[1]
    arguments = ["segment", stage_files.scene, "--semantics", semantics.text, "--views", stage_files.views]
    assert run(*arguments, "--view", "0001", "--classes", "lamp,wall,book", "--out", out, *more) == 0
    loaded = load_semantics(semantics.text)
    found = torch.from_numpy(read_ids(out / "0001.png").astype("int64"))
    names = ["lamp", "wall", "book"]
    expected, _ = segment(stage_files.gaussians, loaded, names, view.camera, toy_text, **options)
    assert found.eq(expected).float().mean() > 0.999
    unknown = json.loads((out / "run.json").read_text())["error"]["unknown"]
    assert unknown == pytest.approx(float((found == 255).float().mean()))
    if "unknown_below" in options:
        plain, _ = segment(stage_files.gaussians, loaded, names, view.camera, toy_text)
        assert (expected == 255).sum() > (plain == 255).sum() + 50
    overlay = read_rgb(out / "overlays" / "0001.png")
    assert overlay.shape[1] > view.camera.width  # the legend stands beside it


def test_segment_of_lifted_labels_gives_places_in_the_list(stage, stage_files, semantics, tmp_path):
    """Without a list the ids of the label images, with one the index of the class."""
    arguments = ["segment", stage_files.scene, "--semantics", semantics.labels, "--views", stage_files.views]
    truth = stage.labels(stage.views[2])
    for more, expected in (([], [0, 1, 2, 3, 4]), (["--classes", "4,2"], [255, 255, 1, 255, 0])):
        assert run(*arguments, "--view", "0002", "--out", tmp_path / "o", *more) == 0
        found = torch.from_numpy(read_ids(tmp_path / "o" / "0002.png").astype("int64"))
        assert (found == torch.tensor(expected)[truth]).float().mean() > 0.93


# render, predict, distill, report, demo and what all take


@pytest.mark.parametrize("mode", ["rgb", "depth", "expected_depth", "alpha"])
def test_render_writes_what_python_renders(stage, stage_files, tmp_path, mode):
    out = tmp_path / "picture.png"
    arguments = ["render", stage_files.scene, "--views", stage_files.views, "--view", "0004", "--mode", mode]
    assert run(*arguments, "--out", out, "--background", "white") == 0
    camera = stage.views[4].camera
    background = torch.ones(3) if mode == "rgb" else None
    image = render(stage_files.gaussians, camera, mode, background=background)
    if mode in ("depth", "expected_depth"):
        np.testing.assert_allclose(np.load(tmp_path / "picture.npy"), image, atol=1e-4)
        assert read_rgb(out).std() > 10
        return
    drawn = read_rgb(out).astype(float) / 255
    expected = image if mode == "rgb" else image[..., None].expand(-1, -1, 3)
    assert np.abs(drawn - expected.clamp(0, 1).numpy()).max() < 0.01


def test_render_turns_as_it_is_told(stopped, stage_files, tmp_path):
    target = "sgwarp.rendering.orbits.orbit_views"
    arguments = ["render", stage_files.scene, "--out", tmp_path / "o"]
    call = stopped(target, *arguments)
    assert call.positional[1:] == (12, 640, 480)
    assert call.up == "y-down"
    call = stopped(target, *arguments, "--frames", 5, "--size", 64, 32, "--up", "z-up")
    assert call.positional[1:] == (5, 64, 32)
    assert call.up == "z-up"


def test_predict_loads_what_it_is_told(stopped, stage_files, tmp_path):
    target = "sgwarp.network.semantic_network.load_network"
    arguments = ["predict", stage_files.scene, "--out", tmp_path / "p.safetensors", "--net", tmp_path / "n.pth"]
    call = stopped(target, *arguments)
    assert call.positional == (tmp_path / "n.pth",)
    assert (call.inputs, call.voxel, call.space) == (None, None, None)
    call = stopped(target, *arguments, "--inputs", "ones", "--voxel", 0.05, "--space", "lseg")
    assert (call.inputs, call.voxel, call.space) == ("ones", 0.05, "lseg")


DISTILL = "sgwarp.network.training.trainer.distill"
DISTILL_OPTIONS = {
    "arch": "14A",
    "inputs": "ones",
    "voxel": 0.3,
    "epochs": 7,
    "learning_rate": 0.5,
    "scenes_per_step": 3,
    "views_per_step": 5,
    "loss": "contrastive",
    "by_reliability": True,
    "half": True,
    "seed": 9,
    "augment": None,
}


@pytest.fixture
def training(stage_files, semantics, tmp_path):
    """One scene with its semantics beside it."""
    folder = tmp_path / "scenes"
    folder.mkdir()
    (folder / "a.ply").write_bytes(stage_files.scene.read_bytes())
    (folder / "a.safetensors").write_bytes(semantics.text.read_bytes())
    return folder


@pytest.mark.parametrize(("name", "value"), DISTILL_OPTIONS.items())
def test_distill_settings(stopped, training, tmp_path, name, value):
    option = f"--{name.replace('_', '-')}"
    given = {True: [option], None: [f"--no-{name}"]}.get(value, [option, value])
    arguments = ["distill", training, "--out", tmp_path / "net.safetensors"]
    plain, changed = (stopped(DISTILL, *arguments, *more).positional[1] for more in ([], given))
    assert getattr(plain, name) != value
    assert getattr(changed, name) == value
    others = {field.name for field in fields(plain)} - {name}
    assert all(getattr(plain, other) == getattr(changed, other) for other in others)


def test_distill_arguments(stopped, training, semantics, speaks, tmp_path):
    arguments = ["distill", training, "--out", tmp_path / "net.safetensors"]
    call = stopped(DISTILL, *arguments)
    assert [scene.name for scene in call.positional[0]] == [str(training / "a.ply")]
    assert (call.validation, call.class_vectors, call.weights) == ([], None, None)
    assert (call.state, call.device) == (tmp_path / "net.state.pt", "cpu")
    assert call.positional[1].augment.up == 2
    more = ["--validation", training, "--classes", "lamp,wall", "--checkpoint", tmp_path / "w.pth", "--up", "y"]
    call = stopped(DISTILL, *arguments, *more)
    assert [scene.name for scene in call.validation] == [str(training / "a.ply")]
    assert torch.equal(call.class_vectors, torch.eye(5)[[2, 0]])
    assert call.weights == tmp_path / "w.pth"
    assert call.positional[1].augment.up == 1
    assert speaks == [("toy",)]


def test_report_arguments(stopped, stage_files, tmp_path):
    target = "sgwarp.evaluation.report.run.make_report"
    arguments = ["report", stage_files.scene, "--views", stage_files.views, "--out", tmp_path / "o"]
    call = stopped(target, *arguments)
    assert call.positional[2:] == (tmp_path / "o", "scene")
    assert (call.labels, call.held_out, call.patches, call.repeats, call.seed) == (None, 2, 60, 5, 0)
    assert len(call.extremes) > 10
    more = ["--labels", stage_files.labels, "--held-out", 3, "--patches", 4, "--repeats", 2, "--seed", 6]
    call = stopped(target, *arguments, *more, "--no-extremes")
    assert (call.labels, call.held_out, call.patches, call.repeats, call.seed) == (stage_files.labels, 3, 4, 2, 6)
    assert call.extremes == ()


def test_report_takes_views_of_another_world(stopped, stage, stage_files, tmp_path, capsys):
    path = tmp_path / "move.json"
    path.write_text(json.dumps({"transform": [[1, 0, 0, 0.5], [0, 1, 0, 0], [0, 0, 1, 0]], "scale": 1.0}))
    arguments = ["report", stage_files.scene, "--views", stage_files.views, "--out", tmp_path / "o"]
    call = stopped("sgwarp.evaluation.report.run.make_report", *arguments, "--transform", path)
    moved = call.positional[1][2].camera.position - stage.views[2].camera.position
    torch.testing.assert_close(moved, torch.tensor([0.5, 0, 0], dtype=torch.float64), rtol=0, atol=1e-5)
    assert run(*arguments, "--images", "images_4") == 2
    assert "COLMAP models only" in capsys.readouterr().err


def test_poses_arguments(stopped, stage_files, tmp_path):
    target, source = "sgwarp.commands.poses.find_poses", stage_files.views / "images"
    call = stopped(target, "poses", source, "--out", tmp_path / "o").positional
    assert (*call[:2], *call[3:]) == (source, tmp_path / "o", "auto", True, None, 0)
    more = ["--matching", "sequential", "--no-one-camera", "--every", 3, "--seed", 5]
    call = stopped(target, "poses", source, "--out", tmp_path / "o", *more).positional
    assert call[3:] == ("sequential", False, 3, 5)


def test_demo_writes_where_it_is_told(stopped, tmp_path):
    assert stopped("sgwarp.demo.run.run_demo", "demo", "--out", tmp_path / "o").positional == (tmp_path / "o",)


def test_threads_are_those_of_the_run(stage_files, tmp_path):
    before = get_threads(), torch.get_num_threads()
    try:
        arguments = ["render", stage_files.scene, "--views", stage_files.views, "--view", "0001", "--out", tmp_path]
        assert run(*arguments, "--threads", 3) == 0
        assert (get_threads(), torch.get_num_threads()) == (3, 3)
        assert json.loads((tmp_path / "run.json").read_text())["threads"] == 3
    finally:
        set_threads(before[0])
        torch.set_num_threads(before[1])


def test_every_command_is_tried_here():
    """A new command brings a test of its options; what an application takes is tested with it."""
    text = Path(__file__).read_text(encoding="utf-8")
    tested_elsewhere = {"batch", "convert", "edit", "encoders", "evaluate", "info", "instances", "track", "view"}
    assert not [name for name in COMMANDS if f'"{name}"' not in text and name not in tested_elsewhere]
