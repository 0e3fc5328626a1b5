"""The noise of the Markov chain, against its closed form (Kheradmand et al. 2024, eq. 9)."""

import numpy as np
import pytest
import torch

from sgwarp.ops.adam import add_noise

OPACITIES = (0.0, 0.005, 0.02, 0.05, 0.1, 0.15)


def moved(opacity: float, *, scales=(0.1, 0.2, 0.3), quat=(1.0, 0.0, 0.0, 0.0), seed=7, size=1.0) -> np.ndarray:
    """How far a Gaussian moves, float64 [3]; the random number depends on seed and row alone."""
    means = torch.zeros(1, 3)
    add_noise(means, torch.tensor([quat]), torch.tensor([scales]), torch.tensor([opacity]), seed, size)
    return means[0].double().numpy()


def faintness(opacity: float) -> float:
    return 1 / (1 + np.exp(-100 * (1 - opacity - 0.995)))


@pytest.mark.parametrize("opacity", OPACITIES)
def test_only_the_faint_move(opacity):
    share = moved(opacity) / moved(0.0)
    np.testing.assert_allclose(share, faintness(opacity) / faintness(0.0), rtol=2e-4)


def test_the_opaque_stay():
    assert not moved(0.2).any()
    assert faintness(0.2) < 1e-8


def test_it_is_normal_within_the_extent_of_the_gaussian():
    """Sigma times a standard normal vector: Sigma = R S S R^T."""
    count, scales = 20_000, torch.tensor([0.1, 0.2, 0.3])
    half = 0.5**0.5  # a quarter turn about z
    means = torch.zeros(count, 3)
    quats = torch.tensor([half, 0.0, 0.0, half]).expand(count, 4).contiguous()
    add_noise(means, quats, scales.expand(count, 3).contiguous(), torch.full((count,), 0.005), 3, 2.0)
    step = means.double().numpy() / (2.0 * faintness(0.005))
    np.testing.assert_allclose(step.std(axis=0), [0.2**2, 0.1**2, 0.3**2], rtol=0.03)
    np.testing.assert_allclose(step.mean(axis=0) / step.std(axis=0), 0, atol=0.03)
    assert abs(np.corrcoef(step.T) - np.eye(3)).max() < 0.03


def test_size_and_seed():
    np.testing.assert_allclose(moved(0.01, size=3.0), 3 * moved(0.01), rtol=1e-6)
    assert (moved(0.01, seed=8) != moved(0.01)).all()
    np.testing.assert_array_equal(moved(0.01), moved(0.01))
