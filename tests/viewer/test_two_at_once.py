"""Two tabs that edit at once: whoever is told of an edit may ask for the scene and for its own selection."""

import threading

import pytest

from sgwarp.apps.editing.operations import Remove
from sgwarp.viewer.tab import Tab

EDITS = {
    "edit": lambda tab, bench: tab.edit(Remove()),
    "undo": lambda tab, bench: bench.undo(),
    "redo": lambda tab, bench: (bench.undo(), bench.redo()),
    "another scene": lambda tab, bench: bench.replace_scene(bench.materials.gaussians),
    "more semantics": lambda tab, bench: bench.replace_semantics(bench.materials.semantics),
}


def answered_elsewhere(*asked) -> bool:
    """Whether another thread gets all answers now, while this one waits."""
    thread = threading.Thread(target=lambda: [ask() for ask in asked], daemon=True)
    thread.start()
    thread.join(10)
    return not thread.is_alive()


@pytest.mark.parametrize("name", EDITS)
def test_listeners_are_told_without_a_lock(tab, bench, name):
    """Else a tab that waits for the scene and an edit that waits for the tab would wait for each other."""
    other = Tab(bench)
    other.camera = tab.camera
    for one in (tab, other):
        one.select_rectangle((0.3, 0.3), (0.7, 0.7))
    if name in ("undo", "redo"):
        bench.apply("id:1", Remove())
    told = []
    bench.subscribe(
        lambda: told.append(answered_elsewhere(lambda: bench.state, lambda: tab.found, lambda: other.found))
    )
    EDITS[name](tab, bench)
    assert told == [True] * (2 if name == "redo" else 1)
