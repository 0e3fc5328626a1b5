"""The float64 oracle against closed forms, numerical derivatives and a literal per-pixel loop."""

import math

import numpy as np
import pytest
import torch

from sgwarp.ops.reference import rasterizer as reference
from sgwarp.ops.reference.rasterizer import ReferenceSettings, harmonics, rasterize
from sgwarp.scene import Camera, Gaussians

pytestmark = pytest.mark.slow

ALPHA_MIN, ALPHA_MAX, T_MIN = 1 / 255, 0.999, 1e-4
C0 = 0.5 / math.sqrt(math.pi)
IDENTITY = [1.0, 0.0, 0.0, 0.0]


def camera(width=21, height=15, f=50.0, cx=None, cy=None, pose=None, **depths) -> Camera:
    K = [[f, 0, width / 2 if cx is None else cx], [0, f, height / 2 if cy is None else cy], [0, 0, 1]]
    return Camera(torch.tensor(K), torch.eye(4) if pose is None else pose, width, height, **depths)


def balls(z, radius, opacity, colors, xy=None) -> Gaussians:
    """Isotropic Gaussians at depths `z`, on the optical axis unless `xy` says otherwise."""
    n = len(z)
    means = torch.zeros(n, 3)
    means[:, 2] = torch.tensor(z)
    if xy is not None:
        means[:, :2] = torch.tensor(xy)
    sh = (torch.tensor(colors) - 0.5).reshape(n, 1, 3) / C0
    scales = torch.tensor(radius)[:, None].expand(n, 3)
    return Gaussians(means, torch.tensor([IDENTITY] * n), scales, torch.tensor(opacity), sh)


def literal(g: Gaussians, cam: Camera, row: int, column: int, values: np.ndarray):
    """One pixel, as the definition reads: numpy, one Gaussian after the other, linear algebra by LAPACK."""
    pose, K = cam.world_to_camera.numpy(), cam.K.numpy()
    W, t = pose[:3, :3], pose[:3, 3]
    means, quats, scales, opacities = (
        getattr(g, k).double().numpy() for k in ("means", "quats", "scales", "opacities")
    )
    points = means @ W.T + t
    T, out, surface, weights = 1.0, np.zeros(values.shape[1]), 0.0, np.zeros(len(g))
    for j in sorted(range(len(g)), key=lambda j: (points[j, 2], j)):
        x, y, z = points[j]
        if not (cam.near < z < cam.far and opacities[j] >= ALPHA_MIN):
            continue
        tan_x, tan_y = 0.5 * cam.width / K[0, 0], 0.5 * cam.height / K[1, 1]
        tx = z * np.clip(x / z, -K[0, 2] / K[0, 0] - 0.3 * tan_x, (cam.width - K[0, 2]) / K[0, 0] + 0.3 * tan_x)
        ty = z * np.clip(y / z, -K[1, 2] / K[1, 1] - 0.3 * tan_y, (cam.height - K[1, 2]) / K[1, 1] + 0.3 * tan_y)
        J = np.array([[K[0, 0] / z, 0, -K[0, 0] * tx / z**2], [0, K[1, 1] / z, -K[1, 1] * ty / z**2]])
        R = rodrigues(quats[j])
        cov = J @ W @ R @ np.diag(scales[j] ** 2) @ R.T @ W.T @ J.T + 0.3 * np.eye(2)
        d = np.array([column + 0.5, row + 0.5]) - (K @ (points[j] / z))[:2]
        alpha = min(ALPHA_MAX, opacities[j] * math.exp(-0.5 * d @ np.linalg.solve(cov, d)))
        if alpha < ALPHA_MIN:
            continue
        if T * (1 - alpha) <= T_MIN:
            break
        weights[j] = alpha * T
        out += weights[j] * values[j]
        if T > 0.5 >= T * (1 - alpha):
            surface = z
        T *= 1 - alpha
    return out, T, surface, weights


