"""The gsplat facade against the native rasterizer, and what its arguments promise."""

import math

import pytest
import torch

from sgwarp.compat import gsplat
from sgwarp.errors import InputError
from sgwarp.ops.reference import rasterizer as reference
from sgwarp.ops.splatting.forward import rasterize
from sgwarp.ops.splatting.settings import RasterSettings
from sgwarp.scene import Camera, Gaussians

META_KEYS = {
    *("batch_ids", "camera_ids", "gaussian_ids", "radii", "means2d", "depths", "conics", "opacities"),
    *("tile_width", "tile_height", "tiles_per_gauss", "isect_ids", "flatten_ids", "isect_offsets"),
    *("width", "height", "tile_size", "n_batches", "n_cameras"),
}


def native_view(raw, camera):
    """The same scene and one of its cameras as the native types."""
    pose = raw.viewmats[camera].double()
    pose[3] = torch.tensor([0.0, 0.0, 0.0, 1.0])
    return Gaussians(*raw.shape, raw.sh), Camera(raw.Ks[camera], pose, raw.width, raw.height)


@pytest.mark.parametrize("antialiased", [False, True])
def test_equals_the_native_rasterizer(raw, antialiased):
    mode = "antialiased" if antialiased else "classic"
    background = torch.tensor([[0.1, 0.5, 0.9], [0.3, 0.2, 0.7]])
    colors, alphas, _ = gsplat.rasterization(
        *raw.shape, raw.sh, *raw.camera, sh_degree=3, backgrounds=background, rasterize_mode=mode, render_mode="RGB+ED"
    )
    for c in range(2):
        native = rasterize(
            *native_view(raw, c),
            background=background[c],
            expected_depth=True,
            settings=RasterSettings(antialiased=antialiased),
        )
        torch.testing.assert_close(colors[c, ..., :3], native.features, rtol=0, atol=5e-6)
        torch.testing.assert_close(colors[c, ..., 3], native.expected_depth, rtol=0, atol=5e-5)
        torch.testing.assert_close(alphas[c, ..., 0], native.alpha, rtol=0, atol=5e-6)


@pytest.mark.slow
def test_matches_the_oracle_on_every_scene(scene):
    _, g, camera = scene
    features = torch.rand(len(g), 5, generator=torch.Generator().manual_seed(1))
    expected = reference.rasterize(g, camera, features.double())
    colors, alphas, _ = gsplat.rasterization(
        g.means,
        g.quats,
        g.scales,
        g.opacities,
        features,
        camera.world_to_camera[None],
        camera.K[None],
        camera.width,
        camera.height,
    )
    clear = expected.margin > 1e-4
    torch.testing.assert_close(colors[0].double()[clear], expected.features[clear], rtol=0, atol=2e-5)
    torch.testing.assert_close(alphas[0, ..., 0].double()[clear], expected.alpha[clear], rtol=0, atol=2e-5)


@pytest.mark.parametrize("mode", ["RGB", "D", "ED", "RGB+D", "RGB+ED"])
@pytest.mark.parametrize("channels", [1, 2, 3, 7, 40])
def test_channels_and_modes(raw, mode, channels):
    """Any number of channels gives, channel by channel, what the others give; depth does not depend on them."""
    values = torch.rand(60, channels, generator=torch.Generator().manual_seed(channels))
    background = torch.rand(2, channels, generator=torch.Generator().manual_seed(9))
    render = lambda v, m, b=None: gsplat.rasterization(*raw.shape, v, *raw.camera, render_mode=m, backgrounds=b)  # noqa: E731
    colors, alphas, _ = render(values, mode, background)
    with_rgb, with_depth = "RGB" in mode, "D" in mode
    assert colors.shape == (2, raw.height, raw.width, channels * with_rgb + with_depth)
    if with_rgb:
        alone = [render(values[:, k : k + 1], "RGB", background[:, k : k + 1])[0] for k in (0, channels - 1)]
        torch.testing.assert_close(colors[..., :1], alone[0], rtol=0, atol=2e-6)
        torch.testing.assert_close(colors[..., channels - 1 : channels], alone[1], rtol=0, atol=2e-6)
    if with_depth:
        depth = render(torch.zeros(60, 1), mode[-2:].replace("+", ""), None)[0]
        torch.testing.assert_close(colors[..., -1:], depth, rtol=0, atol=5e-5)
    assert alphas.shape == (2, raw.height, raw.width, 1)


