"""Examples change with the generator they are given, and with nothing else."""

import pytest
import torch

from sgwarp.lifting.lifter import lift
from sgwarp.network.augmentation import Augmentation
from sgwarp.network.checkpoint import difference
from sgwarp.network.layers.mink_unet import MinkUNet
from sgwarp.network.training.data import make_example


@pytest.fixture(scope="module")
def lifted(stage):
    return lift(stage.gaussians, stage.views[:2], stage.dense)


def test_the_same_seed_gives_the_same_example(stage, lifted):
    def example(seed: int):
        random = torch.Generator().manual_seed(seed)
        found = make_example(stage.gaussians, lifted, "ones", 0.2, augment=Augmentation(up=1), generator=random)
        return found, random.get_state()

    (one, left), (again, left_again), (other, _) = example(3), example(3), example(4)
    assert torch.equal(one.of_gaussians, again.of_gaussians)
    assert torch.equal(one.targets, again.targets)
    assert not torch.equal(one.of_gaussians, other.of_gaussians)
    assert torch.equal(left, left_again)
    assert not torch.equal(left, torch.Generator().manual_seed(3).get_state())  # what comes next is drawn after it


def test_without_augmentation_nothing_is_random(stage, lifted):
    random = torch.Generator().manual_seed(3)
    one, other = (make_example(stage.gaussians, lifted, "ones", 0.2, generator=given) for given in (random, None))
    assert torch.equal(one.of_gaussians, other.of_gaussians)
    assert torch.equal(random.get_state(), torch.Generator().manual_seed(3).get_state())


@pytest.mark.parametrize(("count", "more"), [(0, False), (1, False), (3, False), (4, True)])
def test_so_many_parameters_are_named_and_the_rest_hinted_at(count, more):
    net = MinkUNet(3, 2, "14A")
    state = net.state_dict()
    for name in list(state)[:count]:
        del state[name]
    said = difference(state, net)
    if not count:
        assert said == ""
        return
    assert said.startswith(f"{count} missing: {', '.join(list(net.state_dict())[: min(count, 3)])}")
    assert said.endswith(", ...") == more
