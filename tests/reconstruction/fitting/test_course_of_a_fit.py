"""The course of a fit around its steps: what is reported, timed, saved, drawn and searched for at the end."""

import re
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from sgwarp.errors import InputError
from sgwarp.reconstruction.fitting import held_out_poses, loop, report, trainer
from sgwarp.reconstruction.fitting.held_out_poses import refine_held_out_poses
from sgwarp.reconstruction.fitting.measurement import Measurement
from sgwarp.reconstruction.fitting.photographs import Photograph, read_photographs
from sgwarp.reconstruction.fitting.settings import FitSettings
from sgwarp.reconstruction.fitting.trainer import fit
from sgwarp.runs.log import RunLog
from sgwarp.scene import Camera, Gaussians

SHORT = FitSettings(steps=4, cap=1300, sh_degree=0, evaluate_every=2)
CPU = torch.device("cpu")


def scene(count: int = 4) -> Gaussians:
    quats = torch.tensor([1.0, 0, 0, 0]).expand(count, 4)
    means = torch.tensor([[0.0, 0.0, 3.0]]) + 0.1 * torch.arange(float(count))[:, None]
    return Gaussians(means, quats, torch.full((count, 3), 0.3), torch.full((count,), 0.5), torch.zeros(count, 1, 3))


def started(boards, settings: FitSettings, log: RunLog | None = None) -> loop.Loop:
    photographs = read_photographs(boards.views[:4])
    run = loop.Loop(settings, photographs[1:], photographs[:1], 1.0, CPU, log or RunLog())
    run.begin(scene())
    return run


def test_the_device_is_waited_for_before_what_is_no_step_begins(boards, tmp_path, monkeypatch):
    """On CUDA the time would be charged to the measurement or the checkpoint else."""
    order, stage = [], RunLog.stage

    def noted(log, name, wait=True):
        order.append((name, wait))
        return stage(log, name, wait)

    monkeypatch.setattr(RunLog, "stage", noted)
    run = started(boards, SHORT)
    assert run.go(lambda *call: None, tmp_path / "run.checkpoint", 2, lambda: False)
    step, settled = [("fit", False)], [("fit", True)]
    second = [*step, *settled, ("measure", True), *step, *settled, ("checkpoint", True)]
    assert order == [*step * 2, *second, *step * 4, *settled]


@pytest.mark.parametrize(("first", "told"), [(0, [0, 10, 20, 25]), (10, [10, 20, 25])])
def test_speed_is_that_of_the_steps_of_this_run(boards, monkeypatch, first, told):
    """On a clock that moves by half a second a step, and by nothing otherwise."""
    clock, reports = [100.0], []
    monkeypatch.setattr(loop, "time", SimpleNamespace(perf_counter=lambda: clock[0]))
    take = loop.Loop._take_step

    def slow(run):
        clock[0] += 0.5
        return take(run)

    monkeypatch.setattr(loop.Loop, "_take_step", slow)
    run = started(boards, replace(SHORT, steps=25, evaluate_every=20))
    run.step = first
    assert run.go(lambda done, total, text: reports.append((done, total, text)), None, 1000, lambda: False)
    assert [call[:2] for call in reports] == [(step, 25) for step in told]
    speeds = [re.search(r", ([\d.]+) it/s$", text) for _, _, text in reports]
    expected = ["0.0" if step == first else "2.0" for step in told]
    assert [found and found[1] for found in speeds] == ([None, *expected[1:]] if first == 0 else expected)
    assert re.fullmatch(r"loss 0\.\d{4}, \d+\.\d\d dB, held out \d+\.\d\d dB, 4 Gaussians, 2\.0 it/s", reports[-1][2])
    assert [(point.step, point.seconds) for point in run.curve] == [(20, (20 - first) / 2)]


