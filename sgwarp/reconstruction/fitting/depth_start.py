"""Depth that a fit starts from: views without any, and units that do not fit the poses."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from sgwarp.errors import InputError
from sgwarp.reconstruction.depth_unit import measure_depth_unit, shrink_depth
from sgwarp.reconstruction.fitting.belongings import OfView
from sgwarp.scene import Camera, View
from sgwarp.scene.extent import camera_extent

logger = logging.getLogger("sgwarp")
LEAST_AGREEMENT = 0.4  # of the points that fall into other views, for depth to be believed


def usable_depth(source: str, depth_of: Callable[[View], Any], views: Sequence[View]) -> OfView:
    """Depth of views in the unit of their poses; a view whose depth is missing or damaged has none, with a notice.

    Args:
        source: Where the depth comes from, for messages.
        depth_of: Depth of a view, [H, W]; raises InputError for those without.
        views: The views, with their poses.

    Returns:
        Depth of a view [world units], float32 [H, W], 0 where there is none.

    Raises:
        InputError: No view has depth, or the views contradict each other on it in any unit.
    """
    failed: list[InputError] = []
    small: list[Any] = []
    cameras: list[Camera] = []
    for view in views:
        depth = _read(depth_of, view, failed)
        depth = np.where(np.isfinite(depth) & (depth > 0), depth, 0)
        shrunk, camera = shrink_depth(depth, view.camera)
        small.append(shrunk)
        cameras.append(camera)
    if len(failed) == len(views):
        raise failed[0]
    if failed:
        logger.warning("%s: %d of %d views have no depth, first: %s", source, len(failed), len(views), failed[0])
    factor = _factor(source, small, cameras, camera_extent(views))
    return lambda view: np.asarray(_read(depth_of, view, []), np.float32) * np.float32(factor)


def _read(depth_of: Callable[[View], Any], view: View, failed: list[InputError]) -> Any:
    try:
        return np.asarray(depth_of(view))
    except InputError as error:
        failed.append(error)
        return np.zeros(view.camera.size, np.float32)


def _factor(source: str, depths: Sequence[Any], cameras: Sequence[Camera], extent: float) -> float:
    """What the depth has to be multiplied by to fit the poses."""
    found = measure_depth_unit(depths, cameras, extent)
    if found is None:
        logger.warning("%s: too little of one view shows in others to check the unit of the depth", source)
        return 1.0
    if found.agreement < LEAST_AGREEMENT:
        raise InputError(
            f"{source}: the views contradict each other: in no unit more than {found.agreement:.0%} of their points "
            "lie on the surfaces that others see; correct the depth or the poses, or start without depth"
        )
    if found.factor == 1:
        return 1.0
    logger.warning(
        "%s: depth and poses are in different units: at %.5g times the depth %.0f %% of the points of a view lie on "
        "the surfaces that others see, as given %.0f %%; the depth is multiplied by it",
        *(source, found.factor, 100 * found.agreement, 100 * found.as_given),
    )
    return found.factor
