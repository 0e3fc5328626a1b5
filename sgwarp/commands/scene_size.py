"""How large a scene of a batch was: its Gaussians and its views, from headers and cameras alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from sgwarp.errors import InputError

HEADER = 1 << 16  # bytes that are searched for the number of Gaussians


def measure(stages: Mapping[str, Sequence[str]]) -> dict[str, int]:
    """Gaussians and views of a scene, as far as they can be counted.

    Args:
        stages: Arguments of each command, which have been run.
    """
    from sgwarp.commands.scene_stages import parse

    found: dict[str, int] = {}
    for name, arguments in stages.items():
        command = parse(name, arguments)
        scene = getattr(command, "scene", None) or getattr(command, "gaussians", None) or command.out
        with suppress(InputError):
            found["gaussians"] = count_gaussians(Path(scene))
        views = getattr(command, "views", None)
        if views is not None:
            poses = Path(f"{command.out}.sfm")  # of photographs that had none
            with suppress(InputError):
                found["views"] = _count_views(poses if poses.exists() else views)
        if len(found) == 2:
            break
    return found


def count_gaussians(path: Path) -> int:
    """Gaussians in a scene's file; of a PLY file its header says how many.

    Raises:
        InputError: It cannot be read.
    """
    if path.suffix == ".ply" and path.is_file():
        with path.open("rb") as file:
            for line in file.read(HEADER).splitlines():
                words = line.split()
                if words[:2] == [b"element", b"vertex"] and len(words) == 3 and words[2].isdigit():
                    return int(words[2])
    from sgwarp.io.scenes import load_gaussians

    return len(load_gaussians(path))


def _count_views(path: Path) -> int:
    from sgwarp.io.views import load_views

    return len(load_views(path, photographs=False))
