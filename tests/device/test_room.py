"""Tile lists in a room set aside before: no wait, so that a CUDA graph can hold a training step."""

import pytest
import torch

import sgwarp as sg
from sgwarp.ops.photometric import photometric_loss
from sgwarp.ops.splatting import tiles
from sgwarp.reconstruction.fitting.model import Gradients, Model
from sgwarp.reconstruction.fitting.settings import FitSettings


def leaves(gaussians):
    fields = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh)
    return [t.detach().clone().requires_grad_() for t in fields]


def step(leaves, camera, truth, room):
    """Loss, and the gradients that it leaves."""
    for leaf in leaves:
        leaf.grad = None
    size = (camera.width, camera.height)
    image = sg.rasterize(*leaves[:4], camera.world_to_camera, camera.K, *size, sh=leaves[4], room=room).features
    loss = photometric_loss(image, truth)
    loss.backward()
    return [loss.detach(), image.detach(), *(leaf.grad for leaf in leaves)]


@pytest.fixture
def there(make_scene, pretended_cuda):
    scene = make_scene("sh3")
    truth = torch.rand(*scene.camera.size, 3, generator=torch.Generator().manual_seed(2)).to("cuda")
    return leaves(scene.gaussians.to("cuda")), scene.camera, truth


@pytest.fixture
def needed(make_scene):
    scene = make_scene("sh3")
    room = sg.ListRoom(1)
    sg.rasterize(
        *leaves(scene.gaussians)[:4],
        scene.camera.world_to_camera,
        scene.camera.K,
        *scene.camera.size[::-1],
        sh=scene.gaussians.sh,
        room=room,
    )
    return room.needed


def test_a_roomy_list_changes_nothing(there, needed):
    expected = step(*there, None)
    room = sg.ListRoom(2 * needed)
    for mine, exact in zip(step(*there, room), expected, strict=True):
        assert torch.equal(mine.cpu(), exact.cpu())
    assert (room.needed, room.overflowed, room.grow(), room.size) == (needed, False, False, 2 * needed)


def test_a_training_step_in_a_room_can_be_captured(there, needed, make_scene, pretended_cuda):
    """Rendering, loss, gradients and Adam: nothing waits for the device, and nothing is sent there."""
    room = sg.ListRoom(2 * needed)
    step(*there, room)  # loads kernels, and makes what is used again
    pretended_cuda.reset()
    model, names = (
        Model.starting(make_scene("sh3").gaussians.to("cuda")),
        ("means", "quats", "scales", "opacities", "sh"),
    )
    before = model["means"].clone()
    with pretended_cuda.capturing():
        gradients = step(*there, room)[2:]
        model.update(Gradients(**dict(zip(names, gradients, strict=True))), 1e-3, FitSettings())
    assert not torch.equal(model["means"], before)
    assert "radix_sort_pairs" in pretended_cuda.launches
    with pytest.raises(RuntimeError, match="waits for the device"), pretended_cuda.capturing():
        step(*there, None)


def test_an_overflow_is_seen_a_step_later_and_the_step_done_again(there, needed):
    expected = step(*there, None)
    room = sg.ListRoom(needed // 2)
    cut = step(*there, room)
    assert all(bool(torch.isfinite(t).all()) for t in cut)
    assert not torch.equal(cut[1].cpu(), expected[1].cpu())
    assert room.overflowed
    assert room.needed == needed
    assert room.grow()
    assert room.size == int(1.25 * needed)
    for mine, exact in zip(step(*there, room), expected, strict=True):
        assert torch.equal(mine.cpu(), exact.cpu())


def test_a_room_too_small_keeps_the_nearest_splats(make_scene, needed):
    """Its lists are those of `bin_by_counting` without the last entries."""
    scene = make_scene("sh3")
    projected = tiles.project(scene.gaussians, scene.camera, sg.RasterSettings())
    order = tiles.depth_order(projected)
    whole = tiles.bin_splats(projected, order, None, scene.camera, places=True, keep=True)
    room = sg.ListRoom(needed - needed // 3)
    memory = tiles.splat_memory(len(order), order.device, None)
    colors = tiles.wp.empty(0, dtype=tiles.wp.vec3, device="cpu")
    lists = tiles.bin_by_sorting(projected, order, colors, scene.camera, memory, keep=True, room=room)
    for tile in range(whole.tile_count):
        seen = lists.listed[lists.offsets[tile] : lists.offsets[tile + 1]]
        kept = whole.listed[whole.offsets[tile] : whole.offsets[tile + 1]][: len(seen)]
        assert torch.equal(seen, kept)
    assert int(lists.offsets[-1]) == room.size


@pytest.mark.parametrize("size", [0, -3, 2**30])
def test_a_room_of_no_size_is_refused(size):
    with pytest.raises(sg.InputError, match="ListRoom"):
        sg.ListRoom(size)
