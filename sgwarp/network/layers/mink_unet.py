"""MinkUNet: the U-Nets on sparse voxels of Choy et al., 4D Spatio-Temporal ConvNets (MinkowskiNet), CVPR 2019.

A stem of 5^3, four encoder levels [halve, blocks], four decoder levels [double, join with the encoder, blocks], and a
linear map without bias. Names, kernel sizes and widths are those of MinkowskiEngine's MinkUNet, as the checkpoints of
OpenScene and of Semantic Gaussians hold them.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import nn

from sgwarp.errors import InputError
from sgwarp.network.layers.sparse import BatchNorm, Conv, ConvTranspose, Linear, SparseTensor, normalized

STEM = 32  # channels after the stem


class Architecture(NamedTuple):
    """Residual blocks and channels of the eight levels, four down and four up."""

    blocks: tuple[int, ...]
    planes: tuple[int, ...]


ARCHITECTURES = {
    "14A": Architecture((1, 1, 1, 1, 1, 1, 1, 1), (32, 64, 128, 256, 128, 128, 96, 96)),
    "18A": Architecture((2, 2, 2, 2, 2, 2, 2, 2), (32, 64, 128, 256, 128, 128, 96, 96)),
    "34A": Architecture((2, 3, 4, 6, 2, 2, 2, 2), (32, 64, 128, 256, 256, 128, 64, 64)),
    "34C": Architecture((2, 3, 4, 6, 2, 2, 2, 2), (32, 64, 128, 256, 256, 128, 96, 96)),
}


class BasicBlock(nn.Module):
    """Two 3^3 convolutions around a shortcut, which is linear where the number of channels changes."""

    def __init__(self, in_channels: int, planes: int) -> None:
        super().__init__()
        self.conv1, self.norm1 = Conv(in_channels, planes), BatchNorm(planes)
        self.conv2, self.norm2 = Conv(planes, planes), BatchNorm(planes)
        self.downsample = None
        if in_channels != planes:
            self.downsample = nn.Sequential(Linear(in_channels, planes), BatchNorm(planes))

    def forward(self, x: SparseTensor) -> SparseTensor:
        y, x = normalized(self.conv1, self.norm1, x)
        shortcut = x
        if self.downsample is not None:
            layers: Any = self.downsample
            shortcut, _ = normalized(layers[0], layers[1], x, rectify=False)
        return normalized(self.conv2, self.norm2, y, shortcut=shortcut)[0]


class MinkUNet(nn.Module):
    """The network.

    Args:
        in_channels: Of a voxel.
        out_channels: Of the semantic embedding.
        arch: A name in ARCHITECTURES; the paper takes 34A.

    Raises:
        InputError: There is no architecture of that name.
    """

    def __init__(self, in_channels: int, out_channels: int, arch: str = "34A") -> None:
        super().__init__()
        if arch not in ARCHITECTURES:
            raise InputError(f"architecture '{arch}' does not exist; there are {', '.join(ARCHITECTURES)}")
        self.arch, self.in_channels, self.out_channels = arch, in_channels, out_channels
        blocks, planes = ARCHITECTURES[arch]
        self.conv0p1s1, self.bn0 = Conv(in_channels, STEM, side=5), BatchNorm(STEM)
        self._down: list[tuple[str, str, str]] = []
        self._up: list[tuple[str, str, str]] = []
        width = STEM
        for level in range(4):
            names = (f"conv{level + 1}p{2**level}s2", f"bn{level + 1}", f"block{level + 1}")
            self._add(names, Conv(width, width, side=2, stride=2), width, width, planes[level], blocks[level])
            self._down.append(names)
            width = planes[level]
        beside = (planes[2], planes[1], planes[0], STEM)  # channels of the encoder at the same stride
        for level in range(4):
            names = (f"convtr{level + 4}p{16 >> level}s2", f"bntr{level + 4}", f"block{level + 5}")
            plane, count = planes[level + 4], blocks[level + 4]
            self._add(names, ConvTranspose(width, plane), plane, plane + beside[level], plane, count)
            self._up.append(names)
            width = plane
        self.final = Linear(width, out_channels)

    def _add(
        self, names: tuple[str, str, str], conv: nn.Module, normed: int, entering: int, planes: int, count: int
    ) -> None:
        """One level: a change of stride, its normalisation over `normed` channels, and `count` blocks."""
        stages: list[Any] = [BasicBlock(entering, planes), *(BasicBlock(planes, planes) for _ in range(count - 1))]
        for name, module in zip(names, (conv, BatchNorm(normed), nn.Sequential(*stages)), strict=True):
            self.add_module(name, module)

    def hidden(self, x: SparseTensor) -> SparseTensor:
        """Input of the last, linear layer: 64 or 96 channels per voxel, whatever the size of the embedding."""
        if self.training:
            norms = [module for module in self.modules() if isinstance(module, nn.BatchNorm1d)]
            torch._foreach_add_([n.num_batches_tracked for n in norms if n.num_batches_tracked is not None], 1)
        x, _ = normalized(self.conv0p1s1, self.bn0, x)
        encoded: list[SparseTensor] = []
        for conv, norm, block in self._down:
            y, x = self._normalized(conv, norm, x)
            encoded.append(x)
            x = self.get_submodule(block)(y)
        for conv, norm, block in self._up:
            y, _ = self._normalized(conv, norm, x, encoded.pop())
            x = self.get_submodule(block)(y)
        return x

    def _normalized(
        self, conv: str, norm: str, x: SparseTensor, beside: SparseTensor | None = None
    ) -> tuple[SparseTensor, SparseTensor]:
        layer: Any = self.get_submodule(conv)
        following: Any = self.get_submodule(norm)
        return normalized(layer, following, x, beside=beside)

    def forward(self, x: SparseTensor) -> SparseTensor:
        """Embedding of every voxel, [N, out_channels]; not normalised."""
        y: SparseTensor = self.final(self.hidden(x))
        return y