def rodrigues(quat: np.ndarray) -> np.ndarray:
    """The rotation of a quaternion as the exponential of its axis and angle."""
    w, *v = quat / np.linalg.norm(quat)
    angle, (x, y, z) = 2 * math.atan2(np.linalg.norm(v), w), np.array(v) / np.linalg.norm(v)
    generator = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    return torch.matrix_exp(angle * generator).numpy()


def test_every_scene_matches_the_literal_loop(scene):
    g, cam = scene.gaussians, scene.camera
    raster = rasterize(g, cam)
    values = reference.spherical_harmonics(g.means.double(), g.sh.double(), cam.world_to_camera).numpy()
    rng = np.random.default_rng(0)
    for row, column in zip(rng.integers(0, cam.height, 12), rng.integers(0, cam.width, 12), strict=True):
        out, T, surface, weights = literal(g, cam, int(row), int(column), values)
        at = (int(row), int(column))
        np.testing.assert_allclose(raster.features[at], out, atol=1e-9)
        np.testing.assert_allclose(raster.alpha[at], 1 - T, atol=1e-9)
        np.testing.assert_allclose(raster.depth[at], surface, atol=1e-9)
        z = (g.means.double().numpy() @ cam.world_to_camera.numpy()[2, :3]) + cam.world_to_camera.numpy()[2, 3]
        mean = weights @ z / weights.sum() if weights.any() else 0.0
        np.testing.assert_allclose(raster.expected_depth[at], mean, rtol=1e-9)


def test_block_size_does_not_matter(scene, monkeypatch):
    whole = rasterize(scene.gaussians, scene.camera)
    monkeypatch.setattr(reference, "BLOCK", 7)
    blocks = rasterize(scene.gaussians, scene.camera)
    torch.testing.assert_close(blocks.features, whole.features, rtol=0, atol=1e-13)
    torch.testing.assert_close(blocks.alpha, whole.alpha, rtol=0, atol=1e-13)


def test_isotropic_on_axis_is_a_closed_form():
    cam = camera()
    raster = rasterize(balls([4.0], [0.2], [0.75], [[0.25, 0.5, 1.0]]), cam, background=torch.tensor([1.0, 0.0, 0.0]))
    variance = (50.0 * 0.2 / 4.0) ** 2 + 0.3
    y, x = torch.meshgrid(torch.arange(15) + 0.5, torch.arange(21) + 0.5, indexing="ij")
    alpha = 0.75 * torch.exp(-((x - 10.5) ** 2 + (y - 7.5) ** 2).double() / (2 * variance))
    alpha[alpha < ALPHA_MIN] = 0
    assert (alpha == 0).any()
    assert (alpha > 0.7).any()
    torch.testing.assert_close(raster.alpha, alpha, rtol=1e-6, atol=1e-9)
    color = alpha[..., None] * torch.tensor([0.25, 0.5, 1.0]) + (1 - alpha)[..., None] * torch.tensor([1.0, 0, 0])
    torch.testing.assert_close(raster.features, color.double(), rtol=1e-6, atol=1e-7)
    torch.testing.assert_close(raster.depth, torch.where(alpha >= 0.5, 4.0, 0.0).double())
    torch.testing.assert_close(raster.expected_depth, torch.where(alpha > 0, 4.0, 0.0).double())


