"""A camera with its photograph."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.files.images import read_rgb
from sgwarp.scene.camera import Camera


@dataclass(frozen=True, eq=False)
class View:
    """A camera with the name and, where there is one, the photograph it took.

    Attributes:
        stem: Name without folder or extension; label images and feature files are matched by it.
        camera: The (undistorted) pinhole camera.
        image_path: The photograph, or None: then it is rendered from the scene where one is needed.
        undistort: Maps the photograph as stored, uint8 [H, W, 3], to the pinhole image; None if there is nothing to do.
            With a method `carry(array, nearest)` it does the same to what belongs to the photograph.
        name: The photograph as its data set lists it, with folders and ending; files are matched by it, too.
        mask_path: A mask of the photograph that the data set names, or None.
        depth_path: Depth of the photograph that the data set names, or None.
        depth_unit: What one step of that depth is, if its file holds whole numbers [m].
        origin: Where its data set counts from the origin of the camera's world, if that was moved to it.
    """

    stem: str
    camera: Camera
    image_path: Path | None = None
    undistort: Callable[[Any], Any] | None = field(default=None, repr=False)
    name: str = ""
    mask_path: Path | None = None
    depth_path: Path | None = None
    depth_unit: float = 1e-3
    origin: tuple[float, float, float] | None = None

    def carry(self, array: Any, nearest: bool = True) -> Any:
        """What belongs to the photograph as stored, [h, w] or [h, w, C], as it belongs to the pinhole image.

        It is turned and undistorted like the photograph, and keeps its resolution, which need not be the photograph's.

        Args:
            array: Ids, masks, depth or features of the photograph.
            nearest: Mix no values; else interpolate.

        Raises:
            InputError: It does not have the shape of the photograph.
        """
        carry = getattr(self.undistort, "carry", None)
        return array if carry is None else carry(array, nearest)

    def image(self) -> Tensor:
        """Read the photograph, float32 [H, W, 3] in [0, 1].

        Raises:
            InputError: As `pixels` says.
        """
        return torch.from_numpy(self.pixels()).to(torch.float32) / 255.0

    def pixels(self) -> NDArray[np.uint8]:
        """Read the photograph, uint8 [H, W, 3].

        Raises:
            InputError: There is none, it cannot be read, or its size is not the camera's.
        """
        if self.image_path is None:
            raise InputError(f"view {self.stem}: has no photograph; render one from the scene")
        pixels = read_rgb(self.image_path)
        if self.undistort is not None:
            pixels = self.undistort(pixels)
        if pixels.shape[:2] != self.camera.size:
            got, want = f"{pixels.shape[1]} x {pixels.shape[0]}", f"{self.camera.width} x {self.camera.height}"
            raise InputError(f"{self.image_path}: image is {got}, its camera says {want}; resize one of them")
        return pixels
