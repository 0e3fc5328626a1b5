"""Whether a scene and its views belong together: renderings against photographs, once, at a small size."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.io.world_transforms import moved_views, read_world_transform
from sgwarp.rendering.renderer import render
from sgwarp.scene import Camera, Gaussians, View

logger = logging.getLogger("sgwarp")
COMPARED = 4  # views, evenly spread
WIDTH = 96  # of the pictures [pixels]
LEAST = 0.4  # mean correlation from which on they match; a wrong frame has 0.0 to 0.25, a fitted scene 0.8 and more
CLEAR = 0.2  # by which another pairing has to be better before it is named
BESIDE = "dataparser_transforms.json"  # that nerfstudio leaves


@dataclass(frozen=True)
class Agreement:
    """How well renderings and photographs match.

    Attributes:
        correlation: Mean over the compared views of the correlation of rendering and photograph, -1 to 1; NaN if no
            view has a photograph.
        views: How many were compared.
        reordered: Correlation with the best other photograph in place of a view's own, mean over the views.
    """

    correlation: float
    views: int
    reordered: float

    @property
    def matches(self) -> bool:
        return not self.correlation < LEAST


def compare(gaussians: Gaussians, views: Sequence[View]) -> Agreement:
    """Render a few views and compare them with their photographs; ones that cannot be read are passed over."""
    chosen = [view for view in views if view.image_path is not None]
    chosen = [chosen[i * len(chosen) // COMPARED] for i in range(COMPARED)] if len(chosen) > COMPARED else chosen
    photographs, renderings = [], []
    for view in chosen:
        try:
            photograph = _small(view.image())
        except InputError:
            continue
        camera = view.camera.resized(photograph.shape[0], photograph.shape[1])
        renderings.append(_Rendering.of(gaussians, camera))
        photographs.append(photograph)
    if not photographs:
        return Agreement(float("nan"), 0, float("nan"))
    own = [a.correlation(b) for a, b in zip(renderings, photographs, strict=True)]
    others = [
        max((a.correlation(b) for j, b in enumerate(photographs) if j != i), default=-1.0)
        for i, a in enumerate(renderings)
    ]
    return Agreement(float(np.mean(own)), len(own), float(np.mean(others)))


@dataclass(frozen=True, eq=False)
class _Rendering:
    """A rendering over black, float32 [h, w, 3], and the share of the background in each pixel, float32 [h, w, 1]."""

    picture: NDArray[Any]
    clear: NDArray[Any]

    @classmethod
    def of(cls, gaussians: Gaussians, camera: Camera) -> _Rendering:
        picture = render(gaussians, camera).clamp(0, 1).cpu().numpy()
        alpha = render(gaussians, camera, "alpha").clamp(0, 1).cpu().numpy()
        return cls(picture, 1.0 - alpha[..., None])

    def correlation(self, photograph: NDArray[Any]) -> float:
        """With a photograph, -1 to 1; 0 where the scene is not seen at all.

        The rendering gets one background color, that of the photograph there: a scene may hold less than was
        photographed, and a trainer may have put any color behind it.
        """
        if self.picture.shape != photograph.shape:
            return -1.0
        weight = max(float(self.clear.sum()), 1e-6)
        behind = (photograph * self.clear).sum(axis=(0, 1)) / weight
        return float((_normalized(self.picture + self.clear * behind) * _normalized(photograph)).sum())


def find_placement(
    gaussians: Gaussians, scene: Path, views: Sequence[View], transform: Path | None = None
) -> NDArray[np.float64] | None:
    """The transform that takes the views into the world of the scene, float64 [4, 4], or None if they stay.

    Logs where they are moved by a file that nobody named, and where renderings and photographs do not match.

    Args:
        gaussians: The scene.
        scene: Its file. A dataparser_transforms.json beside it is tried where the views do not match as they are.
        views: Views of a data set, with photographs.
        transform: File of the transform (`read_world_transform`); then nothing else is tried.

    Raises:
        InputError: The transform cannot be read.
    """
    matrix = None if transform is None else read_world_transform(transform)
    if not len(gaussians):
        return matrix  # nothing can match
    matrix = _from_their_own_origin(gaussians, scene, views, matrix)
    found = compare(gaussians, views if matrix is None else moved_views(views, matrix))
    beside = scene.parent / BESIDE
    if not found.matches and transform is None and beside.is_file():
        tried = read_world_transform(beside)
        tried = tried if matrix is None else tried @ matrix
        better = compare(gaussians, moved_views(views, tried))
        if better.correlation > found.correlation + CLEAR:
            logger.warning(
                "%s: the views are moved by the transform in %s: renderings then match their photographs (correlation "
                "%.2f, %.2f without)",
                *(scene, beside.name, better.correlation, found.correlation),
            )
            return tried
    if not found.matches:
        _say(scene, found)
    return matrix


def _from_their_own_origin(
    gaussians: Gaussians, scene: Path, views: Sequence[View], matrix: NDArray[np.float64] | None
) -> NDArray[np.float64] | None:
    """The transform for a scene that was left in the coordinates of a country, where its views were moved from.

    A scene that sgwarp fitted lies near the origin, as its views do; that of another trainer may not.
    """
    means = gaussians.means.detach()[gaussians.finite].double().cpu().numpy()
    if not views or views[0].origin is None or not len(means):
        return matrix
    back = np.eye(4)
    back[:3, 3] = views[0].origin
    given = np.eye(4) if matrix is None else matrix
    middle = np.append(np.mean([view.camera.position.numpy() for view in views], axis=0), 1.0)
    moved, own = (np.linalg.norm((way @ middle)[:3] - np.median(means, axis=0)) for way in (given, given @ back))
    if moved <= own:
        return matrix
    logger.info("%s: lies far from the origin as the data set does; its views are moved back there", scene)
    return given @ back


def _say(scene: Path, found: Agreement) -> None:
    reason = "scene and views may be in different worlds (moved, turned, or in another unit)"
    remedy = "; --transform FILE takes the transform between them, such as nerfstudio's dataparser_transforms.json"
    if found.reordered > found.correlation + CLEAR and found.reordered >= LEAST:
        reason, remedy = "other photographs match better, so their order may be wrong", ""
    logger.warning(
        "%s: renderings and photographs do not match (correlation %.2f over %d views, where 1 is perfect and less than "
        "%.1f is chance): %s%s",
        *(scene, found.correlation, found.views, LEAST, reason, remedy),
    )


def _small(image: Tensor) -> NDArray[Any]:
    """At most WIDTH pixels wide, averaged, float32 [h, w, 3]."""
    height, width = image.shape[:2]
    w = min(WIDTH, width)
    h = max(1, round(height * w / width))
    resized = torch.nn.functional.interpolate(image.permute(2, 0, 1)[None], (h, w), mode="area")
    return np.asarray(resized[0].permute(1, 2, 0).numpy())


def _normalized(image: NDArray[Any]) -> NDArray[Any]:
    """Each channel with mean 0, together with norm 1; zero for a picture of one color. Exposure does not count."""
    centered = image - image.mean(axis=(0, 1))
    norm = float(np.sqrt((centered**2).sum()))
    return centered / norm if norm > 1e-3 * np.sqrt(centered.size) else np.zeros_like(centered)
