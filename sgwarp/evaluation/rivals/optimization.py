"""Features fitted per scene by gradient descent through our rasterizer (Feature 3DGS, Zhou et al., 2024).

Feature 3DGS adds a feature to every Gaussian and fits its rendering to the 2D maps with an L1 loss; its fast variant
renders few channels and decodes them by a 1 x 1 convolution. There features and geometry are fitted together; here the
geometry is given, as for lifting, so that both start from the same scene.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from sgwarp.errors import InputError
from sgwarp.lifting.map_reader import MapReader, Maps, as_source, has_map
from sgwarp.lifting.ridge import map_at_pixels
from sgwarp.ops.splatting.autograd import rasterize
from sgwarp.ops.splatting.settings import RasterSettings
from sgwarp.runs.log import RunLog
from sgwarp.runs.progress import Report
from sgwarp.scene import Camera, Gaussians, Semantics, View

# Chosen on the generated room of benchmarks/lifting_modes.py, for fits of 100 to 300 steps; the release takes 30,000.
RATE = 0.05  # of the features
DECODER_RATE = 1e-2


@dataclass(frozen=True)
class Snapshot:
    """Where a fit is.

    Attributes:
        step: Steps done.
        seconds: Spent on them, without the time of looking.
        features: Of every Gaussian, decoded, float32 [N, C].
    """

    step: int
    seconds: float
    features: Tensor


def fit_features(
    gaussians: Gaussians,
    views: Sequence[View],
    maps: Maps,
    *,
    steps: int = 300,
    channels: int | None = None,
    rate: float = RATE,
    seed: int = 0,
    look: Callable[[Snapshot], None] | None = None,
    look_at: Sequence[int] = (),
    log: RunLog | None = None,
    progress: Report | None = None,
) -> Semantics:
    """Fit a feature to every Gaussian by Adam, one view a step, with the L1 loss of Feature 3DGS.

    Args:
        gaussians: The scene; its geometry stays as it is.
        views, maps: As of `lift`.
        steps: How many views are looked at.
        channels: Channels that are rendered and decoded to those of the maps by a linear layer; None renders all.
        rate: Of the features.
        seed: Of the order of the views and the decoder's start.
        look: Called with a snapshot after each step of `look_at`; its time does not count.
        look_at: Steps.
        log, progress: As of `lift`.

    Returns:
        The features, decoded; the weight of a Gaussian is 1 if its feature ever had a gradient, else 0.

    Raises:
        InputError: No view has a map, or there are no steps.
    """
    if steps < 1 or (channels is not None and channels < 1):
        raise InputError(f"steps and channels: expected 1 or more, got {steps} and {channels}")
    log = log if log is not None else RunLog()
    source = as_source(maps)
    mapped = [view for view in views if has_map(source, view)]
    reader = MapReader(gaussians, source, RasterSettings(), log, keep=True)
    if not mapped or all(reader.read(view) is None for view in mapped[:1]):
        raise InputError("no feature map for the first of the views; file names must match the view stems")
    generator = torch.Generator().manual_seed(seed)
    space, width, labels = reader.kind
    features = torch.zeros(len(gaussians), channels or width, device=gaussians.device, requires_grad=True)
    decoder = None
    parameters: list[dict[str, object]] = [{"params": [features], "lr": rate}]
    if channels is not None:
        decoder = nn.Linear(channels, width).to(gaussians.device)
        with torch.no_grad():
            features.copy_(0.1 * torch.randn(features.shape, generator=generator))
            decoder.weight.copy_(torch.randn(decoder.weight.shape, generator=generator) / channels**0.5)
            decoder.bias.zero_()
        parameters.append({"params": list(decoder.parameters()), "lr": DECODER_RATE})
    adam = torch.optim.Adam(parameters, eps=1e-15)
    touched = torch.zeros(len(gaussians), dtype=torch.bool, device=gaussians.device)
    seconds, order = 0.0, torch.randperm(len(mapped), generator=generator).tolist()
    for step in range(1, steps + 1):
        if not order:
            order = torch.randperm(len(mapped), generator=generator).tolist()
        view = mapped[order.pop()]
        found = reader.read(view)
        if found is None:
            continue
        start = time.perf_counter()
        with log.stage("fit"):
            target, valid = map_at_pixels(found, view, slice(None), gaussians.device)
            rendered = render_features(gaussians, view.camera.resized(*found.size), features)
            missed = (rendered if decoder is None else decoder(rendered)) - target
            adam.zero_grad()
            _l1(missed, valid).backward()
            assert features.grad is not None
            touched |= features.grad.abs().amax(dim=1) > 0
            adam.step()
        seconds += time.perf_counter() - start
        if look is not None and step in look_at:
            look(Snapshot(step, seconds, _decoded(features, decoder, touched)))
        if progress is not None:
            progress(step, steps, view.stem)
    weight = touched.to(torch.float32)
    decoded = _decoded(features, decoder, touched)
    return Semantics(decoded, weight, weight, space, gaussians.fingerprint, labels)


def render_features(gaussians: Gaussians, camera: Camera, features: Tensor) -> Tensor:
    """Features rendered into a view with gradients to them, float32 [H, W, C]."""
    return rasterize(
        *(gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities),
        *(camera.world_to_camera.float(), camera.K.float(), camera.width, camera.height),
        features=features,
    ).features


def _l1(missed: Tensor, valid: Tensor | None) -> Tensor:
    """Mean absolute difference over the pixels that carry semantics."""
    missed = missed.abs().mean(dim=2)
    return missed.mean() if valid is None else (missed * valid.to(missed)).sum() / valid.sum().clamp(min=1)


@torch.no_grad()
def _decoded(features: Tensor, decoder: nn.Module | None, touched: Tensor) -> Tensor:
    """Features in the channels of the maps, zero where nothing was fitted, float32 [N, C]."""
    full = features.detach().clone() if decoder is None else decoder(features)
    return torch.where(touched[:, None], full, 0.0)