def test_the_nearer_of_two_hides_the_farther():
    g = balls([5.0, 3.0], [2.0, 2.0], [0.9, 0.8], [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    raster = rasterize(g, camera(), background=torch.tensor([0.0, 0.0, 1.0]))
    middle = raster.features[7, 10]
    torch.testing.assert_close(middle, torch.tensor([0.2 * 0.9, 0.8, 0.2 * 0.1]).double(), rtol=0, atol=1e-6)
    assert raster.depth[7, 10] == 3.0
    torch.testing.assert_close(raster.expected_depth[7, 10].item(), (0.8 * 3 + 0.18 * 5) / 0.98, rtol=1e-6, atol=0)


def test_depth_ties_go_by_index():
    g = balls([3.0, 3.0], [2.0, 2.0], [0.75, 0.75], [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    middle = rasterize(g, camera()).features[7, 10]
    torch.testing.assert_close(middle, torch.tensor([0.75, 0.25 * 0.75, 0.0]).double(), rtol=0, atol=1e-6)


def test_a_closed_pixel_stays_closed():
    """0.999 leaves 1e-3; 0.95 would leave 5e-5, so the pixel closes; 0.1 after it would fit but comes too late."""
    g = balls([2.0, 3.0, 4.0], [9.0, 9.0, 9.0], [1.0, 0.95, 0.1], [[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]])
    raster = rasterize(g, camera())
    torch.testing.assert_close(raster.features[7, 10], torch.tensor([0.999, 0, 0]).double(), rtol=0, atol=1e-6)
    torch.testing.assert_close(raster.alpha[7, 10].item(), 0.999)


def test_margins_name_the_boundary_pixels():
    edge = balls([4.0], [0.2], [0.75], [[1.0, 1.0, 1.0]])
    variance, distance = (50.0 * 0.2 / 4.0) ** 2 + 0.3, 5.0
    alpha_min = 0.75 * math.exp(-(distance**2) / (2 * variance))
    raster = rasterize(edge, camera(), settings=ReferenceSettings(alpha_min=alpha_min * (1 + 1e-6)))
    assert raster.margin[7, 15] < 1e-5
    assert raster.margin[7, 10] > 1.0
    closing = balls([2.0, 3.0], [9.0, 9.0], [0.99, 0.99 + 1e-7], [[1.0] * 3] * 2)
    assert rasterize(closing, camera()).margin[7, 10] < 1e-3
    near_tie = balls([3.0, 3.000001], [2.0, 2.0], [0.75, 0.75], [[1.0] * 3] * 2)
    assert rasterize(near_tie, camera()).order_margin[7, 10] < 1e-6
    tie = balls([3.0, 3.0], [2.0, 2.0], [0.75, 0.75], [[1.0] * 3] * 2)
    assert torch.isinf(rasterize(tie, camera()).order_margin).all()
    half = balls([3.0], [9.0], [0.5 + 1e-6], [[1.0] * 3])
    assert rasterize(half, camera()).surface_margin[7, 10] < 1e-5


def test_culling_keeps_the_input_rows():
    g = balls([4.0] * 10, [0.3] * 10, [0.5] * 10, [[1.0] * 3] * 10)
    means, quats, scales, opacities, sh = (x.clone() for x in (g.means, g.quats, g.scales, g.opacities, g.sh))
    means[0, 2] = -1.0  # behind
    means[1, 2] = 0.5  # nearer than near
    means[2, 2] = 200.0  # beyond far
    means[3, 0] = 100.0  # beside the image
    quats[4] = 0.0
    opacities[5] = 0.003
    means[6, 1] = torch.nan
    sh[7, 0, 1] = torch.inf
    means[8, 2] = 3.0
    scales[9] = 0.0  # a point: only the dilation is left
    dirty = Gaussians(means, quats, scales, opacities, sh)
    projection = reference.project_scene(dirty, camera(near=0.5, far=200.0))
    assert projection.index.tolist() == [8, 9]
    torch.testing.assert_close(projection.conic[1], torch.tensor([1 / 0.3, 0.0, 1 / 0.3]).double())
    assert torch.isfinite(rasterize(dirty, camera()).features).all()


def test_an_empty_scene_is_background():
    raster = rasterize(balls([-1.0], [1.0], [0.5], [[1.0] * 3]), camera(), background=torch.tensor([0.1, 0.2, 0.3]))
    assert (raster.features == torch.tensor([0.1, 0.2, 0.3]).double()).all()
    assert (raster.alpha == 0).all()
    assert torch.isinf(raster.margin).all()


def test_rotation_is_the_exponential_of_axis_and_angle():
    quats = torch.randn(20, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    expected = torch.stack([torch.from_numpy(rodrigues(q)) for q in quats.numpy()])
    torch.testing.assert_close(reference.rotation_matrices(quats), expected, rtol=0, atol=1e-12)


def pinhole(points, K):
    return points[..., :2] / points[..., 2:] * K.diagonal()[:2] + K[:2, 2]


def test_jacobian_is_the_derivative_of_the_projection():
    cam = camera(cx=4.0, cy=11.0)
    inside = torch.tensor([[0.3, -0.3, 2.0], [-0.1, 0.05, 1.5], [1.0, 0.2, 5.0]], dtype=torch.float64)
    ours = reference.perspective_jacobian(inside, cam.K, cam.width, cam.height)
    numeric = torch.autograd.functional.jacobian(lambda p: pinhole(p, cam.K), inside)
    torch.testing.assert_close(ours, torch.stack([numeric[i, :, i] for i in range(3)]), rtol=1e-12, atol=1e-12)


def test_jacobian_is_held_just_outside_the_image():
    """Beyond 15 % of the image outside its edge, x/z stays what it is there, around the true principal point."""
    cam = camera(cx=4.0, cy=11.0)
    for u, edge in ((9.0, 21 + 0.15 * 21), (-9.0, -0.15 * 21)):
        far_out = torch.tensor([[u * 2.0, 0.0, 2.0]], dtype=torch.float64)
        held = torch.tensor([[(edge - 4.0) / 50.0 * 2.0, 0.0, 2.0]], dtype=torch.float64)
        ours = reference.perspective_jacobian(far_out, cam.K, cam.width, cam.height)
        numeric = torch.autograd.functional.jacobian(lambda p: pinhole(p, cam.K), held)
        torch.testing.assert_close(ours[0], numeric[0, :, 0], rtol=1e-12, atol=1e-12)


def test_antialiasing_keeps_the_energy_of_small_gaussians():
    g = balls([4.0], [0.01], [0.9], [[1.0] * 3])
    sharp, blurred = (50.0 * 0.01 / 4.0) ** 2, (50.0 * 0.01 / 4.0) ** 2 + 0.3
    raster = rasterize(g, camera(), settings=ReferenceSettings(antialiased=True))
    torch.testing.assert_close(raster.alpha[7, 10].item(), 0.9 * sharp / blurred, rtol=1e-6, atol=0)


def test_harmonics_are_orthonormal():
    """Integrals over the sphere, exact by Gauss-Legendre in z and the trapezoid rule in the azimuth."""
    nodes, node_weights = np.polynomial.legendre.leggauss(8)
    azimuth = np.arange(16) * 2 * math.pi / 16
    z, phi = (a.ravel() for a in np.meshgrid(nodes, azimuth, indexing="ij"))
    r = np.sqrt(1 - z * z)
    basis = harmonics(torch.from_numpy(np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1)), 3).numpy()
    gram = basis.T @ (np.repeat(node_weights, 16)[:, None] * basis) * 2 * math.pi / 16
    np.testing.assert_allclose(gram, np.eye(16), atol=1e-12)


def test_harmonics_follow_the_definition():
    """sqrt(2) Re or Im of Y_l^|m| with the Condon-Shortley phase, from derivatives of Legendre polynomials."""
    directions = torch.nn.functional.normalize(torch.randn(30, 3, generator=torch.Generator().manual_seed(1)).double())
    x, y, z = directions.numpy().T
    expected = []
    for degree in range(4):
        for m in range(-degree, degree + 1):
            k = abs(m)
            legendre = np.polynomial.legendre.Legendre.basis(degree)
            polar = (-1) ** k * (legendre.deriv(k) if k else legendre)(z)  # times r^k, which (x + iy)^k holds
            factor = (2 * degree + 1) / (4 * math.pi) * math.factorial(degree - k) / math.factorial(degree + k)
            complex_value = math.sqrt(factor) * polar * (x + 1j * y) ** k
            part = complex_value.imag if m < 0 else complex_value.real
            expected.append(part * (math.sqrt(2) if m else 1.0))
    np.testing.assert_allclose(harmonics(directions, 3).numpy(), np.stack(expected, axis=1), atol=1e-12)


def test_colours_look_from_the_camera_and_are_clamped():
    pose = torch.tensor([[0.0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 7], [0, 0, 0, 1]], dtype=torch.float64)
    means = torch.tensor([[3.0, 0.0, 0.0], [7.0, 0.0, -4.0]], dtype=torch.float64)  # the camera stands at (7, 0, 0)
    sh = torch.zeros(2, 4, 3, dtype=torch.float64)
    sh[:, 3, 0] = 0.2  # red grows towards -x
    sh[:, 1, 1] = 5.0
    sh[:, 0, 2] = -9.0
    colors = reference.spherical_harmonics(means, sh, pose)
    c1 = math.sqrt(3 / (4 * math.pi))
    expected = torch.tensor([[0.5 + 0.2 * c1, 0.5, 0.0], [0.5, 0.5, 0.0]], dtype=torch.float64)
    torch.testing.assert_close(colors, expected, rtol=0, atol=1e-12)
    constant = reference.spherical_harmonics(means, sh, pose, degree=0)
    torch.testing.assert_close(constant[:, 0], torch.full((2,), 0.5, dtype=torch.float64))


@pytest.mark.parametrize("antialiased", [False, True])
def test_gradients_match_finite_differences(antialiased):
    """Three Gaussians, one of them beside the image where the clamp of the Jacobian holds, away from all thresholds."""
    cam = camera(5, 4, f=6.0, cx=2.2, cy=1.7)
    settings = ReferenceSettings(antialiased=antialiased, alpha_min=1e-9)
    rng = torch.Generator().manual_seed(3)
    means = torch.tensor([[0.1, -0.1, 2.0], [-0.3, 0.2, 2.5], [2.1, 0.1, 3.0]], dtype=torch.float64)
    quats = torch.randn(3, 4, generator=rng, dtype=torch.float64)
    scales = 0.4 + 0.4 * torch.rand(3, 3, generator=rng, dtype=torch.float64)
    opacities = torch.tensor([0.6, 0.8, 0.7], dtype=torch.float64)
    sh = 0.1 * torch.randn(3, 16, 3, generator=rng, dtype=torch.float64)
    background = torch.tensor([0.3, 0.6, 0.1], dtype=torch.float64)
    inputs = [means, quats, scales, opacities, sh, cam.world_to_camera.clone(), background]

    def render(means, quats, scales, opacities, sh, world_to_camera, background):
        projection = reference.project(
            means, quats, scales, opacities, world_to_camera, cam.K, cam.width, cam.height, settings=settings
        )
        colors = reference.spherical_harmonics(means, sh, world_to_camera)
        raster = reference.composite(projection, colors, cam.width, cam.height, background, settings)
        return raster.features, raster.alpha, raster.expected_depth

    projection = reference.project(*inputs[:4], inputs[5], cam.K, 5, 4, settings=settings)
    assert len(projection.index) == 3
    assert torch.autograd.gradcheck(render, [x.requires_grad_() for x in inputs])


def test_culled_rows_have_zero_gradient_not_nan():
    g = balls([-2.0, 0.0, 4.0, 4.0], [0.3, 0.3, 0.3, 0.0], [0.5] * 4, [[1.0] * 3] * 4)
    tensors = [x.double().requires_grad_() for x in (g.means, g.quats, g.scales, g.opacities)]
    settings = ReferenceSettings(antialiased=True)
    cam = camera()
    projection = reference.project(*tensors, cam.world_to_camera, cam.K, 21, 15, settings=settings)
    reference.composite(
        projection, torch.ones(4, 1, dtype=torch.float64), 21, 15, settings=settings
    ).alpha.sum().backward()
    for tensor in tensors:
        assert torch.isfinite(tensor.grad).all()
    assert (tensors[0].grad[:2] == 0).all()
    assert tensors[3].grad[2] > 0
