"""What a fit is told reaches the place where it acts: rates, noise, resets, backgrounds, schedules, masks, order."""

import math
from copy import deepcopy
from dataclasses import replace

import pytest
import torch

from sgwarp.io.points import load_points
from sgwarp.ops.adam import count_steps
from sgwarp.reconstruction.fitting import loop, trainer
from sgwarp.reconstruction.fitting.checkpoint import fingerprint
from sgwarp.reconstruction.fitting.densify import FAINT, Densify
from sgwarp.reconstruction.fitting.exposure import Exposure
from sgwarp.reconstruction.fitting.frame import Frame
from sgwarp.reconstruction.fitting.mcmc import MarkovChain
from sgwarp.reconstruction.fitting.model import Gradients, Model
from sgwarp.reconstruction.fitting.photographs import read_photographs
from sgwarp.reconstruction.fitting.settings import FitSettings
from sgwarp.reconstruction.fitting.trainer import fit
from sgwarp.runs.log import RunLog
from sgwarp.scene import Camera, Gaussians

CAMERA = Camera(torch.tensor([[40.0, 0, 20], [0, 40, 20], [0, 0, 1]]), torch.eye(4), 40, 40)
SHORT = FitSettings(steps=12, cap=1300, refine_every=4, degree_every=6, evaluate_every=4, sh_degree=1)
CPU = torch.device("cpu")
PHOTOGRAPHS = 1000  # so many that nothing goes unseen for long


def cloud(count: int, opacity: float = 0.5) -> Model:
    random = torch.Generator().manual_seed(0)
    return Model.starting(
        Gaussians(
            means=torch.randn(count, 3, generator=random),
            quats=torch.randn(count, 4, generator=random),
            scales=0.01 + 0.02 * torch.rand(count, 3, generator=random),
            opacities=torch.full((count,), opacity),
            sh=torch.randn(count, 4, 3, generator=random),
        )
    )


def gradients_of(model: Model, value: float = 0.0) -> Gradients:
    fields = {name: torch.full_like(model[name], value) for name in model.groups}
    return Gradients(**fields, means2d=torch.zeros(len(model), 2))


def after(strategy: Densify | MarkovChain, model: Model, step: int) -> None:
    """A step that shows all Gaussians and wants none of them to move."""
    steps, skipped = (torch.zeros(len(model), dtype=torch.int32) for _ in range(2))
    taken = count_steps(torch.ones(len(model)), torch.zeros(len(model), 1, 3), steps, skipped, sparse=True)
    strategy.after_step(model, step, gradients_of(model), taken, CAMERA)


# Rates of the optimiser. The first step of Adam is the rate, whatever the gradient.


