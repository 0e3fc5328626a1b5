"""Where something begins to count in a fit: darkness, masks, agreement, parallax, sizes, and what is said then."""

import logging
import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from sgwarp.errors import InputError
from sgwarp.files.images import write_rgb
from sgwarp.ops.neighbors import mean_squared_neighbor_distance
from sgwarp.reconstruction import depth as depth_module
from sgwarp.reconstruction.depth_unit import DepthUnit
from sgwarp.reconstruction.fitting import depth_start, initial, trainer
from sgwarp.reconstruction.fitting.belongings import depth_from_folder, masks_from_folder
from sgwarp.reconstruction.fitting.coverage import in_view, report_start, seen_by_any
from sgwarp.reconstruction.fitting.frame import Frame
from sgwarp.reconstruction.fitting.photographs import Photograph, read_photographs, require_overlap
from sgwarp.reconstruction.fitting.pixels import IN_MEMORY, PixelStore
from sgwarp.reconstruction.fitting.report import sheet_rows
from sgwarp.reconstruction.fitting.settings import FitSettings
from sgwarp.reconstruction.fitting.trainer import fit
from sgwarp.reconstruction.stereo import DepthMap
from sgwarp.runs.log import RunLog
from sgwarp.scene import Camera, Gaussians, View

K = torch.tensor([[40.0, 0, 20], [0, 40, 15], [0, 0, 1]])


def camera(x: float = 0.0, width: int = 40, height: int = 30) -> Camera:
    pose = torch.eye(4, dtype=torch.float64)
    pose[0, 3] = -x
    return Camera(K, pose, width, height)


def written(folder, shades, width=40, height=30) -> list[View]:
    """Photographs of one gray each."""
    views = []
    for k, shade in enumerate(shades):
        path = folder / f"{k}.png"
        write_rgb(path, np.full((height, width, 3), shade, np.uint8))
        views.append(View(str(k), camera(0.1 * k, width, height), path))
    return views


def black(x: float) -> Photograph:
    return Photograph(f"at {x:g}", camera(x), torch.zeros(30, 40, 3, dtype=torch.uint8))


# Photographs and masks.


@pytest.mark.parametrize(("shade", "dark"), [(0, True), (16, True), (17, False), (200, False)])
def test_what_no_pixel_of_exceeds_16_is_nearly_black(tmp_path, caplog, shade, dark):
    read_photographs(written(tmp_path, [shade, 100]))
    assert ("1 photographs are nearly black" in caplog.text) == dark


@pytest.mark.parametrize(("hidden", "said"), [(0.69, False), (0.71, True)])
def test_masks_that_leave_out_seven_tenths_may_be_the_other_way_round(tmp_path, caplog, hidden, said):
    mask = np.ones((30, 100), bool)
    mask[:, : round(100 * hidden)] = False
    read_photographs(written(tmp_path, [100, 200], width=100), masks=lambda view: mask)
    assert ("if they mark what is to be left out, say --mask-hides white" in caplog.text) == said


def test_a_photograph_that_is_hidden_counts_as_left_out(tmp_path, caplog):
    masks = {"0": np.zeros((30, 40)), "1": np.ones((30, 40)), "2": np.ones((30, 40))}
    found = read_photographs(written(tmp_path, [100] * 3), masks=lambda view: masks[view.stem])
    assert [photograph.stem for photograph in found] == ["1", "2"]
    assert "left out 1 photographs whose mask leaves no pixel, first 0" in caplog.text
    assert "masks leave out" not in caplog.text  # a third


@pytest.mark.parametrize(
    ("downscale", "largest", "size", "said"),
    [
        (1, 0, (300, 400), False),
        (2, 0, (150, 200), False),
        (1, 400, (300, 400), False),
        (1, 200, (150, 200), True),
        (2, 200, (150, 200), False),
        (2, 100, (75, 100), True),
        (3, 0, (100, 133), False),
    ],
)
def test_photographs_are_made_smaller_with_their_cameras(tmp_path, caplog, downscale, largest, size, said):
    views = written(tmp_path, [100] * 2, 400, 300)
    for photograph in read_photographs(views, downscale=downscale, largest=largest):
        assert photograph.pixels.shape == (*size, 3)
        assert photograph.camera.size == size
        assert photograph.camera.K[0, 0].item() == pytest.approx(40 * size[1] / 400)
    assert ("photographs are scaled down to" in caplog.text) == said


@pytest.mark.parametrize("name", ["downscale", "largest"])
def test_sizes_that_cannot_be_are_named(tmp_path, name):
    with pytest.raises(InputError, match=f"{name}: expected"):
        read_photographs([], **{name: -1})


