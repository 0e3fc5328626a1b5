"""Tracking a generated scene: causal, the same incremental or in full, robust to noise, quick to see a new state."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from sgwarp.apps.tracking.answers import object_rows
from sgwarp.apps.tracking.association import Associated
from sgwarp.apps.tracking.fusion import Fusion, FusionSettings
from sgwarp.apps.tracking.points import carry_points, owners
from sgwarp.apps.tracking.sources import Growing
from sgwarp.apps.tracking.tracker import Tracker, TrackSettings, count_frames, track
from sgwarp.datasets.moving import LABELS, LAMP_ON, make_moving_scene, with_label_noise
from sgwarp.encoders.base import MissingMap
from sgwarp.errors import InputError
from sgwarp.io.moving_views import FrameView
from sgwarp.io.sequences import Frame, no_gaussians
from sgwarp.lifting.lifter import lift
from sgwarp.metrics.segmentation import ConfusionMatrix
from sgwarp.metrics.tracking import identity_switches, matches
from sgwarp.ops.splatting.lifting import LiftSums
from sgwarp.querying.segmentation import segment_votes
from sgwarp.scene import Camera, FeatureMap, Gaussians, View

NAMES = tuple(str(k + 1) for k in range(len(LABELS)))
FRAMES = 12
ALONE = TrackSettings(FusionSettings(0.0))


class Recorded:
    """The frames of a scene, which can be changed one by one."""

    def __init__(self, scene):
        self.frames = [Frame(index, scene.gaussians(index), None, scene.moving) for index in range(scene.frames)]

    def __len__(self):
        return len(self.frames)

    def frame(self, index):
        return self.frames[index]


@pytest.fixture(scope="module")
def scene():
    return make_moving_scene(0, FRAMES, 3000, cameras=6, width=96, height=72, moving_share=0.5)


@pytest.fixture(scope="module")
def truth(scene):
    return {(t, v.stem): scene.truth(t, v.camera) for t in range(FRAMES) for v in scene.cameras}


def label_maps(truth, noise=0.0):
    random = torch.Generator().manual_seed(3)
    changed = {key: with_label_noise(value, noise, random) if noise else value for key, value in truth.items()}
    return {key: FeatureMap("labels", ids=value - 1, labels=NAMES) for key, value in changed.items()}


def text_maps(truth, noise=0.0):
    """The same as vectors of a text space, a random unit vector per label."""
    vectors = torch.nn.functional.normalize(
        torch.randn(len(LABELS), 24, generator=torch.Generator().manual_seed(1)), dim=1
    )
    maps = label_maps(truth, noise)
    return {key: FeatureMap("toy", ids=value.ids, vectors=vectors) for key, value in maps.items()}


def run(scene, maps, settings, frames=FRAMES):
    return list(track(Recorded(scene), lambda frame: scene.cameras, maps, settings=settings, frames=frames))


def quality(scene, truth, frames):
    """mIoU of each frame over two views."""
    found = []
    for one in frames:
        counts = ConfusionMatrix.empty(len(LABELS))
        for view in scene.cameras[::3]:
            channel, _ = segment_votes(one.gaussians, view.camera, one.features, one.weight > 0)
            counts.add(channel, truth[one.index, view.stem] - 1)
        found.append(counts.miou)
    return found


def test_a_frame_alone_is_what_lift_gives(scene, truth):
    maps = label_maps(truth)
    for one in run(scene, maps, ALONE, 3):
        of_frame = {view.stem: maps[one.index, view.stem] for view in scene.cameras}
        wanted = lift(one.gaussians, scene.cameras, of_frame)
        assert torch.allclose(one.features, wanted.features, atol=2e-6)  # another order of the views
        assert torch.allclose(one.weight, wanted.weight, rtol=1e-5)
        assert one.semantics.fingerprint == wanted.fingerprint
        assert torch.allclose(one.effective_views, wanted.effective_views, rtol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("make", [label_maps, text_maps])
@pytest.mark.parametrize("forgetting", [0.0, 0.9])
def test_incremental_is_the_same_as_in_full(scene, truth, make, forgetting):
    maps = make(truth, 0.2)
    settings = TrackSettings(FusionSettings(forgetting))
    quick, full = run(scene, maps, settings, 4), run(scene, maps, replace(settings, incremental=False), 4)
    for one, other in zip(quick, full, strict=True):
        for name in ("features", "weight", "effective_views"):
            assert torch.equal(getattr(one, name), getattr(other, name))
    assert sum(one.work.left_out for one in quick[1:]) > 0
    assert all(one.work.left_out == 0.0 for one in full)


def test_no_frame_knows_the_future(scene, truth):
    settings = TrackSettings(FusionSettings(0.9))
    maps = label_maps(truth, 0.2)
    before = run(scene, maps, settings, 5)
    for key, value in label_maps(truth, 0.7).items():
        if key[0] >= 5:
            maps[key] = value
    for one, other in zip(before, run(scene, maps, settings, 6), strict=False):
        assert torch.equal(one.features, other.features)


@pytest.mark.slow
def test_fusion_beats_single_frames_under_noise(scene, truth):
    noisy = label_maps(truth, 0.2)
    alone = quality(scene, truth, run(scene, noisy, ALONE, 8))
    fused = quality(scene, truth, run(scene, noisy, TrackSettings(FusionSettings(0.9)), 8))
    assert sum(fused) / 8 > sum(alone) / 8 + 0.05


def shown_lit(scene, truth, one):
    """Share of the pixels of the lit lamp that are called so."""
    good = total = 0
    for view in scene.cameras:
        wanted = truth[one.index, view.stem] == LAMP_ON + 1
        channel, _ = segment_votes(one.gaussians, view.camera, one.features, one.weight > 0)
        good += int((channel[wanted] == LAMP_ON).sum())
        total += int(wanted.sum())
    return good / total


@pytest.mark.slow
@pytest.mark.parametrize("make", [label_maps, text_maps])
def test_a_new_state_does_not_smear(scene, truth, make):
    """Three frames after the lamp went on it is on, and nothing of its past is left in the features."""
    frames = run(scene, make(truth), TrackSettings(FusionSettings(0.95, patience=3)))
    alone = run(scene, make(truth), ALONE)
    switch = scene.switch
    if make is label_maps:
        assert shown_lit(scene, truth, frames[switch]) == 0.0  # not believed at once
        assert shown_lit(scene, truth, frames[switch + 3]) > 0.95 * shown_lit(scene, truth, alone[switch + 3])
        slow = run(scene, make(truth), TrackSettings(FusionSettings(0.95, patience=FRAMES)))
        assert shown_lit(scene, truth, slow[switch + 3]) == 0.0  # without the rule the past would stay
    else:
        mine = (scene.owner == 3) & (alone[switch + 3].weight > 0)
        pairs = frames[switch + 3].features[mine], alone[switch + 3].features[mine]
        assert float(torch.nn.functional.cosine_similarity(*pairs).median()) > 0.95


@pytest.mark.slow
def test_a_still_frame_changes_nothing(scene, truth):
    recorded, maps = Recorded(scene), label_maps(truth)
    recorded.frames[1] = replace(recorded.frames[0], index=1)
    maps |= {(1, view.stem): maps[0, view.stem] for view in scene.cameras}
    frames = list(track(recorded, lambda frame: scene.cameras, maps, settings=ALONE, frames=2))
    assert frames[1].unchanged
    assert frames[1].work.left_out == 1.0
    assert frames[1].features is frames[0].features


@pytest.mark.slow
def test_a_frame_without_gaussians(scene, truth):
    recorded, maps = Recorded(scene), label_maps(truth)
    recorded.frames[2] = Frame(2, no_gaussians())
    for settings in (ALONE, TrackSettings()):
        frames = list(track(recorded, lambda frame: scene.cameras, maps, settings=settings, frames=5))
        assert len(frames[2].features) == 0
        assert float((frames[3].weight > 0).float().mean()) > 0.5
    wanted = run(scene, maps, ALONE, 4)[3]
    assert torch.equal(
        list(track(recorded, lambda f: scene.cameras, maps, settings=ALONE, frames=5))[3].features, wanted.features
    )


@pytest.mark.parametrize("settings", [ALONE, TrackSettings()])
def test_nan_in_one_frame_and_a_gaussian_that_jumps(scene, truth, settings):
    recorded, maps = Recorded(scene), label_maps(truth)
    means = recorded.frames[3].gaussians.means.clone()
    means[10:20] = torch.nan
    means[25] = 1e4
    recorded.frames[3] = replace(recorded.frames[3], gaussians=replace(recorded.frames[3].gaussians, means=means))
    frames = list(track(recorded, lambda frame: scene.cameras, maps, settings=settings, frames=6))
    for one in frames:
        assert bool(torch.isfinite(one.features).all())
    clean = run(scene, maps, settings, 5)
    if settings is ALONE:
        assert not bool((frames[3].weight[10:20] > 0).any())
        assert float(frames[3].weight[25]) < 0.01  # 17 km away
        assert torch.equal(frames[4].features, clean[4].features)
    else:
        kept = frames[3].features[10:20].argmax(dim=1) == clean[2].features[10:20].argmax(dim=1)
        assert bool(kept.all())  # what is not seen keeps its past


def test_a_camera_inside_an_object(scene, truth):
    inside = scene.poses(0)[1][1]  # the pillar's centre
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = -inside
    camera = Camera(scene.cameras[0].camera.K, pose, 96, 72)
    views = [*scene.cameras, View("inside", camera)]
    maps = label_maps({**truth, **{(t, "inside"): scene.truth(t, camera) for t in range(3)}})
    frames = list(track(Recorded(scene), lambda frame: views, maps, settings=ALONE, frames=3))
    assert min(quality(scene, truth, frames)) > 0.6
    assert set(scene.truth(0, camera).unique().tolist()) == {LABELS.index("pillar") + 1}


def test_a_missing_map_leaves_its_view_out(scene, truth):
    maps = label_maps(truth)
    del maps[2, "1"]
    frames = run(scene, maps, ALONE, 4)
    without = [view for view in scene.cameras if view.stem != "1"]
    wanted = lift(frames[2].gaussians, without, {view.stem: maps[2, view.stem] for view in without})
    assert torch.allclose(frames[2].features, wanted.features, atol=2e-6)
    assert torch.equal(frames[3].features, run(scene, label_maps(truth), ALONE, 4)[3].features)


def test_a_missing_photograph_leaves_its_view_out(scene):
    class Bright:
        space, needs_image = "toy", True
        seen: list = []  # noqa: RUF012

        def encode(self, frame, view, image):
            self.seen.append((frame, view.view.stem))
            return FeatureMap("toy", dense=image)

    source = Bright()
    tracker = Tracker(source, ALONE)
    views = [FrameView(scene.cameras[0]), FrameView(scene.cameras[1], missing=True)]
    tracker.step(Recorded(scene).frame(0), views)
    assert source.seen == [(0, "0")]
    assert tracker.log.left_out["views_without_photograph"] == 1
    assert tracker.log.left_out["photographs_rendered_instead"] == 1
    source.needs_image = False  # label images do not ask for photographs
    source.encode = lambda frame, view, image: FeatureMap("toy", dense=torch.ones(72, 96, 3))
    tracker = Tracker(source, ALONE)
    tracker.step(Recorded(scene).frame(0), views)
    assert "views_without_photograph" not in tracker.log.left_out


def test_pictures_rendered_instead_of_photographs_lie_between_0_and_1(scene):
    class Bright:
        space, needs_image = "toy", True

        def encode(self, frame, view, image):
            assert 0.0 <= float(image.min()) < float(image.max()) == 1.0
            return FeatureMap("toy", dense=image)

    frame = Recorded(scene).frame(0)
    lit = replace(frame.gaussians, sh=10 * frame.gaussians.sh.abs())
    Tracker(Bright(), ALONE).step(replace(frame, gaussians=lit), [FrameView(scene.cameras[0])])


def test_counts_that_change_need_ids(scene, truth):
    recorded, maps = Recorded(scene), label_maps(truth)
    rows = torch.randperm(3000, generator=torch.Generator().manual_seed(0))[:2600]
    recorded.frames[2] = Frame(2, recorded.frames[2].gaussians.subset(rows))
    alone = list(track(recorded, lambda frame: scene.cameras, maps, settings=ALONE, frames=4))
    assert [len(one.features) for one in alone] == [3000, 3000, 2600, 3000]
    with pytest.raises(InputError, match="frame 2: has 2600 Gaussians, the frame before 3000, and no ids"):
        list(track(recorded, lambda frame: scene.cameras, maps, settings=TrackSettings(), frames=4))
    everyone = torch.arange(3000) * 7
    for index, frame in enumerate(recorded.frames):
        recorded.frames[index] = replace(frame, ids=everyone if index != 2 else everyone[rows])
    frames = list(track(recorded, lambda frame: scene.cameras, maps, settings=TrackSettings(), frames=4))
    known = frames[2].weight > 0
    of_all = run(scene, maps, TrackSettings(), 3)[2].features[rows]
    same = frames[2].features[known].argmax(dim=1) == of_all[known].argmax(dim=1)
    assert float(same.float().mean()) > 0.95  # the 400 that are gone hide nothing


def test_only_foreground_has_a_say(scene, truth):
    settings = TrackSettings(FusionSettings(0.0), foreground=True)
    one = next(iter(track(Recorded(scene), lambda frame: scene.cameras, label_maps(truth), settings=settings)))
    assert not bool((one.weight[~scene.moving] > 0).any())
    assert bool((one.weight[scene.moving] > 0).any())
    plain = Recorded(scene)
    plain.frames[0] = replace(plain.frames[0], foreground=None)
    with pytest.raises(InputError, match="no seg_colors"):
        next(iter(track(plain, lambda frame: scene.cameras, label_maps(truth), settings=settings)))


def test_maps_must_be_of_one_kind_and_finite(scene, truth):
    maps = label_maps(truth) | {(1, "0"): text_maps(truth)[1, "0"]}
    with pytest.raises(InputError, match="frame 1, view 0: feature map is in space 'toy'"):
        run(scene, maps, ALONE)
    dense = torch.zeros(72, 96, 3)
    dense[4, 5] = torch.nan
    maps = {(0, view.stem): FeatureMap("toy", dense=dense) for view in scene.cameras}
    with pytest.raises(InputError, match="frame 0, view 0: feature map holds NaN"):
        run(scene, maps, ALONE)
    with pytest.raises(InputError, match="frames: 99 are asked for"):
        count_frames(Recorded(scene), lambda frame: [], 99)


@pytest.mark.slow
def test_masks_without_identity_become_objects():
    """Ids are shuffled in every image, yet each large object is found at once and keeps its id.

    The pace is that of 60 frames a round: a crate turns by 12 degrees from frame to frame.
    """
    scene = make_moving_scene(0, 60, 8000, cameras=6, width=96, height=72, moving_share=0.5)
    random = torch.Generator().manual_seed(5)
    truth = {(t, view.stem): scene.truth(t, view.camera) for t in range(3) for view in scene.cameras}

    class Shuffled:
        needs_image = False

        def encode(self, frame, view, image):
            ids = torch.cat([torch.zeros(1, dtype=torch.int64), 1 + torch.randperm(14, generator=random)])
            return Growing().map_of(ids[truth[frame, view.view.stem]])

    found = []
    for one in track(
        Recorded(scene), lambda frame: scene.cameras, Associated(Shuffled()), settings=TrackSettings(), frames=3
    ):
        channels = torch.stack(
            [segment_votes(one.gaussians, v.camera, one.features, one.weight > 0)[0] for v in scene.cameras]
        )
        wanted = torch.stack([truth[one.index, view.stem] for view in scene.cameras])
        found.append(matches(channels + 1, wanted))
    large = [LABELS.index(name) + 1 for name in ("floor", "pillar", "table", "crate", "head", "lamp off")]
    settled = [{name: frame[name] for name in large if name in frame} for frame in found[1:]]
    assert identity_switches(settled) == 0
    assert min(map(len, settled)) == len(large)
    assert len(set(settled[-1].values())) == len(large)


@pytest.mark.parametrize("apart", [set(), {(0, 1)}])
def test_a_mask_of_two_objects_joins_them_unless_they_were_seen_as_two(apart):
    source = Associated(None)
    source.count, source._apart, source._sums = 2, set(apart), LiftSums.zeros(2, 2)
    source._sums.features[:] = torch.eye(2)
    masks, expected = torch.zeros(10, 10, dtype=torch.int64), torch.zeros(10, 10, dtype=torch.int64)
    expected[5:] = 1  # half of the one mask shows the second object
    table, joined = source._match(masks, expected, True)
    assert table.tolist() == [0, -1]
    assert joined == (not apart)
    assert source.joined == ([] if apart else [(0, 1)])
    assert source._sums.features.tolist() == ([[1, 0], [0, 1]] if apart else [[1, 0], [1, 0]])


def test_what_became_one_object_is_one_in_the_past_too():
    fusion = Fusion(FusionSettings(0.5), labels=True)
    fusion.join(0, 1)  # nothing is known yet
    fusion.update(sums_of([[0.25, 0.75, 0.0], [0.0, 0.0, 1.0]], [4.0, 2.0]), None)
    fusion.join(2, 1)
    fusion.join(0, 7)  # has not been seen
    assert fusion.evidence.features.tolist() == [[1.0, 0.0, 3.0], [0.0, 0.0, 2.0]]


def sums_of(features, weight):
    weights = torch.tensor(weight)
    sums = LiftSums.zeros(len(weights), len(features[0]))
    sums.features[:] = torch.tensor(features) * weights[:, None]
    return LiftSums(sums.slices, sums.channels, weights, weights.square())


def test_forgetting_by_hand():
    fusion = Fusion(FusionSettings(0.5, patience=2), labels=True)
    fusion.update(sums_of([[1.0, 0.0], [1.0, 0.0]], [4.0, 4.0]), None)
    found = fusion.update(sums_of([[0.8, 0.2], [0.0, 0.0]], [2.0, 0.0]), None)
    assert found.weight.tolist() == [4 * 0.5 + 2, 4.0]  # what is not seen is not forgotten
    assert torch.allclose(found.features, torch.tensor([[2 + 1.6, 0.4], [4.0, 0.0]]))
    assert found.weight_squared.tolist() == [16 * 0.25 + 4, 16.0]
    found = fusion.update(sums_of([[0.0, 1.0], [0.0, 1.0]], [1.0, 1.0]), None)
    assert found.weight.tolist() == [4.0, 4.0]  # contradicted once: kept
    found = fusion.update(sums_of([[0.0, 1.0], [1.0, 0.0]], [3.0, 1.0]), None)
    assert found.weight.tolist() == [3.0, 3.0]  # twice: dropped; or agreed again: 4 / 2 + 1
    assert found.features.tolist() == [[0.0, 3.0], [3.0, 0.0]]


def test_a_frame_that_does_not_see_a_gaussian_neither_contradicts_nor_agrees():
    fusion = Fusion(FusionSettings(0.5, patience=2), labels=True)
    fusion.update(sums_of([[1.0, 0.0]], [4.0]), None)
    assert fusion.update(sums_of([[0.0, 1.0]], [1.0]), None).against.tolist() == [1.0]
    assert fusion.update(sums_of([[0.0, 0.0]], [0.0]), None).against.tolist() == [1.0]
    assert fusion.update(sums_of([[0.0, 1.0]], [2.0]), None).weight.tolist() == [2.0]  # the second time: dropped
    fusion.update(sums_of([[1.0, 0.0]], [1.0]), None)
    assert fusion.update(sums_of([[0.0, 1.0]], [1.0]), None).against.tolist() == [0.0]  # agreeing starts anew


def test_in_a_text_space_a_contradiction_is_four_times_the_usual_distance():
    """Two of three turn by 0.2 rad, 1 - cos = 0.02; the third by 0.3 (0.045) agrees, by 0.5 (0.12) it does not."""

    def turned(*angles):
        return sums_of([[math.cos(angle), math.sin(angle)] for angle in angles], [1.0] * len(angles))

    for angle, agrees in ((0.3, True), (0.5, False)):
        fusion = Fusion(FusionSettings(0.5), labels=False)
        fusion.update(turned(0.0, 0.0, 0.0), None)
        found = fusion.update(turned(0.2, 0.2, angle), None)
        assert found.weight.tolist() == [1.5, 1.5, 1.5 if agrees else 1.0]
        assert found.against.tolist() == [0.0, 0.0, 0.0 if agrees else 1.0]
    labels = Fusion(FusionSettings(0.5), labels=True)
    labels.update(turned(0.0, 0.0, 0.0), None)
    assert labels.update(turned(0.2, 0.2, 0.5), None).weight.tolist() == [1.5] * 3


def test_settings_of_fusion():
    for wrong in ({"forgetting": 1.1}, {"forgetting": -0.1}, {"patience": 0}, {"change": 0.0}):
        with pytest.raises(InputError, match=next(iter(wrong))):
            FusionSettings(**wrong)


def test_labels_grow_and_keep_their_channels():
    growing = Growing()
    first = growing.map_of(torch.tensor([[0, 5], [5, 9]]))
    assert first.labels == ("5", "9")
    second = growing.map_of(torch.tensor([[2, 9], [0, 0]]))
    assert second.labels == ("5", "9", "2")
    assert second.ids.tolist() == [[[2, 1], [-1, -1]]]
    assert Growing().map_of(torch.zeros(2, 2)).ids.unique().tolist() == [-1]


def test_rows_of_objects_by_hand():
    """Gaussian 100 of the first object jumps 10 km away, and moves neither centroid nor extent."""
    line = torch.linspace(0.0, 1.0, 101)[:, None] * torch.tensor([[1.0, 2.0, 0.0]])
    line[100] = 1e4
    means = torch.cat([line, torch.tensor([[5.0, 5.0, 5.0], [torch.nan, 0.0, 0.0]])])
    n = len(means)
    quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(n, 4)
    gaussians = Gaussians(means, quats, torch.ones(n, 3), torch.ones(n), torch.zeros(n, 1, 3))
    channels = torch.tensor([*[0] * 101, 1, 1])
    images = {"a": np.array([[7, 7, 0]]), "b": np.array([[9, 0, 0]])}
    first, second, third = object_rows(gaussians, channels, ("x", "y", "z"), (7, 9, 3), images)
    assert first["gaussians"] == 101
    assert first["centroid"] == pytest.approx([0.5, 1.0, 0.0], abs=1e-5)  # of those from 0.02 to 0.98
    assert first["extent"] == pytest.approx([0.96, 1.92, 0.0], abs=1e-5)
    assert first["pixels"] == {"a": 2, "b": 0}
    assert second["gaussians"] == 1  # the other is not finite
    assert second["centroid"] == [5.0, 5.0, 5.0]
    assert (third["gaussians"], third["centroid"], third["visible"]) == (0, None, False)


def test_points_ride_on_gaussians():
    """A quarter turn about z and a shift, by hand; the wide Gaussian nearby covers less."""
    half = math.sqrt(0.5)
    one = Gaussians(
        torch.tensor([[1.0, 0.0, 0.0], [9.0, 0.0, 0.0]]),
        torch.tensor([[1.0, 0.0, 0.0, 0.0]] * 2),
        torch.full((2, 3), 0.3),
        torch.tensor([0.9, 0.9]),
        torch.zeros(2, 1, 3),
    )
    means, quats = (
        torch.tensor([[1.0, 2.0, 0.0], [9.0, 0.0, 0.0]]),
        torch.tensor([[half, 0.0, 0.0, half], [1, 0, 0, 0.0]]),
    )
    other = replace(one, means=means, quats=quats)

    class Two:
        def __len__(self):
            return 2

        def frame(self, index):
            return Frame(index, (one, other)[index])

    points = torch.tensor([[1.2, 0.0, 0.1], [50.0, 0.0, 0.0]])
    assert owners(one, points).tolist() == [0, 1]
    found = carry_points(Two(), points)
    assert torch.allclose(found[0], points.double())
    assert torch.allclose(found[1, 0], torch.tensor([1.0, 2.2, 0.1], dtype=torch.float64), atol=1e-6)
    with pytest.raises(InputError, match="finite values"):
        owners(one, torch.full((1, 3), torch.nan))


def test_points_on_bodies_follow_them(scene):
    start = scene.gaussians(0).means[::50]
    body = scene.owner[::50]
    found = carry_points(Recorded(scene), start)
    for index in (5, 11):
        R0, p0 = scene.poses(0)
        R, p = scene.poses(index)
        local = torch.einsum("kij,ki->kj", R0[body], start.double() - p0[body])
        wanted = torch.einsum("kij,kj->ki", R[body], local) + p[body]
        assert float((found[index] - wanted).norm(dim=1).median()) < 1e-5


def test_maps_of_any_kind_are_taken(scene, truth):
    maps = label_maps(truth)
    one = next(iter(track(Recorded(scene), lambda frame: scene.cameras, lambda t, view: maps[t, view.stem])))
    assert one.space == "labels"
    with pytest.raises(InputError, match="expected an encoder"):
        next(iter(track(Recorded(scene), lambda frame: scene.cameras, 5)))
    with pytest.raises(MissingMap):
        raise MissingMap("as sources do")
    nothing = next(iter(track(Recorded(scene), lambda frame: scene.cameras, {})))
    with pytest.raises(InputError, match="no view had a feature map"):
        _ = nothing.semantics


@pytest.mark.parametrize(
    ("apart", "after"),
    [
        ({(0, 3)}, {(0, 3)}),  # of neither
        ({(0, 2)}, {(0, 1)}),  # the other one first: 2 becomes 1
        ({(2, 3)}, {(1, 3)}),  # the other one last
        ({(0, 2), (2, 3), (0, 1)}, {(0, 1), (1, 3)}),
    ],
)
def test_what_was_apart_from_an_object_is_apart_from_the_one_that_it_became(apart, after):
    """Objects 1 and 2 become one; whoever was seen beside 2 was seen beside it."""
    source = Associated(None)
    source.count, source._apart, source._sums = 4, set(apart), LiftSums.zeros(2, 4)
    assert source._join(1, 2, torch.tensor([2, -1]))
    assert source._apart == after
    assert not source._join(*min(after), torch.tensor([-1]))