def test_every_parameter_has_its_rate():
    settings = FitSettings(scales_rate=0.003, quats_rate=0.004, opacities_rate=0.005, colors_rate=0.02)
    model = cloud(5)
    before = {name: group.parameters.clone() for name, group in model.groups.items()}
    model.update(gradients_of(model, 1.0), 0.001, replace(settings, opacity_pull=0.0, scale_pull=0.0))
    step = {name: before[name] - group.parameters for name, group in model.groups.items()}
    rates = {"means": 0.001, "quats": 0.004, "scales": 0.003, "opacities": 0.005}
    for name, rate in rates.items():
        torch.testing.assert_close(step[name], torch.full_like(step[name], rate), rtol=1e-3, atol=1e-6)
    expected = torch.full((5, 4, 3), 0.02 / 20)  # beyond degree 0
    expected[:, 0] = 0.02
    torch.testing.assert_close(step["sh"], expected, rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("strategy", ["mcmc", "default"])
def test_the_markov_chain_pulls_opacities_and_scales_down(strategy):
    """The mean opacity and the mean of the 3 N scales in the loss, by the chain rule of sigmoid and exponential."""
    count, opacity = 8, 0.4
    model = cloud(count, opacity)
    scales = model["scales"].clone()
    model.update(gradients_of(model), 0.0, FitSettings(strategy=strategy, sparse=False))
    share = 0.1 * (strategy == "mcmc")  # 1 - beta_1: how much of a gradient its mean takes over at once
    pull = 0.01 / count * opacity * (1 - opacity)
    means = {"opacities": torch.full((count,), share * pull), "scales": share * 0.01 / (3 * count) * scales}
    for name, expected in means.items():
        torch.testing.assert_close(model.groups[name].first, expected, rtol=1e-4, atol=0)


def test_the_rate_of_an_exposure_falls():
    for share, rate in ((0.0, 0.01), (0.5, math.sqrt(0.01 * 0.001)), (1.0, 0.001)):
        exposure = Exposure(2, CPU)
        exposure.update(1, torch.ones(3, 4), share)
        moved = torch.eye(3, 4) - exposure.group.parameters
        torch.testing.assert_close(moved[1], torch.full((3, 4), rate), rtol=1e-3, atol=1e-6)
        assert not moved[0].any()


# The Markov chain.


@pytest.mark.parametrize("name", ["maps", "first", "second", "steps"])
def test_exposures_of_other_photographs_are_refused(name):
    """Of another number, or of another type, which the kernel would read as other bits."""
    state = Exposure(3, CPU).state()
    assert set(state) == {"maps", "first", "second", "steps"}
    for other in (state[name][:2], state[name].to(torch.float64)):
        with pytest.raises(ValueError, match="of other photographs"):
            Exposure(3, CPU).restore(state | {name: other})
    Exposure(3, CPU).restore(state)


def test_faint_gaussians_move_at_random():
    settings = FitSettings(strategy="mcmc", steps=30_000, cap=20)

    def moved(extent: float, noise: float, step: int) -> torch.Tensor:
        model = cloud(20, 0.006)
        before = model["means"].clone()
        after(MarkovChain(replace(settings, noise=noise), extent, PHOTOGRAPHS), model, step)
        return model["means"] - before

    assert not moved(1.0, 0.0, 50).any()
    first = moved(1.0, 5e5, 50)
    assert (first != 0).any(dim=1).all()
    torch.testing.assert_close(moved(2.0, 5e5, 50), 2 * first, atol=1e-6, rtol=1e-2)
    torch.testing.assert_close(moved(1.0, 1e6, 50), 2 * first, atol=1e-6, rtol=1e-2)
    assert moved(1.0, 5e5, 29_999).abs().max() < 0.02 * first.abs().max()  # the rate of the centres has fallen
    assert not torch.equal(moved(1.0, 5e5, 51).sign(), first.sign())


@pytest.mark.parametrize("event", ["relocate", "grow"])
def test_hosts_and_their_copies_shrink_to_keep_the_picture(event):
    """Along a line through the centre, the copies' blended opacity has the integral of the original's."""
    model = cloud(20, 0.5)
    if event == "relocate":
        model.groups["opacities"].values[0] = 0.004
    for group in model.groups.values():
        group.first.fill_(0.1)
        group.second.fill_(0.1)
    model.steps.fill_(7)
    before = model.gaussians()
    cap = 20 if event == "relocate" else 21
    after(MarkovChain(FitSettings(strategy="mcmc", steps=30_000, cap=cap, noise=0.0), 1.0, PHOTOGRAPHS), model, 600)
    assert len(model) == cap
    copy = 0 if event == "relocate" else 20
    (host,) = [row for row in range(20) if row != copy and torch.equal(model["means"][row], model["means"][copy])]
    factor = (model["scales"][host] / before.scales[host]).double()
    x = torch.linspace(-12, 12, 20_001, dtype=torch.float64)
    alpha = model["opacities"][host].double() * torch.exp(-0.5 * (x / factor[0]) ** 2)
    integral = torch.trapezoid(1 - (1 - alpha) ** 2, x)
    assert integral.item() == pytest.approx(0.5 * math.sqrt(2 * math.pi), rel=1e-5)
    torch.testing.assert_close(factor, factor[:1].expand(3), rtol=1e-5, atol=0)
    torch.testing.assert_close(model["scales"][copy], model["scales"][host])
    rest = [row for row in range(1, 20) if row != host]
    torch.testing.assert_close(model["scales"][rest], before.scales[rest], rtol=1e-6, atol=0)
    for group in model.groups.values():
        assert not group.first[[host, copy]].any()
        assert not group.second[[host, copy]].any()
        assert group.first[rest].any()
    assert not model.steps[[host, copy]].any()
    assert (model.steps[rest] == 7).all()


@pytest.mark.parametrize(("opacity", "moves"), [(0.0049, True), (0.0051, False)])
def test_what_is_dead_moves(opacity, moves):
    model = cloud(20, 0.5)
    model.groups["opacities"].values[3] = opacity
    before = model["means"].clone()
    settings = FitSettings(strategy="mcmc", steps=30_000, cap=20, noise=0.0)
    after(MarkovChain(settings, 1.0, PHOTOGRAPHS), model, 600)
    assert bool((model["means"][3] != before[3]).any()) == moves


@pytest.mark.parametrize(("step", "grows"), [(500, False), (600, True), (24_900, True), (25_000, False)])
def test_the_chain_refines_at_its_times(step, grows):
    model = cloud(20)
    after(MarkovChain(FitSettings(strategy="mcmc", steps=30_000, cap=21), 1.0, PHOTOGRAPHS), model, step)
    assert (len(model) > 20) == grows


# Adaptive density control.


@pytest.mark.parametrize(("step", "resets"), [(2_900, False), (3_000, True), (3_100, False), (6_000, True)])
def test_opacities_are_reset_at_their_times(step, resets):
    model = cloud(4, 0.9)
    for moment in ("first", "second"):
        getattr(model.groups["opacities"], moment).fill_(0.5)
    after(Densify(FitSettings(strategy="default", steps=30_000), 1.0, PHOTOGRAPHS, 4, CPU), model, step)
    torch.testing.assert_close(model["opacities"], torch.full((4,), FAINT if resets else 0.9))
    for moment in ("first", "second"):
        assert getattr(model.groups["opacities"], moment).any() != resets


def test_resets_of_short_runs_leave_time_to_recover():
    """A tenth of the reference's steps, but no reset before 1,000 of them."""
    settings = FitSettings(strategy="default", steps=3_000, refine_every=100)
    for step, resets in ((300, False), (1_000, True)):
        model = cloud(4, 0.9)
        after(Densify(settings, 1.0, PHOTOGRAPHS, 4, CPU), model, step)
        assert bool((model["opacities"] < 0.5).all()) == resets


@pytest.mark.parametrize(("extent", "count"), [(1.0, 5), (4.0, 5)])
def test_what_is_large_depends_on_the_extent(extent, count):
    """Scales of 0.02: of a scene of size 1 that is split into smaller ones, of one of size 4 it is cloned."""
    model = cloud(4)
    model.groups["scales"].values.fill_(0.02)
    model.groups["scales"].parameters.fill_(math.log(0.02))
    strategy = Densify(FitSettings(strategy="default", steps=30_000), extent, PHOTOGRAPHS, 4, CPU)
    strategy.sums[1], strategy.views[1] = 1.0, 1
    after(strategy, model, 600)
    assert len(model) == count
    assert bool((model["scales"] < 0.019).any()) == (extent == 1.0)
    assert len(strategy.sums) == len(strategy.views) == count  # and it starts to count anew
    assert not strategy.sums.any()
    assert not strategy.views.any()


def test_a_split_halves_keep_shape_and_place():
    """The children scatter like the Gaussian itself: many of them have its covariance about its centre."""
    count = 4000
    model = cloud(1)
    model.keep(torch.zeros(count, dtype=torch.int64))
    parent = model.gaussians()
    strategy = Densify(FitSettings(strategy="default", steps=30_000, cap=3 * count), 1.0, PHOTOGRAPHS, count, CPU)
    strategy._split(model, torch.arange(count), 600)
    children = model.gaussians().means[count:].double() - parent.means[0].double()
    w, x, y, z = parent.quats[0].double().tolist()
    R = torch.tensor(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ],
        dtype=torch.float64,
    )
    expected = R @ torch.diag(parent.scales[0].double() ** 2) @ R.T
    size = expected.diagonal().max().item()
    torch.testing.assert_close(children.T @ children / len(children), expected, rtol=0, atol=0.06 * size)


