"""Initial Gaussians: at points from structure from motion, on surfaces where photographs agree, or at random."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.ops.neighbors import mean_squared_neighbor_distance
from sgwarp.reconstruction.depth import SH_C0, gaussians_from_depth
from sgwarp.reconstruction.fitting.belongings import depth_from_folder as depth_from_folder
from sgwarp.reconstruction.fitting.photographs import Photograph
from sgwarp.reconstruction.fitting.settings import FitSettings
from sgwarp.reconstruction.stereo import estimate_depth
from sgwarp.runs.progress import Report
from sgwarp.runs.seeds import generator
from sgwarp.scene import SH_COUNTS, Gaussians, View, join_gaussians

logger = logging.getLogger("sgwarp")
OPACITY = {"default": 0.1, "mcmc": 0.5}  # of the reference implementations
SIZE = 1.0  # in root mean square distances to the three nearest others
RANDOM_SIZE = 0.35  # of points anywhere: larger ones, right in front of a camera, would hide the scene from it
LEAST_DISTANCE = 1e-4  # [extent of the cameras], for points in the same place
VISIBLE = 1 / 255  # opacity from which on a Gaussian changes a pixel
LEAST_POINTS = 4  # that three neighbours need
RANDOM_COUNT = 50_000
LEAST_CERTAIN = 500  # depths that are worth starting from
NEAREST, FARTHEST = 0.2, 4.0  # of points anywhere [extent of the cameras]


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
    positions, colours = checked_points(positions, colours)
    if settings.cap < LEAST_POINTS:
        raise InputError(f"cap: a scene starts from at least {LEAST_POINTS} points, got {settings.cap}")
    if len(positions) > settings.cap:
        drawn = torch.randperm(len(positions), generator=generator(settings.seed, 0, "points"))[: settings.cap]
        kept = drawn.sort().values
        positions, colours = positions[kept], colours[kept]
    return _round_gaussians(positions, colours, size * _spacing(positions, extent), settings).to(device)


def _spacing(positions: Tensor, extent: float) -> Tensor:
    """Root mean square distance of each point to the three nearest others, [N]."""
    return mean_squared_neighbor_distance(positions).sqrt().clamp(min=LEAST_DISTANCE * extent)


def _round_gaussians(positions: Tensor, colours: Tensor, deviations: Tensor, settings: FitSettings) -> Gaussians:
    count = len(positions)
    return Gaussians(
        means=positions.to(torch.float32),
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(count, 4),
        scales=deviations[:, None].expand(count, 3),
        opacities=torch.full((count,), OPACITY[settings.strategy]),
        sh=((colours - 0.5) / SH_C0)[:, None, :],
    )


def checked_points(positions: Any, colours: Any) -> tuple[Tensor, Tensor]:
    """Points to start from, float64 [N, 3] and float32 [N, 3], both on the CPU.

    Raises:
        InputError: Fewer than 4, one that is not finite, or colors that are not in [0, 1].
    """
    positions, colours = (t.detach().cpu() if isinstance(t, Tensor) else np.asarray(t) for t in (positions, colours))
    positions = torch.as_tensor(positions, dtype=torch.float64)
    colours = torch.as_tensor(colours, dtype=torch.float32)
    if positions.ndim != 2 or positions.shape[1] != 3 or colours.shape != positions.shape:
        raise InputError(f"points: expected [N, 3] twice, got {list(positions.shape)} and {list(colours.shape)}")
    if len(positions) < LEAST_POINTS:
        raise InputError(f"points: a scene starts from at least {LEAST_POINTS}, got {len(positions)}; or from none")
    for name, values in (("positions", positions), ("colours", colours)):
        if not bool(torch.isfinite(values).all()):
            row = int((~torch.isfinite(values)).any(dim=1).nonzero()[0])
            raise InputError(f"points: {name} of point {row} are not finite; leave it out")
    if not bool(((colours >= 0) & (colours <= 1)).all()):
        raise InputError(
            f"points: colours lie in {float(colours.min()):g} to {float(colours.max()):g}, not in [0, 1]; divide by 255"
        )
    return positions, colours


def gaussians_from_photographs(
    photographs: Sequence[Photograph], settings: FitSettings, extent: float, progress: Report | None = None
) -> Gaussians:
    """Flat Gaussians on the surfaces on whose depth the photographs agree, with their colors.

    Points anywhere on their rays explain the photographs they come from and hide the scene from the others: a fit then
    ends in fog. Only where photographs agree nowhere is that what remains; distances are then spread evenly by their
    logarithm.

    Args:
        photographs: With cameras in the frame of the fit.
        settings: Strategy, cap and seed.
        extent: Of the cameras [m].
        progress: Called as `progress(done, total, text)`.
    """
    count = _most_points(settings)
    found = _surfaces(photographs, count, settings, progress)
    if found is not None:
        return found
    logger.warning("start: the photographs agree nowhere, so points lie anywhere in view; the fit may end in fog")
    places, colors = _points_anywhere(photographs, count, generator(settings.seed, 0, "random points"))
    return gaussians_from_points(places, colors, settings, extent, size=RANDOM_SIZE)


def _most_points(settings: FitSettings) -> int:
    """How many points to start from: "default" has to find room for what it adds, "mcmc" moves what is there."""
    return min(settings.cap if settings.strategy == "mcmc" else settings.cap // 2, RANDOM_COUNT)


def completed(
    positions: Tensor,
    colors: Any,
    photographs: Sequence[Photograph],
    settings: FitSettings,
    extent: float,
    progress: Report,
) -> Gaussians:
    """Gaussians at few points, such as features leave them, and on the surfaces where photographs agree."""
    more = _surfaces(photographs, _most_points(settings) - len(positions), settings, progress)
    added = 0 if more is None else len(more)
    logger.info("start: %d points are few; %d are added where photographs agree", len(positions), added)
    if more is None:
        return gaussians_from_points(positions, colors, settings, extent)
    every = torch.cat([positions, more.means.to(positions.dtype)])
    # Sizes by the distances to both: a sparse point is no large ball in front of a surface.
    spacing = _spacing(every, extent)[: len(positions)]
    own = torch.as_tensor(colors).to(torch.float32)
    return join_gaussians([_round_gaussians(positions, own, SIZE * spacing, settings), more])


def _surfaces(
    photographs: Sequence[Photograph], count: int, settings: FitSettings, progress: Report | None
) -> Gaussians | None:
    """At most `count` Gaussians where photographs agree; None if that is next to nowhere."""
    images = (photograph.image().cpu().numpy() for photograph in photographs)
    maps = estimate_depth(images, [photograph.camera for photograph in photographs], 1.0, progress)
    share = sum(float(m.known.mean()) for m in maps) / len(maps)
    logger.info("start: the photographs agree on the depth of %.0f %% of their pixels", 100 * share)
    known = [m.known & _counted(photograph, m.known.shape) for m, photograph in zip(maps, photographs, strict=True)]
    if count < 1 or sum(int(own.sum()) for own in known) < LEAST_CERTAIN:
        return None
    views = [View(str(index), m.camera) for index, m in enumerate(maps)]
    return gaussians_from_depth(
        views,
        lambda view: np.where(known[int(view.stem)], maps[int(view.stem)].depth, 0.0),
        lambda view: maps[int(view.stem)].colors,
        count=count,
        opacity=OPACITY[settings.strategy],
    )


def _counted(photograph: Photograph, size: tuple[int, ...]) -> Any:
    """Pixels of a small copy that a mask leaves whole, bool [h, w]: what is hidden may look even and seem to agree."""
    import cv2

    if photograph.mask is None:
        return np.ones(size, bool)
    mask = photograph.mask.cpu().numpy().astype(np.float32)
    return cv2.resize(mask, size[::-1], interpolation=cv2.INTER_AREA) > 0.99


def _points_anywhere(photographs: Sequence[Photograph], count: int, random: torch.Generator) -> tuple[Tensor, Tensor]:
    """Points at random pixels and distances in front of the cameras."""
    positions, colors = [], []
    for index, photograph in enumerate(photographs):
        share = (count + len(photographs) - 1 - index) // len(photographs)  # they add up to `count`
        camera = photograph.camera
        u, v, w = torch.rand(3, share, generator=random, dtype=torch.float64)
        x, y = u * camera.width, v * camera.height
        depth = NEAREST * (FARTHEST / NEAREST) ** w
        rays = torch.stack([x, y, torch.ones_like(x)], dim=1) @ torch.linalg.inv(camera.K).T
        positions.append((rays * depth[:, None]) @ camera.world_to_camera[:3, :3] + camera.position)
        colors.append(photograph.image().cpu()[y.long(), x.long()])
    return torch.cat(positions), torch.cat(colors)


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
