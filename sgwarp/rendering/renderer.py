"""A scene seen from a camera: colour, depth, opacity or any per-Gaussian features."""

from __future__ import annotations

from typing import Literal, get_args

from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.ops.splatting.forward import rasterize
from sgwarp.ops.splatting.plan import RenderPlan, Values, plan_render
from sgwarp.ops.splatting.settings import RasterSettings
from sgwarp.runs.log import RunLog
from sgwarp.scene import Camera, Gaussians

NOT_NEEDED = {
    "harmonics": "harmonics_per_gaussian_that_are_zero",
    "colors": "colour_channels_not_asked_for",
    "depth": "depth_images_not_asked_for",
    "record": "images_that_only_gradients_need",
}
RenderMode = Literal["rgb", "depth", "expected_depth", "alpha", "features"]


def render(
    gaussians: Gaussians,
    camera: Camera,
    mode: RenderMode = "rgb",
    features: Tensor | None = None,
    background: Tensor | None = None,
    settings: RasterSettings | None = None,
    log: RunLog | None = None,
) -> Tensor:
    """Render one image, without gradients; `sg.rasterize` has them.

    Args:
        gaussians: The scene.
        camera: Where it is seen from.
        mode: "rgb" (float32 [H, W, 3], not clamped), "depth" (z of the surface, where accumulated opacity passes
            `settings.surface_opacity` [m], 0 where it never does, [H, W]), "expected_depth" (mean z under the blending
            weights [m], [H, W]), "alpha" (accumulated opacity, [H, W]) or "features" (`features` blended, [H, W, C]).
        features: One row per Gaussian, float32 [N, C]; only for mode "features".
        background: What shows where the scene is transparent, one value per channel, [C]; zero if None.
        settings: Thresholds of the rasterizer.
        log: Counts the Gaussians that were left out, by reason, as `culled_...`, and what the plan left out.

    Raises:
        InputError: Unknown mode, or features missing where they are needed or given where they are not.
    """
    if not isinstance(camera, Camera):
        raise InputError(f"camera: expected a Camera, got {type(camera).__name__}; a view has one: view.camera")
    settings = settings or RasterSettings()
    chosen = plan(gaussians, mode, features=features, settings=settings)
    rendering = rasterize(
        gaussians,
        camera,
        features,
        background=background if chosen.values != "nothing" else None,
        expected_depth=mode == "expected_depth",
        depth=mode == "depth",
        settings=settings,
        plan=chosen,
    )
    if log is not None:
        for reason, count in rendering.culled.items():
            log.leave_out(f"culled_{reason}", count)
        for what, amount in chosen.left_out:
            log.leave_out(NOT_NEEDED[what], amount)
    image = rendering.features if chosen.values != "nothing" else getattr(rendering, mode)
    assert isinstance(image, Tensor)
    return image


def plan(
    gaussians: Gaussians,
    mode: RenderMode = "rgb",
    features: Tensor | None = None,
    settings: RasterSettings | None = None,
) -> RenderPlan:
    """The render plan of a call of `render`: what it computes and what it leaves out. `print` shows it.

    Args:
        gaussians: As for `render`.
        mode: As for `render`.
        features: As for `render`.
        settings: As for `render`.

    Raises:
        InputError: Unknown mode, or features missing where they are needed or given where they are not.
    """
    if mode not in get_args(RenderMode):
        raise InputError(f"mode: '{mode}' is not one of {', '.join(get_args(RenderMode))}")
    if (mode == "features") != (features is not None):
        raise InputError(f"mode '{mode}': features [N, C] belong to mode 'features', and only to it")
    if features is not None and features.ndim != 2:
        raise InputError(f"features: expected shape [{len(gaussians)}, C], got {list(features.shape)}")
    values: Values = "colors" if mode == "rgb" else "features" if mode == "features" else "nothing"
    return plan_render(
        gaussians,
        values,
        channels=3 if features is None else features.shape[1],
        depth=mode in ("depth", "expected_depth"),
        settings=settings or RasterSettings(),
    )
