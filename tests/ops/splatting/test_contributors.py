"""The strongest contributors of each pixel against the float64 oracle, in both schedules."""

import pytest
import torch

import sgwarp as sg
from sgwarp.errors import InputError
from sgwarp.evaluation.report.extremes import EXTREMES
from sgwarp.ops import launcher
from sgwarp.ops.reference import contributors as reference_contributors
from sgwarp.ops.reference import rasterizer as reference
from sgwarp.ops.splatting import tiles
from sgwarp.ops.splatting.contributors import rank
from sgwarp.ops.splatting.forward import rasterize
from sgwarp.ops.splatting.settings import RasterSettings
from sgwarp.scene import Camera, Gaussians

SETTINGS = RasterSettings()
# Pixels nearer than this to a threshold, or to a change of the depth order, may flip in float32.
BOUNDARY_BAND = 1e-4
ORDER_BAND = 1e-6
WEIGHT_TOLERANCE = 2e-5  # the bound of images: a weight is what a pure colour would add
SCHEDULE_TOLERANCE = 2e-6
TIE_BAND = 1e-4  # weights this close (relatively) may change places


def top(
    gaussians: Gaussians, camera: Camera, k: int, schedule: str, settings: RasterSettings = SETTINGS
) -> tuple[torch.Tensor, torch.Tensor]:
    projected = tiles.project(gaussians, camera, settings)
    lists = tiles.bin_splats(projected, tiles.depth_order(projected), None, camera)
    return rank(lists, camera, settings, k, schedule)


def assert_well_formed(ids: torch.Tensor, weights: torch.Tensor) -> None:
    """Descending, and empty places at the end alone."""
    assert ids.dtype == torch.int32
    assert weights.dtype == torch.float32
    assert (weights[..., 1:] <= weights[..., :-1]).all()
    assert torch.equal(ids >= 0, weights > 0)


def assert_is_the_oracles(
    gaussians: Gaussians, camera: Camera, ids: torch.Tensor, weights: torch.Tensor, least_clear: float = 0.8
) -> None:
    expected = reference_contributors.top_contributors(gaussians, camera, ids.shape[2])
    clear = (expected.margin > BOUNDARY_BAND) & (expected.order_margin > ORDER_BAND)
    assert clear.double().mean() >= least_clear
    torch.testing.assert_close(weights.double()[clear], expected.weights[clear], rtol=0, atol=WEIGHT_TOLERANCE)
    clear &= expected.gap > TIE_BAND
    assert clear.double().mean() >= 0.9 * least_clear
    assert torch.equal(ids[clear].long(), expected.ids[clear])


@pytest.mark.slow
@pytest.mark.parametrize("schedule", ["lanes", "block"])
@pytest.mark.parametrize("k", [1, 5, 16])
def test_matches_the_oracle(scene, k, schedule):
    _, gaussians, camera = scene
    ids, weights = top(gaussians, camera, k, schedule)
    assert ids.shape == weights.shape == (*camera.size, k)
    assert_well_formed(ids, weights)
    assert_is_the_oracles(gaussians, camera, ids, weights)


@pytest.mark.slow
def test_block_schedule_equals_lane_schedule(scene):
    _, gaussians, camera = scene
    (lane_ids, lane_weights), (block_ids, block_weights) = (top(gaussians, camera, 7, s) for s in ("lanes", "block"))
    expected = reference_contributors.top_contributors(gaussians, camera, 7)
    clear = expected.margin > BOUNDARY_BAND
    torch.testing.assert_close(block_weights[clear], lane_weights[clear], rtol=0, atol=SCHEDULE_TOLERANCE)
    clear &= expected.gap > TIE_BAND
    assert torch.equal(block_ids[clear], lane_ids[clear])


@pytest.mark.slow
@pytest.mark.parametrize("schedule", ["lanes", "block"])
def test_all_weights_together_are_the_opacity(scene, schedule):
    """With room for all, every contributor is there once, and composites to the image."""
    _, gaussians, camera = scene
    count = int(reference_contributors.top_contributors(gaussians, camera, 1).contributors.max())
    ids, weights = top(gaussians, camera, count + 2, schedule)
    assert count > 1
    assert (ids[..., -1] == -1).all()
    rendering = rasterize(gaussians, camera)
    torch.testing.assert_close(weights.sum(dim=2), rendering.alpha, rtol=0, atol=5e-6)
    by_id = ids.sort(dim=2).values
    assert ((by_id[..., 1:] != by_id[..., :-1]) | (by_id[..., 1:] < 0)).all(), "a Gaussian is listed twice"
    colors = reference.spherical_harmonics(gaussians.means.double(), gaussians.sh.double(), camera.world_to_camera)
    image = (weights[..., None] * colors.float()[ids.clamp(min=0).long()]).sum(dim=2)
    torch.testing.assert_close(image, rendering.features, rtol=0, atol=2e-5)


def test_more_places_keep_the_first_ones(make_scene):
    """The k strongest are the first k of the k + n strongest."""
    _, gaussians, camera = make_scene("overlapping")
    ids, weights = sg.top_contributors(gaussians, camera, k=40)
    for k in (1, 2, 8, 33):
        fewer_ids, fewer_weights = sg.top_contributors(gaussians, camera, k=k)
        assert torch.equal(fewer_ids, ids[..., :k])
        assert torch.equal(fewer_weights, weights[..., :k])


