"""Compositing of given splats: against the oracle, with gradients, for given lists, for any number of threads."""

import pytest
import torch

from sgwarp.errors import InputError
from sgwarp.ops import launcher
from sgwarp.ops.planar.projection import ProjectionSettings, project_splats
from sgwarp.ops.planar.splats import ListedSplats, SplatJob, composite_splats, factors_from_conics, listed_rows
from sgwarp.ops.reference import rasterizer as reference
from sgwarp.ops.splatting.settings import RasterSettings

LEAVES = ("means", "quats", "scales", "opacities", "features")


def composite_scene(gaussians, camera, features, wants_depth=False):
    """A scene by projection in torch and compositing; leaves, images, job."""
    fields = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, features)
    leaves = [t.clone().requires_grad_() for t in fields]
    means, quats, scales, opacities, values = leaves
    p = project_splats(
        means,
        camera.world_to_camera,
        camera.K,
        *(camera.width, camera.height),
        ProjectionSettings(),
        quats=quats,
        scales=scales,
        opacities=opacities,
    )
    job = SplatJob(camera.width, camera.height, wants_depth=wants_depth)
    images = composite_splats(p.means2d, p.factors, opacities[p.index], values[p.index], p.depths, job)
    return leaves, images, job, p


@pytest.mark.slow
@pytest.mark.parametrize("channels", [3, 20])
def test_images_and_gradients_match_the_oracle(scene, channels):
    _, gaussians, camera = scene
    features = torch.rand(len(gaussians), channels, generator=torch.Generator().manual_seed(1))
    leaves, (image, T, alpha, depth), _, _ = composite_scene(gaussians, camera, features, wants_depth=True)
    wanted = [t.detach().double().requires_grad_() for t in leaves]
    projection = reference.project(*wanted[:4], camera.world_to_camera, camera.K, camera.width, camera.height)
    expected = reference.composite(projection, wanted[4], camera.width, camera.height)
    clear = expected.margin > 1e-4
    torch.testing.assert_close(image.double()[clear], expected.features[clear], rtol=0, atol=2e-5)
    depth_sum = expected.expected_depth * expected.alpha
    torch.testing.assert_close(depth.double()[clear], depth_sum[clear], rtol=2e-5, atol=2e-4)
    rng = torch.Generator().manual_seed(2)
    w, v = torch.rand(image.shape, generator=rng) * clear[..., None], torch.rand(T.shape, generator=rng) * clear
    ((image * w).sum() + (T * v).sum() + 3 * (alpha * v * v).sum() + 0.1 * (depth * v).sum()).backward()
    loss = (expected.features * w.double()).sum() + ((1 - expected.alpha) * v.double()).sum()
    loss = loss + 3 * (expected.alpha * v.double() ** 2).sum()
    (loss + 0.1 * (depth_sum * v.double()).sum()).backward()
    for leaf, got, want in zip(LEAVES, leaves, wanted, strict=True):
        assert (got.grad - want.grad).abs().max() <= 1e-3 * want.grad.abs().max(), leaf


def test_same_bits_for_any_number_of_threads(make_scene, monkeypatch):
    _, gaussians, camera = make_scene("random_cloud")
    camera = camera.resized(400, 530)
    features = torch.rand(len(gaussians), 3)
    monkeypatch.setattr(launcher, "SMALL", 1)
    before = launcher.get_threads()
    found = []
    try:
        for count in (1, 3):
            launcher.set_threads(count)
            leaves, (image, *_), _, _ = composite_scene(gaussians, camera, features)
            image.square().sum().backward()
            found.append([image.detach(), *(leaf.grad for leaf in leaves)])
    finally:
        launcher.set_threads(before)
    for a, b in zip(*found, strict=True):
        assert torch.equal(a, b)


def test_given_lists_are_followed(make_scene):
    """Lists of the rasterizer's own give its image and gradients again; reversed lists give another image."""
    _, gaussians, camera = make_scene("odd_size")
    features = torch.rand(len(gaussians), 3)
    leaves, (image, *_), job, p = composite_scene(gaussians, camera, features)
    image.square().sum().backward()
    own = ListedSplats(listed_rows(job.lists), job.lists.offsets.clone())
    splats = (p.means2d, p.conics, leaves[3][p.index], leaves[4][p.index])
    means2d, conics, opacities, values = (t.detach().clone().requires_grad_() for t in splats)
    depths = torch.zeros(len(means2d))

    def follow(given):
        again = SplatJob(camera.width, camera.height, given=given)
        return composite_splats(means2d, factors_from_conics(conics), opacities, values, depths, again)[0]

    again = follow(own)
    torch.testing.assert_close(again, image, rtol=0, atol=1e-5)
    again.square().sum().backward()
    want = leaves[4].grad[p.index]
    assert (values.grad - want).abs().max() <= 1e-4 * want.abs().max()
    backwards = torch.cat([part.flip(0) for part in own.listed.split(own.offsets.diff().tolist())])
    assert (follow(ListedSplats(backwards, own.offsets)) - image).abs().max() > 0.05


def test_splats_that_cannot_be_seen_are_skipped():
    """Not finite, transparent or without a proper conic: listed or not, they change nothing and get no gradient."""
    means2d = torch.tensor([[8.0, 8.0], [float("nan"), 3.0], [5.0, 5.0], [6.0, 6.0], [7.0, 7.0]])
    conics = torch.tensor([[0.1, 0.0, 0.1], [0.1, 0.0, 0.1], [0.1, 0.3, 0.1], [-0.1, 0.0, 0.1], [0.1, 0.0, 0.1]])
    opacities = torch.tensor([0.8, 0.8, 0.8, 0.8, 0.0])
    leaves = [t.requires_grad_() for t in (means2d, conics, opacities, torch.ones(5, 3))]
    lists = ListedSplats(torch.tensor([4, 3, 2, 1, 0], dtype=torch.int32), torch.tensor([0, 5], dtype=torch.int32))
    for given in (None, lists):
        job = SplatJob(16, 16, given=given)
        means2d, conics, opacities, values = leaves
        image, T, _, _ = composite_splats(means2d, factors_from_conics(conics), opacities, values, torch.ones(5), job)
        torch.testing.assert_close(1 - T, image[..., 0])
        assert 0.7 < 1 - T[8, 8] < 0.8
        gradients = torch.autograd.grad(image.sum(), leaves)
        for g in gradients:
            assert torch.isfinite(g).all()
            assert (g[1:] == 0).all()
        assert all((g[0] != 0).any() for g in gradients[1:])


def test_clamped_opacity_has_no_gradient():
    job = SplatJob(16, 16, RasterSettings(alpha_max=0.5))
    opacities = torch.tensor([0.9]).requires_grad_()
    factors = factors_from_conics(torch.tensor([[1e-6, 0.0, 1e-6]]))
    image, T, _, _ = composite_splats(
        torch.tensor([[8.0, 8.0]]), factors, opacities, torch.ones(1, 1), torch.ones(1), job
    )
    assert (T == 0.5).all()
    image.sum().backward()
    assert opacities.grad.item() == 0.0


def test_lists_for_another_image_are_refused():
    lists = ListedSplats(torch.zeros(0, dtype=torch.int32), torch.zeros(5, dtype=torch.int32))
    nothing = torch.zeros(0)
    with pytest.raises(InputError, match="expected 6 tiles"):
        composite_splats(
            torch.zeros(0, 2), torch.zeros(0, 3), nothing, torch.zeros(0, 3), nothing, SplatJob(33, 17, given=lists)
        )
