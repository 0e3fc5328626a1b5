"""The whole fit on a small stage: quality, bits, checkpoints and interruptions."""

import math
import os
import signal
import subprocess
import sys
import textwrap
import time
from dataclasses import asdict, replace
from pathlib import Path

import pytest
import torch

from sgwarp.errors import InputError
from sgwarp.io.points import load_points
from sgwarp.io.scenes import load_gaussians
from sgwarp.ops import launcher
from sgwarp.reconstruction.fitting.checkpoint import Checkpoint, fingerprint
from sgwarp.reconstruction.fitting.exposure import Exposure
from sgwarp.reconstruction.fitting.model import Model
from sgwarp.reconstruction.fitting.photographs import read_photographs
from sgwarp.reconstruction.fitting.settings import FitSettings
from sgwarp.reconstruction.fitting.trainer import Fitted, fit
from sgwarp.runs.log import RunLog
from sgwarp.scene import Gaussians, View

pytestmark = pytest.mark.slow

# Short enough for a test, and with every event of a long run: refinements, and a rise of the degree.
QUICK = FitSettings(steps=160, cap=1300, refine_every=20, degree_every=60, evaluate_every=80, sh_degree=2)


def short_fit(boards, settings: FitSettings, **options) -> Fitted:
    views = boards.views
    return fit(views[1:], load_points(boards.folder), views[:1], settings, **options)


def same_bits(one: Gaussians, other: Gaussians) -> bool:
    return all(torch.equal(getattr(one, n), getattr(other, n)) for n in ("means", "quats", "scales", "opacities", "sh"))


@pytest.fixture(scope="module", params=["mcmc", "default"])
def fitted(request, boards) -> tuple[FitSettings, Fitted, RunLog]:
    settings, log = replace(QUICK, strategy=request.param), RunLog()
    return settings, short_fit(boards, settings, log=log), log


def test_a_fit_gets_better_and_says_so(fitted):
    settings, result, log = fitted
    assert result.complete
    assert [point.step for point in result.curve] == [80, 160]
    assert result.curve[-1].psnr == pytest.approx(result.held_out["0000"])
    assert result.held_out["0000"] > 20
    assert result.curve[-1].loss < result.curve[0].loss
    assert 0 < result.curve[0].seconds < result.curve[1].seconds
    assert len(result.gaussians) == result.curve[-1].count <= settings.cap
    assert len(result.gaussians) > 1035 or settings.strategy == "default"
    assert result.gaussians.sh_degree == 2
    assert not result.gaussians.non_finite
    assert set(log.stages) == {"read", "start", "fit", "measure"}
    assert log.left_out["updates_of_unseen_gaussians"] > 1000


def test_the_same_seed_gives_the_same_bits_and_another_does_not(fitted, boards):
    settings, result, _ = fitted
    assert same_bits(short_fit(boards, settings).gaussians, result.gaussians)
    assert not same_bits(short_fit(boards, replace(settings, seed=1)).gaussians, result.gaussians)


def test_the_number_of_threads_does_not_change_a_bit(fitted, boards):
    settings, result, _ = fitted
    before = launcher.get_threads(), torch.get_num_threads()
    try:
        launcher.set_threads(3)
        torch.set_num_threads(1)
        assert same_bits(short_fit(boards, settings).gaussians, result.gaussians)
    finally:
        launcher.set_threads(before[0])
        torch.set_num_threads(before[1])


WORKER = textwrap.dedent(
    """
    import sys
    from pathlib import Path
    from sgwarp.reconstruction.fitting.trainer import fit
    from sgwarp.reconstruction.fitting.settings import FitSettings
    from sgwarp.io.points import load_points
    from sgwarp.io.views import load_views

    folder, checkpoint, settings = Path(sys.argv[1]), Path(sys.argv[2]), FitSettings(**eval(sys.argv[3]))
    views = load_views(folder)
    print("started", flush=True)
    fit(views[1:], load_points(folder), views[:1], settings, checkpoint=checkpoint, checkpoint_every=25)
    """
)


