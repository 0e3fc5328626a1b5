"""Features fused on points, and of each Gaussian those of its nearest point (OpenScene, Peng et al., 2023).

OpenScene fuses the pixels that a point projects to, over the views that see it, as the mean; sight is a depth test.
Here the points are the centers of the opaque Gaussians and the depth is rendered, as the scene has no sensor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch

from sgwarp.errors import InputError
from sgwarp.lifting.lifter import lift
from sgwarp.lifting.map_reader import Maps
from sgwarp.lifting.settings import LiftSettings
from sgwarp.runs.log import RunLog
from sgwarp.runs.progress import Report
from sgwarp.scene import Gaussians, Semantics, View

TOLERANCE = 0.25  # of OpenScene's depth test, relative
OPAQUE = 0.5  # least opacity of a Gaussian whose center is a point


def fuse_nearest_points(
    gaussians: Gaussians,
    views: Sequence[View],
    maps: Maps,
    *,
    tolerance: float = TOLERANCE,
    log: RunLog | None = None,
    progress: Report | None = None,
) -> Semantics:
    """Fuse maps on points and give every Gaussian the feature of its nearest fused point.

    Args:
        gaussians: The scene.
        views, maps: As of `lift`.
        tolerance: Relative depth tolerance of the sight test.
        log, progress: As of `lift`.

    Raises:
        InputError: As of `lift`, or SciPy is not installed.
    """
    try:
        from scipy.spatial import cKDTree
    except ImportError:
        raise InputError("nearest points need SciPy: pip install 'sgwarp[apps]'") from None
    settings = LiftSettings(tau=tolerance, border=0)
    fused = lift(gaussians, views, maps, "center", lift_settings=settings, progress=progress, log=log)
    points = (fused.seen & (gaussians.opacities.to(fused.weight.device) >= OPAQUE)).nonzero().flatten()
    finite = gaussians.finite.nonzero().flatten().to(points.device)
    if not len(points):
        raise InputError("no view sees an opaque Gaussian; there are no points to fuse on")
    log = log if log is not None else RunLog()
    with log.stage("nearest"):
        means = gaussians.means.detach().double().cpu().numpy()
        place = cKDTree(means[points.cpu().numpy()]).query(means[finite.cpu().numpy()])[1]
        nearest = torch.zeros(len(gaussians), dtype=torch.int64, device=points.device)
        nearest[finite] = points[torch.from_numpy(place).to(points.device)]
        known = torch.zeros(len(gaussians), dtype=torch.bool, device=points.device)
        known[finite] = True
    return replace(
        fused,
        features=torch.where(known[:, None], fused.features[nearest], 0.0),
        weight=torch.where(known, fused.weight[nearest], 0.0),
        effective_views=torch.where(known, fused.effective_views[nearest], 0.0),
    )
