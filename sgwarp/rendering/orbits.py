"""Cameras on a circle around a scene, for scenes that come without views."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.runs.isolation import isolated
from sgwarp.scene import Camera, Gaussians, View

FIELD_OF_VIEW = math.radians(50)  # along the shorter side of the image
ELEVATION = math.radians(15)  # of the cameras above the scene's centre
SHARE_IN_VIEW = 0.95  # of the Gaussians, by distance from the centre; stray ones lie far out
UP = {
    "y-down": (0.0, -1.0, 0.0),
    "y-up": (0.0, 1.0, 0.0),
    "z-up": (0.0, 0.0, 1.0),
    "z-down": (0.0, 0.0, -1.0),
}


@isolated
def orbit_views(gaussians: Gaussians, count: int, width: int, height: int, up: str = "y-down") -> list[View]:
    """Views on one turn around the scene, looking at the median of its centres, named orbit_000 and so on.

    Args:
        gaussians: The scene.
        count: Number of views.
        width: Width of the images [pixels].
        height: Height of the images [pixels].
        up: Direction of the scene's axes: "y-down" (OpenCV, most scenes from photographs), "y-up", "z-up", "z-down".

    Raises:
        InputError: No view is asked for, `up` is none of these, or no Gaussian is finite.
    """
    if count < 1:
        raise InputError(f"an orbit needs one view or more, got {count}")
    if up not in UP:
        raise InputError(f"up: '{up}' is not one of {', '.join(UP)}")
    means = gaussians.means[gaussians.finite].double().cpu()
    if not len(means):
        raise InputError("the scene holds no finite Gaussian to look at")
    centre = means.median(dim=0).values
    distances = (means - centre).norm(dim=1).sort().values
    radius = float(distances[int(SHARE_IN_VIEW * (len(distances) - 1))])
    distance = max(radius, 1e-6) / math.sin(FIELD_OF_VIEW / 2)
    focal = 0.5 * min(width, height) / math.tan(FIELD_OF_VIEW / 2)
    K = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]], dtype=torch.float64)
    upward = torch.tensor(UP[up], dtype=torch.float64)
    east = upward.roll(1)
    north = torch.linalg.cross(upward, east)
    views = []
    for index in range(count):
        turn = 2 * math.pi * index / count
        outward = math.cos(ELEVATION) * (math.cos(turn) * east + math.sin(turn) * north) + math.sin(ELEVATION) * upward
        pose = _looking_at(centre + distance * outward, -outward, upward)
        camera = Camera(K, pose, width, height, near=distance * 1e-3)
        views.append(View(f"orbit_{index:03d}", camera))
    return views


def _looking_at(position: Tensor, forward: Tensor, upward: Tensor) -> Tensor:
    """World-to-camera transform, float64 [4, 4], of a camera that looks along the unit vector `forward`."""
    right = torch.linalg.cross(forward, upward)
    right = right / right.norm()
    rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = rotation
    pose[:3, 3] = -rotation @ position
    return pose
