"""How Gaussians come and go: clone, split, remove and reset; relocation, growth and what they leave unchanged."""

import math

import pytest
import torch

from sgwarp.ops.adam import Taken, count_steps
from sgwarp.reconstruction.fitting.densify import FAINT, Densify, reset_opacities
from sgwarp.reconstruction.fitting.mcmc import MarkovChain, shared_opacity_and_scale
from sgwarp.reconstruction.fitting.model import Gradients, Model
from sgwarp.reconstruction.fitting.settings import FitSettings
from sgwarp.runs.seeds import generator, number, view_at
from sgwarp.scene import Camera, Gaussians

CAMERA = Camera(torch.tensor([[40.0, 0, 20], [0, 40, 20], [0, 0, 1]]), torch.eye(4), 40, 40)
DEFAULT = FitSettings(strategy="default", steps=30_000, cap=1000)
MCMC = FitSettings(strategy="mcmc", steps=30_000, cap=1000)


def cloud(count: int, scale: float = 0.02, opacity: float = 0.5) -> Model:
    random = torch.Generator().manual_seed(0)
    return Model.starting(
        Gaussians(
            means=torch.randn(count, 3, generator=random),
            quats=torch.randn(count, 4, generator=random),
            scales=torch.full((count, 3), scale),
            opacities=torch.full((count,), opacity),
            sh=torch.randn(count, 4, 3, generator=random),
        )
    )


def pushed(model: Model, rows: list[int], by: float) -> tuple[Gradients, Taken]:
    """Gradients that want the projections of some rows to move; all are seen."""
    v = torch.zeros(len(model), 2)
    v[rows, 0] = by
    fields = {name: torch.zeros_like(model[name]) for name in model.groups}
    steps, skipped = (torch.zeros(len(model), dtype=torch.int32) for _ in range(2))
    seen, v_sh = torch.ones(len(model)), torch.zeros(len(model), 1, 3)
    return Gradients(**fields, means2d=v), count_steps(seen, v_sh, steps, skipped, sparse=True)


def refine(strategy: Densify | MarkovChain, model: Model, rows: list[int], by: float, step: int = 600) -> None:
    gradients, taken = pushed(model, rows, by)
    strategy.after_step(model, step, gradients, taken, CAMERA)


def test_small_gaussians_are_cloned():
    model = cloud(10, scale=0.005)
    before = model.gaussians()
    # 2e-4 in half images of 20 pixels is 1e-5 per pixel.
    refine(Densify(DEFAULT, 1.0, 100, 10, torch.device("cpu")), model, [2, 7], 1.01e-5)
    after = model.gaussians()
    assert len(after) == 12
    for name in ("means", "scales", "opacities", "sh"):
        assert torch.equal(getattr(after, name)[:10], getattr(before, name))
        assert torch.equal(getattr(after, name)[10:], getattr(before, name)[[2, 7]])
    assert model.groups["means"].first.shape == (12, 3)


def test_large_gaussians_are_split_in_two():
    model = cloud(10, scale=0.02)
    before = model.gaussians()
    refine(Densify(DEFAULT, 1.0, 100, 10, torch.device("cpu")), model, [4], 2e-5)
    after = model.gaussians()
    assert len(after) == 11
    kept = [row for row in range(10) if row != 4]
    assert torch.equal(after.means[:9], before.means[kept])
    torch.testing.assert_close(after.scales[9:], torch.full((2, 3), 0.02 / 1.6))
    apart = (after.means[9:] - before.means[4]).norm(dim=1)
    assert (apart > 0).all()
    assert (apart < 5 * 0.02).all()


def test_what_does_not_want_to_move_stays():
    model = cloud(10)
    before = model.gaussians()
    refine(Densify(DEFAULT, 1.0, 100, 10, torch.device("cpu")), model, [1], 0.99e-5)
    assert torch.equal(model["means"], before.means)


def test_gradients_are_averaged_over_the_views_that_saw_it():
    model = cloud(4, scale=0.005)
    strategy = Densify(DEFAULT, 1.0, 100, 4, torch.device("cpu"))
    gradients, taken = pushed(model, [0, 1], 1.5e-5)
    strategy.after_step(model, 598, gradients, taken, CAMERA)
    gradients, taken = pushed(model, [1], 0.0)
    taken.marks[0] = 0  # the first is not seen in the second step, the second has no gradient there
    strategy.after_step(model, 600, gradients, taken, CAMERA)
    assert len(model) == 5


@pytest.mark.parametrize(("step", "grows"), [(500, False), (600, True), (650, False), (14_900, True), (15_000, False)])
def test_refinement_has_its_times(step, grows):
    model = cloud(5)
    refine(Densify(DEFAULT, 1.0, 100, 5, torch.device("cpu")), model, [0], 1.0, step)
    assert (len(model) > 5) == grows


def test_the_cap_lets_the_steepest_in():
    model = cloud(10, scale=0.005)
    settings = FitSettings(strategy="default", steps=30_000, cap=12)
    strategy = Densify(settings, 1.0, 100, 10, torch.device("cpu"))
    gradients, taken = pushed(model, [], 0.0)
    gradients.means2d[:, 0] = torch.tensor([1, 9, 2, 8, 3, 4, 5, 6, 7, 1]) * 1e-3
    before = model["means"].clone()
    strategy.after_step(model, 600, gradients, taken, CAMERA)
    assert torch.equal(model["means"][10:], before[[1, 3]])


