"""Photographs from a video: the sharpest frame of every few."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from sgwarp.errors import InputError
from sgwarp.files.access import reading
from sgwarp.files.documents import read_json
from sgwarp.files.inputs import own_files
from sgwarp.runs.progress import Report

VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm")
WANTED = 150  # photographs of a video, unless the interval is given
SHORTEST = 3  # frames of which one is kept
SMALL = 480  # width at which sharpness is judged [pixels]
QUALITY = 95  # of the JPEGs
NOTES = "frames.json"  # beside the frames: what they were taken from


def is_video(path: Path) -> bool:
    """Whether a file is named like a video."""
    return path.is_file() and path.suffix.lower() in VIDEO_SUFFIXES


def extract_frames(video: Path, folder: Path, every: int | None = None, progress: Report | None = None) -> int:
    """Write the sharpest of every `every` frames as {number}.jpg.

    A folder of frames of the same video and interval is kept as it is; frames of another are replaced. Sharpness
    is the variance of the Laplacian of a small gray copy.

    Args:
        video: What OpenCV can decode.
        folder: To write; it appears whole or not at all.
        every: Frames of which one is kept; if not given, so many that about 150 remain, and at least 3.
        progress: Called as `progress(done, total, text)`.

    Returns:
        How many photographs the folder holds.

    Raises:
        InputError: OpenCV cannot decode the video, it holds fewer than 3 frames to keep, or the folder holds something
            else than such frames.
    """
    import cv2

    if every is not None and every < 1:
        raise InputError(f"--every: expected at least 1, got {every}")
    origin = _origin(video, every)
    if os.path.lexists(folder):
        known = _read_origin(folder)
        if known is None:
            raise InputError(f"{folder}: is there already, and holds no frames of a video; choose another --out")
        if known == origin:
            return len(list(folder.glob("*.jpg")))
    report = progress or (lambda done, total, text: None)
    capture = cv2.VideoCapture(str(video))
    try:
        total = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
        every = every or max(SHORTEST, total // WANTED)
        partial = folder.with_name(f".{folder.name}.partial")
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir(parents=True)
        number, kept, best, sharpest = 0, 0, None, -1.0
        while True:
            read, frame = capture.read()
            if read:
                value = _sharpness(frame)
                if value > sharpest:
                    best, sharpest = frame, value
                number += 1
            if best is not None and (not read or number % every == 0):
                cv2.imwrite(str(partial / f"{kept:05d}.jpg"), best, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
                kept, best, sharpest = kept + 1, None, -1.0
                report(number, max(total, number), "reading the video")
            if not read:
                break
    finally:
        capture.release()
    if kept < SHORTEST:
        shutil.rmtree(partial)
        raise InputError(f"{video}: {number} frames can be read, of which {kept} remain; convert it with ffmpeg")
    (partial / NOTES).write_text(json.dumps(origin) + "\n", encoding="utf-8")
    shutil.rmtree(folder, ignore_errors=True)
    os.replace(partial, folder)
    return kept


def _origin(video: Path, every: int | None) -> dict[str, Any]:
    """What tells frames of one video and interval from those of others."""
    with reading(video):
        facts = video.stat()
    return {"video": video.name, "bytes": facts.st_size, "changed": facts.st_mtime_ns, "every": every}


def _read_origin(folder: Path) -> dict[str, Any] | None:
    """What the frames in a folder were taken from, or None if nothing tells."""
    try:
        with own_files():
            notes = read_json(folder / NOTES)
    except InputError:
        return None
    return notes if isinstance(notes, dict) else None


def _sharpness(frame: np.ndarray) -> float:
    import cv2

    gray = cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
    height, width = gray.shape
    if width > SMALL:
        gray = cv2.resize(gray, (SMALL, max(1, round(SMALL * height / width))), interpolation=cv2.INTER_AREA)
    return float(cv2.Laplacian(gray, cv2.CV_32F).var())
