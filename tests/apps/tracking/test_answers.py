"""What a frame answers: values of pixels, rows over time, scores of texts, and the pictures that show them."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sgwarp.apps.tracking import pictures
from sgwarp.apps.tracking.answers import Questions, answer, query_scores
from sgwarp.apps.tracking.facts import sequence_facts
from sgwarp.apps.tracking.run import count_changes, gather
from sgwarp.apps.tracking.sources import LabelFrames
from sgwarp.apps.tracking.tracker import TrackedFrame
from sgwarp.errors import InputError
from sgwarp.files.images import read_rgb, write_ids, write_rgb
from sgwarp.io.moving_views import FrameView
from sgwarp.io.sequences import Frame
from sgwarp.ops.splatting.incremental import Work
from sgwarp.scene import Gaussians


def tracked(gaussians, features, weight=None, space="toy", labels=None):
    weight = torch.ones(len(gaussians)) if weight is None else weight
    known = (features, weight, weight)
    return TrackedFrame(0, gaussians, None, [], space, labels, *known, Work())


def spread(count):
    """Gaussians on a line."""
    means = torch.zeros(count, 3)
    means[:, 0] = torch.arange(count)
    quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(count, 4)
    return Gaussians(means, quats, torch.ones(count, 3), torch.ones(count), torch.zeros(count, 1, 3))


def test_the_score_of_a_text_is_the_mean_over_the_best_hundredth(toy_text):
    """Of 200 seen Gaussians two count: cosines 1 and 0.6; one that nothing saw does not."""
    features = torch.zeros(201, 5)
    features[:, 4] = 1.0
    features[7] = torch.tensor([0.0, 0.0, 1.0, 0.0, 0.0])
    features[9] = torch.tensor([0.0, 0.0, 0.6, 0.8, 0.0])
    features[200] = torch.tensor([0.0, 0.0, 1.0, 0.0, 0.0])
    weight = torch.ones(201)
    weight[200] = 0.0
    one = tracked(spread(201), features, weight)
    scores = query_scores(one, Questions(texts=("lamp", "wall"), encoder=toy_text))
    assert scores == {"lamp": pytest.approx(0.8), "wall": pytest.approx(0.0)}
    assert query_scores(one, Questions()) == {}
    with pytest.raises(InputError, match="texts: need features in a text space"):
        query_scores(tracked(spread(201), features, space="labels", labels=("1",) * 5), Questions(texts=("a",)))


def test_pixels_below_the_confidence_are_unknown(stage, toy_text):
    """Of the door half the evidence speaks for the lamp: it is the share of the door is 0.35, that of the lamp 0.48."""
    features = torch.nn.functional.one_hot(stage.classes - 1, 5).float()
    features[stage.classes == 2, 2] = 0.9
    one, view = tracked(stage.gaussians, features), stage.views[0]
    door = (stage.labels(view) == 2).numpy()
    asked = Questions(classes=("wall", "left door", "lamp", "book"), encoder=toy_text, temperature=1.0)
    plain = answer(one, asked, [view])
    assert (plain.images[view.stem][door] == 1).mean() > 0.9
    strict = answer(one, replace(asked, unknown_below=0.4), [view])
    assert (strict.images[view.stem][door] == 255).mean() > (plain.images[view.stem][door] == 255).mean() + 0.5
    assert (strict.images[view.stem][(stage.labels(view) == 3).numpy()] == 2).mean() > 0.8


def test_what_nothing_saw_belongs_to_no_object(stage, toy_text):
    features = torch.nn.functional.one_hot(stage.classes - 1, 5).float()
    weight = torch.where(stage.classes == 3, 0.0, 1.0)
    one = tracked(stage.gaussians, features, weight)
    found = answer(one, Questions(classes=("wall", "left door", "lamp", "book"), encoder=toy_text), [])
    assert set(found.channels[stage.classes == 3].tolist()) == {-1}
    assert [row["gaussians"] > 0 for row in found.objects] == [True, True, False, True]


def test_a_gaussian_changes_from_one_object_to_another_not_from_none():
    before, now = torch.tensor([0, 1, -1, 2, -1]), torch.tensor([0, 2, 1, -1, -1])
    assert count_changes(before, now) == 1
    assert count_changes(before, now[:4]) is None


def test_rows_become_tracks_in_the_order_of_the_ids():
    def row(frame, *names):
        objects = [{"name": name, "gaussians": frame, "centroid": None, "extent": None} for name in names]
        objects = [one | {"visible": True, "pixels": {"a": 3}} for one in objects]
        return {"frame": frame, "objects": objects, "scores": {"x": 0.5}, "changed_object": None, "left_out": 0.0}

    rows = [row(0, "10") | {"views": ["a"]}, row(1, "10", "2") | {"views": ["a"]}]
    tracks = gather(rows)
    assert list(tracks["objects"]) == ["2", "10"]
    assert tracks["objects"]["2"]["gaussians"] == [0, 1]
    assert tracks["objects"]["2"]["visible"] == [False, True]
    assert tracks["scores"] == {"x": [0.5, 0.5]}
    named = [one | {"objects": [{**thing, "name": f"n{thing['name']}"} for thing in one["objects"]]} for one in rows]
    assert list(gather(named)["objects"]) == ["n10", "n2"]


@pytest.mark.parametrize("name", ["00003/7.png", "3/7.png", "ims/7/a.png", "7/00003.png", "7/000003.png"])
def test_label_images_lie_in_any_of_five_places(stage, tmp_path, name):
    frames = LabelFrames(tmp_path)
    view = FrameView(replace(stage.views[0], stem="7"), file="ims/7/a.jpg")
    assert frames.find(3, view) is None
    write_ids(tmp_path / name, torch.ones(72, 96, dtype=torch.uint8))
    assert frames.find(3, view) == tmp_path / name
    assert frames.find(4, replace(view, file=None)) is None


def test_a_contact_sheet_spans_all_frames(tmp_path):
    """Nine of 33 pictures: every fourth, the first and the last among them."""
    paths = [tmp_path / f"{k:02d}.png" for k in range(33)]
    for k, path in enumerate(paths):
        write_rgb(path, np.full((4, 6, 3), 7 * k, np.uint8))
    pictures.write_contact_sheet(tmp_path / "sheet.png", paths)
    sheet = read_rgb(tmp_path / "sheet.png")
    assert sheet.shape == (12, 18, 3)
    assert sheet[::4, ::6, 0].flatten().tolist() == [28 * k for k in range(9)]


def test_facts_leave_out_steps_that_are_not_finite():
    means = spread(4).means
    moved = means.clone()
    moved[0, 1], moved[1, 2], moved[2, 0] = 3.0, 4.0, torch.nan

    class Two:
        def __len__(self):
            return 2

        def frame(self, index):
            return Frame(index, replace(spread(4), means=(means, moved)[index]))

    facts = sequence_facts(Two())
    assert (facts["moving_share"], facts["median_step"], facts["largest_step"]) == (0.75, 3.0, 4.0)
    assert facts["non_finite_rows"] == 1


def test_a_legend_names_what_is_shown_in_colors_that_stay():
    """Two of 60 objects are shown: no legend is longer, and colors are those of the ids."""
    names = tuple(str(k) for k in range(1, 61))
    image, photograph = np.zeros((40, 60), np.uint8), np.full((40, 60, 3), 255, np.uint8)
    image[:, :20], image[:, 20:30] = 7, 50
    picture = pictures.frame_picture([photograph], [image], names, range(1, 61), "title")
    assert len(picture) == pictures.LINE + 40
    wanted = pictures.object_colours(("7", "50"))
    legend = picture[:, 60:].reshape(-1, 3)
    found = [bool((legend == color).all(axis=1).any()) for color in (*wanted, *pictures.object_colours(("8",)))]
    assert found == [True, True, False]
    few = pictures.frame_picture([photograph], [image], ("7", "50"), (7, 50), "title")
    np.testing.assert_array_equal(few, picture)
    many = np.arange(2400).reshape(40, 60) // 40 + 1
    assert len(pictures.frame_picture([photograph], [many], names, range(1, 61), "t")) < 20 * pictures.LINE + 10


@pytest.mark.slow
def test_trajectories_have_gaps_where_an_object_was_away(tmp_path):
    """A line from (0, 0) to (10, 0) would cross the middle of the plot, where there is nothing."""

    def plot(visible):
        count = len(visible)
        centers = [[0.0 if k < count // 2 else 10.0, 0.0, 0.01 * k] for k in range(count)]
        one = {"centroid": centers, "visible": visible}
        assert pictures.write_trajectories(tmp_path / "t.png", {"frames": list(range(count)), "objects": {"1": one}})
        picture = read_rgb(tmp_path / "t.png").astype(int)
        color = pictures.object_colours(("1",))[0]
        middle = picture[60:-80, 250:450]
        return int((np.abs(middle - color).sum(axis=2) < 40).sum())

    assert plot([True] * 8) > 100
    assert plot([True] * 3 + [False] * 2 + [True] * 3) == 0
