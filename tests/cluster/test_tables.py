"""What a batch writes about its scenes: the CSV file, the picture, the line while it works."""

import csv
import json
import sys
import time

import pytest

from sgwarp.cluster import plot
from sgwarp.cluster.summary import Tally, write_table
from sgwarp.cluster.tasks import Limits, Outcome, Stage, Task

OUTCOMES = [
    Outcome(
        "b", "done", "", {"fit": 3.0, "lift": 0.5}, 700, {"lift": {"coverage": 0.9}}, {"gaussians": 10, "views": 4}
    ),
    Outcome("c", "failed", "no photograph, none"),
    Outcome("a", "skipped", "", {"fit": 2.0}, 500, {"fit": {"psnr": 30.5}}, {"gaussians": 20}),
]


def test_a_table_has_a_line_for_every_scene(tmp_path):
    write_table(OUTCOMES, tmp_path / "t.csv")
    with (tmp_path / "t.csv").open(newline="") as file:
        rows = list(csv.reader(file))
    assert rows == [
        [
            *("scene", "status", "fit [s]", "lift [s]", "fit psnr", "lift coverage", "gaussians", "views"),
            *("peak memory [bytes]", "error"),
        ],
        ["a", "skipped", "2.0", "", "30.5", "", "20", "", "500", ""],
        ["b", "done", "3.0", "0.5", "", "0.9", "10", "4", "700", ""],
        ["c", "failed", "", "", "", "", "", "", "", "no photograph, none"],
    ]


def test_a_line_counts_what_was_done_since_the_beginning(monkeypatch):
    """Of 12 scenes one was known before; two in 40 s are 180 an hour, and the other nine take 3 minutes."""
    monkeypatch.setattr(time, "monotonic", lambda: 140.0)
    tally = Tally(list(OUTCOMES), began=100.0)
    assert [tally.count(status) for status in ("done", "failed", "skipped", "held")] == [1, 1, 1, 0]
    assert tally.line(12, 1) == "1 failed, 180 scenes/h, 0:03:00 left"
    assert tally.line(12, 3) == "1 failed"


class Axes:
    def __init__(self):
        self.points, self.said, self.labels, self.limits = {}, [], {}, {}
        self.transAxes = None

    def scatter(self, x, y, label, **style):
        self.points[label] = list(zip(x, y, strict=True))

    def text(self, x, y, text, **style):
        self.said.append(text)

    def set_title(self, text, **style):
        self.said.append(text)

    def set_xlim(self, low, high):
        self.limits["x"] = (low, high)

    def set_ylim(self, bottom):
        self.limits["y"] = bottom

    def __getattr__(self, name):
        return lambda *given, **style: self.labels.update({name: given[0] if given else None})


def test_seconds_are_drawn_over_the_size():
    axes = Axes()
    plot._draw_seconds(axes, OUTCOMES, "gaussians")
    assert axes.points == {"fit": [(10, 3.0), (20, 2.0)], "lift": [(10, 0.5)]}
    assert (axes.labels["set_xlabel"], axes.labels["set_ylabel"]) == ("Gaussians", "seconds")
    assert axes.limits == {"x": (0, pytest.approx(21.0)), "y": 0}
    assert not axes.said
    axes = Axes()
    plot._draw_seconds(axes, OUTCOMES, "views")
    assert axes.points == {"fit": [(4, 3.0)], "lift": [(4, 0.5)]}
    axes = Axes()
    plot._draw_seconds(axes, OUTCOMES[1:2], "views")
    assert (axes.points, axes.said) == ({}, ["no scene was measured"])


def test_reasons_are_counted_the_most_frequent_first(monkeypatch):
    monkeypatch.setattr(plot, "REASONS", 2)
    failed = [Outcome(f"s{k}", "failed", f"s{k}/x.ply: is empty") for k in (4, 1, 2, 3)]
    failed += [Outcome(f"t{k}", "failed", "costs $5") for k in (1, 2)] + [Outcome("u", "failed", "else")]
    axes = Axes()
    plot._write_reasons(axes, [*failed, OUTCOMES[0]])
    title, text = axes.said
    assert title == "7 of 8 scenes failed"
    assert text.splitlines() == [
        *("4: s1, s2, s3 and 1 more", "    SCENE/x.ply: is empty", "2: t1, t2", r"    costs \$5"),
        "and 1 other errors, see summary.csv",
    ]


@pytest.mark.parametrize("failed", [False, True])
def test_the_picture_has_a_panel_for_what_failed(monkeypatch, tmp_path, failed):
    figure = pytest.importorskip("matplotlib.figure")
    panels = []
    monkeypatch.setattr(plot, "_draw_seconds", lambda axes, outcomes, what: panels.append(what))
    monkeypatch.setattr(plot, "_write_reasons", lambda axes, outcomes: panels.append("reasons"))
    saved = []
    monkeypatch.setattr(
        figure.Figure, "savefig", lambda self, path, **given: saved.append(given["format"]) or path.touch()
    )
    path = tmp_path / "p.png"
    assert plot.write_plot(OUTCOMES if failed else OUTCOMES[:1], path) == [path]
    assert panels == ["gaussians", "views"] + ["reasons"] * failed
    assert path.is_file()
    assert saved == ["png"]
    assert plot.write_plot([], tmp_path / "none.png") == []
    assert not (tmp_path / "none.png").exists()


def test_without_matplotlib_there_is_no_picture(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    assert plot.write_plot(OUTCOMES, tmp_path / "p.png") == []


def test_a_task_travels_as_it_is():
    task = Task(
        *("a", "/out", (Stage("fit", ("x", "--steps", "3")),), ("/in",), "m:f", "r"),
        **{"limits": Limits(5.0, 7), "common": ("--threads", "1"), "retry": True, "measure": "m:g", "fault": "none"},
    )
    assert Task.from_json(json.loads(json.dumps(task.to_json()))) == task
    assert task.options == {"fit": ["x", "--steps", "3"]}
    assert task.to_json()["limits"] == {"seconds": 5.0, "memory": 7}
