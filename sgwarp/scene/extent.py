"""How far cameras reach, to which everything that has a length is relative: a unit then makes no difference."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch

from sgwarp.scene.camera import Camera
from sgwarp.scene.gaussians import Gaussians
from sgwarp.scene.view import View

EXTENT_MARGIN = 1.1  # of the reference implementation of 3DGS
ONE_PLACE = 1e-9  # radius that counts as none [distance of the cameras from the origin, or 1 where they are at it]
NEAR_SHARE = 0.01  # near plane [extent, or distance to the next camera times STEPS where that is smaller]
STEPS = 10.0
LEAST_FAR = 1e4  # far plane [extent]


def camera_extent(views: Sequence[View]) -> float:
    """Radius of the cameras around their centre [world units], a tenth wider; 1 if all are in one place."""
    radius = _radius(views)
    return EXTENT_MARGIN * radius if radius else 1.0


def _radius(views: Sequence[View]) -> float:
    """Largest distance of a camera from their centre [world units]; 0 if it is nothing but rounding."""
    places = torch.stack([view.camera.position for view in views])
    center = places.mean(dim=0)
    radius = float((places - center).norm(dim=1).max())
    return radius if radius > ONE_PLACE * float(center.norm()) and radius > 0 else 0.0


def near_plane(views: Sequence[View]) -> float | None:
    """Depth from which on to render [world units]: a hundredth of the extent, less in a long walk of small steps.

    None if all cameras are in one place, which says nothing of the unit.
    """
    if not _radius(views):
        return None
    places = torch.stack([view.camera.position for view in views])
    apart = torch.cdist(places - places.mean(dim=0), places - places.mean(dim=0))
    extent = camera_extent(views)
    apart[apart < ONE_PLACE * extent] = float("inf")
    step = float(apart.amin(dim=1).median())
    return NEAR_SHARE * min(extent, STEPS * step)


def with_near_plane(views: Sequence[View]) -> list[View]:
    """The views with near and far planes that fit their unit."""
    near = near_plane(views) if views else None
    if near is None:
        return list(views)
    far = LEAST_FAR * camera_extent(views)
    return [replace(view, camera=replace(view.camera, near=near, far=max(view.camera.far, far))) for view in views]


def with_near_plane_of(views: Sequence[View], gaussians: Gaussians) -> list[View]:
    """The views, with nearer near planes where they have the default one and the scene is small.

    Cameras in one place, or one alone, say nothing of the unit: then the distance of the scene does.
    """
    means = gaussians.means.detach()[gaussians.finite].double().cpu()
    if not len(means) or all(view.camera.near != Camera.near for view in views):
        return list(views)
    moved = []
    for view in views:
        near = NEAR_SHARE * float((means - view.camera.position).norm(dim=1).median())
        if view.camera.near == Camera.near and 0 < near < Camera.near:
            view = replace(view, camera=replace(view.camera, near=near))
        moved.append(view)
    return moved
