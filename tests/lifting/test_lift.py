"""The streaming loop around the lifting operator: means, coverage, residual, what is skipped and what is refused."""

import math
import sys
import weakref
from functools import partial

import pytest
import torch

from sgwarp.encoders.base import MissingMap
from sgwarp.errors import InputError
from sgwarp.lifting.lifter import lift
from sgwarp.ops.launcher import get_threads
from sgwarp.ops.reference import lifting as reference_lift
from sgwarp.runs.log import RunLog
from sgwarp.scene import FeatureMap, View

MODES = ("weighted", "center")


@pytest.mark.slow
@pytest.mark.parametrize("mode", MODES)
def test_equals_the_mean_of_the_oracles_sums(stage, mode):
    views = [View(view.stem, view.camera.resized(36, 48)) for view in stage.views[:3]]
    center = partial(reference_lift.lift_center, border=3)
    oracle = reference_lift.lift_weighted if mode == "weighted" else center
    parts = []
    for view in views:
        labels = stage.labels(view)
        image = torch.nn.functional.one_hot((labels - 1).clamp(min=0), 4).double()
        parts.append(oracle(stage.gaussians, view.camera, image, labels > 0))
    weight = sum(p.weight for p in parts)
    expected = sum(p.features for p in parts) / weight.clamp(min=1e-12)[:, None]
    effective = weight**2 / sum(p.weight**2 for p in parts).clamp(min=1e-12)

    lifted = lift(stage.gaussians, views, stage.one_hot, mode, border=3)
    # Left out: quotients of tiny weights, and in centre mode decisions that rounding may turn.
    decided = torch.stack([torch.ones_like(weight) if p.margin is None else p.margin for p in parts]).amin(dim=0) > 2e-6
    clear = (weight > 0.05) & decided
    assert clear.sum() > 800
    torch.testing.assert_close(lifted.weight[decided].double(), weight[decided], atol=2e-3, rtol=2e-3)
    torch.testing.assert_close(lifted.features[clear].double(), expected[clear], atol=2e-3, rtol=0)
    torch.testing.assert_close(lifted.effective_views[clear].double(), effective[clear], atol=2e-2, rtol=0)


def test_every_seen_gaussian_gets_its_panel(stage):
    log = RunLog()
    lifted = lift(stage.gaussians, stage.views, stage.one_hot, log=log)
    best = lifted.features.argmax(dim=1) + 1
    well_seen = lifted.weight > 1.0
    assert well_seen.float().mean() > 0.8
    assert (best == stage.classes)[well_seen].float().mean() > 0.97
    assert lifted.labels == ("1", "2", "3", "4")
    assert lifted.fingerprint == stage.gaussians.fingerprint
    assert log.error["coverage"] == lifted.coverage > 0.9
    assert set(log.stages) == {"encode", "lift", "residual"}


def test_unseen_gaussians_are_zero(stage):
    """Semantics only in the left third of one view: what projects to the right of it gets nothing."""
    ids = stage.labels(stage.views[0]) - 1
    ids[:, 32:] = -1
    partly = FeatureMap("labels", ids=ids, labels=("1", "2", "3", "4"))
    lifted = lift(stage.gaussians, stage.views[:1], {"0000": partly})
    assert 0.1 < lifted.coverage < 0.6
    assert not lifted.features[~lifted.seen].any()
    assert not lifted.effective_views[~lifted.seen].any()


def test_features_and_labels_agree(stage):
    """One-hot labels, the same as vectors by id, and as a dense map, lift to the same features."""
    vectors = torch.eye(4)
    by_id = lift(stage.gaussians, stage.views, stage.one_hot)
    by_vector = lift(
        stage.gaussians, stage.views, lambda view: FeatureMap("toy", ids=stage.labels(view) - 1, vectors=vectors)
    )
    dense = lift(stage.gaussians, stage.views, stage.dense)
    torch.testing.assert_close(by_id.features, by_vector.features, atol=1e-5, rtol=0)
    torch.testing.assert_close(by_id.features, dense.features[:, :4], atol=1e-4, rtol=0)
    assert not dense.features[:, 4].any()


