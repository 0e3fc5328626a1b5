"""Settings of a training: the last values that are taken, and the first that are refused."""

import math

import pytest

from sgwarp.errors import InputError
from sgwarp.network.training.settings import DistillSettings

COUNTS = ("epochs", "scenes_per_step", "validate_every", "views_per_step", "contributors")
POSITIVE = ((1e-9, 1e9), (0.0, -1.0, math.inf, math.nan))
RANGES = {
    **dict.fromkeys(("voxel", "learning_rate", "temperature"), POSITIVE),
    **dict.fromkeys(COUNTS, ((1, 7), (0, -1, 1.5, math.inf, math.nan))),
    "weight_decay": ((0.0, 0.5), (-1e-9, math.inf, math.nan)),
    "loss": (("cosine", "contrastive"), ("mse", "")),
}


@pytest.mark.parametrize("name", RANGES)
def test_ranges_of_the_settings(name):
    taken, refused = RANGES[name]
    for value in taken:
        assert getattr(DistillSettings(**{name: value}), name) == value
    for value in refused:
        with pytest.raises(InputError, match=f"^{name}: expected"):
            DistillSettings(**{name: value})


@pytest.mark.parametrize("epochs", [1, 4, 100])
def test_the_learning_rate_of_each_epoch(epochs):
    """Half a cosine from the whole to nothing, which would be reached one epoch after the last."""
    settings = DistillSettings(epochs=epochs, learning_rate=0.2)
    rates = [settings.rate(epoch) for epoch in range(epochs + 1)]
    assert rates == pytest.approx([0.1 + 0.1 * math.cos(math.pi * k / epochs) for k in range(epochs + 1)])
    assert (rates[0], rates[-1]) == (pytest.approx(0.2), pytest.approx(0.0))