@pytest.mark.parametrize("packed", [False, True])
def test_batches_and_cameras_equal_single_calls(raw, packed):
    """Two batch dimensions, two cameras each, colours per camera."""
    rng = torch.Generator().manual_seed(2)
    batch = (3, 2)
    means, quats, scales, opacities = (t.expand(*batch, *t.shape).clone() for t in raw.shape)
    means += 0.2 * torch.randn(means.shape, generator=rng)
    colors = torch.rand(*batch, 2, 60, 4, generator=rng)
    cameras = [t.expand(*batch, *t.shape) for t in (raw.viewmats, raw.Ks)]
    backgrounds = torch.rand(*batch, 2, 4, generator=rng)
    got, alphas, meta = gsplat.rasterization(
        means, quats, scales, opacities, colors, *cameras, raw.width, raw.height, packed=packed, backgrounds=backgrounds
    )
    assert got.shape == (*batch, 2, raw.height, raw.width, 4)
    assert alphas.shape == (*batch, 2, raw.height, raw.width, 1)
    for b0, b1, c in ((0, 0, 0), (2, 1, 1), (1, 0, 1)):
        at = (b0, b1)
        alone, *_ = gsplat.rasterization(
            *(t[at] for t in (means, quats, scales, opacities)),
            colors[(*at, c)],
            raw.viewmats[c : c + 1],
            raw.Ks[c : c + 1],
            raw.width,
            raw.height,
            backgrounds=backgrounds[(*at, slice(c, c + 1))],
        )
        assert torch.equal(got[(*at, c)], alone[0])
    assert (meta["n_batches"], meta["n_cameras"]) == (6, 2)
    assert meta["isect_offsets"].shape == (*batch, 2, 3, 3)
    if packed:
        assert meta["batch_ids"].max() == 5
        assert meta["camera_ids"].max() == 1
        rows = meta["batch_ids"] * 120 + meta["camera_ids"] * 60 + meta["gaussian_ids"]
        assert (rows[1:] > rows[:-1]).all()
    else:
        assert meta["radii"].shape == (*batch, 2, 60, 2)


def test_meta_is_gsplats(raw):
    outs = [gsplat.rasterization(*raw.shape, raw.colors, *raw.camera, packed=packed) for packed in (False, True)]
    for colors, alphas, meta in outs:
        assert set(meta) == META_KEYS
        assert torch.equal(colors, outs[0][0])
        assert torch.equal(alphas, outs[0][1])
        assert (meta["tile_width"], meta["tile_height"], meta["tile_size"]) == (3, 3, 16)
        assert meta["isect_ids"].dtype == torch.int64
        assert meta["flatten_ids"].dtype == meta["radii"].dtype == meta["tiles_per_gauss"].dtype == torch.int32
        assert int(meta["tiles_per_gauss"].sum()) == len(meta["flatten_ids"]) == len(meta["isect_ids"])
        assert (meta["isect_ids"][1:] >= meta["isect_ids"][:-1]).all()
    dense, packed = outs[0][2], outs[1][2]
    assert dense["gaussian_ids"] is None
    for name in ("radii", "means2d", "depths", "conics", "opacities", "tiles_per_gauss"):
        assert torch.equal(dense[name][packed["camera_ids"], packed["gaussian_ids"]], packed[name]), name
    hidden = (dense["radii"] == 0).all(-1)
    assert hidden.any()
    for name in ("means2d", "depths", "conics", "opacities", "tiles_per_gauss"):
        assert (dense[name][hidden] == 0).all(), name


@pytest.mark.parametrize("packed", [False, True])
def test_own_tile_lists_give_the_same_image_again(raw, packed):
    """What `meta` holds is what `rasterize_to_pixels` takes."""
    colors, alphas, meta = gsplat.rasterization(*raw.shape, raw.colors, *raw.camera, packed=packed)
    values = raw.colors[meta["gaussian_ids"]] if packed else raw.colors.expand(2, -1, -1)
    splats = [meta[name] for name in ("means2d", "conics")]
    lists = (meta["isect_offsets"], meta["flatten_ids"])
    image, opacity = gsplat.rasterize_to_pixels(
        *splats, values, meta["opacities"], raw.width, raw.height, 16, *lists, packed=packed
    )
    torch.testing.assert_close(image, colors, rtol=0, atol=2e-6)
    torch.testing.assert_close(opacity, alphas, rtol=0, atol=2e-6)


