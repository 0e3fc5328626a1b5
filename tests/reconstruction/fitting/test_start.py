"""What a fit starts from: points on disk, random points, RGB-D; and the photographs it refuses."""

import json
import logging
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from sgwarp.errors import InputError
from sgwarp.io.points import find_points, load_points
from sgwarp.io.views import load_views
from sgwarp.metrics.images import psnr
from sgwarp.ops.splatting.forward import rasterize
from sgwarp.reconstruction.depth import gaussians_from_depth
from sgwarp.reconstruction.fitting.initial import _points_anywhere, depth_from_folder, gaussians_from_points
from sgwarp.reconstruction.fitting.photographs import masks_from_folder, read_photographs
from sgwarp.reconstruction.fitting.settings import FitSettings
from sgwarp.reconstruction.fitting.trainer import fit
from sgwarp.scene import View
from sgwarp.scene.extent import camera_extent

ONE_STEP = FitSettings(steps=1)


@pytest.fixture
def copy(boards, tmp_path) -> Path:
    """The stage, to be damaged."""
    return Path(shutil.copytree(boards.folder, tmp_path / "stage"))


def edit(folder: Path, change) -> None:
    """Change the content of transforms.json."""
    path = folder / "transforms.json"
    meta = json.loads(path.read_text())
    change(meta)
    path.write_text(json.dumps(meta))


def test_points_beside_the_transforms_are_found(boards):
    positions, colours = load_points(boards.folder)
    assert find_points(boards.folder) == boards.folder / "points3D.ply"
    assert positions.shape == colours.shape
    assert 0 <= colours.min() < colours.max() <= 1
    assert abs(np.median(positions[:, 2]) - 4.0) < 0.01


def test_nerfstudios_entry_names_the_points(copy, caplog):
    (copy / "points3D.ply").rename(copy / "cloud.ply")
    assert find_points(copy) is None
    edit(copy, lambda meta: meta.update(ply_file_path="cloud.ply"))
    assert find_points(copy) == copy / "cloud.ply"
    assert len(load_points(copy / "transforms.json")[0]) > 500
    (copy / "cloud.ply").unlink()
    with pytest.raises(InputError, match=r"holds no points; looked for 'ply_file_path' in transforms\.json"):
        load_points(copy)
    assert "its 'ply_file_path' 'cloud.ply' does not exist" in caplog.text


def test_points_of_a_colmap_model(tmp_path):
    model = tmp_path / "sparse" / "0"
    model.mkdir(parents=True)
    (model / "cameras.txt").write_text("1 PINHOLE 4 3 2 2 2 1.5\n")
    (model / "points3D.txt").write_text("1 0.5 1 2 255 0 51 0.1\n2 1 1 2 0 0 0 0.1\n")
    positions, colours = load_points(tmp_path)
    assert positions.tolist() == [[0.5, 1, 2], [1, 1, 2]]
    assert colours[0].tolist() == pytest.approx([1, 0, 0.2])


def test_points_that_are_not_finite_are_left_out(copy):
    (copy / "cloud.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 3\n"
        + "".join(f"property float {axis}\n" for axis in "xyz")
        + "end_header\n1 2 3\nnan 0 0\n4 5 6\n"
    )
    positions, colours = load_points(copy / "cloud.ply")
    assert positions.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert (colours == 0.5).all()


def test_no_points_is_said(tmp_path, boards):
    shutil.copy(boards.folder / "transforms.json", tmp_path)
    assert find_points(tmp_path) is None
    with pytest.raises(InputError, match="holds no points; looked for 'ply_file_path'"):
        load_points(tmp_path)


@pytest.mark.parametrize("strategy", ["default", "mcmc"])
def test_gaussians_are_as_large_as_the_distance_to_their_neighbours(strategy):
    grid = np.stack(np.meshgrid(*[np.arange(4.0)] * 3), axis=-1).reshape(-1, 3) * 0.2
    gaussians = gaussians_from_points(grid, np.full(grid.shape, 0.25), FitSettings(strategy=strategy), 1.0)
    torch.testing.assert_close(gaussians.scales, torch.full((64, 3), 0.2))
    assert gaussians.opacities.unique().tolist() == pytest.approx([{"default": 0.1, "mcmc": 0.5}[strategy]])
    torch.testing.assert_close(gaussians.sh * 0.28209479177387814 + 0.5, torch.full((64, 1, 3), 0.25))


