"""Every control of the panel: whom it calls with which values, how it begins, and when it is there."""

from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from sgwarp.apps.editing import operations as ops
from sgwarp.encoders.prompts import TEMPLATE_SETS
from sgwarp.errors import InputError
from sgwarp.viewer import panel as panel_module
from sgwarp.viewer.clicks import Found
from sgwarp.viewer.modes import MODES
from sgwarp.viewer.panel import Panel
from sgwarp.viewer.tab import Tab
from sgwarp.viewer.workbench import Materials, Workbench


class Control:
    """In place of one of viser's."""

    def __init__(self, *arguments, **options):
        self.arguments, self.given = arguments, options
        self.value = options.get("initial_value", arguments[0] if arguments else None)
        self.content = arguments[0] if arguments else ""
        self.options, self.visible, self.data = (), options.get("visible", True), None

    def listen(self, work):
        self.work = work

    on_click = on_update = on_trigger = on_upload = listen

    def set(self, value):
        """As the page does."""
        self.value = value
        self.work(SimpleNamespace(client=object()))

    def press(self):
        self.work(SimpleNamespace(client=object()))


class Gui:
    """Controls by their kind and label."""

    def __init__(self):
        self.controls, self.folders = {}, {}

    def add_folder(self, label, **options):
        self.folders[label] = options
        return nullcontext()

    def __getattr__(self, kind):
        def add(label=None, *arguments, **options):
            named = isinstance(label, str) and kind not in ("add_markdown", "add_html")
            made = Control(*arguments, **options) if named else Control(label, *arguments, **options)
            self.controls[kind.removeprefix("add_"), label if named else ""] = made
            return made

        return add


class Page:
    """A panel, its controls, and what everybody around it was told."""

    def __init__(self, tab):
        self.told, self.sent, self.called = [], [], []
        self.gui = Gui()
        self.tab = tab
        calls = [
            lambda *given, name=name: self.called.append((name, *given))
            for name in ("changed", "splats", "aim", "cameras")
        ]
        self.panel = Panel(self, tab, *calls)

    def add_notification(self, title, message, **options):
        self.told.append((title, message, options["color"]))

    def send_file_download(self, name, content, save_immediately):
        self.sent.append((name, content))

    def __getitem__(self, found):
        return self.gui.controls[found]


@pytest.fixture
def page(tab):
    return Page(tab)


def record(monkeypatch, owner, *names, result=None):
    """The calls of these methods, which then do nothing."""
    calls = []
    for name in names:
        monkeypatch.setattr(owner, name, lambda *given, name=name: calls.append((name, *given)) or result)
    return calls


@pytest.fixture
def moving(stage):
    """A tab that has everything: three frames, a network's features, an encoder that sees pictures."""
    sequence = SimpleNamespace(frame=lambda t: SimpleNamespace(gaussians=stage.gaussians), __len__=lambda: 3)

    class Frames(list):
        frame = staticmethod(sequence.frame)

    return Tab(Workbench(Materials(stage.gaussians, sequence=Frames(range(3)))))


# kind, label, value, method of the tab, its arguments
VALUES = [
    ("slider", "Threshold", 0.25, "set_threshold", (0.25,)),
    ("dropdown", "Mode", "depth", "set_mode", ("depth",)),
    ("dropdown", "Level", "s", "set_level", ("s",)),
    ("slider", "Strength", 0.4, "set_strength", (0.4,)),
    ("rgb", "Background", (1, 2, 3), "set_background", ((1, 2, 3),)),
    ("checkbox", "Rectangle reaches through", True, "set_through", (True,)),
    ("checkbox", "Cameras of the views", True, "set_cameras", (True,)),
]
QUIET = {"Rectangle reaches through"}  # the picture stays as it is


@pytest.mark.parametrize(("kind", "label", "value", "method", "arguments"), VALUES, ids=[row[1] for row in VALUES])
def test_a_value_goes_to_the_tab(page, monkeypatch, kind, label, value, method, arguments):
    calls = record(monkeypatch, Tab, method)
    page[kind, label].work(SimpleNamespace(client=None))  # set by this program, not by the page
    assert not calls
    # Controls listen to methods bound when the panel was built, so the panel is built anew.
    page = Page(page.tab)
    page[kind, label].set(value)
    assert [call[2:] for call in calls] == [arguments]
    assert ("changed",) in page.called or label in QUIET
    assert ("changed",) not in page.called or label not in QUIET


