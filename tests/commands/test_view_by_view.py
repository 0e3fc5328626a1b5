"""What commands do for view after view: progress, files, figures; and the picture that a query leaves."""

import json
from contextlib import contextmanager
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from sgwarp.cli import main
from sgwarp.commands.convert import Convert
from sgwarp.commands.options import load_on
from sgwarp.files.images import read_ids, read_rgb
from sgwarp.io.store import save_semantics
from sgwarp.io.views import load_views
from sgwarp.lifting.lifter import lift
from sgwarp.scene import Instance
from sgwarp.visualization.pictures import heat_map

STEMS = [f"{k:04d}" for k in range(6)]


def run(*words) -> int:
    return main([str(word) for word in words])


@pytest.fixture
def shown(monkeypatch):
    """Titles and reports of the progress that commands show."""
    calls = []

    @contextmanager
    def show(title):
        yield lambda done, total, name: calls.append((title, done, total, name))

    for name in ("render", "segment", "instances", "lift"):
        monkeypatch.setattr(f"sgwarp.commands.{name}.show_progress", show)
    return calls


@pytest.fixture
def labels(stage, stage_files, tmp_path):
    path = tmp_path / "labels.safetensors"
    save_semantics(lift(stage_files.gaussians, stage.views, stage.one_hot), path)
    return path


@pytest.mark.parametrize("name", ["render", "segment"])
def test_progress_counts_the_views_from_none_to_all(shown, stage_files, labels, tmp_path, name):
    words = [name, stage_files.scene, "--views", stage_files.views, "--out", tmp_path / "o"]
    assert run(*words, *(["--semantics", labels] if name == "segment" else [])) == 0
    assert shown == [(name, k, 6, ["", *STEMS][k]) for k in range(7)]
    outputs = json.loads((tmp_path / "o" / "run.json").read_text())["outputs"]
    assert [path.rpartition("/")[2] for path in outputs if "overlays" not in path] == [f"{stem}.png" for stem in STEMS]


def test_pixels_without_a_class_are_counted(stage_files, labels, tmp_path, monkeypatch):
    """A mean over the views of the share of their pixels."""
    shares = iter([0.0, 0.25, 0.5, 0.75, 1.0, 0.5])

    def segment_votes(gaussians, camera, votes, seen, unknown_below):
        channel = torch.zeros(camera.size, dtype=torch.int64)
        channel[: round(next(shares) * camera.height)] = -1
        return channel, None

    monkeypatch.setattr("sgwarp.querying.segmentation.segment_votes", segment_votes)
    words = ["segment", stage_files.scene, "--views", stage_files.views, "--out", tmp_path / "o", "--semantics", labels]
    assert run(*words) == 0
    assert json.loads((tmp_path / "o" / "run.json").read_text())["error"]["unknown"] == pytest.approx(0.5)


# query


@pytest.fixture
def asked(stage_files, labels, tmp_path, monkeypatch):
    """`asked(map, *options)`: a query whose score map is this one; what it writes."""

    def ask(score_map, *options):
        pixel = (40, 30)
        monkeypatch.setattr("sgwarp.querying.segmentation.localize", lambda *given, **named: (pixel, score_map))
        words = ["query", stage_files.scene, "--views", stage_files.views, "--view", "0002", "--text", "1"]
        assert run(*words, "--semantics", labels, "--out", tmp_path / "q.png", *options) == 0
        return SimpleNamespace(mask=read_ids(tmp_path / "q.png"), heat=read_rgb(tmp_path / "q_heat.png"))

    return ask


def test_the_mask_is_what_scores_more_than_the_threshold(asked, stage, capsys):
    score_map = torch.full((72, 96), -torch.inf)
    score_map[:36, :48], score_map[:36, 48:], score_map[36:, :48] = 0.25, 0.5, 0.75
    found = asked(score_map, "--threshold", 0.5)
    assert set(np.unique(found.mask)) == {0, 255}
    assert np.array_equal(found.mask == 255, (score_map > 0.5).numpy()), "what scores as much does not"
    assert "mask 25.00%" in capsys.readouterr().out
    assert np.array_equal(asked(score_map, "--threshold", 0.2).mask == 255, (score_map > 0.2).numpy())


