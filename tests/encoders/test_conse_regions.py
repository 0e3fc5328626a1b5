"""Which regions the default encoder looks at, and how evidence comes together, with a classifier that is a toy."""

import numpy as np
import pytest
import torch

from sgwarp.encoders.images.conse import encoder as conse
from sgwarp.encoders.images.conse.class_space import imagenet_space
from sgwarp.encoders.images.conse.classifier import LogitMap
from sgwarp.encoders.images.conse.encoder import Conse, ConseSettings
from sgwarp.encoders.regions import cut_squares

CLASSES = 1000
MATRIX = torch.randn(3, CLASSES, generator=torch.Generator().manual_seed(0)) * 8


class Toy:
    """Logits of an image are its mean color times a matrix; those of locations are noise."""

    def __init__(self, device):
        self.device, self.seen = device, []

    def logits(self, crops):
        self.seen.append(crops)
        return torch.from_numpy(crops).float().mean(dim=(1, 2)) / 255 @ MATRIX

    def logit_map(self, pixels, side):
        noise = torch.Generator().manual_seed(side)
        h, w = (max(1, round(size * side / max(pixels.shape[:2]) / 32)) for size in pixels.shape[:2])
        return LogitMap(torch.randn(h, w, CLASSES, generator=noise) * 5, (h * 32, w * 32), 3.0)


@pytest.fixture
def toy(monkeypatch):
    monkeypatch.setattr(conse, "ImageClassifier", Toy)
    return lambda **settings: Conse(ConseSettings(**settings))


def at_pixels(encoder, pixels, size) -> torch.Tensor:
    """Logits at the pixels of a map of that size, the mean over the passes."""
    maps = [encoder.classifier.logit_map(pixels, side) for side in encoder.settings.map_sides]
    read = [torch.einsum("yi,xj,ijk->yxk", *found.interpolation(*size), found.logits) for found in maps]
    return torch.stack(read).mean(dim=0)


def place(logits: torch.Tensor) -> torch.Tensor:
    return imagenet_space().place_images(logits.softmax(dim=-1))


AREAS = ((3, 13), (4, 10), (12, 16), (1, 193), (5, 12), (7, 7))  # of the masks, rows times columns; cut to the map


@pytest.mark.parametrize(("crops", "looked_at"), [(96, [2, 4, 5, 1]), (3, [2, 4, 5]), (0, [])])
def test_regions_worth_a_look_of_their_own(toy, image, crops, looked_at):
    """Neither too small nor too large, the largest first: both limits belong to them.

    Masks of 24 x 32 pixels count as images of 16, so that 10 pixels there are 40 here; a quarter of all is 192.
    """
    encoder = toy(map_sides=(64, 128), side=16, crop_smallest=10, crop_largest=0.25, crop_side=12, crops=crops)
    masks = torch.zeros(len(AREAS), 24, 32, dtype=torch.bool)
    for mask, (high, wide) in zip(masks, AREAS, strict=True):
        if wide > 32:
            mask.view(-1)[:wide] = True
        else:
            mask[2 : 2 + high, 3 : 3 + wide] = True
    assert masks.flatten(1).sum(dim=1).tolist() == [39, 40, 192, 193, 60, 49]
    found = encoder.encode_regions(image, masks)
    pixels = (image * 255).round().byte().numpy()
    read = at_pixels(encoder, pixels, (24, 32))
    wanted = torch.stack([read[mask].mean(dim=0) for mask in masks])
    squares = []
    for number in looked_at:  # 1.2 times the longer side around the middle, in pixels of an image twice as large
        high, wide = AREAS[number]
        side = 1.2 * 2 * max(high, wide)
        squares.append([2 * 3 + wide - side / 2, 2 * 2 + high - side / 2, side])
    cut = cut_squares(pixels, np.array(squares).reshape(-1, 3), 12)
    for number, crop in zip(looked_at, cut, strict=True):
        wanted[number] = (wanted[number] + torch.from_numpy(crop).float().mean(dim=(0, 1)) / 255 @ MATRIX) / 2
    torch.testing.assert_close(found, place(wanted), rtol=1e-3, atol=1e-4)
    assert [len(part) for part in encoder.classifier.seen] == ([len(looked_at)] if looked_at else [])


def test_a_dense_map_has_a_cell_for_so_many_pixels(toy, image):
    """16 pixels of an image of 128 are 8 of one of 64; every cell has the mean over the passes at its middle."""
    encoder = toy(map_sides=(64, 128), side=128, dense_cell=16)
    found = encoder.encode_pixels(image)
    pixels = (image * 255).round().byte().numpy()
    torch.testing.assert_close(found, place(at_pixels(encoder, pixels, (6, 8))), rtol=1e-4, atol=1e-5)
    assert encoder.encode_pixels(image[:2]).shape[:2] == (1, 8)  # no side vanishes


def test_images_lie_where_their_logits_say(toy):
    crops = torch.randint(0, 256, (3, 12, 12, 3), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    found = toy().encode_images(crops)
    torch.testing.assert_close(found, place(crops.float().mean(dim=(1, 2)) / 255 @ MATRIX), rtol=1e-4, atol=1e-5)


def test_the_text_side_is_loaded_once_and_with_the_first_phrase(toy, monkeypatch):
    loads = []

    class Side:
        def __init__(self, templates):
            loads.append(templates)

        def encode_text(self, texts):
            return texts

    monkeypatch.setattr(conse, "ConseText", Side)
    encoder = Conse(templates=("the {}",))
    assert not loads
    assert [encoder.encode_text([word]) for word in "ab"] == [["a"], ["b"]]
    assert loads == [("the {}",)]
    assert Conse(device="cuda").classifier.device == "cuda"
