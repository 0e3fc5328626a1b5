"""A small scene as gsplat's callers hold it: raw tensors, two cameras."""

from typing import NamedTuple

import pytest
import torch
from torch import Tensor


class RawScene(NamedTuple):
    """Arguments of a rasterizer, float32, N = 60, two cameras of 45 x 37 pixels."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor
    sh: Tensor  # degree 3
    viewmats: Tensor
    Ks: Tensor
    width: int
    height: int

    @property
    def shape(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        return self.means, self.quats, self.scales, self.opacities

    @property
    def camera(self) -> tuple[Tensor, Tensor, int, int]:
        return self.viewmats, self.Ks, self.width, self.height

    def replace(self, **fields) -> "RawScene":
        return self._replace(**fields)


def rigid(angles: tuple[float, float], translation: tuple[float, float, float]) -> Tensor:
    """World-to-camera matrix turned about y, then about x."""
    (sy, cy), (sx, cx) = ((torch.sin(a), torch.cos(a)) for a in torch.tensor(angles, dtype=torch.float64))
    turn_y = torch.tensor([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]], dtype=torch.float64)
    turn_x = torch.tensor([[1, 0, 0], [0, cx, -sx], [0, sx, cx]], dtype=torch.float64)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3], pose[:3, 3] = turn_x @ turn_y, torch.tensor(translation)
    return pose


@pytest.fixture
def raw() -> RawScene:
    rng = torch.Generator().manual_seed(20)
    n = 60

    def uniform(low, high, *shape):
        low, high = torch.as_tensor(low), torch.as_tensor(high)
        return low + (high - low) * torch.rand(*shape, generator=rng)

    K = torch.tensor([[[40.0, 0, 24.0], [0, 42.0, 17.0], [0, 0, 1]], [[38.0, 0, 20.5], [0, 36.0, 20.0], [0, 0, 1]]])
    return RawScene(
        means=uniform([-1.6, -1.4, 2.0], [1.6, 1.4, 5.0], n, 3),
        quats=torch.randn(n, 4, generator=rng),
        scales=uniform(0.04, 0.35, n, 3),
        opacities=uniform(0.1, 0.95, n),
        colors=uniform(0.0, 1.0, n, 3),
        sh=torch.randn(n, 16, 3, generator=rng) * 0.3,
        viewmats=torch.stack([rigid((0.1, -0.05), (0.1, 0.0, 0.2)), rigid((-0.3, 0.1), (-0.2, 0.1, 0.4))]).float(),
        Ks=K,
        width=45,
        height=37,
    )