def test_residual_is_small_for_true_labels_and_large_for_shuffled_ones(stage):
    def shuffled(view: View) -> FeatureMap:
        turned = (stage.labels(view) - 1 + int(view.stem)) % 4
        return FeatureMap("labels", ids=turned, labels=("1", "2", "3", "4"))

    good, bad = RunLog(), RunLog()
    lift(stage.gaussians, stage.views, stage.one_hot, log=good)
    lift(stage.gaussians, stage.views, shuffled, log=bad)
    assert good.error["residual"] < 0.06
    assert bad.error["residual"] > 0.4


def test_residual_of_features_does_not_depend_on_their_length(stage, monkeypatch):
    """It is rendered in slices of channels: 100 channels of which 96 are zero change nothing."""
    monkeypatch.setattr(sys.modules["sgwarp.lifting.residuals"], "IMAGE_BYTES", 0)  # slices of 16 channels

    def padded(view: View) -> FeatureMap:
        small = stage.dense(view)
        wide = torch.nn.functional.pad(small.dense, (95, 0))
        return FeatureMap("toy", dense=wide, valid=small.valid)

    narrow, wide = RunLog(), RunLog()
    lift(stage.gaussians, stage.views, stage.dense, log=narrow)
    lift(stage.gaussians, stage.views, padded, log=wide)
    assert 0 < narrow.error["residual"] < 0.05
    assert wide.error["residual"] == pytest.approx(narrow.error["residual"], abs=1e-5)


@pytest.mark.parametrize("kind", ["labels", "vectors", "dense"])
def test_residual_of_a_large_map_is_estimated_on_a_grid(stage, kind):
    """Three times as large a map has more pixels than are compared; the figure stays nearly the same."""

    def large(view: View) -> FeatureMap:
        view = View(view.stem, view.camera.resized(216, 288))
        if kind == "vectors":
            return FeatureMap("toy", ids=stage.labels(view) - 1, vectors=torch.eye(4))
        return stage.one_hot(view) if kind == "labels" else stage.dense(view)

    small, big = RunLog(), RunLog()
    lift(stage.gaussians, stage.views, stage.one_hot if kind == "labels" else stage.dense, log=small)
    lift(stage.gaussians, stage.views, large, log=big)
    assert big.error["residual"] == pytest.approx(small.error["residual"], abs=0.02)


def test_residual_is_measured_before_its_view_is_lifted(stage):
    """Of two views the second contradicts the first: were it lifted first, it would win about half of its pixels."""

    def contrary(view: View) -> FeatureMap:
        ids = stage.labels(view) - 1
        turned = torch.where(ids >= 0, 3 - ids, -1)
        return FeatureMap("labels", ids=turned if view.stem == "0001" else ids, labels=("1", "2", "3", "4"))

    log = RunLog()
    lift(stage.gaussians, stage.views[:2], contrary, log=log)
    assert log.error["residual"] > 0.9


def test_the_view_in_the_middle_is_held_back(stage):
    """Of five views that one contradicts the others: its residual alone is large."""

    def contrary(wrong: int):
        def labels(view: View) -> FeatureMap:
            ids = stage.labels(view) - 1
            turned = torch.where(ids >= 0, 3 - ids, -1)
            return FeatureMap("labels", ids=turned if view is stage.views[wrong] else ids, labels=("1", "2", "3", "4"))

        return labels

    residuals = []
    for wrong in range(5):
        log = RunLog()
        lift(stage.gaussians, stage.views[:5], contrary(wrong), log=log)
        residuals.append(log.error["residual"])
    assert residuals[2] > 0.9
    assert max(residuals[:2] + residuals[3:]) < 0.5


