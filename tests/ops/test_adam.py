"""The optimiser row by row against float64 Adam, its sparsity, and the noise."""

import pytest
import torch

from sgwarp.ops import launch, reference_fit
from sgwarp.ops.adam import Group, add_noise, count_steps, note_gradients, update, values_of
from sgwarp.ops.reference import rotation_matrices

ROWS, STEPS = 40, 25


def by_parameters(values: torch.Tensor, form: str) -> torch.Tensor:
    """Derivative of the values by their parameters."""
    return {"plain": torch.ones_like(values), "logarithm": values, "logit": values * (1 - values)}[form]


@pytest.mark.parametrize("form", ["plain", "logarithm", "logit"])
def test_rows_take_the_steps_of_adam_that_they_are_seen_in(form):
    random = torch.Generator().manual_seed(1)
    parameters = torch.randn(ROWS, 3, generator=random)
    gradients = torch.randn(STEPS, ROWS, 3, generator=random)
    seen = torch.rand(STEPS, ROWS, generator=random) < torch.linspace(0, 1, ROWS)
    group, steps = Group.starting(parameters.clone(), form), torch.zeros(ROWS, dtype=torch.int32)
    noted = []
    for gradient, shown in zip(gradients, seen, strict=True):
        noted.append(gradient.double() * by_parameters(group.values.double(), form))
        taken = count_steps(shown.float(), torch.zeros(ROWS, 1, 3), steps, sparse=True)
        assert torch.equal(taken.bool(), shown)
        update(group, gradient, taken, steps, 0.01)
    assert torch.equal(steps, seen.sum(dim=0, dtype=torch.int32))
    for row in range(ROWS):
        own = torch.stack([g[row] for g, shown in zip(noted, seen, strict=True) if shown[row]] or [torch.zeros(3)])
        expected = reference_fit.adam(parameters[row].double(), own, 0.01)
        torch.testing.assert_close(group.parameters[row].double(), expected, rtol=2e-5, atol=2e-5)
    torch.testing.assert_close(group.values, values_of(group.parameters, form), rtol=1e-6, atol=1e-7)
    unseen = ~seen.any(dim=0)
    assert unseen.any()
    assert torch.equal(group.parameters[unseen], parameters[unseen])


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
    steps = torch.zeros(6, dtype=torch.int32)
    taken = count_steps(torch.zeros(6), torch.zeros(6, 4, 3), steps, sparse=False)
    assert taken.tolist() == steps.tolist() == [1] * 6


def test_a_gradient_of_the_colour_alone_counts_as_seen():
    v_sh = torch.zeros(3, 4, 3)
    v_sh[1, 0, 2] = -1e-20
    assert count_steps(torch.zeros(3), v_sh, torch.zeros(3, dtype=torch.int32), sparse=True).tolist() == [0, 1, 0]


def test_columns_have_their_rates_and_the_pull_its_direction():
    group, steps = Group.starting(torch.zeros(1, 2, 3)), torch.zeros(1, dtype=torch.int32)
    taken = count_steps(torch.ones(1), torch.zeros(1, 1, 3), steps, sparse=True)
    update(group, torch.ones(1, 2, 3), taken, steps, 0.1, leading=3, rate_of_rest=0.01)
    torch.testing.assert_close(group.values[0], torch.tensor([[-0.1] * 3, [-0.01] * 3]))
    opacity = Group.starting(torch.zeros(1, 1), "logit")
    update(opacity, torch.zeros(1, 1), taken, steps, 0.1, pull=1e-3)
    assert opacity.values.item() < 0.5  # Adam's first step has the size of the rate, whatever the gradient


def test_gradients_are_noted_in_half_images():
    sums, views = torch.zeros(3), torch.zeros(3, dtype=torch.int32)
    for _ in range(2):
        note_gradients(torch.tensor([[3e-2, 4e-2]]).repeat(3, 1), torch.tensor([1, 0, 1]).byte(), 200, 200, sums, views)
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
        before = launch.get_threads()
        launch.set_threads(threads)
        try:
            means = torch.zeros(1000, 3)
            add_noise(means, torch.ones(1000, 4), torch.ones(1000, 3), torch.zeros(1000), seed, 1.0)
        finally:
            launch.set_threads(before)
        return means

    assert torch.equal(moved(3, 1), moved(3, 4))
    assert not torch.equal(moved(3, 1), moved(4, 1))
