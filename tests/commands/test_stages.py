"""How a worker of `sgwarp batch` parses, runs, warms up and measures the commands, in this process."""

import logging
import shlex
import shutil
from pathlib import Path

import pytest

from sgwarp.cluster.listing import Scene
from sgwarp.commands import scene_stages
from sgwarp.commands.render import Render
from sgwarp.commands.scene_size import count_gaussians, measure
from sgwarp.commands.scene_stages import Plan, parse, run_stage, stages_of, warm
from sgwarp.errors import InputError
from sgwarp.io.scenes import save_gaussians


@pytest.fixture
def rendered(monkeypatch):
    """Renderings as they are asked for; none is made."""
    commands = []
    monkeypatch.setattr(Render, "run", lambda command: commands.append(command))
    return commands


def test_a_stage_is_run_as_its_command_line_says(rendered, stage_files, tmp_path, capsys):
    words = [str(stage_files.scene), "--out", str(tmp_path / "my renders"), "--views", str(stage_files.views)]
    run_stage("render", [*words, "--frames", "5"])
    (command,) = rendered
    assert (command.scene, command.out, command.frames) == (stage_files.scene, tmp_path / "my renders", 5)
    assert command.command_line == shlex.join(["sgwarp", "render", *words, "--frames", "5"])
    assert "--frames" in capsys.readouterr().err, "it has no effect on views"


def test_a_stage_writes_over_none_of_its_inputs(rendered, stage_files, tmp_path):
    (tmp_path / "run.json").write_text("views")
    with pytest.raises(InputError, match="is read by this command"):
        run_stage("render", [str(stage_files.scene), "--views", str(tmp_path / "run.json"), "--out", str(tmp_path)])
    assert not rendered


@pytest.mark.parametrize("checkpoint", [False, True])
def test_a_fit_goes_on_from_what_a_killed_process_left(monkeypatch, tmp_path, checkpoint):
    fitted = []
    monkeypatch.setattr(scene_stages.Fit, "run", lambda command: fitted.append(command))
    if checkpoint:
        (tmp_path / "scene.ply.checkpoint").touch()
    run_stage("fit", [str(tmp_path), "--out", str(tmp_path / "scene.ply")])
    assert fitted[0].resume == checkpoint


@pytest.mark.parametrize("there", [False, True])
def test_notices_go_to_the_log_of_the_scene_once(rendered, stage_files, tmp_path, monkeypatch, there):
    logger, other = logging.getLogger("sgwarp"), logging.NullHandler()
    before = logger.level
    monkeypatch.setattr(logger, "handlers", [other] if there else [])
    logger.setLevel(logging.ERROR)
    try:
        for _ in range(2):
            run_stage("render", [str(stage_files.scene), "--out", str(tmp_path / "o")])
        if there:
            assert logger.handlers == [other]
            assert logger.level == logging.ERROR
        else:
            (handler,) = logger.handlers
            assert type(handler) is logging.StreamHandler
            assert logger.level == logging.INFO
    finally:
        logger.setLevel(before)


def test_options_that_do_not_fit_are_named_in_one_short_line():
    with pytest.raises(InputError) as refused:
        parse("lift", ["s.ply", "--tau", "much", "--out", "s.safetensors"])
    text = str(refused.value)
    assert text.startswith("lift: its options do not fit: ")
    assert "  " not in text
    assert text == text.strip()
    assert "\n" not in text
    assert "│" not in text
    assert 60 < len(text) <= 330
    with pytest.raises(InputError) as refused:
        parse("lift", ["s.ply", *(f"--unknown-{k}" for k in range(60))])
    assert len(str(refused.value)) == len("lift: its options do not fit: ") + 300


@pytest.mark.parametrize(
    ("value", "word"), [("true", "--reliability"), ("True", "--reliability"), ("FALSE", "--no-reliability")]
)
def test_switches_of_a_list_are_true_or_false(stage_files, value, word):
    (stage,), _ = stages_of(Scene("one", stage_files.scene), Plan(("lift",), {"reliability": value}, "cpu"))
    assert stage.arguments[-1] == word
    assert parse("lift", stage.arguments).reliability == (value == "true" or value == "True")


def test_words_of_an_option_are_split_where_it_takes_several(stage_files):
    options = {"segment.templates": "'a photo of {}' plain", "segment.classes": "left door, lamp", "size": "64 48"}
    plan = Plan(("segment", "render"), options, "cpu")
    segment, render = stages_of(Scene("one", stage_files.scene), plan)[0]
    command = parse("segment", segment.arguments)
    assert command.templates == ("a photo of {}", "plain")
    assert command.classes == "left door, lamp"
    assert parse("render", render.arguments).size == (64, 48)


