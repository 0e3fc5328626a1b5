"""What is said of cameras and points before a fit, and the points that it makes by itself."""

import logging
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from sgwarp.errors import InputError
from sgwarp.ops.adam import count_steps
from sgwarp.reconstruction.depth_unit import DepthUnit
from sgwarp.reconstruction.fitting import depth_start, initial
from sgwarp.reconstruction.fitting.coverage import in_view, report_start
from sgwarp.reconstruction.fitting.densify import Densify
from sgwarp.reconstruction.fitting.frame import Frame
from sgwarp.reconstruction.fitting.model import Gradients, Model
from sgwarp.reconstruction.fitting.photographs import Photograph
from sgwarp.reconstruction.fitting.settings import FitSettings
from sgwarp.scene import Camera, Gaussians, View
from sgwarp.scene.extent import camera_extent

K = torch.tensor([[40.0, 0, 20], [0, 40, 15], [0, 0, 1]])
FRAME = Frame(torch.zeros(3).double(), 5.0, None)


def black(x: float, width: int = 40, height: int = 30, shade: int = 0) -> Photograph:
    pose = torch.eye(4, dtype=torch.float64)
    pose[0, 3] = -x
    pixels = torch.full((height, width, 3), shade, dtype=torch.uint8)
    return Photograph(f"at {x:g}", Camera(K, pose, width, height), pixels)


def said(caplog, photographs, means) -> str:
    with caplog.at_level(logging.INFO, "sgwarp"):
        report_start(photographs, torch.tensor(means), FRAME)
    return caplog.text


def test_points_are_counted_by_the_photographs_that_show_them(caplog):
    """At a distance of 10 a camera sees 5 to each side: three points are seen by three, one by one, one by none.

    Seen from 3 on both sides the angle is twice atan 0.3; the distances of those seen are 10 and sqrt(109) each three
    and six times, and sqrt(116) once.
    """
    points = [[0.0, 0, 10], [0.0, 0, 10], [-7.0, 0, 10], [0.0, 0, 10], [0.0, 0, -10]]
    text = said(caplog, [black(x) for x in (-3.0, 0.0, 3.0, 100.0)], points)
    assert "points: 5 to start from, 60 % in view of 3 or more photographs" in text
    assert "medians: distance 52.2, parallax 33 degrees" in text
    assert "so close together" not in text


def test_cameras_in_one_place_have_no_parallax(caplog):
    """Cosines that rounding lifts above 1 are no angle."""
    points = torch.rand(500, 3, generator=torch.Generator().manual_seed(0)) + torch.tensor([0.0, 0.0, 8.0])
    assert "parallax 0 degrees" in said(caplog, [black(0.0)] * 3, points.tolist())


def test_points_that_no_photograph_shows_have_no_distance(caplog):
    text = said(caplog, [black(0.0), black(1.0), black(2.0)], [[0.0, 0, -10]] * 2)
    assert "2 to start from, 0 % in view of 3 or more photographs; medians: distance nan, parallax 0 degrees" in text


def test_sizes_of_photographs_are_said_from_the_smallest_to_the_largest(caplog):
    sizes = [(50, 40), (41, 30), (46, 8), (40, 50), (90, 2), (64, 64), (40, 30), (77, 9)]
    photographs = [black(float(k), *size) for k, size in enumerate(sizes)]
    assert "8 photographs of 40 x 30 to 90 x 2, within 5 world units" in said(caplog, photographs, [[0.0, 0, 10]])


def test_the_next_camera_is_the_nearest_other(caplog):
    text = said(caplog, [black(x) for x in (0.0, 1.0, 3.0, 7.0, 15.0)], [[0.0, 0, 10]])
    assert "the next one 10 away" in text  # 1, 1, 2, 4 and 8 units of the frame: in the middle 2 of them


@pytest.mark.parametrize(
    ("point", "radius", "seen"),
    [
        ((0.0, 0.0, 0.5), None, False),  # on the near plane
        ((0.0, 0.0, 64.0), None, False),  # on the far plane
        ((-4.0, -3.0, 8.0), None, True),  # the very corners of the image
        ((4.0, 3.0, 8.0), None, True),
        ((4.01, 0.0, 8.0), None, False),
        ((0.0, -3.01, 8.0), None, False),
        ((4.5, 3.5, 8.0), 0.5, True),  # and as far beside it as the radius
        ((4.6, 0.0, 8.0), 0.5, False),
        ((0.0, -3.6, 8.0), 0.5, False),
        ((-4.5, -3.5, 8.0), 0.5, True),
    ],
)
def test_edges_of_the_image_are_in_view(point, radius, seen):
    camera = Camera(torch.tensor([[40.0, 0, 20], [0, 40, 15], [0, 0, 1]]), torch.eye(4), 40, 30, near=0.5, far=64.0)
    radii = None if radius is None else torch.tensor([radius])
    assert in_view(camera, torch.tensor([point]), radii).tolist() == [seen]


