"""Editing step by step, with undo and redo."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from sgwarp.apps.editing.operations import Change
from sgwarp.apps.editing.picker import EditContext, EditState, pick
from sgwarp.apps.editing.script import EditStep
from sgwarp.apps.editing.selection import Selection
from sgwarp.errors import InputError
from sgwarp.scene import Gaussians

HISTORY = 16  # states kept; what lies further back is replayed from the start


class EditSession:
    """A scene, the steps applied to it, and those undone.

    States share the tensors that a step left alone, so undoing gives back the same bits. Nothing here draws or writes:
    a viewer asks `preview` while its user points and types, and `apply` when they mean it.

    Args:
        gaussians: The scene as loaded.
        context: What selections may need.

    Raises:
        InputError: The scene is empty, or something in the context belongs to another one.
    """

    def __init__(self, gaussians: Gaussians, context: EditContext | None = None) -> None:
        if not len(gaussians):
            raise InputError("the scene holds no Gaussians; there is nothing to edit")
        self.context = context or EditContext()
        self.context.require_scene(gaussians)
        count, device = len(gaussians), gaussians.device
        nothing = torch.zeros(count, dtype=torch.int32, device=device)
        first = EditState(gaussians, torch.arange(count, device=device), nothing, nothing.bool())
        self._states: dict[int, EditState] = {0: first}
        self._steps: list[EditStep] = []
        self._done = 0

    @property
    def state(self) -> EditState:
        """The scene as it is now."""
        return self._states[self._done]

    @property
    def original(self) -> Gaussians:
        """The scene as loaded."""
        return self._states[0].gaussians

    @property
    def steps(self) -> tuple[EditStep, ...]:
        """The steps that led to the scene as it is now."""
        return tuple(self._steps[: self._done])

    @property
    def undone(self) -> tuple[EditStep, ...]:
        """The steps that `redo` would apply, the next one first."""
        return tuple(self._steps[self._done :])

    def preview(self, selection: Selection) -> Tensor:
        """What a selection would select now, bool [N].

        Raises:
            InputError: As `pick`.
        """
        return pick(self.state, selection, self.context)

    def apply(self, step: EditStep) -> EditState:
        """Apply a step; steps that were undone are forgotten.

        Raises:
            InputError: It selects nothing, or would leave no Gaussian; the session stays as it was.
        """
        state = self._next(self.state, step)
        self._steps[self._done :] = [step]
        self._done += 1
        self._states = {number: kept for number, kept in self._states.items() if number < self._done}
        self._keep(state)
        return state

    def undo(self) -> EditState:
        """Go back by one step.

        Raises:
            InputError: There is none.
        """
        if not self._done:
            raise InputError("undo: no step was applied")
        self._done -= 1
        if self._done not in self._states:
            start = max(number for number in self._states if number < self._done)
            state = self._states[start]
            for step in self._steps[start : self._done]:
                state = self._next(state, step)
            self._keep(state)
        return self.state

    def redo(self) -> EditState:
        """Apply the step that was undone last.

        Raises:
            InputError: There is none.
        """
        if self._done == len(self._steps):
            raise InputError("redo: no step was undone")
        if self._done + 1 not in self._states:
            state = self._next(self.state, self._steps[self._done])
            self._done += 1
            self._keep(state)
        else:
            self._done += 1
        return self.state

    def _keep(self, state: EditState) -> None:
        self._states[self._done] = state
        far = sorted((number for number in self._states if number), key=lambda number: abs(number - self._done))
        for number in far[HISTORY:]:
            del self._states[number]

    def _next(self, state: EditState, step: EditStep) -> EditState:
        chosen = pick(state, step.selection, self.context)
        change = step.operation.apply(state.gaussians, chosen)
        _require_representable(state.gaussians, change, step.operation.name)
        if change.rows is None:
            return EditState(change.gaussians, state.rows, state.copies, chosen)
        copies, selected = state.copies[change.rows], chosen[change.rows]
        if change.added:
            copies[-change.added :] = int(state.copies.max()) + 1
            selected = torch.arange(len(copies), device=copies.device) >= len(copies) - change.added
        return EditState(change.gaussians, state.rows[change.rows], copies, selected)


def _require_representable(before: Gaussians, change: Change, name: str) -> None:
    """Raise InputError if a Gaussian left the range of float32: nothing would draw it any more."""

    def usable(gaussians: Gaussians) -> Tensor:
        return gaussians.finite & (gaussians.scales > 0).all(dim=1)

    was = usable(before)
    lost = int(((was if change.rows is None else was[change.rows]) & ~usable(change.gaussians)).sum())
    if lost:
        raise InputError(f"{name}: takes {lost} Gaussians out of the range of 32-bit numbers; give a value closer to 1")


def edit(gaussians: Gaussians, steps: Sequence[EditStep], context: EditContext | None = None) -> EditState:
    """Apply steps to a scene, one after another.

    Args:
        gaussians: The scene; it is left as it is.
        steps: What to do, such as EditStep(Selection(("lamp",)), Remove()).
        context: Semantics, text encoder, instances and views, as far as the selections need them.

    Returns:
        The new scene, and for each Gaussian the row of the old one that it comes from.

    Raises:
        InputError: There is no step, one selects nothing, needs what the context lacks or would leave no Gaussian; its
            number is in the message.
    """
    if not steps:
        raise InputError("edit: no step to apply")
    session = EditSession(gaussians, context)
    for step in steps:
        _apply_numbered(session, step, len(steps))
    return session.state


def _apply_numbered(session: EditSession, step: EditStep, total: int) -> None:
    try:
        session.apply(step)
    except InputError as error:
        where = f"step {len(session.steps) + 1}: " if total > 1 else ""
        raise InputError(f"{where}{error}") from None
