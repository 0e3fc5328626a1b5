"""Proposals, the boxes and squares of masks, and what is read inside them, against slow loops."""

import cv2
import numpy as np
import pytest
import torch

from sgwarp.encoders.images.conse.classifier import STRIDE, LogitMap
from sgwarp.encoders.masks.proposals import Proposals, propose_regions, segment_regions
from sgwarp.encoders.painting import spread
from sgwarp.encoders.regions import box_squares, cut_squares, mask_boxes
from sgwarp.errors import InputError
from sgwarp.scene import Camera, View


@pytest.fixture
def regions():
    """A partition with thin, large and scattered regions."""
    parts = np.zeros((20, 30), np.int32)
    parts[3:7, 5:25] = 1
    parts[15, 2] = 2
    parts[0, 0] = parts[19, 29] = 3
    return parts


def test_segmentation_finds_plain_shapes():
    image = np.full((60, 80, 3), 200, np.uint8)
    cv2.rectangle(image, (10, 10), (34, 39), (20, 60, 220), -1)
    cv2.circle(image, (60, 30), 12, (30, 200, 30), -1)
    found = segment_regions(image, 100, 20)
    inside = [image[y, x].tolist() for y, x in [(20, 20), (30, 60), (55, 5)]]
    numbers = [found[20, 20], found[30, 60], found[55, 5]]
    assert sorted(np.unique(found)) == list(range(found.max() + 1))
    assert len(set(numbers)) == 3
    for number, colour in zip(numbers, inside, strict=True):
        same = (image == colour).all(axis=2)
        assert ((found == number) & same).sum() / ((found == number) | same).sum() > 0.8


def as_masks(regions) -> torch.Tensor:
    return torch.from_numpy(regions) == torch.arange(regions.max() + 1)[:, None, None]


def test_boxes_and_squares(regions):
    boxes = mask_boxes(as_masks(regions))
    squares = box_squares(boxes, 1.5)
    for number in range(regions.max() + 1):
        y, x = np.nonzero(regions == number)
        assert boxes[number].tolist() == [x.min(), y.min(), x.max() + 1, y.max() + 1]
        side = 1.5 * max(y.max() - y.min() + 1, x.max() - x.min() + 1)
        middle = (x.min() + x.max() + 1) / 2, (y.min() + y.max() + 1) / 2
        np.testing.assert_allclose(squares[number], [middle[0] - side / 2, middle[1] - side / 2, side])


def test_cut_squares():
    image = np.random.default_rng(0).integers(0, 255, (20, 30, 3)).astype(np.uint8)
    whole, over_the_edge = cut_squares(image, np.array([[4.0, 2, 10], [-5, -5, 10]]), 10)
    assert (whole == image[2:12, 4:14]).all()
    assert (over_the_edge[5:, 5:] == image[:5, :5]).all()
    assert (over_the_edge[:5] == 127).all()
    assert (over_the_edge[:, :5] == 127).all()


