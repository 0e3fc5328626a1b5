"""Pictures: what is drawn where, not how pretty it is."""

import numpy as np
import pytest
import torch

from sgwarp.visualization.pictures import (
    class_colours,
    depth_picture,
    heat_map,
    mark_pixel,
    overlay,
    to_picture,
    with_legend,
)


def test_colours_are_distinct_and_stay():
    many = class_colours(64)
    assert many.dtype == np.uint8
    assert len({tuple(colour) for colour in many.tolist()}) == 64
    assert np.array_equal(class_colours(10), many[:10])
    first = many[:20].astype(int)
    distance = np.abs(first[:, None] - first[None]).max(axis=2) + 255 * np.eye(20, dtype=int)
    assert distance.min() >= 60
    assert class_colours(0).shape == (0, 3)


def test_to_picture_rounds_and_clips():
    image = torch.tensor([[[0.5, -1.0, 2.0], [float("nan"), 1.0, 0.0]]])
    assert to_picture(image).tolist() == [[[128, 0, 255], [0, 255, 0]]]
    same = np.full((1, 1, 3), 7, np.uint8)
    assert to_picture(same) is same


def test_overlay_colours_classes_and_dims_the_unknown():
    image = np.full((1, 3, 3), 200, np.uint8)
    colours = class_colours(2)
    result = overlay(image, torch.tensor([[0, 1, 255]]), colours, strength=0.5)
    for column in range(2):
        assert np.abs(result[0, column].astype(float) - (100 + colours[column] / 2.0)).max() <= 1
    assert result[0, 2].tolist() == [70, 70, 70]


@pytest.mark.parametrize("names", [["sofa"], [f"class {k}" for k in range(30)], []])
def test_legend_names_every_class(names):
    picture = np.zeros((100, 50, 3), np.uint8)
    colours = class_colours(len(names))
    result = with_legend(picture, names, colours)
    assert np.array_equal(result[:100, :50], picture)
    assert len(result) >= 22 * len(names)
    shown = {tuple(pixel) for pixel in result[:, 50:].reshape(-1, 3).tolist()}
    assert {tuple(colour) for colour in colours.tolist()} <= shown


def test_heat_map_is_redder_where_the_score_is_higher():
    grey = np.full((1, 4, 3), 128, np.uint8)
    result = heat_map(grey, torch.tensor([[0.0, 0.5, 1.0, -torch.inf]])).astype(int)
    redness = result[0, :, 0] - result[0, :, 2]
    assert redness[2] > redness[0]
    assert len(set(result[0, 3].tolist())) == 1
    assert result[0, 3, 0] < 128
    fixed = heat_map(grey, torch.tensor([[0.0, 0.5, 1.0, 1.0]]), low=0.0, high=10.0).astype(int)
    assert (fixed[0, 2, 0] - fixed[0, 2, 2]) < redness[2]
    heat_map(grey, np.zeros((1, 4)))  # one score everywhere
    heat_map(grey, np.full((1, 4), -np.inf))  # nothing known at all


def test_depth_picture():
    result = depth_picture(torch.tensor([[0.0, 1.0, 5.0]])).astype(int)
    assert result[0, 0].tolist() == [0, 0, 0]
    assert result[0, 1, 0] > result[0, 1, 2]  # near is red
    assert result[0, 2, 2] > result[0, 2, 0]  # far is blue
    assert not depth_picture(np.zeros((2, 2))).any()


def test_mark_pixel_leaves_the_original_alone():
    picture = np.full((40, 60, 3), 100, np.uint8)
    marked = mark_pixel(picture, (30, 10))
    assert (picture == 100).all()
    rows, columns = np.nonzero((marked != 100).any(axis=2))
    assert round(float(columns.mean())) == 30
    assert round(float(rows.mean())) == 10
