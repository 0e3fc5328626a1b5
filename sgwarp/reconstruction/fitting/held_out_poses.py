"""Poses of held-out views, refined to a finished scene before it is measured.

Poses that were estimated are off by a fraction of a pixel, those of held-out views as well: measured as they are, a
sharp scene loses decibels that are not its own. The usual remedy where true poses are unknown (BARF, Lin et al. 2021;
NoPe-NeRF, Bian et al. 2023) is to fit the six numbers of each held-out pose to its photograph while the scene stays as
it is. Nothing else is fitted to what is held out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from sgwarp.ops.photometric import photometric_loss
from sgwarp.ops.splatting.autograd import rasterize
from sgwarp.reconstruction.fitting.photographs import Photograph
from sgwarp.reconstruction.fitting.pose_refinement import PoseRefinement
from sgwarp.runs.progress import Report
from sgwarp.scene import Camera, Gaussians

STEP = 1e-2  # unit that the search counts in [radians, and extents of the cameras]; its first step is a fraction of it
MOST_STEPS = 30
LEAST_CHANGE = 1e-9  # of the loss, from which on a search ends


def refine_held_out_poses(
    gaussians: Gaussians,
    photographs: Sequence[Photograph],
    background: Tensor | None,
    similarity_share: float,
    progress: Report | None = None,
) -> list[Camera]:
    """Cameras of photographs, turned and shifted to where the scene looks most like them.

    The loss is that of the fit, the search a quasi-Newton one (L-BFGS). A camera for which it gains nothing keeps its
    pose.

    Args:
        gaussians: The scene, in the frame of the fit; it does not change.
        photographs: With cameras in that frame.
        background: Behind the scene, float32 [3], or None for black.
        similarity_share: Weight of D-SSIM in the loss.
        progress: Called as `progress(done, total, text)`.
    """
    report = progress or (lambda done, total, text: None)
    poses = PoseRefinement([photograph.camera for photograph in photographs], gaussians.device)
    found = []
    for index, photograph in enumerate(photographs):
        report(index, len(photographs), "refining held-out poses")
        search = _Search(gaussians, photograph, background, similarity_share, poses, index)
        pose = poses.world_to_camera(index, search.best_motion())
        found.append(replace(photograph.camera, world_to_camera=pose.cpu()))
    report(len(photographs), len(photographs), "refining held-out poses")
    return found


class _Search:
    """The search for the motion of one camera."""

    def __init__(
        self,
        gaussians: Gaussians,
        photograph: Photograph,
        background: Tensor | None,
        similarity_share: float,
        poses: PoseRefinement,
        index: int,
    ) -> None:
        self.gaussians, self.photograph, self.background = gaussians, photograph, background
        self.share, self.poses, self.index = similarity_share, poses, index
        self.truth = photograph.image(background)

    def best_motion(self) -> Tensor:
        """Rotation vector and shift, float64 [6]; zero if nothing is better."""
        steps = torch.zeros(6, dtype=torch.float64, device=self.gaussians.device, requires_grad=True)
        solver = torch.optim.LBFGS(
            [steps], max_iter=MOST_STEPS, tolerance_change=LEAST_CHANGE, line_search_fn="strong_wolfe"
        )

        def evaluate() -> Tensor:
            solver.zero_grad()
            loss = self._loss(STEP * steps)
            loss.backward()
            return loss

        solver.step(evaluate)
        motion = STEP * steps.detach()
        better = bool(torch.isfinite(motion).all()) and self._value(motion) < self._value(torch.zeros_like(motion))
        return motion if better else torch.zeros_like(motion)

    def _value(self, motion: Tensor) -> float:
        with torch.no_grad():
            return float(self._loss(motion))

    def _loss(self, motion: Tensor) -> Tensor:
        scene, photograph, camera = self.gaussians, self.photograph, self.photograph.camera
        image = rasterize(
            *(scene.means, scene.quats, scene.scales, scene.opacities),
            self.poses.world_to_camera(self.index, motion),
            camera.K,
            camera.width,
            camera.height,
            sh=scene.sh,
            background=self.background,
            near=camera.near,
            far=camera.far,
        ).features
        if photograph.mask is not None:
            image = torch.where(photograph.mask[..., None], image, self.truth)
        return photometric_loss(image, self.truth, self.share)
