"""How OpenCV is asked for regions, against the library called directly or made up."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch

from sgwarp.encoders.masks import proposals
from sgwarp.encoders.masks.proposals import Proposals, propose_regions, segment_regions


@pytest.fixture
def clouds() -> np.ndarray:
    noise = np.random.default_rng(0).normal(128, 400, (96, 128, 3))
    return cv2.GaussianBlur(noise, (0, 0), 4).clip(0, 255).astype(np.uint8)


def same_partition(found: np.ndarray, wanted: np.ndarray) -> bool:
    pairs = np.unique(np.stack([found.ravel(), wanted.ravel()]), axis=1).shape[1]
    return pairs == len(np.unique(found)) == len(np.unique(wanted))


def test_slic_as_opencv_cuts_it(clouds):
    slic = cv2.ximgproc.createSuperpixelSLIC(cv2.cvtColor(clouds, cv2.COLOR_RGB2LAB), cv2.ximgproc.SLICO, 16)
    slic.iterate(10)
    slic.enforceLabelConnectivity()
    assert same_partition(propose_regions(clouds, "slic", 16.0), slic.getLabels())


@pytest.mark.parametrize(("side", "count"), [(16.0, 48), (24.0, 21), (200.0, 1)])
def test_seeds_as_opencv_cuts_them(clouds, side, count):
    """So many of them as squares of that side fill the image, at least one, in four levels of blocks."""
    seeds = cv2.ximgproc.createSuperpixelSEEDS(128, 96, 3, count, 4)
    seeds.iterate(cv2.cvtColor(clouds, cv2.COLOR_RGB2LAB), 10)
    assert same_partition(propose_regions(clouds, "seeds", side), seeds.getLabels())


@pytest.mark.parametrize("method", ["slic", "seeds"])
def test_superpixels_have_at_least_four_pixels_a_side(clouds, method):
    small = clouds[:32, :48]
    assert same_partition(propose_regions(small, method, 1.0), propose_regions(small, method, 4.0))
    assert len(np.unique(propose_regions(small, method, 8.0))) < len(np.unique(propose_regions(small, method, 4.0)))


class Search:
    """Stands for OpenCV's selective search, and remembers what it was asked."""

    def __init__(self, boxes):
        self.boxes, self.image, self.fast = boxes, None, False

    def setBaseImage(self, image):
        self.image = image

    def switchToSelectiveSearchFast(self):
        self.fast = True

    def process(self):
        return np.asarray(self.boxes, np.int32)


@pytest.fixture
def selective(monkeypatch, clouds):
    """`selective(boxes, least)`: the regions that such boxes become, painted on an image of 96 x 128."""

    def paint(boxes, least):
        search = Search(boxes)
        kind = SimpleNamespace(createSelectiveSearchSegmentation=lambda: search)
        monkeypatch.setattr(proposals, "_segmentation", lambda: kind)
        found = propose_regions(clouds, "selective", least)
        assert search.fast
        assert np.array_equal(search.image, clouds[:, :, ::-1])  # OpenCV's order of colors
        return found

    return paint


def test_boxes_are_painted_from_the_largest_to_the_smallest(selective):
    """Those with a side below the least are left out; what no box holds is a region of its own."""
    boxes = [[10, 10, 9, 9], [5, 5, 40, 10], [8, 2, 10, 30], [50, 50, 8, 8], [60, 60, 30, 7], [60, 60, 7, 30]]
    wanted = np.zeros((96, 128), int)
    for number in (1, 2, 0, 3):  # 400, 300, 81 and 64 pixels
        x, y, wide, high = boxes[number]
        wanted[y : y + high, x : x + wide] = number + 1
    assert same_partition(selective(boxes, 8.0), wanted)


def test_of_boxes_of_one_area_the_later_lies_on_top(selective):
    places = np.random.default_rng(0).integers(0, 80, (60, 2))
    boxes = [[x, y, side, side] for (x, y), side in zip(places, [8, 12] * 30, strict=True)]
    wanted = np.zeros((96, 128), int)
    for wanted_side in (12, 8):
        for number, (x, y, side, _) in enumerate(boxes, start=1):
            if side == wanted_side:
                wanted[y : y + side, x : x + side] = number
    found = selective(boxes, 8.0)
    assert same_partition(found, wanted)
    assert found.max() + 1 == len(np.unique(found))


@pytest.mark.parametrize("channel", range(3))
def test_every_color_tells(channel):
    image = np.full((40, 60, 3), 90, np.uint8)
    image[:, 30:, channel] = 200
    found = segment_regions(image, 100, 20)
    assert found[20, 5] != found[20, 55]


@pytest.mark.parametrize(("side", "smallest"), [(80, 60), (160, 15), (40, 60), (8000, 1)])
def test_areas_refer_to_an_image_of_that_side(monkeypatch, view, side, smallest):
    """Which is not made larger; one pixel is the least."""
    asked = []

    def propose(image, method, scale, least):
        asked.append((image.shape, method, scale, least))
        return np.zeros(image.shape[:2], np.int32)

    monkeypatch.setattr(proposals, "propose_regions", propose)
    Proposals("slic", (7.0, 9.0), side).everything(view, torch.rand(60, 80, 3))
    shape = (30, 40, 3) if side == 40 else (60, 80, 3)
    assert asked == [(shape, "slic", 7.0, smallest), (shape, "slic", 9.0, smallest)]


def test_small_copies_hold_the_means_of_their_pixels(monkeypatch, view, image):
    seen = []
    monkeypatch.setattr(
        proposals, "segment_regions", lambda image, *given: seen.append(image) or np.zeros((24, 32), int)
    )
    Proposals(side=32).everything(view, image)
    mean = (image * 255).round().reshape(24, 2, 32, 2, 3).mean(dim=(1, 3))
    assert (torch.from_numpy(seen[0]) - mean).abs().max() <= 0.5 + 1e-4
    Proposals(side=8).everything(view, torch.rand(2, 400, 3))
    assert seen[1].shape == (1, 8, 3)  # no side vanishes
