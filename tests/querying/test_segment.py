"""What the scores look like from a camera, against the geometry of the stage."""

from dataclasses import replace

import pytest
import torch

from sgwarp.errors import InputError
from sgwarp.lifting.lifter import lift
from sgwarp.metrics.segmentation import ConfusionMatrix
from sgwarp.querying.scores import class_votes, query
from sgwarp.querying.segmentation import UNKNOWN, box_mean, label_image, localize, segment, splat_scores
from sgwarp.scene import Camera, Gaussians, Semantics

NAMES = ["wall", "left door", "lamp", "book"]


@pytest.fixture(scope="module")
def held_out(stage):
    return stage.views[2]


@pytest.fixture(scope="module")
def toy_semantics(stage, held_out):
    return lift(stage.gaussians, [view for view in stage.views if view is not held_out], stage.dense)


@pytest.fixture(scope="module")
def lifted_labels(stage, held_out):
    return lift(stage.gaussians, [view for view in stage.views if view is not held_out], stage.one_hot)


def test_text_classes_on_a_held_out_view(stage, toy_semantics, toy_text, held_out):
    labels, confidence = segment(stage.gaussians, toy_semantics, NAMES, held_out.camera, toy_text)
    truth = stage.labels(held_out) - 1  # -1 in the void, which is not scored
    scores = ConfusionMatrix.empty(4)
    scores.add(labels, truth)
    assert labels.dtype == torch.int64
    assert confidence.shape == (*held_out.camera.size, 4)
    assert scores.miou > 0.9
    known = labels != UNKNOWN
    torch.testing.assert_close(confidence.sum(dim=2)[known], torch.ones(int(known.sum())), atol=1e-3, rtol=0)


def test_the_order_of_classes_is_the_users(stage, toy_semantics, toy_text, held_out):
    forward, _ = segment(stage.gaussians, toy_semantics, NAMES, held_out.camera, toy_text)
    backward, _ = segment(stage.gaussians, toy_semantics, NAMES[::-1], held_out.camera, toy_text)
    known = forward != UNKNOWN
    assert torch.equal(known, backward != UNKNOWN)
    assert (forward + backward == 3)[known].float().mean() > 0.999  # ties may go either way


def test_the_void_is_unknown_and_never_class_0(stage, toy_semantics, toy_text, held_out):
    labels, _ = segment(stage.gaussians, toy_semantics, NAMES, held_out.camera, toy_text)
    void = stage.labels(held_out) == 0
    inside = ~torch.nn.functional.max_pool2d((~void).float()[None], 5, 1, 2)[0].bool()  # away from the rim
    assert inside.sum() > 100
    assert (labels[inside] == UNKNOWN).all()


def test_gaussians_that_were_not_seen_hide_but_have_no_say(stage, lifted_labels, held_out):
    """Take the door's semantics away: its pixels become unknown, not the wall behind it."""
    door = stage.classes == 2
    weight = torch.where(door, 0.0, lifted_labels.weight)
    blind = replace(lifted_labels, weight=weight)
    ids, _ = segment(stage.gaussians, blind, None, held_out.camera)
    truth = stage.labels(held_out)
    eroded = -torch.nn.functional.max_pool2d(-(truth == 2).float()[None], 5, 1, 2)[0] > 0
    assert eroded.sum() > 50
    assert (ids[eroded] == 0).all()
    assert (ids == truth)[truth == 3].float().mean() > 0.9


def test_lifted_ids_come_back_as_ids(stage, lifted_labels, held_out):
    ids, confidence = segment(stage.gaussians, lifted_labels, None, held_out.camera)
    truth = stage.labels(held_out)
    assert (ids == truth).float().mean() > 0.93
    assert confidence.shape[2] == 4
    far_apart = replace(lifted_labels, labels=("7", "300", "12", "70000"))
    renamed, _ = segment(stage.gaussians, far_apart, None, held_out.camera)
    assert torch.equal(renamed, torch.tensor([0, 7, 300, 12, 70000])[ids])


def test_labels_that_were_not_asked_for_are_unknown(stage, lifted_labels, held_out):
    """Of the lifted labels only door and book are wanted: the wall's little share of them must not win its pixels."""
    labels, _ = segment(stage.gaussians, lifted_labels, ["4", "2"], held_out.camera)
    truth = stage.labels(held_out)
    expected = torch.tensor([UNKNOWN, UNKNOWN, 1, UNKNOWN, 0])[truth]
    assert (labels == expected).float().mean() > 0.95


def test_label_image():
    channel = torch.tensor([[-1, 0, 2]])
    assert label_image(channel).tolist() == [[UNKNOWN, 0, 2]]
    lifted = Semantics(torch.zeros(1, 3), torch.ones(1), torch.ones(1), "labels", "0" * 16, ("5", "6", "9"))
    assert label_image(channel, lifted).tolist() == [[0, 5, 9]]
    with pytest.raises(InputError, match="choose classes among: sofa, 6, 9"):
        label_image(channel, replace(lifted, labels=("sofa", "6", "9")))


