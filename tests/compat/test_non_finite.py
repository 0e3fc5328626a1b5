"""NaN and infinity in every argument of the facades: refused in one line, or left out with gradients of zero."""

import math

import pytest
import torch
from torch import Tensor

from sgwarp.compat import gsplat, inria
from sgwarp.errors import InputError

BAD = [math.nan, math.inf]
ON_CUDA_UNSEEN = pytest.mark.cpu_only("on CUDA to look is to wait")
WIDTH, HEIGHT = 45, 37


def spoiled(tensor: Tensor, value: float, at: int = 0) -> Tensor:
    copy = tensor.clone()
    copy.view(-1)[at] = value
    return copy


def splat(raw, **changed):
    shape = dict(zip(("means", "quats", "scales", "opacities"), raw.shape, strict=True))
    given = {**shape, "colors": raw.colors, "viewmats": raw.viewmats, "Ks": raw.Ks, **changed}
    return gsplat.rasterization(**given, width=WIDTH, height=HEIGHT)


@pytest.mark.parametrize("value", BAD)
@pytest.mark.parametrize(
    "name", ["viewmats", "Ks", pytest.param("backgrounds", marks=ON_CUDA_UNSEEN), "eps2d", "radius_clip"]
)
def test_gsplat_refuses_what_places_a_whole_image(raw, name, value):
    """It was a black image without a word."""
    fields = {"viewmats": raw.viewmats, "Ks": raw.Ks, "backgrounds": torch.zeros(2, raw.colors.shape[-1])}
    changed = spoiled(fields[name], value) if name in fields else value
    with pytest.raises(InputError, match=f"^{name}: holds NaN or infinity"):
        splat(raw, **{name: changed})
    if name in ("viewmats", "Ks"):
        given = {"viewmats": raw.viewmats, "Ks": raw.Ks, name: changed}
        with pytest.raises(InputError, match=f"^{name}: holds NaN or infinity"):
            gsplat.fully_fused_projection(raw.means, None, raw.quats, raw.scales, **given, width=WIDTH, height=HEIGHT)


@pytest.mark.parametrize("sh_degree", [None, 1])
def test_gsplat_refuses_cameras_without_inverse(raw, sh_degree):
    colors = {"colors": raw.sh, "sh_degree": sh_degree} if sh_degree else {}
    with pytest.raises(InputError, match=r"^viewmats: a matrix has no inverse"):
        splat(raw, viewmats=torch.zeros_like(raw.viewmats), **colors)
    with pytest.raises(InputError, match=r"^Ks: a focal length is zero"):
        splat(raw, Ks=spoiled(raw.Ks, 0.0), **colors)


def require_left_out(render, fields: dict[str, Tensor], name: str, value: float, row: int) -> None:
    """A spoiled row changes the images and gradients as if the Gaussian were not there."""

    def run(changed: dict[str, Tensor]):
        leaves = {key: tensor.clone().requires_grad_() for key, tensor in changed.items()}
        images = [image for image in render(**leaves) if image.is_floating_point() and image.requires_grad]
        sum((image.double() ** 2).sum() for image in images).backward()
        return images, {key: leaf.grad for key, leaf in leaves.items()}

    width = fields[name][row].numel()
    images, gradients = run(fields | {name: spoiled(fields[name], value, row * width)})
    kept = torch.arange(len(fields[name])) != row
    wanted, right = run({key: tensor[kept] for key, tensor in fields.items()})
    for image, want in zip(images, wanted, strict=True):
        torch.testing.assert_close(image, want)
    for key, gradient in gradients.items():
        assert not gradient[row].any()
        torch.testing.assert_close(gradient[kept], right[key])


@pytest.mark.parametrize("value", BAD)
@pytest.mark.parametrize("name", ["means", "opacities", "colors"])
@pytest.mark.parametrize("kind", ["colors", "harmonics", "colors and depth"])
def test_gsplat_leaves_rows_out(raw, kind, name, value):
    fields = dict(zip(("means", "quats", "scales", "opacities"), raw.shape, strict=True))
    fields["colors"] = raw.sh[:, :4] if kind == "harmonics" else raw.colors
    options = {"sh_degree": 1} if kind == "harmonics" else {}
    mode = "RGB+ED" if "depth" in kind else "RGB"

    def render(**given):
        return gsplat.rasterization(
            **given, viewmats=raw.viewmats, Ks=raw.Ks, width=WIDTH, height=HEIGHT, render_mode=mode, **options
        )[:2]

    require_left_out(render, fields, name, value, int(visible(raw)))


def visible(raw) -> Tensor:
    """A Gaussian that both cameras see."""
    radii = gsplat.fully_fused_projection(raw.means, None, raw.quats, raw.scales, *raw.camera)[0]
    return (radii > 0).all(dim=-1).all(dim=0).nonzero()[0, 0]


