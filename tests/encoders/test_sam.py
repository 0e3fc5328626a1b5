"""SAM, SAM 2 and SAM 3 on tiny networks of the real classes, and the rules of "everything" against slow loops."""

import numpy as np
import pytest
import torch

from sgwarp.encoders.base import Masks
from sgwarp.encoders.masks.sam import CLASSES, Sam, SamSettings, best_boxes, without_repetitions
from sgwarp.errors import InputError

LOOSE = SamSettings(
    points=3, together=4, least_score=-100.0, least_stability=0.0, offset=0.0, overlap=1.0, smallest=0.0
)


@pytest.fixture
def image() -> torch.Tensor:
    return torch.rand(48, 80, 3, generator=torch.Generator().manual_seed(3))


@pytest.fixture(params=["sam", "sam2", "sam3"])
def kind(request) -> str:
    return request.param


def by_hand(folder, kind, image, **prompts):
    """The library's own model on an image prepared here; mask logits in the shape of the image, and scores."""
    import transformers

    model = getattr(transformers, CLASSES[kind]).from_pretrained(folder).eval()
    height, width = image.shape[:2]
    # SAM keeps the shape: 48 x 80 becomes 38 x 64 of a square of 64; the others stretch it.
    inside = (38, 64) if kind == "sam" else (64, 64)
    mode = "bicubic" if kind == "sam" else "bilinear"
    small = torch.nn.functional.interpolate(
        image.permute(2, 0, 1)[None], inside, mode=mode, antialias=True, align_corners=False
    ).clamp(0, 1)
    mean, deviation = torch.tensor([0.48, 0.45, 0.40]), torch.tensor([0.26, 0.25, 0.27])
    square = torch.zeros(1, 3, 64, 64)
    square[:, :, : inside[0], : inside[1]] = (small - mean[:, None, None]) / deviation[:, None, None]
    scale = torch.tensor([inside[1] / width, inside[0] / height])
    if "input_points" in prompts:
        prompts["input_points"] = prompts["input_points"] * scale
    else:
        prompts["input_boxes"] = prompts["input_boxes"] * torch.cat([scale, scale])
    with torch.no_grad():
        found = model(pixel_values=square, **prompts)
    logits = found.pred_masks[0].flatten(0, 1)[None]
    large = torch.nn.functional.interpolate(logits, (64, 64), mode="bilinear", align_corners=False)
    large = large[:, :, : inside[0], : inside[1]]
    return torch.nn.functional.interpolate(large, (height, width), mode="bilinear", align_corners=False)[0], found


def test_boxes(sam_models, kind, image):
    boxes = torch.tensor([[4.0, 5, 40, 30], [10, 2, 70, 44], [0, 0, 79, 47], [3, 3, 9, 9], [20, 20, 60, 40]])
    sam = Sam(str(sam_models[kind]), LOOSE)
    found = sam.in_boxes(image, boxes)
    logits, _ = by_hand(sam_models[kind], kind, image, input_boxes=boxes[None], multimask_output=False)
    assert found.shape == (5, 48, 80)
    assert found.dtype == torch.bool
    clear = logits.abs() > 0.02 * logits.std()
    assert torch.equal(found[clear], (logits > 0)[clear])
    assert clear.float().mean() > 0.9


@pytest.mark.slow
def test_everything_asks_at_a_grid_of_points(sam_models, kind, image, tools, monkeypatch):
    """Loose settings leave out nothing but empty masks: three for the middle of each of 3 x 3 cells."""
    monkeypatch.setattr("sgwarp.encoders.masks.sam.without_repetitions", lambda masks, overlap, by_rank: masks)
    points = torch.tensor([[(x + 0.5) * 80 / 3, (y + 0.5) * 48 / 3] for y in range(3) for x in range(3)])
    logits, answers = by_hand(sam_models[kind], kind, image, input_points=points[None, :, None])
    wanted = (logits > 0).flatten(1)
    scores = answers.iou_scores[0].flatten()
    ranks = torch.arange(3).repeat(9)
    found = Sam(str(sam_models[kind]), LOOSE).everything(tools.make_view(48, 80), image)
    there = wanted.any(dim=1)
    assert found.masks.shape == (int(there.sum()), 48, 80)
    torch.testing.assert_close(found.scores, scores[there], rtol=0, atol=1e-4)
    assert torch.equal(found.ranks, ranks[there])
    assert (found.masks.flatten(1) == wanted[there]).float().mean() > 0.99


