"""DEVA (Cheng et al., Tracking Anything with Decoupled Video Segmentation, 2023) through the files it writes.

    DIR/Annotations/{stem}.png   ids at every pixel, 0 = nothing; long ids are R + 256 G + 65536 B
    DIR/pred.json                {"annotations": [{"file_name": "{stem}.jpg", "segments_info": [{"id", "score", ...}]}]}

An id means the same thing in all views, so the maps are one-hot in the space "labels".
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from sgwarp.encoders.base import MapSource
from sgwarp.encoders.building import Request
from sgwarp.encoders.maps.files import FileMaps
from sgwarp.encoders.names import Member
from sgwarp.errors import InputError
from sgwarp.files.documents import read_json
from sgwarp.scene import FeatureMap, View


class DevaMaps(FileMaps):
    """Ids of DEVA as a MapSource.

    Args:
        folder: What DEVA was told to write into.
        views: The views that will be asked for.
        least_score: Segments that pred.json gives a smaller score in a view are left out there.

    Raises:
        InputError: A file is missing or damaged, or an id in a picture is none of pred.json's.
    """

    def __init__(self, folder: str | os.PathLike[str], views: Sequence[View], least_score: float = 0.0) -> None:
        root = Path(folder)
        pictures = root / "Annotations"
        if not pictures.is_dir():
            raise InputError(f"{root}: has no folder Annotations; give the folder that DEVA wrote into")
        inside = [path for path in pictures.iterdir() if path.is_dir()]
        if len(inside) == 1 and not any(pictures.glob("*.png")):  # one folder per video
            pictures = inside[0]
        self.predictions = root / "pred.json"
        self.segments = read_predictions(self.predictions)
        self.least_score = least_score
        super().__init__(pictures, views)

    def encode(self, view: View, image: Tensor | None = None) -> FeatureMap:
        """Ids of a view.

        Raises:
            MissingMap: The view has no picture.
            InputError: It cannot be read, or holds an id that pred.json does not list for it.
        """
        found = super().encode(view, image)
        listed = self.segments.get(view.stem)
        if listed is None:
            raise InputError(
                f"{self.predictions}: lists no frame {view.stem}, but {self.folder / view.stem}.png is there"
            )
        assert found.ids is not None
        assert found.labels is not None
        kept = torch.zeros(len(found.labels) + 1, dtype=torch.bool)  # the last entry is -1, nothing
        for channel in found.ids[found.ids >= 0].unique().tolist():
            label = int(found.labels[channel])
            if label not in listed:
                raise InputError(f"{self.predictions}: lists no segment {label} in frame {view.stem}, which shows it")
            kept[channel] = listed[label] >= self.least_score
        return FeatureMap(found.space, ids=torch.where(kept[found.ids.long()], found.ids, -1), labels=found.labels)


def read_predictions(path: Path) -> dict[str, dict[int, float]]:
    """Score of each segment of each frame, by the frame's stem; 1 where there is none.

    Raises:
        InputError: The file is missing or damaged.
    """
    try:
        content = read_json(path)
        return {Path(frame["file_name"]).stem: _scores(frame["segments_info"]) for frame in content["annotations"]}
    except InputError:
        raise
    except (ValueError, TypeError, KeyError, OverflowError, AttributeError) as error:
        raise InputError(f"{path}: is not the pred.json of DEVA, or is damaged ({error!r})") from None


def _scores(segments: Sequence[Mapping[str, Any]]) -> dict[int, float]:
    return {int(segment["id"]): float(segment.get("score", 1.0)) for segment in segments}


def make_source(member: Member, request: Request) -> MapSource:
    """The ids of the views that are asked for."""
    return DevaMaps(member.source.argument, request.views, **member.source.options)
