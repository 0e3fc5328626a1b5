"""One tab of a browser: what it looks at and how, what it asks and what it has selected."""

from __future__ import annotations

import threading
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from sgwarp.apps.editing.operations import Operation
from sgwarp.apps.editing.picker import grow, whole_instance
from sgwarp.errors import InputError
from sgwarp.querying.scoring import TextScores
from sgwarp.scene import Camera
from sgwarp.viewer import bounds, clicks, legends, paints
from sgwarp.viewer.clicks import Found
from sgwarp.viewer.downloads import decode_picture
from sgwarp.viewer.modes import MODES, PAINTED, Mode, Shot
from sgwarp.viewer.questions import HIGH, LOW, PICTURE, Answers, Questions
from sgwarp.viewer.workbench import Scene, Workbench

MOST_PICTURES = 8  # that a tab may ask for
MOST_KEYS = 64  # of a camera path
NOTHING = "nothing is selected; click at an object or draw a rectangle"


@dataclass(frozen=True)
class Look:
    """What a tab shows.

    Attributes:
        mode: Kind of picture.
        threshold: Least score that counts as found.
        strength: Share of the paint over the scene's own colors.
        moment: Frame of a moving scene.
        level: Of the instances; empty for the coarsest.
        background: Color behind the scene, in [0, 1].
        through: Whether a rectangle also selects what is hidden.
        cameras: Whether the browser draws the views' cameras into the picture, which needs its depth.
    """

    mode: Mode = "color"
    threshold: float = 0.5
    strength: float = 0.7
    moment: int = 0
    level: str = ""
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    through: bool = False
    cameras: bool = False


@dataclass(frozen=True, eq=False)
class _Selected:
    """What is selected, known by where its Gaussians come from, so that it outlives edits and the time slider.

    Attributes:
        found: In the scene of that revision.
        keys: Of its Gaussians, int64.
        revision: Of the scene.
    """

    found: Found
    keys: Tensor
    revision: int

    def carried(self, scene: Scene) -> _Selected:
        """The same in another state of the scene, or in another frame."""
        if scene.revision == self.revision:
            return self
        selected = torch.isin(_keys(scene), self.keys.to(scene.rows.device))
        return _Selected(replace(self.found, selected=selected), self.keys, scene.revision)


def _keys(scene: Scene) -> Tensor:
    """A number for every Gaussian that stays its own: its row in the scene as loaded, and which copy of it it is."""
    return scene.rows + (scene.copies.to(torch.int64) << 32)


