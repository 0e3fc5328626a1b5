"""What an evaluation keeps of each scene, what it removes, and what it refuses, on a data set of empty scenes."""

from dataclasses import fields, replace
from pathlib import Path

import pytest

from sgwarp.datasets.base import SceneData
from sgwarp.errors import InputError
from sgwarp.evaluation.ablation import Ablation, Trial, Variant, _key, as_rows
from sgwarp.evaluation.evaluator import Evaluation, _identity, choose_scenes, evaluate
from sgwarp.evaluation.networks import NetworkSettings
from sgwarp.evaluation.profiles import room
from sgwarp.evaluation.results import FILE, SceneResult
from sgwarp.evaluation.settings import Settings
from sgwarp.runs.log import RunLog


class Case:
    """Of as many Gaussians, views and bytes as it says."""

    gaussians, lifted, scored, bytes_per_gaussian = range(7), range(5), range(3), 12.5


@pytest.fixture
def data(tmp_path, monkeypatch):
    """A data set of three scenes; `data.scene` and `data.score` may be replaced."""

    class Data:
        NAME, ABOUT = "folder", "numbers"
        root = tmp_path / "data"

        @staticmethod
        def list_scenes(root):
            return ["a", "b", "c/d"]

        @staticmethod
        def scene(name):
            return SceneData(name, Data.root / name, 1)

        @staticmethod
        def open_scene(root, name):
            return Data.scene(name)

        @staticmethod
        def score(case, result, sheets):
            result.figures["miou"] = 0.5
            result.values["located"] = [1.0]

    def make(scene, settings, split, log):
        log.stages |= {"lift": 2.0, "read": 0.25}
        log.leave_out("views", 4)
        return Case()

    monkeypatch.setattr("sgwarp.evaluation.evaluator.find_reader", lambda name: Data)
    Data.profile = replace(room.ROOM, make=make, score=lambda *given: Data.score(*given), total=room.total_of_values)
    Data.root.mkdir()
    return Data


def test_what_is_kept_of_a_scene(data, tmp_path):
    def score(case, result, sheets):
        assert sheets == tmp_path / "out" / "scenes" / result.scene.replace("/", "__")
        (sheets / "one.png").touch()
        result.sheets.append("one.png")
        result.values["located"] = [1.0]

    data.score = score
    log = RunLog()
    found = evaluate(data.profile, data.root, tmp_path / "out", Settings(), log=log)
    assert [result.scene for result in found.results] == ["a", "b", "c/d"]
    for result in found.results:
        assert result.seconds == {"lift": 2.0, "read": 0.25}
        assert (result.gaussians, result.bytes_per_gaussian) == (7, 12.5)
        assert result.views == {"lifted": 5, "scored": 3}
        assert result.left_out == {"views": 4}
        assert result.sheets == [f"scenes/{result.scene.replace('/', '__')}/one.png"]
        assert result.peak_memory > 1e6
    assert found.seconds == {"lift": 6.0, "read": 0.75}
    assert {name: log.stages[name] for name in ("lift", "read")} == {"lift": 6.0, "read": 0.75}
    again = evaluate(data.profile, data.root, tmp_path / "out", Settings(), log=log)
    assert again.results == found.results
    assert log.left_out["scenes_done_before"] == 3
    lifted = evaluate(data.profile, data.root, tmp_path / "out", Settings(semantics="x"), log=log)
    assert [result.views["lifted"] for result in lifted.results] == [0, 0, 0]


def test_a_report_of_each_scene(data, tmp_path):
    seen = []
    evaluate(data.profile, data.root, tmp_path / "o", Settings(), progress=lambda *given: seen.append(given))
    assert seen == [(0, 3, ""), (1, 3, "a"), (2, 3, "b"), (3, 3, "c/d")]


@pytest.mark.parametrize("beside", [None, "out/notes.txt", "out/scenes/other/result.json"])
def test_nothing_is_left_of_a_run_in_which_all_failed(data, tmp_path, beside):
    def fail(case, result, sheets):
        (sheets / "half.png").touch()
        raise InputError(f"{result.scene} is odd")

    data.score = fail
    if beside:
        (tmp_path / beside).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / beside).touch()
    with pytest.raises(InputError, match="a is odd"):
        evaluate(data.profile, data.root, tmp_path / "out", Settings())
    assert [path for path in (tmp_path / "out").rglob("*") if path.is_file()] == ([tmp_path / beside] if beside else [])
    assert (tmp_path / "out").exists() == bool(beside)
    assert (tmp_path / "out" / "scenes").exists() == (beside is not None and "scenes" in beside)


def test_scenes_that_fail_stop_no_other(data, tmp_path):
    def score(case, result, sheets):
        if result.scene == "b":
            raise InputError("b is odd")
        result.values["located"] = [1.0]

    data.score = score
    found = evaluate(data.profile, data.root, tmp_path / "out", Settings())
    assert [result.scene for result in found.results] == ["a", "c/d"]
    assert found.failed == {"b": "b is odd"}
    assert sorted(path.parent.name for path in (tmp_path / "out").rglob(FILE)) == ["a", "c__d"]


