"""The networks here are small: waiting for a second thread costs more than it saves, on a busy machine far more."""

import pytest
import torch

from sgwarp.network.layers.mink_unet import ARCHITECTURES, Architecture


@pytest.fixture(autouse=True)
def one_thread():
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def tiny_architecture():
    """A U-Net of few channels by the name "tiny", on one thread."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(ARCHITECTURES, "tiny", Architecture((1,) * 8, (16,) * 8))
        yield
    torch.set_num_threads(threads)
