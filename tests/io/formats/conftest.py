"""A scene, mutations of files, and what two scenes differ by."""

import random
from collections.abc import Iterator

import pytest
import torch

from sgwarp.scene import Gaussians


def _scene(count=60, coefficients=4, seed=0):
    rng = torch.Generator().manual_seed(seed)
    return Gaussians(
        torch.randn(count, 3, generator=rng) * 2,
        torch.nn.functional.normalize(torch.randn(count, 4, generator=rng), dim=1),
        torch.exp(torch.randn(count, 3, generator=rng) - 3),
        torch.rand(count, generator=rng) * 0.98 + 0.01,
        torch.randn(count, coefficients, 3, generator=rng) * 0.3,
    )


def _rotations(quats):
    w, x, y, z = torch.nn.functional.normalize(quats.double(), dim=1).unbind(1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, dim=1) for row in rows], dim=1)


def _covariances(scene):
    axes = _rotations(scene.quats) * scene.scales.double()[:, None, :]
    return axes @ axes.transpose(1, 2)


def _mutations(data: bytes, count: int, seed: int = 0) -> Iterator[bytes]:
    """Copies that are cut short, or have bytes changed, most of them near the start."""
    rng = random.Random(seed)
    for _ in range(count):
        copy = bytearray(data if rng.random() < 0.8 else data[: rng.randrange(len(data))])
        for _ in range(rng.choice([1, 1, 2, 8])):
            if copy:
                place = rng.randrange(min(len(copy), rng.choice([40, 400, len(copy)])))
                copy[place] = rng.choice([0, 255, rng.randrange(256)])
        yield bytes(copy)


@pytest.fixture(scope="session")
def scene():
    return _scene


@pytest.fixture(scope="session")
def rotations():
    return _rotations


@pytest.fixture(scope="session")
def covariances():
    return _covariances


@pytest.fixture(scope="session")
def survives(allow_input_error):
    """Reads mutated copies of a file; anything but a scene or an InputError on one line fails."""

    def read_all(path, reader, count=150):
        data = path.read_bytes()
        read = 0
        for copy in _mutations(data, count):
            path.write_bytes(copy)
            with allow_input_error(path):
                reader(path)
                read += 1
        path.write_bytes(data)
        return read

    return read_all
