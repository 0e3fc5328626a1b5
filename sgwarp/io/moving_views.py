"""Cameras of every frame: Dynamic3DGaussians' {train,test}_meta.json, a folder per frame, or cameras that stay."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from sgwarp.errors import InputError
from sgwarp.files.documents import read_json
from sgwarp.io.colmap import find_model
from sgwarp.io.names import inside
from sgwarp.io.stems import IMAGE_SUFFIXES
from sgwarp.io.views import TRANSFORMS, load_views, note_files
from sgwarp.io.world_transforms import moved_views
from sgwarp.scene import Camera, View
from sgwarp.scene.extent import with_near_plane

Split = Literal["train", "test"]
IMAGES = "ims"  # folder beside the meta files that holds the photographs


@dataclass(frozen=True, eq=False)
class FrameView:
    """A camera at one moment.

    Attributes:
        view: Its stem names the camera and is the same in every frame.
        file: Name that the file of cameras gives the photograph of this frame, or None.
        missing: A photograph is listed, or other frames have one, but it is not there.
    """

    view: View
    file: str | None = None
    missing: bool = False


class MovingViews(Protocol):
    """Cameras of a moving scene."""

    @property
    def frames(self) -> int | None:
        """Number of frames, None if the cameras stay and serve any number."""
        ...

    def at(self, frame: int) -> list[FrameView]:
        """The cameras of a frame, in the same order in every frame."""
        ...


def load_moving_views(path: str | os.PathLike[str], split: Split = "train", photographs: bool = True) -> MovingViews:
    """Open the cameras of a moving scene.

    - `{split}_meta.json` (Dynamic3DGaussians): calibration per frame and camera, photographs in `ims/{fn}`; a view is
      named after its camera's `cam_id`.
    - Folders named by the number of the frame, each with a transforms.json or a COLMAP model.
    - One transforms.json or COLMAP model: the cameras stay. Photographs of frame t are looked for in
      `images/{t:05d}/{stem}.*` and `{t:05d}/{stem}.*`; without any the views are rendered from the scene.

    Raises:
        InputError: Nothing of the kind is there, or what is there cannot be used.
    """
    path = Path(path)
    meta = path if os.path.isfile(path) and path.name.endswith("meta.json") else path / f"{split}_meta.json"
    if meta.is_file():
        return MetaViews(meta, photographs)
    if path.is_dir() and not any((path / name).is_file() for name in TRANSFORMS) and find_model(path) is None:
        folders = sorted((f for f in path.iterdir() if f.is_dir() and f.name.isdecimal()), key=lambda f: int(f.name))
        if folders:
            return FolderViews(folders, photographs)
    return StillViews(path, photographs)


@dataclass(frozen=True, eq=False)
class MovedViews:
    """Cameras after a similarity transform of the world, float64 [4, 4]."""

    views: MovingViews
    matrix: NDArray[np.float64]

    @property
    def frames(self) -> int | None:
        return self.views.frames

    def at(self, frame: int) -> list[FrameView]:
        found = self.views.at(frame)
        moved = moved_views([one.view for one in found], self.matrix)
        return [replace(one, view=view) for one, view in zip(found, moved, strict=True)]


class StillViews:
    """Cameras that stay where they are."""

    def __init__(self, path: Path, photographs: bool = True) -> None:
        self.folder = path if path.is_dir() else path.parent
        self.views = load_views(path, photographs=False)
        self._photographs = photographs and self._find(self.views[0].stem, 0) is not None

    frames: int | None = None

    def at(self, frame: int) -> list[FrameView]:
        found = []
        for view in self.views:
            image = self._find(view.stem, frame) if self._photographs else None
            found.append(FrameView(replace(view, image_path=image), None, self._photographs and image is None))
        note_files(one.view for one in found)
        return found

    def _find(self, stem: str, frame: int) -> Path | None:
        places = (self.folder / "images" / f"{frame:05d}", self.folder / f"{frame:05d}")
        candidates = (place / f"{stem}{suffix}" for place in places for suffix in IMAGE_SUFFIXES)
        return next(filter(os.path.isfile, candidates), None)


class FolderViews:
    """A folder of posed photographs per frame."""

    def __init__(self, folders: list[Path], photographs: bool = True) -> None:
        self.folders, self._photographs = folders, photographs

    @property
    def frames(self) -> int | None:
        return len(self.folders)

    def at(self, frame: int) -> list[FrameView]:
        views = load_views(self.folders[frame], photographs=self._photographs)
        return [FrameView(view) for view in views]


class MetaViews:
    """{train,test}_meta.json of Dynamic3DGaussians: w, h, k[T][C], w2c[T][C], fn[T][C], cam_id[T][C]."""

    def __init__(self, path: Path, photographs: bool = True) -> None:
        self.path, self._photographs = path, photographs
        meta = read_json(path)
        names = ("w", "h", "k", "w2c")
        missing = [name for name in names if not isinstance(meta, dict) or name not in meta]
        if missing:
            raise InputError(f"{path}: has no '{missing[0]}'; expected a meta file of Dynamic3DGaussians")
        self._size = tuple(self._pixels(meta, name) for name in ("h", "w"))
        self._meta = meta
        self._frames = len(meta["w2c"]) if isinstance(meta["w2c"], list) else 0
        for name in ("k", "w2c", "fn", "cam_id"):
            rows = meta.get(name)
            if rows is not None and (not isinstance(rows, list) or len(rows) != self._frames):
                raise InputError(f"{path}: '{name}' must have one list per frame, {self._frames} as 'w2c' has")
        if not self._frames:
            raise InputError(f"{path}: 'w2c' has no frames")
        self._images = path.parent / IMAGES
        self._near: tuple[float, float] | None = None

    def _pixels(self, meta: dict[str, Any], name: str) -> int:
        value = meta[name]
        if isinstance(value, bool) or not isinstance(value, int) or not 0 < value < 1_000_000:
            raise InputError(f"{self.path}: '{name}' must be a positive whole number of pixels, got {value!r}")
        return value

    @property
    def frames(self) -> int | None:
        return self._frames

    def at(self, frame: int) -> list[FrameView]:
        """The cameras of a frame.

        Raises:
            InputError: A matrix is not one, two views have one name, or the lists differ in length.
        """
        poses = self._meta["w2c"][frame]
        if not isinstance(poses, list):
            raise InputError(f"{self.path}: frame {frame}: 'w2c' must be a list of matrices, one per camera")
        lenses, files, names = (self._of(name, frame, len(poses)) for name in ("k", "fn", "cam_id"))
        found, seen = [], set()
        for place, (pose, lens, file, name) in enumerate(zip(poses, lenses, files, names, strict=True)):
            where = f"{self.path}: frame {frame}, camera {place}"
            stem = self._stem(where, file, name, place)
            if stem in seen:
                raise InputError(f"{where}: is another view named '{stem}'; give every camera its own cam_id")
            seen.add(stem)
            named = inside(self.path, self._images, file) if file else None
            image = named if self._photographs else None
            there = image is not None and os.path.isfile(image)
            view = View(stem, self._camera(where, lens, pose), image if there else None)
            found.append(FrameView(view, file, image is not None and not there and self._images.is_dir()))
        note_files(one.view for one in found)
        return self._with_near_planes(found)

    def _with_near_planes(self, found: list[FrameView]) -> list[FrameView]:
        """The cameras with near and far planes that fit the unit of the first ones that were asked for."""
        if self._near is None and found:
            camera = with_near_plane([one.view for one in found])[0].camera
            self._near = camera.near, camera.far
        near, far = self._near or (Camera.near, Camera.far)
        return [
            replace(one, view=replace(one.view, camera=replace(one.view.camera, near=near, far=far))) for one in found
        ]

    def _of(self, name: str, frame: int, count: int) -> list[Any]:
        rows = self._meta.get(name)
        if rows is None:
            return [None] * count
        if not isinstance(rows[frame], list) or len(rows[frame]) != count:
            raise InputError(f"{self.path}: frame {frame}: '{name}' must have one entry per camera, {count}")
        return rows[frame]

    def _stem(self, where: str, file: Any, name: Any, place: int) -> str:
        if file is not None and not isinstance(file, str):
            raise InputError(f"{where}: 'fn' must be the name of a photograph, got {file!r}")
        if name is None:
            name = Path(file).parent.name or Path(file).stem if file else place
        if isinstance(name, bool) or not isinstance(name, (int, str)) or Path(str(name)).name != str(name):
            raise InputError(f"{where}: 'cam_id' must be a number or a plain name, got {name!r}")
        return str(name)

    def _camera(self, where: str, lens: Any, pose: Any) -> Camera:
        try:
            K, matrix = np.array(lens, dtype=np.float64), np.array(pose, dtype=np.float64)
            height, width = self._size
            return Camera(torch.from_numpy(K), torch.from_numpy(matrix), width, height)
        except (TypeError, ValueError) as error:  # InputError is a ValueError, and names the field
            raise InputError(f"{where}: {error}") from None
