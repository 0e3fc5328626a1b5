"""The three rules on toy networks, against a slow reading of the paper, pixel by pixel."""

import numpy as np
import pytest
import torch
from torch.nn.functional import interpolate, normalize

from sgwarp.encoders.base import Instances, MapSource, Masks, TextEncoder, require_same_space
from sgwarp.encoders.compose import (
    Crops,
    MaskedImages,
    PaintedInstances,
    PlainPixels,
    RefinedPixels,
    box_masks,
    combine_masks,
)
from sgwarp.encoders.regions import cut_squares
from sgwarp.errors import InputError

HEIGHT, WIDTH = 48, 64


class Toy:
    """Every kind of network: sees mean colours, and knows phrases by their letters."""

    space, side, identity = "toy", 12, "toy network"

    def encode_images(self, crops):
        return normalize(crops.float().flatten(1, 2).mean(dim=1) + 1, dim=1)

    def encode_pixels(self, image):
        small = interpolate(image.permute(2, 0, 1)[None], (12, 16), mode="area")[0]
        return small.permute(1, 2, 0) * 2 - 1

    def encode_text(self, texts):
        return normalize(torch.tensor([[text.count("a") + 0.5, len(text), 1.0] for text in texts]), dim=1)

    def find(self, view, image):
        assert (view.stem, image.shape) == ("a", (HEIGHT, WIDTH, 3))
        boxes = torch.tensor([[4.0, 6, 30, 40], [20, 10, 60, 44], [0, 0, 64, 48]])
        return Instances(boxes, ("cat", "sofa", "banana"), torch.tensor([0.9, 0.5, 0.2]))

    def identity_of(self, view):
        return "found"