@pytest.mark.parametrize("schedule", ["lanes", "block"])
@pytest.mark.parametrize("settings", [RasterSettings(alpha_min=0.05), RasterSettings(transmittance_min=0.3)])
def test_settings_are_followed(make_scene, settings, schedule):
    _, gaussians, camera = make_scene("odd_size")
    mirrored = reference.ReferenceSettings(alpha_min=settings.alpha_min, transmittance_min=settings.transmittance_min)
    expected = reference_contributors.top_contributors(gaussians, camera, 6, mirrored)
    _, weights = top(gaussians, camera, 6, schedule, settings)
    clear = expected.margin > BOUNDARY_BAND
    assert not torch.allclose(weights, top(gaussians, camera, 6, schedule)[1]), "the setting must do something"
    torch.testing.assert_close(weights.double()[clear], expected.weights[clear], rtol=0, atol=WEIGHT_TOLERANCE)


@pytest.mark.parametrize("schedule", ["lanes", "block"])
def test_equal_weights_stand_front_to_back(schedule):
    """Two sheets of weight 0.1, at many pixels equal to the last bit; a third, stronger, goes before both."""
    camera = Camera(torch.tensor([[50.0, 0, 32], [0, 50, 24], [0, 0, 1]]), torch.eye(4), 64, 48)
    strong, front, back = range(3)
    means = torch.tensor([[0.0, 0, 4], [0, 0, 2], [0, 0, 3]])
    scales = torch.tensor([[1e4], [1e4], [6e2]]).expand(3, 3).contiguous()
    opacities = torch.tensor([0.5, 0.1, 0.1 / 0.9 * (1 + 1.1e-6)])
    sheets = Gaussians(means, torch.tensor([[1.0, 0, 0, 0]] * 3), scales, opacities, torch.zeros(3, 1, 3))
    ids, weights = top(sheets, camera, 3, schedule)
    tied = weights[..., 1] == weights[..., 2]
    assert 20 < tied.sum() < tied.numel()
    assert (ids[tied] == torch.tensor([strong, front, back])).all()
    assert (ids[~tied] == torch.tensor([strong, back, front])).all(dim=1).any(), "elsewhere the weights decide"
    assert (top(sheets, camera, 2, schedule)[0][tied] == torch.tensor([strong, front])).all()


@pytest.mark.slow
@pytest.mark.parametrize("schedule", ["lanes", "block"])
@pytest.mark.parametrize(
    "name",
    ["needles", "coincident depths", "opaque stack", "scales 1e4", "non-finite geometry", "focal 1e-2", "one tile"],
)
def test_extremes_match_the_oracle(name, schedule):
    gaussians, camera = EXTREMES[name].build()
    ids, weights = top(gaussians, camera, 8, schedule)
    assert_well_formed(ids, weights)
    assert_is_the_oracles(gaussians, camera, ids, weights)


@pytest.mark.parametrize("schedule", ["lanes", "block"])
def test_nothing_contributes_to_an_empty_scene(schedule):
    gaussians, camera = EXTREMES["empty scene"].build()
    ids, weights = top(gaussians, camera, 3, schedule)
    assert ids.shape == (*camera.size, 3)
    assert (ids == -1).all()
    assert (weights == 0).all()


@pytest.mark.parametrize("schedule", ["lanes", "block"])
def test_one_pixel_and_more_places_than_gaussians(schedule):
    gaussians, camera = EXTREMES["one pixel"].build()
    few = gaussians.subset(torch.arange(5))
    ids, weights = top(few, camera, 50, schedule)
    assert ids.shape == (1, 1, 50)
    assert_well_formed(ids, weights)
    assert 1 < (ids >= 0).sum() <= 5
    torch.testing.assert_close(weights.sum(dim=2), rasterize(few, camera).alpha, rtol=0, atol=1e-6)


@pytest.mark.parametrize("count", [2, 3, 5])
def test_same_bits_for_any_number_of_threads(make_scene, count):
    _, gaussians, camera = make_scene("random_cloud")
    camera = camera.resized(400, 530)
    before = launcher.get_threads()
    try:
        launcher.set_threads(1)
        ids, weights = sg.top_contributors(gaussians, camera, k=6)
        launcher.set_threads(count)
        again = sg.top_contributors(gaussians, camera, k=6)
    finally:
        launcher.set_threads(before)
    assert torch.equal(ids, again[0])
    assert torch.equal(weights, again[1])


@pytest.mark.parametrize("k", [0, -3, 2.0, True, None])
def test_bad_k_is_named(make_scene, k):
    _, gaussians, camera = make_scene("one_pixel")
    with pytest.raises(InputError, match="k: expected a positive integer"):
        sg.top_contributors(gaussians, camera, k=k)


def test_a_view_is_no_camera(make_scene):
    _, gaussians, camera = make_scene("one_pixel")
    with pytest.raises(InputError, match=r"view\.camera"):
        sg.top_contributors(gaussians, sg.View("0001", camera))
