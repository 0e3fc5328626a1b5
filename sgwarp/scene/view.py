"""A camera with its photograph."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
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
    """

    stem: str
    camera: Camera
    image_path: Path | None = None
    undistort: Callable[[Any], Any] | None = field(default=None, repr=False)

    def image(self) -> Tensor:
        """Read the photograph, float32 [H, W, 3] in [0, 1].

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
        return torch.from_numpy(pixels).to(torch.float32) / 255.0