def test_inputs_of_a_scene_are_sorted_and_each_named_once(stage_files, tmp_path):
    paths = [tmp_path / name for name in ("b.txt", "a.txt", "c.txt", "d.txt", "e.txt")]
    for path in paths:
        path.touch()
    names = ("encoder", "semantics", "predicted", "net", "cache")
    stages = {"encoder": "lift", "semantics": "segment", "predicted": "segment", "net": "predict", "cache": "lift"}
    own = {f"{stages[name]}.{name}": str(path) for name, path in zip(names, paths, strict=True) if name != "semantics"}
    own["instances.masks"] = f"files:{paths[0]}"  # again
    plan = Plan(("lift", "predict", "segment", "instances"), {}, "cpu")
    _, inputs = stages_of(Scene("one", stage_files.scene, own), plan)
    expected = {str(stage_files.scene), str(stage_files.scene.parent), *map(str, (paths[0], paths[2], paths[3]))}
    assert inputs == tuple(sorted(expected)), "a cache changes no result"


@pytest.mark.parametrize(("encoder", "own"), [("conse", True), (None, False), ("files:{path}/labels", False)])
def test_warming_runs_what_it_can_on_the_room_of_the_package(monkeypatch, encoder, own):
    from sgwarp.demo.data import ROOM

    asked = {}

    def noted(name, arguments):
        asked[name] = parse(name, arguments)
        asked[name, "folder"] = Path(asked[name].out).parent.is_dir()
        if name == "fit":
            raise InputError("what goes wrong here is recorded in a scene")

    monkeypatch.setattr(scene_stages, "run_stage", noted)
    warm(["fit", "lift", "predict", "segment", "render"], encoder, "cuda:1")
    assert [name for name in asked if isinstance(name, str)] == ["fit", "lift", "segment", "render"]
    for name in ("fit", "lift", "segment", "render"):
        command = asked[name]
        assert command.device == "cuda:1"
        assert asked[name, "folder"]
        assert not Path(command.out).parent.exists(), "nothing is left behind"
        assert command.views == Path(ROOM)
        assert name == "fit" or command.scene.is_file()
    assert asked["lift"].encoder == (encoder if own else f"files:{Path(ROOM) / 'labels'}")
    assert Path(asked["lift"].encoder.removeprefix("files:")).is_dir() != own
    assert asked["segment"].semantics == asked["lift"].out
    assert asked["fit"].init == "random"
    assert asked["fit"].steps < 10, "the kernels are compiled in the first step"
    stems = {path.stem for path in Path(ROOM, "images").iterdir()}
    assert {asked["segment"].view, asked["render"].view} <= stems


def test_only_asked_stages_are_warmed(monkeypatch):
    asked = []
    monkeypatch.setattr(scene_stages, "run_stage", lambda name, arguments: asked.append(name))
    warm(["render"], None, "cpu")
    assert asked == ["render"]


# How large a scene was


def test_a_scene_is_measured_by_its_first_command_that_knows(stage_files):
    lift = [str(stage_files.scene), "--views", str(stage_files.views), "--out", "s.safetensors"]
    expected = {"gaussians": len(stage_files.gaussians), "views": 6}
    assert measure({"lift": lift}) == expected
    assert measure({"lift": lift, "render": ["--no-such-option"]}) == expected, "what comes later is not looked at"
    evaluated = ["room", "--data", "rooms", "--out", "o", "--gaussians", str(stage_files.scene)]
    assert measure({"evaluate": evaluated}) == {"gaussians": expected["gaussians"]}
    assert measure({"evaluate": evaluated, "lift": lift}) == expected


def test_a_fitted_scene_is_measured_by_what_it_wrote(stage_files, tmp_path):
    out, words = tmp_path / "new.ply", lambda views: [str(views), "--out", str(tmp_path / "new.ply")]
    shutil.copy(stage_files.scene, out)
    assert measure({"fit": words(stage_files.views)}) == {"gaussians": len(stage_files.gaussians), "views": 6}
    photographs = stage_files.views / "images"
    assert measure({"fit": words(photographs)}) == {"gaussians": len(stage_files.gaussians)}
    shutil.copytree(stage_files.views, tmp_path / "new.ply.sfm")  # the poses that were found for them
    assert measure({"fit": words(photographs)}) == {"gaussians": len(stage_files.gaussians), "views": 6}


def test_views_are_counted_without_their_photographs(stage_files, tmp_path):
    shutil.copy(stage_files.views / "transforms.json", tmp_path)
    lift = [str(tmp_path / "none.ply"), "--views", str(tmp_path), "--out", "s.safetensors"]
    assert measure({"lift": lift}) == {"views": 6}, "what cannot be read is not counted"


def test_a_header_says_how_many_gaussians_there_are(stage_files, tmp_path):
    path = tmp_path / "s.ply"
    header = b"ply\nformat binary_little_endian 1.0\ncomment vertex 3\nelement chunk 2\nelement vertex 123456789\n"
    path.write_bytes(header + b"property float x\nend_header\n")
    assert count_gaussians(path) == 123456789, "nothing but the header is read"
    for line in (b"element vertex", b"element vertex many", b"element vertex 5 6", b"element face 7"):
        path.write_bytes(b"ply\nformat binary_little_endian 1.0\n" + line + b"\nend_header\n")
        with pytest.raises(InputError):
            count_gaussians(path)
    save_gaussians(stage_files.gaussians, tmp_path / "s.splat")
    assert count_gaussians(tmp_path / "s.splat") == len(stage_files.gaussians)
    with pytest.raises(InputError):
        count_gaussians(tmp_path)
