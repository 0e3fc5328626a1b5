"""One thing changed at a time: each row is the evaluation with that option, and is not made twice."""

import json
from dataclasses import replace

import pytest

from sgwarp.cli import main
from sgwarp.errors import InputError
from sgwarp.evaluation import ablation
from sgwarp.evaluation.ablation import Trial
from sgwarp.evaluation.evaluator import Evaluation
from sgwarp.evaluation.methods import Method, find_method
from sgwarp.evaluation.networks import NetworkSettings
from sgwarp.evaluation.profiles.room import ROOM
from sgwarp.evaluation.settings import Settings
from sgwarp.runs.log import RunLog

OPTIONS = ("--encoder", "truth?noise=0.2", "--scenes", "one", "--sheets", "0")


class Lost:
    """A method that cannot lift."""

    kind = "rival"

    def lifting(self):
        raise InputError("lost on purpose")


@pytest.fixture(autouse=True)
def few(monkeypatch):
    """Fewer variants than there are; one of them cannot be made."""
    listed = (find_method("weighted"), find_method("squared"), Method("lost", "always refused"))
    monkeypatch.setattr(ablation, "SHARES", (1.0, 0.3))
    monkeypatch.setattr(ablation, "list_methods", lambda: listed)
    find = "sgwarp.evaluation.cases.find_method"
    monkeypatch.setattr(find, lambda name: Lost() if name == "lost" else find_method(name))


def evaluate(rooms, out, *options):
    return main(["evaluate", "room", "--data", str(rooms), "--out", str(out), *OPTIONS, *options])


def rows(out):
    return {(row["axis"], row["value"]): row for row in json.loads((out / "ablation.json").read_text())}


@pytest.mark.slow
def test_rows_are_the_evaluations_with_one_option_changed(rooms, tmp_path):
    out = tmp_path / "out"
    assert evaluate(rooms, out, "--ablate", "views,gaussians,modes") == 0
    found, base = rows(out), json.loads((out / "results.json").read_text())["figures"]
    assert list(found) == [
        ("views", "100 %"),
        ("views", "30 %"),
        ("gaussians", "100 %"),
        ("gaussians", "30 %"),
        ("modes", "weighted"),
        ("modes", "squared"),
        ("modes", "lost"),
    ]
    for axis, value in (("views", "100 %"), ("gaussians", "100 %"), ("modes", "weighted")):
        assert found[axis, value]["figures"] == base
    for (axis, value), options in {
        ("views", "30 %"): ("--share-of-views", "0.3"),
        ("gaussians", "30 %"): ("--share-of-gaussians", "0.3"),
        ("modes", "squared"): ("--method", "squared"),
    }.items():
        alone = tmp_path / axis
        assert evaluate(rooms, alone, *options) == 0
        figures = json.loads((alone / "results.json").read_text())["figures"]
        assert found[axis, value]["figures"] == figures
        assert figures["miou"] != base["miou"]
    assert found["modes", "lost"]["error"] == "lost on purpose"
    assert "modes: lost | –" in (out / "results.md").read_text()
    records = {path: path.stat().st_mtime_ns for path in out.glob("ablations/*/scenes/*/result.json")}
    assert len(records) == 3
    assert evaluate(rooms, out, "--ablate", "views,gaussians,modes") == 0
    assert {path: path.stat().st_mtime_ns for path in records} == records


@pytest.mark.slow
def test_inputs_train_a_network_each(rooms, tmp_path):
    out = tmp_path / "out"
    assert evaluate(rooms, out, "--ablate", "inputs", "--epochs", "1") == 0
    found = rows(out)
    assert [value for _, value in found] == [
        "2D alone, no network",
        "3D, inputs full",
        "2D+3D, inputs full",
        "3D, inputs xyz-rgb",
        "2D+3D, inputs xyz-rgb",
    ]
    accuracy = [row["figures"]["accuracy_3d"] for row in found.values()]
    assert len(set(accuracy)) > 3  # networks of different inputs say different things
    assert (
        found["inputs", "3D, inputs full"]["lifting_or_training"]
        > found["inputs", "2D alone, no network"]["lifting_or_training"]
    )
    networks = {path: path.stat().st_mtime_ns for path in out.glob("ablations/network_*/*/network.safetensors")}
    assert len(networks) == 2
    assert evaluate(rooms, out, "--ablate", "inputs", "--epochs", "1") == 0
    assert {path: path.stat().st_mtime_ns for path in networks} == networks


def test_a_base_off_the_axis_is_evaluated_as_well():
    listed = list(ablation.variants(Settings(share_of_views=0.5), ("views",)))
    assert [(one.value, bool(one.folder)) for one in listed] == [("100 %", True), ("30 %", True)]


@pytest.mark.parametrize("axis", ["views", "gaussians"])
def test_an_axis_changes_its_own_share_alone(axis):
    base = Settings(sheets=0)
    listed = list(ablation.variants(base, (axis,)))
    assert [one.settings for one in listed] == [base, replace(base, **{f"share_of_{axis}": 0.3})]
    assert [one.folder for one in listed] == ["", f"{axis}_0.3"]


def test_variants_that_failed_are_counted(monkeypatch, tmp_path):
    monkeypatch.setattr(ablation, "_try", lambda variant, *rest: Trial(variant, None, variant.folder and "lost"))
    log, told = RunLog(), []
    found = Evaluation(ROOM, Settings())
    network = NetworkSettings()
    result = ablation.ablate(
        found, tmp_path, tmp_path, ("views",), network, log=log, progress=lambda *one: told.append(one)
    )
    assert [trial.error for trial in result.trials] == ["", "lost"]
    assert log.left_out["variants_that_failed"] == 1
    assert told == [(0, 2, ""), (1, 2, "views 100 %"), (2, 2, "views 30 %")]


def test_axes():
    assert ablation.parse_axes("views, modes,views") == ("views", "modes")
    for text in ("", "views,colors"):
        with pytest.raises(InputError, match="inputs, gaussians, views, modes"):
            ablation.parse_axes(text)