@pytest.mark.parametrize(
    ("name", "hides", "white_counts"),
    [
        ("0.png", "black", True),
        ("0.png", "white", False),
        ("dynamic_mask_0.png", "black", False),
        ("dynamic_mask_0.png", "white", False),
        ("mask_0.png", "black", True),
    ],
)
def test_which_side_of_a_mask_counts_and_whose_is_missing(tmp_path, caplog, name, hides, white_counts):
    (tmp_path / "masks").mkdir()
    white = np.zeros((30, 40, 3), np.uint8)
    white[:, 10:] = 255
    write_rgb(tmp_path / "masks" / name, white)
    views = written(tmp_path, [100] * 2)
    mask = masks_from_folder(tmp_path / "masks", views, hides)
    assert mask(views[1]) is None
    assert "1 of 2 views have no mask (1, ...)" in caplog.text
    assert mask(views[0])[:, 10:].all() == white_counts
    assert mask(views[0])[:, :10].any() != white_counts
    assert ("white is what is left out" in caplog.text) == (name.startswith("dynamic") and hides == "black")


@pytest.mark.parametrize(("shade", "counts"), [(127, False), (128, True)])
def test_a_lossy_mask_counts_from_the_middle_on(tmp_path, shade, counts):
    import cv2

    views = written(tmp_path, [100])
    (tmp_path / "masks").mkdir()
    cv2.imwrite(str(tmp_path / "masks" / "0.jpg"), np.full((30, 40, 3), shade, np.uint8))
    assert masks_from_folder(tmp_path / "masks", views)(views[0]).all() == counts


def test_depth_of_another_shape_is_refused_and_of_another_size_carried(tmp_path):
    views = written(tmp_path, [100] * 2)
    np.save(tmp_path / "0.npy", np.arange(15 * 20, dtype=np.float32).reshape(15, 20))
    np.save(tmp_path / "1.npy", np.ones((15, 30), np.float32))
    depth = depth_from_folder(tmp_path, views)
    np.testing.assert_array_equal(depth(views[0])[::2, ::2], np.arange(300).reshape(15, 20))
    with pytest.raises(InputError, match="is 30 x 15, its photograph 40 x 30"):
        depth(views[1])


# What a fit starts from.


@pytest.mark.parametrize(("agreement", "fine"), [(0.39, False), (0.41, True)])
def test_depth_that_contradicts_itself_is_refused(monkeypatch, agreement, fine):
    monkeypatch.setattr(depth_start, "measure_depth_unit", lambda *rest: DepthUnit(1.0, agreement, agreement))
    if fine:
        assert depth_start._factor("here", [], [], 1.0) == 1.0
        return
    with pytest.raises(InputError, match="here: the views contradict each other"):
        depth_start._factor("here", [], [], 1.0)


@pytest.mark.parametrize(
    ("found", "factor", "said"),
    [
        (DepthUnit(0.001, 0.9, 0.1), 0.001, "depth and poses are in different units: at 0.001 times the depth 90 %"),
        (DepthUnit(1.0, 0.9, 0.9), 1.0, ""),
        (None, 1.0, "too little of one view shows in others to check the unit of the depth"),
    ],
)
def test_the_unit_of_the_depth_is_said_and_applied(monkeypatch, caplog, found, factor, said):
    monkeypatch.setattr(depth_start, "measure_depth_unit", lambda *rest: found)
    views = [View(str(k), camera(k)) for k in range(2)]
    usable = depth_start.usable_depth("here", lambda view: np.full((30, 40), 2.0), views)
    np.testing.assert_allclose(usable(views[0]), 2.0 * factor)
    assert (said in caplog.text) if said else not caplog.records


@pytest.mark.parametrize(("known", "fog"), [(499, True), (500, False)])
def test_points_lie_anywhere_and_small_where_photographs_agree_nowhere(monkeypatch, caplog, known, fog):
    photographs = [black(0.0), black(0.0), black(0.0)]
    agreed = np.zeros((30, 40), bool)
    agreed.reshape(-1)[:known] = True
    depth, colors = np.full((30, 40), 2.0, np.float32), np.zeros((30, 40, 3), np.float32)
    maps = [DepthMap(camera(), depth, colors, agreed & (index == 0)) for index in range(3)]
    monkeypatch.setattr(initial, "estimate_depth", lambda *rest: maps)
    found = initial.gaussians_from_photographs(photographs, FitSettings(cap=300), 1.0)
    assert ("the fit may end in fog" in caplog.text) == fog
    if fog:
        assert len(found) == 300
        distance = mean_squared_neighbor_distance(found.means.double()).sqrt().float()
        torch.testing.assert_close(found.scales, (0.35 * distance)[:, None].expand(-1, 3))
    else:
        torch.testing.assert_close(found.means[:, 2], torch.full((len(found),), 2.0))


