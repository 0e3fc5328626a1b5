"""An encoder is added in one place: its row. Commands, lists, cache and scoring follow from it."""

import json
import re
import sys
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import cv2
import numpy as np
import pytest

import sgwarp
from sgwarp.cli import main
from sgwarp.encoders.calibration import PAPER, Calibration, calibration_of_space
from sgwarp.encoders.catalogue import KINDS, Kind
from sgwarp.encoders.images.conse.class_space import SPACE
from sgwarp.encoders.names import parse
from sgwarp.encoders.registry import image_tower_for, make_mask_source, text_encoder_for
from sgwarp.errors import InputError
from sgwarp.io.store import load_semantics, save_semantics

# As somebody would write it: colors as features, and the words for them.
TINT = """
import torch
from torch.nn.functional import normalize

from sgwarp.encoders.building import some, source_of_pixels

COLORS = {"red": (0.7, 0.2, 0.1), "yellow": (0.9, 0.9, 0.1), "blue": (0.1, 0.3, 0.8), "white": (0.8, 0.8, 0.7)}
asked = []


class Tint:
    space = "tint-3"

    def __init__(self, device="cpu", sharp=1):
        self.sharp, self.device = sharp, device
        self.identity = f"tint, {sharp}"

    def encode_pixels(self, image):
        asked.append(self.sharp)
        return normalize(image**self.sharp - 0.5, dim=2)

    def encode_text(self, texts):
        return normalize(torch.tensor([COLORS.get(text, (1, 1, 1)) for text in texts]) - 0.5, dim=1)


class Tower(Tint):
    pass


def make_source(member, request):
    return source_of_pixels(Tint(request.device, **some(member.source, "sharp")), member.masks, request)


def make_text(part, request):
    return Tint(request.device)


def make_masks(part, request):
    return object()


def known(texts):
    return torch.tensor([text in COLORS for text in texts])
"""
ROW = Kind(
    "tint",
    "pixels",
    "colors as features",
    "",
    "tint?sharp=2+graph",
    options={"sharp": "int"},
    make="tint_of_a_test:make_source",
    speak="tint_of_a_test:make_text",
    space="tint-3",
    see="tint_of_a_test:Tower",
    calibration=Calibration("evidence", 0.3, counterparts="tint_of_a_test:known"),
)


@pytest.fixture
def tint(tmp_path, monkeypatch):
    """The row, in the table for the length of a test, and the module that it names."""
    (tmp_path / "tint_of_a_test.py").write_text(TINT)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "tint_of_a_test", raising=False)
    monkeypatch.setitem(KINDS, ROW.name, ROW)
    monkeypatch.setattr("sgwarp.encoders.registry._kept", None)
    return import_module("tint_of_a_test")


@pytest.fixture
def lifted(tint, stage_files, tmp_path):
    """`lifted(name, *options)` lifts by command; the file, and how many views came from the cache."""

    def lift(name: str, *options: str) -> tuple[Path, int]:
        out = tmp_path / f"s{len(list(tmp_path.glob('s*')))}" / "s.safetensors"
        words = ["lift", stage_files.scene, "--views", stage_files.views, "--encoder", name, "--out", out]
        assert main([*map(str, words), "--cache", str(tmp_path / "maps"), *options]) == 0
        left_out = json.loads((out.parent / "run.json").read_text())["left_out"]
        return out, left_out.get("views_encoded_before", 0)

    return lift


def ask(command: str, stage_files, semantics: Path, *options: str) -> int:
    words = [command, stage_files.scene, "--semantics", semantics, "--views", stage_files.views, *options]
    return main([str(word) for word in words])


def overlap(found: np.ndarray, wanted: np.ndarray) -> float:
    return float((found & wanted).sum() / (found | wanted).sum())


def test_it_is_listed_and_its_name_is_understood(tint, capsys):
    assert main(["encoders"]) == 0
    assert "  tint         colors as features (installed)\n" in capsys.readouterr().out
    assert main(["encoders", "--json"]) == 0
    (row,) = (row for row in json.loads(capsys.readouterr().out) if row["name"] == "tint")
    assert (row["role"], row["example"], row["options"]) == ("pixels", "tint?sharp=2+graph", ["sharp"])
    first, second = parse("clip:some/tint+x@1++tint?sharp=2+graph@3")
    assert (first.source.argument, first.weight) == ("some/tint+x", 1.0)
    assert (second.source.kind, second.source.options, second.masks.kind.name) == (ROW, {"sharp": 2}, "graph")
    with pytest.raises(InputError, match="'tint' does not go with 'clip:x'"):
        parse("clip:x+tint")
    with pytest.raises(InputError, match=r"there are conse, .*, tint "):
        parse("klip:x")
    with pytest.raises(InputError, match="tint has no option 'size'; its options are: sharp"):
        parse("tint?size=3")


