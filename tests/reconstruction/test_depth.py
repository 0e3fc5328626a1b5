"""Gaussians from RGB-D views, against surfaces whose points, normals and moments are known in closed form."""

import math

import numpy as np
import pytest
import torch

from sgwarp.errors import InputError
from sgwarp.ops.splatting.forward import rasterize
from sgwarp.reconstruction import depth as from_depth
from sgwarp.reconstruction.depth import gaussians_from_depth
from sgwarp.reconstruction.rgbd import observe
from sgwarp.scene import Camera, View

WIDTH, HEIGHT, FOCAL = 64, 48, 60.0


def camera(z=0.0, width=WIDTH, height=HEIGHT, yaw=0.0):
    """At (0, 0, z), looking along z, turned about y; the principal point is off centre."""
    K = torch.tensor([[FOCAL, 0, width / 2 + 1], [0, FOCAL, height / 2 - 2], [0, 0, 1.0]])
    c, s = math.cos(yaw), math.sin(yaw)
    rotation = torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]], dtype=torch.float64)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ torch.tensor([0, 0, z], dtype=torch.float64)
    return Camera(K, pose, width, height)


def rays(view):
    """Directions with z = 1 in the camera, float64 [H, W, 3]."""
    x = (np.arange(view.width) + 0.5 - view.K[0, 2].item()) / FOCAL
    y = (np.arange(view.height) + 0.5 - view.K[1, 2].item()) / FOCAL
    return np.stack([*np.meshgrid(x, y), np.ones((view.height, view.width))], axis=-1)


def plane_depth(view, normal, offset):
    """Depth of the plane normal . p = offset, p in the world."""
    rotation, position = view.world_to_camera[:3, :3].numpy(), view.position.numpy()
    return ((offset - normal @ position) / (rays(view) @ rotation @ normal)).astype(np.float32)


def sphere_depth(view, centre, radius):
    """Depth of a sphere, 0 around it; the camera is not rotated."""
    d, o = rays(view), np.asarray(centre) - view.position.numpy()
    a, b, c = (d * d).sum(-1), (d * o).sum(-1), o @ o - radius**2
    root = b * b - a * c
    return np.where(root > 0, (b - np.sqrt(root.clip(min=0))) / a, 0).astype(np.float32)


def grey(view, value=0.5):
    return np.full((*view.camera.size, 3), value, np.float32)


def checks(view, side=3):
    """Squares of `side` pixels in two colours: there is no even window."""
    rows, columns = np.indices(view.camera.size) // side
    return np.where(((rows + columns) % 2)[..., None], (0.9, 0.2, 0.1), (0.1, 0.2, 0.8)).astype(np.float32)


def rotation_of(quats):
    """Rotation matrices of quaternions (w, x, y, z), [N, 3, 3]."""
    w, x, y, z = quats.double().unbind(1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, dim=1) for row in rows], dim=1)


NORMAL = np.array([0.5, -0.3, 1.0]) / np.linalg.norm([0.5, -0.3, 1.0])


def test_pixels_of_a_tilted_plane():
    view = camera(z=-0.5, yaw=0.2)
    depth = plane_depth(view, NORMAL, 2.0)
    pixels = observe(view, depth, np.full((HEIGHT, WIDTH, 3), 0.5, np.float32))
    np.testing.assert_allclose(pixels.centres @ NORMAL, 2.0, atol=1e-5)
    grid = pixels.centres.reshape(HEIGHT, WIDTH, 3)
    for step, tangent, axis in (("right", pixels.right, 1), ("down", pixels.down, 0)):
        tangent = tangent.reshape(HEIGHT, WIDTH, 3)
        np.testing.assert_allclose(tangent @ NORMAL, 0, atol=2e-5, err_msg=step)
        # A central difference is the derivative up to second order.
        central = (
            np.take(grid, range(2, grid.shape[axis]), axis) - np.take(grid, range(grid.shape[axis] - 2), axis)
        ) / 2
        inner = np.take(tangent, range(1, grid.shape[axis] - 1), axis)
        np.testing.assert_allclose(inner, central, rtol=2e-3, atol=1e-5, err_msg=step)
    np.testing.assert_allclose(pixels.footprint, depth.ravel() / FOCAL, rtol=1e-5)
    assert (pixels.uniform.reshape(HEIGHT, WIDTH) == 32).all()


