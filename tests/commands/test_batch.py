"""`sgwarp batch` with the real commands, in worker processes."""

import json
import shutil
import signal
import subprocess
import sys
import time

import cv2
import pytest

from sgwarp.cli import main
from sgwarp.cluster.listing import Scene
from sgwarp.commands.scene_stages import Plan, parse, stages_of
from sgwarp.errors import InputError
from sgwarp.io.scenes import load_gaussians


def run(*arguments) -> int:
    return main(["batch", *map(str, arguments)])


@pytest.fixture(scope="module")
def scans(stage_files, tmp_path_factory):
    """Two scenes, and one without its Gaussians."""
    folder = tmp_path_factory.mktemp("batch") / "scans"
    for name in ("one", "two", "bad"):
        shutil.copytree(stage_files.views, folder / name)
        shutil.copytree(stage_files.labels, folder / name / "labels")
        (folder / name / "scene.ply").write_bytes(stage_files.scene.read_bytes() if name != "bad" else b"no ply")
    return folder


OPTIONS = ("--options", "lift.encoder=files:{path}/labels", "segment.view=0001")


def test_commands_run_on_scenes(scans, tmp_path, capsys, stage_files):
    out = tmp_path / "out"
    arguments = (scans, "--do", "lift,segment", "--out", out, "--threads", 1, *OPTIONS)
    assert run(*arguments) == 1
    said = capsys.readouterr().out
    assert "2 done, 0 skipped, 1 failed scenes" in said
    assert "bad: " in said
    done = json.loads((out / "one" / "done.json").read_text())
    assert done["figures"]["lift"]["coverage"] > 0.5
    assert set(done["seconds"]) == {"lift", "segment"}
    assert (
        str(out / "one" / "labels" / "0001.png")
        in json.loads((out / "one" / "segment.run.json").read_text())["outputs"]
    )
    assert "scene.ply" in json.loads((out / "bad" / "failed.json").read_text())["error"]
    log = json.loads((out / "run.json").read_text())
    assert log["error"] == {"done": 2, "failed": 1}
    assert (out / "summary.csv").read_text().splitlines()[1].startswith("bad,failed")

    # The same as the commands by themselves.
    alone = tmp_path / "alone"
    views = scans / "two"
    lift = ["lift", views / "scene.ply", "--views", views, "--encoder", f"files:{views / 'labels'}"]
    assert main([*map(str, lift), "--out", str(alone / "scene.safetensors")]) == 0
    assert (alone / "scene.safetensors").read_bytes() == (out / "two" / "scene.safetensors").read_bytes()

    assert run(*arguments, "--shard", "1/3") == 0
    assert "0 done, 1 skipped, 0 failed scenes" in capsys.readouterr().out
    assert (out / "shards" / "1-of-3" / "run.json").is_file()


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        (("--do", "lift,dance"), "no 'dance'"),
        (("--do", "lift,lift"), "twice"),
        (("--do", "lift", "--options", "lift.mode=center", "lift.mode=squared"), "'lift.mode' stands there twice"),
        (("--do", "segment,lift"), "in the order"),
        (("--do", ""), "name what to do"),
        (("--do", "lift", "--options", "lift.color=7"), "lift.color"),
        (("--do", "lift", "--options", "steps=7"), "steps"),
        (("--do", "lift", "--options", "lift.tau"), "option=value"),
        (("--do", "lift", "--options", "lift.tau=much"), "tau"),
        (("--do", "lift", "--options", "lift.deterministic=maybe"), "true or false"),
        (("--do", "lift", "--workers", "0"), "--workers"),
        (("--do", "lift", "--time-limit", "0"), "--time-limit"),
        (("--do", "lift", "--shard", "3/3"), "--shard"),
        (("--do", "lift", "--address", "x:1"), "--engine ray"),
    ],
)
def test_bad_options_are_refused_before_anything_is_done(scans, tmp_path, capsys, arguments, match):
    assert run(scans, "--out", tmp_path / "out", *arguments) == 2
    said = capsys.readouterr().err
    assert match in said
    assert len(said.splitlines()) == 1
    assert not (tmp_path / "out").exists()


def test_a_scene_goes_from_stage_to_stage(scans):
    scene = Scene(
        "one", scans / "one", {"fit.steps": "30", "steps": "50", "segment.classes": "a,b", "render.size": "7 5"}
    )
    stages, inputs = stages_of(scene, Plan(("fit", "lift", "predict", "segment"), {"predict.net": "net.x"}, "cpu"))
    fit, lift, predict, segment = (parse(stage.name, stage.arguments) for stage in stages)
    assert (fit.views, fit.steps, str(fit.out)) == (scans / "one", 30, "{out}/scene.ply")
    assert (lift.scene, lift.views, str(lift.out)) == (fit.out, scans / "one", "{out}/scene.safetensors")
    assert (predict.scene, str(predict.net)) == (fit.out, "net.x")
    assert (segment.semantics, segment.predicted, segment.classes) == (lift.out, predict.out, "a,b")
    assert inputs == (str(scans / "one"),)


def test_fit_needs_photographs(scans):
    with pytest.raises(InputError, match="starts from photographs"):
        stages_of(Scene("x", scans / "one" / "scene.ply"), Plan(("fit",), {}, "cpu"))


@pytest.fixture(scope="module")
def labeled(scans, tmp_path_factory):
    """The two sound scenes with names of their classes."""
    folder = tmp_path_factory.mktemp("labeled")
    for name in ("one", "two"):
        shutil.copytree(scans / name, folder / name)
        (folder / name / "classes.json").write_text('["wall", "left door", "lamp", "book"]')
    return folder


