"""The comparison with central differences accepts what is right, and notices what is not."""

import pytest
import torch


@pytest.fixture
def case():
    rng = torch.Generator().manual_seed(0)
    point = {"rows": torch.rand(20, 3, generator=rng, dtype=torch.float64) + 0.5, "unused": torch.ones(20)}
    gradient = torch.cos(3.0 * point["rows"]) * 3.0
    gradient[5] = 0.0

    def loss(moved):
        values = torch.sin(3.0 * moved["rows"])
        return values.sum() - values[5].sum()

    return loss, point, gradient


def test_the_right_gradient_passes(case, assert_central_differences):
    loss, point, gradient = case
    assert_central_differences(loss, point, {"rows": gradient})


@pytest.mark.parametrize("mistake", ["one percent", "a sign", "a lost entry", "an entry that is zero"])
def test_a_wrong_gradient_is_noticed(case, assert_central_differences, mistake):
    loss, point, gradient = case
    if mistake == "one percent":
        gradient = 1.01 * gradient
    elif mistake == "a sign":
        gradient[7, 1] *= -1
    elif mistake == "a lost entry":
        gradient[7, 1] = 0.0
    else:
        gradient[5, 2] = 1.0
    with pytest.raises(AssertionError, match="rows"):
        assert_central_differences(loss, point, {"rows": gradient})


def test_a_gradient_that_is_nowhere_is_noticed(case, assert_central_differences):
    loss, point, _ = case
    with pytest.raises(AssertionError, match="nothing to compare"):
        assert_central_differences(loss, point, {"unused": torch.zeros(20)})
