"""Where views are read and placed: every command says which photographs are meant and in which world, each time."""

from dataclasses import fields

import pytest

from sgwarp.cli import main
from sgwarp.commands import COMMANDS
from sgwarp.errors import InputError
from sgwarp.io.store import save_semantics
from sgwarp.lifting.lifter import lift

# What a command is given besides its views; how often it reads them with their photographs, and places them.
CASES = {
    "fit": ("{views} --out {out}/f.ply", 1, 0),
    "lift": ("{scene} --views {views} --encoder files:{labels} --out {out}/s.safetensors", 1, 1),
    "query": ("{scene} --views {views} --semantics {semantics} --text 1 --view 0001 --out {out}/q.png", 1, 1),
    "segment": ("{scene} --views {views} --semantics {semantics} --out {out}/o", 1, 1),
    "render": ("{scene} --views {views} --view 0001 --out {out}/o", 2, 1),  # a list without sizes, and to compare
    "edit": ("{scene} --views {views} --select all --scale 2 --out {out}/e.ply", 1, 1),
    "instances": (
        "{scene} --views {views} --masks files:{labels} --out {out}/I.safetensors "
        "--render-views {views} --render-out {out}/ids",
        2,
        2,
    ),
    "report": ("{scene} --views {views} --out {out}/o", 1, 1),
    "view": ("{scene} --views {views}", 1, 1),
    "distill": ("{data} --loss contrastive --out {out}/n.safetensors --arch 14A --epochs 1", 1, 0),
}


def test_every_command_that_takes_such_options_is_tried():
    takes = {name: {field.name for field in fields(command)} for name, command in COMMANDS.items()}
    assert {name for name in takes if "images" in takes[name]} == set(CASES)
    placed = {name for name in takes if "transform" in takes[name]}
    assert placed - {"track"} == {name for name, (_, _, places) in CASES.items() if places}


@pytest.mark.parametrize("name", CASES)
def test_photographs_and_world_reach_every_reading(stage, stage_files, tmp_path, monkeypatch, capsys, name):
    line, reads, places = CASES[name]
    semantics, data, move = tmp_path / "s.safetensors", tmp_path / "data", tmp_path / "move.json"
    save_semantics(lift(stage_files.gaussians, stage.views, stage.one_hot), semantics)
    (data / "a").mkdir(parents=True)
    (data / "a.ply").write_bytes(stage_files.scene.read_bytes())
    (data / "a.safetensors").write_bytes(semantics.read_bytes())
    read, placed = [], []

    def load_views(folder, images=None, photographs=True):
        if not photographs:
            raise InputError("the size of an image is missing")
        read.append(images)
        if not places and len(read) == reads:
            raise InputError("stopped here")
        return stage.views

    def find_placement(gaussians, scene, views, transform):
        placed.append(transform)
        if len(placed) == places:
            raise InputError("stopped here")

    monkeypatch.setattr("sgwarp.io.views.load_views", load_views)
    monkeypatch.setattr("sgwarp.rendering.agreement.find_placement", find_placement)
    monkeypatch.setattr("sgwarp.viewer.server.open_viewer", None)
    monkeypatch.setattr("sgwarp.encoders.registry._kept", None)  # distill keeps encoders for the rest of its process
    names = {"scene": stage_files.scene, "views": stage_files.views, "labels": stage_files.labels}
    words = line.format(**names, semantics=semantics, data=data, out=tmp_path / "out").split()
    moved = ["--transform", str(move)] if places else []
    assert main([name, *words, "--images", "images_4", *moved]) == 2
    assert capsys.readouterr().err.strip().splitlines()[-1] == "sgwarp: stopped here"
    assert read == ["images_4"] * reads
    assert placed == [move] * places