# The loop.


def short_fit(boards, settings: FitSettings = SHORT, **options):
    views = boards.views
    return fit(views[1:], load_points(boards.folder), views[:1], settings, **options)


@pytest.fixture
def spied(monkeypatch):
    """Names and arguments of what the loop calls, in order."""
    calls: list[tuple[str, tuple, dict]] = []

    def spy(owner, name):
        original = getattr(owner, name)

        def called(*arguments, **options):
            first = arguments[0].step if name == "measure" else arguments[0]  # which moves on
            calls.append((name, (first, *arguments[1:]), options))
            return original(*arguments, **options)

        monkeypatch.setattr(owner, name, called)

    spy(loop, "rasterize_with_gradients")
    spy(loop, "photometric_loss")
    spy(loop, "psnr")
    spy(loop.Loop, "measure")
    spy(Model, "update")
    spy(MarkovChain, "after_step")
    spy(Exposure, "update")
    return calls


@pytest.mark.parametrize("background", ["black", "white", "random"])
def test_the_background_of_a_step(boards, spied, background):
    short_fit(boards, replace(SHORT, background=background))
    given = [options["background"] for name, _, options in spied if name == "rasterize_with_gradients"]
    assert len(given) == SHORT.steps
    if background == "black":
        assert given == [None] * SHORT.steps
        return
    colours = torch.stack(given)
    assert colours.shape == (SHORT.steps, 3)
    if background == "white":
        assert (colours == 1).all()
    else:
        assert len(colours.unique(dim=0)) == SHORT.steps
        assert ((colours >= 0) & (colours < 1)).all()
        assert colours.std(dim=0).min() > 0.1