def test_an_interruption_ends_a_run_before_its_next_step(boards):
    run = started(boards, SHORT)
    assert not run.go(lambda *call: None, None, 1000, lambda: run.step == 3)
    assert run.step == 3
    assert run.go(lambda *call: None, None, 1000, lambda: False)
    assert run.step == 4


@pytest.mark.parametrize("masked", [False, True])
def test_a_step_that_shows_nothing_moves_no_pose(boards, masked):
    """All Gaussians lie behind the cameras; where all pixels are masked as well, no exposure moves either."""
    photographs = read_photographs(boards.views[:3])
    if masked:
        nothing = torch.zeros(photographs[0].camera.size, dtype=torch.uint8)
        photographs = [replace(photograph, stored_mask=nothing) for photograph in photographs]
    run = loop.Loop(replace(SHORT, exposure=True, refine_poses=True), photographs, [], 1.0, CPU, RunLog())
    run.begin(replace(scene(), means=scene().means - torch.tensor([0.0, 0.0, 50.0])))
    assert run.go(lambda *call: None, None, 1000, lambda: False)
    assert not run.poses.group.parameters.any()
    if masked:
        torch.testing.assert_close(run.exposure.group.parameters, torch.eye(3, 4).expand(3, 3, 4))


POINTS = (np.random.default_rng(0).random((900, 3)), np.zeros((900, 3)))


@pytest.mark.parametrize("complete", [True, False])
def test_what_no_camera_sees_goes_at_the_end_alone(boards, monkeypatch, complete):
    """An interrupted run may go on, and noise may bring it back."""
    removed = []
    monkeypatch.setattr(trainer.Loop, "go", lambda *rest: complete)
    monkeypatch.setattr(trainer.Loop, "remove_unseen", lambda run: removed.append(run))
    assert fit(boards.views[:3], POINTS, (), SHORT).complete == complete
    assert len(removed) == complete


def test_a_fit_ends_well_though_no_checkpoint_could_be_written(boards, tmp_path, monkeypatch, caplog):
    def full(run, path):
        raise InputError("no space left on device")

    monkeypatch.setattr(trainer.Loop, "save", full)
    log = RunLog()
    path = tmp_path / "run.checkpoint"
    assert fit(boards.views[:3], POINTS, (), SHORT, checkpoint=path, checkpoint_every=2, log=log).complete
    assert caplog.text.count("no space left on device; the fit goes on without it") == 2
    assert log.left_out["checkpoints"] == 2


def test_the_search_for_a_held_out_pose_is_told_and_bounded(monkeypatch):
    """At most thirty steps; it ends where the loss falls by no more than a billionth."""
    made, reports = [], []

    def search(parameters, **options):
        made.append(options)
        return SimpleNamespace(step=lambda evaluate: None)

    monkeypatch.setattr(held_out_poses.torch.optim, "LBFGS", search)
    camera = Camera(torch.tensor([[10.0, 0, 4], [0, 10, 4], [0, 0, 1]]), torch.eye(4).double(), 8, 8)
    photographs = [Photograph(stem, camera, torch.full((8, 8, 3), 90, dtype=torch.uint8)) for stem in "ab"]
    refine_held_out_poses(scene(), photographs, None, 0.2, lambda *call: reports.append(call))
    assert reports == [(done, 2, "refining held-out poses") for done in range(3)]
    assert made == [{"max_iter": 30, "tolerance_change": 1e-9, "line_search_fn": "strong_wolfe"}] * 2


# Pictures.


