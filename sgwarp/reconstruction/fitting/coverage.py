"""What cameras and points are like before a fit, and which Gaussians no camera can see after it."""

from __future__ import annotations

import logging
from collections.abc import Sequence

import torch
from torch import Tensor

from sgwarp.reconstruction.fitting.frame import Frame
from sgwarp.reconstruction.fitting.photographs import Photograph
from sgwarp.scene import Camera, Gaussians

logger = logging.getLogger("sgwarp")
REACH = 3.0  # standard deviations of a Gaussian that count as its footprint
WELL_SEEN = 3  # photographs that show a point
COUNTED = 5000  # points that the summary looks at
LEAST_PARALLAX = 2.0  # median angle under which cameras see points [degrees]; less leaves their depth open


def report_start(photographs: Sequence[Photograph], means: Tensor, frame: Frame) -> None:
    """Log one line on the cameras and one on the points, and warn where cameras are too close together.

    Args:
        photographs: With cameras in the frame of the fit.
        means: Where the fit starts [units of the frame], [N, 3].
        frame: Of the fit.
    """
    places = torch.stack([photograph.camera.position for photograph in photographs])
    apart = torch.cdist(places, places).fill_diagonal_(float("inf")).amin(dim=1).median()
    sizes = sorted({(p.camera.width, p.camera.height) for p in photographs})
    size = " to ".join(f"{w} x {h}" for w, h in (sizes[:1] if len(sizes) == 1 else (sizes[0], sizes[-1])))
    logger.info(
        "cameras: %d photographs of %s, within %.3g world units of their center, the next one %.3g away",
        *(len(photographs), size, frame.scale, float(apart) * frame.scale),
    )
    chosen = means[:: max(1, len(means) // COUNTED)].to(torch.float64).cpu()
    seen = torch.stack([in_view(photograph.camera, chosen) for photograph in photographs], dim=1)
    counts = seen.sum(dim=1)
    depth = torch.linalg.vector_norm(chosen[:, None] - places[None], dim=2)
    typical = float(depth[seen].median()) * frame.scale if bool(seen.any()) else float("nan")
    parallax = float(_parallax(chosen, places, seen).median())
    logger.info(
        "points: %s to start from, %.0f %% in view of %d or more photographs; medians: distance %.3g, parallax %.0f "
        "degrees",
        *(f"{len(means):,}", 100 * float((counts >= WELL_SEEN).float().mean()), WELL_SEEN, typical, parallax),
    )
    if parallax < LEAST_PARALLAX:
        logger.warning("cameras: they are so close together that depth is hardly known; move more between photographs")


def _parallax(points: Tensor, places: Tensor, seen: Tensor) -> Tensor:
    """Angle between the mean direction to the cameras that see a point and the one farthest off, doubled [degrees]."""
    directions = torch.nn.functional.normalize(places[None] - points[:, None], dim=2)
    mean = torch.nn.functional.normalize((directions * seen[..., None]).sum(dim=1), dim=1)
    cosines = (directions * mean[:, None]).sum(dim=2).masked_fill(~seen, 1.0)
    return 2 * torch.rad2deg(torch.arccos(cosines.amin(dim=1).clamp(-1, 1)))


def in_view(camera: Camera, points: Tensor, radii: Tensor | None = None) -> Tensor:
    """Which points lie in the image, or reach into it by their radius, bool [N].

    Args:
        camera: The camera.
        points: [N, 3].
        radii: [N], or None for zero.
    """
    pose, K = camera.world_to_camera.to(points), camera.K.to(points)
    seen = points @ pose[:3, :3].T + pose[:3, 3]
    depth = seen[:, 2]
    inside = (depth > camera.near) & (depth < camera.far)
    for axis, size in ((0, camera.width), (1, camera.height)):
        pixels = K[axis, axis] * seen[:, axis] / depth + K[axis, 2]
        margin = 0.0 if radii is None else K[axis, axis] * radii / depth
        inside &= (pixels >= -margin) & (pixels <= size + margin)
    return inside


def seen_by_any(gaussians: Gaussians, cameras: Sequence[Camera]) -> Tensor:
    """Gaussians whose footprint reaches into the image of one of the cameras, bool [N]."""
    radii = REACH * gaussians.scales.amax(dim=1)
    seen = torch.zeros(len(gaussians), dtype=torch.bool, device=gaussians.device)
    for camera in cameras:
        seen |= in_view(camera, gaussians.means, radii)
    return seen
