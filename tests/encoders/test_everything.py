"""How "segment everything" asks a SAM, and which of its answers count; a SAM without its network, answers by hand."""

import pytest
import torch
from torch.nn.functional import interpolate

from sgwarp.encoders.masks.sam import Sam, SamSettings, best_boxes

SIDE, INSIDE = 64, (38, 64)  # an image of 48 x 80 in a square of 64


def bare(**settings) -> Sam:
    sam = object.__new__(Sam)
    sam.settings, sam.side, sam.device, sam.kind = SamSettings(**settings), SIDE, torch.device("cpu"), "sam"
    return sam


def logits_of(*counts: int, high: float = 9.0, low: float = -9.0) -> torch.Tensor:
    """Maps of 16 x 16 of which so many places are high, row by row."""
    flat = torch.full((len(counts), 256), low)
    for row, count in zip(flat, counts, strict=True):
        row[:count] = high
    return flat.view(-1, 16, 16)


@pytest.fixture
def image() -> torch.Tensor:
    return torch.rand(48, 80, 3, generator=torch.Generator().manual_seed(3))


def test_points_lie_in_the_middles_of_cells_row_by_row(image):
    sam, asked = bare(points=2, together=3, smallest=0.0), []

    def decode(embedding, input_points):
        asked.append((embedding, input_points))
        return torch.zeros(input_points.shape[1], 3, 16, 16), torch.zeros(input_points.shape[1], 3)

    sam._look = lambda image: ("embedding", INSIDE)
    sam._decode = decode
    found = sam.everything(None, image)
    assert found.masks.shape == (0, 48, 80)
    assert [(name, tuple(points.shape)) for name, points in asked] == [
        ("embedding", (1, 3, 1, 2)),
        ("embedding", (1, 1, 1, 2)),
    ]
    points = torch.cat([points[0, :, 0] for _, points in asked])
    assert points.tolist() == [[16.0, 9.5], [48.0, 9.5], [16.0, 28.5], [48.0, 28.5]]


@pytest.mark.parametrize(("smallest", "kept"), [(0.0, 3), (1 / 5, 3), (0.201, 2), (0.41, 1), (0.61, 0)])
def test_masks_that_cover_too_little_of_the_image_are_left_out(image, smallest, kept):
    """Of an image that fills the square they cover 20, 40 and 60 percent; one that covers nothing never counts."""
    sam = bare(points=1, smallest=smallest, overlap=1.0, least_stability=0.5)
    rows = torch.zeros(1, 4, 20, 20)
    for number, high in enumerate((4, 8, 12)):
        rows[0, number] = torch.where(torch.arange(20)[:, None] < high, 9.0, -9.0)
    rows[0, 3] = -9.0
    sam._look = lambda image: (None, (SIDE, SIDE))
    sam._decode = lambda embedding, input_points: (rows, torch.tensor([[0.9, 0.95, 0.99, 1.0]]))
    found = sam.everything(None, torch.zeros(80, 80, 3))
    assert found.ranks.tolist() == [2, 1, 0][:kept]  # the best first
    shares = found.masks.flatten(1).float().mean(dim=1).tolist()
    assert shares == pytest.approx([0.6, 0.4, 0.2][:kept], abs=0.001)


def test_settings_of_repetitions_are_used(image):
    alike = logits_of(128, 144)[None]
    for settings, count in (({"overlap": 0.8}, 1), ({"overlap": 0.95}, 2), ({"overlap": 0.8, "by_rank": True}, 2)):
        sam = bare(points=1, **settings)
        sam._look = lambda image: (None, (SIDE, SIDE))
        sam._decode = lambda embedding, input_points: (alike, torch.tensor([[0.9, 0.95]]))
        assert len(sam.everything(None, image)) == count


def test_what_is_good_enough():
    """Score and stability reach their least values; nothing above the higher threshold is no mask."""
    sam = bare(least_score=0.5, least_stability=0.5, offset=1.0)
    flat = logits_of(0, 0, 0, 0, 0, 0).flatten(1)
    flat[:, :20] = 0.0  # above the lower threshold alone
    flat[0, :10] = flat[1, :9] = flat[2, :10] = flat[3, :10] = 2.0
    flat[4, :20] = 1.0  # the threshold itself is not above it
    flat[5] = -1.0
    scores = torch.tensor([[0.9, 0.9, 0.5], [0.49, 0.9, 0.9]])
    logits, kept, ranks = sam._good(flat.view(2, 3, 16, 16), scores, (SIDE, SIDE))
    assert (kept.tolist(), ranks.tolist()) == (pytest.approx([0.9, 0.5]), [0, 2])
    assert torch.equal(logits.flatten(1), flat[[0, 2]])


@pytest.mark.parametrize(("place", "good"), [((9, 0), False), ((10, 0), True), ((9, 15), False)])
def test_only_the_part_that_the_image_fills_is_looked_at(place, good):
    """38 of 64 rows are 9.5 of 16, so 10."""
    sam = bare(least_score=0.0, least_stability=0.9)
    logits = logits_of(5)[None]
    logits[0, 0, place[0], place[1]] = 0.5  # not stable
    assert len(sam._good(logits, torch.ones(1, 1), INSIDE)[0]) == good
    turned = sam._good(logits.transpose(2, 3), torch.ones(1, 1), INSIDE[::-1])[0]
    assert len(turned) == good


@pytest.mark.parametrize(("longest", "size"), [(1024, (48, 80)), (40, (24, 40)), (80, (48, 80))])
def test_masks_have_the_shape_of_the_image(image, longest, size):
    """As many as there are: more than go through at once."""
    noise = torch.randn(20, 16, 16, generator=torch.Generator().manual_seed(0))
    found = bare(longest=longest)._at_size(noise, INSIDE, image)
    square = interpolate(noise[None], (64, 64), mode="bilinear", align_corners=False)[:, :, :38]
    wanted = interpolate(square, size, mode="bilinear", align_corners=False)[0]
    assert found.shape == (20, *size)
    clear = wanted.abs() > 1e-4
    assert torch.equal(found[clear], (wanted > 0)[clear])


@pytest.mark.parametrize(("overlap", "kept"), [(0.5, [True, False]), (0.51, [True, True]), (1.0, [True, True])])
def test_of_two_boxes_that_overlap_by_so_much_the_first_stays(overlap, kept):
    boxes = torch.tensor([[0, 0, 2, 1], [0, 0, 1, 1]])
    assert best_boxes(boxes, overlap).tolist() == kept
    assert best_boxes(boxes.flip(0), overlap).tolist() == kept
    assert best_boxes(boxes, overlap, torch.tensor([0, 1])).tolist() == [True, True]
    assert best_boxes(torch.zeros(2, 4), overlap).tolist() == [True, True]  # of nothing, nothing is shared


def test_what_was_dropped_drops_nothing():
    """The second repeats the first; the third repeats the second alone."""
    boxes = torch.tensor([[0.0, 0, 10, 10], [3, 0, 13, 10], [6, 0, 16, 10]])
    assert best_boxes(boxes, 0.5).tolist() == [True, False, True]
