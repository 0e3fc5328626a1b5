"""No command writes over what it reads: photographs, masks, label images, lifted semantics, data sets."""

import dataclasses
import inspect
import os
import re
import shutil
import typing
from pathlib import Path

import pytest
import torch

from sgwarp.cli import main
from sgwarp.commands import COMMANDS
from sgwarp.commands.inputs_kept import WRITTEN
from sgwarp.datasets.moving import make_moving_scene
from sgwarp.datasets.moving_files import save_moving_scene
from sgwarp.errors import InputError
from sgwarp.files.access import read_bytes
from sgwarp.files.atomic import atomic_path
from sgwarp.files.inputs import announce_outputs, inputs_kept, own_files, require_apart, require_no_inputs_in
from sgwarp.files.tensors import write_tensors
from sgwarp.io.store import save_semantics
from sgwarp.io.views import load_views
from sgwarp.lifting.lifter import lift
from sgwarp.runs.log import RunLog


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
        ("render scene.ply --views views --out views/images", "is read by this command"),
        ("render scene.ply --views views --out link", "is read by this command"),
        ("render scene.ply --views views --view 0002 --out views/images/0001.png", "is read by this command"),
        (f"{SEGMENT} --out views/images", "is read by this command"),
        (f"{SEGMENT} --out labels", "holds the images of files:labels"),
        (f"{QUERY} --out views/images/0001.png", "is read by this command"),
        (f"{QUERY} --out views/images/0002.png", "is read by this command"),
        (f"{INSTANCES} --render-out labels", "holds the images of files:labels"),
        (f"{INSTANCES} --render-out labels/../labels", "holds the images of files:labels"),
        (f"{INSTANCES} --render-out views/images", "is read by this command"),
        ("instances scene.ply --views views --masks graph --out s.safetensors", "were lifted from views"),
        (
            "edit scene.ply --views views --view 0002 --out views/images/0001.ply --select all --scale 2",
            "is read by this command",
        ),
        ("predict scene.ply --net n.safetensors --out n.safetensors", "is read by this command"),
        ("lift scene.ply --views views --encoder files:maps --out maps/0002.safetensors", "is read by this command"),
        ("fit views --out 1.ply --steps 1 --points points.ply --init points", "is read by this command"),
        ("track moving/params.npz --views moving --encoder files:moving/labels --out moving/labels", "is read by this"),
        ("batch list/summary.csv --do render --out list", "is read by this command"),
        ("poses photos/mapping --out photos", "would be removed by the results"),
        ("poses photos --out photos", "would be removed by the results"),
    ],
)
def test_inputs_stay(home, capsys, command, message):
    if command.startswith("poses"):
        pytest.importorskip("pycolmap")
    if command.startswith("track"):
        moving = make_moving_scene(0, 2, 300, cameras=2, width=32, height=24, moving_share=0.5)
        save_moving_scene(moving, home / "moving")
    (home / "n.safetensors").write_bytes(b"a network of many hours")
    shutil.copytree(home / "views" / "images", home / "photos" / "mapping")
    (home / "maps").mkdir()
    for view in load_views(home / "views"):
        features = torch.ones(view.camera.height, view.camera.width, 3)
        write_tensors(home / "maps" / f"{view.stem}.safetensors", {"features": features})
    (home / "list").mkdir()
    (home / "list" / "summary.csv").write_text("path\n../else/scene.ply\n")
    (home / "else").mkdir()
    shutil.copy(home / "scene.ply", home / "else")
    (home / "points.ply").symlink_to("run.json")
    (home / "run.json").write_text("points of many hours")
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


SUFFIX = {"fit": ".ply", "edit": ".ply", "convert": ".ply", "query": ".png"}
SUFFIX |= dict.fromkeys(("lift", "distill", "predict", "instances"), ".safetensors")


def options(name: str) -> dict[str, tuple[dataclasses.Field, object]]:
    """Fields of a command by name, with their types."""
    hints = typing.get_type_hints(COMMANDS[name])
    return {field.name: (field, hints[field.name]) for field in dataclasses.fields(COMMANDS[name])}


def is_path(kind: object) -> bool:
    return kind is Path or Path in typing.get_args(kind) or list[Path] in (kind, *typing.get_args(kind))


def example(field: dataclasses.Field, kind: object, name: str, home: Path) -> str:
    """A value that the parser takes."""
    if field.name == "out":
        return str(home / f"result{SUFFIX.get(name, '')}")
    if typing.get_origin(kind) is typing.Literal:
        return typing.get_args(kind)[0]
    return str(home / "nothing")


