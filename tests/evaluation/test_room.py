"""Profile `room` end to end: figures against a recount, tables, sheets, resuming, failures."""

import json
import os
import shutil

import numpy as np
import pytest

import sgwarp as sg
from sgwarp.cli import main
from sgwarp.files.images import read_ids, read_rgb
from sgwarp.scene import FeatureMap


def evaluate(data, out, *options):
    return main(["evaluate", "room", "--data", str(data), "--out", str(out), "--encoder", "truth", *options])


def results(out):
    return json.loads((out / "results.json").read_text())


@pytest.fixture(scope="module")
def done(rooms, tmp_path_factory):
    out = tmp_path_factory.mktemp("done")
    assert evaluate(rooms, out, "--sheets", "1") == 0
    return out


def labels_of(folder, stem):
    return read_ids(folder / "labels" / f"{stem}.png").astype(np.int64) - 1


def recount(folder):
    """Predictions and truth of the held-out views, by the functions of the Python API."""
    names = tuple(json.loads((folder / "classes.json").read_text()).values())
    views, scene = sg.load_views(folder), sg.load_gaussians(folder / "scene.ply")
    maps = {v.stem: FeatureMap("labels", ids=labels_of(folder, v.stem), labels=names) for v in views}
    semantics = sg.lift(scene, [v for k, v in enumerate(views) if k % 8], maps)
    return [
        (sg.segment(scene, semantics, names, view.camera)[0].numpy(), labels_of(folder, view.stem))
        for view in views[::8]
    ]


def miou(pairs, classes=10):
    """Mean over the classes of the truth of intersection over union, pixel by pixel."""
    predicted = np.concatenate([p.ravel() for p, _ in pairs])
    truth = np.concatenate([t.ravel() for _, t in pairs])
    predicted, truth = predicted[truth >= 0], truth[truth >= 0]
    present = [k for k in range(classes) if (truth == k).any()]
    ious = [((predicted == k) & (truth == k)).sum() / ((predicted == k) | (truth == k)).sum() for k in present]
    return np.mean(ious)


def test_figures_are_those_of_a_recount(rooms, done):
    found, pairs = results(done), []
    for name in ("one", "two"):
        scene = found["scenes"][name]
        pairs.append(recount(rooms / name))
        assert scene["figures"]["miou"] == pytest.approx(miou(pairs[-1]))
        assert scene["views"] == {"lifted": 7, "scored": 2}
        assert 0.2 < scene["figures"]["accuracy_3d"] <= 1
        assert 0 < scene["figures"]["located"] <= 1
    assert found["figures"]["miou"] == pytest.approx(miou(pairs[0] + pairs[1]))  # one confusion matrix of both rooms
    own = [found["scenes"][name]["figures"]["miou"] for name in ("one", "two")]
    assert found["figures"]["scene_miou"] == pytest.approx(np.mean(own))
    assert found["figures"]["miou"] != pytest.approx(np.mean(own), abs=1e-6)


def test_cost_stands_beside_accuracy(done):
    found = results(done)
    for scene in found["scenes"].values():
        assert scene["seconds"]["lift"] > 0
        assert scene["peak_memory"] > 1e7
        assert scene["bytes_per_gaussian"] == 4 * 10 + 8  # ten classes, weight, effective views
    page = (done / "results.md").read_text()
    head = page.split("## Results")[1].splitlines()[2]
    assert all(name in head for name in ("miou", "lifting [s]", "memory", "B/Gaussian"))
    tex = (done / "results.tex").read_text()
    assert tex.count(r"\begin{tabular}") == tex.count(r"\bottomrule") >= 4
    assert "accuracy_3d" not in tex.replace(r"accuracy\_3d", "")
    assert json.loads((done / "run.json").read_text())["error"]["failed"] == 0


def test_sheets_show_image_truth_ours_and_error(rooms, done):
    sheets = [sheet for scene in results(done)["scenes"].values() for sheet in scene["sheets"]]
    assert len(sheets) == 2
    picture = read_rgb(done / sheets[0])
    photograph = read_rgb(rooms / "one" / "images" / "0000.png")
    assert np.array_equal(picture[22 : 22 + 48, :64], photograph)
    assert picture.shape[1] > 4 * 64


