import math
from dataclasses import FrozenInstanceError, replace

import cv2
import numpy as np
import pytest
import torch

from sgwarp.errors import InputError
from sgwarp.scene import Camera, FeatureMap, Gaussians, Semantics, View


def fields(count=4, coefficients=4):
    gen = torch.Generator().manual_seed(0)
    return {
        "means": torch.randn(count, 3, generator=gen),
        "quats": torch.randn(count, 4, generator=gen),
        "scales": torch.rand(count, 3, generator=gen),
        "opacities": torch.rand(count, generator=gen),
        "sh": torch.randn(count, coefficients, 3, generator=gen),
    }


def intrinsics(fx=50.0, fy=55.0, cx=14.5, cy=12.25):
    return torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64)


def camera(**change):
    return Camera(**{"K": intrinsics(), "world_to_camera": torch.eye(4), "width": 32, "height": 24, **change})


class TestGaussians:
    def test_fields_become_contiguous_float32(self):
        values = {name: value.double() for name, value in fields().items()}
        values["means"] = values["means"].T.contiguous().T
        g = Gaussians(**values)
        assert {getattr(g, name).dtype for name in values} == {torch.float32}
        assert g.means.is_contiguous()
        assert (len(g), g.sh_degree, g.non_finite) == (4, 1, 0)

    def test_arrays_are_taken(self):
        g = Gaussians(**{name: value.numpy() for name, value in fields().items()})
        assert torch.equal(g.means, fields()["means"])

    def test_empty_scene(self):
        g = Gaussians(**fields(0))
        assert (len(g), g.non_finite) == (0, 0)
        assert g.fingerprint == Gaussians(**fields(0, 1)).fingerprint

    @pytest.mark.parametrize(
        ("name", "shape"),
        [
            ("means", (4, 2)),
            ("quats", (4, 3)),
            ("scales", (3, 3)),
            ("opacities", (4, 1)),
            ("sh", (4, 12)),
            ("means", (4,)),
        ],
    )
    def test_shape_is_named(self, name, shape):
        with pytest.raises(InputError, match=rf"{name}: expected shape \[.*\], got \[{', '.join(map(str, shape))}\]"):
            Gaussians(**{**fields(), name: torch.rand(shape)})

    @pytest.mark.parametrize("coefficients", [0, 2, 15, 25])
    def test_number_of_coefficients(self, coefficients):
        with pytest.raises(
            InputError, match=rf"sh: expected 1, 4, 9 or 16 coefficients per colour, got {coefficients}"
        ):
            Gaussians(**fields(coefficients=coefficients))

    def test_integers_are_refused(self):
        with pytest.raises(InputError, match=r"means: expected floating point values, got torch\.int64"):
            Gaussians(**{**fields(), "means": torch.zeros(4, 3, dtype=torch.int64)})

    def test_first_bad_row_is_named(self):
        values = fields()
        values["scales"][2, 1] = -0.5
        values["scales"][3, 0] = -1
        with pytest.raises(InputError, match=r"scales\[2\] = \[.*-0\.5.*\]: .*cannot be negative \(2 such rows\)"):
            Gaussians(**values)
        for bad in (-0.1, 1.5):
            values = fields()
            values["opacities"][1] = bad
            with pytest.raises(InputError, match=r"opacities\[1\] = .*expected a value in \[0, 1\]; apply the sigmoid"):
                Gaussians(**values)

    @pytest.mark.parametrize(
        ("name", "value"),
        [*((n, v) for n in ("means", "quats", "scales", "sh") for v in (math.nan, math.inf)), ("opacities", math.nan)],
    )
    def test_rows_that_are_not_finite_are_kept(self, name, value):
        values = fields()
        values[name].view(4, -1)[2, 0] = value
        g = Gaussians(**values)
        assert g.finite.tolist() == [True, True, False, True]
        assert g.non_finite == 1

    def test_fingerprint_follows_geometry_and_order(self):
        g = Gaussians(**fields())
        assert g.fingerprint == Gaussians(**fields()).fingerprint
        assert len(g.fingerprint) == 16
        moved = fields()
        moved["means"][0, 0] += 1e-6
        assert Gaussians(**moved).fingerprint != g.fingerprint
        assert g.subset(torch.tensor([1, 0, 2, 3])).fingerprint != g.fingerprint
        painted = {**fields(), "sh": fields()["sh"] + 1}
        assert Gaussians(**painted).fingerprint == g.fingerprint

    def test_subset(self):
        g = Gaussians(**fields())
        assert torch.equal(g.subset(torch.tensor([3, 1])).means, g.means[[3, 1]])
        mask = torch.tensor([True, False, False, True])
        assert torch.equal(g.subset(mask).sh, g.sh[[0, 3]])

    def test_one_device(self):
        with pytest.raises(InputError, match="all fields must be on one device"):
            Gaussians(**{**fields(), "means": torch.zeros(4, 3, device="meta")})

    def test_frozen(self):
        with pytest.raises(FrozenInstanceError):
            Gaussians(**fields()).means = torch.zeros(4, 3)


