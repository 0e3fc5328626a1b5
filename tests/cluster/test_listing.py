"""Lists of scenes, and what of them a shard takes."""

from pathlib import Path

import pytest

from sgwarp.cluster.listing import gaussians_in, list_scenes, shard_of
from sgwarp.errors import InputError


@pytest.fixture
def scans(tmp_path: Path) -> Path:
    for name in ("b", "a", "c"):
        (tmp_path / "scans" / name / "dslr").mkdir(parents=True)
    (tmp_path / "scans" / ".hidden").mkdir()
    (tmp_path / "scans" / "d.compressed.ply").write_bytes(b"ply")
    (tmp_path / "scans" / "notes.md").write_text("no scene")
    return tmp_path / "scans"


def found(source) -> list[tuple[str, str]]:
    return [(scene.name, scene.path.name) for scene in list_scenes(str(source))]


def test_a_folder_holds_folders_and_files(scans):
    assert found(scans) == [("a", "a"), ("b", "b"), ("c", "c"), ("d", "d.compressed.ply")]


def test_a_pattern_is_named_by_what_differs(scans):
    assert found(scans / "*" / "dslr") == [("a", "dslr"), ("b", "dslr"), ("c", "dslr")]
    assert found(scans / "[ab]") == [("a", "a"), ("b", "b")]


def test_a_text_file_has_paths_and_options(scans):
    lines = ["# two scenes", "", "scans/a fit.steps=30 name=first", "'scans/b'  # the second"]
    (scans.parent / "list.txt").write_text("\n".join(lines))
    first, second = list_scenes(str(scans.parent / "list.txt"))
    assert (first.name, first.path, first.options) == ("first", scans / "a", {"fit.steps": "30"})
    assert (second.name, second.path, second.options) == ("b", scans / "b", {})


def test_a_table_has_a_column_per_option(scans):
    table = 'path,name,lift.encoder,fit.steps\nscans/a,,"x,y",\nscans/b,other,,7\n'
    (scans.parent / "list.csv").write_text(table, encoding="utf-8-sig")
    first, second = list_scenes(str(scans.parent / "list.csv"))
    assert (first.name, first.options) == ("a", {"lift.encoder": "x,y"})
    assert (second.name, second.path, second.options) == ("other", scans / "b", {"fit.steps": "7"})


@pytest.mark.parametrize(
    ("name", "text", "match"),
    [
        ("l.csv", "scene\na\n", "no column 'path'"),
        ("l.csv", "path\na,b\n", "line 2 has more cells"),
        ("l.csv", "path,name\n,x\n", "line 2 has no path"),
        ("l.csv", "path,name\na,../x\n", "cannot be the name"),
        ("l.csv", "path,name\na,shards\n", "cannot be the name"),
        ("l.csv", "path\na\nb/a\n", "two scenes are named a"),
        ("l.txt", "a fit.steps\n", "line 1: expected option=value"),
        ("l.txt", "'a\n", "line 1 cannot be read"),
        ("l.txt", "# nothing\n", "names no scene"),
    ],
)
def test_bad_lists_are_refused(tmp_path, name, text, match):
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=match):
        list_scenes(str(tmp_path / name))


def test_what_is_not_there_is_refused(tmp_path):
    with pytest.raises(InputError, match="no such folder, list or pattern"):
        list_scenes(str(tmp_path / "none"))
    with pytest.raises(InputError, match="names no scene"):
        list_scenes(str(tmp_path / "*.nothing"))


@pytest.mark.parametrize("count", [1, 2, 3, 7])
def test_shards_take_every_scene_once(scans, count):
    scenes = list_scenes(str(scans))
    taken = [scene.name for index in range(count) for scene in shard_of(scenes, f"{index}/{count}")]
    assert sorted(taken) == [scene.name for scene in scenes]


@pytest.mark.parametrize("shard", ["", "1", "2/2", "-1/2", "0/0", "a/b", "1/2/3"])
def test_bad_shards_are_refused(shard):
    with pytest.raises(InputError, match="--shard"):
        shard_of([], shard)


def test_the_scene_of_a_folder(tmp_path):
    with pytest.raises(InputError, match="holds 0 scenes"):
        gaussians_in(tmp_path)
    for name in ("points3D.ply", "room.ply"):
        (tmp_path / name).touch()
    assert gaussians_in(tmp_path).name == "room.ply"
    (tmp_path / "other.ply").touch()
    with pytest.raises(InputError, match="holds 2 scenes"):
        gaussians_in(tmp_path)
    (tmp_path / "scene.ply").touch()
    assert gaussians_in(tmp_path).name == "scene.ply"
