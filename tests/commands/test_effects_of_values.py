"""Which values make an option count, one by one, and what counts as given."""

from pathlib import Path

import pytest

from sgwarp.commands import COMMANDS
from sgwarp.commands.effects import NEEDS, say_unused, say_without_effect, was_given


def make(name: str, **options):
    """A command of Python, without a command line."""
    needed = {"scene": Path("s.ply"), "out": Path("o.ply"), "views": Path("v"), "photographs": Path("p")}
    taken = COMMANDS[name].__dataclass_fields__
    given = {key: value for key, value in needed.items() if key in taken} | options
    return COMMANDS[name](**given)


@pytest.mark.parametrize(
    ("out", "plain", "version"),
    [
        ("o.ply", True, False),
        ("O.PLY", True, False),
        ("o.compressed.ply", False, False),
        ("o.COMPRESSED.ply", False, False),
        ("o.spz", False, True),
        ("o.SPZ", False, True),
        ("o.splat", False, False),
        ("ply", False, False),
    ],
)
def test_columns_are_left_out_of_plain_ply_files_alone(out, plain, version):
    command = make("convert", out=Path(out))
    assert NEEDS["convert"]["plain"].met(command) is plain
    assert NEEDS["convert"]["spz_version"].met(command) is version


@pytest.mark.parametrize(
    ("kind", "axes"), [("ply", True), ("npz", False), ("folder", False), ("missing", False), ("data set", False)]
)
def test_axes_are_those_of_one_scene(tmp_path, kind, axes):
    path = tmp_path / ("s.npz" if kind == "npz" else "s.ply")
    if kind == "folder":
        path.mkdir()
    elif kind != "missing":
        path.touch()
    command = make("info", scene=path, data_set="lerf" if kind == "data set" else None)
    assert NEEDS["info"]["axes"].met(command) is axes


@pytest.mark.parametrize("option", ["split", "mask_split"])
def test_splits_are_of_cameras_that_move(tmp_path, option):
    folder = {"split": "views", "mask_split": "mask_views"}[option]
    assert not NEEDS["track"][option].met(make("track", **{folder: tmp_path}))
    (tmp_path / "other_meta.json").touch()
    assert not NEEDS["track"][option].met(make("track", **{folder: tmp_path}))
    assert NEEDS["track"][option].met(make("track", **{folder: tmp_path, option: "other"}))
    assert not NEEDS["track"]["mask_split"].met(make("track", mask_views=None))


@pytest.mark.parametrize("profile", ["room", "room-instances", "scannet-instances", "panoptic-4d", "lerf-ovs"])
def test_an_evaluation_lifts_without_semantics_or_where_they_are_instances(profile):
    met = NEEDS["evaluate"]["encoder"].met
    common = {"profile": profile, "data": Path("d"), "out": Path("o")}
    assert met(make("evaluate", **common))
    assert met(make("evaluate", semantics="s", **common)) == (profile.endswith("-instances") or "4d" in profile)


@pytest.mark.parametrize(
    ("options", "met"),
    [
        ({}, False),
        ({"select": ("lamp",)}, False),
        ({"select": ("lamp", "click:1,2,3")}, True),
        ({"keep": ("click:1,2,3",)}, True),
        ({"view": "1"}, True),
        ({"script": Path("a.json")}, True),
    ],
)
def test_views_of_an_edit_are_for_looking(options, met):
    assert NEEDS["edit"]["views"].met(make("edit", **options)) is met


@pytest.mark.parametrize(
    ("options", "met"), [({}, False), ({"semantics": Path("s")}, True), ({"script": Path("a")}, True)]
)
def test_thresholds_of_an_edit_are_for_texts(options, met):
    assert NEEDS["edit"]["threshold"].met(make("edit", **options)) is met


@pytest.mark.parametrize(
    ("options", "depth", "points"),
    [
        ({}, True, True),
        ({"init": "depth"}, True, False),
        ({"init": "points"}, False, True),
        ({"init": "random"}, False, False),
        ({"depth": Path("d")}, True, False),
        ({"init": "points", "depth": Path("d")}, False, True),
        ({"resume": True}, False, False),
        ({"resume": True, "init": "points"}, False, False),
    ],
)
def test_what_a_fit_starts_from(options, depth, points):
    command = make("fit", **options)
    assert NEEDS["fit"]["depth"].met(command) is depth
    assert NEEDS["fit"]["points"].met(command) is points


@pytest.mark.parametrize(
    ("name", "option", "options", "met"),
    [
        ("fit", "mask_hides", {"masks": Path("m")}, True),
        ("fit", "mask_hides", {"masks": Path("none")}, False),
        ("fit", "mask_hides", {}, False),
        ("fit", "held_out_poses", {"hold_out": 0}, False),
        ("fit", "held_out_poses", {"hold_out": 1}, True),
        ("track", "foreground", {"scene": Path("params.npz")}, True),
        ("track", "foreground", {"scene": Path("frames")}, False),
        ("lift", "deterministic", {"device": "cuda:1"}, True),
        ("lift", "deterministic", {}, False),
        ("lift", "cache_limit", {"cache": "none"}, False),
        ("lift", "cache_limit", {"cache": "folder"}, True),
        ("lift", "cache_limit", {}, True),
        ("view", "min_weight", {"semantics": Path("s")}, True),
        ("view", "min_weight", {}, False),
        ("render", "frames", {"views": None}, True),
        ("render", "frames", {}, False),
    ],
)
def test_whether_an_option_counts(name, option, options, met):
    assert NEEDS[name][option].met(make(name, **options)) is met


def test_what_was_given_is_what_stands_on_the_command_line():
    command = make("lift", tau=0.05)
    command.command_line = "sgwarp lift 's p.ply' --views v --tau=0.05 --no-reliability --cache_limit 3"
    for name, given in (
        ("tau", True),
        ("reliability", True),
        ("cache_limit", True),
        ("views", True),
        ("border", False),
    ):
        assert was_given(command, name) is given
    command.border = 3
    assert was_given(command, "border") is False


def test_without_a_command_line_what_differs_from_the_default_was_given(caplog):
    command = make("lift", tau=0.2, photographs=False)
    found = {name: was_given(command, name) for name in ("tau", "border", "photographs", "mode")}
    assert found == {"tau": True, "border": False, "photographs": True, "mode": False}
    say_without_effect(command)
    assert caplog.messages == ["--tau has no effect: it goes with --mode center"]
    caplog.clear()
    say_unused(command, ("photographs", "border", "tau"), "nothing is lifted")
    assert caplog.messages == [
        "--no-photographs has no effect: nothing is lifted",
        "--tau has no effect: nothing is lifted",
    ]
