"""Every notebook runs from top to bottom without a warning, and what it finds on the way is right."""

import json
import runpy
from pathlib import Path

import jupytext
import matplotlib
import nbformat
import pytest
import warp as wp

from sgwarp.files.images import read_ids
from sgwarp.ops import launcher  # noqa: F401 - starts Warp quietly

pytestmark = pytest.mark.slow

FOLDER = Path(__file__).resolve().parents[1] / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.py"))


def test_there_are_notebooks():
    assert {"01_kernels", "02_swap_in"} <= {path.stem for path in NOTEBOOKS}


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_it_is_a_valid_notebook(path):
    notebook = jupytext.read(path, fmt="py:percent")
    nbformat.validate(notebook)
    first, *others = notebook.cells
    assert first.cell_type == "markdown"
    assert first.source.startswith("# ")
    assert len(first.source) > 200, "a notebook opens with what the reader learns"
    assert any(cell.cell_type == "code" for cell in others)


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch):
    """Run a notebook as a script: its variables, and how many figures it showed."""
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    shown = []

    def draw_and_close() -> None:
        figures = [plt.figure(number) for number in plt.get_fignums()]
        for figure in figures:
            figure.set_dpi(40)
            figure.canvas.draw()
        shown.extend(figures)
        plt.close("all")

    monkeypatch.setattr(plt, "show", draw_and_close)
    device = wp.get_device()
    with matplotlib.rc_context():
        yield lambda name: (runpy.run_path(str(FOLDER / name)), len(shown))
    assert not plt.get_fignums(), "a figure was never shown"
    wp.set_device(device)


def test_kernels(run, capsys):
    found, figures = run("01_kernels.py")
    assert figures == 11
    assert "largest difference to sg.render" in capsys.readouterr().out
    assert not wp.config.enable_cpu_blocks

    assert found["culled"]["non_finite"] == 40
    assert all(found["culled"].values()), "every reason to leave a Gaussian out occurs"
    assert sum(found["culled"].values()) == found["N"]
    assert len(found["touched"]) < found["in_box"][found["one"]]

    assert found["difference_to_render"] < 1e-5
    assert found["ray_error"] < 1e-5
    assert found["lane_block_difference"] < 1e-5
    assert found["difference_to_lift"] < 1e-5
    assert found["transpose_gap"] < 1e-6

    any_weight, enough_weight = found["label_accuracies"]
    assert any_weight < 0.9 < 0.97 < enough_weight
    one_view, many_views = found["class_accuracies"]
    assert one_view < 0.85 < 0.95 < many_views
    weighted, over_a_tenth, centre = (found["coverage"][name] for name in found["coverage"])
    assert weighted[-1] > over_a_tenth[-1] > centre[-1] > 0.8
    for shares in found["coverage"].values():
        assert shares == sorted(shares)


def test_swap_in(run):
    found, figures = run("02_swap_in.py")
    assert figures == 5
    calls = {"gsplat's call", "Inria's call"}
    assert found["image_differences"].keys() == found["losses"].keys() == calls
    assert max(found["image_differences"].values()) < 5e-6
    for differences in found["gradient_differences"].values():
        assert differences.keys() == found["RATES"].keys()
        assert max(differences.values()) < 2e-5
    assert found["proxy_difference"] < 1e-6
    assert found["seen"].sum() > 1000
    assert found["same_bits"]
    assert found["apart"][:40].max() < 1e-3
    for name in calls:
        losses = found["losses"][name]
        assert losses[-12:].mean() < 0.2 * losses[:12].mean()
        assert found["quality"][name] > 21


def test_fit_and_ask(run, capsys):
    found, figures = run("03_fit_and_ask.py")
    assert figures == 4
    assert "of the Gaussians were seen" in capsys.readouterr().out

    curve = [point.psnr for point in found["fitted"].curve]
    assert curve[-1] > 22
    assert curve[-1] > curve[0] + 3
    small, middle, large = (found["quality"][cap].psnr for cap in found["caps"])
    assert small < middle < large
    assert found["semantics"].coverage > 0.95
    truth = read_ids(found["ROOM"] / "held_out" / "labels" / f"{found['view'].stem}.png")
    names = json.loads((found["ROOM"] / "classes.json").read_text())
    assert {word: names[str(truth[y, x])] for word, (x, y) in found["hits"].items()} == {
        word: word for word in ("couch", "plant", "lamp")
    }


def test_track(run, capsys):
    found, figures = run("06_track.py")
    assert figures == 5
    assert "median trajectory error" in capsys.readouterr().out
    alone, fused = (sum(found[name]) / found["FRAMES"] for name in ("alone", "fused"))
    assert fused > alone + 0.05
    assert found["figures"].median_error < 0.01
    last = found["answers_fused"][-1].objects
    pixels = {one["name"]: sum(one["pixels"].values()) for one in last}
    assert pixels[found["on"]] > 10 * pixels[found["off"]]


def test_instances(run, capsys):
    found, figures = run("04_instances.py")
    assert figures == 3
    assert "mean IoU over" in capsys.readouterr().out
    assert found["mean_iou"] > 0.75
    assert len(found["found"].table) >= 11


def test_edit(run, capsys):
    found, figures = run("05_edit.py")
    assert figures == 3
    assert "same bits as before: True" in capsys.readouterr().out
    alone, together = found["figures"]["semantics alone"], found["figures"]["with instances"]
    assert together.completeness > 0.85
    assert together.leakage < 0.1 < alone.leakage + 1.0 - alone.completeness