class Tab:
    """The state of one tab; every method may be called from any thread.

    A method that does not accept what it is given raises InputError and leaves the tab as it was.

    Args:
        bench: What all tabs share.
    """

    def __init__(self, bench: Workbench) -> None:
        self.bench = bench
        self.look = Look()
        self.answers: Answers | None = None
        self.camera: Camera | None = None
        self.keys: list[Camera] = []
        self._pictures: dict[str, Tensor] = {}
        self._lock = threading.RLock()
        self._selected: _Selected | None = None
        self._carried: tuple[Any, TextScores] | None = None
        self._paints: dict[tuple[str, str, int], tuple[Tensor, Tensor | None]] = {}

    # What to show

    def set_mode(self, mode: Any) -> None:
        """Choose the kind of picture."""
        chosen = bounds.choice("mode", mode, MODES)
        self._require_material(chosen)
        self._look(mode=chosen)

    def _require_material(self, mode: str) -> None:
        given = self.bench.materials
        if mode == "features" and given.semantics is None:
            raise InputError("features: needs --semantics, what `sgwarp lift` wrote")
        if mode == "instances" and given.instances is None:
            raise InputError("instances: needs --instances, what `sgwarp instances` wrote")
        if mode == "coverage" and given.semantics is None and not given.views:
            raise InputError("coverage: needs --semantics or --views, to tell what was looked at")
        if mode in ("relevancy", "segmentation") and given.semantics is None:
            raise InputError(f"{mode}: needs --semantics, what `sgwarp lift` wrote")

    def set_threshold(self, value: Any) -> None:
        """Least score that counts as found: 0 is the scene's median, 1 its best thousandth."""
        self._look(threshold=bounds.number("threshold", value, LOW, HIGH))

    def set_strength(self, value: Any) -> None:
        """Share of the paint over the scene's own colors."""
        self._look(strength=bounds.number("strength", value, 0.0, 1.0))

    def set_moment(self, value: Any) -> None:
        """Frame of a moving scene."""
        self._look(moment=bounds.whole("time", value, 0, self.bench.frames - 1))

    def advance(self) -> int:
        """Go to the next frame of a moving scene, from the last one to the first; returns it."""
        with self._lock:
            self._look(moment=(self.look.moment + 1) % self.bench.frames)
            return self.look.moment

    def set_level(self, value: Any) -> None:
        """Level of the instances."""
        instances = self.bench.materials.instances
        levels = instances.levels if instances is not None else ()
        self._look(level=bounds.choice("level", value, levels))

    def set_background(self, values: Any) -> None:
        """Color behind the scene, from 0 to 255."""
        red, green, blue = bounds.numbers("background", values, 3, 255.0)
        if min(red, green, blue) < 0:
            raise InputError("background: expected numbers from 0 to 255")
        self._look(background=(red / 255, green / 255, blue / 255))

    def set_through(self, value: Any) -> None:
        """Whether a rectangle also selects what is hidden."""
        self._look(through=bool(value))

    def set_cameras(self, value: Any) -> None:
        """Whether the browser draws the views' cameras into the picture."""
        self._look(cameras=bool(value))

    def _look(self, **changes: Any) -> None:
        with self._lock:
            self.look = replace(self.look, **changes)

    # What to ask

    def ask(self, queries: Any, negatives: Any = "", templates: Any = "own", ensemble: Any = "max") -> Answers | None:
        """Ask; an empty box forgets the answers. Shows them where the mode did not."""
        ensemble = bounds.choice("ensemble", ensemble, ("2d", "3d", "max", "sum", "mean"))
        questions = Questions.parse(queries, negatives, templates, ensemble)
        if not questions.queries:
            with self._lock:
                self.answers = None
                if self.look.mode in ("relevancy", "segmentation"):
                    self._look(mode="color")
            return None
        answers = self.bench.asker.ask(questions, self._pictures)
        with self._lock:
            self.answers = answers
            if self.look.mode not in ("relevancy", "segmentation"):
                self._look(mode="relevancy")
        return answers

    def add_picture(self, data: bytes) -> str:
        """Take a picture to ask for; returns the name that stands for it in the box of queries."""
        if not self.bench.asker.sees_pictures:
            raise InputError("picture: the encoder of these semantics has no image tower; ask in words")
        if len(self._pictures) >= MOST_PICTURES:
            raise InputError(f"picture: at most {MOST_PICTURES} in a tab; open another one")
        vector = self.bench.asker.picture_vector(decode_picture(data))
        with self._lock:
            name = PICTURE.format(len(self._pictures) + 1)
            self._pictures[name] = vector
        return name

    # What to select

    @property
    def found(self) -> Found | None:
        """What is selected, in the scene as it is now; None if nothing is, or if all of it was deleted."""
        return self._found_in(self.bench.scene(self.look.moment))

    def _found_in(self, scene: Scene) -> Found | None:
        with self._lock:
            if self._selected is not None:
                self._selected = self._selected.carried(scene)
            there = self._selected is not None and bool(self._selected.found.selected.any())
            return self._selected.found if self._selected is not None and there else None

    def click(self, position: Any) -> Found:
        """Select the object at a place of the picture, from 0 to 1 on either side; again: its part there."""
        camera = self._require_camera()
        pixel = bounds.pixel(position, camera)
        scene, context = self.bench.scene(self.look.moment), self.bench.session.context
        found = clicks.click(scene.state, context, self.bench.asker, camera, pixel, self._found_in(scene))
        self._select(found, scene)
        return found

    def select_rectangle(self, first: Any, second: Any) -> Found:
        """Select what lies in a rectangle of the picture."""
        camera = self._require_camera()
        corners = bounds.pixel(first, camera), bounds.pixel(second, camera)
        scene = self.bench.scene(self.look.moment)
        found = Found(clicks.in_rectangle(scene.state, camera, corners, self.look.through))
        self._select(found, scene)
        return found

    def select_found(self, query: Any = 0) -> Found:
        """Select what a query scores above the threshold."""
        if self.answers is None:
            raise InputError("nothing was asked; write a query first")
        query = bounds.whole("query", query, 0, len(self.answers.questions.queries) - 1)
        name = self.answers.questions.queries[query]
        if name in self.answers.unknown:
            raise InputError(f"query: the encoder knows nothing like {name}, so nothing was found")
        scene = self.bench.scene(self.look.moment)
        scores = self.answers.carried(scene.rows)
        found = Found((scores.values[:, query] > self.look.threshold) & scores.seen)
        self._select(found, scene)
        return found

    def select_instance(self, number: Any) -> Found:
        """Select an instance by its id."""
        instances = self.bench.materials.instances
        if instances is None:
            raise InputError("object: needs --instances, what `sgwarp instances` wrote")
        number = bounds.whole("object", number, 1, len(instances.table))
        scene = self.bench.scene(self.look.moment)
        chosen = whole_instance(scene.state, instances, number)
        level = instances.table[number - 1].level
        return self._select(clicks.describe(scene.state, self.bench.asker, instances, chosen, level), scene)

    def select_box(self, low: Any, high: Any) -> Found:
        """Select the Gaussians whose centers lie between two corners [scene units]."""
        first, second = (
            bounds.numbers(name, corner, 3, bounds.FAR_AWAY) for name, corner in (("from", low), ("to", high))
        )
        scene = self.bench.scene(self.look.moment)
        means = scene.gaussians.means.double()
        corners = torch.tensor([first, second], dtype=torch.float64, device=means.device)
        inside = ((means >= corners.amin(dim=0)) & (means <= corners.amax(dim=0))).all(dim=1)
        return self._select(Found(inside & scene.gaussians.finite), scene)

    def grow_selection(self, distance: Any) -> Found:
        """Add what lies within a distance of the selection, or if negative take away what lies within it of the rest
        [scene units]."""
        distance = bounds.number("distance", distance, -bounds.FAR_AWAY, bounds.FAR_AWAY)
        scene = self.bench.scene(self.look.moment)
        found = self._found_in(scene)
        if found is None:
            raise InputError(NOTHING)
        chosen = found.selected if not distance else grow(scene.gaussians.means, found.selected, distance)
        if not bool(chosen.any()):
            raise InputError(f"distance: {distance:g} would leave nothing selected")
        return self._select(Found(chosen), scene)

    def clear_selection(self) -> None:
        """Select nothing."""
        with self._lock:
            self._selected = None

    def _select(self, found: Found, scene: Scene) -> Found:
        with self._lock:
            self._selected = _Selected(found, _keys(scene)[found.selected], scene.revision)
        return found

    def _require_camera(self) -> Camera:
        if self.camera is None:
            raise InputError("the page has not said yet where it looks from")
        return self.camera

    # What to do with it

    def edit(self, operation: Operation) -> str:
        """Apply an operation to the selection, for all tabs; says what was done. What is left of it stays selected."""
        self.bench.require_still(operation)
        found = self.found
        if found is None:
            raise InputError(NOTHING)
        # Without our lock: every tab hears of the edit, and another one may be in the middle of its own.
        self.bench.apply_to(found.selected, found.instance, operation)
        if self.found is None:
            self.clear_selection()  # so that an undo shows the scene as it was
        return f"{operation.name}: {int(found.selected.sum()):,} Gaussians; {len(self.bench.state.gaussians):,} in all"

    # The picture

    def shot(self) -> Shot:
        """Everything that the next picture depends on but the camera."""
        with self._lock:
            look, answers = self.look, self.answers
        scene = self.bench.scene(look.moment)
        found = self._found_in(scene)
        shot = Shot(
            scene.gaussians,
            look.mode,
            background=look.background,
            threshold=look.threshold,
            depth=look.cameras,
        )
        if found is not None:
            shot = replace(shot, selected=found.selected)
        if look.mode in PAINTED:
            paint, known = self._paint(look, scene)
            share = 1.0 if look.mode == "coverage" else look.strength
            shot = replace(shot, paint=paint, known=known, strength=share)
        if look.mode in ("relevancy", "segmentation"):
            shot = replace(shot, **self._scores(answers, scene, look.mode))
        return shot

    def _paint(self, look: Look, scene: Scene) -> tuple[Tensor, Tensor | None]:
        given = self.bench.materials
        key = look.mode, look.level, id(given)
        with self._lock:
            if key not in self._paints:
                self._paints = {key: self._make_paint(look)}
            paint, known = self._paints[key]
        if len(paint) <= int(scene.rows.max()):
            raise InputError(f"{look.mode}: belongs to a frame with other Gaussians")
        rows = scene.rows.cpu()
        return paint[rows], None if known is None else known[rows]

    def _make_paint(self, look: Look) -> tuple[Tensor, Tensor | None]:
        given = self.bench.materials
        if look.mode == "features":
            assert given.semantics is not None
            return paints.feature_colors(given.semantics), given.semantics.seen.cpu()
        if look.mode == "instances":
            assert given.instances is not None
            return paints.instance_colors(given.instances, look.level or None)
        return paints.coverage_colors(given.gaussians, given.semantics, given.views), None

    def _scores(self, answers: Answers | None, scene: Scene, mode: str) -> dict[str, Any]:
        """Scores and colors of a shot: those of the queries, or without any of the lifted labels."""
        if answers is None:
            labels = getattr(self.bench.materials.semantics, "labels", None)
            if labels is None or mode == "relevancy":
                return {}
            answers = self.bench.asker.ask(Questions(tuple(labels)))
            with self._lock:
                self.answers = answers
        key = id(answers), scene.revision
        if self._carried is None or self._carried[0] != key:
            if len(answers.scores.values) <= int(scene.rows.max()):
                raise InputError("the semantics belong to a frame with other Gaussians")
            self._carried = key, answers.carried(scene.rows.to(answers.scores.values.device))
        return {"scores": self._carried[1], "colors": answers.questions.colors}

    def legend(self) -> list[tuple[str, str]]:
        """Names and colors of what the picture shows, #rrggbb."""
        return legends.legend(self.look.mode, self.answers, self.bench.materials.instances, self.look.level)

    @property
    def missing(self) -> str:
        """What to do so that the mode shows something; empty if nothing is missing."""
        return legends.missing(self.look.mode, self.answers)

    # A camera path

    def add_key(self) -> int:
        """Put the camera at the end of the path; returns how many there are."""
        if len(self.keys) >= MOST_KEYS:
            raise InputError(f"camera path: at most {MOST_KEYS} places; clear it first")
        self.keys = [*self.keys, self._require_camera()]
        return len(self.keys)

    def clear_keys(self) -> None:
        """Forget the path."""
        self.keys = []
