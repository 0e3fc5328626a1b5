"""The optimiser row by row against float64 Adam, its sparsity, and the noise."""

from functools import partial

import pytest
import torch

from sgwarp.ops import adam, launcher
from sgwarp.ops.adam import Group, add_noise, count_steps, note_gradients, update, values_of
from sgwarp.ops.reference import fitting as reference_fit
from sgwarp.ops.reference.rasterizer import rotation_matrices

ROWS, STEPS = 40, 25


@pytest.fixture(autouse=True, params=["rows", "elements"])
def _threads(request, monkeypatch):
    """Every test runs with a thread per row and, as on CUDA, per element."""
    monkeypatch.setitem(globals(), "update", partial(adam.update, by_element=request.param == "elements"))


def by_parameters(values: torch.Tensor, form: str) -> torch.Tensor:
    """Derivative of the values by their parameters."""
    return {"plain": torch.ones_like(values), "logarithm": values, "logit": values * (1 - values)}[form]


def counters(rows: int) -> tuple[torch.Tensor, torch.Tensor]:
    return torch.zeros(rows, dtype=torch.int32), torch.zeros(rows, dtype=torch.int32)


def fit_rows(parameters: torch.Tensor, gradients: torch.Tensor, seen: torch.Tensor, form: str, rate: float) -> Group:
    """Rows take the steps they are seen in; in the last one all are."""
    group, (steps, skipped) = Group.starting(parameters.clone(), form), counters(len(parameters))
    for gradient, shown in zip(gradients, seen, strict=True):
        taken = count_steps(shown.float(), torch.zeros(len(shown), 1, 3), steps, skipped, sparse=True)
        assert torch.equal(taken.seen, shown)
        assert taken.count == int(shown.sum())
        update(group, gradient, taken, rate)
    assert bool((steps == len(gradients)).all())
    return group


def test_rows_that_are_always_seen_take_the_steps_of_adam():
    random = torch.Generator().manual_seed(1)
    parameters, gradients = torch.randn(ROWS, 3, generator=random), torch.randn(STEPS, ROWS, 3, generator=random)
    group = fit_rows(parameters, gradients, torch.ones(STEPS, ROWS, dtype=torch.bool), "plain", 0.01)
    expected = reference_fit.adam(parameters.double(), gradients.double(), 0.01)
    torch.testing.assert_close(group.parameters.double(), expected, rtol=2e-5, atol=2e-5)