def test_points_beyond_the_cap_are_drawn_and_doubles_keep_a_size():
    points = np.concatenate([np.random.default_rng(0).normal(size=(50, 3)), np.zeros((50, 3))])
    gaussians = gaussians_from_points(points, np.zeros((100, 3)), FitSettings(cap=40), 2.0)
    assert len(gaussians) == 40
    assert (gaussians.scales > 0).all()
    assert {tuple(row) for row in gaussians.means.tolist()} <= {
        tuple(row) for row in torch.tensor(points).float().tolist()
    }


def test_random_points_lie_in_front_of_their_cameras_and_take_their_colours(boards):
    photographs = read_photographs(boards.views)
    positions, colours = _points_anywhere(photographs, 800, torch.Generator().manual_seed(0))
    assert len(positions) == len(colours) == 800
    for index, photograph in enumerate(photographs):
        own = slice(100 * index, 100 * (index + 1))
        camera = photograph.camera
        points = positions[own] @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
        pixels = points @ camera.K.T
        x, y = (pixels[:, 0] / pixels[:, 2]), (pixels[:, 1] / pixels[:, 2])
        assert (points[:, 2] > 0).all()
        assert torch.equal(photograph.image()[y.long(), x.long()], colours[own])


def test_depth_starts_near_the_photographs(boards):
    views = boards.views
    start = gaussians_from_depth(views[1:], depth_from_folder(boards.folder / "depth"), count=2000)
    from_depth, from_nothing = (fit(views[1:], first, views[:1], ONE_STEP) for first in (start, None))
    assert from_depth.held_out["0000"] > from_nothing.held_out["0000"]


def test_depth_images_in_millimetres(boards, tmp_path):
    metres = depth_from_folder(boards.folder / "depth")(boards.views[2])
    cv2.imwrite(str(tmp_path / "0002.png"), (metres * 1000).round().astype(np.uint16))
    assert np.abs(depth_from_folder(tmp_path)(boards.views[2]) - metres).max() < 6e-4
    with pytest.raises(InputError, match=r"0003\.png: no such file"):
        depth_from_folder(tmp_path)(boards.views[3])
    (tmp_path / "0004.npy").write_bytes(b"no array")
    with pytest.raises(InputError, match=r"0004\.npy: is not "):
        depth_from_folder(tmp_path)(boards.views[4])


def test_the_extent_is_that_of_the_reference_implementation(boards):
    places = torch.stack([view.camera.position for view in boards.views])
    assert camera_extent(boards.views) == pytest.approx(1.1 * (places - places.mean(0)).norm(dim=1).max().item())
    assert camera_extent(boards.views[:1]) == 1.0


def test_smaller_photographs_are_means_of_their_pixels(boards):
    view = boards.views[3]
    (small,) = read_photographs([view], downscale=4)
    assert small.camera.size == (12, 16)
    expected = view.image().unfold(0, 4, 4).unfold(1, 4, 4).mean(dim=(3, 4))
    assert (small.image() - expected).abs().max() < 0.6 / 255


def test_fewer_than_three_photographs(boards):
    with pytest.raises(
        InputError, match=r"2 photographs are left to fit to \(0000, 0001\).*at least 3: add photographs"
    ):
        fit(boards.views[:2], load_points(boards.folder))


