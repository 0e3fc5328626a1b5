"""The lines that `sgwarp info` prints, and which kind of thing it takes a path for."""

import json

import numpy as np
import pytest
import torch

from sgwarp.cli import main
from sgwarp.commands.info import Info, histogram_lines, lines, scene_facts
from sgwarp.datasets.moving import make_moving_scene
from sgwarp.datasets.moving_files import save_moving_scene
from sgwarp.datasets.synthetic import make_room
from sgwarp.datasets.synthetic_files import save_room
from sgwarp.io.scenes import save_gaussians
from sgwarp.scene import Gaussians


def test_facts_are_lines_and_what_is_unknown_is_none():
    facts = {
        "gaussians": 3,
        "median_scale": 0.123456,
        "bounds": [[0.0, -1.23456, 2.0], [1.0, 12345.6, 3.0]],
        "labels": ["a", "b"],
        "other_columns": None,
        "semantics": {"file": "s", "notes": {"mode": "weighted"}, "mean_effective_views": 2.0},
        "scene": "with_name",
    }
    assert lines(facts) == [
        "gaussians: 3",
        "median scale: 0.1235",
        "bounds: (0, -1.235, 2) to (1, 1.235e+04, 3)",
        "labels: a, b",
        "semantics:",
        "  file: s",
        "  notes:",
        "    mode: weighted",
        "  mean effective views: 2",
        "scene: with_name",
    ]
    assert lines({"bounds": None}) == []
    assert lines({"opacity_histogram": [0] * 9 + [7]})[0] == "opacity histogram:"
    assert lines({"opacity_histogram": [0] * 9 + [7]})[-1] == "  0.9-1.0 " + 40 * "#" + " 7"


def test_bars_are_as_long_as_their_share_of_the_longest():
    rows = histogram_lines([0, 1, 10, 20, 0, 0, 0, 0, 0, 5], "  ")
    assert [row[:9] for row in rows] == [f"  {k / 10:.1f}-{(k + 1) / 10:.1f}" for k in range(10)]
    assert [row.count("#") for row in rows] == [0, 2, 20, 40, 0, 0, 0, 0, 0, 10]
    assert {row[9] for row in rows} == {" "}
    assert len({row.rindex(" ") for row in rows}) == 1, "numbers stand below each other"
    assert [int(row.split()[-1]) for row in rows] == [0, 1, 10, 20, 0, 0, 0, 0, 0, 5]
    assert all("#" not in row for row in histogram_lines([0] * 10, ""))


def row(count: int, **changes) -> Gaussians:
    values = {
        "means": torch.zeros(count, 3),
        "quats": torch.tensor([1.0, 0, 0, 0]).expand(count, 4),
        "scales": torch.full((count, 3), 0.5),
        "opacities": torch.linspace(0, 1, count),
        "sh": torch.zeros(count, 4, 3),
    }
    return Gaussians(**{**values, **changes})


def test_a_scene_of_which_nothing_is_finite():
    found = scene_facts(row(2, means=torch.full((2, 3), float("nan"))))
    assert (found["bounds"], found["median_scale"]) == (None, None)
    assert (found["gaussians"], found["non_finite_rows"], found["sh_degree"]) == (2, 2, 1)
    assert found["opacity_histogram"] == [0] * 10


def test_columns_of_other_programs_are_listed():
    found = scene_facts(row(3, extras={"heat": np.ones(3), "age": np.ones(3)}))
    assert found["other_columns"] == ["age", "heat"]
    assert scene_facts(row(3))["other_columns"] is None
    assert sum(scene_facts(row(11))["opacity_histogram"]) == 11, "0 and 1 lie in the first and last bin"


@pytest.fixture
def room(tmp_path):
    save_room(make_room(seed=0, count=300), tmp_path / "rooms" / "study", views=3, width=32, height=24)
    return tmp_path / "rooms"


def shown(capsys, *words) -> dict:
    assert main(["info", *map(str, words), "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_a_folder_is_a_data_set_where_it_is_one(room, capsys):
    assert main(["info", str(room), "--data-set", "scannet"]) == 2
    assert "holds no scene of 'scannet'; expected" in capsys.readouterr().err
    named = shown(capsys, room, "--data-set", "folder")
    assert "study" in json.dumps(named)
    assert shown(capsys, room) == named


def test_a_moving_scene_is_no_data_set_and_has_no_semantics(tmp_path, capsys):
    moving = make_moving_scene(0, 2, 300, cameras=2, width=32, height=24, moving_share=0.5)
    save_moving_scene(moving, tmp_path / "moving")
    folder, file = shown(capsys, tmp_path / "moving"), shown(capsys, tmp_path / "moving" / "params.npz")
    assert folder["scene"] == str(tmp_path / "moving")
    del folder["scene"], file["scene"]
    assert folder == file
    assert folder["frames"] == 2
    assert main(["info", str(tmp_path / "moving"), "--semantics", "s.safetensors"]) == 2
    assert "--semantics: belong to one scene, " in capsys.readouterr().err


def test_a_file_names_its_format(tmp_path, capsys):
    for suffix, name in ((".ply", "ply"), (".splat", "splat")):
        path = tmp_path / f"s{suffix}"
        save_gaussians(row(3, sh=torch.zeros(3, 1, 3), opacities=torch.full((3,), 0.5)), path)
        found = shown(capsys, path)
        assert (found["scene"], found["gaussians"]) == (str(path), 3)
        assert name in found["format"].lower()
        assert "semantics" not in found


def test_lines_unless_json_is_asked_for(capsys):
    info = Info(scene="s")
    info._show({"gaussians": 3, "sh_degree": 0})
    assert capsys.readouterr().out == "gaussians: 3\nsh degree: 0\n"
    info.json = True
    info._show({"gaussians": 3, "sh_degree": 0})
    assert capsys.readouterr().out == '{\n  "gaussians": 3,\n  "sh_degree": 0\n}\n'