def test_unknown_below(stage, toy_semantics, toy_text, held_out):
    def unknown(least):
        labels, confidence = segment(
            stage.gaussians, toy_semantics, NAMES, held_out.camera, toy_text, unknown_below=least
        )
        best = confidence.max(dim=2).values
        assert (best[labels != UNKNOWN] >= least).all()
        return int((labels == UNKNOWN).sum())

    assert unknown(0.0) < unknown(0.95) < held_out.camera.width * held_out.camera.height
    assert unknown(1.1) == held_out.camera.width * held_out.camera.height


def test_splatted_scores_are_means_not_sums(stage, held_out):
    """A score that all Gaussians share is that score at every known pixel, however thin the coverage."""
    scores = torch.full((len(stage.gaussians), 2), 0.3)
    scores[:, 1] = -0.7
    mean, known = splat_scores(stage.gaussians, held_out.camera, scores, torch.ones(len(scores), dtype=torch.bool))
    torch.testing.assert_close(mean[known], torch.tensor([0.3, -0.7]).expand(int(known.sum()), 2), atol=1e-5, rtol=0)
    assert 0.5 < known.float().mean() < 1.0


@pytest.mark.parametrize("number", [1, 2, 3])
@pytest.mark.parametrize("box", [1, 5])
def test_localize_hits_the_panel(stage, toy_semantics, toy_text, held_out, number, box):
    scores = query(toy_semantics, NAMES, toy_text)[:, number]
    (x, y), score_map = localize(scores, stage.gaussians, held_out.camera, seen=toy_semantics.seen, box=box)
    assert stage.labels(held_out)[y, x] == number + 1
    assert score_map[y, x] == score_map.max()
    assert torch.isinf(score_map).any()


def test_localize_prefers_negative_scores_to_the_void(stage, held_out):
    scores = torch.where(stage.classes == 4, -0.5, -0.9)
    (x, y), _ = localize(scores, stage.gaussians, held_out.camera)
    assert stage.labels(held_out)[y, x] == 4


def test_box_mean_against_a_loop():
    rng = torch.Generator().manual_seed(0)
    image, known = torch.rand(7, 9, generator=rng), torch.rand(7, 9, generator=rng) > 0.4
    for side in (1, 3, 4):
        expected = torch.zeros(7, 9)
        for y in range(7):
            for x in range(9):
                low = (side - 1) // 2
                window = [
                    image[v, u]
                    for v in range(max(0, y - low), min(7, y - low + side))
                    for u in range(max(0, x - low), min(9, x - low + side))
                    if known[v, u]
                ]
                expected[y, x] = sum(window) / len(window) if window else 0.0
        torch.testing.assert_close(box_mean(image, known, side), expected, atol=1e-6, rtol=0)


@pytest.mark.parametrize(("opacity", "known"), [(0.45, False), (0.55, True)])
def test_a_pixel_is_known_from_half_an_opacity_on(opacity, known):
    """A single Gaussian, far wider than the view."""
    camera = Camera(torch.tensor([[20.0, 0, 8], [0, 20, 8], [0, 0, 1]]), torch.eye(4), 16, 16)
    wall = Gaussians(
        torch.tensor([[0.0, 0, 2]]),
        torch.tensor([[1.0, 0, 0, 0]]),
        torch.full((1, 3), 100.0),
        torch.tensor([opacity]),
        torch.zeros(1, 1, 3),
    )
    mean, seen = splat_scores(wall, camera, torch.tensor([[0.7]]), torch.tensor([True]))
    assert (seen == known).all()
    torch.testing.assert_close(mean, torch.full_like(mean, 0.7))


def test_a_temperature_that_cannot_be_is_refused(toy_semantics, lifted_labels, toy_text):
    """Also where labels need none."""
    for semantics in (toy_semantics, lifted_labels):
        with pytest.raises(InputError, match="temperature"):
            class_votes(semantics, ["1"], toy_text, temperature=0.0)


def test_refusals(stage, toy_semantics, toy_text, held_out):
    camera = held_out.camera
    other = stage.gaussians.subset(torch.arange(len(stage.gaussians)).flip(0))
    with pytest.raises(InputError, match="belong to scene"):
        segment(other, toy_semantics, NAMES, camera, toy_text)
    with pytest.raises(InputError, match="at most 255"):
        segment(stage.gaussians, toy_semantics, [str(k) for k in range(256)], camera, toy_text)
    with pytest.raises(InputError, match="names of the classes"):
        segment(stage.gaussians, toy_semantics, None, camera, toy_text)
    with pytest.raises(InputError, match=r"scores \[N\]"):
        localize(torch.zeros(3, 2), stage.gaussians, camera)
    with pytest.raises(InputError, match="expected scores"):
        localize(torch.zeros(3), stage.gaussians, camera)
    with pytest.raises(InputError, match="shows no Gaussian"):
        localize(torch.zeros(len(other)), other, camera, seen=torch.zeros(len(other), dtype=torch.bool))
