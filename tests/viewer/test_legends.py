"""Legends against the colors that are drawn, paint of what views saw, and bounds of numbers and texts."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sgwarp.errors import InputError
from sgwarp.scene import Semantics
from sgwarp.viewer import bounds, legends
from sgwarp.viewer.markup import as_plain, legend_rows, notice, score_table, score_text
from sgwarp.viewer.modes import BELOW, draw
from sgwarp.viewer.paints import coverage_colors, instance_colors
from sgwarp.visualization.pictures import class_colours, depth_picture


def rgb(color: str) -> list[int]:
    return list(bytes.fromhex(color.removeprefix("#")[:6]))


def test_opacity_is_drawn_in_the_colors_of_its_legend(tab, stage):
    tab.set_mode("opacity")
    (opaque, white), (nothing, black) = tab.legend()
    assert (opaque, nothing) == ("opaque", "nothing")
    pixels, labels = draw(tab.shot(), tab.camera).pixels, stage.labels(stage.views[2]).numpy()
    assert np.abs(pixels[labels == 3].astype(int).mean(axis=0) - rgb(white)).max() < 40
    assert np.abs(pixels[labels == 0].astype(int).mean(axis=0) - rgb(black)).max() < 40


def test_depth_is_drawn_in_the_colors_of_its_legend():
    picture = depth_picture(np.array([[1.0, 9.0, 0.0]], np.float32)).astype(int)
    rows = legends.legend("depth", None)
    assert [name for name, _ in rows] == ["near", "far", "no surface"]
    for pixel, (name, color) in zip(picture[0], rows, strict=True):
        assert np.abs(pixel - rgb(color)).max() <= 12, name


def test_coverage_is_painted_in_the_colors_of_its_legend(stage):
    """By views that count, whatever their weight; half way between the ends it is half of both."""
    count = torch.tensor([0.0, 1.0, 8.0, 30.0, 4.5])
    semantics = Semantics(torch.ones(5, 2), torch.tensor([0.0, 900.0, 0.1, 0.1, 3.0]), count, "toy", "0" * 16)
    paint = coverage_colors(stage.gaussians, semantics, ()) * 255
    rows = legends.legend("coverage", None)
    assert [name for name, _ in rows] == ["no view", "one view", "8 views or more"]
    colors = torch.tensor([rgb(color) for _, color in rows], dtype=torch.float32)
    torch.testing.assert_close(paint[:3], colors, rtol=0, atol=1.0)
    torch.testing.assert_close(paint[3], paint[2])
    torch.testing.assert_close(paint[4], (paint[1] + paint[2]) / 2)
    with pytest.raises(InputError, match="--semantics or --views"):
        coverage_colors(stage.gaussians, None, ())


def test_several_queries_have_a_row_each_and_one_for_the_rest(tab):
    tab.ask("lamp; book")
    rows = tab.legend()
    assert [name for name, _ in rows] == ["lamp", "book", "below the threshold"]
    assert [rgb(color) for _, color in rows[:2]] == class_colours(2).tolist()
    assert rgb(rows[2][1]) == [round(255 * BELOW)] * 3
    tab.set_mode("segmentation")
    assert rgb(tab.legend()[-1][1]) == [0x55] * 3


def test_a_legend_names_so_many_instances(instances, monkeypatch):
    monkeypatch.setattr(legends, "LISTED", 3)
    rows = legends.legend("instances", None, instances)
    assert [name for name, _ in rows] == ["wall", "left door", "lamp", "and more"]
    monkeypatch.setattr(legends, "LISTED", 4)
    assert [name for name, _ in legends.legend("instances", None, instances)][-1] == "object 8"
    assert [name for name, _ in legends.legend("instances", None, instances, "s")] == [
        f"object {k}" for k in (1, 2, 3, 4)
    ]
    assert legends.legend("instances", None, None) == []


def test_instances_are_painted_by_their_id(instances):
    for level, first in ((None, 5), ("m", 5), ("s", 1)):
        paint, known = instance_colors(instances, level)
        ids = instances.instance(level or "m")
        assert torch.equal(known, ids > 0)
        assert bool((ids[known] >= first).all())
        wanted = torch.from_numpy(class_colours(8)[ids[known].numpy() - 1]).float() / 255
        torch.testing.assert_close(paint[known], wanted)
        assert not paint[~known].any()


@pytest.mark.parametrize("mode", ["color", "features", "relevancy", "segmentation"])
def test_modes_say_what_is_missing(mode):
    assert legends.legend(mode, None) == []
    text = legends.missing(mode, None)
    assert (mode in text and "write a query" in text) if mode in ("relevancy", "segmentation") else text == ""


# Bounds


@pytest.mark.parametrize("value", [2.5, -2.5, float("nan"), float("inf"), -float("inf"), None, "x"])
def test_every_number_of_several_is_bounded(value):
    assert bounds.numbers("place", (2.0, -2.0, 0), 3, 2.0) == (2.0, -2.0, 0.0)
    for at in range(3):
        values = [0.0, 0.0, 0.0]
        values[at] = value
        with pytest.raises(InputError, match="place: expected 3 numbers of at most 2"):
            bounds.numbers("place", values, 3, 2.0)
    for wrong in ((0.0, 0.0), (0.0,) * 4):
        with pytest.raises(InputError, match="place: expected 3 numbers"):
            bounds.numbers("place", wrong, 3, 2.0)


def test_whole_numbers_and_choices_are_bounded():
    assert [bounds.whole("n", value, 0, 3) for value in (0, 3, 2.0)] == [0, 3, 2]
    for value in (-1, 4, 1.5, True, "1"):
        with pytest.raises(InputError, match="n: expected a"):
            bounds.whole("n", value, 0, 3)
    assert bounds.choice("mode", "a", ("a", "b")) == "a"
    with pytest.raises(InputError, match="mode: expected one of a, b, got 'c'"):
        bounds.choice("mode", "c", ("a", "b"))


def test_a_text_keeps_its_words_apart():
    assert bounds.text("query", "  lamp\nbook\tred\x00couch ") == "lamp book red couch"
    assert len(bounds.text("query", "a" * bounds.MOST_TEXT)) == bounds.MOST_TEXT
    for value in ("a" * (bounds.MOST_TEXT + 1), 7, None):
        with pytest.raises(InputError, match=f"query: expected a text of at most {bounds.MOST_TEXT} letters"):
            bounds.text("query", value)


IDENTITY, CENTER = (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
PAGE = {"wxyz": IDENTITY, "position": CENTER, "fov": 1.0, "width": 640, "height": 480, "near": 0.1, "far": 9.0}


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("wxyz", (0.0, 0.0, 0.0, 0.0), "has no direction"),
        ("wxyz", (3.0, 0.0, 0.0, 0.0), "camera rotation: expected 4 numbers"),
        ("position", (0.0, 0.0, 2e12), "camera position: expected 3 numbers"),
        ("fov", 0.0, "field of view"),
        ("fov", 3.1, "field of view"),
        ("width", 0, "width"),
        ("height", 2e6, "height"),
    ],
)
def test_a_camera_out_of_bounds_is_refused(name, value, message):
    found = bounds.viewpoint(*PAGE.values())
    assert (found.size, found.near, found.far) == ((480, 640), 0.1, 9.0)
    with pytest.raises(InputError, match=message):
        bounds.viewpoint(**{**PAGE, name: value})


def test_what_users_typed_stays_text():
    assert legend_rows([]) == score_table([]) == notice("") == ""
    rows = legend_rows([("<b>", "#010203"), ("lamp", "#aabbcc")])
    assert "&lt;b&gt;" in rows
    assert rows.index("#010203") < rows.index("&lt;b&gt;") < rows.index("#aabbcc") < rows.index("lamp")
    table = score_table([("<i>", 0.256), ("over", 1.7), ("under", -0.3)])
    assert "&lt;i&gt;" in table
    assert [part.partition("%")[0] for part in table.split("width:")[1:] if "40%" not in part[:4]] == [
        "90",
        "26",
        "100",
        "0",
    ]
    assert [score_text(value) for value in (0.256, -0.001, 1.7)] == ["0.26", "0.00", "1.70"]
    assert "0.26" in table
    assert notice("a < b").count("a &lt; b") == 1
    assert as_plain("a*b_[c]") == r"a\*b\_\[c\]"


def test_a_selection_says_what_it_is(instances, tab):
    found = tab.select_instance(7)
    count = int(found.selected.sum())
    assert found.sentence == f"object 7: lamp (80%), {count:,} Gaussians, level m, membership 92% sure"
    assert replace(found, instance=0, words=(), level="", confidence=float("nan")).sentence == (
        f"selection, {count:,} Gaussians"
    )
    assert "level" not in replace(found, level="default").sentence