@pytest.mark.parametrize("value", BAD)
@pytest.mark.parametrize("name", ["means2d", "conics", "opacities", "colors"])
def test_gsplat_stages_leave_splats_out(raw, name, value):
    """Lists given from outside, and explicit pairs: no pixel but those of the splat itself knows of it."""
    radii, means2d, depths, conics, _ = gsplat.fully_fused_projection(
        raw.means, None, raw.quats, raw.scales, raw.viewmats[:1], raw.Ks[:1], WIDTH, HEIGHT
    )
    tiles = (3, 3)
    _, keys, rows = gsplat.isect_tiles(means2d, radii, depths, 16, *tiles)
    offsets = gsplat.isect_offset_encode(keys, 1, *tiles)
    splats = {"means2d": means2d, "conics": conics, "colors": raw.colors[None], "opacities": raw.opacities[None]}
    row = int(visible(raw))
    bad = splats | {name: spoiled(splats[name], value, row * splats[name][0, 0].numel())}
    hidden = splats | {"opacities": spoiled(splats["opacities"], 0.0, row)}
    lists = (WIDTH, HEIGHT, 16, offsets, rows)
    for given, want in zip(
        gsplat.rasterize_to_pixels(
            **bad, image_width=WIDTH, image_height=HEIGHT, tile_size=16, isect_offsets=offsets, flatten_ids=rows
        ),
        gsplat.rasterize_to_pixels(
            **hidden, image_width=WIDTH, image_height=HEIGHT, tile_size=16, isect_offsets=offsets, flatten_ids=rows
        ),
        strict=True,
    ):
        torch.testing.assert_close(given, want)
    pairs = gsplat.rasterize_to_indices_in_range(
        0, 9, torch.ones(1, HEIGHT, WIDTH), means2d, conics, splats["opacities"], *lists
    )
    for given, want in zip(
        gsplat.accumulate(**bad, **named(pairs)), gsplat.accumulate(**hidden, **named(pairs)), strict=True
    ):
        torch.testing.assert_close(given, want)


def named(pairs):
    ids = dict(zip(("gaussian_ids", "pixel_ids", "image_ids"), pairs, strict=True))
    return {**ids, "image_width": WIDTH, "image_height": HEIGHT}


@pytest.mark.parametrize("value", BAD)
def test_a_number_of_one_row_stays_there(raw, value):
    """Functions of single rows: NaN comes out where NaN went in, and nowhere else."""
    found = gsplat.spherical_harmonics(1, raw.means, spoiled(raw.sh[:, :4], value))
    assert bool(torch.isfinite(found[1:]).all())
    covariances, precisions = gsplat.quat_scale_to_covar_preci(spoiled(raw.quats, value), raw.scales)
    assert bool(torch.isfinite(covariances[1:]).all())
    assert bool(torch.isfinite(precisions[1:]).all())


def inria_image(raw, camera: dict | None = None, **given):
    tangents = [0.5 * size / float(raw.Ks[0, axis, axis]) for axis, size in enumerate((WIDTH, HEIGHT))]
    projection = torch.zeros(4, 4)
    projection[0, 0], projection[1, 1], projection[3, 2], projection[2, 2] = 1 / tangents[0], 1 / tangents[1], 1, 1
    view = raw.viewmats[0].float().T.contiguous()
    center = torch.linalg.inv(view)[3, :3]
    settings = {
        "image_height": HEIGHT, "image_width": WIDTH, "tanfovx": tangents[0], "tanfovy": tangents[1],
        "bg": torch.zeros(3), "scale_modifier": 1.0, "viewmatrix": view, "projmatrix": view @ projection.T,
        "sh_degree": 1, "campos": center,
    }  # fmt: skip
    rasterizer = inria.GaussianRasterizer(inria.GaussianRasterizationSettings(**settings | (camera or {})))
    fields = {"means3D": raw.means, "opacities": raw.opacities, "shs": raw.sh[:, :4], "scales": raw.scales,
              "rotations": raw.quats}  # fmt: skip
    return rasterizer(means2D=None, **fields | given)[:1]


@pytest.mark.parametrize("value", BAD)
@pytest.mark.parametrize(
    "name",
    [
        *("viewmatrix", "projmatrix", "tanfovx", "tanfovy", "scale_modifier"),
        *(pytest.param(name, marks=ON_CUDA_UNSEEN) for name in ("campos", "bg")),
    ],
)
def test_inria_refuses_what_places_a_whole_image(raw, name, value):
    good = inria_image(raw)[0]
    assert bool((good > 0).any())
    sizes = {"viewmatrix": (4, 4), "projmatrix": (4, 4), "campos": (3,), "bg": (3,)}
    changed = spoiled(torch.eye(4) if len(sizes.get(name, ())) == 2 else torch.zeros(3), value)
    with pytest.raises(InputError, match=f"^{name}: holds NaN or infinity"):
        inria_image(raw, {name: changed if name in sizes else value})


def test_inria_refuses_matrices_without_inverse(raw):
    with pytest.raises(InputError, match=r"^viewmatrix: has no inverse"):
        inria_image(raw, {"viewmatrix": torch.zeros(4, 4)})
    flat = torch.zeros(4, 4)
    flat[2, 3] = 1.0
    with pytest.raises(InputError, match=r"^tanfovx: .* which says inf"):
        inria_image(raw, {"viewmatrix": torch.eye(4), "projmatrix": flat})


@ON_CUDA_UNSEEN
def test_inria_marks_nothing_by_a_matrix_that_is_not_finite(raw):
    rasterizer = inria.GaussianRasterizer(
        inria.GaussianRasterizationSettings(
            HEIGHT, WIDTH, 1.0, 1.0, torch.zeros(3), 1.0, torch.full((4, 4), math.nan), torch.eye(4), 0, torch.zeros(3)
        )
    )
    with pytest.raises(InputError, match=r"^viewmatrix: holds NaN or infinity"):
        rasterizer.markVisible(raw.means)


@pytest.mark.parametrize("value", BAD)
@pytest.mark.parametrize("name", ["means3D", "scales", "shs"])
def test_inria_leaves_rows_out(raw, name, value):
    fields = {"means3D": raw.means, "opacities": raw.opacities, "shs": raw.sh[:, :4], "scales": raw.scales,
              "rotations": raw.quats}  # fmt: skip
    require_left_out(lambda **given: inria_image(raw, **given), fields, name, value, int(visible(raw)))