def test_transparent_and_after_a_reset_huge_gaussians_are_removed():
    for step, left in ((600, 9), (3600, 8)):
        model = cloud(10)
        model.groups["opacities"].values[3] = 0.004
        model.groups["scales"].values[5] = 0.11
        refine(Densify(DEFAULT, 1.0, 100, 10, torch.device("cpu")), model, [], 0.0, step)
        assert len(model) == left


def test_opacities_are_reset():
    model = cloud(3, opacity=0.9)
    model.groups["opacities"].first += 1.0
    model.groups["opacities"].values[2] = 0.006
    reset_opacities(model)
    torch.testing.assert_close(model["opacities"], torch.tensor([FAINT, FAINT, 0.006]))
    torch.testing.assert_close(model.groups["opacities"].parameters[:2].sigmoid(), torch.full((2,), FAINT))
    assert not model.groups["opacities"].first.any()


@pytest.mark.parametrize("opacity", [0.01, 0.3, 0.9, 0.999999, 1.0])
def test_copies_together_are_as_opaque_as_the_original(opacity):
    for copies in (1, 2, 3, 10, 51, 80):
        shared, factor = shared_opacity_and_scale(torch.tensor([opacity]), torch.tensor([copies]))
        together = 1 - (1 - shared) ** min(copies, 51)
        assert together.item() == pytest.approx(opacity, abs=2e-6)
        assert 0 < factor.item() <= 1 + 2e-6
    shared, factor = shared_opacity_and_scale(torch.tensor([opacity]), torch.tensor([1]))
    assert factor.item() == pytest.approx(1.0, abs=2e-6)


def test_copies_keep_the_integral_of_opacity_through_the_centre():
    """What defines their scale: sum over the copies, front to back, of alpha T along a line equals the original's."""
    opacity, copies = 0.8, 4
    shared, factor = shared_opacity_and_scale(torch.tensor([opacity]), torch.tensor([copies]))
    x = torch.linspace(-12, 12, 200_001, dtype=torch.float64)
    alpha = shared * torch.exp(-0.5 * (x / factor) ** 2)
    blended = 1 - (1 - alpha) ** copies
    assert torch.trapezoid(blended, x).item() == pytest.approx(opacity * math.sqrt(2 * math.pi), rel=1e-6)


def test_the_dead_move_to_the_living():
    model = cloud(40)
    model.groups["opacities"].values[:5] = 0.004
    before = model.gaussians()
    settings = FitSettings(strategy="mcmc", steps=30_000, cap=40, noise=0.0)
    refine(MarkovChain(settings, 1.0, 100), model, [], 0.0)
    assert len(model) == 40
    hosts = [(before.means[5:] == mean).all(dim=1).nonzero().item() + 5 for mean in model["means"][:5]]
    others = [row for row in range(5, 40) if row not in hosts]
    assert torch.equal(model["opacities"][others], before.opacities[others])
    for row, host in enumerate(hosts):
        copies = hosts.count(host) + 1
        assert model["opacities"][row] == model["opacities"][host]
        together = 1 - (1 - model["opacities"][host].double()) ** copies
        assert together.item() == pytest.approx(0.5, abs=1e-5)
        assert torch.equal(model["sh"][row], before.sh[host])


def test_it_grows_by_a_twentieth_up_to_the_cap():
    model = cloud(100)
    strategy = MarkovChain(FitSettings(strategy="mcmc", steps=30_000, cap=108), 1.0, 100)
    counts = []
    for step in (600, 700, 800):
        refine(strategy, model, [], 0.0, step)
        counts.append(len(model))
    assert counts == [105, 108, 108]
    assert model.steps.shape == (108,)


def test_the_faint_are_hosts_less_often():
    model = cloud(2000)
    model.groups["opacities"].values[:1000] = 0.05
    rows = torch.arange(2000)
    chosen = MarkovChain._choose(model, rows, 11_000, generator(0, 1, "test"))
    assert ((chosen < 1000).float().mean() - 1 / 11).abs() < 0.01


def test_degrees_start_from_zero_and_are_not_stored_before():
    model = cloud(6)
    model.keep(torch.arange(6))
    assert model["sh"].shape == (6, 4, 3)
    before = model["sh"].clone()
    model.raise_degree(3)
    assert model["sh"].shape == (6, 16, 3)
    assert torch.equal(model["sh"][:, :4], before)
    assert not model["sh"][:, 4:].any()
    model.raise_degree(1)
    assert model["sh"].shape == (6, 16, 3)


def test_a_state_can_be_restored():
    model = cloud(6)
    again = Model.restored({name: value.clone() for name, value in model.state().items()})
    for name, value in model.state().items():
        assert torch.equal(again.state()[name], value)
    assert again.groups["means"].values is again.groups["means"].parameters


def test_all_views_come_in_turn_and_in_another_order():
    turns = [[view_at(5, step, 7) for step in range(7 * turn, 7 * turn + 7)] for turn in range(4)]
    assert all(sorted(turn) == list(range(7)) for turn in turns)
    assert len({tuple(turn) for turn in turns}) > 1
    assert number(1, 2, "a") != number(1, 2, "b") != number(2, 2, "b")


def test_few_points_grow_to_the_cap_by_half_of_a_short_run():
    settings = FitSettings(strategy="mcmc", steps=1000, cap=800)
    model, strategy = cloud(100), MarkovChain(settings, 1.0, 100)
    for step in range(1, 501):
        if step % 100 == 0:
            refine(strategy, model, [], 0.0, step)
    assert len(model) == 800