def killed(boards, settings: FitSettings, path: Path, number: int) -> None:
    """Run in a process of its own and kill that once there is a checkpoint."""
    command = [sys.executable, "-c", WORKER, str(boards.folder), str(path), repr(asdict(settings))]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    until = time.monotonic() + 300
    while not path.exists():
        if process.poll() is not None:
            pytest.fail(process.stderr.read())
        if time.monotonic() > until:
            process.kill()
            pytest.fail("no checkpoint after five minutes")
        time.sleep(0.005)
    process.send_signal(number)
    process.communicate(timeout=60)
    assert process.returncode == -number


def test_killed_and_resumed_is_the_same_as_never_stopped(fitted, boards, tmp_path):
    settings, result, _ = fitted
    path = tmp_path / "run.checkpoint"
    killed(boards, settings, path, signal.SIGKILL)
    assert 0 < torch.load(path, weights_only=True)["step"] < settings.steps
    resumed = short_fit(boards, settings, checkpoint=path, resume=True)
    assert same_bits(resumed.gaussians, result.gaussians)
    assert [(p.step, p.psnr, p.loss, p.count) for p in resumed.curve] == [
        (p.step, p.psnr, p.loss, p.count) for p in result.curve
    ]
    assert not path.exists(), "a complete run leaves no checkpoint"


def test_ctrl_c_stops_between_steps_and_can_be_resumed(fitted, boards, tmp_path):
    settings, result, _ = fitted
    path = tmp_path / "run.checkpoint"

    def press(done: int, total: int, text: str) -> None:
        if done == 90:
            os.kill(os.getpid(), signal.SIGINT)

    handler = signal.getsignal(signal.SIGINT)
    stopped = short_fit(boards, settings, checkpoint=path, progress=press)
    assert signal.getsignal(signal.SIGINT) is handler
    assert not stopped.complete
    assert stopped.curve[-1].step in (90, 91)
    assert len(stopped.gaussians)
    resumed = short_fit(boards, settings, checkpoint=path, resume=True)
    assert same_bits(resumed.gaussians, result.gaussians)


def test_sparse_updates_cost_no_quality(fitted, boards):
    settings, result, _ = fitted
    log = RunLog()
    dense = short_fit(boards, replace(settings, sparse=False), log=log)
    assert "updates_of_unseen_gaussians" not in log.left_out
    assert abs(dense.held_out["0000"] - result.held_out["0000"]) < 0.5  # the sets they grow to differ


def test_what_is_reported(boards):
    seen = []
    short_fit(boards, replace(QUICK, steps=20), progress=lambda *report: seen.append(report))
    assert [done for done, _, _ in seen] == [0, 10, 20]
    assert all(total == 20 for _, total, _ in seen)
    assert "it/s" in seen[-1][2]
    assert "Gaussians" in seen[-1][2]


@pytest.mark.parametrize("background", ["black", "white"])
def test_backgrounds(boards, background):
    """Photographs whose upper half shows nothing but the background."""

    def cut(pixels):
        pixels = pixels.copy()
        pixels[:24] = 255 if background == "white" else 0
        return pixels

    views = [View(v.stem, v.camera, v.image_path, undistort=cut) for v in boards.views]
    positions, colours = load_points(boards.folder)
    below = positions[:, 1] > 0
    settings = replace(QUICK, steps=60, background=background)
    result = fit(views[1:], (positions[below], colours[below]), views[:1], settings)
    assert result.held_out["0000"] > 13


def test_exposure_follows_photographs_that_were_developed_differently(boards):
    factors = {f"{k:04d}": 0.6 + 0.1 * k for k in range(8)}

    def developed(view: View) -> View:
        def develop(pixels):
            return (pixels * min(factors[view.stem], 1.1) * 0.8).round().clip(0, 255).astype("uint8")

        return View(view.stem, view.camera, view.image_path, undistort=develop)

    views = [developed(view) for view in boards.views]
    start, settings = load_points(boards.folder), replace(QUICK, strategy="default")
    plain, adjusted = (fit(views, start, (), replace(settings, exposure=e)).curve[-1].loss for e in (False, True))
    assert adjusted < 0.9 * plain


def test_the_mean_exposure_is_held():
    exposure = Exposure(3, torch.device("cpu"))
    for step in range(20):
        exposure.update(step % 3, torch.full((3, 4), 1.0), step / 20)
    maps = torch.stack([exposure.leaf(index).detach() for index in range(3)])
    torch.testing.assert_close(maps.mean(dim=0), torch.eye(3, 4))
    assert not torch.equal(exposure.group.parameters[0], torch.eye(3, 4))