class TestCamera:
    def test_position(self):
        R = torch.from_numpy(cv2.Rodrigues(np.array([0.2, 0.5, -0.3]))[0])
        centre = torch.tensor([1.0, -2.0, 3.0], dtype=torch.float64)
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3], pose[:3, 3] = R, -R @ centre
        assert camera(world_to_camera=pose).position.tolist() == pytest.approx(centre.tolist())

    def test_values_become_float64_on_the_cpu(self):
        c = camera(K=intrinsics().float(), world_to_camera=np.eye(4, dtype=np.float32))
        assert c.K.dtype == c.world_to_camera.dtype == torch.float64
        assert c.size == (24, 32)

    def test_resized_sees_the_same(self):
        point = torch.tensor([0.3, -0.2, 2.0], dtype=torch.float64)
        before, after = camera(), camera().resized(12, 64)
        a, b = before.K @ point, after.K @ point
        torch.testing.assert_close(b[:2] / b[2], a[:2] / a[2] * torch.tensor([2.0, 0.5]))
        assert (after.width, after.height) == (64, 12)

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"K": torch.eye(4)}, r"K: expected shape \[3, 3\], got \[4, 4\]"),
            ({"K": intrinsics(fx=0.0)}, r"K: singular or mirrored \(fx = 0, fy = 55\)"),
            ({"K": intrinsics(fy=-3.0)}, r"K: singular or mirrored"),
            ({"K": intrinsics(cx=math.nan)}, r"K: holds NaN or infinity"),
            ({"K": intrinsics() * 2}, r"K: last row must be \[0, 0, 1\]"),
            ({"K": intrinsics() + torch.tensor([[0, 0.1, 0], [0, 0, 0], [0, 0, 0]])}, r"K: skew is not supported"),
            ({"world_to_camera": torch.eye(3)}, r"world_to_camera: expected shape \[4, 4\]"),
            ({"world_to_camera": torch.full((4, 4), math.inf)}, r"world_to_camera: holds NaN or infinity"),
            ({"world_to_camera": torch.diag(torch.tensor([2.0, 2, 2, 1]))}, r"not a rigid transform .*by 3\)"),
            ({"world_to_camera": torch.diag(torch.tensor([1.0, 1, -1, 1]))}, r"mirrors the world \(determinant -1\)"),
            ({"world_to_camera": torch.diag(torch.tensor([1.0, 1, 1, 2]))}, r"last row must be \[0, 0, 0, 1\]"),
            ({"width": 0}, r"image size must be positive, got 0 x 24"),
            ({"near": 0.0}, r"near: expected 0 < near < far"),
            ({"far": 0.001}, r"near: expected 0 < near < far, got 0\.01 and 0\.001"),
        ],
    )
    def test_bad_values_are_named(self, change, message):
        with pytest.raises(InputError, match=message):
            camera(**change)


class TestView:
    def write(self, path, height=24, width=32):
        cv2.imwrite(str(path), np.full((height, width, 3), (10, 20, 255), np.uint8))
        return path

    def test_image(self, tmp_path):
        image = View("a", camera(), self.write(tmp_path / "a.png")).image()
        assert image.dtype == torch.float32
        assert image.shape == (24, 32, 3)
        assert (image[3, 4] * 255).tolist() == pytest.approx([255, 20, 10])

    def test_no_photograph(self):
        with pytest.raises(InputError, match="view a: has no photograph; render one"):
            View("a", camera()).image()

    def test_photograph_of_another_size(self, tmp_path):
        view = View("a", camera(), self.write(tmp_path / "a.png", 32, 24))
        with pytest.raises(InputError, match=r"a\.png: image is 24 x 32, its camera says 32 x 24; resize one of them"):
            view.image()

    def test_missing_photograph(self, tmp_path):
        with pytest.raises(InputError, match=r"gone\.png: no such file"):
            View("a", camera(), tmp_path / "gone.png").image()

    def test_undistort_sees_the_pixels_as_stored(self, tmp_path):
        seen = []

        def undistort(pixels):
            seen.append((pixels.dtype, pixels.shape))
            return pixels[::2, ::2]

        view = View("a", camera().resized(12, 16), self.write(tmp_path / "a.png"), undistort)
        assert view.image().shape == (12, 16, 3)
        assert seen == [(np.uint8, (24, 32, 3))]