def test_controls_begin_with_the_state_of_the_tab(page, tab, bench, stage):
    assert page["dropdown", "Mode"].arguments == (MODES,)
    assert page["dropdown", "Mode"].value == "color"
    assert page["dropdown", "Level"].value == "m", "the coarsest"
    assert page["dropdown", "Level"].arguments == (("s", "m"),)
    assert page["slider", "Strength"].arguments == (0.0, 1.0, 0.01, tab.look.strength)
    low, high, step, first = page["slider", "Threshold"].arguments
    assert (low, high, step, first) == (-0.5, 1.5, 0.01, tab.look.threshold)
    assert page["rgb", "Background"].arguments == ((0, 0, 0),)
    for label, ticked in (
        *(("Cameras of the views", False), ("Splats in the browser", False), ("Rectangle reaches through", False)),
        *(("With all columns", True), ("Only the selection", False)),
    ):
        assert page["checkbox", label].value is ticked, label
    low, high = bench.extent()
    assert (page["vector3", "From"].value, page["vector3", "To"].value) == (low, high)
    assert page["vector3", "Shift"].value == (0.0, 0.0, 0.0)
    assert page["number", "Grow by"].value == 0.05
    assert page["dropdown", "Look from"].arguments == (("-", *(view.stem for view in stage.views)),)
    assert page["dropdown", "Templates"].arguments == (("own", *TEMPLATE_SETS),)
    assert page["dropdown", "Ensemble"].value == "max"
    assert page.gui.folders["Save"] == page.gui.folders["Box"] == {"expand_by_default": False}


def test_controls_are_there_where_they_can_do_something(page, stage, toy_semantics, toy_text, moving):
    bare, both = (
        Page(Tab(Workbench(given)))
        for given in (
            Materials(stage.gaussians),
            Materials(stage.gaussians, toy_semantics, toy_semantics, toy_text),
        )
    )
    assert [one["dropdown", "Templates"].visible for one in (bare, page, both)] == [False, True, True]
    assert [one["dropdown", "Ensemble"].visible for one in (bare, page, both)] == [False, False, True]
    for key in (("dropdown", "Level"), ("dropdown", "Look from"), ("checkbox", "Cameras of the views")):
        assert key in page.gui.controls
        assert key not in bare.gui.controls, key
    still, played = page.gui.controls, Page(moving).gui.controls
    assert ("slider", "Time") not in still
    assert ("checkbox", "Play") not in still
    assert played["slider", "Time"].arguments == (0, 2, 1, 0)
    assert ("upload_button", "Ask for a picture") not in still
    towered = Workbench(Materials(stage.gaussians, toy_semantics, None, toy_text, make_tower=lambda: None))
    assert ("upload_button", "Ask for a picture") in Page(Tab(towered)).gui.controls


FOUND = Found(torch.tensor([True, False]))
# label, method of the tab, its arguments
BUTTONS = [
    ("Select what was found", "select_found", ()),
    ("Grow", "grow_selection", (0.25,)),
    ("Hide", "edit", (ops.Fade(0.0),)),
    ("Isolate", "edit", (ops.Isolate(0.05),)),
    ("Delete", "edit", (ops.Remove(),)),
    ("Keep only this", "edit", (ops.Extract(),)),
    ("Recolor", "edit", (ops.Recolor((0.2, 0.4, 1.0)),)),
    ("Move", "edit", (ops.Move((0.1, 0.2, 0.3)),)),
    ("Duplicate", "edit", (ops.Duplicate((0.1, 0.2, 0.3)),)),
    ("Select nothing", "clear_selection", ()),
    ("Select box", "select_box", ((1.0, 2.0, 3.0), (4.0, 5.0, 6.0))),
    ("Clear camera path", "clear_keys", ()),
]


@pytest.mark.parametrize(("label", "method", "arguments"), BUTTONS, ids=[row[0] for row in BUTTONS])
def test_a_button_calls_the_tab(tab, monkeypatch, label, method, arguments):
    result = {"edit": "what was done"}.get(method, FOUND)
    calls = record(monkeypatch, tab, method, result=result)
    page = Page(tab)
    for kind, name, value in (
        ("number", "Grow by", 0.25),
        ("rgb", "Color", (51, 102, 255)),
        ("vector3", "Shift", (0.1, 0.2, 0.3)),
        ("vector3", "From", (1.0, 2.0, 3.0)),
        ("vector3", "To", (4.0, 5.0, 6.0)),
    ):
        page[kind, name].value = value
    page["button", label].press()
    assert calls == [(method, *arguments)]
    assert page.told == ([("Done", "what was done", "green")] if method == "edit" else [])
    assert (("changed",) in page.called) == (label != "Clear camera path")