def test_it_is_unknown_without_its_row():
    with pytest.raises(InputError, match="encoder 'tint' does not exist"):
        parse("tint")


def test_lift_and_query_and_segment(stage, stage_files, lifted, tmp_path, capsys):
    semantics, _ = lifted("tint")
    view, out = stage.views[2], tmp_path / "blue.png"
    assert ask("query", stage_files, semantics, "--text", "blue", "--view", view.stem, "--out", str(out)) == 0
    truth = stage.labels(view).numpy()
    assert overlap(cv2.imread(str(out), cv2.IMREAD_UNCHANGED) > 0, truth == 4) > 0.7
    capsys.readouterr()
    classes = "red,yellow,blue,piano"
    options = ["--classes", classes, "--view", view.stem, "--out", str(tmp_path / "maps_of")]
    assert ask("segment", stage_files, semantics, *options) == 0
    assert "the encoder knows nothing like piano" in capsys.readouterr().out  # the row's counterparts
    labels = cv2.imread(str(tmp_path / "maps_of" / f"{view.stem}.png"), cv2.IMREAD_UNCHANGED)
    assert [overlap(labels == k, truth == k + 2) > 0.7 for k in range(3)] == [True] * 3
    assert (labels[truth == 1] == 255).mean() > 0.9  # the wall has no class: evidence leaves it out


def test_its_scoring_is_that_of_the_row(tint, monkeypatch, stage, stage_files, lifted, tmp_path):
    assert calibration_of_space("tint-3") is ROW.calibration
    assert calibration_of_space("tint-3@0.8 ++ clip-512-0123@0.2") is ROW.calibration
    semantics, _ = lifted("tint")
    wall = stage.labels(stage.views[2]).numpy() == 1
    for scoring, unknown in ((ROW.calibration, True), (Calibration("cosine", 0.1), False)):
        monkeypatch.setitem(KINDS, "tint", replace(ROW, calibration=scoring))
        folder = tmp_path / scoring.scoring
        assert ask("segment", stage_files, semantics, "--classes", "red,blue", "--out", str(folder)) == 0
        labels = cv2.imread(str(folder / "0002.png"), cv2.IMREAD_UNCHANGED)
        assert ((labels[wall] == 255).mean() > 0.9) == unknown
    monkeypatch.setitem(KINDS, "tint", replace(ROW, calibration=None))
    assert calibration_of_space("tint-3") is PAPER


def test_the_cache_follows_what_it_depends_on(stage, tint, lifted):
    count = len(stage.views)
    assert [lifted(name)[1] for name in ("tint", "tint", "tint?sharp=2", "tint?sharp=2")] == [0, count, 0, count]
    assert tint.asked == [1] * count + [2] * count
    assert lifted("tint+graph?scales=100")[1] == 0


def test_a_space_that_is_always_the_same_needs_no_name(tint, stage, stage_files, lifted, tmp_path):
    semantics, _ = lifted("tint")
    nameless = tmp_path / "nameless.safetensors"
    save_semantics(load_semantics(semantics), nameless)
    out = ["--text", "red", "--view", "0002", "--out", str(tmp_path / "red.png")]
    assert ask("query", stage_files, nameless, *out) == 0
    assert isinstance(text_encoder_for("tint-3", device="cuda"), tint.Tint)
    tower = image_tower_for("tint-3", "cuda")()
    assert isinstance(tower, tint.Tower)
    assert tower.device == "cuda"
    assert image_tower_for("tint-4") is None
    assert KINDS["conse"].space == SPACE


def test_masks_of_a_new_row(tint, stage, monkeypatch, tmp_path):
    """A generator that reads files says so itself; any other is given the photograph."""
    monkeypatch.setitem(KINDS, "read", replace(KINDS["masks"], name="read"))
    monkeypatch.setitem(KINDS, "cut", Kind("cut", "masks", "toy", "", "tint+cut", make="tint_of_a_test:make_masks"))
    assert not make_mask_source(f"read:{tmp_path}", stage.views).needs_image
    assert make_mask_source("cut", stage.views).needs_image
    with pytest.raises(InputError, match=r"take one of .*, read, cut "):
        make_mask_source("tint")


def test_only_files_of_encoders_know_one_by_name():
    """What is particular to one stands in its row, or in its own file."""
    sources = Path(sgwarp.__file__).parent
    shared = [*sources.glob("encoders/*.py"), *sources.glob("commands/*.py"), *sources.glob("querying/*.py")]
    assert len(shared) > 30
    asks = re.compile(r"kind\.name (==|!=|in) ")
    assert not [path.name for path in shared if asks.search(path.read_text(encoding="utf-8"))]
