"""Points of photographs whose poses are known: features are matched, and triangulated with these poses."""

from __future__ import annotations

import logging
import tempfile
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sgwarp.files.images import write_rgb
from sgwarp.reconstruction.fitting.frame import Frame
from sgwarp.reconstruction.sfm.features import (
    LARGEST,
    PHOTOGRAPHS_AT_ONCE,
    SfmSettings,
    match_features,
    store_features,
)
from sgwarp.reconstruction.sfm.library import require_pycolmap, run_cancellable
from sgwarp.runs.progress import Report
from sgwarp.scene import Camera, View

logger = logging.getLogger("sgwarp")
NEIGHBORS = 20  # photographs that each is matched with
LEAST_POINTS = 50  # that are worth starting from
LEAST_TRACK = 3  # photographs that see a point
LEAST_SHARE = 0.6  # of the points, that so many see
LEAST_COSINE = 0.3  # between the directions of view of two that are matched

Points = tuple[NDArray[np.float64], NDArray[np.float32]]


def triangulate(views: Sequence[View], settings: SfmSettings | None = None, progress: Report | None = None) -> Points:
    """Triangulate points with the poses that views have.

    Distorted photographs are undistorted first, so that every camera is a pinhole.

    Args:
        views: Posed photographs.
        settings: Threads and seed.
        progress: Called as `progress(done, total, text)`.

    Returns:
        Positions [world units], float64 [N, 3], and colors in [0, 1], float32 [N, 3]; few or none where photographs
        show too little or the poses are wrong.

    Raises:
        InputError: pycolmap is not installed, or a photograph cannot be read.
    """
    pycolmap = require_pycolmap()
    settings, report = settings or SfmSettings(), progress or (lambda done, total, text: None)
    pycolmap.set_random_seed(settings.seed)
    frame = Frame.around(views)
    with tempfile.TemporaryDirectory(prefix="sgwarp-") as place:
        folder = Path(place)
        cameras = [_store(view, folder, f"{index:06d}.png") for index, view in enumerate(views)]
        model = _Model(folder, settings, report, [frame.camera(camera) for camera in cameras])
        model.extract()
        model.match()
        found = model.triangulate()
        points = _consistent(list(found.points3D.values()))
        positions = np.array([point.xyz for point in points]).reshape(-1, 3)
        colors = np.array([point.color for point in points]).reshape(-1, 3)
    return positions * frame.scale + frame.origin.numpy(), colors.astype(np.float32) / np.float32(255)


def _consistent(points: list[Any]) -> list[Any]:
    """Points that at least three photographs agree on; none if most lost their third, as those of wrong poses do."""
    kept = [point for point in points if point.track.length() >= LEAST_TRACK]
    if len(kept) < LEAST_SHARE * len(points):
        logger.warning(
            "the poses contradict the photographs: of %d points only %d fit three of them", len(points), len(kept)
        )
        return []
    return kept


def _store(view: View, folder: Path, name: str) -> Camera:
    """Write the pinhole photograph, no larger than features need; returns its camera."""
    import cv2

    image, camera = view.image().numpy(), view.camera
    factor = min(1.0, LARGEST / max(camera.size))
    if factor < 1:
        height, width = (max(1, round(factor * size)) for size in camera.size)
        camera = camera.resized(height, width)
        image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    write_rgb(folder / name, image)
    return camera


class _Model:
    """A COLMAP database of photographs in a folder, with their cameras."""

    def __init__(self, folder: Path, settings: SfmSettings, report: Report, cameras: Sequence[Camera]) -> None:
        self.library = require_pycolmap()
        self.folder, self.settings, self.report, self.cameras = folder, settings, report, cameras
        self.database = folder / "database.db"
        self.names = [f"{index:06d}.png" for index in range(len(cameras))]
        self.lenses: dict[int, Any] = {}

    def extract(self) -> None:
        """Find the features of each photograph, with its own camera."""
        library = self.library
        groups: dict[tuple[float, ...], list[str]] = defaultdict(list)
        for name, camera in zip(self.names, self.cameras, strict=True):
            intrinsics = (*camera.K.diagonal()[:2].tolist(), *camera.K[:2, 2].tolist(), *camera.size)
            groups[intrinsics].append(name)
        with library.Database.open(self.database) as data:
            for number, (fx, fy, cx, cy, height, width) in enumerate(groups, start=1):
                lens = library.Camera(
                    model="PINHOLE", width=int(width), height=int(height), params=[fx, fy, cx, cy], camera_id=number
                )
                lens.has_prior_focal_length = True
                data.write_camera(lens, use_camera_id=True)
                self.lenses[number] = lens
        done = 0
        for number, names in enumerate(groups.values(), start=1):
            for start in range(0, len(names), PHOTOGRAPHS_AT_ONCE):
                self.report(done, len(self.names), "finding features")
                chunk = names[start : start + PHOTOGRAPHS_AT_ONCE]
                store_features(self.database, self.folder, chunk, self.settings, number)
                done += len(chunk)

    def match(self) -> None:
        """Match each photograph with those near it that look about the same way."""
        pairs = [(self.names[a], self.names[b]) for a, b in sorted(_pairs(self.cameras))]
        match_features(self.database, pairs, self.settings, self.report)

    def triangulate(self) -> Any:
        """The reconstruction with the given poses and all points."""
        library = self.library
        model = library.Reconstruction()
        for lens in self.lenses.values():
            model.add_camera_with_trivial_rig(lens)
        with library.Database.open(self.database) as data:
            for image in data.read_all_images():
                camera = self.cameras[self.names.index(image.name)]
                pose = library.Rigid3d(camera.world_to_camera[:3].numpy())
                placed = library.Image(name=image.name, camera_id=image.camera_id, image_id=image.image_id)
                model.add_image_with_trivial_frame(placed, pose)
        out = self.folder / "model"
        out.mkdir()
        options = library.IncrementalPipelineOptions()
        options.random_seed, options.num_threads = self.settings.seed, self.settings.threads

        def run(token: Any) -> Any:
            return library.triangulate_points(
                model, self.database, self.folder, out, options=options, cancellation_token=token
            )

        return run_cancellable(self.database, run, lambda: self.report(0, 1, "triangulating"))


def _pairs(cameras: Sequence[Camera]) -> set[tuple[int, int]]:
    """Which photographs to match: of each, the nearest of those that look about the same way."""
    places = np.stack([camera.position.numpy() for camera in cameras])
    axes = np.stack([camera.world_to_camera[2, :3].numpy() for camera in cameras])
    apart = np.linalg.norm(places[:, None] - places[None], axis=2)
    apart[axes @ axes.T < LEAST_COSINE] = np.inf
    np.fill_diagonal(apart, np.inf)
    order = np.argsort(apart, axis=1, kind="stable")[:, :NEIGHBORS]
    return {(min(a, int(b)), max(a, int(b))) for a in range(len(cameras)) for b in order[a] if apart[a, b] < np.inf}
