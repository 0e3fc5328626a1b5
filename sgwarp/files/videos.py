"""Videos that were written: OpenCV's writer says nothing where the disk is full."""

from __future__ import annotations

from pathlib import Path

from sgwarp.errors import InputError


def require_frames(where: str, path: Path, frames: int) -> None:
    """Refuse a video that lacks frames, as one does that the disk had no room for.

    Args:
        where: Name of the video in messages.
        path: The file, written and closed.
        frames: How many were written.

    Raises:
        InputError: There are fewer.
    """
    import cv2

    capture = cv2.VideoCapture(str(path))
    try:
        held = int(capture.get(cv2.CAP_PROP_FRAME_COUNT)) if capture.isOpened() else 0
    finally:
        capture.release()
    if held < frames:
        raise InputError(f"{where}: cannot be written ({held} of {frames} frames are there); make room on the disk")