def test_squares_shrink_to_their_mean():
    image = np.random.default_rng(0).integers(0, 255, (16, 16, 3)).astype(np.uint8)
    (small,) = cut_squares(image, np.array([[0.0, 0, 16]]), 2)
    wanted = image.reshape(2, 8, 2, 8, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(small, wanted, atol=1)


def test_interpolation_reads_a_map_at_the_centres_of_its_locations():
    """A map whose values are the positions of its locations gives those of the pixels, but at its edges."""
    first, inputs = 3.0, (96, 160)
    y, x = torch.meshgrid(torch.arange(3.0), torch.arange(5.0), indexing="ij")
    found = LogitMap(torch.stack([y, x], dim=-1) * STRIDE + first, inputs, first)
    rows, columns = found.interpolation(48, 80)
    read = torch.einsum("yi,xj,ijk->yxk", rows, columns, found.logits)
    for row in range(48):
        for column in range(80):
            wanted = [
                min(max((place + 0.5) * 2 - 0.5, first), first + STRIDE * last)
                for place, last in ((row, 2), (column, 4))
            ]
            np.testing.assert_allclose(read[row, column], wanted, rtol=1e-5)


@pytest.mark.parametrize("locations", [(1, 1), (2, 3), (4, 6)])
def test_region_means_equal_a_loop_over_pixels(regions, locations):
    values = torch.randn(*locations, 7, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    found = LogitMap(values, (locations[0] * STRIDE, locations[1] * STRIDE), 3.0)
    rows, columns = found.interpolation(*regions.shape)
    masks = as_masks(regions)
    sums = spread(masks, rows, columns).flatten(1) @ values.float().flatten(0, 1)
    means = sums / masks.flatten(1).sum(dim=1)[:, None]
    for number in range(regions.max() + 1):
        wanted = torch.zeros(7, dtype=torch.float64)
        pixels = np.argwhere(regions == number)
        for y, x in pixels:
            for i in range(locations[0]):
                for j in range(locations[1]):
                    wanted += float(rows[y, i]) * float(columns[x, j]) * values[i, j]
        np.testing.assert_allclose(means[number], wanted / len(pixels), rtol=1e-5, atol=1e-6)


def test_opencv_without_contributed_modules(monkeypatch):
    from sgwarp.errors import InputError

    monkeypatch.delattr(cv2, "ximgproc")
    with pytest.raises(InputError, match="pip install opencv-contrib-python-headless"):
        segment_regions(np.zeros((8, 8, 3), np.uint8), 100, 10)


@pytest.mark.parametrize(("method", "scale"), [("graph", 300.0), ("slic", 16.0), ("seeds", 16.0), ("selective", 8.0)])
def test_every_kind_of_proposal_separates_a_square_from_its_ground(method, scale):
    image = np.full((96, 128, 3), 200, np.uint8)
    image[30:70, 40:90] = (180, 30, 30)
    image[30:70, 40:90] += np.random.default_rng(0).integers(0, 6, (40, 50, 3), dtype=np.uint8)
    regions = propose_regions(image, method, scale, 50)
    assert regions.shape == (96, 128)
    assert regions.dtype == np.int32
    assert set(np.unique(regions)) == set(range(regions.max() + 1))
    inside = np.zeros((96, 128), bool)
    inside[30:70, 40:90] = True
    # Every region lies mostly on one side: the square can be put together from whole regions.
    share = np.bincount(regions.ravel(), inside.ravel()) / np.bincount(regions.ravel())
    square = share[regions] > 0.5
    assert (square & inside).sum() / (square | inside).sum() > 0.85


def test_unknown_proposals_are_refused():
    with pytest.raises(InputError, match="graph, slic, seeds, selective"):
        propose_regions(np.zeros((8, 8, 3), np.uint8), "sam", 1.0)


def plain_view(height: int, width: int) -> View:
    K = torch.tensor([[50.0, 0, width / 2], [0, 50.0, height / 2], [0, 0, 1]])
    return View("a", Camera(K, torch.eye(4), width, height))


def test_scales_become_ranks():
    noise = np.random.default_rng(0).normal(128, 400, (60, 80, 3))
    image = torch.from_numpy(cv2.GaussianBlur(noise, (0, 0), 4).clip(0, 255)).float() / 255
    found = Proposals(scales=(900.0, 30.0, 200.0), smallest=10, side=80).everything(plain_view(60, 80), image)
    counts = [int((found.ranks == rank).sum()) for rank in range(3)]
    assert counts[0] > counts[1] > counts[2] > 0
    for rank in range(3):  # each scale is a partition
        assert (found.masks[found.ranks == rank].sum(dim=0) == 1).all()
    assert found.masks.flatten(1).any(dim=1).all()
    assert found.at_level("default").tolist() == list(range(len(found)))
    assert found.at_level("l").tolist() == (found.ranks == 2).nonzero().flatten().tolist()
    with pytest.raises(InputError, match="level 'xl' is not one of default, s, m, l"):
        found.at_level("xl")


def test_large_images_are_segmented_small():
    found = Proposals(side=40).everything(plain_view(60, 80), torch.rand(60, 80, 3))
    assert found.masks.shape[1:] == (30, 40)
    assert (found.masks.sum(dim=0) == 1).all()


def test_proposals_have_no_boxes():
    with pytest.raises(InputError, match="cannot be asked for the mask of a box; use sam:PATH"):
        Proposals().in_boxes(torch.zeros(8, 8, 3), torch.zeros(1, 4))


@pytest.mark.parametrize(
    "settings", [{"scales": (0.0,)}, {"scales": (9.0, 0.0)}, {"side": 2}, {"smallest": 0}, {"method": "sam"}]
)
def test_bad_proposals(settings):
    with pytest.raises(InputError, match="proposals"):
        Proposals(**settings)