def test_undo_and_redo_are_buttons_too(tab, monkeypatch):
    for name in ("undo", "redo"):
        monkeypatch.setattr(tab.bench, name, lambda name=name: f"{name} of a step")
    page = Page(tab)
    for label, said in (("Undo", "undo of a step"), ("Redo", "redo of a step")):
        page["button", label].press()
        assert page.told.pop() == ("Done", said, "green")


# label, key, modifier, method of the tab, its arguments
KEYS = [
    ("Delete the selection", "D", "shift", "edit", (ops.Remove(),)),
    ("Hide the selection", "H", None, "edit", (ops.Fade(0.0),)),
    ("Select nothing", "N", None, "clear_selection", ()),
]


@pytest.mark.parametrize(("label", "key", "modifier", "method", "arguments"), KEYS, ids=[row[0] for row in KEYS])
def test_a_key_calls_the_tab(tab, monkeypatch, label, key, modifier, method, arguments):
    calls = record(monkeypatch, tab, method, result="done")
    page = Page(tab)
    assert page["command", label].given == {"hotkey": key, "modifier": modifier}
    page["command", label].press()
    assert calls == [(method, *arguments)]


def test_keys_of_undo_redo_and_the_first_view(tab, monkeypatch):
    for name in ("undo", "redo"):
        monkeypatch.setattr(tab.bench, name, lambda name=name: name)
    page = Page(tab)
    for label, modifier in (("Undo", "cmd/ctrl"), ("Redo", "cmd/ctrl+shift")):
        assert page["command", label].given == {"hotkey": "Z", "modifier": modifier}
        page["command", label].press()
        assert page.told.pop()[1] == label.lower()
    assert page["command", "Reset view"].given == {"hotkey": "R", "modifier": None}
    for kind in ("command", "button"):
        page.called.clear()
        page[kind, "Reset view"].press()
        assert ("aim", "") in page.called


def test_the_camera_goes_to_a_view_that_is_chosen(page):
    page["dropdown", "Look from"].set("0003")
    assert page.called == [("aim", "0003")]
    page.called.clear()
    page["dropdown", "Look from"].set("-")
    assert page.called == []


def test_cameras_and_splats_are_drawn_as_ticked(page):
    for wanted in (True, False):
        page.called.clear()
        page["checkbox", "Cameras of the views"].set(wanted)
        assert ("cameras", wanted) in page.called
        assert page.tab.look.cameras is wanted
        page["checkbox", "Splats in the browser"].set(wanted)
        assert ("splats", wanted) in page.called


def test_the_tick_goes_away_where_the_browser_cannot_draw(page, monkeypatch):
    def refuse(wanted):
        raise InputError("too many")

    page.panel._splats = refuse
    page["checkbox", "Splats in the browser"].set(True)
    assert page["checkbox", "Splats in the browser"].value is False
    assert page.told == [("Not possible", "too many", "red")]


# Asking


@pytest.fixture
def timers(monkeypatch):
    """Timers that wait for the test."""
    made = []

    class Timer:
        def __init__(self, seconds, work):
            self.seconds, self.work, self.state = seconds, work, "made"
            made.append(self)

        def start(self):
            self.state = "started"

        def cancel(self):
            self.state = "cancelled"

    monkeypatch.setattr(panel_module.threading, "Timer", Timer)
    return made


def test_a_question_is_asked_once_after_the_last_letter(tab, timers, monkeypatch):
    calls = record(monkeypatch, tab, "ask")
    page = Page(tab)
    for kind, label, value in (
        ("text", "Query", "lamp; book"),
        ("text", "Negatives", "wall"),
        ("dropdown", "Templates", "photo"),
        ("dropdown", "Ensemble", "sum"),
    ):
        page[kind, label].set(value)
        assert timers[-1].state == "started"
    assert [timer.state for timer in timers] == ["cancelled"] * 3 + ["started"]
    assert not calls
    timers[-1].work()
    assert calls == [("ask", "lamp; book", "wall", "photo", "sum")]
    assert page.called == [("changed",)]


def test_a_tab_that_is_gone_asks_and_plays_no_more(moving, timers, monkeypatch):
    players = []

    class Player:
        def __init__(self, step):
            self.step, self.stopped = step, False
            players.append(self)

        def stop(self):
            self.stopped = True

    monkeypatch.setattr(panel_module, "Player", Player)
    calls = record(monkeypatch, moving, "ask", "clear_selection")
    page = Page(moving)
    page["text", "Query"].set("lamp")
    page["checkbox", "Play"].set(True)
    page["checkbox", "Play"].set(True)
    assert [one.stopped for one in players] == [True, False], "two do not play at once"
    page.panel.close()
    assert timers[-1].state == "cancelled"
    assert players[-1].stopped
    timers[-1].work()
    page["button", "Select nothing"].press()
    assert not calls


