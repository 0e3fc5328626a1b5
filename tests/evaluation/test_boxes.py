"""Boxes of masks, of which the protocol of LERF asks where a query names no box."""

import pytest
import torch

from sgwarp.evaluation.profiles.lerf_ovs import _box_of
from sgwarp.metrics.relevancy_maps import hits_any_box


@pytest.mark.parametrize(("x1", "y1", "x2", "y2"), [(2, 1, 9, 3), (0, 0, 19, 9), (4, 5, 4, 5)])
def test_the_box_around_a_mask(x1, y1, x2, y2):
    mask = torch.zeros(10, 20, dtype=torch.bool)
    mask[y1, x1] = mask[y2, x2] = True
    box = _box_of(mask)
    assert box.tolist() == [[x1, y1, x2, y2]]
    for x, y in ((x1, y1), (x2, y2)):
        assert hits_any_box(torch.tensor([[x, y]]), box)
    for x, y in ((x1 - 1, y1), (x2 + 1, y2), (x1, y1 - 1), (x2, y2 + 1)):
        assert not hits_any_box(torch.tensor([[x, y]]), box)


def test_an_empty_mask_has_no_box():
    box = _box_of(torch.zeros(4, 5, dtype=torch.bool))
    assert box.shape == (0, 4)
    assert not hits_any_box(torch.tensor([[1, 1]]), box)
