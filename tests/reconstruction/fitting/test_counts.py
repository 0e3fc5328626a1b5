"""How many: points that a fit starts from, views that are measured, seconds of a run that was interrupted."""

from dataclasses import replace
from itertools import count
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from sgwarp.files.images import write_ids
from sgwarp.io.points import load_points
from sgwarp.reconstruction.fitting import initial, loop, trainer
from sgwarp.reconstruction.fitting.belongings import depth_from_folder
from sgwarp.reconstruction.fitting.exposure import Exposure
from sgwarp.reconstruction.fitting.frame import Frame
from sgwarp.reconstruction.fitting.per_photograph import PerPhotograph
from sgwarp.reconstruction.fitting.photographs import read_photographs
from sgwarp.reconstruction.fitting.settings import FitSettings
from sgwarp.reconstruction.fitting.trainer import fit
from sgwarp.runs.log import RunLog
from sgwarp.scene import Gaussians


@pytest.mark.parametrize(
    ("strategy", "cap", "most"),
    [
        ("mcmc", 1_000, 1_000),  # moves what is there
        ("default", 1_000, 500),  # has to find room for what it adds
        ("mcmc", 60_000, 50_000),
        ("default", 60_000, 30_000),
        ("default", 500_000, 50_000),
    ],
)
def test_points_that_are_made_leave_a_strategy_its_room(monkeypatch, strategy, cap, most):
    asked = []

    def surfaces(photographs, wanted, settings, progress):
        asked.append(wanted)
        return initial.gaussians_from_points(np.zeros((600, 3)), np.zeros((600, 3)), settings, 1.0)

    monkeypatch.setattr(initial, "_surfaces", surfaces)
    settings = FitSettings(strategy=strategy, cap=cap)
    initial.gaussians_from_photographs([], settings, 1.0)
    initial.completed(torch.zeros(7, 3), torch.zeros(7, 3), [], settings, 1.0, lambda *call: None)
    assert asked == [most, most - 7]


@pytest.mark.parametrize(
    ("points", "cap", "more"),
    [
        (499, 1_000, True),  # less than half of what there is room for
        (500, 1_000, False),
        (19_999, 100_000, True),  # few for any scene
        (20_000, 100_000, False),
        (20_000, 1_000_000, False),
    ],
)
def test_few_points_are_added_to(monkeypatch, points, cap, more):
    added = []
    monkeypatch.setattr(trainer, "require_overlap", lambda *rest: None)
    monkeypatch.setattr(trainer, "completed", lambda *rest: added.append(1) or torch.zeros(len(rest[0])))
    monkeypatch.setattr(trainer, "gaussians_from_points", lambda positions, *rest: torch.zeros(len(positions)))
    frame = SimpleNamespace(points=lambda positions: positions)
    given = np.zeros((points, 3)), np.zeros((points, 3), np.float32)
    assert len(trainer._starting(given, [], [], frame, FitSettings(cap=cap), None, "cpu")) == points
    assert bool(added) == more


@pytest.mark.parametrize("number", [1, 63, 64, 65, 127, 128, 129, 500])
def test_at_most_64_fitted_views_are_measured_and_as_many_as_that_allows(monkeypatch, number):
    measured = []

    def psnr_of(run, photographs, cameras):
        assert [camera.stem for camera in cameras] == photographs
        measured.extend(photographs)
        return [30.0] * len(photographs)

    monkeypatch.setattr(loop.Loop, "_psnr_of", psnr_of)
    run = loop.Loop(FitSettings(), list(range(number)), [], 1.0, torch.device("cpu"), RunLog())
    monkeypatch.setattr(run, "cameras", lambda: [SimpleNamespace(stem=k) for k in range(number)])
    assert run.measure_fitted() == 30.0
    every = next(n for n in count(1) if len(range(0, number, n)) <= 64)
    assert measured == list(range(0, number, every))


