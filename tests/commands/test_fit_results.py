"""What `sgwarp fit` gives to the fit and makes of its result. Nothing is fitted here."""

import json
import logging
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from sgwarp.cli import main
from sgwarp.commands.fit import LARGEST_GAP, Fit
from sgwarp.errors import InputError
from sgwarp.io.scenes import load_gaussians
from sgwarp.io.views import load_views
from sgwarp.reconstruction.fitting.measurement import Measurement
from sgwarp.reconstruction.fitting.trainer import Fitted
from sgwarp.reconstruction.sfm.poses import NOTES
from sgwarp.runs.log import RunLog

CURVE = [Measurement(k, 1.0 * k, 10.0 + k, 0.5 / k, 100 * k) for k in (1, 2, 3)]
FIT = "sgwarp.reconstruction.fitting.trainer.fit"


@pytest.fixture
def fitted(stage_files, monkeypatch):
    """`fitted(**changes)`: the fit gives this result at once; holds how it was asked."""
    calls = []

    def make(**changes):
        def fit(views, start, held_out, settings, **given):
            calls.append(SimpleNamespace(views=views, start=start, held_out=held_out, settings=settings, **given))
            given["checkpoint"].write_text("checkpoint")
            result = Fitted(stage_files.gaussians, CURVE, {view.stem: 13.0 for view in held_out}, 15.0, True)
            return replace(result, views=tuple(views), held_out_views=tuple(held_out), **changes)

        monkeypatch.setattr(FIT, fit)
        return calls

    return make


def run(stage_files, out, *more) -> int:
    return main([str(word) for word in ("fit", stage_files.views, "--out", out, "--init", "random", *more)])


def record(out) -> dict:
    return json.loads((out.parent / "run.json").read_text())


def test_a_fit_leaves_a_scene_its_sheet_its_plot_and_its_figures(fitted, stage_files, tmp_path):
    fitted()
    out = tmp_path / "s.v2.ply"
    assert run(stage_files, out) == 0
    names = ["s.v2.ply", "s.v2.held_out.jpg", "s.v2.curve.png"]
    log = record(out)
    assert log["outputs"] == [str(tmp_path / name) for name in names]
    assert {path.name for path in tmp_path.iterdir()} == {*names, "run.json"}, "and no checkpoint"
    assert len(load_gaussians(out)) == len(stage_files.gaussians)
    assert log["error"] == pytest.approx(
        {"held_out_psnr": 13.0, "fitted_psnr": 15.0, "overfitting_gap": 2.0, "loss": 0.5 / 3}
    )
    assert [(row["step"], row["psnr"], row["count"]) for row in log["curve"]] == [
        (1, 11.0, 100),
        (2, 12.0, 200),
        (3, 13.0, 300),
    ]
    assert cv2.imread(str(tmp_path / "s.v2.curve.png")).std() > 5
    assert "write" in log["stages"]


def test_without_held_out_views_there_is_neither_sheet_nor_plot(fitted, stage_files, tmp_path):
    call = fitted(curve=[replace(CURVE[0], psnr=float("nan"))])
    assert run(stage_files, tmp_path / "s.ply", "--hold-out", 0) == 0
    assert call[0].held_out == []
    assert len(call[0].views) == 6
    assert {path.name for path in tmp_path.iterdir()} == {"s.ply", "run.json"}
    error = record(tmp_path / "s.ply")["error"]
    assert error["held_out_psnr"] is None
    assert "overfitting_gap" not in error


def test_without_matplotlib_there_is_no_plot_and_all_else(fitted, stage_files, tmp_path, monkeypatch):
    def missing():
        raise InputError("the plot of a fit needs matplotlib")

    monkeypatch.setattr("sgwarp.reconstruction.fitting.report.require_matplotlib", missing)
    fitted()
    assert run(stage_files, tmp_path / "s.ply") == 0
    assert {path.name for path in tmp_path.iterdir()} == {"s.ply", "s.held_out.jpg", "run.json"}


def test_an_interrupted_fit_keeps_its_checkpoint(fitted, stage_files, tmp_path):
    fitted(complete=False)
    assert run(stage_files, tmp_path / "s.ply") == 130
    assert (tmp_path / "s.ply").is_file()
    assert (tmp_path / "s.ply.checkpoint").read_text() == "checkpoint"
    assert (tmp_path / "run.json").is_file()


@pytest.mark.parametrize("more", [-0.5, 0.0, 0.5])
def test_a_gap_larger_than_six_decibel_is_warned_of(fitted, stage_files, tmp_path, caplog, more):
    assert LARGEST_GAP == 6.0
    fitted(fitted_psnr=13.0 + 6.0 + more)
    assert run(stage_files, tmp_path / "s.ply") == 0
    assert ("overfitted: 19.5 dB on the photographs that were fitted, 13.0 dB on those" in caplog.text) == (more > 0)
    assert ("overfitted" in caplog.text) == (more > 0)


