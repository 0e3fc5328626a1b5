"""Camera models against those of COLMAP itself."""

import numpy as np
import pytest

from sgwarp.io.lens_models import COLMAP_MODELS, distort

pycolmap = pytest.importorskip("pycolmap")
COEFFICIENTS = {
    "fov": [0.7],
    "division": [-0.12],
    "eucm": [0.55, 1.1],
    "perspective": [0.08, -0.02, 0.003, -0.002, 0.01, 0.05, -0.01, 0.004],
    "fisheye": [0.03, -0.01, 0.004, -0.001],
    "thin_prism_fisheye": [0.03, -0.01, 0.002, -0.003, 0.004, -0.001, 0.005, -0.004],
    "rad_tan_thin_prism_fisheye": [0.03, -0.01, 0.004, -0.001, 5e-4, -2e-4, 0.002, -0.003, 0.005, -0.004, 0.001, 0.002],
}


def test_all_models_of_colmap_are_known():
    theirs = {name for name in dir(pycolmap.CameraModelId) if name.isupper()} - {"INVALID", "EQUIRECTANGULAR"}
    assert theirs == set(COLMAP_MODELS)


@pytest.mark.parametrize("name", COLMAP_MODELS)
def test_a_ray_arrives_where_colmap_says(name):
    model, focals, count = COLMAP_MODELS[name]
    lens = [70.0, 73.0][:focals]
    coefficients = COEFFICIENTS.get(model, [])[:count]
    camera = pycolmap.Camera(model=name, width=200, height=160, params=[*lens, 101.0, 79.0, *coefficients])
    x, y = (values.ravel() for values in np.meshgrid(np.linspace(-0.9, 0.9, 13), np.linspace(-0.7, 0.7, 11)))
    theirs = camera.img_from_cam(2.5 * np.column_stack([x, y, np.ones_like(x)]))
    ours = np.column_stack(distort(model, coefficients, x, y)) * [lens[0], lens[-1]] + [101.0, 79.0]
    assert len(coefficients) == count
    np.testing.assert_allclose(ours, theirs, atol=1e-8)
    if coefficients:  # they do matter
        straight = np.column_stack([x, y]) * [lens[0], lens[-1]] + [101.0, 79.0]
        assert np.abs(theirs - straight).max() > 0.5
