"""Masks of a view by the name of what makes them: generators, id images, detectors."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch

from sgwarp.encoders.base import Instances, Masks
from sgwarp.encoders.masks import sam
from sgwarp.encoders.masks.sources import DetectedMasks, GeneratedMasks, MappedMasks, ViewMasks
from sgwarp.encoders.registry import make_mask_source
from sgwarp.errors import InputError
from sgwarp.scene import FeatureMap

STACK = torch.zeros(4, 3, 5, dtype=torch.bool)
STACK[0, 0, 0] = STACK[2] = STACK[3, 2, 4] = True  # the second is empty


class Generator:
    def __init__(self):
        self.asked = []

    def everything(self, view, image):
        self.asked.append((view, image))
        return Masks(STACK, torch.ones(4), torch.tensor([0, 1, 2, -1]))

    def in_boxes(self, image, boxes):
        self.asked.append((image, boxes))
        return STACK[: len(boxes)]


def test_empty_masks_are_left_out_with_their_ranks_and_names():
    found = ViewMasks.without_empty(STACK, torch.tensor([0, 1, 2, -1]), ("a", "b", "c", "d"))
    assert torch.equal(found.masks, STACK[[0, 2, 3]])
    assert (found.ranks.tolist(), found.names, len(found)) == ([0, 2, -1], ("a", "c", "d"), 3)
    assert ViewMasks.without_empty(STACK, torch.zeros(4)).names == ()


def test_generators_look_at_the_photograph_or_at_its_size(view, image):
    generator = Generator()
    found = GeneratedMasks(generator).read(view, image)
    assert (found.ranks.tolist(), found.names) == ([0, 2, -1], ())
    GeneratedMasks(generator, needs_image=False).read(view, None)
    (first, given), (second, blank) = generator.asked
    assert first is second is view
    assert given is image
    assert (blank.shape, blank.any().item()) == ((48, 64, 3), False)


class Source:
    needs_image = True

    def __init__(self, found):
        self.found = found

    def encode(self, view, image):
        assert view.stem == "a"
        assert image.shape == (48, 64, 3)
        return self.found


def test_every_id_is_a_mask_with_its_label(view, image):
    ids = torch.tensor([[0, -1, 2], [2, 2, -1]])
    found = MappedMasks(Source(FeatureMap("labels", ids=ids, labels=("cup", "hat", "lamp"))), "files:x").read(
        view, image
    )
    assert torch.equal(found.masks, torch.stack([ids == 0, ids == 2]))
    assert (found.ranks.tolist(), found.names) == ([-1, -1], ("cup", "lamp"))


def test_levels_are_ranked_after_the_first(view, image):
    """As LangSplat stores them: all masks, then small, middle and large ones."""
    ids = torch.tensor([[[0, 1]], [[2, -1]], [[-1, -1]], [[3, 4]]])
    found = MappedMasks(Source(FeatureMap("s", ids=ids, vectors=torch.eye(5))), "files:x").read(view, image)
    assert found.masks[:, 0].tolist() == [[True, False], [False, True], [True, False], [True, False], [False, True]]
    assert (found.ranks.tolist(), found.names) == ([-1, -1, 0, 2, 2], ())


def test_dense_features_are_no_masks(view, image):
    source = MappedMasks(Source(FeatureMap("s", dense=torch.ones(2, 2, 3))), "files:x")
    with pytest.raises(InputError, match="files:x: view a holds dense features, which are no masks; give id images"):
        source.read(view, image)
    assert source.needs_image


def test_boxes_of_a_detector_become_masks(view, image):
    generator, asked = Generator(), []
    boxes = torch.tensor([[0.0, 0, 1, 1], [2, 2, 3, 3], [0, 0, 5, 3]])
    found = Instances(boxes, ("cup", "hat", "wall"), torch.ones(3))
    detector = SimpleNamespace(find=lambda *given: asked.append(given) or found)
    read = DetectedMasks(detector, generator, "gdino:x").read(view, None)
    assert torch.equal(read.masks, STACK[[0, 2]])
    assert (read.names, read.ranks.tolist()) == (("cup", "wall"), [-1, -1])
    assert asked[0][0] is view
    assert asked[0][1].shape == (48, 64, 3)
    assert generator.asked[0][0] is asked[0][1]
    own = Instances(boxes, found.names, found.scores, STACK[1:])
    detector.find = lambda view, image: own
    assert DetectedMasks(detector, generator, "gdino:x").read(view, image).names == ("hat", "wall")
    assert len(generator.asked) == 1  # masks of its own are taken as they are


def test_id_images_by_name(tmp_path, view):
    ids = np.zeros((48, 64), np.uint8)
    ids[:5], ids[20:, 30:] = 3, 7
    cv2.imwrite(str(tmp_path / "a.png"), ids)
    source = make_mask_source(f"files:{tmp_path}", [view])
    assert not source.needs_image
    found = source.read(view, None)
    assert found.names == ("3", "7")
    np.testing.assert_array_equal(found.masks, np.stack([ids == 3, ids == 7]))


def test_detectors_by_name(tmp_path, view, image):
    source = make_mask_source(f"vlpart:{tmp_path}", [view])
    assert isinstance(source, DetectedMasks)
    assert not source.needs_image  # files are read
    np.savez(tmp_path / "a.npz", boxes=[[0.0, 0, 5, 5]], names=np.array(["x"]), scores=[1.0])
    with pytest.raises(InputError, match=rf"vlpart:{tmp_path}: view a has boxes without masks; add \+sam:PATH"):
        source.read(view, image)
    assert make_mask_source(f"vlpart:{tmp_path}+graph", [view]).needs_image  # its boxes become masks on the photograph
    with pytest.raises(InputError, match="masks with names have no text side"):
        source_of_names().encode_text(["x"])


def source_of_names():
    from sgwarp.encoders.masks.sources import NoText

    return NoText()


@pytest.mark.parametrize("name", ["files:{0}++files:{0}", "vlpart:{0}++vlpart:{0}"])
def test_several_at_once_give_no_masks(tmp_path, view, name):
    with pytest.raises(InputError, match="gives no masks; take one of"):
        make_mask_source(name.format(tmp_path), [view])


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("sam:P", sam.SamSettings()),
        ("sam:P?points=3&least_score=0.5&least_stability=0.4", sam.SamSettings(3, 64, 0.5, 0.4)),
        ("sam:P?overlap=0.3&longest=99", sam.SamSettings(overlap=0.3, longest=99)),
        ("sam:P?levels=s,m", sam.SamSettings(by_rank=True)),
        ("sam:P?levels=default", sam.SamSettings()),
    ],
)
def test_options_and_device_reach_the_generator(monkeypatch, name, settings):
    asked = []
    monkeypatch.setattr(sam, "Sam", lambda *given: asked.append(given) or SimpleNamespace())
    assert make_mask_source(name, device="cuda").needs_image
    assert asked == [("P", settings, "cuda")]
