"""What `rasterize` refuses before it renders, with and without gradients."""

import pytest
import torch

import sgwarp as sg
from sgwarp.errors import InputError

FIELDS = ("means", "quats", "scales", "opacities", "sh")


def arguments(make_scene):
    _, gaussians, camera = make_scene("random_cloud")
    fields = {name: getattr(gaussians, name).clone() for name in FIELDS}
    return fields, {"viewmat": camera.world_to_camera, "K": camera.K, "width": 32, "height": 24}


@pytest.mark.parametrize("name", ["quats", "scales", "opacities", "sh"])
@pytest.mark.parametrize("gradients", [False, True])
def test_tensors_on_two_devices_are_refused(make_scene, name, gradients):
    fields, view = arguments(make_scene)
    fields["means"].requires_grad_(gradients)
    fields[name] = fields[name].to("meta")
    with pytest.raises(InputError, match=f"{name}.*meta.*move them to one device"):
        sg.rasterize(**fields, **view)


@pytest.mark.parametrize("gradients", [False, True])
@pytest.mark.parametrize("both", [False, True])
@pytest.mark.parametrize(("name", "value"), [("scales", -1.0), ("opacities", -0.1), ("opacities", 2.0)])
def test_values_that_no_scene_may_hold_are_refused(make_scene, name, value, both, gradients):
    """Also where a color that is not finite, or NaN beside them, hides their Gaussian."""
    fields, view = arguments(make_scene)
    fields["sh"][3] = torch.nan
    fields[name].view(len(fields["sh"]), -1)[3, 0] = value
    fields["quats"][3, 0] = torch.nan
    if both:
        view["features"] = torch.rand(len(fields["sh"]), 2)
    fields["means"].requires_grad_(gradients)
    with pytest.raises(InputError, match=rf"{name}\[3\]"):
        sg.rasterize(**fields, **view)