def test_masks_no_larger_than_asked(sam_models, tools):
    sam = Sam(
        str(sam_models["sam"]), SamSettings(points=1, least_score=-100.0, least_stability=0.0, offset=0.0, longest=20)
    )
    assert sam.everything(tools.make_view(48, 80), torch.rand(48, 80, 3)).masks.shape[1:] == (12, 20)


def test_score_and_stability(sam_models, kind):
    """Masks of logits that fall off linearly: the slope decides how stable they are."""
    settings = SamSettings(least_score=0.5, least_stability=0.8)
    sam = Sam(str(sam_models[kind]), settings)
    ramp = torch.linspace(-16, 16, 16).expand(16, 16)
    logits = torch.stack([ramp * 4, ramp / 8, ramp * 4])[None]  # steep, flat, steep
    scores = torch.tensor([[0.9, 0.9, 0.1]])
    found, kept, ranks = sam._good(logits, scores, (sam.side, sam.side))
    assert kept.tolist() == pytest.approx([0.9])
    assert ranks.tolist() == [0]
    assert torch.equal(found[0], ramp * 4)


def random_masks(seed: int) -> Masks:
    rng = np.random.default_rng(seed)
    masks = np.zeros((12, 20, 30), bool)
    for mask in masks:
        y, x = rng.integers(0, 14), rng.integers(0, 22)
        mask[y : y + rng.integers(2, 7), x : x + rng.integers(2, 9)] = True
    scores = torch.from_numpy(rng.permutation(12).astype(np.float32))
    return Masks(torch.from_numpy(masks), scores, torch.from_numpy(rng.integers(0, 3, 12)))


@pytest.mark.parametrize("by_rank", [False, True])
@pytest.mark.parametrize("overlap", [0.1, 0.3])
def test_repetitions_against_a_loop(overlap, by_rank):
    dropped = 0
    for seed in range(5):
        masks = random_masks(seed)
        kept: list[int] = []
        for number in sorted(range(12), key=lambda k: -masks.scores[k]):
            boxes = []
            for k in (number, *kept):
                y, x = np.nonzero(masks.masks[k].numpy())
                boxes.append((x.min(), y.min(), x.max() + 1, y.max() + 1))
            repeats = False
            for other, box in zip(kept, boxes[1:], strict=True):
                wide = min(box[2], boxes[0][2]) - max(box[0], boxes[0][0])
                high = min(box[3], boxes[0][3]) - max(box[1], boxes[0][1])
                shared = max(wide, 0) * max(high, 0)
                whole = sum((b[2] - b[0]) * (b[3] - b[1]) for b in (box, boxes[0])) - shared
                same = not by_rank or masks.ranks[other] == masks.ranks[number]
                repeats |= bool(same and shared / whole >= overlap)
            if not repeats:
                kept.append(number)
        found = without_repetitions(masks, overlap, by_rank)
        assert torch.equal(found.masks, masks.masks[kept])
        assert torch.equal(found.ranks, masks.ranks[kept])
        dropped += 12 - len(kept)
    assert dropped > 0


def test_nothing_at_all():
    empty = Masks(torch.zeros(0, 4, 4, dtype=torch.bool), torch.zeros(0), torch.zeros(0, dtype=torch.int64))
    assert len(without_repetitions(empty, 0.5)) == 0
    with pytest.raises(InputError, match="overlap"):
        best_boxes(torch.zeros(1, 4), 0.0)


def test_identity_knows_the_weights(sam_models, tmp_path):
    first, again = (Sam(str(sam_models["sam"]), LOOSE) for _ in range(2))
    assert first.identity == again.identity
    assert Sam(str(sam_models["sam"])).identity != first.identity
    with torch.no_grad():
        again.model.mask_decoder.iou_token.weight += 1.0
    again.model.save_pretrained(tmp_path)
    (tmp_path / "preprocessor_config.json").write_text((sam_models["sam"] / "preprocessor_config.json").read_text())
    assert Sam(str(tmp_path), LOOSE).identity != first.identity


def test_another_model_is_refused(joint_models):
    with pytest.raises(InputError, match="holds a model of type 'clip', not sam or sam2"):
        Sam(str(joint_models["clip"]))
