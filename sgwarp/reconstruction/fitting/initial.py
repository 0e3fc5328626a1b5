"""Initial Gaussians: at points from structure from motion, or at random inside the camera frusta."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.files.arrays import read_array
from sgwarp.files.images import read_ids
from sgwarp.ops.neighbors import mean_squared_neighbor_distance
from sgwarp.reconstruction.depth import SH_C0
from sgwarp.reconstruction.fitting.photographs import Photograph, camera_extent
from sgwarp.reconstruction.fitting.settings import FitSettings
from sgwarp.runs.seeds import generator
from sgwarp.scene import SH_COUNTS, Gaussians, View

OPACITY = {"default": 0.1, "mcmc": 0.5}  # of the reference implementations
SIZE = 1.0  # in root mean square distances to the three nearest others
RANDOM_SIZE = 0.35  # of random points: larger ones, right in front of a camera, would hide the scene from it
LEAST_DISTANCE = 1e-4  # [extent of the cameras], for points in the same place
VISIBLE = 1 / 255  # opacity from which on a Gaussian changes a pixel
LEAST_POINTS = 4  # that three neighbours need
RANDOM_COUNT = 50_000
NEAREST, FARTHEST = 0.2, 4.0  # of random points [extent of the cameras]
MILLIMETRE = 1e-3  # [m], the unit of depth images


def gaussians_from_points(
    positions: Any,
    colours: Any,
    settings: FitSettings,
    extent: float,
    device: str | torch.device = "cpu",
    size: float = SIZE,
) -> Gaussians:
    """A round Gaussian of SH degree 0 at every point, as large as the distance to its neighbours.

    Args:
        positions: [m], [N, 3]. Of more points than `settings.cap`, so many are drawn at random.
        colours: In [0, 1], [N, 3].
        extent: Of the cameras [m].
        size: Scale, in root mean square distances to the three nearest others.

    Raises:
        InputError: Fewer than 4 points or a cap below, one that is not finite, or colours that are not in [0, 1].
    """
    positions, colours = (t.detach().cpu() if isinstance(t, Tensor) else np.asarray(t) for t in (positions, colours))
    positions = torch.as_tensor(positions, dtype=torch.float64)
    colours = torch.as_tensor(colours, dtype=torch.float32)
    if positions.ndim != 2 or positions.shape[1] != 3 or colours.shape != positions.shape:
        raise InputError(f"points: expected [N, 3] twice, got {list(positions.shape)} and {list(colours.shape)}")
    if len(positions) < LEAST_POINTS:
        raise InputError(f"points: a scene starts from at least {LEAST_POINTS}, got {len(positions)}; or from none")
    if settings.cap < LEAST_POINTS:
        raise InputError(f"cap: a scene starts from at least {LEAST_POINTS} points, got {settings.cap}")
    for name, values in (("positions", positions), ("colours", colours)):
        if not bool(torch.isfinite(values).all()):
            row = int((~torch.isfinite(values)).any(dim=1).nonzero()[0])
            raise InputError(f"points: {name} of point {row} are not finite; leave it out")
    if not bool(((colours >= 0) & (colours <= 1)).all()):
        raise InputError(
            f"points: colours lie in {float(colours.min()):g} to {float(colours.max()):g}, not in [0, 1]; divide by 255"
        )
    if len(positions) > settings.cap:
        drawn = torch.randperm(len(positions), generator=generator(settings.seed, 0, "points"))[: settings.cap]
        kept = drawn.sort().values
        positions, colours = positions[kept], colours[kept]
    distance = mean_squared_neighbor_distance(positions).sqrt().clamp(min=LEAST_DISTANCE * extent)
    count = len(positions)
    gaussians = Gaussians(
        means=positions.to(torch.float32),
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(count, 4),
        scales=(size * distance)[:, None].expand(count, 3),
        opacities=torch.full((count,), OPACITY[settings.strategy]),
        sh=((colours - 0.5) / SH_C0)[:, None, :],
    )
    return gaussians.to(device)


def random_points(
    photographs: Sequence[Photograph], views: Sequence[View], settings: FitSettings
) -> tuple[Tensor, Tensor]:
    """Points at random pixels and distances in front of the cameras, with the colours of these pixels.

    Distances are spread evenly by their logarithm.

    Returns:
        Positions [m], float64 [N, 3], and colours in [0, 1], float32 [N, 3].
    """
    extent = camera_extent(views)
    count = min(settings.cap, RANDOM_COUNT)
    random = generator(settings.seed, 0, "random points")
    positions, colours = [], []
    for index, photograph in enumerate(photographs):
        share = (count + len(photographs) - 1 - index) // len(photographs)  # they add up to `count`
        camera = photograph.camera
        u, v, w = torch.rand(3, share, generator=random, dtype=torch.float64)
        x, y = u * camera.width, v * camera.height
        depth = extent * NEAREST * (FARTHEST / NEAREST) ** w
        rays = torch.stack([x, y, torch.ones_like(x)], dim=1) @ torch.linalg.inv(camera.K).T
        positions.append((rays * depth[:, None]) @ camera.world_to_camera[:3, :3] + camera.position)
        colours.append(photograph.image().cpu()[y.long(), x.long()])
    return torch.cat(positions), torch.cat(colours)


def adapted(gaussians: Gaussians, settings: FitSettings) -> Gaussians:
    """A scene that exists already, as a fit can start from it.

    Raises:
        InputError: It is empty or larger than the cap, holds NaN or infinity, or is transparent throughout.
    """
    if not len(gaussians):
        raise InputError("the scene to start from holds no Gaussians")
    if len(gaussians) > settings.cap:
        raise InputError(f"the scene to start from has {len(gaussians)} Gaussians, more than the cap {settings.cap}")
    if gaussians.non_finite:
        raise InputError(f"{gaussians.non_finite} Gaussians to start from hold NaN or infinity; remove them first")
    if not bool((gaussians.opacities > VISIBLE).any()):
        raise InputError(
            f"all Gaussians to start from are below an opacity of {VISIBLE:.4f}: no photograph would move them"
        )
    return replace(gaussians, sh=gaussians.sh[:, : SH_COUNTS[settings.sh_degree]])


def depth_from_folder(folder: Path) -> Callable[[View], Any]:
    """Depth of a view [m], [H, W], 0 where there is none: {stem}.npy in metres or {stem}.png in millimetres.

    What is returned raises InputError if there is neither, or it cannot be read.
    """

    def depth(view: View) -> Any:
        numbers = folder / f"{view.stem}.npy"
        if not numbers.is_file():
            return read_ids(folder / f"{view.stem}.png").astype(np.float32) * np.float32(MILLIMETRE)
        return read_array(numbers)

    return depth
