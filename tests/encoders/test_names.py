"""Names of encoders, what is made of them, and what is said when they do not fit."""

import ast
import importlib.util
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch

from sgwarp.encoders import catalogue
from sgwarp.encoders.building import builder
from sgwarp.encoders.cache import CachedMaps
from sgwarp.encoders.catalogue import KINDS
from sgwarp.encoders.compose import Crops, MaskedImages, PaintedInstances, PlainPixels, RefinedPixels
from sgwarp.encoders.ensemble import Ensemble
from sgwarp.encoders.images.clip import JointEncoder
from sgwarp.encoders.instances.detections import DetectorSettings
from sgwarp.encoders.instances.vlpart import VLPartFiles
from sgwarp.encoders.maps.files import LABEL_SPACE
from sgwarp.encoders.masks.files import FileMasks
from sgwarp.encoders.masks.proposals import Proposals
from sgwarp.encoders.masks.sam import Sam
from sgwarp.encoders.names import parse
from sgwarp.encoders.registry import encoder_of_questions, make_encoder, make_text_encoder, text_encoder_for
from sgwarp.errors import InputError


def builders() -> set[str]:
    return {path for kind in KINDS.values() for path in (kind.make, kind.speak) if path}


@pytest.mark.parametrize("path", sorted(builders()))
def test_a_builder_passes_the_device_on(path):
    """To every class of its file that takes one; without a GPU no result would tell."""
    module, _, function = path.partition(":")
    tree = ast.parse(Path(importlib.util.find_spec(module).origin).read_text(encoding="utf-8"))
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    takers = {
        owner.name
        for owner in tree.body
        if isinstance(owner, ast.ClassDef)
        for node in owner.body
        if isinstance(node, ast.FunctionDef) and node.name == "__init__" and "device" in {a.arg for a in node.args.args}
    }
    (made,) = [node for node in functions if node.name == function]
    calls = [node for node in ast.walk(made) if isinstance(node, ast.Call) and ast.unparse(node.func) in takers]
    assert all("request.device" in ast.unparse(call) for call in calls)
    assert calls or not takers or function != "make_text"


def test_parts():
    (member,) = parse("clip:some/path+with+plus?longest=64&templates=room,the {}+sam:x?points=4&levels=s,m")
    assert (member.source.kind.name, member.source.argument) == ("clip", "some/path+with+plus")
    assert member.source.options == {"longest": 64, "templates": ("room", "the {}")}
    assert (member.masks.kind.name, member.masks.argument) == ("sam", "x")
    assert member.masks.options == {"points": 4, "levels": ("s", "m")}
    assert (member.text, member.weight) == (None, 1.0)


def test_members():
    first, second, third = parse("conse@2++clip:a+graph@0.5++gdino:b?classes=x+sam:c+text:clip:d")
    assert [member.source.kind.name for member in (first, second, third)] == ["conse", "clip", "gdino"]
    assert [member.weight for member in (first, second, third)] == [2.0, 0.5, 1.0]
    assert second.masks.kind.name == "graph"
    assert third.text == "clip:d"


@pytest.mark.parametrize("kind", KINDS.values(), ids=lambda kind: kind.name)
def test_every_example_is_a_name(kind):
    (member,) = parse(kind.example)
    assert kind.name in {member.source.kind.name, member.masks.kind.name if member.masks else ""}


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("klip:x", r"encoder 'klip:x' does not exist; there are conse, clip, .* \(see: sgwarp encoders\)"),
        ("clip", "write clip:PATH"),
        ("clip:x?size=3", "clip has no option 'size'; its options are: templates, longest, rule"),
        ("clip:x?longest=far", "option longest: expected a number, got 'far'"),
        ("clip:x?longest=", "option longest has no value"),
        ("conse+graph?background=maybe", "option background: expected yes or no, got 'maybe'"),
        ("graph", "graph gives masks only"),
        ("graph:x", "graph takes nothing after a colon"),
        ("conse+clip:x", r"'clip:x' does not go with 'conse'; put \+\+ between two encoders"),
        ("conse+graph+slic", "'slic' does not go with 'conse'"),
        ("files:x+graph", "'graph' does not go with 'files:x'"),
        ("conse+text:conse+graph", r"\+text:NAME goes last"),
        ("vlpart:x+text:", r"\+text:NAME goes last"),
        ("conse@0", "the weight after @ is a positive number, got '0'"),
    ],
)
def test_names_that_do_not_fit(name, message):
    with pytest.raises(InputError, match=message):
        parse(name)


