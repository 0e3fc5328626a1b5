"""GroundingDINO, OWLv2, CLIPSeg, Mask2Former and OneFormer on tiny networks of the real classes."""

from types import SimpleNamespace

import pytest
import torch

from sgwarp.encoders.base import InstanceEncoder
from sgwarp.encoders.instances.detections import DetectorSettings, keep_detections
from sgwarp.encoders.instances.grounding_dino import GroundingDino
from sgwarp.encoders.instances.owlv2 import Owlv2
from sgwarp.encoders.maps.closed_set import ClosedSet, class_shares
from sgwarp.encoders.pixels.clipseg import ClipSeg
from sgwarp.errors import InputError

ALL = DetectorSettings(least_score=0.0, overlap=1.0)
SWIN = {
    "model_type": "swin",
    "embed_dim": 8,
    "depths": [1, 1, 1, 1],
    "num_heads": [1, 1, 2, 2],
    "window_size": 2,
    "image_size": 64,
}


@pytest.fixture(scope="module")
def gdino(tools, tmp_path_factory):
    import transformers

    folder = tmp_path_factory.mktemp("gdino")
    torch.manual_seed(0)
    text = {
        "model_type": "bert",
        "vocab_size": 1100,
        "hidden_size": 16,
        "num_hidden_layers": 1,
        "num_attention_heads": 2,
        "intermediate_size": 24,
        "max_position_embeddings": 32,
    }
    config = transformers.GroundingDinoConfig(
        backbone_config={**SWIN, "out_features": ["stage2", "stage3", "stage4"]},
        text_config=text,
        d_model=32,
        encoder_layers=1,
        decoder_layers=2,
        encoder_attention_heads=2,
        decoder_attention_heads=2,
        encoder_ffn_dim=24,
        decoder_ffn_dim=24,
        num_queries=12,
        max_text_len=32,
    )
    tools.write_model(folder, transformers.GroundingDinoForObjectDetection(config))
    tools.write_tokenizer(folder, 32)
    tools.write_preparation(folder, {"shortest_edge": 128, "longest_edge": 256})
    return folder


@pytest.fixture(scope="module")
def owlv2(tools, tmp_path_factory):
    import transformers

    folder = tmp_path_factory.mktemp("owlv2")
    torch.manual_seed(0)
    config = transformers.Owlv2Config(
        text_config={**tools.text, "max_position_embeddings": 16}, vision_config=tools.vision, projection_dim=32
    )
    model = transformers.Owlv2ForObjectDetection(config)
    for value in model.box_head.parameters():
        value.data *= 0.01  # random weights of full size would put every box outside the image
    tools.write_model(folder, model)
    tools.write_tokenizer(folder)
    tools.write_preparation(folder, {"height": 32, "width": 32})
    return folder


def corners(box, width, height):
    x, y, w, h = box.tolist()
    sides = (x - w / 2) * width, (y - h / 2) * height, (x + w / 2) * width, (y + h / 2) * height
    return [min(max(side, 0), limit) for side, limit in zip(sides, (width, height, width, height), strict=True)]