def test_the_colors_of_a_heat_map_mean_the_same_in_every_query(asked, stage_files):
    """From the median, 0, to the best thousandth, 1, whatever the view shows of it."""
    score_map = torch.linspace(0.1, 0.4, 96).expand(72, 96).contiguous()
    photograph = load_views(stage_files.views)[2].image()
    expected = heat_map(photograph, score_map, low=0.0, high=1.0).astype(int)
    stretched = heat_map(photograph, score_map).astype(int)
    far = np.ones((72, 96), bool)
    far[15:46, 25:56] = False  # not where the best pixel is marked
    found = asked(score_map).heat.astype(int)
    assert np.abs(found - expected)[far].max() <= 1
    assert np.abs(found - stretched)[far].max() > 20


@pytest.mark.parametrize("name", ["q.png", "other.png"])
def test_a_photograph_is_kept_before_the_work(stage_files, labels, tmp_path, monkeypatch, capsys, name):
    """Whether the mask or its heat map would take its place, and whichever view it belongs to."""
    views = tmp_path / "views"
    (views / "images").mkdir(parents=True)
    data = json.loads((stage_files.views / "transforms.json").read_text())
    data["frames"][4]["file_path"] = "images/q.png"
    data["frames"][5]["file_path"] = "images/other_heat.png"
    (views / "transforms.json").write_text(json.dumps(data))
    for frame, stem in zip(data["frames"], STEMS, strict=True):
        (views / frame["file_path"]).write_bytes((stage_files.views / "images" / f"{stem}.png").read_bytes())
    monkeypatch.setattr("sgwarp.querying.segmentation.localize", None)
    words = ["query", stage_files.scene, "--views", views, "--view", "0001", "--text", "1", "--semantics", labels]
    assert run(*words, "--out", views / "images" / name) == 2
    assert "is read by this command" in capsys.readouterr().err


# convert


def test_a_name_that_no_format_has_is_refused_before_the_scene_is_read(tmp_path, capsys):
    assert run("convert", tmp_path / "missing.ply", tmp_path / "out.obj") == 2
    assert "out.obj: scenes are written as" in capsys.readouterr().err
    assert run("convert", tmp_path / "missing.ply", tmp_path / "out.ply") == 2
    assert "missing.ply: no such file" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("suffix", "options", "expected"),
    [
        (".spz", {}, ("spz", 4, "rub")),
        (".spz", {"spz_version": 3, "out_axes": "rdf"}, ("spz", 3, "rdf")),
        (".ply", {"out_axes": "rub"}, ("other", "rub")),
        (".ply", {}, ("other", None)),
    ],
)
def test_the_version_and_the_axes_reach_the_writer(stage_files, tmp_path, monkeypatch, suffix, options, expected):
    from sgwarp.io.formats.axes import parse_axes

    calls = []
    monkeypatch.setattr(
        "sgwarp.io.formats.spz.write_spz", lambda scene, path, version, axes: calls.append(("spz", version, axes))
    )
    monkeypatch.setattr("sgwarp.io.scenes.save_gaussians", lambda scene, path, axes: calls.append(("other", axes)))
    Convert(scene=stage_files.scene, out=tmp_path / f"o{suffix}", **options)._write(stage_files.gaussians)
    (call,) = calls
    if call[0] == "spz":
        assert call[:2] == expected[:2]
        assert np.array_equal(call[2], parse_axes(expected[2]))
    else:
        assert call == expected


# Semantics on the device of their scene


@dataclass
class Parts:
    """Semantics of tensors that hold nothing, as there is no second device here."""

    features: torch.Tensor
    weight: torch.Tensor
    effective_views: torch.Tensor
    space: str = "toy"


def test_semantics_come_onto_the_device_of_the_scene(monkeypatch):
    scene = SimpleNamespace(device=torch.device("meta"))
    parts = Parts(torch.ones(3, 2), torch.ones(3), torch.ones(3))
    asked = []
    monkeypatch.setattr("sgwarp.io.store.load_semantics", lambda *given: asked.append(given) or parts)
    found = load_on("s.safetensors", scene)
    assert asked == [("s.safetensors", scene)]
    assert {part.device.type for part in (found.features, found.weight, found.effective_views)} == {"meta"}
    assert (found.features.shape, found.space) == ((3, 2), "toy")


# instances


