"""From masks to pixels, against slow loops over pixels."""

import pytest
import torch
from torch.nn.functional import normalize

from sgwarp.encoders.painting import average, cover_sets, mask_means, paint, resize_masks, rest_cells


def random_masks(count: int, seed: int, size=(9, 13)) -> torch.Tensor:
    noise = torch.Generator().manual_seed(seed)
    masks = torch.zeros(count, *size, dtype=torch.bool)
    for mask in masks:
        y, x = (int(torch.randint(0, side - 2, (), generator=noise)) for side in size)
        h, w = (int(torch.randint(2, side, (), generator=noise)) for side in size)
        mask[y : y + h, x : x + w] = True
    return masks


@pytest.mark.parametrize("count", [0, 1, 5, 40])
def test_cover_sets(count):
    masks = random_masks(count, count)
    ids, members = cover_sets(masks)
    seen = set()
    for y in range(9):
        for x in range(13):
            covering = [k for k in range(count) if masks[k, y, x]]
            if not covering:
                assert ids[y, x] == -1
            else:
                assert members[ids[y, x]].nonzero().flatten().tolist() == covering
                seen.add(tuple(covering))
    assert len(members) == len(seen)
    assert sorted(ids[ids >= 0].unique().tolist()) == list(range(len(seen)))


@pytest.mark.parametrize("weighted", [False, True])
def test_average(weighted):
    masks = random_masks(12, 1)
    noise = torch.Generator().manual_seed(0)
    vectors = torch.randn(12, 5, generator=noise) * 10
    weights = torch.rand(12, generator=noise) + 0.1 if weighted else None
    ids, means = average(masks, vectors, weights)
    for y in range(9):
        for x in range(13):
            covering = [k for k in range(12) if masks[k, y, x]]
            if not covering:
                assert ids[y, x] == -1
                continue
            total, sum_of_weights = torch.zeros(5), 0.0
            for k in covering:  # normalised first, then averaged
                weight = 1.0 if weights is None else float(weights[k])
                total += weight * vectors[k] / vectors[k].norm()
                sum_of_weights += weight
            torch.testing.assert_close(means[ids[y, x]], total / sum_of_weights, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_paint(seed):
    """The smallest mask at a pixel is on top, whatever the order of the masks."""
    masks = random_masks(15, seed)
    areas = masks.flatten(1).sum(dim=1)
    ids = paint(masks)
    for y in range(9):
        for x in range(13):
            covering = [k for k in range(15) if masks[k, y, x]]
            smallest = min(covering, key=lambda k: (areas[k], -k), default=-1)
            assert ids[y, x] == smallest


def test_painting_nothing():
    assert (paint(torch.zeros(0, 3, 4, dtype=torch.bool)) == -1).all()


@pytest.mark.parametrize("cells", [(9, 13), (3, 4), (1, 1)])
def test_mask_means(cells):
    """Against a map that is first made as large as the masks."""
    masks = random_masks(70, 2)  # more than go through at once
    features = torch.randn(*cells, 6, generator=torch.Generator().manual_seed(0))
    large = torch.nn.functional.interpolate(
        features.permute(2, 0, 1)[None], (9, 13), mode="bilinear", align_corners=False
    )[0].permute(1, 2, 0)
    found = mask_means(masks, features)
    for mask, mean in zip(masks, found, strict=True):
        torch.testing.assert_close(mean, large[mask].mean(dim=0), rtol=1e-4, atol=1e-5)


def test_rest_cells():
    uncovered = torch.zeros(9, 13, dtype=torch.bool)
    uncovered[2, 3] = uncovered[8, 12] = uncovered[8, 11] = uncovered[0, 12] = True
    found = rest_cells(uncovered, 4)  # cells of 4 x 4 pixels
    assert torch.equal(found.any(dim=0), uncovered)
    assert found.sum() == uncovered.sum()
    assert sorted(mask.nonzero().tolist() for mask in found) == [[[0, 12]], [[2, 3]], [[8, 11]], [[8, 12]]]
    assert len(rest_cells(torch.ones(9, 13, dtype=torch.bool), 4)) == 3 * 4


def test_resize_masks():
    masks = random_masks(3, 0)
    assert torch.equal(resize_masks(masks, (9, 13)), masks)
    double = resize_masks(masks, (18, 26))
    assert torch.equal(double, masks.repeat_interleave(2, dim=1).repeat_interleave(2, dim=2))
    thirds = resize_masks(masks[:, :, :12], (3, 4))
    assert torch.equal(thirds, masks[:, 1::3, 1:12:3])  # a third has its middle pixel


def test_vectors_come_back_normalised_from_single_masks():
    vectors = torch.tensor([[3.0, 4.0], [0.0, 2.0]])
    masks = torch.tensor([[[True, False]], [[False, True]]])
    ids, means = average(masks, vectors)
    torch.testing.assert_close(means[ids[0]], normalize(vectors, dim=1))