def test_points_anywhere_lie_between_a_fifth_and_four_extents():
    points, _ = initial._points_anywhere([black(0.0), black(0.0), black(0.0)], 3001, torch.Generator().manual_seed(0))
    assert len(points) == 3001
    logs = points[:, 2].log()
    assert math.log(0.2) < logs.min() < math.log(0.21)
    assert math.log(3.9) < logs.max() < math.log(4.0)
    assert logs.mean().item() == pytest.approx((math.log(0.2) + math.log(4.0)) / 2, abs=0.05)
    assert in_view(camera(), points).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"means": torch.zeros(0, 3)}, "holds no Gaussians"),
        ({"means": torch.zeros(6, 3)}, "has 6 Gaussians, more than the cap 5"),
        ({"means": torch.full((5, 3), torch.nan)}, "5 Gaussians to start from hold NaN or infinity"),
        ({"opacities": torch.full((5,), 1 / 256)}, "are below an opacity of 0.0039"),
        ({"opacities": torch.full((5,), 1 / 254)}, None),
    ],
)
def test_scenes_to_start_from(change, message):
    count = len(change.get("means", torch.zeros(5)))
    shapes = {"means": (3,), "quats": (4,), "scales": (3,), "opacities": (), "sh": (16, 3)}
    scene = Gaussians(**{name: torch.full((count, *shape), 0.5) for name, shape in shapes.items()} | change)
    if message is None:
        assert initial.adapted(scene, FitSettings(cap=5, sh_degree=1)).sh.shape == (5, 4, 3)
        return
    with pytest.raises(InputError, match=message):
        initial.adapted(scene, FitSettings(cap=5))


@pytest.mark.parametrize("count", [3, 4])
def test_a_scene_starts_from_four_points(count):
    points = torch.eye(4, 3)[:count]
    if count == 4:
        assert len(initial.gaussians_from_points(points, points, FitSettings(cap=4), 1.0)) == 4
        with pytest.raises(InputError, match="cap: a scene starts from at least 4 points, got 3"):
            initial.gaussians_from_points(points, points, FitSettings(cap=3), 1.0)
        return
    with pytest.raises(InputError):
        initial.gaussians_from_points(points, points, FitSettings(), 1.0)


# Cameras and points.


@pytest.mark.parametrize(("beside", "said"), [(0.17, True), (0.18, False)])
def test_cameras_that_see_points_under_two_degrees_know_little_of_their_depth(caplog, beside, said):
    """Three photographs on a line, `beside` apart from the middle one, of points at a distance of 10."""
    photographs = [black(x) for x in (-beside, 0.0, beside)]
    with caplog.at_level(logging.INFO, "sgwarp"):
        report_start(photographs, torch.tensor([[0.0, 0, 10]] * 7), Frame(torch.zeros(3).double(), 5.0, None))
    assert ("they are so close together that depth is hardly known" in caplog.text) == said
    assert 2 * math.degrees(math.atan(0.17 / 10)) < 2 < 2 * math.degrees(math.atan(0.18 / 10))
    assert (
        f"3 photographs of 40 x 30, within 5 world units of their center, the next one {5 * beside:.3g}" in caplog.text
    )
    assert "7 to start from, 100 % in view of 3 or more photographs; medians: distance 50" in caplog.text


@pytest.mark.parametrize(("x", "seen"), [(5.29, True), (5.31, False), (-5.29, True), (-5.31, False)])
def test_a_footprint_reaches_three_deviations(x, seen):
    """At a distance of 10 the image of 40 pixels is 10 wide, and 3 * 0.1 reach into it from beside."""
    shapes = {"quats": (4,), "opacities": (), "sh": (1, 3)}
    blank = {name: torch.full((1, *shape), 0.5) for name, shape in shapes.items()}
    scene = Gaussians(torch.tensor([[x, 0, 10.0]]), scales=torch.tensor([[0.01, 0.1, 0.02]]), **blank)
    assert seen_by_any(scene, [camera()]).tolist() == [seen]


@pytest.mark.parametrize(
    ("shows", "said"), [([1, 1, 1], ""), ([0, 1, 1], "1 of 3 photographs show none"), ([0, 0, 0], "error")]
)
def test_photographs_that_show_nothing_of_the_start(caplog, shows, said):
    photographs = [black(0.0 if one else 900.0) for one in shows]
    means = torch.tensor([[0.0, 0, 10]] * 4)
    if said == "error":
        with pytest.raises(InputError, match="shows none of the 4 points that the scene starts from"):
            require_overlap(photographs, means)
        return
    require_overlap(photographs, means, [black(0.0), black(900.0)])
    assert "held-out view at 900 shows none" in caplog.text
    assert "held-out view at 0 " not in caplog.text
    assert said in caplog.text
    assert ("to start from, first" in caplog.text) == bool(said)


