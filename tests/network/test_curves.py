"""The curves that a training leaves: their figures as JSON, and what the picture shows of them."""

import builtins
import json

import cv2
import pytest

from sgwarp.network.training.curves import write_curves
from sgwarp.network.training.settings import Epoch


def history(count: int) -> list[Epoch]:
    return [Epoch(k, 0.1 / k, 1.0 / k, 2.5, cosine=k / (k + 1) if k > 1 else None) for k in range(1, count + 1)]


@pytest.fixture
def drawn(monkeypatch):
    """The figures that are saved, as matplotlib has them."""
    figures = []
    figure = pytest.importorskip("matplotlib.figure").Figure
    savefig = figure.savefig

    def noted(self, *arguments, **options):
        figures.append(self)
        return savefig(self, *arguments, **options)

    monkeypatch.setattr(figure, "savefig", noted)
    return figures


@pytest.mark.parametrize(("count", "marker"), [(3, "."), (29, "."), (30, "."), (31, ""), (60, "")])
def test_figures_and_picture_of_a_training(drawn, tmp_path, count, marker):
    epochs = history(count)
    files = write_curves(epochs, tmp_path / "net.v1")
    assert files == [tmp_path / "net.v1_curves.json", tmp_path / "net.v1_curves.png"]
    text = files[0].read_text()
    rows = json.loads(text)
    assert text.endswith("]\n")
    assert [(row["epoch"], row["loss"], row["cosine"], row["miou"]) for row in rows] == [
        (k, 1.0 / k, k / (k + 1) if k > 1 else None, None) for k in range(1, count + 1)
    ]
    (figure,) = drawn
    (axes,) = figure.axes
    loss, cosine = axes.lines
    assert (loss.get_label(), cosine.get_label()) == ("training loss", "validation cosine")
    assert [tuple(point) for point in loss.get_xydata()] == [(k, 1.0 / k) for k in range(1, count + 1)]
    assert [tuple(point) for point in cosine.get_xydata()] == [(k, k / (k + 1)) for k in range(2, count + 1)]
    assert loss.get_color() != cosine.get_color()
    # Points are marked as long as they stand apart: fewer than thirty of them.
    assert cosine.get_marker() in ((".",) if count - 1 < 30 else ("", "None"))
    assert (cosine.get_marker() == ".") == (marker == ".")
    assert axes.get_xlabel() == "epoch"
    assert axes.get_ylim()[0] == 0
    assert [text.get_text() for text in axes.get_legend().get_texts()] == ["training loss", "validation cosine"]
    assert axes.xaxis.get_gridlines()[0].get_alpha() == pytest.approx(0.3)
    height, width = cv2.imread(str(files[1])).shape[:2]
    assert (width, height) == (768, 432)


def test_a_history_without_figures_has_an_empty_picture(drawn, tmp_path):
    files = write_curves([Epoch(1, 0.1, None, 1.0)], tmp_path / "net")
    assert len(files) == 2
    (axes,) = drawn[0].axes
    assert not axes.lines
    assert axes.get_legend() is None


def test_without_matplotlib_the_figures_are_written_alone(tmp_path, monkeypatch):
    load = builtins.__import__

    def without(name, *rest):
        if name.startswith("matplotlib"):
            raise ImportError(name)
        return load(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without)
    assert write_curves(history(2), tmp_path / "net") == [tmp_path / "net_curves.json"]
    assert [path.name for path in tmp_path.iterdir()] == ["net_curves.json"]