def test_a_folder_that_is_not_there_is_no_name_on_the_hub(tmp_path):
    with pytest.raises(InputError, match="nowhere: no such folder"):
        make_encoder(f"clip:{tmp_path / 'nowhere'}")


def test_rules_follow_from_the_parts(joint_models, sam_models, tmp_path):
    clip, sam = f"clip:{joint_models['clip']}", f"sam:{sam_models['sam']}"
    plain = make_encoder(f"{clip}?longest=64")
    assert isinstance(plain, PlainPixels)
    assert plain.encoder.longest == 64
    masked = make_encoder(f"{clip}+{sam}?points=2&levels=s,l&background=no")
    assert isinstance(masked, MaskedImages)
    assert isinstance(masked.encoder, Crops)
    assert isinstance(masked.encoder.encoder, JointEncoder)
    assert isinstance(masked.generator, Sam)
    assert (masked.levels, masked.encoder.background) == (("s", "l"), False)
    assert (masked.generator.settings.points, masked.generator.settings.by_rank) == (2, True)
    refined = make_encoder(f"{clip}?rule=pixels+graph?rest=own&scales=50,100")
    assert isinstance(refined, RefinedPixels)
    assert refined.rest == "own"
    assert refined.generator == Proposals("graph", (50.0, 100.0))
    (tmp_path / "m").mkdir()
    assert isinstance(make_encoder(f"{clip}+masks:{tmp_path / 'm'}").generator, FileMasks)
    painted = make_encoder(f"vlpart:{tmp_path / 'm'}?least_score=0.3+{sam}+text:{clip}")
    assert isinstance(painted, PaintedInstances)
    assert isinstance(painted.detector, VLPartFiles)
    assert painted.space == plain.space
    with pytest.raises(InputError, match="rule is images or pixels, not 'words'"):
        make_encoder(f"{clip}?rule=words")


def test_clip_and_sam_end_to_end(joint_models, sam_models, view, image):
    """Whatever random networks see: a map in CLIP's space that its phrases can be compared with."""
    name = f"clip:{joint_models['clip']}+sam:{sam_models['sam']}?points=3&least_score=-9&least_stability=0"
    source = make_encoder(name)
    source.generator.settings = type(source.generator.settings)(
        points=3, least_score=-9.0, least_stability=0.0, offset=0.0
    )
    found = source.encode(view, image)
    assert found.space == source.space == text_encoder_for(source.space, name).space
    assert found.vectors.shape[1] == source.encode_text(["couch"]).shape[1] == 24


def test_ensembles_and_caches(joint_models, tmp_path, view, image):
    name = f"clip:{joint_models['clip']}@3++siglip:{joint_models['siglip']}@1"
    source = make_encoder(name, cache=tmp_path / "maps", cache_limit=1.0)
    assert isinstance(source, CachedMaps)
    assert isinstance(source.source, Ensemble)
    assert source.source.weights == (0.75, 0.25)
    found = source.encode(view, image)
    assert found.channels == 24 + 32
    texts = text_encoder_for(source.space, name)
    assert texts.space == source.space
    torch.testing.assert_close(texts.encode_text(["couch"]), source.encode_text(["couch"]))


def test_files_are_not_cached(tmp_path, view):
    cv2.imwrite(str(tmp_path / "a.png"), np.full((48, 64), 3, np.uint8))
    source = make_encoder(f"files:{tmp_path}", [view], cache=tmp_path / "maps")
    assert not isinstance(source, CachedMaps)
    assert not (tmp_path / "maps").exists()


def test_text_sides(joint_models, tmp_path):
    clip, siglip = (f"{kind}:{joint_models[kind]}" for kind in ("clip", "siglip"))
    encoder = make_text_encoder(clip)
    assert text_encoder_for(encoder.space, clip).space == encoder.space
    with pytest.raises(InputError, match=f"space '{encoder.space}' cannot be mixed with space 'siglip-32-"):
        text_encoder_for(encoder.space, siglip)
    with pytest.raises(InputError, match=r"vlpart has no text side of its own; add one, such as \+text:conse"):
        make_encoder(f"vlpart:{tmp_path}")
    plain = make_text_encoder(clip, templates=["plain"]).encode_text(["couch"])
    assert not torch.allclose(plain, encoder.encode_text(["couch"]))
    torch.testing.assert_close(plain, make_text_encoder(f"{clip}?templates={{}}").encode_text(["couch"]))


def test_questions_go_to_the_sources_own_text_side_or_to_that_of_its_space(joint_models, tmp_path):
    clip = f"clip:{joint_models['clip']}?templates=plain"
    own = encoder_of_questions(clip, "whatever it gives")
    torch.testing.assert_close(own.encode_text(["couch"]), make_text_encoder(clip).encode_text(["couch"]))
    assert encoder_of_questions(f"files:{tmp_path}", LABEL_SPACE) is None
    with pytest.raises(InputError, match="no text encoder for space 'mine' is known"):
        encoder_of_questions(f"files:{tmp_path}", "mine")