def test_tile_masks(raw):
    _, _, meta = gsplat.rasterization(*raw.shape, raw.colors, *raw.camera, packed=False)
    masks = torch.ones(2, 3, 3, dtype=torch.bool)
    masks[0, 1, 1] = masks[1, 0, 2] = False
    backgrounds = torch.rand(2, 3, generator=torch.Generator().manual_seed(1))
    means2d = meta["means2d"].clone().requires_grad_()
    arguments = (meta["conics"], raw.colors.expand(2, -1, -1), meta["opacities"], raw.width, raw.height, 16)
    lists = (meta["isect_offsets"], meta["flatten_ids"])
    whole, _ = gsplat.rasterize_to_pixels(means2d, *arguments, *lists, backgrounds=backgrounds)
    image, alpha = gsplat.rasterize_to_pixels(means2d, *arguments, *lists, backgrounds=backgrounds, masks=masks)
    shown = masks.repeat_interleave(16, 1).repeat_interleave(16, 2)[:, : raw.height, : raw.width]
    assert torch.equal(image[shown], whole[shown])
    assert torch.equal(image[~shown], backgrounds[:, None, None].expand_as(image)[~shown])
    assert (alpha[~shown[..., None]] == 0).all()
    (image * ~shown[..., None]).sum().backward()
    assert (means2d.grad == 0).all()


@pytest.mark.parametrize("model", ["pinhole", "ortho", "fisheye"])
def test_covariances_give_the_image_of_quaternions_and_scales(raw, model):
    Ks = raw.Ks * (torch.tensor([[0.3], [0.3], [1.0]]) if model == "ortho" else 1.0)
    camera = (raw.viewmats, Ks, raw.width, raw.height)
    covars, _ = gsplat.quat_scale_to_covar_preci(raw.quats, raw.scales)
    by_shape, alphas, _ = gsplat.rasterization(*raw.shape, raw.colors, *camera, camera_model=model)
    by_covars, *_ = gsplat.rasterization(
        raw.means, None, None, raw.opacities, raw.colors, *camera, camera_model=model, covars=covars
    )
    assert alphas.mean() > 0.1
    torch.testing.assert_close(by_covars, by_shape, rtol=0, atol=1e-4)


def test_ranges_and_radius_clip(raw):
    everything = gsplat.rasterization(*raw.shape, raw.colors, *raw.camera)[2]
    some = gsplat.rasterization(*raw.shape, raw.colors, *raw.camera, near_plane=2.6, far_plane=4.0)[2]
    kept = (everything["depths"] > 2.6) & (everything["depths"] < 4.0)
    assert 0 < kept.sum() < len(kept)
    assert torch.equal(some["gaussian_ids"], everything["gaussian_ids"][kept])
    clipped = gsplat.rasterization(*raw.shape, raw.colors, *raw.camera, radius_clip=9.0)[2]
    kept = (everything["radii"] > 9).any(-1)
    assert 0 < kept.sum() < len(kept)
    assert torch.equal(clipped["gaussian_ids"], everything["gaussian_ids"][kept])


@pytest.mark.cpu_only("gradients of results do not come back from the device")
@pytest.mark.parametrize("packed", [False, True])
def test_gradients_of_centres(raw, packed):
    """`means2d` can retain its gradient; `absgrad` is never smaller, and equal if one pixel decides."""
    means = raw.means.clone().requires_grad_()
    arguments = (means, *raw.shape[1:], raw.colors, *raw.camera)
    colors, _, meta = gsplat.rasterization(*arguments, packed=packed, absgrad=True)
    meta["means2d"].retain_grad()
    colors.square().sum().backward()
    signed, magnitude = meta["means2d"].grad, meta["means2d"].absgrad
    assert magnitude.shape == signed.shape == meta["means2d"].shape
    assert (magnitude >= signed.abs() * (1 - 1e-4) - 1e-6).all()
    assert (magnitude > 1.5 * signed.abs() + 1e-3).any()
    colors, _, meta = gsplat.rasterization(*arguments, packed=packed, absgrad=True)
    meta["means2d"].retain_grad()
    colors[0, 18, 22].sum().backward()
    torch.testing.assert_close(meta["means2d"].absgrad, meta["means2d"].grad.abs(), rtol=1e-4, atol=1e-6)
    assert (meta["means2d"].absgrad > 0).any()


def test_gradients_do_not_depend_on_the_layout(raw):
    """Packed, dense and sparse gradients are the same numbers."""
    found = []
    for layout in ({"packed": False}, {"packed": True}, {"packed": True, "sparse_grad": True}):
        leaves = [t.clone().requires_grad_() for t in (*raw.shape, raw.sh)]
        colors, *_ = gsplat.rasterization(*leaves, *raw.camera, sh_degree=1, render_mode="RGB+D", **layout)
        colors.sin().sum().backward()
        found.append([leaf.grad for leaf in leaves])
    assert [g.is_sparse for g in found[2]] == [True, True, True, False, False]
    for dense, packed, sparse in zip(*found, strict=True):
        torch.testing.assert_close(packed, dense, rtol=1e-5, atol=1e-6)
        torch.testing.assert_close(sparse.to_dense() if sparse.is_sparse else sparse, dense, rtol=1e-5, atol=1e-6)