@pytest.mark.parametrize("form", ["logarithm", "logit"])
def test_gradients_of_values_reach_the_parameters(form):
    random = torch.Generator().manual_seed(1)
    parameters, gradients = torch.randn(ROWS, 3, generator=random), torch.randn(STEPS, ROWS, 3, generator=random)
    group, (steps, skipped), noted = Group.starting(parameters.clone(), form), counters(ROWS), []
    for gradient in gradients:
        noted.append(gradient.double() * by_parameters(group.values.double(), form))
        taken = count_steps(torch.ones(ROWS), torch.zeros(ROWS, 1, 3), steps, skipped, sparse=True)
        update(group, gradient, taken, 0.01)
    expected = reference_fit.adam(parameters.double(), torch.stack(noted), 0.01)
    torch.testing.assert_close(group.parameters.double(), expected, rtol=2e-5, atol=2e-5)
    torch.testing.assert_close(group.values, values_of(group.parameters, form), rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize(("steps", "error"), [(25, 1e-4), (400, 0.01)])
def test_rows_make_up_for_the_steps_they_were_not_seen_in(steps, error):
    """They end where Adam on all rows takes them, with a gradient of zero where they are not seen: exactly while they
    are young, later but for the bias of the mean square, which is taken to stand still."""
    random = torch.Generator().manual_seed(1)
    parameters, gradients = torch.randn(ROWS, 3, generator=random), 1 + torch.randn(steps, ROWS, 3, generator=random)
    seen = torch.rand(steps, ROWS, generator=random) < torch.linspace(0.02, 1, ROWS)
    seen[-1] = True
    group = fit_rows(parameters, gradients, seen, "plain", 0.01)
    expected = reference_fit.adam(parameters.double(), gradients.double() * seen[..., None], 0.01)
    way = (expected - parameters).abs().amax()
    assert float((group.parameters - expected).abs().max() / way) < error


def test_a_pull_reaches_rows_that_are_not_seen():
    """A regulariser is a gradient of all rows in all steps, also of those that nothing else moves."""
    random = torch.Generator().manual_seed(1)
    steps, pull = 300, 0.3
    parameters, gradients = torch.randn(ROWS, 3, generator=random), torch.randn(steps, ROWS, 3, generator=random)
    seen = torch.rand(steps, ROWS, generator=random) < torch.linspace(0.02, 1, ROWS)
    seen[-1] = True
    group, (counted, skipped) = Group.starting(parameters.clone()), counters(ROWS)
    for gradient, shown in zip(gradients, seen, strict=True):
        taken = count_steps(shown.float(), torch.zeros(ROWS, 1, 3), counted, skipped, sparse=True)
        update(group, gradient, taken, 0.01, pull=pull)
    expected = reference_fit.adam(parameters.double(), gradients.double() * seen[..., None] + pull, 0.01)
    moved, wanted = group.parameters - parameters, expected - parameters
    assert float((moved - wanted).abs().mean() / wanted.abs().mean()) < 0.1
    never, (counted, skipped) = Group.starting(torch.zeros(1, 1)), counters(1)
    for step in range(50):
        shown = torch.tensor([1.0 if step == 49 else 0.0])
        taken = count_steps(shown, torch.zeros(1, 1, 3), counted, skipped, sparse=True)
        update(never, torch.zeros(1, 1), taken, 0.01, pull=pull)
    assert never.parameters.item() == pytest.approx(-0.5, rel=0.05)  # fifty steps of the rate


def test_many_columns_take_the_same_steps_as_few():
    """48 columns go 16 at a time, 47 one at a time."""
    random = torch.Generator().manual_seed(1)
    parameters, gradients = torch.randn(ROWS, 48, generator=random), torch.randn(150, ROWS, 48, generator=random)
    seen = torch.rand(150, ROWS, generator=random) < 0.3
    results = []
    for columns in (48, 47):
        group, (steps, skipped) = Group.starting(parameters[:, :columns].clone()), counters(ROWS)
        for gradient, shown in zip(gradients, seen, strict=True):
            taken = count_steps(shown.float(), torch.zeros(ROWS, 1, 3), steps, skipped, sparse=True)
            update(group, gradient[:, :columns], taken, 0.02, leading=3, rate_of_rest=0.01)
        results.append(group)
    wide, narrow = results
    for name in ("parameters", "first", "second"):
        torch.testing.assert_close(getattr(wide, name)[:, :47], getattr(narrow, name), rtol=1e-5, atol=1e-6)


def test_rows_that_wait_stay_as_they_are():
    group, (steps, skipped) = Group.starting(torch.ones(2, 3)), counters(2)
    for _ in range(3):
        taken = count_steps(torch.tensor([1.0, 0.0]), torch.zeros(2, 1, 3), steps, skipped, sparse=True)
        update(group, torch.ones(2, 3), taken, 0.1)
    assert torch.equal(group.parameters[1], torch.ones(3))
    assert skipped.tolist() == [0, 3]


def test_the_oracle_is_torchs_adam():
    random = torch.Generator().manual_seed(2)
    start, gradients = torch.randn(5, generator=random).double(), torch.randn(30, 5, generator=random).double()
    leaf = start.clone().requires_grad_()
    optimiser = torch.optim.Adam([leaf], lr=0.02, eps=1e-15)
    for gradient in gradients:
        leaf.grad = gradient.clone()
        optimiser.step()
    torch.testing.assert_close(reference_fit.adam(start, gradients, 0.02), leaf.detach())


def test_dense_steps_are_taken_by_all():
    steps, skipped = counters(6)
    taken = count_steps(torch.zeros(6), torch.zeros(6, 4, 3), steps, skipped, sparse=False)
    assert taken.marks.tolist() == steps.tolist() == [1] * 6
    assert not taken.seen.any()


def test_a_gradient_of_the_colour_alone_counts_as_seen():
    v_sh = torch.zeros(3, 4, 3)
    v_sh[1, 0, 2] = -1e-20
    assert count_steps(torch.zeros(3), v_sh, *counters(3), sparse=True).seen.tolist() == [False, True, False]


def test_columns_have_their_rates_and_the_pull_its_direction():
    group = Group.starting(torch.zeros(1, 2, 3))
    taken = count_steps(torch.ones(1), torch.zeros(1, 1, 3), *counters(1), sparse=True)
    update(group, torch.ones(1, 2, 3), taken, 0.1, leading=3, rate_of_rest=0.01)
    torch.testing.assert_close(group.values[0], torch.tensor([[-0.1] * 3, [-0.01] * 3]))
    opacity = Group.starting(torch.zeros(1, 1), "logit")
    update(opacity, torch.zeros(1, 1), taken, 0.1, pull=1e-3)
    assert opacity.values.item() < 0.5  # Adam's first step has the size of the rate, whatever the gradient


def test_gradients_are_noted_in_half_images():
    sums, views = torch.zeros(3), torch.zeros(3, dtype=torch.int32)
    for _ in range(2):
        taken = count_steps(torch.tensor([1.0, 0.0, 1.0]), torch.zeros(3, 1, 3), *counters(3), sparse=False)
        note_gradients(torch.tensor([[3e-2, 4e-2]]).repeat(3, 1), taken, 200, 200, sums, views)
    torch.testing.assert_close(sums, torch.tensor([10.0, 0.0, 10.0]))
    assert views.tolist() == [2, 0, 2]


def test_noise_moves_the_faint_within_their_extent():
    n = 20_000
    quats = torch.nn.functional.normalize(torch.tensor([[0.7, 0.2, -0.4, 0.5]]))
    scales = torch.tensor([[0.5, 0.1, 0.02]])
    opacities = torch.tensor([0.005, 0.5]).repeat(n // 2)
    means = torch.zeros(n, 3)
    add_noise(means, quats.repeat(n, 1), scales.repeat(n, 1), opacities, 7, 2.0)
    assert not means[1::2].any()
    moved = means[::2].double()
    # Half of the noise is left at opacity 0.005: means are 2 * 0.5 * Sigma * normal.
    rotation = rotation_matrices(quats)[0].double()
    sigma = rotation @ torch.diag(scales[0].double() ** 2) @ rotation.T
    torch.testing.assert_close(torch.cov(moved.T), sigma @ sigma.T, rtol=0.05, atol=5e-4)
    assert moved.mean(dim=0).norm() < 0.01


def test_noise_depends_on_the_seed_and_the_row_alone():
    def moved(seed: int, threads: int) -> torch.Tensor:
        before = launcher.get_threads()
        launcher.set_threads(threads)
        try:
            means = torch.zeros(1000, 3)
            add_noise(means, torch.ones(1000, 4), torch.ones(1000, 3), torch.zeros(1000), seed, 1.0)
        finally:
            launcher.set_threads(before)
        return means

    assert torch.equal(moved(3, 1), moved(3, 4))
    assert not torch.equal(moved(3, 1), moved(4, 1))
