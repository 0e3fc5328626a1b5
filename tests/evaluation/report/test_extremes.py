"""The extreme scenes: each within its stated bound of the float64 oracle, in both schedules."""

import math
import time

import pytest
import torch

from sgwarp.evaluation.report import stability
from sgwarp.evaluation.report.extremes import EXTREMES
from sgwarp.evaluation.report.stability import check, check_gradients

pytestmark = pytest.mark.slow

SCHEDULES = ("lanes", "block")
LARGEST_UNDECIDABLE = 0.2  # share of the pixels; more and a scene would not test what it is named for
# What is culled because of the extreme itself, of 200.
CULLED = {
    "near plane": ("outside_depth", 100),
    "opacity 0 and 1": ("transparent", 100),
    "zero quaternions": ("non_finite", 100),
    "non-finite geometry": ("non_finite", 9 + 12 + 6 + 1),
    "non-finite colours": ("non_finite", 36),
}


@pytest.mark.parametrize("schedule", SCHEDULES)
@pytest.mark.parametrize("extreme", EXTREMES.values(), ids=EXTREMES)
def test_images_stay_within_their_bounds(extreme, schedule):
    start = time.perf_counter()
    result = check(extreme, schedule)
    assert 0 < result.seconds < time.perf_counter() - start
    assert result.finite
    assert result.error <= extreme.image_bound
    assert result.depth_error <= extreme.image_bound
    assert result.undecidable < LARGEST_UNDECIDABLE
    reason, count = CULLED.get(extreme.name, ("non_finite", 0))
    assert result.culled.get(reason, 0) == count
    assert sum(result.culled.values()) < 0.99 * len(extreme.build()[0]) or extreme.name == "empty scene"


@pytest.mark.parametrize("schedule", SCHEDULES)
@pytest.mark.parametrize(
    "extreme", [e for e in EXTREMES.values() if e.gradient_bound is not None], ids=lambda e: e.name
)
def test_gradients_stay_within_their_bounds(extreme, schedule):
    result = check_gradients(extreme, schedule)
    assert result.finite
    assert result.errors.keys() == {*stability.FIELDS, *stability.POSE}
    assert result.error <= extreme.gradient_bound


def test_scenes_are_what_they_are_named_for():
    built = {name: extreme.build()[0] for name, extreme in EXTREMES.items()}
    scales = built["needles"].scales
    assert (scales.amax(dim=1) / scales.amin(dim=1)).min() > 0.99e6
    depths = built["coincident depths"].means[:, 2]
    assert depths.unique(return_counts=True)[1].tolist() == [50] * 4
    assert built["far coordinates"].means.min() > 0.99e5
    assert built["scales 1e-7"].scales.max() < 2e-7
    assert built["scales 1e4"].scales.min() > 4e3
    assert len(built["one tile"]) == 100_000
    assert len(built["empty scene"]) == 0
    bad = built["non-finite geometry"]
    for field in (bad.means, bad.quats, bad.scales, bad.opacities):
        assert field.isnan().any()
    assert built["non-finite colours"].sh.isinf().any()
    again = EXTREMES["needles"].build()[0]
    assert torch.equal(again.means, built["needles"].means), "scenes are deterministic"


def test_an_error_and_a_nan_are_found(monkeypatch):
    """A renderer that is wrong at one pixel, or not finite there, does not pass."""
    render, extreme = stability._render, EXTREMES["flat"]

    def spoiled_by(amount):
        def spoiled(*arguments):
            image, *rest = render(*arguments)
            image[5, 7, 1] += amount
            return image, *rest

        return spoiled

    monkeypatch.setattr(stability, "_render", spoiled_by(1e-3))
    assert check(extreme).error == pytest.approx(1e-3, rel=0.1)
    assert check(extreme).finite
    monkeypatch.setattr(stability, "_render", spoiled_by(math.nan))
    assert not check(extreme).finite


@pytest.mark.parametrize(("argument", "name"), [(2, "scales"), (4, "rotation"), (4, "translation")])
def test_a_wrong_gradient_is_found(monkeypatch, argument, name):
    """The same values, and gradients that are one percent too large."""
    right = stability.rasterize

    def wrong(*arguments, **options):
        spoiled = list(arguments)
        spoiled[argument] = spoiled[argument] + 0.01 * (spoiled[argument] - spoiled[argument].detach())
        return right(*spoiled, **options)

    monkeypatch.setattr(stability, "rasterize", wrong)
    result = check_gradients(EXTREMES["flat"])
    assert result.finite
    assert result.errors[name] == pytest.approx(0.01, rel=0.1)