def test_pixel_pairs_give_the_image(raw):
    """rasterize_to_indices_in_range and accumulate, in one go and batch by batch."""
    colors, alphas, meta = gsplat.rasterization(*raw.shape, raw.colors, *raw.camera, packed=False)
    splats = (meta["means2d"], meta["conics"], meta["opacities"])
    lists = (raw.width, raw.height, 4, *_fine_lists(meta, raw))
    values = raw.colors.expand(2, -1, -1)
    T = torch.ones(2, raw.height, raw.width)
    pairs = gsplat.rasterize_to_indices_in_range(0, int(1e10), T, *splats, *lists)
    image, alpha = gsplat.accumulate(*splats, values, *pairs, raw.width, raw.height)
    torch.testing.assert_close(image, colors, rtol=0, atol=2e-6)
    torch.testing.assert_close(alpha, alphas, rtol=0, atol=2e-6)
    total, covered = torch.zeros_like(image), torch.zeros_like(alpha)
    count = 0
    for step in range(100):
        T = 1.0 - covered[..., 0]
        found = gsplat.rasterize_to_indices_in_range(step, step + 1, T, *splats, *lists)
        if len(found[0]) == 0:
            break
        part, opacity = gsplat.accumulate(*splats, values, *found, raw.width, raw.height)
        total, covered = total + part * T[..., None], covered + opacity * T[..., None]
        count += len(found[0])
    assert step > 1
    assert count == len(pairs[0])
    torch.testing.assert_close(total, image, rtol=0, atol=2e-6)


def _fine_lists(meta, raw):
    """Tile lists for tiles of 4 x 4, whose batches of 16 are short enough for several."""
    columns, rows = -(-raw.width // 4), -(-raw.height // 4)
    _, keys, listed = gsplat.isect_tiles(meta["means2d"], meta["radii"], meta["depths"], 4, columns, rows)
    return gsplat.isect_offset_encode(keys, 2, columns, rows), listed


def test_pixel_pairs_against_a_plain_loop(raw):
    """Three pixels by hand: which Gaussians, in which order, and what they add up to, with gradients."""
    _, _, meta = gsplat.rasterization(*raw.shape, raw.colors, *raw.camera, packed=False)
    splats = [meta[n].double().requires_grad_() for n in ("means2d", "conics", "opacities")]
    values = raw.colors.expand(2, -1, -1).double().requires_grad_()
    lists = (raw.width, raw.height, 16, meta["isect_offsets"], meta["flatten_ids"])
    pairs = gsplat.rasterize_to_indices_in_range(0, 1000, torch.ones(2, raw.height, raw.width), *splats, *lists)
    image, _ = gsplat.accumulate(*splats, values, *pairs, raw.width, raw.height)
    for i, y, x in ((0, 20, 24), (1, 15, 6), (1, 36, 0)):
        wanted, T = [], 1.0
        color = torch.zeros(3, dtype=torch.float64)
        for g in meta["depths"][i].argsort(stable=True).tolist():
            if (meta["radii"][i, g] == 0).any():
                continue
            dx, dy = torch.tensor([x + 0.5, y + 0.5]) - splats[0][i, g]
            A, B, C = splats[1][i, g]
            alpha = (splats[2][i, g] * torch.exp(-0.5 * (A * dx**2 + C * dy**2) - B * dx * dy)).clamp(max=0.999)
            if alpha < 1 / 255:
                continue
            wanted.append(g)
            color = color + T * alpha * values[i, g]
            T = T * (1 - alpha)
        here = (pairs[2] == i) & (pairs[1] == y * raw.width + x)
        assert pairs[0][here].tolist() == wanted
        assert len(wanted) > 1
        torch.testing.assert_close(image[i, y, x], color, rtol=0, atol=1e-12)
        for a, b in zip(
            torch.autograd.grad(image[i, y, x].sum(), [*splats, values], retain_graph=True),
            torch.autograd.grad(color.sum(), [*splats, values]),
            strict=True,
        ):
            torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-12)


