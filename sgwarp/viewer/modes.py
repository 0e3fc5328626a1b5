"""Pictures of a scene in every mode, from nothing but tensors and a camera."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sgwarp.ops.splatting.forward import rasterize
from sgwarp.querying.scoring import TextScores, best_texts
from sgwarp.querying.segmentation import KNOWN_OPACITY, splat_scores
from sgwarp.scene import Camera, Gaussians
from sgwarp.visualization.pictures import Picture, depth_picture, heat_map, overlay, to_picture

Mode = Literal["color", "depth", "opacity", "features", "relevancy", "segmentation", "instances", "coverage"]
MODES: tuple[Mode, ...] = get_args(Mode)
PAINTED = ("features", "instances", "coverage")  # modes that give every Gaussian a color of its own
HIGHLIGHT = (255, 140, 0)
TINT = 0.35  # share of the highlight inside a selection
BELOW = 0.3  # brightness of what scores less than the threshold, among several queries


@dataclass(frozen=True, eq=False)
class Shot:
    """Everything that a picture depends on but the camera.

    Attributes:
        gaussians: The scene.
        mode: What to show.
        paint: One color per Gaussian in [0, 1], float32 [N, 3], for the PAINTED modes.
        known: Gaussians that have a color in such a mode, bool [N].
        strength: Share of the paint over the scene's own colors, 0 to 1.
        scores: For relevancy and segmentation.
        colors: One per query, uint8 [Q, 3].
        threshold: Least score that counts as found.
        selected: What is outlined, bool [N], or None.
        background: Color behind the scene, in [0, 1].
        depth: Whether depth is wanted, for what a browser draws into the picture.
    """

    gaussians: Gaussians
    mode: Mode = "color"
    paint: Tensor | None = None
    known: Tensor | None = None
    strength: float = 1.0
    scores: TextScores | None = None
    colors: Picture = field(default_factory=lambda: np.zeros((0, 3), np.uint8))
    threshold: float = 0.5
    selected: Tensor | None = None
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    depth: bool = False


@dataclass(frozen=True, eq=False)
class Drawn:
    """A picture.

    Attributes:
        pixels: uint8 [H, W, 3].
        depth: z of the surface [world units], 0 for none, float32 [H, W]; None if it was not wanted.
    """

    pixels: Picture
    depth: NDArray[np.float32] | None = None


def draw(shot: Shot, camera: Camera) -> Drawn:
    """The picture of a shot as seen from a camera."""
    gaussians = shot.gaussians
    background = None
    if any(shot.background):
        background = torch.tensor(shot.background, dtype=torch.float32, device=gaussians.device)
    seen = rasterize(gaussians, camera, background=background, depth=shot.depth or shot.mode == "depth")
    depth = None if seen.depth is None else seen.depth.cpu().numpy()
    if shot.mode == "depth":
        pixels = depth_picture(depth)
    elif shot.mode == "opacity":
        pixels = to_picture(seen.alpha[..., None].expand(-1, -1, 3))
    else:
        pixels = _colored(shot, camera, to_picture(seen.features))
    if shot.selected is not None and bool(shot.selected.any()):
        pixels = _outlined(pixels, gaussians, camera, shot.selected)
    return Drawn(pixels, depth if shot.depth else None)


def _colored(shot: Shot, camera: Camera, picture: Picture) -> Picture:
    if shot.mode in PAINTED and shot.paint is not None:
        known = torch.ones(len(shot.paint), dtype=torch.bool) if shot.known is None else shot.known
        paint, enough = splat_scores(shot.gaussians, camera, shot.paint, known)
        share = torch.where(enough, shot.strength, 0.0)[..., None].cpu().numpy()
        return np.asarray((1 - share) * picture + share * to_picture(paint) + 0.5).astype(np.uint8)
    if shot.scores is None or shot.mode not in ("relevancy", "segmentation"):
        return picture
    if shot.mode == "segmentation":
        return overlay(picture, best_texts(shot.gaussians, camera, shot.scores).cpu().numpy(), shot.colors)
    means, enough = splat_scores(shot.gaussians, camera, shot.scores.values, shot.scores.seen)
    values = torch.where(enough[..., None], means, -torch.inf).cpu().numpy()
    if values.shape[2] == 1:
        heated = heat_map(picture, np.where(enough.cpu().numpy(), values[..., 0], np.nan), low=0.0, high=1.0)
        return np.where(_rim(values[..., 0] >= shot.threshold)[..., None], np.uint8(255), heated)
    return found_queries(picture, values, shot.colors, shot.threshold)


def found_queries(picture: Picture, values: NDArray[Any], colors: Picture, threshold: float) -> Picture:
    """Several queries at once: the best one of every pixel in its color, the stronger the better it fits.

    Args:
        picture: uint8 [H, W, 3].
        values: Scores, -inf where nothing is known, float [H, W, Q].
        colors: uint8 [Q, 3].
        threshold: Pixels whose best score is smaller are dimmed.
    """
    best = values.argmax(axis=2)
    score = np.take_along_axis(values, best[..., None], axis=2)
    strength = np.nan_to_num(0.35 + 0.5 * (score - threshold), neginf=0.0).clip(0.0, 0.85)
    found = (1 - strength) * picture + strength * colors[best]
    return np.asarray(np.where(score >= threshold, found, BELOW * picture) + 0.5).astype(np.uint8)


def _outlined(picture: Picture, gaussians: Gaussians, camera: Camera, selected: Tensor) -> Picture:
    """The picture with the selection tinted and a line around it."""
    share = rasterize(gaussians, camera, selected.to(gaussians.device, torch.float32)[:, None]).features[..., 0]
    inside = (share >= KNOWN_OPACITY).cpu().numpy()
    color = np.array(HIGHLIGHT, dtype=np.float32)
    tinted = np.where(inside[..., None], (1 - TINT) * picture + TINT * color, picture)
    return np.asarray(np.where(_rim(inside)[..., None], color, tinted) + 0.5).astype(np.uint8)


def _rim(inside: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Pixels that touch a region from outside, [H, W]."""
    import cv2

    region = inside.astype(np.uint8)
    return np.asarray(cv2.dilate(region, np.ones((3, 3), np.uint8)) > region)
