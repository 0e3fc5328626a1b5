"""What the helpers that commands share pass on: settings of poses, and which encoder of phrases is asked for."""

import numpy as np
import pytest

from sgwarp.cli import main
from sgwarp.io.store import save_semantics
from sgwarp.lifting.lifter import lift
from sgwarp.reconstruction.sfm.features import SfmSettings
from sgwarp.reconstruction.sfm.triangulation import LEAST_POINTS

ESTIMATE = "sgwarp.reconstruction.sfm.poses.estimate_poses"
POSES = {
    "matching": (["--matching", "sequential"], {"matching": "sequential"}),
    "one camera": (["--no-one-camera"], {"one_camera": False}),
    "seed": (["--seed", 5], {"seed": 5}),
    "all": (
        ["--matching", "exhaustive", "--no-one-camera", "--seed", 7],
        {"matching": "exhaustive", "one_camera": False, "seed": 7},
    ),
}


@pytest.fixture
def photographs(stage_files, monkeypatch):
    """A folder without poses."""
    monkeypatch.setattr("sgwarp.reconstruction.sfm.library.require_pycolmap", lambda: None)
    return stage_files.views / "images"


def settings_of(call) -> SfmSettings:
    return call.positional[2]


@pytest.mark.parametrize("name", POSES)
def test_poses_are_found_as_it_was_asked_for(stopped, photographs, tmp_path, name):
    given, changed = POSES[name]
    call = stopped(ESTIMATE, "poses", photographs, "--out", tmp_path / "o", "--threads", 2, *given)
    assert call.positional[:2] == (photographs, tmp_path / "o")
    found = settings_of(call)
    expected = {"matching": "auto", "one_camera": True, "seed": 0, **changed}
    assert {key: getattr(found, key) for key in expected} == expected
    assert found.threads == 2


def test_a_video_gives_its_frames_in_order(stopped, photographs, tmp_path, monkeypatch):
    """Its frames are cut into the output, every n-th as asked for, and matched with those that follow."""
    video, asked = tmp_path / "walk.mp4", []
    video.touch()
    monkeypatch.setattr("sgwarp.reconstruction.sfm.video.extract_frames", lambda *call: asked.append(call[:3]))
    for more, matching in (([], "sequential"), (["--matching", "exhaustive"], "exhaustive")):
        call = stopped(ESTIMATE, "poses", video, "--out", tmp_path / "o", "--every", 4, *more)
        assert call.positional[0] == tmp_path / "o" / "images"
        assert settings_of(call).matching == matching
        assert asked.pop() == (video, tmp_path / "o" / "images", 4)


@pytest.mark.parametrize("seed", [0, 6])
def test_a_fit_finds_poses_with_its_seed(stopped, photographs, tmp_path, seed):
    call = stopped(ESTIMATE, "fit", photographs, "--out", tmp_path / "s.ply", "--seed", seed, "--threads", 1)
    assert call.positional[:2] == (photographs, tmp_path / "s.ply.sfm")
    assert (settings_of(call).seed, settings_of(call).threads) == (seed, 1)


def test_a_fit_triangulates_with_its_seed(stopped, stage_files, tmp_path, monkeypatch):
    monkeypatch.setattr("sgwarp.reconstruction.sfm.library.has_pycolmap", lambda: True)
    target = "sgwarp.reconstruction.sfm.triangulation.triangulate"
    call = stopped(target, "fit", stage_files.views, "--out", tmp_path / "s.ply", "--seed", 8, "--threads", 1)
    assert [view.stem for view in call.positional[0]] == ["0001", "0002", "0003", "0004", "0005"]
    assert (call.positional[1].seed, call.positional[1].threads) == (8, 1)


# Commands that ask in words, up to where they ask for the encoder of phrases.
ASKING = {
    "query": "{scene} --views {views} --view 0001 --text lamp --out {out}/q.png",
    "segment": "{scene} --views {views} --classes lamp --out {out}/o",
    "edit": "{scene} --select lamp --remove --out {out}/e.ply",
    "instances": "{scene} --views {views} --masks files:{labels} --classes lamp --out {out}/I.safetensors",
    "view": "{scene}",
}


@pytest.mark.parametrize("name", ASKING)
def test_phrases_are_for_the_encoder_of_the_lift_or_the_one_that_is_named(stopped, stage, stage_files, tmp_path, name):
    semantics, target = tmp_path / "s.safetensors", "sgwarp.encoders.registry.text_encoder_for"
    save_semantics(lift(stage_files.gaussians, stage.views, stage.dense), semantics, {"encoder": "clip:first"})
    names = {"scene": stage_files.scene, "views": stage_files.views, "labels": stage_files.labels}
    words = [name, *ASKING[name].format(**names, out=tmp_path / "out").split(), "--semantics", semantics]
    call = stopped(target, *words).positional
    assert call[:3] == ("toy", "clip:first", "cpu")
    assert all(templates is None for templates in call[3:])
    if name != "instances":
        assert stopped(target, *words, "--encoder", "clip:other").positional[:3] == ("toy", "clip:other", "cpu")


# How a folder of photographs says where its cameras stood; each is fitted as it is, and no poses are looked for.
POSED = {
    "transforms": ("transforms.json",),
    "transforms of a split": ("transforms_train.json",),
    "COLMAP": ("sparse/0/cameras.bin", "sparse/0/images.bin"),
    "COLMAP as text, beside the photographs": ("cameras.txt", "images.txt"),
    "COLMAP in a folder of its own": ("colmap/sparse/0/cameras.bin", "colmap/sparse/0/images.bin"),
}


@pytest.mark.parametrize("name", [*POSED, "photographs alone"])
def test_a_fit_looks_for_poses_where_there_are_none(stopped, tmp_path, name):
    views = tmp_path / "room"
    for file in ("images/0001.png", *POSED.get(name, ())):
        (views / file).parent.mkdir(parents=True, exist_ok=True)
        (views / file).touch()
    target = "sgwarp.io.views.load_views" if name in POSED else "sgwarp.commands.fit.find_poses"
    assert stopped(target, "fit", views, "--out", tmp_path / "s.ply").positional[0] == views


@pytest.mark.parametrize("init", ["auto", "triangulated"])
@pytest.mark.parametrize("more", [-1, 0])
def test_few_triangulated_points_are_no_start(stopped, stage_files, tmp_path, monkeypatch, capsys, caplog, init, more):
    count = LEAST_POINTS + more
    points = np.zeros((count, 3)), np.zeros((count, 3))
    monkeypatch.setattr("sgwarp.reconstruction.sfm.library.has_pycolmap", lambda: True)
    monkeypatch.setattr("sgwarp.reconstruction.sfm.triangulation.triangulate", lambda *arguments: points)
    arguments = ["fit", stage_files.views, "--out", tmp_path / "s.ply", "--init", init]
    if more < 0 and init == "triangulated":
        assert main([str(argument) for argument in arguments]) == 2
        assert f"only {count} points fit the poses" in capsys.readouterr().err
        return
    start = stopped("sgwarp.reconstruction.fitting.trainer.fit", *arguments).positional[1]
    assert start is (None if more < 0 else points)
    assert (f"only {count} can be triangulated" in caplog.text) == (more < 0)
