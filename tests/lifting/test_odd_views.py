"""Views without a map, views of little worth, and settings at the ends of their ranges."""

import math
from dataclasses import replace

import pytest
import torch

from sgwarp.encoders.base import MissingMap
from sgwarp.errors import InputError
from sgwarp.lifting.lifter import lift
from sgwarp.lifting.map_reader import MapReader, as_source
from sgwarp.lifting.reliability import from_residuals
from sgwarp.lifting.residuals import residual
from sgwarp.lifting.settings import LiftSettings
from sgwarp.ops.splatting.settings import RasterSettings
from sgwarp.runs.log import RunLog
from sgwarp.scene import FeatureMap

MODES = ("weighted", "center", "squared", "strongest", "robust", "solve")


@pytest.mark.parametrize("missing", [0, 1, 4])
@pytest.mark.parametrize("mode", MODES)
def test_a_view_that_turns_out_to_have_no_map_is_as_if_it_were_not_there(stage, mode, missing):
    """Those after it count all the same, in every walk over the views."""
    views, absent = stage.views[:5], stage.views[missing].stem

    def encode(view):
        if view.stem == absent:
            raise MissingMap(f"none of {view.stem}")
        return stage.dense(view)

    options = {"mode": mode, "lift_settings": LiftSettings(ridge=10.0, passes=2, iterations=2, reliability=True)}
    log = RunLog()
    found = lift(stage.gaussians, views, encode, log=log, **options)
    without = lift(stage.gaussians, [view for view in views if view.stem != absent], stage.dense, **options)
    torch.testing.assert_close(found.weight, without.weight, rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(found.features, without.features, rtol=1e-3, atol=1e-4)
    assert log.left_out["views_without_map"] >= 1


RANGES = {  # the last values that are taken and the first that are refused
    "tau": ([1e-6, 9.0], [0.0, -1.0, math.nan]),
    "border": ([0], [-1]),
    "passes": ([1, 50], [0, math.inf]),
    "iterations": ([1, 50], [0, math.inf]),
    "fill": ([0, 1], [-1, math.inf]),
    "ridge": ([0.0, 1e6], [-1e-9, math.inf, math.nan]),
    "smoothing": ([1e-9, 1.0], [0.0, -1.0, math.inf]),
}


@pytest.mark.parametrize("name", RANGES)
def test_ranges_of_the_settings(name):
    taken, refused = RANGES[name]
    for value in taken:
        assert getattr(LiftSettings(**{name: value}), name) == value
    for value in refused:
        with pytest.raises(InputError, match=f"{name}"):
            LiftSettings(**{name: value})


@pytest.mark.parametrize("share", [0.0, -0.5, 1.001])
def test_shares_of_views_that_are_refused(stage, share):
    with pytest.raises(InputError, match=r"share_of_views: expected a share in \(0, 1\]"):
        lift(stage.gaussians, stage.views, stage.dense, share_of_views=share)


def test_what_views_are_worth():
    """(median / its own)^2 at most 1 and at least a hundredth; the median is of the known ones."""
    found = from_residuals({"a": 0.1, "b": 0.2, "c": 0.4, "d": math.nan, "e": 20.0, "f": 0.2})
    assert found == pytest.approx({"a": 1.0, "b": 1.0, "c": 0.25, "d": 1.0, "e": 0.01, "f": 1.0})
    assert from_residuals({"a": math.nan}) == {"a": 1.0}


@pytest.mark.parametrize(
    ("kind", "expected"), [("all of the first label", 0.0), ("another label", 1.0), ("none", math.nan)]
)
def test_pixels_that_a_residual_compares(stage, kind, expected):
    """Everything is lifted as the first label, and the map says so, says another, or says nothing."""
    view = stage.views[0]
    label = {"all of the first label": 0, "another label": 1, "none": -1}[kind]
    inside = stage.labels(view) > 0
    ids = torch.where(inside, label, -1)
    features = torch.tensor([1.0, 0.0]).expand(len(stage.gaussians), 2)
    weight = torch.ones(len(stage.gaussians))
    found = residual(stage.gaussians, view.camera, FeatureMap("labels", ids=ids, labels=("1", "2")), features, weight)
    assert found == pytest.approx(expected, abs=0.02, nan_ok=True)
    if label >= 0:  # the same as features: what is marked invalid is not compared
        dense = torch.nn.functional.one_hot(torch.full(view.camera.size, label), 2).float()
        dense[~inside] = torch.tensor([-1.0, 0.0])
        for valid, least in ((inside, expected), (None, expected + 0.01)):
            partly = residual(stage.gaussians, view.camera, FeatureMap("t", dense=dense, valid=valid), features, weight)
            assert partly == pytest.approx(expected, abs=0.02) if valid is not None else partly > least


def test_maps_are_kept_only_where_they_are_needed_again(stage):
    made = []

    def encode(view):
        made.append(view.stem)
        return stage.dense(view)

    for keep, count in ((False, 2), (True, 1)):
        reader = MapReader(stage.gaussians, as_source(encode), RasterSettings(), RunLog(), keep=keep)
        for _ in range(2):
            reader.read(stage.views[0])
        assert len(made) == count
        made.clear()


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("space", lambda found: replace(found, space="other")),
        ("channels", lambda found: replace(found, dense=found.dense[..., :3])),
    ],
)
def test_maps_of_two_kinds_name_both_views(stage, name, change):
    first, second = stage.views[:2]
    reader = MapReader(
        stage.gaussians,
        as_source(lambda view: stage.dense(view) if view is first else change(stage.dense(view))),
        RasterSettings(),
        RunLog(),
    )
    reader.read(first)
    with pytest.raises(InputError, match=rf"view {second.stem}: feature map has {name} .*, view {first.stem} has"):
        reader.read(second)