def test_poses_refined_for_held_out_views_are_what_the_gap_is_measured_from(fitted, stage_files, tmp_path, caplog):
    caplog.set_level(logging.INFO)
    fitted(fitted_psnr=21.0, held_out_refined={"0000": 14.0, "0001": 18.0})
    out = tmp_path / "s.ply"
    assert run(stage_files, out, "--refine-poses") == 0
    error = record(out)["error"]
    assert (error["held_out_psnr"], error["held_out_psnr_refined_poses"]) == (13.0, 16.0)
    assert error["overfitting_gap"] == 5.0
    assert "held out: 13.00 dB from the poses given, 16.00 dB from poses refined" in caplog.text
    assert "overfitted" not in caplog.text
    poses = tmp_path / "s.ply.refined" / "transforms.json"
    assert str(poses) in record(out)["outputs"] or str(poses.parent) in record(out)["outputs"]
    assert [view.stem for view in load_views(poses.parent)] == [f"{k:04d}" for k in range(1, 6)]


def test_the_fit_is_told_where_and_how(fitted, stage_files, tmp_path):
    calls = fitted()
    out = tmp_path / "s.ply"
    assert run(stage_files, out) == 0
    assert run(stage_files, out, "--downscale", 2, "--max-size", 50, "--checkpoint-every", 7, "--resume") == 0
    plain, other = calls
    assert (plain.downscale, plain.largest, plain.checkpoint_every, plain.resume) == (1, 1600, 1000, False)
    assert (other.downscale, other.largest, other.checkpoint_every, other.resume) == (2, 50, 7, True)
    for call in calls:
        assert call.checkpoint == tmp_path / "s.ply.checkpoint"
        assert call.keep_checkpoint is True
        assert call.device == "cpu"
        assert callable(call.progress)
        assert isinstance(call.log, RunLog)
        assert call.start is None
        assert [view.stem for view in call.held_out] == ["0000"]
        assert [view.stem for view in call.views] == [f"{k:04d}" for k in range(1, 6)]


@pytest.mark.parametrize(
    ("options", "estimated", "expected"),
    [
        ({}, False, False),
        ({}, True, True),
        ({"refine_poses": True}, False, True),
        ({"refine_poses": True, "held_out_poses": "given"}, True, False),
        ({"held_out_poses": "refined"}, False, True),
        ({"held_out_poses": "refined", "hold_out": 0}, False, False),
        ({"hold_out": 0}, True, False),
    ],
)
def test_poses_of_held_out_views_are_refined_where_they_are_estimates(tmp_path, options, estimated, expected):
    if estimated:
        (tmp_path / NOTES).write_text("{}")
    assert Fit(views=tmp_path, out=tmp_path / "s.ply", **options)._refines_held_out(tmp_path) is expected


def test_poses_that_were_found_are_an_output_and_what_is_fitted(fitted, stage_files, tmp_path, monkeypatch, caplog):
    caplog.set_level(logging.INFO)
    calls, out = fitted(), tmp_path / "s.ply"

    def find_poses(source, made, log, seed):
        made.mkdir()
        (made / "transforms.json").write_text((stage_files.views / "transforms.json").read_text())
        (made / "images").symlink_to(source)

    monkeypatch.setattr("sgwarp.commands.fit.find_poses", find_poses)
    words = ["fit", stage_files.views / "images", "--out", out, "--init", "random"]
    assert main([str(word) for word in words]) == 0
    assert record(out)["outputs"][0] == str(tmp_path / "s.ply.sfm")
    assert len(calls[0].views) == 5
    assert f"are found by structure from motion, and kept in {tmp_path / 's.ply.sfm'}" in caplog.text


# What a fit starts from


def command(stage_files, **options) -> Fit:
    return Fit(views=stage_files.views, out=stage_files.views.parent / "unwritten.ply", **options)


def begun(fit: Fit, views):
    return fit._start(fit.views, views, SimpleNamespace(cap=123), RunLog())


@pytest.fixture
def starts(monkeypatch):
    """What each start would give, and what was asked for."""
    asked = []

    def note(name, result):
        def called(*given, **named):
            asked.append((name, given, named))
            return result

        return called

    monkeypatch.setattr("sgwarp.reconstruction.depth.gaussians_from_depth", note("depth", "from depth"))
    monkeypatch.setattr("sgwarp.reconstruction.fitting.depth_start.usable_depth", note("usable", "depth"))
    monkeypatch.setattr("sgwarp.io.points.load_points", note("points", ("points", "colours")))
    return asked


def test_a_resumed_or_random_start_reads_nothing(starts, stage_files):
    for options in ({"resume": True}, {"init": "random"}, {"resume": True, "init": "depth"}):
        assert begun(command(stage_files, **options), []) is None
    assert starts == []


