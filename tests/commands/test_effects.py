"""An option without effect is not taken silently: one line says what it goes with."""

import dataclasses
import typing
from pathlib import Path

import pytest
import torch
import tyro

from sgwarp.cli import main
from sgwarp.commands import COMMANDS
from sgwarp.commands.effects import ALWAYS, NEEDS, say_without_effect
from sgwarp.io.store import save_semantics
from sgwarp.lifting.lifter import lift
from sgwarp.lifting.settings import LiftMode, LiftSettings

OPTIONS = {name: {field.name for field in dataclasses.fields(command)} for name, command in COMMANDS.items()}
BASE = {
    "lift": "s.ply --views v --out o.safetensors",
    "query": "s.ply --semantics s --views v --text t --view 1 --out o.png",
    "segment": "s.ply --semantics s --views v --out o",
    "distill": "d --out o.safetensors",
    "predict": "s.ply --net n --out o.safetensors",
    "instances": "s.ply --views v --masks graph --out o.safetensors",
    "edit": "s.ply --out o.ply",
    "render": "s.ply --out o",
    "track": "frames --views v --out o",
    "evaluate": "room --data d --out o",
    "fit": "v --out o.ply",
    "poses": "photos --out o",
    "info": "s.ply",
    "convert": "s.ply o.ply",
    "view": "s.ply",
}
# What makes an option count, and what makes it not count where it does by itself. A value for each that needs one.
MET = {
    "lift": {
        **dict.fromkeys(("tau", "border"), "--mode center"),
        **{"passes": "--mode robust", "ridge": "--mode solve", "iterations": "--mode solve"},
        "deterministic": "--device cuda",
    },
    "query": {"ensemble": "--predicted p"},
    "segment": {
        "ensemble": "--predicted p",
        **dict.fromkeys(("encoder", "templates", "scoring", "temperature"), "--classes a"),
    },
    "distill": dict.fromkeys(("encoder", "images", "views_per_step"), "--loss contrastive"),
    "predict": {"always": "--projection p"},
    "edit": {
        **dict.fromkeys(("transform", "images"), "--views v"),
        "views": "--view 1",
        **dict.fromkeys(("negatives", "threshold"), "--semantics s"),
    },
    "render": dict.fromkeys(("transform", "images"), "--views v"),
    "track": {
        **{"split": "--views moving", "mask_split": "--mask-views moving"},
        **dict.fromkeys(("scoring", "temperature"), "--classes a"),
        "foreground": "params.npz",
    },
    "evaluate": {"ensemble": "--predicted p", "epochs": "--ablate inputs"}
    | {"forgetting": "panoptic-4d", "classes": "parts"},
    "fit": {"mask_hides": "--masks m"},
    "poses": {"every": "a.mp4"},
    "info": {},
    "convert": {"spz_version": "a.spz"},
    "view": dict.fromkeys(("transform", "images"), "--views v")
    | dict.fromkeys(("encoder", "min_weight"), "--semantics s"),
}  # fmt: skip
UNMET = {
    "lift": {"cache_limit": "--cache none"},
    "query": {"predicted": "--ensemble 2d", "canonical": "--score cosine"},
    "segment": {"predicted": "--ensemble 2d"},
    "distill": {"up": "--no-augment"},
    "instances": dict.fromkeys(("least_iou", "least_cosine"), "--group name"),
    "render": {**dict.fromkeys(("frames", "size", "up"), "--views v"), "background": "--mode depth"},
    "track": {"cache_limit": "--cache none"},
    "evaluate": {"count": "--gaussians g"}
    | dict.fromkeys(("encoder", "levels", "method", "share_of_views", "cache"), "--semantics s"),
    "fit": {
        **dict.fromkeys(("init", "depth"), "--resume"),
        **{"points": "--depth d", "held_out_poses": "--hold-out 0"},
    },
    "info": {"axes": "--data-set lerf", "semantics": "--data-set lerf"},
    "convert": {"plain": "a.splat", "device": "--device cuda"},
}
VALUES = {"edit": {"negatives": "a"}, "info": {"axes": "rub"}, "convert": {"device": "cpu"}}
CASES = [(name, option) for name, needs in NEEDS.items() for option in needs]


