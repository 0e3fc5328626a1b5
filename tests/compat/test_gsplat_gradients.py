"""Gradients through the gsplat facade against central differences of the float64 oracle: nothing here is autograd's.

Two scenes in a batch, two cameras each. A pose moves rigidly, by a twist that is applied to it; a covariance moves as
that of a quaternion and scales, whose directions reach all of its six numbers.
"""

import math

import pytest
import torch
from torch import Tensor

from sgwarp.compat import gsplat
from sgwarp.ops.reference import rasterizer as reference

pytestmark = pytest.mark.slow

BATCH, CAMERAS = 2, 2
BOUNDARY_BAND = 1e-4  # pixels nearer than this to a threshold, or to a change of the order, may flip in float32
ORDER_BAND = 1e-6


def moved_poses(viewmats: Tensor, twists: Tensor) -> Tensor:
    """Poses turned and shifted by twists (rotation vector, translation), [..., 6]."""
    x, y, z, *shift = twists.unbind(-1)
    none = torch.zeros_like(x)
    rows = ((none, -z, y, shift[0]), (z, none, -x, shift[1]), (-y, x, none, shift[2]), (none,) * 4)
    generator = torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
    return torch.linalg.matrix_exp(generator) @ viewmats.to(twists)


def covariances(quats: Tensor, scales: Tensor) -> Tensor:
    axes = reference.rotation_matrices(quats.flatten(0, -2)) * scales.flatten(0, -2)[:, None]
    return (axes @ axes.transpose(1, 2)).reshape(*scales.shape, 3)


def inputs(raw, channels: int | None) -> dict[str, Tensor]:
    """Everything that a gradient can flow to, float32, with a batch dimension; the second scene is another one."""
    rng = torch.Generator().manual_seed(4)
    means, quats, scales, opacities, sh = (t.expand(BATCH, *t.shape).clone() for t in (*raw.shape, raw.sh))
    means[1] += 0.2 * torch.randn(means[1].shape, generator=rng)
    colors = sh if channels is None else torch.rand(BATCH, CAMERAS, 60, channels, generator=rng)
    return {
        "means": means,
        "quats": quats,
        "scales": scales * torch.tensor([1.0, 0.7, 1.4]),
        "opacities": opacities,
        "colors": colors,
        "twists": torch.zeros(BATCH, CAMERAS, 6),
        "backgrounds": torch.rand(BATCH, CAMERAS, channels or 3, generator=rng),
    }


def expected(t: dict[str, Tensor], raw, mode: str, antialiased: bool) -> tuple[Tensor, Tensor, Tensor]:
    """Images and opacities of the oracle, and where float32 can decide."""
    settings = reference.ReferenceSettings(antialiased=antialiased)
    poses = moved_poses(raw.viewmats.expand(BATCH, -1, -1, -1), t["twists"])
    images, alphas, clear = [], [], []
    for image in range(BATCH * CAMERAS):
        b, c = divmod(image, CAMERAS)
        shape = [t[name][b] for name in ("means", "quats", "scales", "opacities")]
        projection = reference.project(
            *shape, poses[b, c], raw.Ks[c].double(), raw.width, raw.height, settings=settings
        )
        colors = t["colors"][b, c] if t["colors"].shape[1] == CAMERAS else None
        if colors is None:
            colors = reference.spherical_harmonics(t["means"][b], t["colors"][b], poses[b, c], degree=2)
        raster = reference.composite(projection, colors, raw.width, raw.height, t["backgrounds"][b, c], settings)
        depth = raster.expected_depth * (raster.alpha if mode in ("D", "RGB+D") else 1.0)
        channels = [raster.features] if "RGB" in mode else []
        channels += [depth[..., None]] if "D" in mode else []
        images.append(torch.cat(channels, dim=-1))
        alphas.append(raster.alpha)
        clear.append((raster.margin > BOUNDARY_BAND) & (raster.order_margin > ORDER_BAND))
    stacked = (torch.stack(parts).unflatten(0, (BATCH, CAMERAS)) for parts in (images, alphas, clear))
    return tuple(stacked)


def compare(compare_with, raw, mode, antialiased, packed, channels=None, by_covariance=False) -> None:
    start = inputs(raw, channels)
    point = {name: tensor.double() for name, tensor in start.items()}
    images, alphas, clear = expected(point, raw, mode, antialiased)
    assert clear.double().mean() > 0.9
    rng = torch.Generator().manual_seed(5)
    on_image = torch.randn(images.shape, generator=rng, dtype=torch.float64) * clear[..., None]
    on_alpha = torch.randn(alphas.shape, generator=rng, dtype=torch.float64) * clear

    def loss(t: dict[str, Tensor]) -> Tensor:
        images, alphas, _ = expected(t, raw, mode, antialiased)
        return (images * on_image).sum() + (alphas * on_alpha).sum()

    t = {name: tensor.clone().requires_grad_() for name, tensor in start.items()}
    shape = {"quats": t["quats"], "scales": t["scales"]}
    if by_covariance:
        shape = {
            "quats": None,
            "scales": None,
            "covars": covariances(t["quats"].double(), t["scales"].double()).float(),
        }
    got, got_alphas, _ = gsplat.rasterization(
        means=t["means"],
        **shape,
        opacities=t["opacities"],
        colors=t["colors"],
        viewmats=moved_poses(raw.viewmats.expand(BATCH, -1, -1, -1), t["twists"]),
        Ks=raw.Ks.expand(BATCH, -1, -1, -1),
        width=raw.width,
        height=raw.height,
        sh_degree=2 if channels is None else None,
        packed=packed,
        backgrounds=t["backgrounds"],
        render_mode=mode,
        rasterize_mode="antialiased" if antialiased else "classic",
    )
    ((got * on_image).sum() + (got_alphas[..., 0] * on_alpha).sum()).backward()
    unused = {"colors", "backgrounds"} if "RGB" not in mode else set()
    compare_with(loss, point, {name: leaf.grad for name, leaf in t.items() if name not in unused})


@pytest.mark.parametrize(("mode", "antialiased"), [("RGB", False), ("RGB", True), ("RGB+D", True), ("RGB+ED", False)])
def test_batches_and_cameras(raw, assert_central_differences, mode, antialiased):
    compare(assert_central_differences, raw, mode, antialiased, packed=False)


@pytest.mark.parametrize("mode", ["D", "ED"])
def test_depth_alone(raw, assert_central_differences, mode):
    compare(assert_central_differences, raw, mode, antialiased=False, packed=True)


@pytest.mark.parametrize("channels", [1, 7])
def test_colors_per_camera(raw, assert_central_differences, channels):
    compare(assert_central_differences, raw, "RGB+ED", False, True, channels)


@pytest.mark.parametrize("antialiased", [False, True])
def test_covariances(raw, assert_central_differences, antialiased):
    compare(assert_central_differences, raw, "RGB+D", antialiased, True, by_covariance=True)


def test_a_twist_is_a_rigid_motion(raw):
    twists = torch.tensor([0.3, -0.2, 0.1, 0.5, 0.6, -0.7], dtype=torch.float64).expand(2, 6)
    moved = moved_poses(raw.viewmats, twists)
    R = moved[:, :3, :3]
    torch.testing.assert_close(
        R @ R.transpose(1, 2), torch.eye(3, dtype=torch.float64).expand(2, 3, 3), rtol=0, atol=1e-6
    )
    angle = (torch.einsum("bij,bij->b", R, raw.viewmats[:, :3, :3].double()) - 1) / 2
    assert torch.allclose(angle.acos(), torch.tensor(math.sqrt(0.14), dtype=torch.float64), atol=1e-5)