@pytest.mark.parametrize("image_bytes", [0, 2**28])  # slices of 16 channels, and all of them at once
def test_residual_of_many_labels(stage, monkeypatch, image_bytes):
    """Forty labels, of which four are shown, in different slices: the figure is that of the four alone."""
    monkeypatch.setattr(sys.modules["sgwarp.lifting.residuals"], "IMAGE_BYTES", image_bytes)
    names = tuple(str(k) for k in range(40))
    places = torch.tensor([5, 17, 33, 39, -1])

    def sparse(view: View) -> FeatureMap:
        return FeatureMap("labels", ids=places[stage.labels(view) - 1], labels=names)

    few, many = RunLog(), RunLog()
    lift(stage.gaussians, stage.views, stage.one_hot, log=few)
    lift(stage.gaussians, stage.views, sparse, log=many)
    assert many.error["residual"] == pytest.approx(few.error["residual"], abs=1e-6)


def test_residual_falls_on_a_view_that_has_a_map(stage):
    """The views in the middle have none; a dict can tell before they are asked for."""
    maps = {view.stem: stage.one_hot(view) for view in (*stage.views[:2], *stage.views[4:])}
    log = RunLog()
    lift(stage.gaussians, stage.views, maps, log=log)
    assert log.error["residual"] < 0.1


def test_one_view_has_no_residual(stage):
    log = RunLog()
    lift(stage.gaussians, stage.views[:1], stage.one_hot, log=log)
    assert set(log.error) == {"coverage"}


def test_only_one_map_is_alive_at_a_time(stage):
    alive: weakref.WeakSet[FeatureMap] = weakref.WeakSet()
    before_each = []

    def watched(view: View) -> FeatureMap:
        before_each.append(len(alive))
        feature_map = stage.dense(view)
        alive.add(feature_map)
        return feature_map

    lift(stage.gaussians, stage.views[:4], watched)
    assert before_each == [0, 0, 0, 0]


def test_views_without_map_are_skipped_and_counted(stage):
    maps = {view.stem: stage.one_hot(view) for view in stage.views[:4]}
    log = RunLog()
    from_dict = lift(stage.gaussians, stage.views, maps, log=log)
    assert log.left_out == {"views_without_map": 2}
    torch.testing.assert_close(
        from_dict.weight, lift(stage.gaussians, stage.views[:4], maps).weight, atol=1e-4, rtol=1e-5
    )

    def missing(view: View) -> FeatureMap:
        raise MissingMap(f"{view.stem}: none")

    with pytest.raises(InputError, match="any of the 6 views"):
        lift(stage.gaussians, stage.views, missing)
    with pytest.raises(InputError, match="any of the 6 views"):
        lift(stage.gaussians, stage.views, {})


def test_share_of_views_is_evenly_spread(stage):
    asked = []

    def spy(view: View) -> FeatureMap:
        asked.append(view.stem)
        return stage.one_hot(view)

    log = RunLog()
    lift(stage.gaussians, stage.views, spy, share_of_views=0.5, log=log)
    assert sorted(asked) == ["0000", "0002", "0004"]
    assert log.left_out == {"views_by_share": 3}


class Sighted:
    """A source that needs an image, and remembers what it got."""

    space = "labels"
    needs_image = True

    def __init__(self, stage):
        self.stage, self.images = stage, {}

    def encode(self, view, image):
        self.images[view.stem] = image
        return self.stage.one_hot(view)


@pytest.mark.slow
def test_photograph_where_there_is_one_else_a_rendering(stage, stage_files):
    picture = stage_files.views / "images" / "0000.png"
    views = [View("0000", stage.views[0].camera, picture), stage.views[1]]
    source, log = Sighted(stage), RunLog()
    lift(stage.gaussians, views, source, log=log)
    assert log.left_out == {"photographs_rendered_instead": 1}
    assert {"read", "render"} <= set(log.stages)
    for view in views:
        image, labels = source.images[view.stem], stage.labels(view)
        assert image.shape == (*view.camera.size, 3)
        red_door = image[labels == 2].median(dim=0).values
        torch.testing.assert_close(red_door, torch.tensor([0.7, 0.2, 0.1]), atol=0.03, rtol=0)


def test_progress_counts_to_the_end(stage):
    calls = []
    lift(stage.gaussians, stage.views[:3], stage.one_hot, progress=lambda *call: calls.append(call))
    assert calls[0] == (0, 3, "")
    assert [call[:2] for call in calls[1:]] == [(1, 3), (2, 3), (3, 3)]
    assert {call[2] for call in calls[1:]} == {"0000", "0001", "0002"}


