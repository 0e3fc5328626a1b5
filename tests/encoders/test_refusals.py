"""What masks, boxes and options of encoders are refused, in words that name the remedy."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from sgwarp.encoders.base import LEVELS, Instances, Masks
from sgwarp.encoders.compose import RefinedPixels
from sgwarp.encoders.maps.files import open_files
from sgwarp.encoders.masks.proposals import Proposals
from sgwarp.encoders.masks.sources import DetectedMasks
from sgwarp.errors import InputError

RANKED = Masks(torch.ones(5, 2, 2, dtype=torch.bool), torch.ones(5), torch.tensor([0, 2, 1, -1, 0]))


@pytest.mark.parametrize(
    ("masks", "scores", "ranks", "message"),
    [
        (torch.ones(2, 4, dtype=torch.bool), torch.ones(2), torch.ones(2), r"expected bool \[M, h, w\]"),
        (torch.ones(2, 4, 4), torch.ones(2), torch.ones(2), r"expected bool \[M, h, w\], got torch.float32"),
        (torch.ones(2, 4, 4, dtype=torch.bool), torch.ones(3), torch.ones(2), "expected 2 scores and ranks"),
        (torch.ones(2, 4, 4, dtype=torch.bool), torch.ones(2), torch.ones(1), "expected 2 scores and ranks"),
    ],
)
def test_masks_of_the_wrong_shape(masks, scores, ranks, message):
    with pytest.raises(InputError, match=message):
        Masks(masks, scores, ranks)


def test_masks_of_a_level():
    assert {level: RANKED.at_level(level).tolist() for level in LEVELS} == {
        **{"default": [0, 1, 2, 3, 4], "s": [0, 4], "m": [2], "l": [1]}
    }
    with pytest.raises(InputError, match="level 'x' is not one of default, s, m, l"):
        RANKED.at_level("x")


@pytest.mark.parametrize(
    ("boxes", "scores", "masks"),
    [
        (torch.zeros(1, 4), torch.zeros(2), None),
        (torch.zeros(2, 3), torch.zeros(2), None),
        (torch.zeros(2, 4), torch.zeros(2), torch.ones(1, 2, 2, dtype=torch.bool)),
    ],
)
def test_instances_of_the_wrong_shape(boxes, scores, masks):
    with pytest.raises(InputError, match="instances: 2 names, but boxes and scores of shape"):
        Instances(boxes, ("a", "b"), scores, masks)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"method": "magic"}, "proposals: 'magic' is not one of graph, slic, seeds, selective"),
        ({"scales": (0.0,)}, "scales, side and smallest must be positive"),
        ({"side": 7}, "scales, side and smallest must be positive"),
        ({"smallest": 0}, "scales, side and smallest must be positive"),
    ],
)
def test_proposals(options, message):
    Proposals(side=8, smallest=1, scales=(1e-3,))
    with pytest.raises(InputError, match=message):
        Proposals(**options)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"layout": "cwh"}, "layout is chw or hwc, not 'cwh'"),
        ({"levels": "1,x"}, "levels are numbers such as 1,2,3, not '1,x'"),
        ({"straight": "true"}, "straight is yes or no, not 'true'"),
    ],
)
def test_options_of_files(tmp_path, options, message):
    with pytest.raises(InputError, match=message):
        open_files(str(tmp_path), (), **options)


def test_rules_for_what_lies_outside_all_masks():
    with pytest.raises(InputError, match="rest: 'all' is not one of cells, own, none"):
        RefinedPixels(None, None, "all")


@pytest.mark.parametrize(("lowest", "highest", "fits"), [(-1, 2, True), (-2, 2, False), (0, 3, False)])
def test_ids_that_their_vectors_lack(tmp_path, view, lowest, highest, fits):
    """LangSplat's pair of files: ids from -1 for none on, and a row of features for each."""
    ids = np.zeros((1, view.camera.height, view.camera.width), np.float32)
    ids[0, 0, 0], ids[0, 1, 1] = lowest, highest
    np.save(tmp_path / f"{view.stem}_s.npy", ids)
    np.save(tmp_path / f"{view.stem}_f.npy", np.ones((3, 4), np.float32))
    if fits:
        assert open_files(str(tmp_path), (view,)).encode(view, None).vectors.shape == (3, 4)
        return
    with pytest.raises(InputError, match=rf"ids go from {lowest} to {highest}, {view.stem}_f.npy has 3 rows"):
        open_files(str(tmp_path), (view,)).encode(view, None)


def test_boxes_need_something_that_makes_masks_of_them(view, image):
    found = Instances(torch.tensor([[0.0, 0, 5, 5]]), ("a",), torch.ones(1), None)
    detector = SimpleNamespace(find=lambda view, image: found)
    with pytest.raises(InputError, match=r"gdino:x: view .* has boxes without masks; add \+sam:PATH to get them"):
        DetectedMasks(detector, None, "gdino:x").read(view, image)
    asked = []
    masks = torch.ones(1, 4, 4, dtype=torch.bool)
    generator = SimpleNamespace(in_boxes=lambda image, boxes: asked.append((image, boxes)) or masks)
    read = DetectedMasks(detector, generator, "gdino:x").read(view, image)
    assert (read.names, read.ranks.tolist(), torch.equal(read.masks, masks)) == (("a",), [-1], True)
    assert asked[0][0] is image
    assert torch.equal(asked[0][1], found.boxes)