@pytest.fixture
def instances(stage_files, tmp_path, monkeypatch):
    """`instances(*options)`: the command with an instance that was not looked for; cameras that maps are drawn for."""
    box = {"centroid": (0.0, 0.0, 0.0), "rotation": (1.0, 0.0, 0.0, 0.0), "extent": (1.0, 1.0, 1.0)}
    found = SimpleNamespace(table=(Instance(1, "default", 0, 5, 2, 3, 0.9, **box, label="", label_score=0.0),))
    drawn = []

    def render_ids(gaussians, found, camera):
        drawn.append(camera)
        return torch.ones(camera.size), None

    monkeypatch.setattr("sgwarp.apps.instances.finder.find", lambda *given, **named: (found, "evidence"))
    monkeypatch.setattr("sgwarp.encoders.registry.make_mask_source", lambda *given: "source")
    monkeypatch.setattr("sgwarp.io.instances.save_instances", lambda found, path, notes: path.write_text(str(notes)))
    monkeypatch.setattr("sgwarp.io.instances.save_table", lambda found, path: path.touch())
    monkeypatch.setattr("sgwarp.apps.instances.maps.render_ids", render_ids)
    monkeypatch.setattr("sgwarp.apps.instances.maps.draw_ids", lambda photograph, ids, found: photograph)

    def do(*options):
        drawn.clear()
        words = ["instances", stage_files.scene, "--views", stage_files.views, "--masks", "graph"]
        assert run(*words, "--out", tmp_path / "i.safetensors", "--render-out", tmp_path / "maps", *options) == 0
        return list(drawn)

    return do


def test_id_maps_are_drawn_for_the_views_or_for_others_in_the_world_of_the_scene(
    instances, shown, stage, stage_files, tmp_path
):
    few = tmp_path / "few"
    few.mkdir()
    data = json.loads((stage_files.views / "transforms.json").read_text())
    data["frames"] = [{**data["frames"][k], "file_path": f"images/other{k}.png"} for k in (1, 4)]
    (few / "transforms.json").write_text(json.dumps(data))
    (few / "images").mkdir()
    for k in (1, 4):
        (few / "images" / f"other{k}.png").symlink_to(stage_files.views / "images" / f"{k:04d}.png")
    move = tmp_path / "move.json"
    move.write_text(json.dumps({"transform": [[1, 0, 0, 0.5], [0, 1, 0, 0], [0, 0, 1, 0]], "scale": 1.0}))
    for moved in (0.0, 0.5):
        options = ["--transform", move] if moved else []
        for more, places, stems in (([], range(6), STEMS), (["--render-views", few], (1, 4), ["other1", "other4"])):
            shown.clear()
            cameras = instances(*options, *more)
            for camera, k in zip(cameras, places, strict=True):
                expected = stage.views[k].camera.position + torch.tensor([moved, 0, 0], dtype=torch.float64)
                torch.testing.assert_close(camera.position, expected, rtol=0, atol=1e-4)
            count = len(stems)
            assert [call for call in shown if call[0] == "render"] == [
                ("render", k, count, ["", *stems][k]) for k in range(count + 1)
            ]
            outputs = json.loads((tmp_path / "run.json").read_text())["outputs"]
            pictures = [path for path in outputs if path.endswith(".png")]
            folder = tmp_path / "maps"
            names = [(folder / f"{stem}.png", folder / "pictures" / f"{stem}.png") for stem in stems]
            assert pictures == [str(path) for pair in names for path in pair]


def test_an_instance_file_is_weighed(instances, stage_files, tmp_path):
    instances("--least-gaussians", 3)
    log = json.loads((tmp_path / "run.json").read_text())
    size = (tmp_path / "i.safetensors").stat().st_size
    assert log["error"] == pytest.approx({"instances": 1, "bytes_per_gaussian": size / len(stage_files.gaussians)})
    assert (tmp_path / "i.safetensors").read_text() == str({"masks": "graph", "views": 6, "group": "association"})
    files = ["i.safetensors", "i.table.json"]
    assert log["outputs"][:2] == [str(tmp_path / name) for name in files]


def test_settings_of_instances_are_those_of_the_options(tmp_path):
    from sgwarp.commands.instances import Instances

    plain = Instances(scene=tmp_path, views=tmp_path, masks="graph", out=tmp_path / "i.safetensors")
    given = {"least_iou": 0.4, "least_cosine": 0.7, "least_confidence": 0.6, "least_gaussians": 3, "neighbors": 5}
    changed = replace(plain, group="name", levels="s, l", **given)._settings()
    assert (changed.grouping, changed.levels) == ("name", ("s", "l"))
    for name, value in given.items():
        assert getattr(changed, name) == value
        assert getattr(plain._settings(), name) != value
