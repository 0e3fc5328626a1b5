"""Small generated rooms as labelled folders."""

from pathlib import Path

import pytest

from sgwarp.datasets.synthetic import make_room
from sgwarp.datasets.synthetic_files import save_room

VIEWS, WIDTH, HEIGHT = 9, 64, 48


@pytest.fixture(scope="session")
def rooms(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of two rooms, `one` and `two`."""
    folder = tmp_path_factory.mktemp("rooms")
    for seed, name in enumerate(("one", "two")):
        save_room(make_room(seed, 8000), folder / name, VIEWS, WIDTH, HEIGHT, seed)
    return folder