def test_play_shows_one_frame_after_the_other(moving, monkeypatch):
    players = []
    monkeypatch.setattr(panel_module, "Player", lambda step: players.append(step) or SimpleNamespace(stop=lambda: None))
    page = Page(moving)
    page["checkbox", "Play"].set(True)
    for expected in (1, 2, 0, 1):
        page.called.clear()
        players[0]()
        assert page["slider", "Time"].value == moving.look.moment == expected
        assert page.called == [("changed",)]
    page["checkbox", "Play"].set(False)
    assert len(players) == 1
    page["slider", "Time"].set(2)
    assert moving.look.moment == 2


def test_words_that_the_encoder_does_not_know_are_told(tab, timers, monkeypatch):
    answers = SimpleNamespace(unknown=("zzz", "qqq"))
    monkeypatch.setattr(tab, "ask", lambda *given: answers)
    page = Page(tab)
    page["text", "Query"].set("zzz; qqq; lamp")
    timers[-1].work()
    assert page.told == [("Not possible", "the encoder knows nothing like zzz, qqq; choose other words", "red")]
    answers.unknown = ()
    timers[-1].work()
    assert len(page.told) == 1


@pytest.mark.parametrize(("before", "after"), [("", "picture 1"), ("lamp ", "lamp; picture 1")])
def test_a_picture_joins_the_query(stage, toy_semantics, toy_text, timers, monkeypatch, before, after):
    tab = Tab(Workbench(Materials(stage.gaussians, toy_semantics, None, toy_text, make_tower=lambda: None)))
    monkeypatch.setattr(tab, "add_picture", lambda data: {b"pixels": "picture 1"}[data])
    page = Page(tab)
    page["text", "Query"].value = before
    page["upload_button", "Ask for a picture"].set(SimpleNamespace(content=b"pixels"))
    assert page["text", "Query"].value == after
    assert timers[-1].state == "started"
    assert page["upload_button", "Ask for a picture"].given["mime_type"] == "image/*"


def test_an_object_of_the_list_is_selected_by_its_number(tab, monkeypatch):
    calls = record(monkeypatch, tab, "select_instance", result=FOUND)
    page = Page(tab)
    page["dropdown", "Select object"].set("-")
    page["dropdown", "Select object"].set("7 lamp 0.98")
    assert calls == [("select_instance", 7)]


def test_answers_are_shown(tab):
    page = Page(tab)
    top, histogram, legend = page["dropdown", "Select object"], page["uplot", ""], page["html", ""]
    assert (top.visible, histogram.visible) == (False, False)
    answers = tab.ask("lamp")
    tab.set_threshold(0.5)
    page.panel.refresh()
    assert (top.visible, histogram.visible) == (True, True)
    assert top.options[0] == "-"
    assert top.options[1].startswith("7 lamp ")
    assert len(top.options) == 1 + len(answers.rank(tab.bench.materials.instances))
    centers, heights, reached = histogram.data
    expected, counts = (part.numpy() for part in answers.histogram())
    np.testing.assert_allclose(centers, expected)
    np.testing.assert_allclose(heights, np.log10(1 + counts))
    np.testing.assert_allclose(reached, np.where(expected >= 0.5, heights, 0.0))
    assert 0 < (reached > 0).sum() < (heights > 0).sum()
    assert "threshold (line)" in legend.content
    assert legend.content.count("<tr>") == min(5, len(top.options) - 1)
    tab.ask("")
    page.panel.refresh()
    assert (top.visible, histogram.visible) == (False, False)
    tab.set_mode("segmentation")
    page.panel.refresh()
    assert "Nothing was asked yet" in legend.content


def test_the_panel_follows_the_tab(tab):
    page = Page(tab)
    info = [one for (kind, _), one in page.gui.controls.items() if kind == "markdown"][-1]
    assert info.content.startswith("Click at an object")
    for mode in MODES:
        tab.set_mode(mode)
        page.panel.refresh()
        assert page["dropdown", "Mode"].value == mode
        assert page["slider", "Strength"].visible is (mode in ("features", "instances")), mode
    tab.select_instance(7)
    page.panel.refresh()
    assert info.content.startswith("object 7: lamp")