def test_threads_are_restored_also_after_an_error(stage):
    before = get_threads()
    one = lift(stage.gaussians, stage.views[:2], stage.one_hot, threads=1)
    two = lift(stage.gaussians, stage.views[:2], stage.one_hot, threads=2)
    assert torch.equal(one.features, two.features)
    with pytest.raises(InputError):
        lift(stage.gaussians, stage.views[:2], {}, threads=before + 1)
    assert get_threads() == before


def test_maps_of_another_kind_are_refused(stage):
    def other_space(view: View) -> FeatureMap:
        return stage.dense(view) if view.stem == "0003" else stage.one_hot(view)

    with pytest.raises(InputError, match=r"view 0003: .*'toy'.*view 0000 .*'labels'"):
        lift(stage.gaussians, stage.views, other_space)

    def other_labels(view: View) -> FeatureMap:
        labels = ("1", "2", "3", "5") if view.stem == "0004" else ("1", "2", "3", "4")
        return FeatureMap("labels", ids=stage.labels(view) - 1, labels=labels)

    with pytest.raises(InputError, match="view 0004: feature map has labels"):
        lift(stage.gaussians, stage.views, other_labels)


def test_not_a_number_is_refused_unless_marked_invalid(stage):
    view = stage.views[0]
    dense = stage.dense(view).dense.clone()
    dense[5, 7] = math.nan
    with pytest.raises(InputError, match=r"view 0000: .* at 1 places"):
        lift(stage.gaussians, [view], {"0000": FeatureMap("toy", dense=dense)})
    valid = torch.ones(view.camera.size, dtype=torch.bool)
    valid[5, 7] = False
    lifted = lift(stage.gaussians, [view], {"0000": FeatureMap("toy", dense=dense, valid=valid)})
    assert torch.isfinite(lifted.features).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mode": "cubed"}, "mode: 'cubed'"),
        ({"tau": 0.0}, "tau must be positive"),
        ({"tau": math.nan}, "tau must be positive"),
        ({"border": -1}, "border not negative"),
        ({"share_of_views": 0.0}, "share_of_views"),
        ({"share_of_views": 1.5}, "share_of_views"),
        ({"views": []}, "no views"),
        ({"maps": 3}, "maps: expected"),
    ],
)
def test_bad_arguments(stage, change, message):
    arguments = {"views": stage.views, "maps": stage.one_hot, **change}
    with pytest.raises(InputError, match=message):
        lift(stage.gaussians, arguments.pop("views"), arguments.pop("maps"), **arguments)


def test_empty_scene_and_a_scene_elsewhere(stage):
    nothing = stage.gaussians.subset(torch.zeros(0, dtype=torch.int64))
    with pytest.raises(InputError, match="holds no Gaussians"):
        lift(nothing, stage.views, stage.one_hot)
    behind = type(stage.gaussians)(
        stage.gaussians.means * torch.tensor([1.0, 1.0, -1.0]),
        stage.gaussians.quats,
        stage.gaussians.scales,
        stage.gaussians.opacities,
        stage.gaussians.sh,
    )
    with pytest.raises(InputError, match="same world frame"):
        lift(behind, stage.views, stage.one_hot)


def test_non_finite_rows_are_counted_and_unseen(stage):
    means = stage.gaussians.means.clone()
    means[10] = math.nan
    scene = type(stage.gaussians)(
        means, stage.gaussians.quats, stage.gaussians.scales, stage.gaussians.opacities, stage.gaussians.sh
    )
    log = RunLog()
    lifted = lift(scene, stage.views[:2], stage.one_hot, log=log)
    assert log.left_out["non_finite_gaussians"] == 1
    assert not lifted.seen[10]
    assert torch.isfinite(lifted.features).all()


def test_interrupt_passes_through(stage):
    def interrupted(view: View) -> FeatureMap:
        if view.stem == "0001":
            raise KeyboardInterrupt
        return stage.one_hot(view)

    with pytest.raises(KeyboardInterrupt):
        lift(stage.gaussians, stage.views, interrupted)
