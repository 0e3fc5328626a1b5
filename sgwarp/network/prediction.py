"""Semantics that the network predicts from raw Gaussians: s3D = f3D(G) (paper, Sec. III-C)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.network.inputs import voxelize
from sgwarp.network.semantic_network import SemanticNetwork
from sgwarp.ops.splatting.forward import rasterize
from sgwarp.ops.splatting.settings import RasterSettings
from sgwarp.runs.log import RunLog
from sgwarp.scene import Camera, Gaussians, Semantics


@dataclass(frozen=True, eq=False)
class Prediction:
    """The network's output for a scene, as the input of its last, linear layer.

    That layer has 64 or 96 inputs whatever the size C of the embedding, so the hidden features say all there is to say:
    they are smaller, and cheaper to splat.

    Attributes:
        hidden: Of every voxel, float32 [V, H].
        rows: Voxel of every Gaussian, -1 for none, int64 [N].
        matrix: The last layer, float32 [H, C].
        space: Name of the embedding space.
        fingerprint: `Gaussians.fingerprint` of the scene.
        labels: Names of the channels, if they are labels.
    """

    hidden: Tensor
    rows: Tensor
    matrix: Tensor
    space: str
    fingerprint: str
    labels: tuple[str, ...] | None = None

    @cached_property
    def known(self) -> Tensor:
        """Gaussians that have a prediction, bool [N]."""
        return self.rows >= 0

    @cached_property
    def hidden_of_gaussians(self) -> Tensor:
        """Hidden features of every Gaussian, zero where it has no voxel, float32 [N, H]."""
        return torch.where(self.known[:, None], self.hidden[self.rows.clamp(min=0)], 0.0)

    def semantics(self) -> Semantics:
        """The embedding of every Gaussian. Labels become shares, which are not negative and add up to 1.

        Its weight is 1 where there is a prediction, its effective views 0: no view has been looked at.
        """
        embedded = self.hidden @ self.matrix
        if self.labels is not None:
            embedded = embedded.clamp(min=0.0)
            total = embedded.sum(dim=1, keepdim=True)
            embedded = embedded / torch.where(total > 0, total, 1.0)
        features = torch.where(self.known[:, None], embedded[self.rows.clamp(min=0)], 0.0)
        weight = self.known.to(torch.float32)
        return Semantics(features, weight, torch.zeros_like(weight), self.space, self.fingerprint, self.labels)

    def render(self, gaussians: Gaussians, camera: Camera, settings: RasterSettings | None = None) -> Tensor:
        """The embedding as seen from a camera, float32 [H, W, C]: H channels are splatted, then mapped pixel by pixel.

        Both steps are linear, so this is the splatted embedding itself, up to rounding. Not normalised. Labels are
        few, and their shares are not linear in the hidden features: they are splatted themselves.

        Raises:
            InputError: The prediction belongs to another scene.
        """
        if self.fingerprint != gaussians.fingerprint:
            raise InputError("the prediction belongs to another scene; predict this one")
        settings = settings or RasterSettings()
        if self.labels is not None:
            return rasterize(gaussians, camera, self.semantics().features, settings=settings).features
        return rasterize(gaussians, camera, self.hidden_of_gaussians, settings=settings).features @ self.matrix


def predict(gaussians: Gaussians, network: SemanticNetwork, *, log: RunLog | None = None) -> Prediction:
    """Run the network over a scene, on the network's device.

    Args:
        gaussians: The scene.
        network: Trained by `distill`, or loaded from a checkpoint.
        log: Receives the times, and how many Gaussians have no voxel (not finite, or too far out).

    Raises:
        InputError: The scene has no Gaussian that falls into a voxel.
    """
    log = log if log is not None else RunLog(device=str(network.device))
    gaussians = gaussians.to(network.device)
    with log.stage("voxelize"):
        voxels, rows = voxelize(gaussians, network.inputs, network.voxel)
    log.leave_out("gaussians_without_voxel", int((rows < 0).sum()))
    log.leave_out("gaussians_that_share_a_voxel", int((rows >= 0).sum()) - len(voxels.features))
    network.net.eval()
    with log.stage("network"), torch.no_grad():
        voxels = voxels.with_features(voxels.features.to(network.net.final.kernel.dtype))
        hidden = network.net.hidden(voxels).features.float()
    if not bool(torch.isfinite(hidden).all()):
        raise InputError("the network's output is not finite: its weights are damaged, or were trained to infinity")
    matrix = network.net.final.kernel.detach().float()
    return Prediction(hidden, rows, matrix, network.space, gaussians.fingerprint, network.labels)