@pytest.mark.parametrize(("count", "rows"), [(1, [0]), (8, list(range(8))), (15, [0, 2, 4, 6, 8, 10, 12, 14])])
def test_rows_of_a_contact_sheet(count, rows):
    assert sheet_rows(count) == rows


def test_a_store_keeps_a_gigabyte_in_memory_and_the_rest_in_a_file():
    assert IN_MEMORY == 1 << 30
    store = PixelStore(in_memory=100)
    first, second, third = (store.put(np.full(shape, k, np.uint8)) for k, shape in enumerate([(10, 9), (4, 3), (2, 5)]))
    assert isinstance(first, torch.Tensor)
    assert not isinstance(second, torch.Tensor)
    assert isinstance(third, torch.Tensor)
    fourth = store.put(np.arange(6, dtype=np.uint8).reshape(2, 3))
    assert second.read().tolist() == [[1] * 3] * 4
    assert fourth.read().tolist() == [[0, 1, 2], [3, 4, 5]]


# What is passed on.


def test_options_of_a_fit_reach_the_photographs(boards, monkeypatch):
    """All of them, for those that are fitted and those that are held out."""
    given = []

    class Enough(Exception):
        pass

    def read(views, **options):
        given.append(([view.stem for view in views], options))
        if len(given) == 2:
            raise Enough
        return []

    monkeypatch.setattr(trainer, "read_photographs", read)
    views, mask = boards.views, np.ones((48, 64))
    with pytest.raises(Enough):
        fit(views[1:], None, views[:1], FitSettings(), downscale=2, largest=33, masks={"0003": mask})
    assert [stems for stems, _ in given] == [[view.stem for view in views[1:]], [views[0].stem]]
    for _, options in given:
        assert (options["downscale"], options["largest"], options["device"]) == (2, 33, "cpu")
        assert options["masks"](SimpleNamespace(stem="0003")) is mask
        assert options["masks"](SimpleNamespace(stem="0004")) is None
    assert given[0][1]["store"] is given[1][1]["store"]


def test_options_of_depth_reach_their_places(monkeypatch):
    """Each of another value than its default and than the others."""
    seen = {}
    monkeypatch.setattr(depth_module._Grid, "around", lambda views, depths: SimpleNamespace(cell=0.5))
    patches = SimpleNamespace(add=lambda pixels: None, patches=lambda: "patches")
    monkeypatch.setattr(depth_module, "_Cells", lambda grid: patches)
    monkeypatch.setattr(depth_module, "_colours", lambda view, images: ("colors", images))
    monkeypatch.setattr(depth_module, "_depth", lambda view, depths: ("depth", depths))

    def observe(camera, depth, rgb, planarity=0.5, contrast=0.12):
        seen["observe"] = (depth, rgb, planarity, contrast)

    monkeypatch.setattr(depth_module, "observe", observe)
    monkeypatch.setattr(depth_module, "_leaves_for_count", lambda *given: seen.setdefault("leaves", given))
    monkeypatch.setattr(
        depth_module, "_gaussians", lambda patches, leaves, opacity: seen.setdefault("opacity", opacity)
    )
    told = []
    options = {"count": 777, "planarity": 0.3, "contrast": 0.2, "opacity": 0.7}
    view = View("a", camera())
    depth_module.gaussians_from_depth([view], len, max, progress=lambda *call: told.append(call), **options)
    assert seen == {
        "observe": (("depth", len), ("colors", max), 0.3, 0.2),
        "leaves": ("patches", 0.5, 777),
        "opacity": 0.7,
    }
    assert told == [(0, 1, ""), (1, 1, "a")]


@pytest.mark.parametrize("complete", [True, False])
def test_what_a_fit_returns_and_leaves(boards, tmp_path, complete, monkeypatch):
    """A complete run removes its checkpoint, and its held-out views are measured; its log has what took how long."""
    path, log = tmp_path / "run.checkpoint", RunLog()
    settings = FitSettings(steps=2, cap=1300, sh_degree=0)
    if not complete:
        monkeypatch.setattr(trainer.Loop, "go", lambda run, *rest: False)
    path.write_bytes(b"left")
    result = fit(
        boards.views[1:],
        (np.random.default_rng(0).random((900, 3)), np.zeros((900, 3))),
        boards.views[:1],
        settings,
        checkpoint=path,
        log=log,
    )
    assert result.complete == complete
    assert path.exists() != complete
    assert list(result.held_out) == [boards.views[0].stem]
    assert [view.stem for view in result.views] == [view.stem for view in boards.views[1:]]
    assert math.isfinite(result.fitted_psnr)
    assert result.curve[-1].step == (2 if complete else 0)