@pytest.mark.parametrize("where", ["folder", "gaussians", "both"])
def test_data_is_not_removed_for_a_record(data, tmp_path, where):
    record = tmp_path / "out" / "scenes" / "a"
    record.mkdir(parents=True)
    (record / "photograph.png").write_text("mine")
    (record / "scene.ply").write_text("mine")
    place = {"folder": record if where != "gaussians" else data.root}
    place["gaussians"] = record / "scene.ply" if where != "folder" else None
    data.scene = staticmethod(lambda name: SceneData(name, place["folder"], 1, gaussians=place["gaussians"]))
    with pytest.raises(InputError, match="where the record of this scene goes; choose another --out"):
        evaluate(data.profile, data.root, tmp_path / "out", Settings(), scenes=["a"])
    assert {path.read_text() for path in record.iterdir()} == {"mine"}
    assert len(list(record.iterdir())) == 2


def test_scenes_that_are_chosen(data):
    def chosen(scenes, wanted):
        return choose_scenes(replace(data.profile, scenes=scenes), data, data.root, wanted)

    assert chosen((), None) == (["a", "b", "c/d"], [])
    assert chosen(("b", "x", "a"), None) == (["b", "a"], ["x"])
    assert chosen(("b", "x"), ["a"]) == (["a"], [])
    for scenes, wanted, message in (
        ((), ["a", "y"], "has no scene 'y'; there are: a, b, c/d"),
        ((), ["a", "b", "a"], "'a' stands there twice"),
        (("x", "y"), None, r"has none of the 2 scenes of profile 'room' \(x, ..\)"),
    ):
        with pytest.raises(InputError, match=message):
            chosen(scenes, wanted)
    data.list_scenes = staticmethod(lambda root: [])
    with pytest.raises(InputError, match="holds no scene of data set 'folder'; expected numbers"):
        chosen((), None)


CHOICES = {
    "profile": lambda given: replace(given[0], profile=replace(given[0].profile, name="other")),
    "settings": lambda given: replace(given[0], settings=replace(given[0].settings, method="center")),
}
NETWORK = {"epochs": 31, "arch": "18A", "voxel": 0.06, "train": Path("other")}


def test_networks_of_other_choices_get_a_folder_of_their_own(data):
    assert set(NETWORK) == {field.name for field in fields(NetworkSettings)}
    base = (Evaluation(data.profile, Settings()), NetworkSettings())
    keys = [_key(*base), *(_key(change(base), base[1]) for change in CHOICES.values())]
    keys += [_key(base[0], replace(base[1], **{name: value})) for name, value in NETWORK.items()]
    assert len(set(keys)) == 1 + len(CHOICES) + len(NETWORK)
    elsewhere = replace(base[0], settings=replace(base[0].settings, device="cuda", cache="elsewhere"))
    assert _key(elsewhere, base[1]) == keys[0]


def test_a_record_belongs_to_its_files(data, tmp_path):
    """Size and time of each file that a scene is read from, its classes, profile and choices."""
    for name in ("scene.ply", "s.safetensors", "p.safetensors"):
        (tmp_path / name).write_text("one")
    settings = Settings(semantics=str(tmp_path / "s.safetensors"), predicted=str(tmp_path / "p.safetensors"))
    scene = SceneData("a", data.root, 1, classes=("lamp",), gaussians=tmp_path / "scene.ply")
    seen = [_identity(data.profile, scene, settings)]
    for name in ("scene.ply", "s.safetensors", "p.safetensors"):
        (tmp_path / name).write_text("another")
        seen.append(_identity(data.profile, scene, settings))
    seen.append(_identity(data.profile, replace(scene, classes=("couch",)), settings))
    seen.append(_identity(replace(data.profile, name="other"), scene, settings))
    seen.append(_identity(data.profile, scene, replace(settings, threshold=0.6)))
    (tmp_path / "given.ply").write_text("another")
    seen.append(_identity(data.profile, scene, replace(settings, gaussians=str(tmp_path / "given.ply"))))
    assert all(one != other for k, one in enumerate(seen) for other in seen[:k])


def test_rows_of_an_ablation_for_machines(data):
    settings = Settings()
    found = Evaluation(
        data.profile, settings, [SceneResult("a", seconds={"lift": 3.0, "read": 1.0})], figures={"x": 1.0}
    )
    variant = Variant("views", "50 %", "views_0.5", settings)
    trials = [Trial(variant, found, "", 0.5), Trial(replace(variant, value="20 %"), None, "odd")]
    first, second = as_rows(Ablation(data.profile, trials))
    assert first == {
        **{"axis": "views", "value": "50 %", "figures": {"x": 1.0}, "seconds": {"lift": 3.0, "read": 1.0}},
        **{"lifting_or_training": 3.5, "error": None},
    }
    assert (second["axis"], second["value"], second["figures"], second["seconds"]) == ("views", "20 %", None, None)
    assert second["error"] == "odd"