def test_photographs_that_cannot_be_used_are_left_out(copy, caplog):
    views = load_views(copy)
    data = (copy / "images" / "0003.png").read_bytes()
    (copy / "images" / "0003.png").write_bytes(data[: len(data) // 2])
    (copy / "images" / "0004.png").write_text("a photograph")
    with caplog.at_level(logging.WARNING, logger="sgwarp"):
        read = read_photographs(views)
        assert [p.stem for p in read] == [view.stem for view in views if view.stem not in ("0003", "0004")]
        assert "left out 2 of 8 photographs that cannot be used, first: " in caplog.text
        assert "0003.png: image is cut short" in caplog.text
        assert fit(load_views(copy), load_points(copy), settings=ONE_STEP).complete
    assert "left out 1 frames that cannot be used, first: " in caplog.text
    assert "0004.png: " in caplog.text
    for view in views:
        view.image_path.write_text("nothing")
    with pytest.raises(InputError, match=r"0000\.png: is not an image"):
        read_photographs(views)


def test_a_photograph_of_another_shape_is_left_out(copy, caplog):
    cv2.imwrite(str(copy / "images" / "0005.png"), np.zeros((30, 20, 3), np.uint8))
    with caplog.at_level(logging.WARNING, logger="sgwarp"):
        assert "0005" not in [view.stem for view in load_views(copy)]
    assert "0005.png: image is 20 x 30, its camera says 64 x 48" in caplog.text


def test_a_photograph_that_shows_nothing_of_the_scene(copy, caplog):
    def turn_round(meta):
        pose = np.array(meta["frames"][6]["transform_matrix"])
        pose[:3, [0, 2]] *= -1
        meta["frames"][6]["transform_matrix"] = pose.tolist()

    edit(copy, turn_round)
    fit(load_views(copy), load_points(copy), settings=ONE_STEP)
    assert "1 of 8 photographs show none of the" in caplog.text
    assert "0006.png" in caplog.text


def test_a_view_without_photograph(boards):
    views = [*boards.views[:3], View("bare", boards.views[3].camera)]
    with pytest.raises(InputError, match="view bare: has no photograph"):
        fit(views, load_points(boards.folder), settings=ONE_STEP)


def test_masks(boards, tmp_path):
    views = boards.views
    with pytest.raises(InputError, match=r"holds no mask of any view; expected files such as 0000\.png"):
        masks_from_folder(tmp_path, views)
    mask = np.zeros((48, 64), np.uint8)
    mask[:, :32] = 255
    cv2.imwrite(str(tmp_path / "0000.png"), mask)
    masks = masks_from_folder(tmp_path, views)
    read = read_photographs(views[:2], masks=masks)
    assert torch.equal(read[0].mask, torch.from_numpy(mask > 0))
    assert read[1].mask is None
    cv2.imwrite(str(tmp_path / "0000.png"), mask[:20])
    with pytest.raises(InputError, match=r"0000\.png: is 64 x 20, its photograph 64 x 48; resize one of them"):
        read_photographs(views[:1], masks=masks)
    cv2.imwrite(str(tmp_path / "0000.png"), np.zeros_like(mask))
    assert read_photographs(views[:1], masks=masks) == []


@pytest.mark.parametrize(
    ("name", "white_is_left_out"),
    [
        *(("0000.png", False), ("0000_mask.png", False), ("mask_0000.png", False), ("0000.mask.png", False)),
        *(("0000.npy", False), ("dynamic_mask_0000.png", True)),
    ],
)
def test_spellings_of_masks(boards, tmp_path, name, white_is_left_out):
    """In instant-ngp's dynamic_mask_ white is what moves; --mask-hides white says so of any."""
    mask = np.zeros((48, 64), np.uint8)
    mask[:, :20] = 255
    if name.endswith(".npy"):
        np.save(tmp_path / name, mask > 0)
    else:
        cv2.imwrite(str(tmp_path / name), mask)
    views = boards.views[:1]
    np.testing.assert_array_equal(masks_from_folder(tmp_path, views)(views[0]), (mask > 0) ^ white_is_left_out)
    np.testing.assert_array_equal(masks_from_folder(tmp_path, views, "white")(views[0]), mask == 0)


def test_masks_that_hide_nearly_all_may_be_the_other_way_round(boards, caplog):
    mask = np.zeros((48, 64), np.uint8)
    mask[:, :6] = 1
    read_photographs(boards.views[:3], masks=lambda view: mask)
    assert "masks leave out 91 % of the pixels of 3 photographs" in caplog.text
    assert "--mask-hides white" in caplog.text
    caplog.clear()
    read_photographs(boards.views[:3], masks=lambda view: 1 - mask)
    assert not caplog.text


@pytest.mark.parametrize("name", ["0000.tif", "0000_depth.tiff", "depth_0000.png", "depth_0000.npy", "0000.npy"])
def test_spellings_of_depth(boards, tmp_path, name):
    """Floating point is meters, whole numbers are millimeters."""
    depth = np.linspace(1, 5, 48 * 64).reshape(48, 64).astype(np.float32)
    if name.endswith(".npy"):
        np.save(tmp_path / name, depth[None] if name == "0000.npy" else depth)
    else:
        cv2.imwrite(str(tmp_path / name), (depth * 1000).round().astype(np.uint16) if "png" in name else depth)
    found = depth_from_folder(tmp_path, boards.views)(boards.views[0])
    np.testing.assert_allclose(found, depth, atol=6e-4)


def test_depth_of_formats_that_are_not_read_is_named(boards, tmp_path):
    (tmp_path / "0000.exr").write_bytes(b"\x76\x2f\x31\x01")
    with pytest.raises(InputError, match=r"0000\.exr: depth is read from \.npy .* not from \.exr; convert it"):
        depth_from_folder(tmp_path, boards.views)(boards.views[0])


def test_photographs_of_twelve_bits_in_sixteen_are_nearly_black(boards, tmp_path, caplog):
    cv2.imwrite(str(tmp_path / "a.png"), np.full((48, 64, 3), 4000, np.uint16))
    read_photographs([replace(boards.views[0], image_path=tmp_path / "a.png"), *boards.views[1:3]])
    assert "1 photographs are nearly black, first " in caplog.text


def test_masked_pixels_do_not_count(boards):
    """A corner painted over in every photograph spoils the scene, unless it is masked."""
    views, points = boards.views, load_points(boards.folder)
    mask = np.ones((48, 64), bool)
    mask[:24, :32] = False

    def painted(view: View) -> View:
        def paint(pixels: np.ndarray) -> np.ndarray:
            return np.where(mask[..., None], pixels, np.uint8(0))

        return View(view.stem, view.camera, view.image_path, undistort=paint)

    settings = FitSettings(steps=80, strategy="default")
    results = []
    for masks in (None, lambda view: mask):
        fitted = fit([painted(view) for view in views[1:]], points, (), settings, masks=masks)
        image = rasterize(fitted.gaussians, views[0].camera).features
        results.append(psnr(image[:20, :28], views[0].image()[:20, :28]))
    spoiled, masked = results
    assert masked > spoiled + 3


def test_masks_count_on_held_out_views_too(boards):
    """What covers part of every photograph says nothing about the scene, when it is measured either."""
    mask = np.ones((48, 64), bool)
    mask[:16] = False

    def covered(view: View) -> View:
        return View(
            view.stem, view.camera, view.image_path, undistort=lambda p: np.where(mask[..., None], p, np.uint8(255))
        )

    views = [covered(view) for view in boards.views]
    settings, points = FitSettings(steps=80, evaluate_every=80), load_points(boards.folder)
    counted = fit(views[1:], points, views[:1], settings, masks=lambda view: mask).curve[-1].psnr
    everything = fit(views[1:], points, views[:1], settings).curve[-1].psnr
    clean = fit(boards.views[1:], points, boards.views[:1], settings).curve[-1].psnr
    assert counted > clean - 2
    assert counted > everything


def test_masks_that_are_missing_are_counted(boards, tmp_path, caplog):
    cv2.imwrite(str(tmp_path / "0000.png"), np.full((48, 64), 255, np.uint8))
    masks_from_folder(tmp_path, boards.views)
    assert "7 of 8 views have no mask (0001, ...)" in caplog.text


def test_a_mask_that_vanishes_with_the_size(boards):
    mask = np.zeros((48, 64), bool)
    mask[5, 5] = True
    assert len(read_photographs(boards.views[:1], masks=lambda view: mask)) == 1
    assert read_photographs(boards.views[:1], downscale=4, masks=lambda view: mask) == []


@pytest.mark.parametrize("downscale", [1, 2])
def test_transparent_photographs_show_the_background(boards, tmp_path, downscale):
    view = boards.views[0]
    pixels = np.full((48, 64, 4), 200, np.uint8)
    pixels[..., 3] = 255
    pixels[:24, :, 3] = 0
    pixels[24:36, :, 3] = 102
    cv2.imwrite(str(tmp_path / "0000.png"), pixels)
    (photograph,) = read_photographs([View("0000", view.camera, tmp_path / "0000.png")], downscale=downscale)
    rows = [4 // downscale, 30 // downscale, 40 // downscale]
    for background, expected in ((None, [0, 0.4 * 200 / 255, 200 / 255]), (1.0, [1, 0.4 * 200 / 255 + 0.6, 200 / 255])):
        shown = photograph.image(None if background is None else torch.full((3,), background))
        assert shown[rows, 5, 1].tolist() == pytest.approx(expected, abs=0.005)
    (opaque,) = read_photographs(boards.views[:1])
    assert opaque.alpha is None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda p, c: (p, (c * 255).astype(np.uint8)), r"colours lie in \d+ to \d+, not in \[0, 1\]; divide by 255"),
        (lambda p, c: (np.where(np.arange(len(p))[:, None] == 7, np.nan, p), c), "positions of point 7 are not finite"),
        (lambda p, c: (p, np.where(np.arange(len(p))[:, None] == 9, np.inf, c)), "colours of point 9 are not finite"),
        (lambda p, c: p, "start: expected points"),
    ],
)
def test_points_that_make_no_sense(boards, change, message):
    with pytest.raises(InputError, match=message):
        fit(boards.views, change(*load_points(boards.folder)), settings=ONE_STEP)