# Surfaces where photographs agree.


@pytest.fixture
def maps(monkeypatch):
    """Two photographs of a wall, half and a quarter of whose pixels agree with others."""
    found = []
    for photograph, known in zip(PAIR, (np.arange(1200) % 2 == 0, np.arange(1200) % 4 == 0), strict=True):
        colors = np.random.default_rng(0).random((30, 40, 3)).astype(np.float32)
        depth = np.full((30, 40), 2.0, np.float32)
        found.append(SimpleNamespace(camera=photograph.camera, known=known.reshape(30, 40), depth=depth, colors=colors))
    given = []

    def estimate(images, cameras, extent, progress):
        given.append((list(images), cameras, extent, progress))
        return found

    monkeypatch.setattr(initial, "estimate_depth", estimate)
    return given


PAIR = [black(0.0, shade=51), black(1.0, shade=102)]


def test_depth_is_looked_for_in_all_photographs(maps, caplog):
    with caplog.at_level(logging.INFO, "sgwarp"):
        found = initial.gaussians_from_photographs(PAIR, FitSettings(cap=700), 1.0, len)
    assert "start: the photographs agree on the depth of 38 % of their pixels" in caplog.text  # of three eighths
    ((images, cameras, extent, progress),) = maps
    assert [float(image.max()) for image in images] == pytest.approx([0.2, 0.4])
    assert (cameras, extent, progress) == ([photograph.camera for photograph in PAIR], 1.0, len)
    assert 300 < len(found) <= 700


def test_what_a_mask_hides_starts_nothing(maps):
    mask = torch.zeros(30, 40, dtype=torch.uint8)
    mask[:20] = 1
    masked = [Photograph(p.stem, p.camera, p.stored, mask) for p in PAIR]
    whole, part = (initial.gaussians_from_photographs(group, FitSettings(), 1.0) for group in (PAIR, masked))
    edge = 2.0 * (20 - PAIR[0].camera.K[1, 2].item()) / PAIR[0].camera.K[1, 1].item()  # of what the masks leave
    assert whole.means[:, 1].max() > edge
    assert part.means[:, 1].max() < edge


@pytest.mark.parametrize("name", ["cap", "anywhere"])
def test_the_seed_alone_decides_which_points_are_drawn(name):
    def drawn(seed: int, around: int) -> torch.Tensor:
        torch.manual_seed(around)  # of whoever else draws
        settings = FitSettings(cap=800, seed=seed)
        if name == "anywhere":
            return initial._points_anywhere(PAIR, 50, torch.Generator().manual_seed(seed))[0]
        points = torch.arange(3000.0).reshape(1000, 3)
        return initial.gaussians_from_points(points, points / 3000, settings, 1.0).means

    assert torch.equal(drawn(5, 0), drawn(5, 1))
    assert not torch.equal(drawn(5, 0), drawn(6, 0))


def test_how_many_are_added_to_few_points_is_said(maps, caplog):
    own, colors = torch.full((10, 3), -1.0, dtype=torch.float64), np.full((10, 3), 0.5)
    with caplog.at_level(logging.INFO, "sgwarp"):
        found = initial.completed(own, colors, PAIR, FitSettings(cap=300), 1.0, len)
    assert f"start: 10 points are few; {len(found) - 10} are added where photographs agree" in caplog.text
    assert 100 < len(found) <= 300
    assert (found.means[:10] == -1).all()


@pytest.mark.parametrize("shape", [(12,), (4, 3, 1), (4, 2), (3, 4)])
def test_points_of_another_shape_are_refused(shape):
    with pytest.raises(InputError, match=r"points: expected \[N, 3\] twice"):
        initial.checked_points(np.zeros(shape), np.zeros(shape))
    with pytest.raises(InputError, match=r"points: expected \[N, 3\] twice"):
        initial.checked_points(np.zeros((12, 3)), np.zeros(shape))


@pytest.mark.parametrize("value", [-0.01, 1.01])
def test_one_color_outside_its_range_is_refused(value):
    colors = np.full((6, 3), 0.5)
    colors[4, 1] = value
    with pytest.raises(InputError, match=r"not in \[0, 1\]; divide by 255"):
        initial.checked_points(np.zeros((6, 3)), colors)
    colors[4, 1] = round(value)
    assert initial.checked_points(np.zeros((6, 3)), colors)[1][4, 1] == round(value)


def test_gaussians_that_reach_a_pixel_nowhere_are_no_start():
    """Of an opacity of 1/255 itself nothing would be drawn but at the very center."""
    shapes = {"means": (3,), "quats": (4,), "scales": (3,), "sh": (1, 3)}
    fields = {name: torch.full((5, *shape), 0.5) for name, shape in shapes.items()}
    with pytest.raises(InputError, match="no photograph would move them"):
        initial.adapted(Gaussians(**fields, opacities=torch.full((5,), 1 / 255)), FitSettings())
    one = torch.tensor([0.0, 0.0, 0.9, 0.0, 0.0])
    assert len(initial.adapted(Gaussians(**fields, opacities=one), FitSettings())) == 5


