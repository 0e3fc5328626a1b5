"""What an interrupted run needs to go on, and the features of every frame, stored only where they change."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sgwarp.apps.tracking.fusion import Evidence, Fusion
from sgwarp.apps.tracking.sources import LabelFrames
from sgwarp.apps.tracking.tracker import TrackedFrame, Tracker
from sgwarp.errors import InputError
from sgwarp.files.arrays import read_arrays
from sgwarp.files.atomic import atomic_path
from sgwarp.files.inputs import own_files
from sgwarp.files.torch_files import load_torch, save_torch

FORMAT = 1
STATE = "state.pt"
STORED_CHANGE = 0.01  # a stored feature is replaced where a channel moved by more than this share of its length


def save_state(folder: Path, tracker: Tracker, frame: int, settings: dict[str, Any], channels: Tensor) -> None:
    """Write the evidence after a frame, whole or not at all."""
    evidence = tracker.fusion.evidence if tracker.fusion is not None else None
    content: dict[str, Any] = {"format": FORMAT, "frame": frame, "settings": settings, "channels": channels}
    content |= {"space": tracker.space, "labels": list(tracker.labels) if tracker.labels is not None else None}
    if isinstance(tracker.source, LabelFrames):
        content["met"] = list(tracker.source.growing.labels)
    if evidence is not None:
        content["evidence"] = dict(vars(evidence))
    save_torch(folder / STATE, content)


def load_state(folder: Path, tracker: Tracker, settings: dict[str, Any]) -> tuple[int, Tensor] | None:
    """Put the evidence of an earlier run back; returns its last frame and the objects of its Gaussians, or None.

    Raises:
        InputError: The file is damaged, or belongs to a run with other settings.
    """
    path = folder / STATE
    if not path.is_file():
        return None
    try:
        with own_files():
            content = load_torch(path)
        if content["format"] != FORMAT:
            raise InputError(f"{path}: is of format {content['format']}, this version knows {FORMAT}; start anew")
        frame, stored, channels = int(content["frame"]), content["settings"], content["channels"]
        evidence = Evidence(**content["evidence"]) if "evidence" in content else None
        space, labels = str(content["space"]), content["labels"]
    except InputError:
        raise
    except (RuntimeError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: is damaged ({type(error).__name__}); start anew without --resume") from None
    for name in sorted({*stored, *settings}):
        if stored.get(name) != settings.get(name):
            values = f"{stored.get(name)!r}, now {settings.get(name)!r}"
            raise InputError(f"{path}: the interrupted run had {name} {values}; start anew without --resume")
    tracker.space, tracker.labels = space, None if labels is None else tuple(labels)
    if isinstance(tracker.source, LabelFrames):
        tracker.source = LabelFrames(tracker.source.folder, tuple(content.get("met", ())))
    tracker.fusion = Fusion(tracker.settings.fusion, labels is not None)
    tracker.fusion.evidence = evidence
    return frame, channels


class FeatureStore:
    """Features of every frame in half precision, one file per frame with the rows that changed.

    A row is written again where one of its channels differs from the stored one by more than a hundredth of the row's
    length, or where it is seen for the first time or no longer.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._stored: Tensor | None = None  # float16 [N, C]
        self.rows = 0  # written so far
        self.all_rows = 0  # without leaving any out

    def resume(self, frame: int) -> None:
        """Go on behind a frame that was stored."""
        self._stored = torch.from_numpy(read_features(self.folder, frame))

    def write(self, tracked: TrackedFrame) -> None:
        """Store a frame."""
        now = torch.where(tracked.weight[:, None] > 0, tracked.features, 0.0).cpu()
        known = self._stored
        whole = known is None or known.shape != now.shape
        if known is None or whole:
            rows = torch.arange(len(now))
        else:
            distance = (now - known.float()).abs().amax(dim=1) if now.shape[1] else torch.zeros(len(now))
            rows = (distance > STORED_CHANGE * now.norm(dim=1)).nonzero().flatten()
        half = now[rows].to(torch.float16)
        if known is None or whole:
            self._stored = half
        else:
            known[rows] = half
        self.rows += len(rows)
        self.all_rows += len(now)
        index = rows.to(torch.int32).numpy()
        with atomic_path(self.folder / f"{tracked.index:05d}.npz") as temporary:
            shape = np.array(now.shape)
            np.savez(temporary, shape=shape, whole=np.array(whole), rows=index, features=half.numpy())


def read_features(folder: Path, frame: int) -> Any:
    """Features of a frame from what `FeatureStore` wrote, float16 [N, C]; 0 where nothing is known.

    Raises:
        InputError: A file of this frame or one before is missing or damaged.
    """
    found: Any = None
    for index in range(frame + 1):
        path = folder / f"{index:05d}.npz"
        try:
            stored = read_arrays(path)
            shape, rows, features = tuple(stored["shape"].tolist()), stored["rows"], stored["features"]
            if bool(stored["whole"]):
                # A whole frame lists every row, so it cannot claim more than it holds.
                found = np.zeros(shape, np.float16) if (len(rows), *features.shape[1:]) == shape else None
            if found is None or not _are_rows(rows, len(found)):
                raise InputError(f"{path}: is damaged (its rows do not fit its frame); track again")
            found[rows] = features
        except InputError:
            raise
        except (ValueError, KeyError, IndexError, TypeError, EOFError, OverflowError) as error:
            raise InputError(f"{path}: is damaged ({type(error).__name__}); track again") from None
    return found


def _are_rows(rows: Any, count: int) -> bool:
    whole = rows.ndim == 1 and rows.dtype.kind in "iu"
    return bool(whole and (rows.size == 0 or (rows.min() >= 0 and rows.max() < count)))
