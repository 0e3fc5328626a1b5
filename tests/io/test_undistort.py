import math
import pickle
from pathlib import Path

import numpy as np
import pytest

from sgwarp.errors import InputError
from sgwarp.io.undistort import Lens, Undistortion, pinhole_matrix

W, H = 96, 64
BARREL = Lens(70.0, 72.0, 50.0, 30.0, W, H, (-0.2, 0.03, 0.002, -0.003))
PINCUSHION = Lens(70.0, 72.0, 45.0, 33.0, W, H, (0.15, 0.02, -0.001, 0.002, 0.01))
RATIONAL = Lens(70.0, 70.0, 48.0, 32.0, W, H, (0.3, -0.1, 0.001, 0.001, 0.01, 0.45, -0.05, 0.002))
FISHEYE = Lens(55.0, 56.0, 47.0, 34.0, W, H, (0.02, -0.01, 0.003, -0.001), model="fisheye")
EQUIDISTANT = Lens(60.0, 60.0, 48.0, 32.0, W, H, model="fisheye")
LENSES = [BARREL, PINCUSHION, RATIONAL, FISHEYE, EQUIDISTANT]


def distorted(lens, x, y):
    """Pixel of the stored photograph that sees direction (x, y, 1), written out from the definition of the models."""
    if lens.model == "fisheye":
        k = [1.0, *lens.distortion, 0.0, 0.0, 0.0, 0.0]
        r = np.hypot(x, y)
        theta = np.arctan(r)
        bent = sum(k[i] * theta ** (2 * i + 1) for i in range(5))
        scale = np.where(r > 0, bent / np.maximum(r, 1e-12), 1.0)
        u, v = x * scale, y * scale
    else:
        k1, k2, p1, p2, k3, k4, k5, k6 = [*lens.distortion, *[0.0] * 8][:8]
        r2 = x * x + y * y
        radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
        u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return u * lens.fx + lens.cx, v * lens.fy + lens.cy


def expected_positions(lens):
    K = pinhole_matrix(lens)
    u, v = np.meshgrid(np.arange(W) + 0.5, np.arange(H) + 0.5)
    return distorted(lens, (u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1])


@pytest.mark.parametrize("lens", LENSES)
def test_every_pixel_is_read_where_its_ray_fell(lens):
    """A photograph whose value is its own coordinate tells where each pinhole pixel was read."""
    u, v = np.meshgrid(np.arange(W, dtype=np.float32) + 0.5, np.arange(H, dtype=np.float32) + 0.5)
    read = Undistortion(lens, Path("a.png"))(np.stack([u, v, u], axis=2))
    expected_u, expected_v = expected_positions(lens)
    inside = (expected_u > 0.5) & (expected_u < W - 0.5) & (expected_v > 0.5) & (expected_v < H - 0.5)
    assert inside.mean() > 0.9
    assert np.abs(read[:, :, 0] - expected_u)[inside].max() < 0.05  # OpenCV resamples at 1/32 of a pixel
    assert np.abs(read[:, :, 1] - expected_v)[inside].max() < 0.05


@pytest.mark.parametrize("lens", LENSES)
def test_no_black_borders(lens):
    u, v = expected_positions(lens)
    assert u.min() > 0
    assert v.min() > 0
    assert u.max() < W
    assert v.max() < H
    white = np.full((H, W, 3), 255, np.uint8)
    assert Undistortion(lens, Path("a.png"))(white).min() == 255