def test_depth_that_is_given_comes_first(starts, stage_files, monkeypatch):
    monkeypatch.setattr("sgwarp.reconstruction.fitting.belongings.depth_from_folder", lambda *given: given)
    folder = stage_files.views / "depth"
    for init in ("auto", "depth"):
        starts.clear()
        assert begun(command(stage_files, depth=folder, init=init), ["v"]) == "from depth"
        assert [name for name, *_ in starts] == ["usable", "depth"]
        assert starts[0][1] == (f"--depth {folder}", (folder, ["v"]), ["v"])
        assert starts[1][1:] == ((["v"], "depth"), {"count": 123})
    starts.clear()
    assert begun(command(stage_files, depth=folder, init="points"), ["v"]) == ("points", "colours")


def test_depth_that_the_data_set_names_is_said(starts, stage_files, monkeypatch, caplog):
    caplog.set_level(logging.INFO)
    monkeypatch.setattr("sgwarp.reconstruction.fitting.belongings.depth_of_views", lambda views: "declared")
    assert begun(command(stage_files), ["v"]) == "from depth"
    assert starts[0][1] == (f"{stage_files.views}: depth that it names", "declared", ["v"])
    assert "--init points starts without them" in caplog.text


def test_depth_that_does_not_fit_is_left_out_unless_it_was_asked_for(stage_files, monkeypatch, caplog):
    def unusable(*given):
        raise InputError("the depth images disagree")

    monkeypatch.setattr("sgwarp.reconstruction.fitting.belongings.depth_of_views", lambda views: "declared")
    monkeypatch.setattr("sgwarp.reconstruction.fitting.depth_start.usable_depth", unusable)
    monkeypatch.setattr("sgwarp.io.points.find_points", lambda source: "found")
    monkeypatch.setattr("sgwarp.io.points.load_points", lambda *given: ("points", given))
    assert begun(command(stage_files), ["v"]) == ("points", (stage_files.views,))
    assert "the depth images disagree" in caplog.text
    with pytest.raises(InputError, match="the depth images disagree"):
        begun(command(stage_files, init="depth"), ["v"])
    monkeypatch.setattr("sgwarp.reconstruction.fitting.belongings.depth_of_views", lambda views: None)
    with pytest.raises(InputError, match="--init depth: needs --depth"):
        begun(command(stage_files, init="depth"), ["v"])


@pytest.mark.parametrize("init", ["auto", "points"])
def test_points_that_are_named_are_read_in_the_world_of_the_data_set(starts, stage_files, tmp_path, init):
    points = tmp_path / "p.ply"
    assert begun(command(stage_files, points=points, init=init), []) == ("points", "colours")
    assert starts == [("points", (points, stage_files.views), {})]


def test_points_of_the_data_set_itself(starts, stage_files):
    assert begun(command(stage_files, init="points"), []) == ("points", "colours")
    assert starts == [("points", (stage_files.views, stage_files.views), {})]


@pytest.mark.parametrize("broken", [True, False])
def test_points_that_cannot_be_read_or_are_not_there_are_made(stage_files, monkeypatch, caplog, broken):
    def unreadable(source):
        raise InputError("points3D.bin: is damaged")

    made = np.zeros((10_000, 3)), np.zeros((10_000, 3))
    monkeypatch.setattr("sgwarp.io.points.find_points", unreadable if broken else lambda source: None)
    monkeypatch.setattr("sgwarp.reconstruction.sfm.library.has_pycolmap", lambda: True)
    monkeypatch.setattr("sgwarp.reconstruction.sfm.triangulation.triangulate", lambda *given: made)
    assert begun(command(stage_files), []) is made
    assert ("points3D.bin: is damaged" in caplog.text) == broken


def test_without_pycolmap_a_start_is_random_and_says_so(stage_files, monkeypatch, caplog):
    monkeypatch.setattr("sgwarp.io.points.find_points", lambda source: None)
    monkeypatch.setattr("sgwarp.reconstruction.sfm.library.has_pycolmap", lambda: False)
    assert begun(command(stage_files), []) is None
    assert "pycolmap is not installed to triangulate some; starts at random" in caplog.text


# What is watched


def test_the_viewer_of_a_fit_closes_with_it(fitted, stage_files, tmp_path, monkeypatch):
    calls, said = fitted(), []

    def live(views):
        said.append([view.stem for view in views])
        return SimpleNamespace(close=lambda: said.append("closed"), watch="watch", finish=lambda: said.append("finish"))

    monkeypatch.setattr(Fit, "_live", staticmethod(live))
    assert run(stage_files, tmp_path / "s.ply", "--view") == 0
    assert said == [[f"{k:04d}" for k in range(1, 6)], "finish", "closed"]
    assert calls[0].log.watch == "watch"
    said.clear()
    fitted(complete=False)
    assert run(stage_files, tmp_path / "s.ply", "--view") == 130
    assert said[1:] == ["closed"], "an interrupted fit is not waited for"
