"""Tracking at its limits: ids that an image can hold, maps that are refused, features that are stored again."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from sgwarp.apps.tracking import answers
from sgwarp.apps.tracking.answers import Questions, answer
from sgwarp.apps.tracking.association import Associated
from sgwarp.apps.tracking.facts import sequence_facts
from sgwarp.apps.tracking.fusion import Evidence, Fusion, FusionSettings
from sgwarp.apps.tracking.points import carry_points
from sgwarp.apps.tracking.state import FeatureStore, load_state, read_features, save_state
from sgwarp.apps.tracking.tracker import TrackedFrame, Tracker, _Plain
from sgwarp.errors import InputError
from sgwarp.files.torch_files import load_torch, save_torch
from sgwarp.io.moving_views import FrameView
from sgwarp.io.sequences import Frame
from sgwarp.ops.splatting.lifting import LiftSums
from sgwarp.scene import FeatureMap, Gaussians


def frame(features: torch.Tensor, gaussians=None, *, index=0, space="labels", labels=None, weight=None) -> TrackedFrame:
    count = len(features)
    weight = torch.ones(count) if weight is None else weight
    if gaussians is None:
        gaussians = SimpleNamespace(fingerprint="0" * 16)
    return TrackedFrame(index, gaussians, None, [], space, labels, features, weight, weight, None)


# Values of the pixels


@pytest.mark.parametrize(
    ("labels", "largest"), [(("1", "255"), np.uint8), (("1", "256"), np.uint16), (("0", "65535"), np.uint16)]
)
def test_ids_that_an_image_holds(stage, labels, largest):
    shares = torch.nn.functional.one_hot((stage.classes == 2).long(), 2).float()
    found = answer(frame(shares, stage.gaussians, labels=labels), Questions(), stage.views[:1])
    (image,) = found.images.values()
    assert (found.names, found.values) == (labels, tuple(map(int, labels)))
    assert image.dtype == largest
    inside = stage.labels(stage.views[0]).numpy()
    assert (image[inside == 2] == int(labels[1])).mean() > 0.9
    assert set(np.unique(image)) <= {0, *map(int, labels)}
    assert torch.equal(found.channels, (stage.classes == 2).long())


@pytest.mark.parametrize("wrong", ["65536", "-1", "lamp", "1.5"])
def test_labels_that_no_image_holds(stage, wrong):
    shares = torch.ones(len(stage.classes), 2)
    with pytest.raises(InputError, match=f"label '{wrong}' is no id that a 16-bit image can hold"):
        answer(frame(shares, stage.gaussians, labels=("1", wrong)), Questions(), stage.views[:1])


def test_classes_are_numbered_from_zero_and_the_unknown_is_255(stage, toy_text):
    features = torch.nn.functional.one_hot(stage.classes - 1, toy_text.encode_text(["x"]).shape[1]).float()
    asked = Questions(("lamp", "book"), encoder=toy_text)
    seen = (stage.classes >= 3).float()
    tracked = frame(features * seen[:, None], stage.gaussians, space=toy_text.space, weight=seen)
    found = answer(tracked, asked, stage.views[:1])
    assert found.values == (0, 1)
    assert [row["name"] for row in found.objects] == ["lamp", "book"]
    (image,) = found.images.values()
    inside = stage.labels(stage.views[0]).numpy()
    for number, value in ((3, 0), (4, 1), (1, 255), (0, 255)):
        assert (image[inside == number] == value).mean() > 0.8, number
    assert found.channels.tolist() == torch.where(seen > 0, stage.classes - 3, -1).tolist()


@pytest.mark.parametrize(("classes", "nothing"), [(("lamp",), 255), (None, 0)])
def test_a_frame_of_which_nothing_is_known(stage, classes, nothing):
    tracked = frame(torch.zeros(len(stage.classes), 1), stage.gaussians, space="")
    found = answer(tracked, Questions(classes, texts=("lamp",)), stage.views[:2])
    assert all((image == nothing).all() for image in found.images.values())
    assert [image.shape for image in found.images.values()] == [(72, 96)] * 2
    assert (found.scores, bool((found.channels == -1).all())) == ({"lamp": 0.0}, True)


def test_text_features_need_names_of_classes(stage):
    with pytest.raises(InputError, match="features in space 'toy' need the names of the classes"):
        answer(frame(torch.ones(len(stage.classes), 5), stage.gaussians, space="toy"), Questions(), [])
    asked = Questions(None, texts=("lamp",))
    with pytest.raises(InputError, match="texts: need features in a text space and its encoder"):
        answers.query_scores(frame(torch.ones(3, 1), labels=("1",)), asked)


# Maps that are refused


DENSE = torch.ones(2, 3, 4)
GOOD = FeatureMap("toy", dense=DENSE)


def spoiled(where: tuple[int, ...], value: float) -> torch.Tensor:
    dense = DENSE.clone()
    dense[where] = value
    return dense


VALID = torch.tensor([[True, True, True], [True, True, False]])
MAPS = {
    "the same again": (GOOD, None),
    "NaN": (FeatureMap("toy", dense=spoiled((0, 1, 2), math.nan)), "holds NaN or infinity"),
    "infinity": (FeatureMap("toy", dense=spoiled((0, 1, 2), math.inf)), "holds NaN or infinity"),
    "NaN where it is invalid": (FeatureMap("toy", dense=spoiled((1, 2, 0), math.nan), valid=VALID), None),
    "NaN where it is valid": (FeatureMap("toy", dense=spoiled((1, 1, 0), math.nan), valid=VALID), "holds NaN"),
    "a vector with NaN": (
        FeatureMap("toy", ids=torch.zeros(2, 3, dtype=torch.int64), vectors=torch.full((1, 4), math.nan)),
        "holds NaN",
    ),
    "another space": (FeatureMap("other", dense=DENSE), "in space 'other', those before in 'toy'"),
    "labels": (FeatureMap("toy", dense=DENSE, labels=("1", "2", "3", "4")), "feature map is in space"),
}


@pytest.mark.parametrize("name", MAPS)
def test_maps_of_a_moving_scene(name):
    found, message = MAPS[name]
    tracker = Tracker(_Plain(lambda index, view: None))
    tracker._check(0, "a", GOOD)
    assert (tracker.space, tracker.labels) == ("toy", None)
    if message is None:
        tracker._check(1, "b", found)
        return
    with pytest.raises(InputError, match=f"frame 1, view b: .*{message}"):
        tracker._check(1, "b", found)


def test_labels_are_those_of_the_last_map():
    tracker = Tracker(_Plain(lambda index, view: None))
    ids = torch.zeros(2, 3, dtype=torch.int64)
    for labels in (("1",), ("1", "2")):
        tracker._check(0, "a", FeatureMap("labels", ids=ids, labels=labels))
        assert tracker.labels == labels


# Fusion


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"forgetting": -0.01}, "forgetting: expected 0 to 1"),
        ({"forgetting": 1.01}, "forgetting: expected 0 to 1"),
        ({"patience": 0}, "patience: expected 1 frame or more"),
        ({"change": 0.0}, r"change: expected a cosine distance in \(0, 2\]"),
        ({"change": 2.01}, "change: expected a cosine distance"),
    ],
)
def test_settings_of_fusion_that_are_refused(given, message):
    with pytest.raises(InputError, match=message):
        FusionSettings(**given)


def test_settings_of_fusion_that_are_taken():
    for given in ({"forgetting": 0.0}, {"forgetting": 1.0}, {"patience": 1}, {"change": 2.0}, {"change": 1e-6}):
        settings = FusionSettings(**given)
        assert {name: getattr(settings, name) for name in given} == given


@pytest.mark.parametrize(("change", "contradicts"), [(0.1, False), (0.09, True), (None, True)])
def test_a_distance_that_is_given_takes_the_place_of_the_usual_one(change, contradicts):
    """Features 26 degrees apart: a cosine of 0.9, and so a distance of 0.1 between the two limits."""
    angle = math.acos(0.9)
    first = torch.tensor([[1.0, 0.0], [1.0, 0.0], [1.0, 0.0]])
    second = torch.tensor([[math.cos(angle), math.sin(angle)], [1.0, 0.0], [1.0, 0.0]])
    fusion = Fusion(FusionSettings(0.9, 1, change), False)
    for features in (first, second):
        sums = LiftSums.zeros(3, 2, "cpu")
        sums.features.copy_(features)
        sums.weight.fill_(1.0)
        known = fusion.update(sums, None)
    # With a patience of one frame what is contradicted is dropped, so that the frame alone is left.
    assert known.weight[0].item() == pytest.approx(1.0 if contradicts else 1.9)
    assert known.weight[1].item() == pytest.approx(1.9)


def test_only_rows_that_stay_can_be_fused_without_ids():
    fusion = Fusion(FusionSettings(), False)
    for count in (3, 4):
        sums = LiftSums.zeros(count, 2, "cpu")
        sums.weight.fill_(1.0)
        if count == 3:
            fusion.update(sums, None, 0)
            continue
        with pytest.raises(InputError, match="frame 7: has 4 Gaussians, the frame before 3, and no ids say which"):
            fusion.update(sums, None, 7)


# What is stored


@pytest.mark.parametrize("length", [1.0, 40.0])
@pytest.mark.parametrize(("change", "stored"), [(0.008, False), (0.012, True)])
def test_a_row_is_stored_again_where_it_moved_by_a_hundredth_of_its_length(tmp_path, length, change, stored):
    store = FeatureStore(tmp_path)
    first = torch.tensor([[1.0, 0.0], [0.0, 1.0], [0.0, 0.0]]) * length
    second = first.clone()
    second[0, 1] += change * length
    store.write(frame(first))
    assert (store.rows, store.all_rows) == (3, 3)
    store.write(frame(second, index=1))
    assert (store.rows, store.all_rows) == (3 + stored, 6)
    wanted = second if stored else first
    assert torch.equal(torch.from_numpy(read_features(tmp_path, 1)), wanted.half())
    assert torch.equal(torch.from_numpy(read_features(tmp_path, 0)), first.half())
    again = FeatureStore(tmp_path)
    again.resume(1)
    again.write(frame(second, index=2))
    assert torch.equal(torch.from_numpy(read_features(tmp_path, 2)), wanted.half())
    assert again.rows == 0


def test_what_is_not_known_is_stored_as_zero_and_another_shape_as_a_whole(tmp_path):
    store = FeatureStore(tmp_path)
    store.write(frame(torch.ones(2, 2), weight=torch.tensor([1.0, 0.0])))
    assert read_features(tmp_path, 0).tolist() == [[1.0, 1.0], [0.0, 0.0]]
    store.write(frame(torch.ones(2, 3), index=1))
    assert (read_features(tmp_path, 1).tolist(), store.rows) == ([[1.0] * 3] * 2, 4)
    (tmp_path / "00000.npz").unlink()
    with pytest.raises(InputError, match=r"00000\.npz"):
        read_features(tmp_path, 1)


def evidence() -> Evidence:
    return Evidence(torch.ones(2, 3), torch.ones(2), torch.ones(2), torch.zeros(2), torch.tensor([5, 6]))


def test_a_state_gives_back_what_was_known(tmp_path):
    tracker = Tracker(_Plain(lambda index, view: None))
    tracker.space, tracker.labels = "labels", ("1", "2", "3")
    tracker.fusion = Fusion(FusionSettings(), True)
    tracker.fusion.evidence = evidence()
    save_state(tmp_path, tracker, 4, {"every": 2}, torch.tensor([0, 2]))
    again = Tracker(_Plain(lambda index, view: None))
    found, channels = load_state(tmp_path, again, {"every": 2})
    assert (found, channels.tolist()) == (4, [0, 2])
    assert (again.space, again.labels, again.fusion.labels) == ("labels", ("1", "2", "3"), True)
    for name, value in vars(evidence()).items():
        assert torch.equal(getattr(again.fusion.evidence, name), value), name
    assert load_state(tmp_path / "none", again, {}) is None
    for settings, message in (
        ({"every": 3}, "the interrupted run had every 2, now 3"),
        ({}, "the interrupted run had every 2, now None"),
        ({"every": 2, "split": "x"}, "the interrupted run had split None, now 'x'"),
    ):
        with pytest.raises(InputError, match=message):
            load_state(tmp_path, again, settings)
    path = tmp_path / "state.pt"
    content = load_torch(path)
    save_torch(path, {**content, "format": 2})
    with pytest.raises(InputError, match="is of format 2, this version knows 1; start anew"):
        load_state(tmp_path, again, {"every": 2})
    del content["space"]
    save_torch(path, content)
    with pytest.raises(InputError, match=r"is damaged \(KeyError\); start anew without --resume"):
        load_state(tmp_path, again, {"every": 2})


# Masks without ids


def test_what_is_remembered_fades_and_stays_when_objects_appear(stage):
    """The second frame shows a part that the first did not; of the first seven tenths are left."""
    view = FrameView(stage.views[0])
    labels = stage.labels(stage.views[0])
    first = torch.where(labels == 2, 0, -1)
    # Sixteen objects and more: their sums take another slice of channels.
    y, x = torch.meshgrid(torch.arange(72), torch.arange(96), indexing="ij")
    second = torch.where(labels == 1, y // 12 * 6 + x // 16 + 1, first)
    shown = {0: first, 1: second.unique(return_inverse=True)[1].view(72, 96) - 1}

    def encode(frame, view, image):
        ids = shown[frame]
        return FeatureMap("labels", ids=ids, labels=tuple(map(str, range(int(ids.max()) + 1))))

    found = Associated(SimpleNamespace(encode=encode))
    found.observe(0, stage.gaussians, [view])
    before = found._sums.features[:, 0].clone()
    assert found.count == 1
    found.observe(1, stage.gaussians, [view])
    assert found.count > 16
    torch.testing.assert_close(found._sums.features[:, 0], 1.7 * before, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(found._sums.features.sum(dim=1), found._sums.weight, rtol=1e-4, atol=1e-4)
    assert torch.equal(found._ready[view.view.stem] == 0, labels == 2)


@pytest.mark.parametrize("kind", ["dense", "vectors"])
def test_masks_without_ids_are_id_images(stage, kind):
    wrong = {
        "dense": FeatureMap("t", dense=torch.ones(2, 2, 1)),
        "vectors": FeatureMap("t", ids=torch.zeros(2, 2, dtype=torch.int64), vectors=torch.ones(1, 1)),
    }[kind]
    found = Associated(SimpleNamespace(encode=lambda frame, view, image: wrong))
    with pytest.raises(InputError, match=r"frame 3, view .*: has no id image; masks without ids need one"):
        found.observe(3, stage.gaussians, [FrameView(stage.views[0])])


def test_points_need_gaussians_that_stay(stage):
    frames = [stage.gaussians, stage.gaussians.subset(torch.arange(9))]
    sequence = SimpleNamespace(frame=lambda index: SimpleNamespace(gaussians=frames[index]))
    with pytest.raises(InputError, match=f"frame 1: has 9 Gaussians, frame 0 {len(frames[0])}; points ride on rows"):
        carry_points(sequence, torch.zeros(1, 3), frames=(0, 1))
    lost = Gaussians(*(torch.full((1, *shape), math.nan) for shape in ((3,), (4,), (3,), (), (1, 3))))
    for start, points, message in (
        (lost, torch.zeros(1, 3), "no finite Gaussian to ride on"),
        (frames[0], torch.full((1, 3), math.inf), r"expected finite values of shape \[K, 3\]"),
    ):
        sequence = SimpleNamespace(frame=lambda index, start=start: SimpleNamespace(gaussians=start))
        with pytest.raises(InputError, match=message):
            carry_points(sequence, points, frames=(0,))


def test_foreground_needs_a_column(stage):
    tracker = Tracker(_Plain(lambda index, view: None))
    tracker.settings = replace(tracker.settings, foreground=True)
    with pytest.raises(InputError, match="frame 2: the scene has no seg_colors that tell foreground"):
        tracker._tracked(SimpleNamespace(foreground=None, index=2), stage.gaussians, [], evidence(), None)


def test_facts_compare_gaussians_of_one_identity():
    """Of ids 7, 3 and 5 the second frame has 5, 9 and 7: 7 moves by two meters, 5 stays, 9 has no partner."""

    def moment(index, ids, places):
        means = torch.tensor(places)[:, None] * torch.tensor([[1.0, 0.0, 0.0]])
        quats, count = torch.tensor([[1.0, 0.0, 0.0, 0.0]]), len(ids)
        shape = (quats.expand(count, 4), torch.ones(count, 3), torch.ones(count), torch.zeros(count, 1, 3))
        return Frame(index, Gaussians(means, *shape), torch.tensor(ids), torch.tensor([True, False, True]))

    frames = [moment(0, [7, 3, 5], [0.0, 1.0, 4.0]), moment(1, [5, 9, 7], [4.0, 50.0, 2.0])]

    class Frames:
        def __len__(self):
            return 2

        def frame(self, index):
            return frames[index]

    facts = sequence_facts(Frames())
    assert (facts["frames"], facts["gaussians"], facts["identity"]) == (2, 3, "ids")
    assert facts["moving_share"] == pytest.approx(0.5)
    assert (facts["median_step"], facts["largest_step"]) == (2.0, 2.0)
    assert facts["foreground_share"] == pytest.approx(2 / 3)
    assert facts["non_finite_rows"] == 0


def test_objects_without_identity_are_numbered_from_one(stage):
    """0 is unknown in every label image that is written."""
    source = Associated(None)
    (view, *_) = stage.views
    source._ready, source.count = {view.stem: torch.zeros(view.camera.size, dtype=torch.int64)}, 3
    assert source.encode(0, FrameView(view), None).labels == ("1", "2", "3")