class TestFeatureMap:
    def test_dense(self):
        m = FeatureMap("x", dense=torch.rand(2, 3, 5, dtype=torch.float16), valid=torch.ones(2, 3))
        assert (m.channels, m.size, m.valid.dtype) == (5, (2, 3), torch.bool)

    def test_ids_with_vectors_and_levels(self):
        m = FeatureMap("x", ids=torch.tensor([[0, 1], [-1, 2]]), vectors=torch.rand(3, 7))
        assert (m.channels, m.size, m.ids.shape, m.ids.dtype) == (7, (2, 2), (1, 2, 2), torch.int32)
        assert FeatureMap("x", ids=torch.zeros(4, 2, 2, dtype=torch.uint8), vectors=torch.rand(1, 7)).size == (2, 2)

    def test_ids_with_labels_are_one_hot(self):
        m = FeatureMap("labels", ids=torch.zeros(2, 2, dtype=torch.int64), labels=("floor", "wall"))
        assert m.channels == 2

    @pytest.mark.parametrize(
        ("values", "message"),
        [
            ({"space": "", "dense": torch.rand(2, 2, 1)}, "space: a feature map must name"),
            ({}, "give either dense features or ids"),
            (
                {"dense": torch.rand(2, 2, 1), "ids": torch.zeros(2, 2, dtype=torch.int32)},
                "give either dense features or ids",
            ),
            ({"dense": torch.rand(2, 2)}, r"dense: expected floating point \[h, w, C\], got torch\.float32 \[2, 2\]"),
            ({"dense": torch.zeros(2, 2, 1, dtype=torch.int32)}, "dense: expected floating point"),
            ({"dense": torch.rand(2, 2, 0)}, "dense: expected floating point"),
            ({"dense": torch.rand(2, 2, 1), "valid": torch.ones(3, 2)}, r"valid: expected \[2, 2\], got \[3, 2\]"),
            ({"ids": torch.rand(2, 2), "labels": ("a",)}, r"ids: expected integers, got torch\.float32"),
            (
                {"ids": torch.zeros(2, dtype=torch.int32), "labels": ("a",)},
                r"ids: expected shape \[L, h, w\], got \[2\]",
            ),
            ({"ids": torch.zeros(2, 2, dtype=torch.int32)}, "ids: give either vectors or labels"),
            ({"ids": torch.full((2, 2), 3), "labels": ("a", "b")}, "ids: expected -1 to 1, got 3 to 3"),
            ({"ids": torch.full((2, 2), -2), "vectors": torch.rand(2, 4)}, "ids: expected -1 to 1, got -2 to -2"),
            ({"ids": torch.zeros(2, 2, dtype=torch.int32), "vectors": torch.rand(4)}, "vectors: expected shape"),
        ],
    )
    def test_bad_values_are_named(self, values, message):
        with pytest.raises(InputError, match=message):
            FeatureMap(**{"space": "x", **values})


class TestSemantics:
    def make(self, **change):
        values = {
            "features": torch.rand(4, 3),
            "weight": torch.tensor([0.0, 1.0, 2.0, 0.5]),
            "effective_views": torch.ones(4),
            "space": "x",
            "fingerprint": Gaussians(**fields()).fingerprint,
        }
        return Semantics(**{**values, **change})

    def test_coverage(self):
        assert self.make().seen.tolist() == [False, True, True, True]
        assert self.make().coverage == 0.75
        none = self.make(features=torch.rand(0, 3), weight=torch.rand(0), effective_views=torch.rand(0))
        assert (len(none), none.coverage) == (0, 0.0)

    def test_belongs_to_one_scene_and_one_space(self):
        g = Gaussians(**fields())
        self.make().require_scene(g)
        self.make().require_space("x")
        with pytest.raises(InputError, match=rf"belong to scene {g.fingerprint}, this scene is .*; lift it again"):
            self.make().require_scene(g.subset(torch.tensor([1, 0, 2, 3])))
        with pytest.raises(InputError, match="space 'y' cannot be compared with semantics in space 'x'"):
            self.make().require_space("y")

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"features": torch.rand(4)}, r"features: expected floating point \[N, C\], got torch\.float32 \[4\]"),
            ({"features": torch.zeros(4, 3, dtype=torch.int8)}, r"features: expected floating point"),
            ({"weight": torch.rand(3)}, r"weight: expected shape \[4\], got \[3\]"),
            ({"effective_views": torch.rand(4, 1)}, r"effective_views: expected shape \[4\], got \[4, 1\]"),
            ({"space": ""}, "space: must name the embedding space"),
            ({"labels": ("a",)}, "labels: expected 3, got 1"),
        ],
    )
    def test_bad_values_are_named(self, change, message):
        with pytest.raises(InputError, match=message):
            self.make(**change)

    def test_replace_checks_again(self):
        with pytest.raises(InputError, match="weight"):
            replace(self.make(), weight=torch.rand(9))
