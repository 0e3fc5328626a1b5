"""What is no tensor is taken for one, or refused in one line."""

import numpy as np
import pytest
import torch

import sgwarp as sg
from sgwarp.errors import InputError

GENERATOR = torch.Generator().manual_seed(0)
FIELDS = {
    "means": torch.rand(9, 3, generator=GENERATOR) + torch.tensor([-0.5, -0.5, 2.0]),
    "quats": torch.rand(9, 4, generator=GENERATOR) + 0.1,
    "scales": torch.rand(9, 3, generator=GENERATOR) * 0.3,
    "opacities": torch.rand(9, generator=GENERATOR),
    "viewmat": torch.eye(4),
    "K": torch.tensor([[20.0, 0, 8], [0, 20, 6], [0, 0, 1]]),
    "sh": torch.rand(9, 1, 3, generator=GENERATOR),
    "background": torch.tensor([0.1, 0.2, 0.3]),
}


def render(**changed):
    return sg.rasterize(**(FIELDS | changed), width=16, height=12)


@pytest.mark.cpu_only("arrays and lists are of the CPU")
@pytest.mark.parametrize("convert", [np.asarray, torch.Tensor.tolist])
def test_arrays_and_lists_are_taken_for_tensors(convert):
    want = render()
    found = render(**{name: convert(value) for name, value in FIELDS.items()})
    assert torch.equal(found.features, want.features)


@pytest.mark.cpu_only("arrays are of the CPU")
def test_an_array_that_cannot_be_written_to():
    array = FIELDS["means"].numpy().copy()
    array.flags.writeable = False
    assert torch.equal(render(means=array).features, render().features)


@pytest.mark.parametrize("name", FIELDS)
@pytest.mark.parametrize("value", ["x", [[1.0], [1.0, 2.0]], {}, np.array([None]), 0.5, None, torch.eye(3).to_sparse()])
def test_everything_else_is_refused_in_one_line(name, value):
    if value is None and name in ("background", "sh"):
        return  # may be left out, or is asked for by another message
    with pytest.raises(InputError, match=rf"^({name}|world_to_camera): ") as caught:
        render(**{name: value})
    assert str(caught.value).isprintable()


@pytest.mark.parametrize("value", [None, "x", torch.eye(3).to_sparse()])
def test_scenes_are_checked_alike(value):
    with pytest.raises(InputError, match=r"^means: "):
        sg.Gaussians(value, torch.ones(1, 4), torch.ones(1, 3), torch.ones(1), torch.ones(1, 1, 3))


@pytest.mark.parametrize("size", [(True, 12), (16, True), (2**16, 2**16)])
def test_sizes_that_are_none(size):
    with pytest.raises(InputError, match=r"^image size: "):
        sg.Camera(FIELDS["K"], torch.eye(4), *size)
