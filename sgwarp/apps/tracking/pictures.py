"""Pictures of a tracked scene: overlays per frame, a contact sheet, a video, and the trajectories from above."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from sgwarp.errors import InputError
from sgwarp.files.atomic import atomic_path
from sgwarp.files.images import read_rgb, write_rgb
from sgwarp.files.videos import require_frames
from sgwarp.visualization.pictures import Picture, class_colours, overlay, with_legend

SHEET = 9  # frames on a contact sheet
SIDE_BY_SIDE = 4  # views in the picture of a frame
FRAMES_PER_SECOND = 10
LINE = 22  # of text [pixels]
LEGEND = 20  # objects in it at most
PALETTE = 4096  # colours before they come again


@cache
def _palette() -> Picture:
    return class_colours(PALETTE)


def object_colours(names: Sequence[str]) -> Picture:
    """The colour of each object, uint8 [len(names), 3]: of an id always the same, else by its place."""
    ids = all(name.isdecimal() for name in names)
    keys = [int(name) for name in names] if ids else range(len(names))
    found: Picture = _palette()[np.array(keys, np.int64) % PALETTE]
    return found


def frame_picture(
    photographs: Sequence[Any], images: Sequence[Any], names: Sequence[str], values: Sequence[int], title: str
) -> Picture:
    """Up to four views side by side, objects in their colours, with a legend of the largest ones that they show.

    Args:
        photographs: Of the views, [H, W, 3] each.
        images: Values of their pixels, [H, W] each.
        names, values: Of the objects.
        title: Written on top.
    """
    import cv2

    colours = object_colours(names)
    table = np.full(max([*values, 255]) + 2, -1)
    table[list(values)] = np.arange(len(values))
    chosen = list(zip(photographs, images, strict=True))[:SIDE_BY_SIDE]
    tiles = [overlay(photograph, table[np.asarray(image, dtype=np.int64)], colours) for photograph, image in chosen]
    height, width = max(len(tile) for tile in tiles), max(tile.shape[1] for tile in tiles)
    columns = 1 if len(tiles) == 1 else 2
    rows = -(-len(tiles) // columns)
    board = np.full((LINE + rows * height, columns * width, 3), 255, np.uint8)
    for k, tile in enumerate(tiles):
        y, x = LINE + k // columns * height, k % columns * width
        board[y : y + len(tile), x : x + tile.shape[1]] = tile
    cv2.putText(board, title, (6, LINE - 7), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (0, 0, 0), 1, cv2.LINE_AA)
    shown = np.zeros(len(names), np.int64)
    for _, image in chosen:
        place = table[np.asarray(image, dtype=np.int64)]
        shown += np.bincount(place[place >= 0], minlength=len(names))
    largest = sorted(k for k in np.argsort(-shown, kind="stable")[:LEGEND].tolist() if shown[k])
    return with_legend(board, [names[k] for k in largest], colours[largest])


def write_contact_sheet(path: Path, pictures: Sequence[Path]) -> None:
    """Up to nine of the pictures, evenly spread over time, on one sheet."""
    count = min(SHEET, len(pictures))
    chosen = [read_rgb(pictures[round(k * (len(pictures) - 1) / max(1, count - 1))]) for k in range(count)]
    height, width = max(len(one) for one in chosen), max(one.shape[1] for one in chosen)
    columns = math.ceil(math.sqrt(count))
    sheet = np.full((-(-count // columns) * height, columns * width, 3), 255, np.uint8)
    for k, one in enumerate(chosen):
        y, x = k // columns * height, k % columns * width
        sheet[y : y + len(one), x : x + one.shape[1]] = one
    write_rgb(path, sheet)


def write_video(path: Path, pictures: Sequence[Path]) -> None:
    """The pictures one after another as an MPEG-4 file, ten per second.

    Raises:
        InputError: This OpenCV cannot write one.
    """
    import cv2

    sizes = [read_rgb(picture).shape for picture in (pictures[0], pictures[-1])]
    # Legends grow as ids appear; codecs want even sizes.
    height, width = (2 * math.ceil(max(size[axis] for size in sizes) / 2) for axis in (0, 1))
    with atomic_path(path) as temporary:
        writer = cv2.VideoWriter(str(temporary), cv2.VideoWriter.fourcc(*"mp4v"), FRAMES_PER_SECOND, (width, height))
        if not writer.isOpened():
            raise InputError(
                f"{path}: cannot be written: the disk is full, or this OpenCV has no MPEG-4 encoder; see --no-pictures"
            )
        for picture in pictures:
            board = np.full((height, width, 3), 255, np.uint8)
            pixels = read_rgb(picture)[:height, :width]
            board[: len(pixels), : pixels.shape[1]] = pixels
            writer.write(np.ascontiguousarray(board[:, :, ::-1]))
        writer.release()
        require_frames(str(path), temporary, len(pictures))


def write_trajectories(path: Path, tracks: dict[str, Any]) -> bool:
    """Plot the objects' paths from above, and their height over time; False where there is no matplotlib.

    Args:
        path: Name ending in .png.
        tracks: As in tracks.json.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError:
        return False
    objects = tracks["objects"]
    colours = object_colours(list(objects)) / 255.0
    figure = Figure(figsize=(11, 4.5), layout="constrained")
    FigureCanvasAgg(figure)
    above, over_time = figure.subplots(1, 2)
    for (name, one), color in zip(objects.items(), colours, strict=True):
        rows = [
            (t, c) for t, c, seen in zip(tracks["frames"], one["centroid"], one["visible"], strict=True) if c and seen
        ]
        if not rows:
            continue
        times, places = np.array([t for t, _ in rows]), np.array([c for _, c in rows])
        gaps = np.flatnonzero(np.diff(times) > 1) + 1  # while it was away there is no line
        last = places[-1, [0, 2]]
        places, times = np.insert(places, gaps, np.nan, axis=0), np.insert(times.astype(float), gaps, np.nan)
        above.plot(places[:, 0], places[:, 2], color=color, label=name, lw=1.2)
        above.plot(*last, "o", color=color, ms=5)
        over_time.plot(times, -places[:, 1], color=color, lw=1.2)
    above.set(xlabel="x [m]", ylabel="z [m]", title="centroids from above; a dot is the last sight", aspect="equal")
    over_time.set(xlabel="frame", ylabel="-y [m]", title="height of the centroids (y down)")
    if above.lines:
        above.legend(fontsize=7, loc="center left", bbox_to_anchor=(1.0, 0.5))
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=130)
    return True
