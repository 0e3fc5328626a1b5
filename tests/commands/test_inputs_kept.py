"""No command writes over what it reads: photographs, masks, label images, lifted semantics, data sets."""

import shutil
from pathlib import Path

import pytest

from sgwarp.cli import main
from sgwarp.io.store import save_semantics
from sgwarp.lifting.lifter import lift


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture
def home(stage, stage_files, toy_text, tmp_path, monkeypatch) -> Path:
    """A folder as a user has it: scene.ply, views/images, labels, and semantics lifted from the labels."""
    monkeypatch.setattr("sgwarp.encoders.registry.text_encoder_for", lambda space, *rest: toy_text)
    shutil.copy(stage_files.scene, tmp_path / "scene.ply")
    shutil.copytree(stage_files.views, tmp_path / "views")
    shutil.copytree(stage_files.labels, tmp_path / "labels")
    semantics = lift(stage_files.gaussians, stage.views, stage.dense)
    save_semantics(semantics, tmp_path / "s.safetensors", {"encoder": "files:labels"})
    (tmp_path / "link").symlink_to("views/images")
    monkeypatch.chdir(tmp_path)
    return tmp_path


SEGMENT = "segment scene.ply --semantics s.safetensors --views views --classes wall,lamp"
QUERY = "query scene.ply --semantics s.safetensors --views views --text lamp --view 0001"
INSTANCES = "instances scene.ply --views views --masks files:labels --out i.safetensors"


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("render scene.ply --views views --out views/images", "belongs to the photographs"),
        ("render scene.ply --views views --out link", "belongs to the photographs"),
        ("render scene.ply --views views --view 0002 --out views/images/0001.png", "belongs to the photographs"),
        (f"{SEGMENT} --out views/images", "belongs to the photographs"),
        (f"{SEGMENT} --out labels", "holds the images of files:labels"),
        (f"{QUERY} --out views/images/0001.png", "belongs to the photographs"),
        (f"{QUERY} --out views/images/0002.png", "belongs to the photographs"),
        (f"{INSTANCES} --render-out labels", "holds the images of files:labels"),
        (f"{INSTANCES} --render-out labels/../labels", "holds the images of files:labels"),
        (f"{INSTANCES} --render-out views/images", "belongs to the photographs"),
        ("instances scene.ply --views views --masks graph --out s.safetensors", "were lifted from views"),
        ("edit scene.ply --views views --view 0002 --out views/images/0001.ply --select all --scale 2", "belongs to"),
        ("predict scene.ply --net n.safetensors --out n.safetensors", "is read by this command"),
    ],
)
def test_inputs_stay(home, capsys, command, message):
    (home / "n.safetensors").write_bytes(b"a network of many hours")
    before = contents(home)
    assert main(command.split()) == 2
    assert message in capsys.readouterr().err.strip().splitlines()[-1]
    assert contents(home) == before


@pytest.mark.parametrize(
    "command", [f"{SEGMENT} --out maps", f"{INSTANCES} --render-out maps", f"{QUERY} --out m/0001.png"]
)
def test_results_of_an_earlier_run_are_replaced(home, command):
    for _ in range(2):
        assert main(command.split()) == 0


def test_a_record_does_not_take_the_place_of_the_data(tmp_path, capsys):
    """NVOS keeps its views in scenes/NAME, where an evaluation into the same folder would put its records."""
    from sgwarp.datasets.synthetic import make_room
    from sgwarp.datasets.synthetic_files import save_room

    save_room(make_room(seed=0, count=300), tmp_path / "scenes" / "study", views=4, width=32, height=24)
    before = contents(tmp_path)
    words = ["evaluate", "room", "--data", tmp_path / "scenes", "--out", tmp_path, "--encoder", "truth"]
    assert main([str(word) for word in words]) == 2
    assert "where the record of this scene goes" in capsys.readouterr().err
    assert contents(tmp_path) == before