def test_grounding_dino(gdino, tools, view, image):
    """Against the library's model on the prompt "couch . teddy bear . ", phrase by phrase through its tokens."""
    from transformers import GroundingDinoForObjectDetection

    encoder = GroundingDino(str(gdino), ("couch", "Teddy bear"), ALL)
    found = encoder.find(view, image)
    model = GroundingDinoForObjectDetection.from_pretrained(gdino).eval()
    tokens = torch.tensor([[101, 200, 1012, 210, 211, 1012, 102]])
    owners = {0: (1,), 1: (3, 4)}
    large = torch.nn.functional.interpolate(
        image.permute(2, 0, 1)[None], (128, 160), mode="bicubic", antialias=True, align_corners=False
    ).clamp(0, 1)
    values = (large - tools.mean[:, None, None]) / tools.deviation[:, None, None]
    with torch.no_grad():
        answer = model(pixel_values=values, input_ids=tokens, attention_mask=torch.ones_like(tokens))
    wanted = []
    for logits, box in zip(answer.logits[0], answer.pred_boxes[0], strict=True):
        scores = [max(torch.sigmoid(logits[place]).item() for place in owners[k]) for k in (0, 1)]
        best = int(scores[1] > scores[0])
        wanted.append((scores[best], ("couch", "Teddy bear")[best], corners(box, 64, 48)))
    wanted = sorted((row for row in wanted if row[2][2] > row[2][0] and row[2][3] > row[2][1]), key=lambda row: -row[0])
    assert len(found.names) == len(wanted) > 0
    torch.testing.assert_close(found.scores, torch.tensor([row[0] for row in wanted]), rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(found.boxes, torch.tensor([row[2] for row in wanted]), rtol=1e-2, atol=0.05)
    assert found.names == tuple(row[1] for row in wanted)


def test_long_lists_of_names_are_asked_in_several_prompts(gdino, view, image):
    names = tuple(f"the {word} of the {word}" for word in ("couch", "lamp", "cup", "bear", "photo", "task"))
    encoder = GroundingDino(str(gdino), names, ALL)
    assert len(encoder._prompts) == 2
    assert sum(int(owners.max()) + 1 for _, _, owners in encoder._prompts) == len(names)
    for _, tokens, owners in encoder._prompts:
        assert tokens["input_ids"].shape == (1, len(owners))
        assert len(owners) <= 32
    assert set(encoder.find(view, image).names) <= set(names)
    with pytest.raises(InputError, match="is longer than a prompt of 32 tokens"):
        GroundingDino(str(gdino), ("couch " * 40,))


def test_prompts_hold_the_names_in_their_order(gdino):
    """Tokens and the class that each speaks for, -1 for marks and full stops, prompt by prompt."""
    encoder = GroundingDino(str(gdino), ("couch", "teddy bear", " Lamp", "the cup", "photo"))
    encoder.model.config.max_text_len = 10
    pieces = [[200, 1012], [210, 211, 1012], [201, 1012], [203, 202, 1012], [208, 1012]]
    wanted = [(0, pieces[:3], [-1, 0, -1, 1, 1, -1, 2, -1, -1]), (3, pieces[3:], [-1, 0, 0, -1, 1, -1, -1])]
    found = list(encoder._fill_prompts("gdino"))
    assert len(found) == len(wanted)
    for (first, tokens, owners), (start, words, classes) in zip(found, wanted, strict=True):
        ids = torch.tensor([[101, *(word for name in words for word in name), 102]])
        assert (first, owners.tolist()) == (start, classes)
        assert torch.equal(tokens["input_ids"], ids)
        assert torch.equal(tokens["attention_mask"], torch.ones_like(ids))
        assert torch.equal(tokens["token_type_ids"], torch.zeros_like(ids))


@pytest.mark.parametrize(("positions", "longest", "limit"), [(12, 256, 12), (256, 12, 12), (256, 64, 64)])
def test_a_prompt_keeps_to_the_shorter_of_two_limits(gdino, positions, longest, limit):
    encoder = GroundingDino(str(gdino), ("couch",) * 40)
    encoder.model.config.text_config.max_position_embeddings = positions
    encoder.model.config.max_text_len = longest
    lengths = [len(owners) for _, _, owners in encoder._fill_prompts("grounding-dino")]
    assert limit - 1 <= max(lengths) <= limit


@pytest.mark.slow
def test_owlv2(owlv2, tools, view, image):
    """Against the library's model on the image in the upper left corner of a grey square."""
    from transformers import Owlv2ForObjectDetection

    found = Owlv2(str(owlv2), ("couch", "teddy bear"), ("{}",), ALL).find(view, image)
    square = torch.full((1, 3, 64, 64), 0.5)
    square[:, :, :48] = image.permute(2, 0, 1)
    small = torch.nn.functional.interpolate(square, (32, 32), mode="bicubic", antialias=True, align_corners=False)
    values = (small.clamp(0, 1) - tools.mean[:, None, None]) / tools.deviation[:, None, None]
    tokens = torch.zeros(2, 16, dtype=torch.int64)
    tokens[0, :3], tokens[1, :4] = torch.tensor([101, 200, 102]), torch.tensor([101, 210, 211, 102])
    model = Owlv2ForObjectDetection.from_pretrained(owlv2).eval()
    with torch.no_grad():
        answer = model(pixel_values=values, input_ids=tokens, attention_mask=(tokens > 0).long())
    wanted = []
    for logits, box in zip(answer.logits[0], answer.pred_boxes[0], strict=True):
        place = corners(box, 64, 64)
        place[1], place[3] = min(place[1], 48), min(place[3], 48)
        wanted.append((torch.sigmoid(logits.max()).item(), ("couch", "teddy bear")[int(logits.argmax())], place))
    wanted = sorted((row for row in wanted if row[2][3] > row[2][1] and row[2][2] > row[2][0]), key=lambda row: -row[0])
    assert len(found.names) == len(wanted) > 0
    torch.testing.assert_close(found.scores, torch.tensor([row[0] for row in wanted]), rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(found.boxes, torch.tensor([row[2] for row in wanted]), rtol=1e-2, atol=0.05)


@pytest.mark.parametrize("encoder", [GroundingDino, Owlv2])
def test_detectors_need_names(encoder):
    with pytest.raises(InputError, match="needs the names to look for"):
        encoder("somewhere", ())


def test_owlv2_has_one_template(owlv2):
    for templates in ((), ("{}", "the {}")):
        with pytest.raises(InputError, match="needs the names to look for, and one template"):
            Owlv2(str(owlv2), ("couch",), templates)
    assert Owlv2(str(owlv2), ("couch " * 40,)).settings == DetectorSettings(0.1, 0.7)  # a long name is cut


@pytest.mark.slow
def test_detectors_keep_the_protocol(gdino, owlv2):
    def asked(encoder: InstanceEncoder) -> str:
        return encoder.identity

    assert asked(GroundingDino(str(gdino), ("couch",))) != asked(GroundingDino(str(gdino), ("lamp",)))
    assert asked(Owlv2(str(owlv2), ("couch",))) != asked(Owlv2(str(owlv2), ("couch",), settings=ALL))


def test_which_detections_count():
    boxes = torch.tensor([[0.5, 0.5, 0.2, 0.2], [0.51, 0.5, 0.2, 0.2], [0.5, 0.5, 0.2, 0.2], [1.5, 0.5, 0.2, 0.2]])
    scores = torch.tensor([0.6, 0.9, 0.5, 0.8])
    settings = DetectorSettings(least_score=0.4, overlap=0.7)
    found = keep_detections(boxes, ["cup", "cup", "lamp", "cup"], scores, settings, (100, 200))
    assert found.names == ("cup", "lamp")  # the first repeats the second, the last lies outside
    torch.testing.assert_close(found.boxes, torch.tensor([[82.0, 40, 122, 60], [80, 40, 120, 60]]))
    assert len(keep_detections(boxes, ["cup"] * 4, scores, DetectorSettings(0.95), (100, 200)).names) == 0


@pytest.fixture(scope="module")
def clipseg(tools, tmp_path_factory):
    import transformers

    folder = tmp_path_factory.mktemp("clipseg")
    torch.manual_seed(0)
    config = transformers.CLIPSegConfig(
        text_config=tools.text,
        vision_config=tools.vision,
        projection_dim=24,
        extract_layers=[0, 1],
        reduce_dim=16,
        decoder_num_attention_heads=2,
        decoder_intermediate_size=24,
    )
    tools.write_model(folder, transformers.CLIPSegForImageSegmentation(config))
    tools.write_tokenizer(folder)
    tools.write_preparation(folder, {"height": 32, "width": 32})
    return folder


def test_clipseg(clipseg, tools, image):
    """All phrases at once through the library against one at a time."""
    from transformers import CLIPSegForImageSegmentation

    encoder = ClipSeg(str(clipseg), ("couch", "teddy bear"))
    found = encoder.encode_pixels(image)
    assert encoder.labels == ("couch", "teddy bear")
    assert (encoder.space, found.shape[2]) == ("labels", 2)
    small = torch.nn.functional.interpolate(
        image.permute(2, 0, 1)[None], (32, 32), mode="bicubic", antialias=True, align_corners=False
    ).clamp(0, 1)
    values = (small - tools.mean[:, None, None]) / tools.deviation[:, None, None]
    tokens = torch.tensor([[101, 200, 102, 0], [101, 210, 211, 102]])
    model = CLIPSegForImageSegmentation.from_pretrained(clipseg).eval()
    with torch.no_grad():
        answer = model(input_ids=tokens, attention_mask=(tokens > 0).long(), pixel_values=values.expand(2, -1, -1, -1))
    torch.testing.assert_close(found, answer.logits.sigmoid().permute(1, 2, 0), rtol=1e-3, atol=1e-5)
    assert not torch.allclose(found[..., 0], found[..., 1])
    both = ClipSeg(str(clipseg), ("couch", "teddy bear"), ("{}", "a photo of a {}")).encode_pixels(image)
    other = ClipSeg(str(clipseg), ("couch", "teddy bear"), ("a photo of a {}",)).encode_pixels(image)
    torch.testing.assert_close(both, (found + other) / 2, rtol=1e-4, atol=1e-6)
    long, cut = (ClipSeg(str(clipseg), ("couch " * count,)).encode_pixels(image) for count in (40, 14))
    torch.testing.assert_close(long, cut, rtol=1e-4, atol=1e-6)  # 16 tokens with their marks
    with pytest.raises(InputError, match="needs the phrases to look for"):
        ClipSeg(str(clipseg), ())


def write_closed_set(folder, tools, kind):
    import transformers

    torch.manual_seed(0)
    names = {number: name for number, name in enumerate(("couch", "lamp", "wall"))}
    common = {"id2label": names, "label2id": {name: number for number, name in names.items()}, "num_labels": 3}
    backbone = {**SWIN, "out_features": ["stage1", "stage2", "stage3", "stage4"]}
    if kind == "mask2former":
        config = transformers.Mask2FormerConfig(
            backbone_config=backbone,
            feature_size=32,
            mask_feature_size=32,
            hidden_dim=32,
            encoder_feedforward_dim=24,
            encoder_layers=1,
            decoder_layers=2,
            num_attention_heads=2,
            dim_feedforward=24,
            num_queries=6,
            **common,
        )
        tools.write_model(folder, transformers.Mask2FormerForUniversalSegmentation(config))
    else:
        config = transformers.OneFormerConfig(
            backbone_config=backbone,
            conv_dim=32,
            mask_dim=32,
            hidden_dim=32,
            encoder_feedforward_dim=24,
            encoder_layers=1,
            decoder_layers=2,
            num_attention_heads=2,
            dim_feedforward=24,
            num_queries=6,
            query_dec_layers=1,
            task_seq_len=12,
            is_training=False,
            **common,
        )
        tools.write_model(folder, transformers.OneFormerForUniversalSegmentation(config))
        tools.write_tokenizer(folder)
    tools.write_preparation(folder, {"shortest_edge": 64})


@pytest.mark.parametrize("kind", ["mask2former", "oneformer"])
def test_closed_sets(kind, tools, tmp_path, view, image):
    write_closed_set(tmp_path, tools, kind)
    source = ClosedSet(str(tmp_path), least=0.0, longest=64)
    assert source.needs_image
    found = source.encode(view, image)
    assert (found.space, found.labels) == ("labels", ("couch", "lamp", "wall"))
    assert found.size == (16, 16)  # 48 x 64 becomes 64 x 64, read at a quarter
    # What the library's own network is asked, by hand.
    large = torch.nn.functional.interpolate(
        image.permute(2, 0, 1)[None], (64, 64), mode="bicubic", antialias=True, align_corners=False
    ).clamp(0, 1)
    asked = {"pixel_values": (large - tools.mean[:, None, None]) / tools.deviation[:, None, None]}
    if kind == "oneformer":
        asked["task_inputs"] = torch.tensor([[101, 203, 204, 205, 206, 102] + [0] * 6])
    with torch.no_grad():
        answer = source.model(**asked)
    best, number = class_shares(answer.class_queries_logits[0], answer.masks_queries_logits[0]).max(dim=0)
    assert best.shape == (16, 16)  # as large as the map: nothing is resized
    assert torch.equal(found.ids[0].long(), number)
    middle = float(best.median())
    some = ClosedSet(str(tmp_path), least=middle, longest=64).encode(view, image)
    assert 0.3 < (some.ids >= 0).float().mean() < 0.7
    clear = (best - middle).abs() > 1e-5
    assert torch.equal((some.ids[0] >= 0)[clear], (best > middle)[clear])
    strict = ClosedSet(str(tmp_path), least=0.999, longest=64).encode(view, image)
    assert (strict.ids == -1).all()  # random weights are sure of nothing
    with pytest.raises(InputError, match="needs an image"):
        source.encode(view, None)


def test_every_pixel_has_the_class_with_the_greatest_share(tools, tmp_path, view, image):
    """Of a network that is sure of three regions, at half the size of the map; and of less than `least` nothing."""
    write_closed_set(tmp_path, tools, "mask2former")
    source = ClosedSet(str(tmp_path), least=0.6, longest=64)
    classes = torch.full((1, 4, 4), -20.0)
    for query, (number, logit) in enumerate([(0, 20.0), (2, 20.0), (1, 20.0), (0, -20.0)]):
        classes[0, query, number] = logit  # all classes of the last alike, "nothing" among them
    masks = torch.full((1, 4, 8, 8), -20.0)
    masks[0, 0, :4] = masks[0, 1, 4:, :4] = masks[0, 3, 4:, 4:] = 20.0
    masks[0, 2, :4, 6:] = 21.0
    masks[0, 0, :4, 6:] = -1.0  # 0.27
    asked = []

    def model(**inputs):
        asked.append(inputs)
        return SimpleNamespace(class_queries_logits=classes, masks_queries_logits=masks)

    source.model = model
    found = source.encode(view, image).ids[0]
    assert (asked[0]["pixel_mask"] == 1).all()
    assert asked[0]["pixel_mask"].shape == (1, 64, 64)
    assert found.shape == (16, 16)
    assert (found[:7, :11] == 0).all()
    assert (found[9:, :7] == 2).all()
    assert (found[:7, 13:] == 1).all()
    assert (found[9:, 9:] == -1).all()  # a quarter for each class


@pytest.mark.parametrize(
    ("settings", "fits"),
    [
        ({"least": 0.0, "longest": 32}, True),
        ({"least": 0.99, "longest": 32}, True),
        ({"least": 1.0}, False),
        ({"least": -0.1}, False),
        ({"longest": 31}, False),
    ],
)
def test_settings_of_closed_sets(tools, tmp_path, settings, fits):
    write_closed_set(tmp_path, tools, "mask2former")
    if fits:
        assert ClosedSet(str(tmp_path), **settings).longest == 32
        return
    with pytest.raises(InputError, match="least is a confidence from 0 to 1 and longest at least 32"):
        ClosedSet(str(tmp_path), **settings)


def test_class_shares_against_a_loop():
    noise = torch.Generator().manual_seed(0)
    classes, masks = torch.randn(3, 5, generator=noise), torch.randn(3, 2, 2, generator=noise)
    found = class_shares(classes, masks)
    for k in range(4):
        for y in range(2):
            for x in range(2):
                wanted = sum(
                    float(classes[q].softmax(0)[k]) / (1 + float(torch.exp(-masks[q, y, x]))) for q in range(3)
                )
                assert found[k, y, x].item() == pytest.approx(wanted, rel=1e-5)