def test_a_cap_below_what_a_scene_needs(boards):
    with pytest.raises(InputError, match="cap: a scene starts from at least 4 points, got 2"):
        fit(boards.views, load_points(boards.folder), settings=FitSettings(steps=1, cap=2))


def test_the_overlap_is_that_of_all_points(boards):
    fitted = fit(boards.views, load_points(boards.folder), settings=FitSettings(steps=1, cap=4))
    assert len(fitted.gaussians) == 4


def test_a_scene_to_start_from_keeps_the_degree_that_was_asked_for(boards):
    first = fit(boards.views, load_points(boards.folder), settings=FitSettings(steps=4, sh_degree=2, degree_every=1))
    assert first.gaussians.sh.shape[1] == 9
    again = fit(boards.views, first.gaussians, settings=FitSettings(steps=1, sh_degree=0))
    assert again.gaussians.sh.shape[1] == 1


def test_small_scenes_are_not_cut_by_the_near_plane(boards):
    """The same stage in another unit: a thousandth of its size."""
    views = []
    for view in boards.views:
        pose = view.camera.world_to_camera.clone()
        pose[:3, 3] *= 1e-3
        views.append(View(view.stem, replace(view.camera, world_to_camera=pose), view.image_path))
    positions, colours = load_points(boards.folder)
    settings = FitSettings(steps=60, evaluate_every=60)
    small = fit(views[1:], (1e-3 * positions, colours), views[:1], settings).curve[-1].psnr
    usual = fit(boards.views[1:], (positions, colours), boards.views[:1], settings).curve[-1].psnr
    assert small == pytest.approx(usual, abs=1.0)