def test_transparent_photographs_show_the_background_of_the_step(boards, spied, monkeypatch):
    original = trainer.read_photographs

    def transparent(views, **options):
        found = original(views, **options)
        return [replace(p, stored_alpha=torch.zeros(p.camera.size, dtype=torch.uint8)) for p in found]

    monkeypatch.setattr(trainer, "read_photographs", transparent)
    short_fit(boards, replace(SHORT, steps=4, background="random"))
    backgrounds = [options["background"] for name, _, options in spied if name == "rasterize_with_gradients"]
    truths = [arguments[1] for name, arguments, _ in spied if name == "photometric_loss"]
    for background, truth in zip(backgrounds, truths, strict=True):
        assert torch.equal(truth, background.expand_as(truth))


def test_measured_before_the_refinement(boards, spied):
    short_fit(boards)
    order = [
        (name, arguments[0] if name == "measure" else arguments[2])
        for name, arguments, _ in spied
        if name in ("measure", "after_step")
    ]
    assert [entry for entry in order if entry[1] in (4, 8, 12)] == [
        *(("measure", 4), ("after_step", 4)),
        *(("measure", 8), ("after_step", 8)),
        *(("after_step", 12), ("measure", 12)),  # the last measurement is of what is returned
    ]


def test_near_and_far_reach_the_rasterizer(boards, spied):
    views = [replace(view, camera=replace(view.camera, near=0.002, far=50.0)) for view in boards.views]
    fit(views[1:], load_points(boards.folder), (), replace(SHORT, steps=2))
    cameras = [Frame.around(views[1:]).camera(view.camera) for view in views[1:]]
    reached = [(options["near"], options["far"]) for name, _, options in spied if name == "rasterize_with_gradients"]
    assert reached == [(cameras[0].near, cameras[0].far)] * 2
    assert cameras[0].near < 0.005


def test_the_degree_of_the_colors_stays_below_its_limit():
    settings = FitSettings(sh_degree=2, degree_every=3)
    assert [settings.degree_at(step) for step in (0, 2, 3, 6, 9, 100)] == [0, 0, 1, 2, 2, 2]


@pytest.mark.parametrize("background", ["black", "white"])
def test_the_background_of_what_is_measured(boards, spied, background):
    """Transparent where nothing is: Gaussians behind the cameras show nothing at all."""
    blank = Gaussians(*(torch.full((4, *shape), 0.1) for shape in ((3,), (4,), (3,), (), (1, 3))))
    run = loop.Loop(replace(SHORT, background=background), read_photographs(boards.views[:2]), [], 1.0, CPU, RunLog())
    run.begin(replace(blank, means=blank.means - 50.0))
    run.measure_fitted()
    shown = [args[0] for name, args, _ in spied if name == "psnr"]
    assert len(shown) == 2
    assert all(torch.equal(image, torch.full_like(image, float(background == "white"))) for image in shown)


def test_exposures_follow_the_share_of_the_run(boards, spied):
    short_fit(boards, replace(SHORT, exposure=True))
    shares = [arguments[3] for name, arguments, _ in spied if name == "update" and isinstance(arguments[0], Exposure)]
    assert shares == pytest.approx([step / 12 for step in range(12)])


def test_the_loss_has_its_share_of_similarity(boards, spied):
    short_fit(boards, replace(SHORT, similarity_share=0.7))
    assert {arguments[2] for name, arguments, _ in spied if name == "photometric_loss"} == {0.7}


def test_cameras_of_the_steps(boards, spied):
    """All photographs in turn, in an order that the seed decides."""

    def poses(seed: int) -> list[tuple[float, ...]]:
        spied.clear()
        short_fit(boards, replace(SHORT, seed=seed, steps=14))
        found = [args[4] for name, args, _ in spied if name == "rasterize_with_gradients"]
        return [tuple(pose.flatten().tolist()) for pose in found]

    one, other = poses(0), poses(1)
    for turns in (one, other):
        assert len(set(turns[:7])) == 7
        assert set(turns[:7]) == set(turns[7:])
    assert set(one) == set(other)
    assert one != other