def test_clicks_and_rectangles_arrive(tab, monkeypatch):
    calls = record(monkeypatch, tab, "click", "select_rectangle", result=FOUND)
    page = Page(tab)
    page.panel.click((0.1, 0.2))
    page.panel.rectangle((0.1, 0.2), (0.3, 0.4))
    assert calls == [("click", (0.1, 0.2)), ("select_rectangle", (0.1, 0.2), (0.3, 0.4))]
    assert not page.told


def test_a_click_at_nothing_clears_the_selection(tab, monkeypatch):
    tab.select_instance(7)
    monkeypatch.setattr(tab, "click", lambda place: Found(torch.zeros(2, dtype=torch.bool)))
    page = Page(tab)
    page.panel.click((0.5, 0.5))
    assert tab.found is None
    assert page.told == [("Not possible", "nothing is there to select", "red")]


# Telling


def test_a_refusal_and_a_fault_are_told_and_draw_nothing(tab, monkeypatch, caplog):
    for error, message in ((InputError("not so"), "not so"), (KeyError("of a test"), "KeyError: 'of a test'")):

        def fail(error=error):
            raise error

        monkeypatch.setattr(tab, "clear_selection", fail)
        page = Page(tab)
        page["button", "Select nothing"].press()
        assert page.told == [("Not possible", message, "red")]
        assert not page.called
    assert "a control failed" in caplog.text
    page.panel.tell("x" * 900)
    assert page.told[-1] == ("Done", "x" * 500, "green")


def test_what_takes_a_while_stands_before_the_status(page):
    status = page.panel.status
    page.panel.set_status("5 Gaussians")
    assert status.content == "5 Gaussians"
    with page.panel._says("Asking"):
        assert status.content == "Asking ..."
        page.panel.set_status("6 Gaussians")
        assert status.content == "Asking ..."
    page.panel.set_status("6 Gaussians")
    assert status.content == "6 Gaussians"


# Saving


@pytest.fixture
def files(monkeypatch):
    """What the functions that make files are asked for; each gives its own name."""
    calls = []
    for name in ("scene_file", "script_file", "picture_file", "video_file"):
        monkeypatch.setattr(panel_module, name, lambda *given, name=name: calls.append((name, *given)) or name.encode())
    return calls


def test_a_scene_is_saved_as_ticked(tab, files):
    page = Page(tab)
    page["button", "Scene (PLY)"].press()
    assert files.pop() == ("scene_file", tab.bench, False, None, 0)
    page["checkbox", "With all columns"].value = False
    page["checkbox", "Only the selection"].value = True
    page["button", "Scene (PLY)"].press()
    assert page.told == [("Not possible", "nothing is selected", "red")]
    tab.select_instance(7)
    page["button", "Scene (PLY)"].press()
    name, bench, plain, only, moment = files.pop()
    assert (name, bench, plain, moment) == ("scene_file", tab.bench, True, 0)
    assert torch.equal(only, tab.found.selected)
    assert page.sent == [("scene.ply", b"scene_file")] * 2


def test_the_frame_that_is_shown_is_saved(moving, files):
    page = Page(moving)
    moving.set_moment(2)
    page["button", "Scene (PLY)"].press()
    assert files == [("scene_file", moving.bench, False, None, 2)]


def test_edits_pictures_and_paths_are_saved(tab, files, stage):
    page = Page(tab)
    page["button", "Edits (JSON)"].press()
    assert files.pop() == ("script_file", tab.bench)
    page["button", "Picture (PNG)"].press()
    name, shot, camera = files.pop()
    assert (name, shot.gaussians, camera) == ("picture_file", tab.bench.state.gaussians, tab.camera)
    for count in (1, 2):
        page["button", "Add place to camera path"].press()
        assert page.told.pop() == ("Done", f"{count} places", "green")
    page["button", "Video of the path (MP4)"].press()
    name, shot, keys, progress = files.pop()
    assert (name, keys) == ("video_file", [tab.camera, tab.camera])
    progress(3, 9)
    page.panel.set_status("")
    assert page.panel.status.content == "Drawing picture 3 of 9 ..."
    assert page.sent == [("edits.json", b"script_file"), ("picture.png", b"picture_file"), ("path.mp4", b"video_file")]
    page.panel.close()
    with pytest.raises(InputError, match="closed"):
        progress(4, 9)
    tab.camera = None
    page = Page(tab)
    page["button", "Picture (PNG)"].press()
    assert not page.sent, "the page has not said yet where it looks from"