def test_a_list_of_scenes_is_evaluated(labeled, tmp_path, capsys):
    options = ("evaluate.encoder=truth", "evaluate.hold-out=2", "evaluate.sheets=0")
    assert run(labeled, "--do", "evaluate", "--out", tmp_path / "out", "--threads", 1, "--options", *options) == 0
    for name in ("one", "two"):
        own = json.loads((tmp_path / "out" / name / "evaluation" / "results.json").read_text())
        assert list(own["scenes"]) == [name]
        assert own["figures"]["miou"] > 0.5
        done = json.loads((tmp_path / "out" / name / "done.json").read_text())
        assert done["figures"]["evaluate"]["miou"] == own["figures"]["miou"]
    capsys.readouterr()
    assert run(labeled, "--do", "evaluate", "--out", tmp_path / "out", "--threads", 1, "--options", *options) == 0
    assert "2 skipped" in capsys.readouterr().out


def test_what_a_batch_lifted_is_what_it_evaluates(labeled, tmp_path):
    options = ("lift.encoder=files:{path}/labels", "evaluate.encoder=truth", "evaluate.scenes=one")
    plan = Plan(("lift", "evaluate"), dict(option.split("=", 1) for option in options), "cpu")
    scene = Scene("one", labeled / "one")
    lift, evaluate = stages_of(scene, plan)[0]
    words = list(evaluate.arguments)
    assert words[:3] == ["room", "--data", str(labeled / "one")]
    assert words[words.index("--semantics") + 1] == lift.arguments[lift.arguments.index("--out") + 1]
    assert words[words.index("--gaussians") + 1] == str(labeled / "one" / "scene.ply")
    parse("evaluate", words)
    named = Plan(("evaluate",), {"evaluate.profile": "lerf-mask", "evaluate.data": str(labeled)}, "cpu")
    words = list(stages_of(scene, named)[0][0].arguments)
    assert words[0] == "lerf-mask"
    assert words.count("--data") == 1
    assert "--semantics" not in words


RUN = "import sys; from sgwarp.cli import main; sys.exit(main())"


def test_an_interrupted_batch_goes_on(labeled, tmp_path, capsys):
    """Ctrl-C, and what batch queues send: the workers end with the driver, and the next run does the rest."""
    words = ["batch", labeled, "--do", "lift", "--out", tmp_path / "out", "--threads", "1", *OPTIONS[:2]]
    records = []
    for number, code, what in ((signal.SIGINT, 130, ".*.partial"), (signal.SIGTERM, 143, "[!.]*/done.json")):
        started = subprocess.Popen([sys.executable, "-c", RUN, *map(str, words)], stderr=subprocess.PIPE)
        end = time.monotonic() + 120
        while not list((tmp_path / "out").glob(what)):
            assert time.monotonic() < end
            time.sleep(0.01)
        started.send_signal(number)
        said = started.communicate()[1].decode()
        records.append(list((tmp_path / "out").glob("[!.]*/done.json")))
        # A signal that comes after the last scene finds nothing to end: the process is gone, or about to go.
        too_late = len(records[-1]) == 2 and started.returncode in (0, -number)
        assert started.returncode == code or too_late
        assert "Traceback" not in said
    assert main([*map(str, words)]) == 0
    assert f"{len(records[-1])} skipped" in capsys.readouterr().out
    assert sorted(path.parent.name for path in (tmp_path / "out").glob("[!.]*/done.json")) == ["one", "two"]
    assert not list((tmp_path / "out").glob(".*.partial"))


def test_a_folder_without_gaussians_fails_alone(scans, tmp_path, capsys):
    """Names have spaces and letters of other languages; one of the scenes lacks its Gaussians."""
    shutil.copytree(scans / "one", tmp_path / "scans" / "büro 東京")
    (tmp_path / "scans" / "empty").mkdir()
    out = tmp_path / "scans" / "results"
    words = (tmp_path / "scans", "--do", "lift", "--out", out, "--threads", 1, *OPTIONS[:2])
    assert run(*words) == 1
    assert "1 done, 0 skipped, 1 failed scenes" in capsys.readouterr().out
    assert "holds 0 scenes" in json.loads((out / "empty" / "failed.json").read_text())["error"]
    views = len(json.loads((scans / "one" / "transforms.json").read_text())["frames"])
    done = json.loads((out / "büro 東京" / "done.json").read_text())
    assert done["size"] == {"gaussians": len(load_gaussians(scans / "one" / "scene.ply")), "views": views}
    head, first, second = (out / "summary.csv").read_text().splitlines()
    assert first.startswith("büro 東京,done")
    assert second.startswith("empty,failed")
    assert "gaussians,views" in head
    assert cv2.imread(str(out / "summary.png")).shape[1] > 1000  # with a panel of who failed why
    # The results lie beside the scenes, and are none themselves.
    assert run(*words) == 1
    assert "0 done, 1 skipped, 1 failed scenes" in capsys.readouterr().out


def test_results_beside_their_inputs_are_refused(scans, tmp_path, capsys):
    shutil.copytree(scans / "one", tmp_path / "scans" / "one")
    before = sorted(path.name for path in (tmp_path / "scans" / "one").iterdir())
    assert run(tmp_path / "scans", "--do", "fit", "--out", tmp_path / "scans", *OPTIONS[:0]) == 2
    assert "which its results would replace" in capsys.readouterr().err
    assert sorted(path.name for path in (tmp_path / "scans" / "one").iterdir()) == before


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="uses /sys, where nobody can make folders")
def test_a_folder_that_cannot_be_written_is_refused(scans, capsys):
    assert run(scans, "--do", "lift", "--out", "/sys/results", *OPTIONS[:2]) == 2
    assert "sys" in capsys.readouterr().err
