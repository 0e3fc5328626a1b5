"""The controls of one tab. They hold no state of their own: what they say goes to the tab, what they show comes from
it."""

from __future__ import annotations

import contextlib
import logging
import threading
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from sgwarp.apps.editing import operations as ops
from sgwarp.encoders.prompts import TEMPLATE_SETS
from sgwarp.errors import InputError
from sgwarp.viewer import bounds
from sgwarp.viewer.clicks import Found
from sgwarp.viewer.downloads import picture_file, scene_file, script_file, video_file
from sgwarp.viewer.markup import as_plain, legend_rows, notice, score_table, score_text
from sgwarp.viewer.modes import MODES
from sgwarp.viewer.playing import Player
from sgwarp.viewer.questions import HIGH, LOW, OWN
from sgwarp.viewer.tab import Tab

logger = logging.getLogger("sgwarp")
TYPED = 0.4  # seconds after the last letter until a query is asked
LISTED = 5  # best objects in the panel; the list to choose from is longer
SHOWN = 6.0  # seconds that a message stays
NOTHING = "Click at an object, or draw a rectangle with Shift held."
HINTS = {
    "query": "What to look for; several queries are separated by semicolons.",
    "negatives": "Phrases that a query has to fit better than, such as object; things; stuff; texture.",
    "threshold": "0 is the scene's median score, 1 its best thousandth.",
}