def test_images_for_a_source_that_looks_at_them(stage, stage_files):
    """The photograph where there is one, else a picture of the scene, with the thresholds of the run, in [0, 1]."""
    from sgwarp.io.views import load_views
    from sgwarp.rendering.renderer import render

    class Source:
        space, needs_image, seen = "toy", True, ()

        def encode(self, view, image):
            self.seen = (*self.seen, image)
            return stage.dense(view)

    source, log, coarse = Source(), RunLog(), RasterSettings(alpha_min=0.3)
    bright = replace(stage.gaussians, sh=stage.gaussians.sh + 2.0)
    reader = MapReader(bright, source, coarse, log)
    photographed, alone = load_views(stage_files.views)[0], stage.views[0]
    reader.read(photographed)
    reader.read(alone)
    assert torch.equal(source.seen[0], photographed.image())
    wanted = render(bright, alone.camera, settings=coarse).clamp(0.0, 1.0)
    torch.testing.assert_close(source.seen[1], wanted, rtol=0, atol=1e-6)
    assert log.left_out["photographs_rendered_instead"] == 1
    assert {"read", "render", "encode"} <= set(log.stages)


@pytest.mark.parametrize("mode", MODES)
def test_what_is_marked_invalid_may_be_anything(stage, mode):
    """NaN there changes no bit, in every walk over the views."""

    def maps(filling):
        found = {}
        for view in stage.views[:3]:
            whole = stage.dense(view)
            valid = torch.arange(whole.size[1]).expand(whole.size) % 5 > 0
            dense = torch.where(valid[..., None], whole.dense, filling)
            found[view.stem] = FeatureMap(whole.space, dense=dense, valid=valid)
        return found

    settings = LiftSettings(ridge=10.0, passes=2, iterations=2, reliability=True)
    zero, nan = (
        lift(stage.gaussians, stage.views[:3], maps(filling), mode, lift_settings=settings)
        for filling in (0.0, math.nan)
    )
    assert torch.equal(zero.features, nan.features)
    assert torch.equal(zero.weight, nan.weight)


@pytest.mark.parametrize("kind", ["features", "labels"])
def test_a_residual_is_that_of_the_means(stage, kind):
    """Sums of a large weight have no more say in a pixel than those of a small one."""
    view = stage.views[0]
    found = stage.dense(view) if kind == "features" else stage.one_hot(view)
    means = torch.rand(len(stage.gaussians), found.channels, generator=torch.Generator().manual_seed(0))
    weight = torch.logspace(-3, 3, len(means))[torch.randperm(len(means), generator=torch.Generator().manual_seed(1))]
    expected = residual(stage.gaussians, view.camera, found, means, torch.ones(len(means)))
    got = residual(stage.gaussians, view.camera, found, means * weight[:, None], weight)
    assert got == pytest.approx(expected, rel=1e-4)
    assert residual(stage.gaussians, view.camera, found, means * weight[:, None], torch.ones(len(means))) != (
        pytest.approx(expected, rel=1e-3)
    )
