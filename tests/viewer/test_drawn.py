"""What a drawn picture brings along, and how large an uploaded one may be."""

import cv2
import numpy as np
import pytest

from sgwarp.errors import InputError
from sgwarp.viewer import downloads
from sgwarp.viewer.modes import Shot, draw


@pytest.mark.parametrize("mode", ["color", "depth"])
@pytest.mark.parametrize("wanted", [False, True])
def test_depth_comes_where_it_is_wanted(make_scene, mode, wanted):
    _, gaussians, camera = make_scene("odd_size")
    drawn = draw(Shot(gaussians, mode=mode, depth=wanted), camera)
    assert drawn.pixels.shape == (camera.height, camera.width, 3)
    assert (drawn.depth is not None) is wanted


def test_an_uploaded_picture_is_bounded_by_its_pixels(monkeypatch):
    monkeypatch.setattr(downloads, "MOST_UPLOADED", 100)
    within, beyond = (cv2.imencode(".png", np.zeros(size, np.uint8))[1].tobytes() for size in ((10, 10), (10, 11)))
    assert downloads.decode_picture(within).shape == (10, 10, 3)
    with pytest.raises(InputError, match="picture: is 11 x 10, more than 100 pixels"):
        downloads.decode_picture(beyond)
