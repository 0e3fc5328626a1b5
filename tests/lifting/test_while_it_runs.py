"""What a lift shows of itself while it runs, and what it does with maps that are wrong in one channel."""

import math
from dataclasses import replace

import pytest
import torch

from sgwarp.errors import InputError
from sgwarp.lifting.lifter import lift
from sgwarp.lifting.settings import LiftSettings
from sgwarp.runs.log import RunLog
from sgwarp.scene import FeatureMap


def right_half(stage):
    """Maps that say nothing about their left half."""

    def found(view):
        one = stage.one_hot(view)
        ids = one.ids.clone()
        ids[..., : view.camera.width // 2] = -1
        return replace(one, ids=ids)

    return found


def test_each_view_can_be_watched_as_it_comes(stage):
    """What is shown after each view is a lift of the views so far, and does not change the result."""
    shown, views = [], stage.views[:3]
    log = RunLog()
    log.watch = lambda make: shown.append(make())
    result = lift(stage.gaussians, views, stage.dense, log=log)
    order = [views[0], views[2], views[1]]  # the one in the middle goes last
    assert len(shown) == 4
    for count, semantics in enumerate(shown[:3], start=1):
        expected = lift(stage.gaussians, order[:count], stage.dense)
        torch.testing.assert_close(semantics.features, expected.features, rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(semantics.weight, expected.weight, rtol=1e-4, atol=1e-5)
    assert shown[3] is result
    assert torch.equal(result.features, lift(stage.gaussians, views, stage.dense).features)


def test_what_is_watched_at_the_end_has_its_holes(stage):
    """Holes are filled after it: what views saw is watched, what neighbours lend is not."""
    pytest.importorskip("scipy")
    shown, log = [], RunLog()
    log.watch = lambda make: shown.append(make())
    half = right_half(stage)
    filled = lift(stage.gaussians, stage.views[:1], half, lift_settings=LiftSettings(fill=2), log=log)
    assert int(shown[-1].seen.sum()) < int(filled.seen.sum())
    assert log.left_out["unseen_gaussians_filled"] == int(filled.seen.sum()) - int(shown[-1].seen.sum())


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("kind", ["dense", "vectors"])
def test_one_channel_that_is_not_a_number_is_refused(stage, kind, value):
    view = stage.views[0]
    if kind == "dense":
        dense = stage.dense(view).dense.clone()
        dense[5, 7, 2] = dense[6, 1, 0] = value
        found = FeatureMap("toy", dense=dense)
    else:
        vectors = torch.eye(4)
        vectors[1, 3] = vectors[2, 0] = value
        found = FeatureMap("toy", ids=stage.labels(view) - 1, vectors=vectors)
    with pytest.raises(InputError, match=r"view 0000: .* at 2 places; mark them invalid"):
        lift(stage.gaussians, [view], {"0000": found})


@pytest.mark.parametrize(("count", "last"), [(1, 0), (2, 1), (3, 1), (4, 2), (5, 2)])
def test_the_view_in_the_middle_goes_last_and_all_go_once(stage, count, last):
    asked = []

    def noted(view):
        asked.append(view.stem)
        return stage.one_hot(view)

    views = stage.views[:count]
    lift(stage.gaussians, views, noted)
    rest = [view.stem for k, view in enumerate(views) if k != last]
    assert asked == [*rest, views[last].stem]


def test_effective_views_count_views_that_weigh_alike(stage):
    """Three copies of a view are three views; of a Gaussian that none saw there are none."""
    one = stage.views[2]
    views = [replace(one, stem=f"{k}") for k in range(3)]
    half = right_half(stage)
    semantics = lift(stage.gaussians, views, lambda view: half(one))
    seen = semantics.weight > 1e-3
    assert 0 < int(seen.sum()) < len(stage.gaussians)
    torch.testing.assert_close(semantics.effective_views[seen], torch.full((int(seen.sum()),), 3.0), rtol=1e-3, atol=0)
    assert not semantics.effective_views[semantics.weight == 0].any()