@pytest.mark.parametrize(("longest", "split"), [(0.0099, False), (0.0101, True)])
def test_a_needle_is_split_by_its_length(longest, split):
    scales = torch.tensor([[0.001, longest, 0.002]]).expand(3, 3)
    quats = torch.tensor([1.0, 0, 0, 0]).expand(3, 4)
    model = Model.starting(Gaussians(torch.zeros(3, 3), quats, scales, torch.full((3,), 0.5), torch.zeros(3, 1, 3)))
    strategy = Densify(FitSettings(strategy="default"), 1.0, 1000, 3, torch.device("cpu"))
    strategy.sums[1], strategy.views[1] = 1.0, 1
    strategy._grow(model, 600)
    assert len(model) == 4
    assert int((model["scales"][:, 1] < 0.9 * longest).sum()) == (2 if split else 0)


@pytest.mark.parametrize(
    ("total", "views", "grows"),
    [
        (0.00021, 1, True),
        (0.00019, 1, False),
        (0.00041, 2, True),
        (0.00039, 2, False),
        (0.00041, 3, False),
        (0, 0, False),
    ],
)
def test_what_the_loss_moves_in_the_mean_of_its_views_grows(total, views, grows):
    quats = torch.tensor([1.0, 0, 0, 0]).expand(3, 4)
    scales, opacities = torch.full((3, 3), 0.005), torch.full((3,), 0.5)
    model = Model.starting(Gaussians(torch.zeros(3, 3), quats, scales, opacities, torch.zeros(3, 1, 3)))
    strategy = Densify(FitSettings(strategy="default"), 1.0, 1000, 3, torch.device("cpu"))
    strategy.sums[1], strategy.views[1] = total, views
    strategy._grow(model, 600)
    assert len(model) == 3 + grows


@pytest.mark.parametrize(("step", "resets"), [(12_000, True), (15_000, False)])
def test_the_last_reset_leaves_time_to_recover(step, resets):
    """At 15,000 steps of 30,000 the set of Gaussians is what it will be."""
    quats = torch.tensor([1.0, 0, 0, 0]).expand(3, 4)
    scales, opacities = torch.full((3, 3), 0.005), torch.full((3,), 0.5)
    model = Model.starting(Gaussians(torch.zeros(3, 3), quats, scales, opacities, torch.zeros(3, 1, 3)))
    strategy = Densify(FitSettings(strategy="default", steps=30_000), 1.0, 1000, 3, torch.device("cpu"))
    counts = torch.zeros(3, dtype=torch.int32)
    taken = count_steps(torch.ones(3), torch.zeros(3, 1, 3), counts, counts.clone(), sparse=True)
    blank = {name: torch.zeros_like(model[name]) for name in model.groups}
    strategy.after_step(model, step, Gradients(**blank, means2d=torch.zeros(3, 2)), taken, black(0.0).camera)
    assert bool((model["opacities"] < 0.1).all()) == resets


# Depth to start from.


def posed(count: int) -> list[View]:
    return [View(str(k), black(float(k)).camera) for k in range(count)]


def test_depth_is_measured_where_it_is_known(monkeypatch, caplog):
    given = []

    def depth(view):
        if view.stem == "1":
            raise InputError("1.png: no such file")
        return np.tile(np.array([np.nan, -1.0, np.inf, 2.0], np.float32), (30, 10))

    def measure(depths, cameras, extent):
        given.append((depths, cameras, extent))
        return DepthUnit(0.001, 0.9, 0.12)

    monkeypatch.setattr(depth_start, "measure_depth_unit", measure)
    views = posed(3)
    usable = depth_start.usable_depth("here", depth, views)
    (((first, second, third), cameras, extent),) = given
    assert first[0, :5].tolist() == third[29, :5].tolist() == [0, 0, 0, 2, 0]
    assert second.shape == (30, 40)
    assert not second.any()
    assert [camera.size for camera in cameras] == [(30, 40)] * 3
    assert [camera.position[0].item() for camera in cameras] == [0, 1, 2]
    assert extent == camera_extent(views)
    assert "here: 1 of 3 views have no depth, first: 1.png: no such file" in caplog.text
    assert "at 0.001 times the depth 90 % of the points" in caplog.text
    assert "as given 12 %; the depth is multiplied by it" in caplog.text
    assert usable(views[0])[0, 3] == np.float32(0.002)
    assert not usable(views[1]).any()


def test_depth_of_no_view_is_an_error():
    def depth(view):
        raise InputError(f"{view.stem}.png: no such file")

    with pytest.raises(InputError, match=r"^0\.png: no such file"):
        depth_start.usable_depth("here", depth, posed(2))
