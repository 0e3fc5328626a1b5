"""Writers of published formats, independent of the readers: text COLMAP models, photographs, masks."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

WIDTH, HEIGHT, FOCAL = 24, 18, 20.0


class Writer:
    """Files of a data set below a folder; cameras look along z from a row of places."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def path(self, name: str) -> Path:
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def text(self, name: str, content: object) -> None:
        self.path(name).write_text(content if isinstance(content, str) else json.dumps(content), encoding="utf-8")

    def image(self, name: str, width: int = WIDTH, height: int = HEIGHT) -> None:
        pixels = np.random.default_rng(sum(name.encode())).integers(0, 256, (height, width, 3), dtype=np.uint8)
        cv2.imwrite(str(self.path(name)), pixels)

    def gray(self, name: str, pixels: np.ndarray) -> None:
        cv2.imwrite(str(self.path(name)), pixels)

    def mask(self, name: str, top: int, bottom: int, left: int, right: int, size=(HEIGHT, WIDTH)) -> np.ndarray:
        pixels = np.zeros(size, dtype=np.uint8)
        pixels[top:bottom, left:right] = 255
        self.gray(name, pixels)
        return pixels > 0

    def colmap(self, name: str, stems: list[str], images: str = "images", ending: str = ".jpg") -> None:
        """sparse/0 as text, and the photographs."""
        cameras = f"1 PINHOLE {WIDTH} {HEIGHT} {FOCAL} {FOCAL} {WIDTH / 2} {HEIGHT / 2}\n"
        lines = [f"{k + 1} 1 0 0 0 {-0.1 * k} 0 0 1 {stem}{ending}\n\n" for k, stem in enumerate(stems)]
        self.text(f"{name}/sparse/0/cameras.txt", cameras)
        self.text(f"{name}/sparse/0/images.txt", "".join(lines))
        self.text(f"{name}/sparse/0/points3D.txt", "")
        for stem in stems:
            self.image(f"{name}/{images}/{stem}{ending}")


@pytest.fixture
def writer(tmp_path: Path) -> Writer:
    return Writer(tmp_path)