class Shapes:
    """Three overlapping masks of two ranks, half as large as the image, one of them empty."""

    identity = "shapes"

    def __init__(self, everywhere=False):
        masks = torch.zeros(4, HEIGHT // 2, WIDTH // 2, dtype=torch.bool)
        masks[0, 2:20, 3:20] = masks[1, 8:16, 10:30] = masks[2, 10:12, 5:25] = True
        if everywhere:
            masks[3] = True
        self.masks = Masks(masks, torch.ones(4), torch.tensor([2, 0, 0, 2]))

    def everything(self, view, image):
        assert (view.stem, image.shape) == ("a", (HEIGHT, WIDTH, 3))
        return self.masks

    def in_boxes(self, image, boxes):
        """The lower right half of each box."""
        halves = boxes.clone()
        halves[:, :2] = (boxes[:, :2] + boxes[:, 2:]) / 2
        return box_masks(halves, (HEIGHT, WIDTH))

    def identity_of(self, view):
        return ""


def at(found, y, x):
    """Vector at a pixel of an id map, None where there is none."""
    number = int(found.ids[0, y, x])
    return None if number < 0 else found.vectors[number]


def test_crops_reach_a_little_beyond_their_mask(image):
    seen = []

    class Sized(Toy):
        def encode_images(self, crops):
            seen.append(crops)
            return super().encode_images(crops)

    masks = torch.zeros(1, HEIGHT // 2, WIDTH // 2, dtype=torch.bool)
    masks[0, 8:12, 10:18] = True
    Crops(Sized()).encode_regions(image, masks)
    square = np.array([[28 - 9.6, 20 - 9.6, 19.2]])  # x, y, side: 1.2 x 16 pixels around the middle of the mask
    expected = cut_squares((image * 255).round().byte().numpy(), square, Toy.side)
    assert torch.equal(seen[0], torch.from_numpy(expected))


def test_image_level(view, image):
    source = MaskedImages(Crops(Toy(), margin=1.0), Shapes())
    found = source.encode(view, image)
    assert isinstance(source, MapSource)
    assert isinstance(source, TextEncoder)
    assert found.size == (HEIGHT // 2, WIDTH // 2)
    pixels = (image * 255).round().numpy()
    vectors = []
    for mask in Shapes().masks.masks[:3].numpy():
        y, x = np.nonzero(mask)
        top, left, high, wide = 2 * y.min(), 2 * x.min(), 2 * (y.max() + 1 - y.min()), 2 * (x.max() + 1 - x.min())
        side = max(high, wide)
        square = np.full((side, side, 3), 127.0)  # padded with grey where it reaches beyond the image
        y0, x0 = top + (high - side) // 2, left + (wide - side) // 2
        for row in range(side):
            for column in range(side):
                if 0 <= y0 + row < HEIGHT and 0 <= x0 + column < WIDTH:
                    square[row, column] = pixels[y0 + row, x0 + column]
        vectors.append(torch.from_numpy(square).float().mean(dim=(0, 1)) + 1)
    vectors = normalize(torch.stack(vectors), dim=1)
    for y in range(HEIGHT // 2):
        for x in range(WIDTH // 2):
            covering = [k for k in range(3) if Shapes().masks.masks[k, y, x]]
            if not covering:
                assert at(found, y, x) is None
            else:  # resizing a square changes its mean colour a little
                torch.testing.assert_close(at(found, y, x), vectors[covering].mean(dim=0), rtol=0.02, atol=0.02)


def test_background_is_painted_grey(image):
    masks = torch.zeros(1, HEIGHT, WIDTH, dtype=torch.bool)
    masks[0, 0:24, 0:12] = True
    seen = []

    class Watched(Toy):
        side = 24

        def encode_images(self, crops):
            seen.append(crops)
            return super().encode_images(crops)

    Crops(Watched(), margin=1.0).encode_regions(image, masks)
    Crops(Watched(), margin=1.0, background=False).encode_regions(image, masks)
    # The square around a mask of 24 x 12 reaches 6 pixels over the left edge.
    assert (seen[0][0, :, :6] == 127).all()
    assert (seen[1][0, :, :6] == 127).all()
    assert torch.equal(seen[1][0, :, 6:18], (image[:24, :12] * 255).round().to(torch.uint8))
    assert torch.equal(seen[0][0, :, 18:], (image[:24, 12:18] * 255).round().to(torch.uint8))
    assert (seen[1][0, :, 18:] == 127).all()


def test_levels(view, image):
    source = MaskedImages(Crops(Toy()), Shapes(everywhere=True), ("default", "s", "l"))
    found = source.encode(view, image)
    alone = [MaskedImages(Crops(Toy()), Shapes(everywhere=True), (level,)).encode(view, image) for level in ("s", "l")]
    assert found.ids.shape[0] == 3
    for number, one in zip((1, 2), alone, strict=True):
        there = one.ids[0] >= 0
        assert torch.equal(found.ids[number] >= 0, there)
        torch.testing.assert_close(
            found.vectors[found.ids[number][there].long()], one.vectors[one.ids[0][there].long()]
        )
    with pytest.raises(InputError, match="view a: the mask generator found no mask of level m"):
        MaskedImages(Crops(Toy()), Shapes(), ("m",)).encode(view, image)


def read_bilinearly(features, size):
    large = interpolate(features.permute(2, 0, 1)[None], size, mode="bilinear", align_corners=False)
    return large[0].permute(1, 2, 0)


@pytest.mark.parametrize("rest", ["none", "cells", "own"])
def test_pixel_level(view, image, rest):
    """Each mask takes the mean of what the network saw, not of what larger masks painted; smaller ones lie on top."""
    source = RefinedPixels(Toy(), Shapes(), rest)
    found = source.encode(view, image)
    assert torch.equal(source.encode_text(["cat"]), Toy().encode_text(["cat"]))
    size = (HEIGHT // 2, WIDTH // 2)
    features = Toy().encode_pixels(image)
    large = read_bilinearly(features, size)
    masks = Shapes().masks.masks[:3]
    painted = torch.full((*size, 3), float("nan"))
    for mask in sorted(masks, key=lambda mask: -int(mask.sum())):
        painted[mask] = large[mask].mean(dim=0)
    covered = masks.any(dim=0)
    if rest == "own":
        assert found.dense.shape == features.shape
        for y in range(12):
            for x in range(16):
                wanted = painted[2 * y + 1, 2 * x + 1]  # the mask pixel at the middle of the network's
                wanted = features[y, x] if bool(wanted.isnan().any()) else wanted
                torch.testing.assert_close(found.dense[y, x], wanted, rtol=1e-4, atol=1e-5)
        return
    assert found.size == size
    for y in range(size[0]):
        for x in range(size[1]):
            if covered[y, x]:
                torch.testing.assert_close(at(found, y, x), painted[y, x], rtol=1e-4, atol=1e-5)
            elif rest == "none":
                assert at(found, y, x) is None
            else:  # 16 cells along 32 pixels: cells of 2 x 2
                cell = torch.zeros(size, dtype=torch.bool)
                cell[y // 2 * 2 : y // 2 * 2 + 2, x // 2 * 2 : x // 2 * 2 + 2] = True
                wanted = large[cell & ~covered].mean(dim=0)
                torch.testing.assert_close(at(found, y, x), wanted, rtol=1e-4, atol=1e-5)


def test_pixel_level_gives_ids_wherever_masks_cover_all(view, image):
    found = RefinedPixels(Toy(), Shapes(everywhere=True), "own").encode(view, image)
    assert found.dense is None
    assert len(found.vectors) == 4


@pytest.mark.parametrize("rest", ["none", "cells", "own"])
def test_labels_stay_labels(view, image, rest):
    class Shares(Toy):
        space, labels = "labels", ("red", "green", "blue")

    found = RefinedPixels(Shares(), Shapes(), rest).encode(view, image)
    assert found.labels == Shares.labels
    assert found.dense.shape == (12, 16, 3)
    plain = PlainPixels(Shares()).encode(view, image)
    assert plain.labels == Shares.labels
    large = read_bilinearly(plain.dense, (HEIGHT // 2, WIDTH // 2))
    # The corner lies outside all masks; its cell is the 2 x 2 pixels of the masks' size there.
    expected = {"none": torch.zeros(3), "own": plain.dense[0, 15], "cells": large[:2, -2:].mean(dim=(0, 1))}
    torch.testing.assert_close(found.dense[0, 15], expected[rest], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("with_masks", [False, True])
def test_instance_level(view, image, with_masks):
    generator = Shapes() if with_masks else None
    source = PaintedInstances(Toy(), Toy(), generator)
    found = source.encode(view, image)
    assert found.size == (HEIGHT, WIDTH)
    assert torch.equal(source.encode_text(["cat"]), Toy().encode_text(["cat"]))
    instances = Toy().find(view, image)
    vectors = Toy().encode_text(instances.names)
    for y in range(HEIGHT):
        for x in range(WIDTH):
            covering = []
            for k, (x1, y1, x2, y2) in enumerate(instances.boxes.tolist()):
                if with_masks:
                    x1, y1 = (x1 + x2) / 2, (y1 + y2) / 2
                if x1 <= x + 0.5 < x2 and y1 <= y + 0.5 < y2:
                    covering.append(k)
            if not covering:
                assert at(found, y, x) is None
            else:
                weights = instances.scores[covering]
                wanted = (vectors[covering] * weights[:, None]).sum(dim=0) / weights.sum()
                torch.testing.assert_close(at(found, y, x), wanted, rtol=1e-4, atol=1e-5)


def test_a_box_holds_the_pixels_whose_centres_it_holds():
    """Its near sides belong to it, its far sides do not."""
    boxes = torch.tensor([[0.5, 1.5, 2.5, 3.5], [0.6, 1.6, 2.6, 3.6], [-9, -9, 99, 99], [2, 2, 2, 4]])
    found = box_masks(boxes, (5, 4))
    assert found.shape == (4, 5, 4)
    assert found[0].nonzero().tolist() == [[1, 0], [1, 1], [2, 0], [2, 1]]
    assert found[1].nonzero().tolist() == [[2, 1], [2, 2], [3, 1], [3, 2]]
    assert found[2].all()
    assert not found[3].any()


def test_instances_with_masks_of_their_own(view, image):
    class Own(Toy):
        def find(self, view, image):
            found = super().find(view, image)
            masks = torch.zeros(3, HEIGHT, WIDTH, dtype=torch.bool)
            masks[0, 5] = True
            return Instances(found.boxes, found.names, found.scores, masks)

    found = PaintedInstances(Own(), Toy(), Shapes()).encode(view, image)
    assert torch.equal(found.ids[0] >= 0, torch.arange(HEIGHT)[:, None].expand(HEIGHT, WIDTH) == 5)


def test_nothing_found(view, image):
    class Blind(Toy):
        def find(self, view, image):
            return Instances(torch.zeros(0, 4), (), torch.zeros(0))

    found = PaintedInstances(Blind(), Toy()).encode(view, image)
    assert (found.ids == -1).all()
    assert found.vectors.shape == (0, 3)


def test_no_image_no_text_no_masks(view, image):
    class Mute:
        space, identity = "mute", "mute"

        def encode_pixels(self, image):
            return torch.zeros(2, 2, 3)

    source = PlainPixels(Mute())
    with pytest.raises(InputError, match="view a: this encoder needs an image"):
        source.encode(view, None)
    with pytest.raises(InputError, match=r"space 'mute' has no text side here; add one: \+text:"):
        source.encode_text(["cat"])
    with pytest.raises(InputError, match="rest: 'some' is not one of cells, own, none"):
        RefinedPixels(Mute(), Shapes(), "some")
    none = Shapes()
    none.masks = Masks(torch.zeros(0, 24, 32, dtype=torch.bool), torch.zeros(0), torch.zeros(0, dtype=torch.int64))
    with pytest.raises(InputError, match="found no mask"):
        RefinedPixels(Mute(), none, "none").encode(view, image)


def test_keys_name_all_parts(view):
    keys = {
        MaskedImages(Crops(Toy()), Shapes()).cache_key(view),
        MaskedImages(Crops(Toy(), background=False), Shapes()).cache_key(view),
        MaskedImages(Crops(Toy()), Shapes(), ("s",)).cache_key(view),
        RefinedPixels(Toy(), Shapes()).cache_key(view),
        RefinedPixels(Toy(), Shapes(), "own").cache_key(view),
        PlainPixels(Toy()).cache_key(view),
        PaintedInstances(Toy(), Toy()).cache_key(view),
        PaintedInstances(Toy(), Toy(), Shapes()).cache_key(view),
    }
    assert len(keys) == 8
    assert all("toy" in key for key in keys)


def test_two_spaces_never_mix():
    require_same_space("clip-512-a", "clip-512-a", "test")
    with pytest.raises(InputError, match="space 'clip-512-a' cannot be mixed with space 'lseg-512-b'"):
        require_same_space("clip-512-a", "lseg-512-b", "test")


@pytest.mark.parametrize(
    "bad",
    [
        lambda: Masks(torch.zeros(2, 3, 3), torch.zeros(2), torch.zeros(2)),
        lambda: Masks(torch.zeros(2, 3, 3, dtype=torch.bool), torch.zeros(1), torch.zeros(2)),
        lambda: Instances(torch.zeros(2, 4), ("a",), torch.zeros(2)),
        lambda: Instances(torch.zeros(1, 4), ("a",), torch.zeros(1), torch.zeros(2, 3, 3)),
    ],
)
def test_fields_that_do_not_fit(bad):
    with pytest.raises(InputError, match=r"masks|instances"):
        bad()


@pytest.mark.parametrize("rule", [MaskedImages, RefinedPixels])
def test_a_cached_map_depends_on_the_files_of_its_masks(view, rule):
    class Filed(Shapes):
        content = "one"

        def identity_of(self, view):
            return self.content

    class Seeing(Toy):
        identity = "toy"

    generator = Filed()
    source = rule(Seeing(), generator)
    before = source.cache_key(view)
    assert source.cache_key(view) == before
    generator.content = "other"
    assert source.cache_key(view) != before


def test_masks_of_several_scales_have_the_size_of_the_first():
    """One pixel of the smaller map is four of the larger; scores and ranks follow their masks."""
    large, small = torch.zeros(1, 4, 6, dtype=torch.bool), torch.zeros(2, 2, 3, dtype=torch.bool)
    large[0, 3, 5] = small[0, 0, 2] = small[1, 1, 0] = True
    first = Masks(large, torch.tensor([0.9]), torch.tensor([2]))
    second = Masks(small, torch.tensor([0.5, 0.4]), torch.tensor([0, 1]))
    found = combine_masks([first, second])
    assert (found.masks.shape, found.scores.tolist()) == ((3, 4, 6), pytest.approx([0.9, 0.5, 0.4]))
    assert found.ranks.tolist() == [2, 0, 1]
    assert torch.equal(found.masks[0], large[0])
    assert found.masks[1].nonzero().tolist() == [[0, 4], [0, 5], [1, 4], [1, 5]]
    assert found.masks[2].nonzero().tolist() == [[2, 0], [2, 1], [3, 0], [3, 1]]
    assert combine_masks([second, first]).masks.shape == (3, 2, 3)
