"""Every option of `sgwarp evaluate` reaches what it names, and nothing else."""

from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from sgwarp.cli import main
from sgwarp.datasets.synthetic import make_room
from sgwarp.datasets.synthetic_files import save_room
from sgwarp.evaluation.networks import NetworkSettings
from sgwarp.evaluation.profiles.catalogue import find_profile
from sgwarp.evaluation.settings import Settings

EVALUATE, ABLATE = "sgwarp.evaluation.evaluator.evaluate", "sgwarp.evaluation.ablation.ablate"
SETTINGS = {  # words on the command line, and what becomes of them
    "encoder": (["files:x"], "files:x"),
    "method": (["center"], "center"),
    "gaussians": (["g/{scene}.ply"], "g/{scene}.ply"),
    "semantics": (["s/{scene}.safetensors"], "s/{scene}.safetensors"),
    "predicted": (["p/{scene}.safetensors"], "p/{scene}.safetensors"),
    "ensemble": (["mean"], "mean"),
    "scoring": (["cosine"], "cosine"),
    "classes": (["couch", "lamp"], ("couch", "lamp")),
    "threshold": (["0.7"], 0.7),
    "views": (["released"], "released"),
    "hold_out": (["5"], 5),
    "every": (["3"], 3),
    "share_of_views": (["0.5"], 0.5),
    "share_of_gaussians": (["0.25"], 0.25),
    "count": (["777"], 777),
    "forgetting": (["0.4"], 0.4),
    "sheets": (["0"], 0),
    "seed": (["9"], 9),
    "device": (["cpu"], "cpu"),
    "cache": (["none"], None),
}


@pytest.fixture
def words(tmp_path):
    return ["evaluate", "room", "--data", tmp_path / "rooms", "--out", tmp_path / "out"]


def test_every_setting_is_tried():
    assert set(SETTINGS) | {"levels"} == {field.name for field in fields(Settings)}


@pytest.mark.parametrize("name", SETTINGS)
def test_a_setting(stopped, words, name, monkeypatch, tmp_path):
    monkeypatch.setenv("SGWARP_CACHE", str(tmp_path / "maps"))
    given, value = SETTINGS[name]
    plain, changed = (
        stopped(EVALUATE, *words, *more).positional[3] for more in ([], [f"--{name.replace('_', '-')}", *given])
    )
    assert plain == replace(Settings(**find_profile("room").defaults), cache=str(tmp_path / "maps"))
    assert changed == replace(plain, **{name: value})
    assert changed != plain or name == "device"


def test_levels_and_scenes(stopped, words, tmp_path):
    call = stopped(EVALUATE, *words, "--encoder", "files:{level}", "--levels", "s", "m", "--scenes", "a", "b")
    assert (call.positional[3].levels, call.scenes) == (("s", "m"), ("a", "b"))
    assert call.positional[:3] == (find_profile("room"), tmp_path / "rooms", tmp_path / "out")
    assert stopped(EVALUATE, *words).scenes is None


@pytest.mark.parametrize(
    ("more", "axes", "network"),
    [
        (["--ablate", "views"], ("views",), NetworkSettings(epochs=30, train=None)),
        (["--ablate", "inputs,modes", "--epochs", "7"], ("inputs", "modes"), NetworkSettings(epochs=7)),
        (["--ablate", "inputs", "--train", "others"], ("inputs",), NetworkSettings(epochs=30, train=Path("others"))),
    ],
)
def test_ablations(stopped, words, monkeypatch, tmp_path, more, axes, network):
    found = SimpleNamespace()
    monkeypatch.setattr(EVALUATE, lambda *rest, **options: found)
    call = stopped(ABLATE, *words, *more)
    assert call.positional == (found, tmp_path / "rooms", tmp_path / "out", axes, network)


@pytest.mark.parametrize(("failed", "code"), [({}, 0), ({"attic": "holds no photograph"}, 1)])
def test_the_exit_code_says_whether_a_scene_failed(words, monkeypatch, capsys, failed, code):
    found = SimpleNamespace(figures={"miou": 0.5}, failed=failed)
    monkeypatch.setattr(EVALUATE, lambda *rest, **options: found)
    monkeypatch.setattr("sgwarp.evaluation.report_files.write_tables", lambda *rest: [])
    monkeypatch.setattr(
        "sgwarp.evaluation.report_files.headline", lambda found: SimpleNamespace(markdown=lambda: "## Results")
    )
    assert main([str(word) for word in words]) == code
    said = capsys.readouterr().out
    assert ("attic: holds no photograph" in said) == bool(failed)
    assert "## Results" in said


def test_an_ablation_lifts_anew(words, capsys):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(EVALUATE, lambda *rest, **options: pytest.fail("evaluated before it was refused"))
        assert main([*map(str, words), "--ablate", "modes", "--semantics", "s"]) == 2
    assert "--ablate: lifts anew each time; leave --semantics out" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--threshold", "nan"], "--threshold: expected a finite number"),
        (["--threshold", "inf"], "--threshold: expected a finite number"),
        (["--forgetting", "5"], "--forgetting: expected 0 to 1"),
        (["--forgetting", "nan"], "--forgetting: expected 0 to 1"),
        (["--epochs", "0", "--ablate", "inputs"], "--epochs: expected 1 or more"),
        (["--train", "others"], "--train others: goes with --ablate inputs"),
        (["--train", "others", "--ablate", "views"], "--train others: goes with --ablate inputs"),
    ],
)
def test_values_without_sense_are_refused_before_the_work(words, monkeypatch, capsys, more, message):
    monkeypatch.setattr(EVALUATE, lambda *rest, **options: pytest.fail("evaluated before it was refused"))
    assert main([*map(str, words), *more]) == 2
    assert message in capsys.readouterr().err


def test_a_scene_named_twice_is_refused(tmp_path, capsys):
    """It would count twice in every mean."""
    for name in ("attic", "study"):
        save_room(make_room(seed=0, count=100), tmp_path / "rooms" / name, views=3, width=16, height=12)
    words = ["evaluate", "room", "--data", tmp_path / "rooms", "--out", tmp_path / "out", "--encoder", "truth"]
    assert main([*map(str, words), "--scenes", "study", "attic", "study"]) == 2
    assert "--scenes: 'study' stands there twice" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