def test_a_resumed_run_counts_the_seconds_before(boards, tmp_path):
    path, settings = tmp_path / "run.checkpoint", FitSettings(steps=6, cap=1300, sh_degree=0, evaluate_every=3)
    options = {"checkpoint": path, "keep_checkpoint": True}
    points = load_points(boards.folder)
    first = fit(boards.views[1:], points, boards.views[:1], settings, **options)
    saved = torch.load(path, weights_only=True)
    assert saved["seconds"] == first.curve[-1].seconds > 0
    torch.save({**saved, "step": 5, "seconds": 1000.0}, path)
    resumed = fit(boards.views[1:], points, boards.views[:1], settings, **options, resume=True)
    assert 1000.0 < resumed.curve[-1].seconds < 1100.0
    assert [point.step for point in resumed.curve] == [3, 6]


def test_depth_of_floats_is_in_meters_and_of_whole_numbers_in_the_unit(boards, tmp_path):
    """Of whichever file: PNG, integers in NPY, and NPY of any floating point type."""
    views = boards.views[:5]
    shape, stems = views[0].camera.size, [view.stem for view in views]
    for stem, kind, value in zip(stems[:4], ("f4", "f8", "u2", "i8"), (2.5, 2.5, 2500, 2500), strict=True):
        np.save(tmp_path / f"{stem}.npy", np.full(shape, value, kind))
    write_ids(tmp_path / f"{stems[4]}.png", np.full(shape, 2500, np.uint16))
    depth = depth_from_folder(tmp_path, views)
    for view in views:
        np.testing.assert_allclose(depth(view), 2.5, rtol=1e-6)


def test_every_photograph_has_steps_of_its_own():
    """The first step of Adam is the rate, however many steps the parameters of others have taken."""
    rows = PerPhotograph(torch.zeros(3, 2), rate=0.1, last_rate=0.1)
    for _ in range(7):
        rows.update(0, torch.ones(2), 0.0)
    rows.update(2, torch.tensor([5.0, -0.01]), 0.0)
    torch.testing.assert_close(rows.group.parameters[2], torch.tensor([-0.1, 0.1]), rtol=1e-3, atol=0)
    torch.testing.assert_close(rows.group.parameters[0], torch.full((2,), -0.7), rtol=1e-3, atol=0)
    assert not rows.group.parameters[1].any()
    assert rows.steps.tolist() == [7, 0, 1]


def test_what_all_photographs_share_belongs_to_the_scene():
    """A factor of all exposures and a motion of all cameras leave no trace; what one has beyond them stays."""
    exposure = Exposure(3, torch.device("cpu"))
    exposure.group.parameters += 0.25
    for index in range(3):
        torch.testing.assert_close(exposure.leaf(index).detach(), torch.eye(3, 4))
    exposure.group.parameters[1] += 0.3
    sums = sum(exposure.leaf(index).detach() for index in range(3))
    torch.testing.assert_close(sums, 3 * torch.eye(3, 4))
    torch.testing.assert_close(exposure.leaf(1).detach(), torch.eye(3, 4) + 0.2)


@pytest.mark.parametrize(("behind", "unseen"), [(True, 4), (False, 0)])
def test_updates_that_were_left_out_are_counted(boards, behind, unseen):
    """Four Gaussians, all of them behind the cameras or all in front: in each of three steps."""
    blank = Gaussians(*(torch.full((4, *shape), 0.1) for shape in ((3,), (4,), (3,), (), (1, 3))))
    means = torch.tensor([[0.0, 0.0, -50.0 if behind else 3.0]]).expand(4, 3)
    log = RunLog()
    settings = FitSettings(steps=3, strategy="default", cap=1300, sh_degree=0)
    run = loop.Loop(settings, read_photographs(boards.views[:3]), [], 1.0, torch.device("cpu"), log)
    run.begin(replace(blank, means=means))
    assert run.go(lambda *call: None, None, 1000, lambda: False)
    assert log.left_out.get("updates_of_unseen_gaussians", 0) == 3 * unseen


def test_the_frame_lies_around_the_mean_of_the_cameras(boards):
    views = [boards.views[k] for k in (0, 1, 4)]
    places = torch.stack([view.camera.position for view in views])
    frame = Frame.around(views)
    torch.testing.assert_close(frame.origin, places.mean(dim=0))
    moved = torch.stack([frame.view(view).camera.position for view in views])
    torch.testing.assert_close(moved.mean(dim=0), torch.zeros(3, dtype=torch.float64), rtol=0, atol=1e-9)