def words(name: str, home: Path, given: dict[str, str]) -> list[str]:
    """A command line with the options that must be there, and those given."""
    before, after = [], []
    for option, (field, kind) in options(name).items():
        needed = field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
        if option in given or needed:
            value = given.get(option, example(field, kind, name, home))
            positional = "Positional" in str(field.type)
            before += [value] if positional else []
            after += [] if positional else [f"--{option.replace('_', '-')}", value]
    return [name, *before, *after]


def outputs(name: str, home: Path, given: dict[str, str]) -> list[Path]:
    """What the command says it will write; the guard asks the same."""
    import tyro

    command = tyro.cli(COMMANDS[name], args=words(name, home, given)[1:])
    return [path for _, paths in command.written() for path in paths] if hasattr(command, "written") else []


MORE = {"edit": {"view": "0001"}, "instances": {"ply": "{home}/i.ply"}, "evaluate": {"ablate": "views"}}
INPUTS = [(n, o) for n in COMMANDS for o, (_, kind) in options(n).items() if is_path(kind) and o not in WRITTEN]


@pytest.mark.parametrize(("name", "option"), INPUTS)
def test_no_option_of_any_command_is_written_over(tmp_path, capsys, name, option):
    """Every output that a command announces, given as every input that it takes, by name and through a link."""
    given = {key: value.format(home=tmp_path) for key, value in MORE.get(name, {}).items()}
    for number, output in enumerate(outputs(name, tmp_path, given)):
        output.parent.mkdir(parents=True, exist_ok=True)
        output.write_bytes(b"the work of many hours")
        link = tmp_path / f"link{number}"
        os.link(output, link)
        for place in (output, link):
            assert main(words(name, tmp_path, {**given, option: str(place)})) == 2, (name, option, output)
            assert "is read by this command; choose another" in capsys.readouterr().err
        assert output.read_bytes() == link.read_bytes() == b"the work of many hours"
        output.unlink()


def test_every_command_says_what_it_writes():
    """Options whose help speaks of writing are those that the guard takes for outputs, and each command with one says
    which files it stands for; so a new command cannot be forgotten."""
    seen = set()
    for name, command in COMMANDS.items():
        classes = [kind for kind in command.__mro__ if dataclasses.is_dataclass(kind)]
        source = "\n".join(inspect.getsource(kind) for kind in classes)
        for option, (_, kind) in options(name).items():
            if is_path(kind):
                about = re.search(rf'^    {option}: .*\n    """([^"]*)"""', source, re.MULTILINE)[1]
                writes = re.search(r"\bto write\b|^Folder for|^Folder of the results", about) is not None
                assert writes == (option in WRITTEN), (name, option, about)
                seen |= {name} if writes else set()
    assert {name for name in COMMANDS if "written" in vars(COMMANDS[name])} == seen
    assert seen == set(COMMANDS) - {"encoders", "info", "view"}


def test_the_guard_compares_files(tmp_path):
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "a").write_text("input")
    (tmp_path / "link").symlink_to("in/a")

    def write(path: Path) -> None:
        with atomic_path(path) as temporary:
            temporary.write_text("output")

    with inputs_kept():
        write(tmp_path / "b")
        read_bytes(tmp_path / "b")
        write(tmp_path / "b")  # its own
        with own_files():
            read_bytes(tmp_path / "in" / "a")
        require_no_inputs_in(tmp_path)
        read_bytes(tmp_path / "in" / "a")
        for path in (tmp_path / "in" / "a", tmp_path / "link"):
            with pytest.raises(InputError, match="is read by this command"):
                write(path)
        with pytest.raises(InputError, match="is read by this command"):
            require_no_inputs_in(tmp_path)
        with pytest.raises(InputError, match=r"--x .*link: is read by this command"):
            announce_outputs("--x", [tmp_path / "link"])
        announce_outputs("--x", [tmp_path / "b", tmp_path / "none"])
    with inputs_kept():
        announce_outputs("--x", [tmp_path / "link"])
        require_apart()
        read_bytes(tmp_path / "in" / "a")
        for refused in (require_apart, lambda: write(tmp_path / "c"), lambda: RunLog().stage("x").__enter__()):
            with pytest.raises(InputError, match=r"--x .*link: is read by this command"):
                refused()
    assert (tmp_path / "in" / "a").read_text() == "input"
    read_bytes(tmp_path / "in" / "a")  # outside a command nothing is watched
    write(tmp_path / "in" / "a")
