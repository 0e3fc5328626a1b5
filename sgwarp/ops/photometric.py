"""Photometric loss between a rendering and an image: L1 and structural similarity, with gradients."""

from __future__ import annotations

from typing import Any

import torch
import warp as wp
from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.kernels.fitting import photometric_block
from sgwarp.kernels.fitting import photometric_lanes as kernels
from sgwarp.kernels.transmittance import LANES, Lanes
from sgwarp.ops.arguments import view
from sgwarp.ops.devices import warp_device
from sgwarp.ops.launcher import launch, launch_blocks
from sgwarp.ops.memory import scratch

FLOAT_BYTES = 4


def photometric_loss(
    image: Tensor, truth: Tensor, similarity_share: float = 0.2, *, schedule: str | None = None
) -> Tensor:
    """(1 - s) mean |x - y| + s (1 - SSIM(x, y)), the loss that 3DGS is fitted with (Kerbl et al. 2023, eq. 7).

    SSIM (Wang et al. 2004) has a Gaussian window of 11 x 11 pixels and 1.5 pixels deviation, per channel; outside the
    images everything is zero. It is averaged over all pixels and channels. Same bits for any number of threads.

    Args:
        image: x, the rendering, float32 [H, W, 3]; has the gradient.
        truth: y, float32 [H, W, 3], in [0, 1].
        similarity_share: s, 0 to 1.
        schedule: "lanes" or "block", by default the device's own; either runs on the CPU.

    Returns:
        A float32 scalar; on CUDA nobody waits for it.

    Raises:
        InputError: Shapes or types do not fit.
    """
    if image.ndim != 3 or image.shape[2] != kernels.CHANNELS or image.numel() == 0:
        raise InputError(f"image: expected shape [H, W, 3], got {list(image.shape)}")
    if truth.shape != image.shape:
        raise InputError(f"truth: expected the image's shape {list(image.shape)}, got {list(truth.shape)}")
    if image.dtype != torch.float32 or truth.dtype != torch.float32:
        raise InputError(f"image and truth: expected float32, got {image.dtype} and {truth.dtype}")
    loss: Tensor = _Photometric.apply(image, truth, similarity_share, schedule)
    return loss


class _Photometric(torch.autograd.Function):
    """The gradient costs little beside the loss, so that both are computed at once."""

    @staticmethod
    def forward(ctx: Any, image: Tensor, truth: Tensor, share: float, schedule: str | None) -> Tensor:
        block = (schedule or ("block" if image.device.type == "cuda" else "lanes")) == "block"
        compute = _in_blocks if block else _in_lanes
        loss, gradient = compute(image.detach(), truth.detach(), share)
        ctx.save_for_backward(gradient)
        return loss

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, v_loss: Tensor) -> tuple[Tensor, None, None, None]:
        (gradient,) = ctx.saved_tensors
        return gradient * v_loss, None, None, None


def _in_blocks(image: Tensor, truth: Tensor, share: float) -> tuple[Tensor, Tensor]:
    """Two launches, and no copy to the host."""
    height, width, channels = image.shape
    floats, device = width * channels, image.device
    tile_columns = -(-width // photometric_block.SIDE)
    tiles = tile_columns * -(-height // photometric_block.SIDE)
    planes = scratch("photometric derivatives", kernels.ADJOINTS * height * floats, torch.float32, device)
    derivatives = view(planes.view(kernels.ADJOINTS, height, floats), wp.float32)
    sums = view(scratch("photometric sums", 2 * tiles, torch.float32, device).view(tiles, 2), photometric_block.Sums)
    loss, gradient = torch.empty(1, device=device), torch.empty(height, floats, device=device)
    pair = [view(picture.reshape(height, floats), wp.float32) for picture in (image, truth)]
    outputs = [derivatives, sums]
    launch_blocks(photometric_block.compare_tiles, [tiles], [*pair, tile_columns], outputs, device=device)
    inputs = [derivatives, *pair, sums, tile_columns, share]
    outputs = [view(gradient, wp.float32), view(loss, wp.float32)]
    launch_blocks(photometric_block.gather_tiles, [tiles], inputs, outputs, device=device)
    return loss[0], gradient.view(image.shape)


def _in_lanes(image: Tensor, truth: Tensor, share: float) -> tuple[Tensor, Tensor]:
    height, width, channels = image.shape
    floats, device = width * channels, image.device
    x, y = (_in_vectors(name, picture.reshape(height, floats)) for name, picture in (("x", image), ("y", truth)))
    columns = x.shape[1] // LANES
    moments = _Planes("moments", kernels.MOMENTS, height, columns, device)
    adjoints, averaged = (_Planes(name, kernels.ADJOINTS, height, columns, device) for name in ("adjoints", "averaged"))
    rows = torch.empty(2, height, device=device)
    gradient = torch.empty(height, floats, device=device)
    pair = [view(t.view(height, columns, LANES), Lanes) for t in (x, y)]
    launch(kernels.average_down, height * columns, pair, [moments.vectors], device=device)
    outputs = [adjoints.vectors, view(rows[0], wp.float32)]
    launch(kernels.compare_windows, height, [moments.shifted, floats], outputs, device=device, chunk=ROWS)
    launch(kernels.average_adjoints_down, height * columns, [adjoints.vectors], [averaged.vectors], device=device)
    count = height * floats
    inputs = [averaged.shifted, *pair, floats, (1.0 - share) / count, -share / count]
    outputs = [view(gradient, wp.float32), view(rows[1], wp.float32)]
    launch(kernels.gather_gradient, height, inputs, outputs, device=device, chunk=ROWS)
    similarity, difference = rows.to(torch.float64).sum(dim=1) / count
    loss = (1.0 - share) * difference + share * (1.0 - similarity)
    return loss.to(torch.float32), gradient.view(image.shape)


ROWS = 16  # of an image that a host thread takes at once


class _Planes:
    """Scratch of `count` planes with margins of zeros: as vectors, and with a vector at every float."""

    def __init__(self, name: str, count: int, height: int, columns: int, device: torch.device) -> None:
        stride = (columns + 2 * kernels.MARGIN) * LANES
        memory = scratch(f"photometric {name}", count * height * stride, torch.float32, device)
        planes = memory.view(count, height, stride)
        planes[:, :, : kernels.MARGIN * LANES] = 0.0
        planes[:, :, stride - kernels.MARGIN * LANES :] = 0.0
        self.vectors = view(planes.view(count, height, -1, LANES), Lanes)
        self.shifted: Any = wp.array(
            ptr=memory.data_ptr(),
            dtype=Lanes,
            shape=(count, height, stride - LANES + 1),
            strides=(height * stride * FLOAT_BYTES, stride * FLOAT_BYTES, FLOAT_BYTES),
            capacity=memory.numel() * FLOAT_BYTES,
            device=warp_device(device),
        )


def _in_vectors(name: str, rows: Tensor) -> Tensor:
    """Rows padded with zeros to whole vectors."""
    height, floats = rows.shape
    stride = -(-floats // LANES) * LANES
    padded = scratch(f"photometric {name}", height * stride, torch.float32, rows.device).view(height, stride)
    padded[:, :floats] = rows
    padded[:, floats:] = 0.0
    return padded