def test_features_per_gaussian_are_no_source_of_maps():
    with pytest.raises(InputError, match=r"holds features per Gaussian, not per view; read it with sg\.load_openscene"):
        make_encoder("openscene:x.pt")


def test_what_is_installed(monkeypatch):
    monkeypatch.setattr(
        catalogue, "find_spec", lambda name: None if name == "tensorflow" else importlib.util.find_spec("os")
    )
    assert KINDS["openseg"].missing == ["tensorflow"]
    assert KINDS["lseg"].missing == []
    assert KINDS["graph"].missing == []


@pytest.mark.parametrize("kind", KINDS.values(), ids=lambda kind: kind.name)
def test_a_row_carries_its_builder(kind):
    """In the folder of its role; nothing else has to know an encoder."""
    made = "make_masks" if kind.role == "masks" else "make_source"
    assert kind.make.startswith(f"sgwarp.encoders.{kind.role}.")
    assert kind.make.endswith(f":{made}")
    assert callable(builder(kind.make))
    if kind.speak:
        assert callable(builder(kind.speak))


@pytest.fixture
def made(monkeypatch):
    """`made(place, name)` builds the encoder of a name with the class at `place` replaced; how that was called."""

    def build(place: str, name: str) -> SimpleNamespace:
        calls = []

        class Fake:
            space, identity = "toy", "fake"

            def __init__(self, *arguments, **options):
                calls.append((arguments, options))

            def encode_text(self, texts):
                raise AssertionError("not asked")

        monkeypatch.setattr(f"sgwarp.encoders.{place}", Fake)
        source = make_encoder(name)
        return SimpleNamespace(source=source, arguments=calls[0][0], **calls[0][1])

    return build


@pytest.mark.parametrize("given", ["", "?background=yes", "?background=no"])
def test_what_surrounds_a_mask_stays_visible_unless_told_otherwise(made, given):
    source = made("images.clip.JointEncoder", f"clip:P+graph{given}").source
    assert source.encoder.background == (given != "?background=no")
    assert source.levels == ("default",)


def test_without_masks_a_network_of_pixels_stands_alone(made):
    assert isinstance(made("images.clip.JointEncoder", "clip:P?rule=pixels").source, PlainPixels)
    refined = made("images.clip.JointEncoder", "clip:P?rule=pixels+slic").source
    assert (type(refined), refined.generator.method, refined.rest) == (RefinedPixels, "slic", "cells")


def test_options_reach_the_networks(made):
    assert made("images.clip.JointEncoder", "clip:P?longest=448").longest == 448
    assert not hasattr(made("images.clip.JointEncoder", "clip:P"), "longest")
    call = made("pixels.lseg.LSeg", "lseg:P?longest=300&tokenizer=T")
    assert (call.longest, call.tokenizer) == (300, "T")
    for given, pooled in (("", True), ("?pooled=yes", True), ("?pooled=no", False)):
        call = made("pixels.openseg.OpenSeg", f"openseg:P{given}+text:conse")
        assert (call.arguments[0], call.arguments[1].space, call.arguments[2]) == ("P", KINDS["conse"].space, pooled)
    call = made("pixels.clipseg.ClipSeg", "clipseg:P?classes=a,b")
    assert call.arguments == ("P", ("a", "b"))
    call = made("maps.closed_set.ClosedSet", "mask2former:P?least=0.7&longest=320")
    assert (call.arguments, call.least, call.longest) == (("P",), 0.7, 320)


@pytest.mark.parametrize(
    ("name", "place", "least"), [("owlv2", "owlv2.Owlv2", 0.1), ("gdino", "grounding_dino.GroundingDino", 0.25)]
)
def test_detectors_have_their_scores_and_masks(made, name, place, least):
    def settings(call) -> DetectorSettings:
        return call.settings if hasattr(call, "settings") else call.arguments[2]

    plain = made(f"instances.{place}", f"{name}:P?classes=a,b+text:conse")
    assert plain.arguments[:2] == ("P", ("a", "b"))
    assert settings(plain) == DetectorSettings(least, 0.7)
    assert plain.source.generator is None
    changed = made(f"instances.{place}", f"{name}:P?classes=a&least_score=0.4&overlap=0.5+graph+text:conse")
    assert settings(changed) == DetectorSettings(0.4, 0.5)
    assert changed.source.generator.method == "graph"
