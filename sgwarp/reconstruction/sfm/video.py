"""Photographs from a video: the sharpest frame of every few."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import numpy as np

from sgwarp.errors import InputError
from sgwarp.runs.progress import Report

VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm")
WANTED = 150  # photographs of a video, unless the interval is given
SHORTEST = 3  # frames of which one is kept
SMALL = 480  # width at which sharpness is judged [pixels]
QUALITY = 95  # of the JPEGs


def is_video(path: Path) -> bool:
    """Whether a file is named like a video."""
    return path.is_file() and path.suffix.lower() in VIDEO_SUFFIXES


def extract_frames(video: Path, folder: Path, every: int | None = None, progress: Report | None = None) -> int:
    """Write the sharpest of every `every` frames as {number}.jpg; an existing folder is kept as it is.

    Sharpness is the variance of the Laplacian of a small gray copy.

    Args:
        video: What OpenCV can decode.
        folder: To write; it appears whole or not at all.
        every: Frames of which one is kept; if not given, so many that about 150 remain, and at least 3.
        progress: Called as `progress(done, total, text)`.

    Returns:
        How many photographs the folder holds.

    Raises:
        InputError: OpenCV cannot decode the video, or it holds fewer than 3 frames to keep.
    """
    import cv2

    if every is not None and every < 1:
        raise InputError(f"--every: expected at least 1, got {every}")
    if folder.is_dir():
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
    os.replace(partial, folder)
    return kept


def _sharpness(frame: np.ndarray) -> float:
    import cv2

    height, width = frame.shape[:2]
    factor = min(1.0, SMALL / width)
    gray = cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
    size = (max(1, round(factor * width)), max(1, round(factor * height)))
    small = cv2.resize(gray, size, interpolation=cv2.INTER_AREA)
    return float(cv2.Laplacian(small, cv2.CV_32F).var())
