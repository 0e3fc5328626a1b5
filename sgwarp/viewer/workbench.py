"""What all tabs share: the scene, what is known about it, and the edits with undo and redo."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from sgwarp.apps.editing.operations import Operation
from sgwarp.apps.editing.picker import EditContext, EditState
from sgwarp.apps.editing.script import EditStep
from sgwarp.apps.editing.selection import Selection, rows_term
from sgwarp.apps.editing.session import EditSession
from sgwarp.encoders.base import TextEncoder
from sgwarp.errors import InputError
from sgwarp.io.sequences import GaussianSequence
from sgwarp.scene import Gaussians, InstanceMap, Semantics, View
from sgwarp.scene.extent import near_plane
from sgwarp.viewer.questions import Asker

KEPT_FRAMES = 8  # of a moving scene
LEAST_STEPS = 100  # of the extent down to the near plane


@dataclass(frozen=True, eq=False)
class Materials:
    """What a viewer is started with.

    Attributes:
        gaussians: The scene; of a moving one the first frame.
        semantics: Lifted, or None.
        predicted: By the network, or None.
        encoder: Text encoder of the semantics' space; None for lifted labels.
        with_templates: Makes the text encoder for other prompt templates, or None.
        instances: Or None.
        views: Cameras to start from, and to tell what was looked at.
        sequence: The frames of a moving scene, or None.
        make_tower: Makes what encodes images in the semantics' space, if the text encoder does not; or None.
    """

    gaussians: Gaussians
    semantics: Semantics | None = None
    predicted: Semantics | None = None
    encoder: TextEncoder | None = None
    with_templates: Callable[[str], TextEncoder] | None = None
    instances: InstanceMap | None = None
    views: Sequence[View] = ()
    sequence: GaussianSequence | None = None
    make_tower: Callable[[], Any] | None = None


@dataclass(frozen=True, eq=False)
class Scene:
    """What is shown at one moment.

    Attributes:
        gaussians: The scene.
        rows: Row of the scene as loaded that each comes from, int64 [N].
        copies: Which duplication made it, 0 for none, int32 [N].
        revision: Another number after every change.
    """

    gaussians: Gaussians
    rows: Tensor
    copies: Tensor
    revision: int

    @property
    def state(self) -> EditState:
        """The same for what selects."""
        return EditState(self.gaussians, self.rows, self.copies, torch.zeros_like(self.copies, dtype=torch.bool))


@dataclass
class Workbench:
    """A scene that several tabs look at and change; every method may be called from any thread.

    Attributes:
        materials: What the viewer was started with.
        asker: Asks its semantics.
    """

    materials: Materials
    asker: Asker = field(init=False)

    def __post_init__(self) -> None:
        given = self.materials
        self._lock = threading.RLock()
        self._listeners: list[Callable[[], None]] = []
        self._frames: OrderedDict[int, Gaussians] = OrderedDict()
        self._revision = 0
        self._range: tuple[Materials, tuple[float, float]] | None = None
        self._begin(given)

    def _begin(self, given: Materials) -> None:
        context = EditContext(given.semantics, given.encoder, given.instances, given.views)
        self.session = EditSession(given.gaussians, context)
        self.asker = Asker(given.semantics, given.encoder, given.predicted, given.with_templates, given.make_tower)

    def subscribe(self, listener: Callable[[], None]) -> Callable[[], None]:
        """Have a function called after every change; returns one that ends this."""
        with self._lock:
            self._listeners.append(listener)
        return lambda: self._listeners.remove(listener) if listener in self._listeners else None

    @contextmanager
    def _changing(self) -> Iterator[None]:
        """Change the scene in the block, then tell the listeners.

        They are told after the lock is given back: a listener takes the lock of its tab, which may wait for ours.
        """
        with self._lock:
            yield
            self._revision += 1
            listeners = list(self._listeners)
        for listener in listeners:
            listener()

    @property
    def frames(self) -> int:
        """How many frames a moving scene has; 1 if it stands still."""
        return len(self.materials.sequence) if self.materials.sequence is not None else 1

    def scene(self, moment: int = 0) -> Scene:
        """The scene as it is now, or a frame of a moving one.

        Raises:
            InputError: There is no such frame, or it cannot be read.
        """
        if self.frames == 1:
            with self._lock:
                state = self.session.state
                return Scene(state.gaussians, state.rows, state.copies, self._revision)
        if not 0 <= moment < self.frames:
            raise InputError(f"time: expected 0 to {self.frames - 1}, got {moment}")
        gaussians = self._frame(moment)
        rows = torch.arange(len(gaussians), device=gaussians.device)
        copies = torch.zeros_like(rows, dtype=torch.int32)
        return Scene(gaussians, rows, copies, self._revision * self.frames + moment)

    def _frame(self, moment: int) -> Gaussians:
        sequence = self.materials.sequence
        assert sequence is not None
        with self._lock:
            if moment not in self._frames:
                self._frames[moment] = sequence.frame(moment).gaussians.to(self.materials.gaussians.device)
                while len(self._frames) > KEPT_FRAMES:
                    self._frames.popitem(last=False)
            self._frames.move_to_end(moment)
            return self._frames[moment]

    @property
    def state(self) -> EditState:
        """The scene after the edits."""
        with self._lock:
            return self.session.state

    def require_still(self, operation: Operation) -> None:
        """Refuse to edit a scene that moves.

        Raises:
            InputError: It does.
        """
        if self.frames > 1:
            raise InputError(
                f"{operation.name}: a moving scene can be looked at and asked, not edited; save the frame that is "
                "shown as Scene (PLY), and open that"
            )

    def apply(self, term: str, operation: Operation) -> str:
        """Edit what a term selects; says what was done.

        Raises:
            InputError: The scene moves, or as `EditSession.apply`; nothing has changed then.
        """
        with self._changing():
            before = len(self.session.state.gaussians)
            after = self._edit(term, operation)
        return f"{operation.name}: {before} Gaussians before, {len(after.gaussians)} after"

    def apply_to(self, chosen: Tensor, instance: int, operation: Operation) -> None:
        """Edit what is chosen, as `term_of` takes it, in one step: no other edit comes between.

        Raises:
            InputError: As `term_of` and `apply`; nothing has changed then.
        """
        with self._changing():
            self._edit(self.term_of(chosen, instance), operation)

    def _edit(self, term: str, operation: Operation) -> EditState:
        self.require_still(operation)
        return self.session.apply(EditStep(Selection((term,), clean=False), operation))

    def undo(self) -> str:
        """Go back by one edit; says which.

        Raises:
            InputError: There is none.
        """
        with self._changing():
            self.session.undo()
            name = self.session.undone[0].operation.name
        return f"undone: {name}"

    def redo(self) -> str:
        """Apply again what was undone last; says what.

        Raises:
            InputError: There is nothing.
        """
        with self._changing():
            self.session.redo()
            name = self.session.steps[-1].operation.name
        return f"done again: {name}"

    def term_of(self, chosen: Tensor, instance: int = 0) -> str:
        """The shortest term that selects exactly these Gaussians of the scene as it is now.

        Args:
            chosen: bool [N].
            instance: The one they may belong to; 0 for none.

        Raises:
            InputError: None is chosen, or the scene has changed since.
        """
        with self._lock:
            if len(chosen) != len(self.session.state.gaussians):
                raise InputError("the selection is of an earlier state of the scene; select again")
            if not bool(chosen.any()):
                raise InputError("nothing is selected")
            if instance:
                term = f"id:{instance}"
                if torch.equal(self.session.preview(Selection((term,), clean=False)), chosen):
                    return term
        return rows_term(chosen.nonzero().flatten().tolist())

    def replace_scene(self, gaussians: Gaussians) -> None:
        """Show another state of a scene that grows, such as that of a fit; edits of the old one are gone."""
        with self._changing():
            self.materials = replace(self.materials, gaussians=gaussians, instances=None, semantics=None)
            self._begin(self.materials)

    def replace_semantics(self, semantics: Semantics) -> None:
        """Take what is known so far from a lift that goes on."""
        with self._changing():
            self.materials = replace(self.materials, semantics=semantics)
            self.session.context = replace(self.session.context, semantics=semantics)
            self.asker = replace(self.asker, semantics=semantics)

    def extent(self) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
        """Two corners of a box that holds all centers but the outermost hundredth on each side [scene units]."""
        means = self.materials.gaussians.means[self.materials.gaussians.finite].double().cpu()
        if not len(means):
            return (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
        ordered, last = means.sort(dim=0).values, len(means) - 1
        low, high = ordered[last // 100].tolist(), ordered[last - last // 100].tolist()
        return (low[0], low[1], low[2]), (high[0], high[1], high[2])

    def depth_range(self) -> tuple[float, float]:
        """Near and far plane for cameras that move freely in the scene [world units]."""
        given = self.materials
        if self._range is None or self._range[0] is not given:  # asked for with every move of a camera
            self._range = given, _depth_range(given)
        return self._range[1]


def _depth_range(given: Materials) -> tuple[float, float]:
    near = near_plane(given.views) if given.views else None
    if near is None:
        means = given.gaussians.means[given.gaussians.finite]
        spread = (means - means.median(dim=0).values).norm(dim=1).median() if len(means) else torch.ones(())
        near = max(float(spread) / LEAST_STEPS, 1e-12)
    return near, near * 1e8