def test_curves_are_drawn_over_the_seconds(tmp_path, monkeypatch):
    figures = pytest.importorskip("matplotlib.figure")
    drawn = []
    monkeypatch.setattr(figures.Figure, "savefig", lambda figure, path: drawn.append(figure) or path.touch())
    points = [Measurement(500, 2.0, 20.5, 0.3, 1000), Measurement(1000, 5.0, 24.0, 0.1, 2500)]
    report.draw_curve(points, tmp_path / "curve.png")
    quality, loss = drawn[0].axes
    assert quality.lines[0].get_xydata().tolist() == [[2.0, 20.5], [5.0, 24.0]]
    assert loss.lines[0].get_xydata().tolist() == [[2.0, 0.3], [5.0, 0.1]]
    assert [axis.get_xlabel() for axis in (quality, loss)] == ["seconds of fitting"] * 2
    assert [axis.get_ylabel() for axis in (quality, loss)] == ["PSNR of held-out views [dB]", "loss, running mean"]
    (note,) = quality.texts
    assert (note.get_text(), note.xy) == ("24.00 dB\n1,000 steps, 2,500 Gaussians", (5.0, 24.0))
    assert [(x < 0, y < 0) for x, y in [note.xyann]] == [(True, True)]  # below and beside the point that it is of
    assert (note.get_ha(), note.get_va()) == ("right", "top")
    for axis in (quality, loss):
        line, x, y = axis.lines[0], axis.xaxis, axis.yaxis
        assert (line.get_color(), line.get_markersize()) == ("#2d6cb5", 4)
        assert {x.label.get_color(), y.label.get_color(), note.get_color()} == {"#222222"}
        assert {grid.get_alpha() for grid in (*x.get_gridlines(), *y.get_gridlines())} == {0.3}
        assert [axis.spines[side].get_visible() for side in ("top", "right", "left")] == [False, False, True]
    assert not loss.texts
    assert drawn[0].get_facecolor() == (1, 1, 1, 1)
    assert drawn[0].get_layout_engine() is not None  # so that labels do not overlap
    width, height = drawn[0].get_size_inches() * drawn[0].dpi
    assert (width, height) == (1440, 540)
    assert (tmp_path / "curve.png").exists()


def test_curves_without_matplotlib_are_refused_with_the_remedy(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(InputError, match=r"the plot of a fit needs matplotlib; run: pip install"):
        report.draw_curve([Measurement(1, 1.0, 1.0, 1.0, 1)], tmp_path / "curve.png")


def test_what_is_brighter_than_white_is_shown_and_compared_as_white(monkeypatch):
    camera = Camera(torch.tensor([[30.0, 0, 20], [0, 30, 10], [0, 0, 1]]), torch.eye(4), 40, 20)
    photograph = Photograph("a", camera, torch.full((20, 40, 3), 255, dtype=torch.uint8))
    drawn = []
    for shade in (1.0, 3.0):
        features = torch.full((20, 40, 3), shade)
        monkeypatch.setattr(
            report, "rasterize", lambda *rest, shown=features, **options: SimpleNamespace(features=shown)
        )
        drawn.append(report._row(scene(1), photograph, False)[30:])
    np.testing.assert_array_equal(*drawn)


def test_titles_of_a_contact_sheet_can_be_read():
    """White letters on a black strip around them, in the corner of each of the three white pictures."""
    camera = Camera(torch.tensor([[30.0, 0, 20], [0, 30, 10], [0, 0, 1]]), torch.eye(4), 40, 20)
    photograph = Photograph("a", camera, torch.full((20, 40, 3), 255, dtype=torch.uint8))
    row = report._row(replace(scene(1), opacities=torch.zeros(1)), photograph, True)
    assert row.shape == (200, 3 * 400 + 2 * 6, 3)
    assert (row[:, 400:406] == 255).all()
    for start in (0, 406):
        tile = row[:, start : start + 400].astype(int).min(axis=2)
        strip = int((tile[1] == 0).sum())
        assert (tile[:25, :strip] == 0).mean() > 0.7
        assert (tile[25:] == 255).all()
        assert (tile[:, strip:] == 255).all()
        rows, columns = np.nonzero(tile[:25, :strip])
        assert 3 <= rows.min() < rows.max() <= 22
        assert rows.max() - rows.min() >= 10
        assert columns.min() == pytest.approx(strip - 1 - columns.max(), abs=2)  # as far from either end
        assert 6 <= columns.min() <= 10
        assert tile[:25, :strip].max() > 200