@pytest.mark.parametrize("lens", LENSES)
def test_one_zoom_and_no_more_than_needed(lens):
    K = pinhole_matrix(lens)
    zoom = K[0, 0] / lens.fx
    assert K.tolist() == [[zoom * lens.fx, 0, lens.cx], [0, pytest.approx(zoom * lens.fy), lens.cy], [0, 0, 1]]
    assert 0.5 < zoom < 2
    corners = np.linspace(0, W, 200), np.linspace(0, H, 200)
    edges = [(corners[0], 0 * corners[0]), (corners[0], 0 * corners[0] + H)]
    edges += [(0 * corners[1], corners[1]), (0 * corners[1] + W, corners[1])]
    reach = 0.0  # how far a slightly wider image would look over the edge of the photograph
    for u, v in edges:
        x, y = (u - lens.cx) / lens.fx / zoom * 1.02, (v - lens.cy) / lens.fy / zoom * 1.02
        seen_u, seen_v = distorted(lens, x, y)
        reach = max(reach, -seen_u.min(), -seen_v.min(), seen_u.max() - W, seen_v.max() - H)
    assert reach > 0


def test_without_distortion_nothing_changes():
    lens = Lens(70.0, 72.0, 50.0, 30.0, W, H, (0.0, 0.0, 0.0, 0.0))
    assert not lens.distorted
    assert pinhole_matrix(lens).tolist() == [[70, 0, 50], [0, 72, 30], [0, 0, 1]]


def test_nearest_mixes_no_ids():
    ids = np.kron(np.arange(24, dtype=np.int32).reshape(4, 6) * 10, np.ones((16, 16), np.int32)) * 65537
    straight = Undistortion(BARREL, Path("a.png"))(ids, nearest=True)
    assert straight.shape == (H, W)
    assert set(np.unique(straight)) <= set(np.unique(ids))
    u, v = expected_positions(BARREL)
    far = (np.abs(u % 16 - 8) < 7) & (np.abs(v % 16 - 8) < 7)  # away from the borders of the squares
    assert np.array_equal(straight[far], ids[v.astype(int).clip(0, H - 1), u.astype(int).clip(0, W - 1)][far])


def test_fisheye_that_sees_behind_itself_is_cropped():
    K = pinhole_matrix(Lens(15.0, 15.0, 48.0, 32.0, W, H, model="fisheye"))  # 183 degrees
    assert K[0, 0] == pytest.approx(7.5)


def test_resized_lens_sees_the_same():
    half = BARREL.resized(W // 2, H // 2)
    x, y = 0.3, -0.2
    u, v = distorted(BARREL, x, y)
    assert distorted(half, x, y) == (pytest.approx(u / 2), pytest.approx(v / 2))
    assert (half.width, half.height) == (W // 2, H // 2)


def test_photograph_of_another_size():
    with pytest.raises(InputError, match=r"b/a\.png: image is 20 x 10, its camera says 96 x 64"):
        Undistortion(BARREL, Path("b/a.png"))(np.zeros((10, 20, 3), np.uint8))


@pytest.mark.parametrize(
    "lens",
    [
        Lens(30.0, 30.0, 48.0, 32.0, W, H, (-5.0, 0.0, 0.0, 0.0)),
        Lens(30.0, 30.0, 48.0, 32.0, W, H, (-9.0, 0.0, 0.0, 0.0), model="fisheye"),
        Lens(30.0, 30.0, 48.0, 32.0, W, H, (1e6, -1e9, 0.0, 0.0)),
    ],
)
def test_what_no_pinhole_can_show(lens):
    with pytest.raises(InputError, match="folds the image and cannot be undistorted"):
        pinhole_matrix(lens)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fx": 0.0}, r"K: singular or mirrored \(fx = 0, fy = 72\)"),
        ({"fy": -2.0}, "K: singular or mirrored"),
        ({"cx": math.nan}, "K: holds NaN"),
        ({"distortion": (math.inf,)}, "K: holds NaN or infinity"),
        ({"height": 0}, "image size must be positive, got 96 x 0"),
    ],
)
def test_bad_lens(change, message):
    values = {"fx": 70.0, "fy": 72.0, "cx": 50.0, "cy": 30.0, "width": W, "height": H}
    with pytest.raises(InputError, match=message):
        Lens(**{**values, **change})


def test_can_be_sent_to_another_process():
    undistort = Undistortion(BARREL, Path("a.png"))
    assert pickle.loads(pickle.dumps(undistort)) == undistort