def test_held_out_views_that_show_nothing_are_named(boards, caplog):
    pose = boards.views[0].camera.world_to_camera.clone()
    pose[:3, 3] += 500
    away = View("away", replace(boards.views[0].camera, world_to_camera=pose), boards.views[0].image_path)
    fit(boards.views, load_points(boards.folder), [away], ONE_STEP)
    assert "held-out view away shows none" in caplog.text


@pytest.mark.parametrize("bad", [{"steps": 10.5}, {"steps": float("nan")}, {"cap": 2e3}, {"sh_degree": 1.5}])
def test_numbers_that_are_not_whole(bad):
    with pytest.raises(InputError, match="expected a whole number"):
        FitSettings(**bad)


def test_things_that_are_no_views(boards):
    with pytest.raises(InputError, match="views: expected posed photographs"):
        fit([view.camera for view in boards.views], settings=ONE_STEP)


def test_masks_by_name(boards):
    mask = np.zeros((48, 64), bool)
    mask[:, :32] = True
    fitted = fit(boards.views, load_points(boards.folder), settings=ONE_STEP, masks={"0000": mask})
    same = fit(
        boards.views,
        load_points(boards.folder),
        settings=ONE_STEP,
        masks=lambda view: mask if view.stem == "0000" else None,
    )
    assert torch.equal(fitted.gaussians.means, same.gaussians.means)


def test_a_transparent_start_is_refused(boards):
    scene = fit(boards.views, load_points(boards.folder), settings=ONE_STEP).gaussians
    with pytest.raises(InputError, match="no photograph would move them"):
        fit(boards.views, replace(scene, opacities=torch.zeros(len(scene))), settings=ONE_STEP)