class Panel:
    """Builds the controls of a tab and listens to them.

    Args:
        client: Of viser.
        tab: Its state.
        changed: Called when the picture has to be drawn anew.
        splats: Called with whether the browser draws.
        aim: Called with the stem of a view to look from.
        cameras: Called with whether the views' cameras are drawn.
    """

    def __init__(
        self,
        client: Any,
        tab: Tab,
        changed: Callable[[], None],
        splats: Callable[[bool], None],
        aim: Callable[[str], None],
        cameras: Callable[[bool], None],
    ) -> None:
        self._client, self.tab, self._changed = client, tab, changed
        self._splats, self._aim, self._cameras = splats, aim, cameras
        self._typing: threading.Timer | None = None
        self._player: Player | None = None
        self._closed = False
        self.doing = ""  # what takes a while
        self.status = client.gui.add_markdown("")
        with client.gui.add_folder("Ask"):
            self._build_ask()
        with client.gui.add_folder("Show"):
            self._build_show()
        with client.gui.add_folder("Selection"):
            self._build_selection()
        with client.gui.add_folder("Save", expand_by_default=False):
            self._build_save()
        self._build_shortcuts()
        self.refresh()

    def close(self) -> None:
        """Do nothing more: the tab is gone."""
        self._closed = True
        if self._typing is not None:
            self._typing.cancel()
        if self._player is not None:
            self._player.stop()

    # What the user is told

    def tell(self, message: str, wrong: bool = False) -> None:
        """Show a message for a while."""
        title = "Not possible" if wrong else "Done"
        color = "red" if wrong else "green"
        self._client.add_notification(title, message[:500], auto_close_seconds=SHOWN, color=color)

    def set_status(self, text: str) -> None:
        """The line at the top; what takes a while goes before what is shown."""
        text = f"{self.doing} ..." if self.doing else text
        if self.status.content != text:
            self.status.content = text

    @contextlib.contextmanager
    def _says(self, doing: str) -> Iterator[None]:
        """Say what is done, as it may take a while."""
        self.doing = doing
        self.set_status("")
        try:
            yield
        finally:
            self.doing = ""

    def _try(self, work: Callable[[], Any], redraw: bool = True) -> Any:
        """Do what a control asks for; a value that is refused changes nothing, whatever fails is told."""
        if self._closed:
            return None
        try:
            result = work()
        except InputError as error:
            self.tell(str(error), wrong=True)
            self.refresh()  # the control shows what was refused
            return None
        except Exception as error:  # a fault of one tab must not end the program
            logger.exception("viewer: a control failed")
            self.tell(f"{type(error).__name__}: {error}", wrong=True)
            return None
        if redraw:
            self.refresh()
            self._changed()
        return result

    def _on(self, handle: Any, work: Callable[[Any], Any], redraw: bool = True) -> Any:
        """Have a control's new value taken, if it comes from the page."""

        @handle.on_update
        def _(event: Any) -> None:
            if event.client is not None:
                self._try(lambda: work(handle.value), redraw)

        return handle

    def _button(self, label: str, work: Callable[[], Any], hint: str | None = None, redraw: bool = True) -> Any:
        handle = self._client.gui.add_button(label, hint=hint)

        @handle.on_click
        def _(event: Any) -> None:
            self._try(work, redraw)

        return handle

    # Ask

    def _build_ask(self) -> None:
        gui, bench = self._client.gui, self.tab.bench
        self._query = gui.add_text("Query", "", hint=HINTS["query"])
        self._negatives = gui.add_text("Negatives", "", hint=HINTS["negatives"])
        spoken = bench.materials.encoder is not None
        self._templates = gui.add_dropdown("Templates", (OWN, *TEMPLATE_SETS), initial_value=OWN, visible=spoken)
        two = bench.materials.predicted is not None
        self._ensemble = gui.add_dropdown(
            "Ensemble", ("max", "2d", "3d", "sum", "mean"), initial_value="max", visible=two
        )
        for box in (self._query, self._negatives, self._templates, self._ensemble):
            self._on(box, lambda value: self._ask_soon(), redraw=False)
        self._threshold = gui.add_slider("Threshold", LOW, HIGH, 0.01, 0.5, hint=HINTS["threshold"])
        self._on(self._threshold, self.tab.set_threshold)
        empty = np.zeros(2), np.zeros(2), np.zeros(2)
        self._histogram = gui.add_uplot(
            empty,
            ({"label": "score"}, {"stroke": "#868e96", "fill": "#ced4da"}, {"stroke": "#e8590c", "fill": "#ffa94d"}),
            scales={"x": {"time": False, "range": (LOW, HIGH)}},
            axes=({"stroke": "#adb5bd"}, {"show": False}),  # logarithms; only their shape says something
            legend={"show": False},
            padding=(8, 16, 0, 16),
            height=110,
            visible=False,
        )
        self._legend = gui.add_html("")
        self._top = gui.add_dropdown("Select object", ("-",), visible=False)
        self._on(self._top, self._choose)
        self._button("Select what was found", lambda: self._tell_found(self.tab.select_found()))
        if bench.asker.sees_pictures:
            upload = gui.add_upload_button("Ask for a picture", mime_type="image/*")

            @upload.on_upload
            def _(event: Any) -> None:
                self._try(lambda: self._take_picture(upload.value.content), redraw=False)

    def _ask_soon(self) -> None:
        if self._typing is not None:
            self._typing.cancel()
        self._typing = threading.Timer(TYPED, lambda: self._try(self._ask))
        self._typing.daemon = True
        self._typing.start()

    def _ask(self) -> None:
        with self._says("Asking"):
            answers = self.tab.ask(
                self._query.value, self._negatives.value, self._templates.value, self._ensemble.value
            )
        if answers is not None and answers.unknown:
            names = ", ".join(answers.unknown)
            self.tell(f"the encoder knows nothing like {names}; choose other words", wrong=True)

    def _take_picture(self, data: bytes) -> None:
        name = self.tab.add_picture(data)
        before = self._query.value.strip()
        self._query.value = f"{before}; {name}" if before else name
        self._ask_soon()

    def _choose(self, value: str) -> None:
        number = value.partition(" ")[0]
        if number.isdecimal():
            self._tell_found(self.tab.select_instance(int(number)))

    # Show

    def _build_show(self) -> None:
        gui, bench, look = self._client.gui, self.tab.bench, self.tab.look
        self._mode = self._on(gui.add_dropdown("Mode", MODES, initial_value=look.mode), self.tab.set_mode)
        instances = bench.materials.instances
        if instances is not None and len(instances.levels) > 1:
            levels = tuple(instances.levels)
            self._on(gui.add_dropdown("Level", levels, initial_value=levels[-1]), self.tab.set_level)
        self._strength = self._on(gui.add_slider("Strength", 0.0, 1.0, 0.01, look.strength), self.tab.set_strength)
        if bench.frames > 1:
            self._time = self._on(gui.add_slider("Time", 0, bench.frames - 1, 1, 0), self.tab.set_moment)
            self._on(gui.add_checkbox("Play", False), self._play, redraw=False)
        self._on(gui.add_rgb("Background", (0, 0, 0)), self.tab.set_background)
        if bench.materials.views:
            stems = ("-", *(view.stem for view in bench.materials.views))
            self._on(gui.add_dropdown("Look from", stems), lambda stem: stem == "-" or self._aim(stem), redraw=False)
            self._on(gui.add_checkbox("Cameras of the views", False), self._show_cameras)
        self._button("Reset view", lambda: self._aim(""), "Look from where the page began (R).", redraw=False)
        self._drawn_there = self._on(gui.add_checkbox("Splats in the browser", False), self._draw_splats)

    def _show_cameras(self, wanted: bool) -> None:
        self._cameras(bool(wanted))
        self.tab.set_cameras(wanted)

    def _draw_splats(self, wanted: bool) -> None:
        try:
            self._splats(bool(wanted))
        except InputError:
            self._drawn_there.value = False
            raise

    def _play(self, wanted: bool) -> None:
        if self._player is not None:
            self._player.stop()
        self._player = Player(self._next_frame) if wanted else None

    def _next_frame(self) -> None:
        moment = self.tab.advance()
        self._time.value = moment
        self._changed()

    # Selection

    def _build_selection(self) -> None:
        gui = self._client.gui
        self._info = gui.add_markdown(NOTHING)
        self._on(
            gui.add_checkbox("Rectangle reaches through", False, hint="Also select what is hidden."),
            self.tab.set_through,
            redraw=False,
        )
        reach = gui.add_number("Grow by", 0.05, step=0.01, hint="Negative numbers shrink the selection.")
        self._button("Grow", lambda: self.tab.grow_selection(reach.value))
        self._build_box()
        self._button("Hide", lambda: self._edit(ops.Fade(0.0)), "Opacity 0; undo shows it again.")
        self._button("Isolate", lambda: self._edit(ops.Isolate(0.05)), "Fade everything else.")
        self._button("Delete", lambda: self._edit(ops.Remove()), "Also by Shift+D.")
        self._button("Keep only this", lambda: self._edit(ops.Extract()))
        color = gui.add_rgb("Color", (230, 60, 40))
        self._button("Recolor", lambda: self._edit(ops.Recolor(_color(color.value))))
        shift = gui.add_vector3("Shift", (0.0, 0.0, 0.0), step=0.01)
        self._button("Move", lambda: self._edit(ops.Move(_shift(shift.value))))
        self._button("Duplicate", lambda: self._edit(ops.Duplicate(_shift(shift.value))))
        self._button("Undo", self._undo, "Also by Ctrl+Z.")
        self._button("Redo", self._redo, "Also by Ctrl+Shift+Z.")
        self._button("Select nothing", self.tab.clear_selection, "Also by N.")

    def _build_box(self) -> None:
        """Two corners, those of the scene without its outermost hundredth at first."""
        gui = self._client.gui
        low, high = self.tab.bench.extent()
        with gui.add_folder("Box", expand_by_default=False):
            first, second = gui.add_vector3("From", low, step=0.01), gui.add_vector3("To", high, step=0.01)
            self._button(
                "Select box",
                lambda: self._tell_found(self.tab.select_box(first.value, second.value)),
                "What lies between two corners; Keep only this then crops the scene.",
            )

    def _build_shortcuts(self) -> None:
        """Keys, and the same words in the palette of commands (Ctrl+K)."""
        commands: tuple[tuple[str, str, str | None, Callable[[], Any]], ...] = (
            ("Undo", "Z", "cmd/ctrl", self._undo),
            ("Redo", "Z", "cmd/ctrl+shift", self._redo),
            ("Delete the selection", "D", "shift", lambda: self._edit(ops.Remove())),
            ("Hide the selection", "H", None, lambda: self._edit(ops.Fade(0.0))),
            ("Select nothing", "N", None, self.tab.clear_selection),
            ("Reset view", "R", None, lambda: self._aim("")),
        )
        for label, key, modifier, work in commands:
            handle = self._client.gui.add_command(label, hotkey=key, modifier=modifier)
            handle.on_trigger(lambda event, work=work: self._try(work))

    def _undo(self) -> None:
        self.tell(self.tab.bench.undo())

    def _redo(self) -> None:
        self.tell(self.tab.bench.redo())

    def _edit(self, operation: ops.Operation) -> None:
        self.tell(self.tab.edit(operation))

    def click(self, place: Any) -> None:
        """A click into the picture."""
        self._try(lambda: self._tell_found(self.tab.click(place)))

    def rectangle(self, first: Any, second: Any) -> None:
        """A rectangle drawn over the picture."""
        self._try(lambda: self._tell_found(self.tab.select_rectangle(first, second)))

    def _tell_found(self, found: Found) -> None:
        if not bool(found.selected.any()):
            self.tab.clear_selection()
            raise InputError("nothing is there to select")

    # Save

    def _build_save(self) -> None:
        gui, tab = self._client.gui, self.tab
        columns = gui.add_checkbox("With all columns", True, hint="Off: only those that every viewer reads.")
        chosen = gui.add_checkbox("Only the selection", False)

        def save_scene() -> None:
            only = None
            if chosen.value:
                found = tab.found
                if found is None:
                    raise InputError("nothing is selected")
                only = found.selected
            with self._says("Writing the scene"):
                self._send("scene.ply", scene_file(tab.bench, not columns.value, only, tab.look.moment))

        self._button("Scene (PLY)", save_scene, redraw=False)
        self._button(
            "Edits (JSON)",
            lambda: self._send("edits.json", script_file(tab.bench)),
            "For sgwarp edit --script.",
            redraw=False,
        )
        self._button("Picture (PNG)", self._save_picture, redraw=False)
        self._button("Add place to camera path", lambda: self.tell(f"{tab.add_key()} places"), redraw=False)
        self._button("Clear camera path", tab.clear_keys, redraw=False)
        self._button("Video of the path (MP4)", self._save_video, redraw=False)

    def _save_picture(self) -> None:
        if self.tab.camera is not None:
            self._send("picture.png", picture_file(self.tab.shot(), self.tab.camera))

    def _save_video(self) -> None:
        def progress(done: int, total: int) -> None:
            if self._closed:
                raise InputError("the tab was closed")
            self.doing = f"Drawing picture {done} of {total}"

        with self._says("Drawing the video"):
            self._send("path.mp4", video_file(self.tab.shot(), self.tab.keys, progress))

    def _send(self, name: str, content: bytes) -> None:
        self._client.send_file_download(name, content, save_immediately=True)

    # What the tab says

    def refresh(self) -> None:
        """Bring the controls up to date with the tab."""
        tab, found = self.tab, self.tab.found
        self._mode.value = tab.look.mode
        self._strength.visible = tab.look.mode in ("features", "instances")  # the modes that it changes
        self._info.content = NOTHING if found is None else as_plain(found.sentence)
        self._legend.content = legend_rows(tab.legend()) + notice(tab.missing) + self._refresh_answers()

    def _refresh_answers(self) -> str:
        """Histogram and best objects; these also as HTML."""
        answers = self.tab.answers
        first = None if answers is None else answers.first
        self._histogram.visible = first is not None
        if answers is None or first is None:
            self._top.visible = False
            return ""
        centers, counts = answers.histogram(first)
        heights = np.log10(1.0 + counts.numpy())
        reached = centers.numpy() >= self.tab.look.threshold
        self._histogram.data = (centers.numpy(), heights, np.where(reached, heights, 0.0))
        ranked = answers.rank(self.tab.bench.materials.instances, first)
        self._top.visible = bool(ranked)
        options = ("-", *(f"{one.id} {one.name} {score_text(one.score)}" for one in ranked))
        if tuple(self._top.options) != options:
            self._top.options = options
        return score_table([(one.name, one.score) for one in ranked[:LISTED]])


def _color(values: Any) -> ops.Vector:
    red, green, blue = bounds.numbers("color", values, 3, 255.0)
    return red / 255, green / 255, blue / 255


def _shift(values: Any) -> ops.Vector:
    x, y, z = bounds.numbers("shift", values, 3, bounds.FAR_AWAY)
    return x, y, z