def test_rates_of_the_centres_fall_in_the_loop(boards, spied):
    short_fit(boards)
    rates = [args[2] for name, args, _ in spied if name == "update" and isinstance(args[0], Model)]
    assert len(rates) == 12
    for step, rate in enumerate(rates):
        assert rate / rates[0] == pytest.approx(0.01 ** (step / 12))


def test_what_is_measured(boards, spied):
    """Held-out views with their masks, before the background of the run."""
    mask = torch.ones(48, 64, dtype=torch.bool)
    mask[:, :9] = False
    short_fit(boards, replace(SHORT, steps=4, background="white"), masks=lambda view: mask)
    measured = [args for name, args, _ in spied if name == "psnr"]
    assert measured
    assert all(torch.equal(args[2], mask) for args in measured)
    assert measured[-1][0][:4].min() > 0.05  # nothing of the scene there: white, and not black


def test_the_loss_that_is_reported_is_smooth(boards, monkeypatch):
    values: list[float] = []
    original = loop.photometric_loss

    def noted(*arguments):
        loss = original(*arguments)
        values.append(float(loss.detach()))
        return loss

    monkeypatch.setattr(loop, "photometric_loss", noted)
    result = short_fit(boards)
    smooth = values[0]
    for value in values[1:]:
        smooth = 0.99 * smooth + 0.01 * value
    assert result.curve[-1].loss == pytest.approx(smooth)


def test_rotations_are_returned_as_unit_quaternions(boards):
    quats = short_fit(boards).gaussians.quats
    torch.testing.assert_close(quats.norm(dim=1), torch.ones(len(quats)))


def test_a_checkpoint_brings_everything_back(boards, tmp_path, monkeypatch):
    """A resumed run has the model, the exposures and the strategy's counts as they were saved."""
    path = tmp_path / "run.checkpoint"
    settings = replace(SHORT, exposure=True, refine_poses=True, strategy="default")
    short_fit(boards, settings, checkpoint=path, keep_checkpoint=True)
    saved = torch.load(path, weights_only=True)
    restored = {}
    original = loop.Loop.restore

    def restore(run, *arguments):
        original(run, *arguments)
        # Copied at once: the end of a run removes Gaussians that no camera sees.
        parts = ("model", "strategy", "exposure", "poses")
        restored.update({part: deepcopy(getattr(run, part).state()) for part in parts})

    monkeypatch.setattr(loop.Loop, "restore", restore)
    short_fit(boards, settings, checkpoint=path, keep_checkpoint=True, resume=True)  # no step is left to take
    assert set(restored) == {"model", "strategy", "exposure", "poses"}
    for part, state in restored.items():
        assert state.keys() == saved[part].keys()
        assert all(torch.equal(state[name], saved[part][name]) for name in state), part
    assert saved["exposure"]["maps"].std(dim=0).any()
    assert saved["poses"]["maps"].std(dim=0).all()
    assert saved["strategy"]["views"].any()


def test_degrees_rise_in_the_loop(boards, spied):
    short_fit(boards)
    counts = [options["sh"].shape[1] for name, _, options in spied if name == "rasterize_with_gradients"]
    assert counts == [1] * 6 + [4] * 6


def test_masked_pixels_teach_nothing(boards, spied):
    """What is outside the mask gets the photograph's own colour, so that it makes no difference."""
    mask = torch.zeros(48, 64, dtype=torch.bool)
    mask[:, 20:] = True
    short_fit(boards, replace(SHORT, steps=2), masks={view.stem: mask for view in boards.views})
    images = [arguments[:2] for name, arguments, _ in spied if name == "photometric_loss"]
    assert len(images) == 2
    for image, truth in images:
        assert torch.equal(image[:, :20], truth[:, :20])
        assert not torch.equal(image[:, 20:], truth[:, 20:])


def test_masks_belong_to_the_run(boards):
    """A checkpoint is not resumed with other masks."""
    views, mask = boards.views[:3], torch.ones(48, 64)
    plain = fingerprint(read_photographs(views), [])
    whole = fingerprint(read_photographs(views, masks=lambda view: mask), [])
    mask[0, 0] = 0
    partly = fingerprint(read_photographs(views, masks=lambda view: mask), [])
    assert len({plain, whole, partly}) == 3
    assert fingerprint([], read_photographs(views)) != plain