def test_what_is_done_is_not_done_again(rooms, done, tmp_path):
    out = tmp_path / "again"
    shutil.copytree(done, out)
    before = {name: (out / "scenes" / name / "result.json").stat().st_mtime_ns for name in ("one", "two")}
    assert evaluate(rooms, out, "--sheets", "1") == 0
    after = {name: (out / "scenes" / name / "result.json").stat().st_mtime_ns for name in ("one", "two")}
    assert before == after
    assert json.loads((out / "run.json").read_text())["left_out"]["scenes_done_before"] == 2
    assert results(out)["figures"] == results(done)["figures"]
    assert evaluate(rooms, out, "--sheets", "0", "--scenes", "two") == 0  # other choices: made anew
    assert (out / "scenes" / "two" / "result.json").stat().st_mtime_ns != before["two"]


def test_a_scene_that_changed_is_done_again(rooms, done, tmp_path):
    data, out = tmp_path / "data", tmp_path / "out"
    shutil.copytree(rooms / "one", data / "one")
    assert evaluate(data, out, "--sheets", "0") == 0
    os.utime(data / "one" / "scene.ply", (1, 1))
    assert evaluate(data, out, "--sheets", "0") == 0
    assert "scenes_done_before" not in json.loads((out / "run.json").read_text())["left_out"]


def test_a_scene_that_fails_stops_nothing(rooms, tmp_path, capsys):
    data = tmp_path / "data"
    for name in ("one", "two"):
        shutil.copytree(rooms / name, data / name)
    (data / "one" / "scene.ply").write_bytes(b"ply\n")
    assert evaluate(data, tmp_path / "out", "--sheets", "0") == 1
    found = results(tmp_path / "out")
    assert list(found["scenes"]) == ["two"]
    assert "scene.ply" in found["failed"]["one"]
    assert evaluate(data, tmp_path / "other", "--scenes", "one") == 2
    assert "scene.ply" in capsys.readouterr().err
    assert not (tmp_path / "other" / "results.json").exists()


def test_noise_makes_it_worse_and_2d_alone_is_the_noise(rooms, tmp_path):
    """With a third of the regions wrong, single views have about a third of them wrong; lifted, views outvote them."""
    noisy = ["--encoder", "truth?noise=0.3", "--sheets", "0", "--scenes", "one", "--hold-out", "2"]
    accuracy = {}
    for method in ("weighted", "2d"):
        out = tmp_path / method
        assert main(["evaluate", "room", "--data", str(rooms), "--out", str(out), "--method", method, *noisy]) == 0
        accuracy[method] = results(out)["scenes"]["one"]
    assert 0.4 < accuracy["2d"]["figures"]["accuracy"] < 0.95
    assert accuracy["2d"]["bytes_per_gaussian"] == 0
    assert "lift" not in accuracy["2d"]["seconds"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--encoder", "truth?noise=2"], "share from 0 to 1"),
        (["--encoder", "truth?blur=1"], "share from 0 to 1"),
        (["--method", "magic"], "does not exist"),
        (["--share-of-views", "0"], "--share_of_views"),
        (["--scenes", "three"], "no scene 'three'"),
        (["--levels", "a"], "levels"),
        (["--hold-out", "1"], "hold_out"),
    ],
)
def test_what_is_refused(rooms, tmp_path, capsys, options, message):
    assert main(["evaluate", "room", "--data", str(rooms), "--out", str(tmp_path / "out"), *options]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_folder_without_scenes_is_refused(tmp_path, capsys):
    assert evaluate(tmp_path, tmp_path / "out") == 2
    assert "holds no scene of data set 'folder'" in capsys.readouterr().err


def test_what_was_lifted_before_is_asked(rooms, tmp_path):
    """Ids of label images, class k + 1, stand for the classes; nothing is lifted again."""
    folder = rooms / "one"
    maps = shutil.copytree(folder / "labels", tmp_path / "maps")
    for stem in ("0000", "0008"):
        (maps / f"{stem}.png").unlink()
    lifted = tmp_path / "one.safetensors"
    assert (
        main(
            [
                "lift",
                str(folder / "scene.ply"),
                "--views",
                str(folder),
                "--encoder",
                f"files:{maps}",
                "--out",
                str(lifted),
            ]
        )
        == 0
    )
    options = ["--scenes", "one", "--sheets", "0"]
    assert evaluate(rooms, tmp_path / "here", *options) == 0
    assert evaluate(rooms, tmp_path / "before", *options, "--semantics", str(tmp_path / "{scene}.safetensors")) == 0
    here, before = (results(tmp_path / name)["scenes"]["one"] for name in ("here", "before"))
    assert before["figures"]["miou"] == pytest.approx(here["figures"]["miou"], abs=1e-6)
    assert before["figures"]["accuracy_3d"] == pytest.approx(here["figures"]["accuracy_3d"], abs=1e-6)
    assert "lift" not in before["seconds"]
    assert before["views"]["lifted"] == 0