def given(name: str, option: str) -> list[str]:
    """The option with a value that the parser takes."""
    kind = typing.get_type_hints(COMMANDS[name])[option]
    chosen = [one for one in typing.get_args(kind) if one is not type(None)] or [kind]
    flag = f"--{option.replace('_', '-')}"
    if kind is bool:
        return [
            flag
            if not next(f for f in dataclasses.fields(COMMANDS[name]) if f.name == option).default
            else f"--no-{option}"
        ]
    if option in VALUES.get(name, {}):
        return [flag, VALUES[name][option]]
    literal = next((one for one in (kind, *chosen) if typing.get_origin(one) is typing.Literal), None)
    if literal is not None:
        return [flag, str(typing.get_args(literal)[-1])]
    if typing.get_origin(kind) is tuple and int in chosen:
        return [flag, "64", "48"]
    return [flag, "3" if {int, float} & {kind, *chosen} else "x"]  # fmt: skip


def line(name: str, option: str, more: str) -> list[str]:
    """The command line; a word that is no option takes the place of a positional one."""
    words, own = BASE[name].split(), given(name, option)
    if more and not more.startswith("--"):
        place = 1 if name == "convert" else 0
        words[place], more = more, ""
    pairs = more.split()
    if pairs and pairs[0] == own[0]:  # as --device cpu and --device cuda
        own = []
    elif pairs and pairs[0] in words:
        at = words.index(pairs[0])
        words[at : at + 2] = []
    return [*words, *pairs, *own]


@pytest.fixture
def home(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "moving").mkdir()
    for split in ("train", "test"):
        (tmp_path / "moving" / f"{split}_meta.json").write_text("{}")
    for name in ("s.ply", "a.mp4"):
        (tmp_path / name).write_bytes(b"")
    return tmp_path


def notices(caplog, name: str, words: list[str]) -> list[str]:
    caplog.clear()
    command = tyro.cli(COMMANDS[name], args=words)
    command.command_line = " ".join(["sgwarp", name, *words])
    say_without_effect(command)
    return caplog.messages


def test_every_option_of_every_command_is_in_one_of_the_tables():
    assert set(ALWAYS) == set(COMMANDS)
    for name, options in OPTIONS.items():
        listed = [*ALWAYS[name], *NEEDS.get(name, {})]
        assert sorted(listed) == sorted(options), name


@pytest.mark.parametrize(("name", "option"), CASES)
def test_an_option_without_effect_is_said(home, caplog, name, option):
    met, unmet = MET.get(name, {}).get(option, ""), UNMET.get(name, {}).get(option, "")
    assert met or unmet
    flag = given(name, option)[0]
    said = f"{flag} has no effect: it goes with {NEEDS[name][option].words}"
    assert said in notices(caplog, name, line(name, option, unmet))
    assert said not in notices(caplog, name, line(name, option, met))


@pytest.mark.parametrize("name", BASE)
def test_nothing_is_said_without_such_an_option(home, caplog, name):
    assert notices(caplog, name, BASE[name].split()) == []


CHANGED = {"tau": 1e-6, "border": 20, "passes": 1, "ridge": 50.0, "iterations": 1}


@pytest.mark.parametrize("mode", typing.get_args(LiftMode))
def test_the_table_of_lifting_is_true(stage, stage_files, mode):
    """Each option changes what its mode lifts, and nothing that the others do."""
    views = stage.views[:3]
    plain = lift(stage_files.gaussians, views, stage.dense, mode, lift_settings=LiftSettings())
    for option, value in CHANGED.items():
        changed = lift(stage_files.gaussians, views, stage.dense, mode, lift_settings=LiftSettings(**{option: value}))
        command = tyro.cli(COMMANDS["lift"], args=[*BASE["lift"].split(), "--mode", mode])
        same = torch.equal(plain.features, changed.features) and torch.equal(plain.weight, changed.weight)
        assert same != NEEDS["lift"][option].met(command), option


def test_label_images_are_asked_as_they_are(stage, stage_files, tmp_path, capsys):
    labels = tmp_path / "l.safetensors"
    save_semantics(lift(stage_files.gaussians, stage.views, stage.one_hot), labels)
    files = [stage_files.scene, "--semantics", labels, "--views", stage_files.views, "--view", "0001"]
    words = ["--text", "3", "--score", "cosine", "--out", tmp_path / "q.png"]
    assert main([str(word) for word in ("query", *files, *words)]) == 0
    assert "sgwarp: --score has no effect: the semantics were lifted from label images" in capsys.readouterr().err
    words = ["--classes", "3", "--temperature", "3", "--out", tmp_path / "o"]
    assert main([str(word) for word in ("segment", *files, *words)]) == 0
    assert "sgwarp: --temperature has no effect: the semantics were" in capsys.readouterr().err
