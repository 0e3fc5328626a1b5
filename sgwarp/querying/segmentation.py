"""Scores rendered into a view: segmentation and localization.

The few score channels are splatted, never the features themselves. Gaussians that no view saw hide what lies behind
them but have no say; a pixel where they prevail is unknown.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from sgwarp.encoders.base import TextEncoder
from sgwarp.encoders.calibration import Scoring
from sgwarp.errors import InputError
from sgwarp.ops.splatting.forward import rasterize
from sgwarp.ops.splatting.settings import RasterSettings
from sgwarp.querying.ensembles import Ensemble, seen_by
from sgwarp.querying.scores import class_votes
from sgwarp.runs.isolation import isolated
from sgwarp.scene import Camera, Gaussians, Semantics

UNKNOWN = 255  # label of a pixel that no class can claim
BOX = 9  # side of the box over which a query's scores are averaged before the best pixel is taken [pixels]
KNOWN_OPACITY = 0.5  # least opacity that seen Gaussians must add up to at a pixel


@isolated
def splat_scores(
    gaussians: Gaussians,
    camera: Camera,
    scores: Tensor,
    seen: Tensor,
    settings: RasterSettings | None = None,
) -> tuple[Tensor, Tensor]:
    """Scores as seen from a camera.

    Args:
        gaussians: The scene.
        camera: The view.
        scores: One row per Gaussian, [N, Q].
        seen: Gaussians that have a score, bool [N]; the others only hide.
        settings: Thresholds of the rasterizer.

    Returns:
        mean: Mean score of the seen Gaussians at a pixel under the blending weights, float32 [H, W, Q].
        known: Whether their opacities add up to KNOWN_OPACITY, bool [H, W].
    """
    if scores.ndim != 2 or len(scores) != len(gaussians) or seen.shape != scores.shape[:1]:
        shapes = f"scores {list(scores.shape)}, seen {list(seen.shape)}"
        raise InputError(f"expected scores [N, Q] and seen [N] for N = {len(gaussians)} Gaussians, got {shapes}")
    share = seen.to(gaussians.device, torch.float32)[:, None]
    channels = torch.cat([scores.to(share) * share, share], dim=1)
    blended = rasterize(gaussians, camera, channels, settings=settings or RasterSettings()).features
    opacity = blended[..., -1:]
    known = opacity[..., 0] >= KNOWN_OPACITY
    return blended[..., :-1] / torch.where(opacity > 0, opacity, 1.0), known


@isolated
def segment(
    gaussians: Gaussians,
    semantics: Semantics,
    classes: Sequence[str] | None,
    camera: Camera,
    encoder: TextEncoder | None = None,
    *,
    temperature: float | None = None,
    scoring: Scoring | None = None,
    unknown_below: float = 0.0,
    predicted: Semantics | None = None,
    ensemble: Ensemble = "max",
    settings: RasterSettings | None = None,
) -> tuple[Tensor, Tensor]:
    """Segment a view: the class of every pixel.

    Args:
        gaussians: The scene.
        semantics: Its lifted semantics.
        classes: Names of the classes, at most 255. None for lifted label or id images: the answer then is their ids.
        camera: The view.
        encoder: Text encoder of the semantics' space; not needed for lifted label or id images.
        temperature: Of the softmax over the classes, per Gaussian, before they are splatted; see `class_votes`.
        scoring: "evidence" and "relevancy" leave unknown what fits no class, "cosine" gives every pixel a class; None
            for what the encoder is calibrated for; see `class_votes`.
        unknown_below: Pixels whose best class has a smaller confidence are unknown, in [0, 1].
        predicted: Semantics that the network predicts for the scene, to be asked together with the lifted ones.
        ensemble: How the two become one, see `combine`; one of them alone answers where only it knows a Gaussian.
        settings: Thresholds of the rasterizer.

    Returns:
        labels: Index into `classes` and 255 where unknown, or without classes the ids themselves and 0 where unknown,
            int64 [H, W].
        confidence: Share of each class, or lifted id, in what is seen at the pixel, float32 [H, W, Q].

    Raises:
        InputError: The semantics belong to another scene, the encoder to another space, a class is not among the
            lifted labels, there are no or too many classes, or no encoder where one is needed.
    """
    semantics.require_scene(gaussians)
    if classes is not None and len(classes) > UNKNOWN:
        raise InputError(f"classes: at most {UNKNOWN} at a time, got {len(classes)}")
    votes = class_votes(semantics, classes, encoder, temperature, scoring, predicted=predicted, ensemble=ensemble)
    seen = seen_by(semantics, predicted, ensemble)
    channel, confidence = segment_votes(gaussians, camera, votes, seen, unknown_below=unknown_below, settings=settings)
    return label_image(channel, semantics if classes is None else None), confidence


def segment_votes(
    gaussians: Gaussians,
    camera: Camera,
    votes: Tensor,
    seen: Tensor,
    *,
    unknown_below: float = 0.0,
    settings: RasterSettings | None = None,
) -> tuple[Tensor, Tensor]:
    """`segment` from the votes of the Gaussians [N, Q], which are the same for every view.

    A Gaussian's votes add up to 1 or less; what is missing went to none of the columns, and a pixel where it outweighs
    the best column is unknown.

    Returns:
        channel: Column of `votes` with the largest share, -1 where unknown (a share of 0 never wins), int64 [H, W].
        confidence: Share of each column in what is seen at the pixel, float32 [H, W, Q].
    """
    confidence, known = splat_scores(gaussians, camera, votes, seen, settings)
    best, channel = confidence.max(dim=2)
    elsewhere = 1.0 - confidence.sum(dim=2)
    wins = known & (best > 0) & (best >= elsewhere) & (best >= unknown_below)
    return torch.where(wins, channel, -1), confidence


def label_image(channel: Tensor, lifted: Semantics | None = None) -> Tensor:
    """Channels as written to a label image, int64 [H, W].

    Args:
        channel: Index of the class at every pixel, -1 where unknown, int64 [H, W].
        lifted: Semantics of lifted label or id images: then the ids of those images are restored, 0 where unknown.
            Without them the index stays, and 255 is unknown.

    Raises:
        InputError: The lifted labels are no ids.
    """
    if lifted is None:
        return torch.where(channel >= 0, channel, UNKNOWN)
    names = lifted.labels or ()
    if not all(name.isdecimal() for name in names):
        raise InputError(f"the lifted labels are names, not ids; choose classes among: {', '.join(names)}")
    ids = torch.tensor([*map(int, names), 0], device=channel.device)
    return ids[channel]  # -1 is the last entry


@isolated
def localize(
    scores: Tensor,
    gaussians: Gaussians,
    camera: Camera,
    *,
    seen: Tensor | None = None,
    box: int = 1,
    settings: RasterSettings | None = None,
) -> tuple[tuple[int, int], Tensor]:
    """Localize a query: the pixel of a view with the best score.

    Args:
        scores: Of one query, [N].
        gaussians: The scene.
        camera: The view.
        seen: Gaussians that have a score, bool [N]; all of them if None.
        box: Side of the box that the score map is averaged over before the best pixel is taken; 1 leaves it as it is.
        settings: Thresholds of the rasterizer.

    Returns:
        pixel: (x, y) of the best pixel, column and row.
        score_map: float32 [H, W], -inf where nothing is known.

    Raises:
        InputError: scores has another shape, or nothing is known anywhere in the view.
    """
    if scores.ndim != 1 or box < 1:
        raise InputError(f"expected scores [N] and a box of 1 pixel or more, got {list(scores.shape)} and {box}")
    seen = torch.ones_like(scores, dtype=torch.bool) if seen is None else seen
    mean, known = splat_scores(gaussians, camera, scores[:, None], seen, settings)
    if not bool(known.any()):
        raise InputError("localize: the view shows no Gaussian that has a score; choose another view")
    score_map = torch.where(known, box_mean(mean[..., 0], known, box), -torch.inf)
    y, x = divmod(int(score_map.argmax()), camera.width)
    return (x, y), score_map


def box_mean(image: Tensor, known: Tensor, side: int) -> Tensor:
    """Mean over the known pixels of the `side` x `side` box around each pixel; 0 if there are none, float32 [H, W]."""
    pair = torch.stack([torch.where(known, image, 0.0), known.to(image)]).double()
    for axis in (1, 2):  # sums of a box are differences of running sums: the cost does not depend on its side
        size = pair.shape[axis]
        place = torch.arange(size, device=image.device) - (side - 1) // 2
        running = torch.cat([torch.zeros_like(pair.narrow(axis, 0, 1)), pair.cumsum(axis)], dim=axis)
        first, last = place.clamp(0, size), (place + side).clamp(0, size)
        pair = running.index_select(axis, last) - running.index_select(axis, first)
    total, count = pair
    count = count.round()
    return (total / torch.where(count > 0, count, 1.0)).to(torch.float32)