def test_bad_gaussians_are_left_out(raw):
    """NaN, infinity and quaternions without direction change nothing, and get gradients of zero."""
    clean, *_ = gsplat.rasterization(*raw.shape, raw.colors, *raw.camera)
    bad = [torch.cat([t, t[:5]]).requires_grad_(False) for t in (*raw.shape, raw.colors)]
    bad[0][60, 1] = math.nan
    bad[0][61, 2] = math.inf
    bad[1][62] = 0.0
    bad[2][63, 0] = math.inf
    bad[3][64] = math.nan
    leaves = [t.requires_grad_() for t in bad]
    colors, _, meta = gsplat.rasterization(*leaves, *raw.camera, packed=False, render_mode="RGB+ED")
    torch.testing.assert_close(colors[..., :3], clean, rtol=0, atol=0)
    assert (meta["radii"][:, 60:] == 0).all()
    colors.sum().backward()
    for leaf in leaves:
        assert torch.isfinite(leaf.grad).all()
        assert (leaf.grad[60:] == 0).all()


@pytest.mark.parametrize("packed", [False, True])
def test_nothing_to_see(raw, packed):
    """No Gaussians at all, or all behind the camera: the background, and a backward pass."""
    backgrounds = torch.rand(2, 3, generator=torch.Generator().manual_seed(1))
    behind = raw.replace(means=raw.means - torch.tensor([0.0, 0.0, 20.0]))
    empty = raw.replace(
        **{name: getattr(raw, name)[:0] for name in ("means", "quats", "scales", "opacities", "colors")}
    )
    for scene in (behind, empty):
        leaves = [t.clone().requires_grad_() for t in (*scene.shape, scene.colors)]
        colors, alphas, meta = gsplat.rasterization(*leaves, *raw.camera, backgrounds=backgrounds, packed=packed)
        assert torch.equal(colors, backgrounds[:, None, None].expand_as(colors))
        assert (alphas == 0).all()
        assert len(meta["flatten_ids"]) == 0
        colors.sum().backward()
        assert all(leaf.grad is None or (leaf.grad == 0).all() for leaf in leaves)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("distributed", True),
        ("with_ut", True),
        ("with_eval3d", True),
        ("radial_coeffs", torch.zeros(2, 6)),
        ("tangential_coeffs", torch.zeros(2, 2)),
        ("thin_prism_coeffs", torch.zeros(2, 4)),
        ("ftheta_coeffs", object()),
        ("rolling_shutter", gsplat.RollingShutterType.ROLLING_TOP_TO_BOTTOM),
        ("viewmats_rs", torch.eye(4).expand(2, 4, 4)),
        ("tile_size", 8),
        ("camera_model", "ftheta"),
        ("render_mode", "depth"),
        ("rasterize_mode", "sharp"),
        ("near_plane", 1e11),
        ("sh_degree", 3),
        ("backgrounds", torch.zeros(2, 4)),
        ("covars", torch.zeros(60, 6)),
    ],
)
def test_what_is_refused_is_named(raw, name, value):
    with pytest.raises(InputError, match=name if name != "sh_degree" else "colors") as caught:
        gsplat.rasterization(*raw.shape, raw.colors, *raw.camera, **{name: value})
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "shape"),
    [
        ("means", (60, 2)),
        ("quats", (59, 4)),
        ("scales", (60,)),
        ("opacities", (60, 1)),
        ("colors", (3, 60, 3)),
        ("viewmats", (2, 3, 4)),
        ("Ks", (3, 3, 3)),
    ],
)
def test_wrong_shapes_are_named(raw, name, shape):
    arguments = {n: getattr(raw, n) for n in ("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks")}
    arguments[name] = torch.zeros(shape)
    with pytest.raises(InputError, match=f"^{name}: expected"):
        gsplat.rasterization(**arguments, width=raw.width, height=raw.height)


def test_other_mistakes_are_named(raw):
    with pytest.raises(InputError, match="viewmats"):
        gsplat.rasterization(*raw.shape, raw.colors, raw.viewmats[:0], raw.Ks[:0], raw.width, raw.height)
    with pytest.raises(InputError, match="sparse_grad"):
        gsplat.fully_fused_projection(raw.means, None, raw.quats, raw.scales, *raw.camera, sparse_grad=True)
    with pytest.raises(InputError, match="image_ids"):
        gsplat.isect_tiles(torch.zeros(5, 2), torch.zeros(5, 2), torch.zeros(5), 16, 3, 3, packed=True)
    with pytest.raises(InputError, match="degrees_to_use"):
        gsplat.spherical_harmonics(2, torch.zeros(5, 3), torch.zeros(5, 4, 3))
    with pytest.raises(InputError, match="64-bit"):
        gsplat.isect_tiles(torch.zeros(2**16, 0, 2), torch.zeros(2**16, 0, 2), torch.zeros(2**16, 0), 1, 2**9, 2**9)
