"""Controls of the panel without a browser: every button does what it says, values arrive in their order."""

from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace

import pytest

from sgwarp.apps.editing import operations as ops
from sgwarp.io.sequence_files import write_params
from sgwarp.io.sequences import load_sequence
from sgwarp.viewer.panel import Panel, _color, _shift
from sgwarp.viewer.tab import Tab
from sgwarp.viewer.workbench import Materials, Workbench


class Control:
    """In place of one of viser's: remembers its value and who listens."""

    def __init__(self, kind, label, *arguments, **options):
        self.kind, self.label = kind, label
        self.value = options.get("initial_value", arguments[-1] if arguments else None)
        self.content, self.options, self.visible, self.data = "", (), True, None
        self.press = self.change = None

    def on_click(self, work):
        self.press = work

    def on_update(self, work):
        self.change = work

    def on_trigger(self, work):
        self.press = work


class Gui:
    def __init__(self):
        self.controls = {}

    def add_folder(self, label, **options):
        return nullcontext()

    def __getattr__(self, kind):
        def add(label="", *arguments, **options):
            made = Control(kind, label, *arguments, **options)
            self.controls[label if isinstance(label, str) else kind] = made
            return made

        return add


class Client:
    def __init__(self):
        self.gui, self.told = Gui(), []

    def add_notification(self, title, message, **options):
        self.told.append((title, message))


@pytest.fixture
def open_panel():
    def make(tab):
        client = Client()
        Panel(client, tab, *[lambda *given: None] * 4)
        return client

    return make


BUTTONS = {
    "Hide": ops.Fade(0.0),
    "Isolate": ops.Isolate(0.05),
    "Delete": ops.Remove(),
    "Keep only this": ops.Extract(),
    "Recolor": ops.Recolor((1.0, 0.0, 0.2)),
    "Move": ops.Move((0.1, 0.2, 0.3)),
    "Duplicate": ops.Duplicate((0.1, 0.2, 0.3)),
}


@pytest.mark.parametrize("label", BUTTONS)
def test_a_button_does_what_it_says(tab, open_panel, monkeypatch, label):
    edits = []
    monkeypatch.setattr(tab, "edit", lambda operation: edits.append(operation) or "done")
    client = open_panel(tab)
    client.gui.controls["Color"].value = (255, 0, 51)
    client.gui.controls["Shift"].value = (0.1, 0.2, 0.3)
    client.gui.controls[label].press(None)
    assert edits == [BUTTONS[label]]
    assert client.told == [("Done", "done")]


def test_undo_and_redo(tab, open_panel, monkeypatch):
    monkeypatch.setattr(tab.bench, "undo", lambda: "undone")
    monkeypatch.setattr(tab.bench, "redo", lambda: "redone")
    client = open_panel(tab)
    client.gui.controls["Undo"].press(None)
    client.gui.controls["Redo"].press(None)
    assert client.told == [("Done", "undone"), ("Done", "redone")]


def test_values_keep_their_order():
    assert _shift((1.0, 2.0, 3.0)) == (1.0, 2.0, 3.0)
    assert _color((255, 0, 51)) == (1.0, 0.0, 0.2)


@pytest.mark.parametrize("frames", [1, 2])
def test_a_moving_scene_has_a_slider_for_the_time(stage, open_panel, tmp_path, frames):
    moved = [replace(stage.gaussians, means=stage.gaussians.means + 0.1 * t) for t in range(frames)]
    write_params(tmp_path / "params.npz", moved)
    sequence = load_sequence(tmp_path / "params.npz")
    tab = Tab(Workbench(Materials(sequence.frame(0).gaussians, sequence=sequence)))
    controls = open_panel(tab).gui.controls
    assert ("Time" in controls) == (frames == 2)
    if frames == 2:
        controls["Time"].value = 1
        controls["Time"].change(SimpleNamespace(client=object(), client_id=0, target=controls["Time"]))
        assert tab.look.moment == 1
