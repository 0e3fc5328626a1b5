"""What a tab saves, as bytes for its browser, and pictures it sends. No name of a file comes from a browser."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from torch import Tensor

from sgwarp.apps.editing.script import save_script
from sgwarp.errors import InputError
from sgwarp.files.image_headers import image_size
from sgwarp.files.images import read_rgb
from sgwarp.files.videos import require_frames
from sgwarp.io.scenes import save_gaussians
from sgwarp.scene import Camera
from sgwarp.viewer.modes import Shot, draw
from sgwarp.viewer.workbench import Workbench
from sgwarp.visualization.pictures import Picture

MOST_UPLOAD = 16 * 2**20  # of a picture [bytes]
MOST_UPLOADED = 2**25  # pixels of it
PICTURE_SIZE = 1920  # longest side of a saved picture, at most [pixels]
VIDEO_SIZE = 1280  # of a video
FRAMES_PER_SECOND = 24
SECONDS_PER_KEY = 1.5  # between two places of a camera path
Progress = Callable[[int, int], None]


def scene_file(bench: Workbench, plain: bool, only: Tensor | None = None, moment: int = 0) -> bytes:
    """The scene as edited, or a frame of a moving one, as PLY.

    Args:
        bench: Of the scene.
        plain: Leave out the columns that the loaded file has besides those of the reference implementation.
        only: Gaussians to save, bool [N]; all if None.
        moment: Frame of a moving scene.

    Raises:
        InputError: The scene has changed since `only` was chosen.
    """
    scene = bench.scene(moment)
    if only is not None and len(only) != len(scene.gaussians):
        raise InputError("the selection is of an earlier state of the scene; select again")
    extras = None if plain else bench.session.original.extras
    if extras is not None:
        rows = scene.rows.cpu().numpy()
        extras = {name: column[rows] for name, column in extras.items()}
    gaussians = replace(scene.gaussians.to("cpu"), extras=extras)
    if only is not None:
        gaussians = gaussians.subset(only.cpu())
    return _written("scene.ply", lambda path: save_gaussians(gaussians, path))


def script_file(bench: Workbench) -> bytes:
    """The edits as a script for `sgwarp edit --script`.

    Raises:
        InputError: There are none.
    """
    if not bench.session.steps:
        raise InputError("script: nothing was edited yet")
    return _written("edits.json", lambda path: save_script(bench.session.steps, bench.session.original, path))


def picture_file(shot: Shot, camera: Camera) -> bytes:
    """A picture as PNG, at the size of the camera's picture or less."""
    import cv2

    pixels = draw(shot, shrunk(camera, PICTURE_SIZE)).pixels
    return bytes(cv2.imencode(".png", np.ascontiguousarray(pixels[..., ::-1]))[1].tobytes())


def video_file(shot: Shot, keys: Sequence[Camera], progress: Progress | None = None) -> bytes:
    """A flight along the places of a camera path, as MPEG-4.

    Args:
        shot: What is shown.
        keys: At least two places.
        progress: Called as `progress(done, total)`.

    Raises:
        InputError: There are fewer than two places, or this OpenCV has no encoder.
    """
    import cv2

    if len(keys) < 2:
        raise InputError("camera path: a video needs at least two places")
    first = shrunk(keys[0], VIDEO_SIZE)
    height, width = (max(2, side - side % 2) for side in first.size)  # codecs want even sizes
    cameras = [one.resized(height, width) for one in fly(keys, round(FRAMES_PER_SECOND * SECONDS_PER_KEY))]

    def write(path: Path) -> None:
        fourcc = cv2.VideoWriter.fourcc(*"mp4v")
        writer = cv2.VideoWriter(str(path), fourcc, FRAMES_PER_SECOND, (width, height))
        if not writer.isOpened():
            raise InputError(
                "path.mp4: cannot be written: the disk is full, or this OpenCV has no MPEG-4 encoder; save pictures"
            )
        for done, camera in enumerate(cameras, start=1):
            writer.write(np.ascontiguousarray(draw(shot, camera).pixels[..., ::-1]))
            if progress is not None:
                progress(done, len(cameras))
        writer.release()
        require_frames("path.mp4", path, len(cameras))

    return _written("path.mp4", write)


def fly(keys: Sequence[Camera], steps: int) -> list[Camera]:
    """Cameras along a path: positions on a Catmull-Rom curve through those of the keys, rotations between two keys on
    the shortest arc, field of view linear in the focal length.

    Args:
        keys: Places, at least one, all of the size of the first.
        steps: Cameras from one key to the next.
    """
    cameras = []
    places = torch.stack([key.position for key in keys])
    padded = torch.cat([2 * places[:1] - places[1:2], places, 2 * places[-1:] - places[-2:-1]])
    for at in range(len(keys) - 1):
        one, other = keys[at], keys[at + 1].resized(*keys[at].size)
        for step in range(steps):
            share = step / steps
            camera = _between(one, other, share, catmull_rom(padded[at : at + 4], share))
            cameras.append(camera.resized(*keys[0].size))
    return [*cameras, keys[-1].resized(*keys[0].size)]


def catmull_rom(points: Tensor, share: float) -> Tensor:
    """The uniform curve between the second and the third of four points, [3]."""
    a, b, c, d = points
    return 0.5 * (2 * b + (c - a) * share + (2 * a - 5 * b + 4 * c - d) * share**2 + (3 * b - a - 3 * c + d) * share**3)


def _between(one: Camera, other: Camera, share: float, place: Tensor) -> Camera:
    first, second = one.world_to_camera[:3, :3], other.world_to_camera[:3, :3]
    turn = second @ first.T
    angle = math.acos(min(1.0, max(-1.0, (float(turn.trace()) - 1) / 2)))
    axis = torch.stack([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    rotation = first
    if float(axis.norm()) > 1e-12:
        x, y, z = (axis / axis.norm()).tolist()
        cross = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64) * (share * angle)
        rotation = torch.linalg.matrix_exp(cross) @ first
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ place
    return replace(one, K=(1 - share) * one.K + share * other.K, world_to_camera=pose)


def shrunk(camera: Camera, longest: int) -> Camera:
    """The camera with a picture whose longest side is no longer than that [pixels]."""
    share = longest / max(camera.size)
    if share >= 1:
        return camera
    return camera.resized(max(1, round(camera.height * share)), max(1, round(camera.width * share)))


def decode_picture(data: bytes) -> Picture:
    """An uploaded picture, uint8 [H, W, 3].

    Raises:
        InputError: It is too large, or no picture.
    """
    if len(data) > MOST_UPLOAD:
        raise InputError(f"picture: has {len(data)} bytes, more than {MOST_UPLOAD}; make it smaller")
    size = image_size(data)
    if size is not None and size[0] * size[1] > MOST_UPLOADED:
        raise InputError(f"picture: is {size[1]} x {size[0]}, more than {MOST_UPLOADED} pixels; make it smaller")
    with _scratch("picture") as path:
        path.write_bytes(data)
        try:
            return read_rgb(path)
        except InputError as error:
            raise InputError(str(error).replace(str(path), "picture")) from None


def _written(name: str, write: Callable[[Path], None]) -> bytes:
    with _scratch(name) as path:
        write(path)
        return path.read_bytes()


@contextmanager
def _scratch(name: str) -> Iterator[Path]:
    """A place for a temporary file.

    Raises:
        InputError: There is no room for it.
    """
    try:
        with TemporaryDirectory() as folder:
            yield Path(folder) / name
    except OSError as error:
        reason = error.strerror or str(error)
        raise InputError(f"{name}: no temporary file can be written ({reason}); free some room or set TMPDIR") from None