def test_checkpoints_belong_to_one_run(boards, tmp_path):
    views, path = boards.views, tmp_path / "run.checkpoint"
    photographs = read_photographs(views)
    shapes = ((3,), (4,), (3,), (), (1, 3))
    model = Model.starting(Gaussians(*(torch.full((4, *shape), 0.5) for shape in shapes))).state()
    state = Checkpoint(asdict(QUICK), fingerprint(photographs, []), 5, 1.0, model, {}, {}, {}, [[0.0, 0.0]])
    state.save(path)
    device = torch.device("cpu")
    assert Checkpoint.load(path, QUICK, fingerprint(photographs, []), device).step == 5
    with pytest.raises(InputError, match="that run had cap = 1300, this one 7; give the same"):
        Checkpoint.load(path, replace(QUICK, cap=7), fingerprint(photographs, []), device)
    with pytest.raises(InputError, match="that run had other photographs"):
        Checkpoint.load(path, QUICK, fingerprint(photographs[1:], photographs[:1]), device)
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(InputError, match="is not a checkpoint, or is damaged; start again without --resume"):
        Checkpoint.load(path, QUICK, fingerprint(photographs, []), device)
    torch.save({"format": 0}, path)
    with pytest.raises(InputError, match="was written by another version"):
        Checkpoint.load(path, QUICK, fingerprint(photographs, []), device)
    with pytest.raises(InputError, match=r"missing\.checkpoint: no such file"):
        short_fit(boards, QUICK, checkpoint=tmp_path / "missing.checkpoint", resume=True)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"steps": 0}, "steps: expected at least 1"),
        ({"cap": 0}, "cap: expected at least 1"),
        ({"strategy": "best"}, "strategy: 'best' is not one of default, mcmc"),
        ({"background": "blue"}, "background: 'blue' is not one of black, white, random"),
        ({"sh_degree": 4}, "sh_degree: expected 0 to 3"),
        ({"similarity_share": 1.5}, "similarity_share: expected 0 to 1"),
        ({"scales_rate": math.nan}, "scales_rate: expected a number that is not negative"),
    ],
)
def test_settings_are_checked(change, message):
    with pytest.raises(InputError, match=message):
        FitSettings(**change)


@pytest.mark.parametrize(
    "name", ["opacities_rate", "scale_pull", "noise", "grow_gradient", "split_scale", "least_opacity"]
)
def test_rates_and_thresholds_are_not_negative(name):
    with pytest.raises(InputError, match=f"{name}: expected a number that is not negative, got -1"):
        FitSettings(**{name: -1.0})
    assert getattr(FitSettings(**{name: 0.0}), name) == 0.0


def test_the_ends_of_a_range_belong_to_it():
    for share in (0.0, 1.0):
        assert FitSettings(similarity_share=share).similarity_share == share
    for degree in (0, 3):
        assert FitSettings(sh_degree=degree).sh_degree == degree


def test_schedules():
    settings = FitSettings(steps=6000)
    assert settings.means_rate_at(0, 2.0) == pytest.approx(3.2e-4)
    assert settings.means_rate_at(6000, 2.0) == pytest.approx(3.2e-6)
    assert settings.means_rate_at(3000, 2.0) == pytest.approx(3.2e-5)
    steady = FitSettings(steps=6000, last_means_rate=0.0)  # nothing falls exponentially to 0
    assert [steady.means_rate_at(step, 2.0) for step in (0, 6000)] == pytest.approx([3.2e-4] * 2)
    assert [settings.degree_at(step) for step in (0, 999, 1000, 2500, 5900)] == [0, 0, 1, 2, 3]
    assert settings.scaled(15_000) == 3000


def test_a_scene_can_be_fitted_further(boards, tmp_path):
    views = boards.views
    first = short_fit(boards, replace(QUICK, steps=40))
    from sgwarp.io.scenes import save_gaussians

    save_gaussians(first.gaussians, tmp_path / "scene.ply")
    scene = load_gaussians(tmp_path / "scene.ply")
    further = fit(views[1:], scene, views[:1], replace(QUICK, steps=40))
    assert further.held_out["0000"] > first.held_out["0000"]
    with pytest.raises(InputError, match="more than the cap 50"):
        fit(views[1:], scene, views[:1], replace(QUICK, cap=50))
