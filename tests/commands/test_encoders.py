"""Encoders from the command line: what there is, and a second lift that encodes nothing."""

import json

import pytest
import torch

from sgwarp.cli import main
from sgwarp.encoders.catalogue import KINDS
from sgwarp.io.store import load_semantics
from sgwarp.scene import FeatureMap


class Toy:
    """Sees colours; counts how often it is asked."""

    space, needs_image, asked = "toy-3", True, 0

    def cache_key(self, view):
        return "toy"

    def encode(self, view, image):
        Toy.asked += 1
        return FeatureMap(self.space, dense=image)

    def encode_text(self, texts):
        return torch.eye(3)[: len(texts)]


@pytest.fixture
def toy(monkeypatch):
    monkeypatch.setattr("sgwarp.encoders.registry._make_member", lambda *rest: Toy())
    monkeypatch.setattr(Toy, "asked", 0)
    return Toy


def run(*arguments) -> int:
    return main([str(argument) for argument in arguments])


def test_every_source_is_listed(capsys):
    assert run("encoders") == 0
    text = capsys.readouterr().out
    for kind in KINDS.values():
        assert f"  {kind.name:12} {kind.about} (" in text
        assert f"--encoder '{kind.example}'" in text
    for role in ("image level: sees one region", "pixel level: features for every pixel", "instance level: finds"):
        assert text.count(role) == 1
    assert run("encoders", "--json") == 0
    facts = {row["name"]: row for row in json.loads(capsys.readouterr().out)}
    assert facts.keys() == set(KINDS)
    assert facts["conse"]["install"] == 'pip install "sgwarp[conse]"'
    assert facts["files"]["installed"]
    assert facts["sam"]["options"][0] == "points"


def test_missing_extras_are_named(capsys, monkeypatch):
    monkeypatch.setattr("sgwarp.encoders.catalogue.find_spec", lambda name: None)
    assert run("encoders") == 0
    text = capsys.readouterr().out
    assert 'LSeg, the paper\'s encoder for segmentation (needs: pip install "sgwarp[models]")' in text
    assert "DEVA's ids of a whole video (installed)" in text


def test_a_second_lift_encodes_nothing(stage, stage_files, toy, tmp_path):
    options = ["lift", stage_files.scene, "--views", stage_files.views, "--cache", tmp_path / "maps"]
    found = []
    for name in ("first", "second"):
        out = tmp_path / name / "s.safetensors"
        assert run(*options, "--out", out) == 0
        log = json.loads((out.parent / "run.json").read_text())
        found.append((load_semantics(out).features, log["left_out"].get("views_encoded_before", 0)))
    assert toy.asked == len(stage.views)
    assert [count for _, count in found] == [0, len(stage.views)]
    assert torch.equal(found[0][0], found[1][0])


def test_no_cache(stage, stage_files, toy, tmp_path):
    options = ["lift", stage_files.scene, "--views", stage_files.views, "--cache", "none"]
    for name in ("first", "second"):
        assert run(*options, "--out", tmp_path / name / "s.safetensors") == 0
    assert toy.asked == 2 * len(stage.views)


def test_bad_caches(stage_files, toy, tmp_path, capsys):
    (tmp_path / "file").touch()
    options = ["lift", stage_files.scene, "--views", stage_files.views, "--out", tmp_path / "s.safetensors"]
    assert run(*options, "--cache", tmp_path / "file") == 2
    assert "cannot be made" in capsys.readouterr().err
    assert run(*options, "--cache-limit", 0) == 2
    assert "limit above 0" in capsys.readouterr().err


def test_phrases_by_another_encoder(stage_files, toy, tmp_path, capsys, monkeypatch):
    """The encoder that a file was lifted with answers, unless another is named; spaces that differ are both named."""
    asked = []

    def speak(name, device, templates):
        asked.append((name, templates))
        return Toy()

    monkeypatch.setattr("sgwarp.encoders.registry.make_text_encoder", speak)
    out = tmp_path / "s.safetensors"
    assert (
        run("lift", stage_files.scene, "--views", stage_files.views, "--out", out, "--encoder", "clip:somewhere") == 0
    )
    query = ["query", stage_files.scene, "--semantics", out, "--views", stage_files.views, "--view", "0002"]
    query += ["--text", "red", "--out", tmp_path / "red.png"]
    assert run(*query) == 0
    assert run(*query, "--encoder", "clip:elsewhere", "--templates", "room") == 0
    assert run(*query, "--score", "relevancy", "--canonical", "green") == 0
    assert asked == [("clip:somewhere", None), ("clip:elsewhere", ("room",)), ("clip:somewhere", None)]
    monkeypatch.setattr(Toy, "space", "other-3")
    capsys.readouterr()
    assert run(*query) == 2
    assert "space 'toy-3' cannot be mixed with space 'other-3'" in capsys.readouterr().err


def test_features_per_gaussian(stage, stage_files, tmp_path):
    mask = torch.arange(len(stage_files.gaussians)) % 2 == 0
    torch.save({"feat": torch.ones(int(mask.sum()), 3).half(), "mask_full": mask}, tmp_path / "stage_0.pt")
    out = tmp_path / "s.safetensors"
    name = f"openscene:{tmp_path / 'stage_0.pt'}?space=toy-3"
    assert run("lift", stage_files.scene, "--views", stage_files.views, "--out", out, "--encoder", name) == 0
    found = load_semantics(out, stage_files.gaussians)
    assert (found.space, found.coverage) == ("toy-3", pytest.approx(0.5, abs=0.01))