def test_pixels_do_not_bridge_a_jump():
    depth = np.full((HEIGHT, WIDTH), 3.0, np.float32)
    depth[:, WIDTH // 2 :] = 1.0
    depth[:10] = 0  # nothing there
    pixels = observe(camera(), depth, np.full((HEIGHT, WIDTH, 3), 0.5, np.float32))
    assert len(pixels.centres) == (HEIGHT - 10) * WIDTH
    z = pixels.centres[:, 2]
    np.testing.assert_allclose(pixels.right, np.outer(z / FOCAL, (1, 0, 0)), atol=1e-6)
    np.testing.assert_allclose(pixels.down, np.outer(z / FOCAL, (0, 1, 0)), atol=1e-6)
    uniform = pixels.uniform.reshape(HEIGHT - 10, WIDTH)
    assert (uniform[:, [WIDTH // 2 - 1, WIDTH // 2]] == 1).all()
    assert (uniform[0] == 1).all()
    assert uniform[20, 5] > 1


@pytest.mark.parametrize(("footprints", "followed"), [(2.5, True), (3.5, False), (15.0, False)])
def test_two_pixels_alone_are_one_surface_only_if_they_lie_close(footprints, followed):
    """Columns in pairs: no third pixel tells a slope from a jump, so only a small change is taken for a slope."""
    depth = np.zeros((HEIGHT, WIDTH), np.float32)  # nothing between the pairs
    depth[:, 0:-1:3], depth[:, 1::3] = 3.0, 3.0 + footprints * 3.0 / FOCAL
    pixels = observe(camera(), depth, np.full((HEIGHT, WIDTH, 3), 0.5, np.float32))
    assert (np.abs(pixels.right[:, 2]) > 0.5 * footprints * 3.0 / FOCAL).all() == followed
    assert np.any(pixels.right[:, 2]) == followed


def test_colour_edges_are_not_uniform():
    rgb = np.full((HEIGHT, WIDTH, 3), 0.5, np.float32)
    rgb[:, 30:] = 0.8
    uniform = observe(camera(), np.full((HEIGHT, WIDTH), 2.0, np.float32), rgb).uniform.reshape(HEIGHT, WIDTH)
    distance = np.where(np.arange(WIDTH) < 30, 29 - np.arange(WIDTH), np.arange(WIDTH) - 30)
    largest = np.where(distance >= 1, 2.0 ** np.floor(np.log2(distance.clip(1, 16)) + 1), 1)
    np.testing.assert_array_equal(uniform, np.broadcast_to(largest, uniform.shape))


def test_one_gaussian_has_the_moments_of_a_rectangle():
    view = View("a", camera())
    (gaussian,) = [gaussians_from_depth([view], lambda v: np.full(v.camera.size, 2.0), grey, count=1, opacity=0.7)]
    assert len(gaussian) == 1
    pixel = 2.0 / FOCAL
    middle = ((WIDTH / 2 - (WIDTH / 2 + 1)) * pixel, (HEIGHT / 2 - (HEIGHT / 2 - 2)) * pixel, 2.0)
    np.testing.assert_allclose(gaussian.means[0], middle, atol=1e-5)
    R = rotation_of(gaussian.quats)[0].numpy()
    np.testing.assert_allclose(np.abs(R), [[0, 0, 1], [0, 1, 0], [1, 0, 0]], atol=1e-4)
    expected = [from_depth.OVERLAP_FLAT * side * pixel / math.sqrt(12) for side in (HEIGHT, WIDTH)]
    np.testing.assert_allclose(gaussian.scales[0, 1:], expected, rtol=2e-3)  # less the pixel's own blur
    np.testing.assert_allclose(gaussian.scales[0, 0], from_depth.FLATNESS * expected[1], rtol=2e-3)
    np.testing.assert_allclose(gaussian.opacities, 0.7)
    np.testing.assert_allclose(gaussian.sh, 0, atol=1e-6)


def test_plane_from_several_views():
    views = [View(f"{k}", camera(z=-0.2 * k, yaw=0.15 * k)) for k in range(3)]
    gaussians = gaussians_from_depth(views, lambda v: plane_depth(v.camera, NORMAL, 2.0), checks, count=1500)
    assert 1200 < len(gaussians) <= 1500
    np.testing.assert_allclose(gaussians.means.double().numpy() @ NORMAL, 2.0, atol=1e-4)
    normals = rotation_of(gaussians.quats)[:, :, 0].numpy()
    assert np.abs(normals @ NORMAL).min() > math.cos(math.radians(2))
    assert (gaussians.scales[:, 0] < 0.11 * gaussians.scales[:, 2]).all()
    assert (gaussians.sh.shape[1], gaussians.sh_degree) == (1, 0)


def test_sphere_means_and_normals():
    centre, radius = np.array([0.1, -0.1, 2.0]), 0.6
    view = View("a", camera())
    gaussians = gaussians_from_depth([view], lambda v: sphere_depth(v.camera, centre, radius), grey, count=400)
    outward = gaussians.means.double().numpy() - centre
    distance = np.linalg.norm(outward, axis=1)
    reach = gaussians.scales[:, 2].numpy() * 2  # a patch of this reach sags by reach^2 / 2 radius
    assert (distance < radius + 1e-4).all()
    assert (radius - distance < reach**2 / (2 * radius) + 1e-3).all()
    radial = np.abs((rotation_of(gaussians.quats)[:, :, 0].numpy() * outward).sum(axis=1) / distance)
    towards_camera = -(outward @ centre) / distance / np.linalg.norm(centre)
    inner = towards_camera > 0.5
    assert inner.sum() > 100
    assert radial[inner].min() > math.cos(math.radians(12))


def test_views_of_one_surface_are_fused():
    views = [View("a", camera()), View("b", camera())]
    once, twice = (
        gaussians_from_depth(which, lambda v: plane_depth(v.camera, NORMAL, 2.0), checks, count=800)
        for which in (views[:1], views)
    )
    assert len(once) == len(twice)
    for name in ("means", "scales", "sh"):
        np.testing.assert_allclose(getattr(once, name), getattr(twice, name), atol=1e-5)


def test_the_nearest_view_has_most_say():
    views = [View("near", camera(z=1.0)), View("far", camera(z=-1.0))]  # 1 m and 3 m from the plane z = 2
    gaussians = gaussians_from_depth(
        views,
        lambda v: np.full(v.camera.size, 1.0 if v.stem == "near" else 3.0),
        lambda v: grey(v, 1.0 if v.stem == "near" else 0.0),
        count=200,
    )
    colour = 0.5 + 0.28209479177387814 * gaussians.sh[:, 0, 0]
    both = (gaussians.means[:, :2].abs() < torch.tensor([0.35, 0.25])).all(dim=1)
    assert both.sum() > 5
    # Nine times the pixels, each of nine times the weight, less those that stand out into the next leaf.
    assert colour[both].min() > 0.95
    assert colour.min() < 0.01


def test_thin_things_keep_their_width():
    depth = np.full((HEIGHT, WIDTH), 3.0, np.float32)
    depth[:, 30:33] = 1.5
    gaussians = gaussians_from_depth([View("a", camera())], lambda v: depth, grey, count=800)
    pole = gaussians.means[:, 2] < 2
    assert pole.sum() > 10
    variance = (rotation_of(gaussians.quats).square() * gaussians.scales.double().square()[:, None]).sum(dim=2)
    width = 3 * 1.5 / FOCAL
    assert variance[pole, 0].sqrt().max() < 0.55 * width
    edges = (torch.tensor([30.0, 33.0]) - (WIDTH / 2 + 1)) / FOCAL * 1.5
    assert (gaussians.means[pole, 0] > edges[0]).all()
    assert (gaussians.means[pole, 0] < edges[1]).all()
    assert ((gaussians.means[:, 2] - 1.5).abs() < 1e-4).logical_or((gaussians.means[:, 2] - 3).abs() < 1e-4).all()


def test_rendering_shows_the_views():
    """A sphere before a chequered wall, seen again from where it was seen."""
    view = View("a", camera(width=96, height=72))
    ball = sphere_depth(view.camera, (0.0, 0.0, 2.0), 0.5)
    depth = np.where(ball > 0, ball, 3.0).astype(np.float32)
    rgb = np.where(ball[..., None] > 0, np.float32(0.3), checks(view, 12))
    gaussians = gaussians_from_depth([view], lambda v: depth, lambda v: rgb, count=4000)
    seen = rasterize(gaussians, view.camera, expected_depth=True)
    assert seen.alpha[2:-2, 2:-2].min() > 0.75
    assert seen.alpha.mean() > 0.95
    error = (seen.features.numpy() - rgb)[2:-2, 2:-2]
    assert -10 * math.log10((error**2).mean()) > 20
    off = np.abs(seen.expected_depth.numpy() - depth)[2:-2, 2:-2]
    assert np.median(off) < 0.01


def test_count_bounds_and_flat_surfaces_need_little():
    view = View("a", camera())
    flat, busy = (
        gaussians_from_depth([view], lambda v: np.full(v.camera.size, 2.0), rgb, count=100_000)
        for rgb in (grey, checks)
    )
    assert len(flat) <= len(busy) <= WIDTH * HEIGHT
    for count in (1, 7, 100, 600):
        assert (
            1
            <= len(gaussians_from_depth([view], lambda v: plane_depth(v.camera, NORMAL, 2), grey, count=count))
            <= count
        )


def test_leaves_are_the_largest_cells_that_no_patch_in_them_finds_too_large():
    generator = np.random.default_rng(0)
    index = generator.integers(0, 64, (300, 3))
    code = np.sort(from_depth._morton(index))
    wanted = generator.choice([0, 1, 2, 3, 4, 5], 300, p=[0.02, 0.02, 0.06, 0.1, 0.3, 0.5])
    finest = np.stack([np.full(300, 0.5), 2.0**wanted * 1.1], axis=1)
    zeros = np.zeros((300, 6))
    patches = from_depth._Patches(code, zeros[:, 0], zeros[:, :3], zeros, zeros[:, :5], finest)

    def fits(patch, level):
        return wanted[code >> 3 * level == code[patch] >> 3 * level].min() >= level

    level = [max(tried for tried in range(6) if fits(patch, tried)) for patch in range(300)]
    cells = [(tried, patch_code >> 3 * tried) for tried, patch_code in zip(level, code.tolist(), strict=True)]
    expected = [patch for patch in range(300) if patch == 0 or cells[patch] != cells[patch - 1]]
    assert len(set(level)) > 3
    assert from_depth._leaves(patches, 1.0, 1.0).tolist() == expected


def test_quaternions_of_any_rotation():
    axes = torch.nn.functional.normalize(torch.randn(200, 4, generator=torch.Generator().manual_seed(0)), dim=1)
    half_turns = torch.tensor([[0.0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1], [1, 0, 0, 0], [0, 0.6, 0.8, 0]])
    matrices = rotation_of(torch.cat([axes, half_turns]))
    again = rotation_of(torch.from_numpy(from_depth._quaternions(matrices.numpy())))
    np.testing.assert_allclose(again, matrices, atol=1e-6)


def test_progress_names_every_view():
    calls = []
    views = [View("a", camera()), View("b", camera(yaw=0.1))]
    gaussians_from_depth(views, lambda v: grey(v)[..., 0], grey, count=50, progress=lambda *call: calls.append(call))
    assert calls == [(0, 2, ""), (1, 2, "a"), (2, 2, "b")]


def bad_colours(view):
    return np.full((*view.camera.size, 3), np.nan, np.float32)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"views": []}, "no views"),
        ({"count": 0}, "count"),
        ({"planarity": 0.0}, "planarity"),
        ({"contrast": -1.0}, "contrast"),
        ({"opacity": 0.0}, "opacity"),
        ({"opacity": float("nan")}, "opacity"),
        ({"depths": lambda v: np.zeros(v.camera.size)}, "none of the 1 views has any depth"),
        ({"depths": lambda v: np.full(v.camera.size, np.nan)}, "none of the 1 views has any depth"),
        ({"depths": lambda v: np.ones((3, 3))}, r"view a: depth has shape \[3, 3\]"),
        ({"images": lambda v: np.ones(v.camera.size)}, "view a: colours have shape"),
        ({"images": bad_colours}, "view a: colours hold NaN"),
        ({"images": None}, "view a: has no photograph"),
    ],
)
def test_bad_input_is_one_clear_line(change, message):
    arguments = {"views": [View("a", camera())], "depths": lambda v: grey(v)[..., 0], "images": grey, "count": 10}
    with pytest.raises(InputError, match=message) as caught:
        gaussians_from_depth(**{**arguments, **change})
    assert "\n" not in str(caught.value)
