"""The C++ that the lane schedule is built from, with the instructions of this machine and as any machine can."""

import numpy as np
import pytest
import torch
import warp as wp

from sgwarp.kernels.native import power_and_reciprocal
from sgwarp.kernels.transmittance import LANE_OPTIONS, Lanes
from sgwarp.ops import memory


def evaluate(x: np.ndarray, portable: bool) -> tuple[np.ndarray, np.ndarray]:
    function = power_and_reciprocal(portable)

    @wp.kernel(module="unique", module_options=LANE_OPTIONS, enable_backward=False)
    def kernel(x: wp.array[Lanes], powers_out: wp.array[Lanes], reciprocals_out: wp.array[Lanes]):
        function(wp.tid(), x, powers_out, reciprocals_out)

    rows = wp.array(x.reshape(-1, 16), dtype=Lanes, device="cpu")
    powers, reciprocals = wp.zeros_like(rows), wp.zeros_like(rows)
    wp.launch(kernel, len(rows), [rows], [powers, reciprocals], device="cpu")
    return powers.numpy().ravel(), reciprocals.numpy().ravel()


@pytest.mark.parametrize("portable", [False, True])
def test_powers_of_two_in_the_range_of_opacities(portable):
    x = np.linspace(-16, 0, 16 * 4096, dtype=np.float32)
    powers, _ = evaluate(x, portable)
    truth = np.exp2(x.astype(np.float64))
    assert np.abs(powers / truth - 1).max() < 3e-7
    assert (powers <= 1).all()


@pytest.mark.parametrize("portable", [False, True])
def test_reciprocals_of_what_passes_a_gaussian(portable):
    x = np.geomspace(1e-6, 1, 16 * 4096, dtype=np.float32)
    _, reciprocals = evaluate(x, portable)
    assert np.abs(reciprocals * x.astype(np.float64) - 1).max() < 3e-7


def large(channels: int) -> torch.Tensor:
    return memory.fresh(512, 512, channels, device=torch.device("cpu"))


def test_large_images_use_again_what_others_left():
    memory.release_scratch()
    first = large(64)
    address = first.data_ptr()
    view = first[:10]
    second = large(64)
    assert second.data_ptr() != address, "the first is still in use"
    del first
    third = large(64)
    assert third.data_ptr() != address, "a view of the first is still in use"
    del view
    fourth = large(64)
    assert fourth.data_ptr() == address
    assert large(65).shape == (512, 512, 65)


def test_no_more_than_two_large_images_wait_for_use():
    memory.release_scratch()
    images = [large(64 + i) for i in range(4)]
    del images
    assert len(memory._idle) == memory.MAX_IDLE
    memory.release_scratch()
    assert not memory._idle
