"""Operations against closed forms and pictures, selections against geometry, sessions and scripts by their bits."""

import dataclasses
import json
import math

import pytest
import torch

from sgwarp.apps.editing import operations as ops
from sgwarp.apps.editing.measurement import measure_edit
from sgwarp.apps.editing.picker import EditContext, _name_instances, grow, largest_pieces, pick, pieces
from sgwarp.apps.editing.script import EditStep, load_script, save_script, step_from
from sgwarp.apps.editing.selection import Selection, parse_term
from sgwarp.apps.editing.session import HISTORY, EditSession, edit
from sgwarp.apps.instances.maps import render_ids
from sgwarp.errors import InputError
from sgwarp.ops.planar.harmonics_rotation import rotate_harmonics, rotation_of_harmonics
from sgwarp.ops.reference.rasterizer import harmonics, rasterize, rotation_matrices
from sgwarp.ops.splatting.settings import RasterSettings
from sgwarp.rendering.renderer import render
from sgwarp.scene import Camera, Gaussians, Instance, InstanceMap, Semantics, View

FIELDS = ("means", "quats", "scales", "opacities", "sh")
QUAT = torch.tensor([0.7, -0.3, 0.5, 0.4], dtype=torch.float64)
QUAT = QUAT / QUAT.norm()
ALL = Selection(("all",), clean=False)


def same(one, other) -> bool:
    return all(torch.equal(getattr(one, name), getattr(other, name)) for name in FIELDS)


def sphere(count: int) -> torch.Tensor:
    directions = torch.randn(count, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    return torch.nn.functional.normalize(directions, dim=1)


# Harmonics


def test_rotated_harmonics_are_the_rotated_function():
    turn = rotation_matrices(QUAT[None])[0]
    matrix = rotation_of_harmonics(turn, 3)
    directions = sphere(200)
    here, there = harmonics(directions, 3), harmonics(directions @ turn, 3)  # rows of d @ R are R^T d
    assert float((here @ matrix - there).abs().max()) < 1e-13
    assert float((matrix @ matrix.T - torch.eye(16, dtype=torch.float64)).abs().max()) < 1e-13


def test_two_turns_are_their_product():
    first, second = rotation_matrices(torch.stack([QUAT, torch.tensor([0.6, 0.8, 0.0, 0.0]).double()]))
    both = rotation_of_harmonics(first @ second, 3)
    assert float((rotation_of_harmonics(first, 3) @ rotation_of_harmonics(second, 3) - both).abs().max()) < 1e-13


def test_harmonics_turn_as_in_splatreg():
    """An independent implementation, by recursion over the degrees."""
    from splatreg import sh

    turn = rotation_matrices(QUAT[None])[0]
    coefficients = torch.randn(5, 16, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(
        rotate_harmonics(coefficients, turn), sh.rotate_sh(coefficients, turn), rtol=0, atol=1e-12
    )


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_the_rotated_scene_from_the_rotated_camera_is_the_original_picture(scenes, degree):
    gaussians = scenes.cloud(300, seed=degree, degree=degree)
    camera = scenes.pinhole()
    settings = RasterSettings(alpha_min=2.0**-16, transmittance_min=0.0)  # crossing a threshold must not be visible
    center = torch.tensor([0.3, -0.2, 4.0], dtype=torch.float64)
    chosen = torch.ones(300, dtype=torch.bool)
    turned = ops.rotate_gaussians(gaussians, chosen, QUAT, center)
    turn = rotation_matrices(QUAT[None])[0]
    back = torch.eye(4, dtype=torch.float64)  # x' = R (x - c) + c
    back[:3, :3], back[:3, 3] = turn.T, center - turn.T @ center
    moved = Camera(camera.K, camera.world_to_camera @ back, camera.width, camera.height)
    before, after = render(gaussians, camera, settings=settings), render(turned, moved, settings=settings)
    assert float((before - after).abs().max()) < 1e-5
    assert float(before.std()) > 0.1
    plain = render(dataclasses.replace(turned, sh=gaussians.sh), moved, settings=settings)
    assert degree == 0 or float((before - plain).abs().max()) > 1e-2, "without turning the harmonics it shows"


def room_cloud(count: int) -> Gaussians:
    """Flat Gaussians on the walls of a room 4 x 3 x 4 m, 2 cm rough, of degree 1."""
    random = torch.Generator().manual_seed(3)
    size, rows = torch.tensor([4.0, 3.0, 4.0]), torch.arange(count)
    means = torch.rand(count, 3, generator=random) * size
    wall = torch.randint(0, 3, (count,), generator=random)
    means[rows, wall] = size[wall] * torch.randint(0, 2, (count,), generator=random)
    means[rows, wall] += 0.02 * torch.randn(count, generator=random)
    scales = 0.02 + 0.15 * torch.rand(count, 3, generator=random)
    scales[rows, wall] = 0.003
    quats = torch.tensor([1.0, 0.0, 0.0, 0.0]) + 0.1 * torch.randn(count, 4, generator=random)
    opacities = 0.05 + 0.94 * torch.rand(count, generator=random)
    return Gaussians(means, quats, scales, opacities, 0.4 * torch.randn(count, 4, 3, generator=random))


def test_in_a_turned_room_only_pixels_at_a_decision_may_differ():
    """At the default cut-offs. Where an alpha or a transmittance lies within 2e-4 of its cut-off, or two depths within
    1e-6, rounding may decide either way; all other pixels agree to 1e-5, and that is 99 of 100."""
    gaussians = room_cloud(2500)
    center = torch.tensor([2.0, 1.5, 2.0], dtype=torch.float64)
    turned = ops.rotate_gaussians(gaussians, torch.ones(2500, dtype=torch.bool), QUAT, center)
    turn, pose, back = rotation_matrices(QUAT[None])[0], torch.eye(4).double(), torch.eye(4).double()
    pose[:3, :3] = rotation_matrices(torch.tensor([[0.9, 0.2, 0.3, -0.1]]).double())[0]
    pose[:3, 3] = torch.tensor([0.0, 0.0, 1.0]) - pose[:3, :3] @ center
    back[:3, :3], back[:3, 3] = turn.T, center - turn.T @ center
    K = torch.tensor([[60.0, 0.0, 32.0], [0.0, 60.0, 24.0], [0.0, 0.0, 1.0]])
    pairs = (gaussians, Camera(K, pose, 64, 48)), (turned, Camera(K, pose @ back, 64, 48))
    exact = [rasterize(scene, camera) for scene, camera in pairs]
    clear = torch.stack([(one.margin > 2e-4) & (one.order_margin > 1e-6) for one in exact]).all(dim=0)
    assert float(clear.float().mean()) > 0.99
    drawn = [render(scene, camera) for scene, camera in pairs]
    assert float((drawn[0] - drawn[1]).abs().amax(dim=2)[clear].max()) < 1e-5
    assert float((exact[0].features - exact[1].features).abs().amax(dim=2)[clear].max()) < 1e-5
    assert float(drawn[0].std()) > 0.1


def test_where_a_threshold_is_crossed_one_gaussian_is_all_that_shows(scenes):
    gaussians, camera = scenes.cloud(300, seed=2, degree=3), scenes.pinhole()
    center = torch.tensor([0.3, -0.2, 4.0], dtype=torch.float64)
    turned = ops.rotate_gaussians(gaussians, torch.ones(300, dtype=torch.bool), QUAT, center)
    turn = rotation_matrices(QUAT[None])[0]
    back = torch.eye(4, dtype=torch.float64)
    back[:3, :3], back[:3, 3] = turn.T, center - turn.T @ center
    moved = Camera(camera.K, camera.world_to_camera @ back, camera.width, camera.height)
    error = (render(gaussians, camera) - render(turned, moved)).abs()
    assert float(error.max()) < 2 / 255
    assert float((error > 1e-5).float().mean()) < 2e-3


# Operations


@pytest.fixture
def half(scenes):
    """A cloud and its first half."""
    return scenes.cloud(60, seed=5, degree=2), torch.arange(60) < 30


def test_remove_extract_and_isolate(half):
    gaussians, chosen = half
    assert same(ops.Remove().apply(gaussians, chosen).gaussians, gaussians.subset(~chosen))
    assert same(ops.Extract().apply(gaussians, chosen).gaussians, gaussians.subset(chosen))
    faded = ops.Isolate(0.25).apply(gaussians, chosen).gaussians
    torch.testing.assert_close(faded.opacities[~chosen], gaussians.opacities[~chosen] * 0.25)
    assert torch.equal(faded.opacities[chosen], gaussians.opacities[chosen])


def test_move_shifts_the_selection_alone(half):
    gaussians, chosen = half
    moved = ops.Move((1.0, -2.0, 0.5)).apply(gaussians, chosen).gaussians
    torch.testing.assert_close(moved.means[chosen] - gaussians.means[chosen], torch.tensor([[1.0, -2.0, 0.5]] * 30))
    assert torch.equal(moved.means[~chosen], gaussians.means[~chosen])
    assert moved.sh is gaussians.sh


def test_rotate_keeps_the_centroid_and_turns_covariances(half):
    gaussians, chosen = half
    turned = ops.Rotate((0.0, 0.0, 2.0), 90.0).apply(gaussians, chosen).gaussians
    turn = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]).double()
    center = ops.centroid(gaussians, chosen)
    torch.testing.assert_close(ops.centroid(turned, chosen), center, rtol=0, atol=1e-6)

    def covariances(g):
        axes = rotation_matrices(g.quats[chosen].double()) * g.scales[chosen].double()[:, None, :]
        return axes @ axes.mT

    torch.testing.assert_close(covariances(turned), turn @ covariances(gaussians) @ turn.T, rtol=1e-5, atol=1e-8)
    torch.testing.assert_close(
        turned.means[chosen].double(), center + (gaussians.means[chosen].double() - center) @ turn.T, rtol=0, atol=1e-6
    )
    assert torch.equal(turned.sh[~chosen], gaussians.sh[~chosen])


def test_scale_is_about_the_centroid(half):
    gaussians, chosen = half
    scaled = ops.Scale(2.0).apply(gaussians, chosen).gaussians
    torch.testing.assert_close(scaled.scales[chosen], 2 * gaussians.scales[chosen])
    center = ops.centroid(gaussians, chosen).float()
    torch.testing.assert_close(scaled.means[chosen] - center, 2 * (gaussians.means[chosen] - center), rtol=0, atol=1e-5)


def test_recolor_keeps_the_shading_from_every_direction(half):
    """Color c seen from d becomes target * luma(c) / mean luma, whatever d."""
    gaussians, chosen = half
    target = torch.tensor([0.1, 0.6, 0.15], dtype=torch.float64)
    painted = ops.Recolor((0.1, 0.6, 0.15)).apply(gaussians, chosen).gaussians
    basis = harmonics(sphere(20), 2)

    def colors(g):
        return 0.5 + torch.einsum("dk,nkc->ndc", basis, g.sh[chosen].double())

    luma = torch.tensor([0.2126, 0.7152, 0.0722], dtype=torch.float64)
    weight = gaussians.opacities[chosen].double()
    base = 0.5 + 0.28209479177387814 * gaussians.sh[chosen, 0].double()
    mean = ((base @ luma) * weight).sum() / weight.sum()
    wanted = (colors(gaussians) @ luma)[..., None] / mean * target
    torch.testing.assert_close(colors(painted), wanted, rtol=1e-5, atol=1e-6)
    assert torch.equal(painted.sh[~chosen], gaussians.sh[~chosen])


def test_duplicate_adds_shifted_copies_at_the_end(half):
    gaussians, chosen = half
    change = ops.Duplicate((0.0, 1.0, 0.0)).apply(gaussians, chosen)
    assert (len(change.gaussians), change.added) == (90, 30)
    assert same(change.gaussians.subset(torch.arange(60)), gaussians)
    torch.testing.assert_close(change.gaussians.means[60:, 1], gaussians.means[chosen, 1] + 1.0)
    assert change.rows[60:].tolist() == list(range(30))


def test_gaussians_that_are_not_finite_do_not_move_the_centroid(half):
    gaussians, chosen = half
    means = gaussians.means.clone()
    means[3] = math.nan
    others = chosen.clone()
    others[3] = False
    found = ops.centroid(dataclasses.replace(gaussians, means=means), chosen)
    torch.testing.assert_close(found, ops.centroid(gaussians, others), rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"do": "explode"}, "do: expected one of"),
        ({"do": "move", "by": [1, 2]}, "by is three numbers"),
        ({"do": "move", "by": [1, 2, math.nan]}, "expected a finite number"),
        ({"do": "move", "by": [1, 2, 10**400]}, "expected a finite number, got 10{39}$"),
        ({"do": "move", "by": [1, 2, True]}, "expected a finite number"),
        ({"do": "scale", "factor": 10**400}, "expected a finite number"),
        ({"do": "remove", "grow": -(10**400)}, "grow: expected a finite number"),
        ({"do": "remove", "threshold": 10**400}, "threshold: expected a finite number"),
        ({"do": "scale", "factor": 0}, "positive factor"),
        ({"do": "rotate", "axis": [0, 0, 0]}, "the axis has no direction"),
        ({"do": "recolor", "color": [2, 0, 0]}, "from 0 to 1"),
        ({"do": "recolor", "color": "mauve-ish"}, "color 'mauve-ish'"),
        ({"do": "isolate", "fade": 1}, "fade is a factor"),
        ({"do": "remove", "hard": True}, "has no entry 'hard'"),
    ],
)
def test_operations_are_checked(content, message):
    with pytest.raises(InputError, match=message):
        step_from({"select": ["all"]} | content)


def test_colors_have_names_and_codes():
    assert ops.parse_color("green") == ops.COLORS["green"]
    assert ops.parse_color("#ff8000") == (1.0, 128 / 255, 0.0)
    assert ops.parse_color("0.1,0.2,0.3") == (0.1, 0.2, 0.3)


# Selections


@pytest.fixture(scope="module")
def context(stage, toy_text):
    """Everything a selection may ask for: semantics of the panels, instances 1 to 4 = wall, door, lamp, book."""
    count = len(stage.classes)
    features = torch.nn.functional.one_hot(stage.classes - 1, 5).float()
    fingerprint = stage.gaussians.fingerprint
    semantics = Semantics(features, torch.ones(count), torch.ones(count), "toy", fingerprint)
    zero = (0.0, 0.0, 0.0)
    table = tuple(
        Instance(k, "default", 0, 1, 1, 1, 1.0, zero, (1.0, 0.0, 0.0, 0.0), zero, label)
        for k, label in enumerate(("wall", "left door", "lamp", "book"), start=1)
    )
    instances = InstanceMap(
        stage.classes[None, :, None],
        torch.ones(1, count, 1),
        torch.full((count,), 9.0),
        table,
        ("default",),
        fingerprint,
    )
    return EditContext(semantics, toy_text, instances, stage.views)


def picked(stage, context, *terms, **options) -> torch.Tensor:
    return EditSession(stage.gaussians, context).preview(Selection(terms, **options))


def test_texts_name_gaussians_and_whole_instances(stage, context):
    for number, text in enumerate(("left door", "lamp", "book"), start=2):
        assert torch.equal(picked(stage, context, text), stage.classes == number)
        alone = dataclasses.replace(context, instances=None)
        assert torch.equal(picked(stage, alone, text), stage.classes == number)
    both = picked(stage, context, "lamp", "text:book")
    assert torch.equal(both, stage.classes >= 3)


def test_a_text_names_all_instances_that_come_close_to_the_best(stage, context):
    """Means of 3, 2.5, 1 and -1: those from 80 % of the best on are named, and none that a rival fits better."""
    scores = torch.tensor([3.0, 2.5, 1.0, -1.0])[stage.classes - 1]
    seen, nothing = torch.ones(len(scores), dtype=torch.bool), torch.full_like(scores, -torch.inf)
    assert torch.equal(_name_instances(scores, nothing, seen, context.instances)[0], stage.classes <= 2)
    rivals = torch.where(stage.classes == 1, 4.0, 0.0)
    assert torch.equal(_name_instances(scores, rivals, seen, context.instances)[0], stage.classes == 2)
    assert not bool(torch.stack(_name_instances(-scores.abs(), nothing, seen, context.instances)).any())


@pytest.mark.parametrize("term", ["id:3", "text:lamp", "click"])
def test_undecided_parts_move_with_their_instance(stage, context, term):
    """A third of the lamp was hardly seen, and leans towards it; so does a far part of the wall, which stays."""
    lamp = (stage.classes == 3).nonzero().flatten()
    far = (stage.classes == 1).nonzero().flatten()
    distance = torch.cdist(stage.gaussians.means[far], stage.gaussians.means[lamp]).amin(dim=1)
    far = far[distance.argmax()]
    candidates, observations = context.instances.candidates.clone(), context.instances.observations.clone()
    hardly = lamp[torch.arange(len(lamp)) % 3 == 1]
    observations[hardly] = 0.05
    observations[far], candidates[0, far, 0] = 0.05, 3
    found = dataclasses.replace(context.instances, candidates=candidates, observations=observations)
    assert not bool(found.members(3)[hardly].any())
    assert bool(found.leaning(3)[far])
    if term == "click":
        view = context.views[0]
        ids, _ = render_ids(stage.gaussians, found, view.camera)
        y, x = (ids == 3).nonzero()[0].tolist()
        term = f"click:{view.stem},{x},{y}"
    wanted = dataclasses.replace(context, instances=found)
    assert torch.equal(picked(stage, wanted, term), stage.classes == 3)


def test_without_semantics_a_text_is_a_label(stage, context):
    labels = dataclasses.replace(context, semantics=None, encoder=None)
    assert torch.equal(picked(stage, labels, "lamp"), stage.classes == 3)
    with pytest.raises(InputError, match="select 'sofa': needs --semantics"):
        picked(stage, labels, "sofa")


def test_negatives_win_where_they_fit_better(stage, context):
    with pytest.raises(InputError, match="selects no Gaussian"):
        picked(stage, context, "lamp", negatives=("lamp",))


def test_ids_boxes_and_keep(stage, context):
    assert torch.equal(picked(stage, context, "id:4"), stage.classes == 4)
    inside = picked(stage, context, "box:-9,-9,2.9,9,9,3.1")
    assert torch.equal(inside, stage.classes == 2)
    rest = picked(stage, context, "all", keep=("wall", "id:2"), clean=False)
    assert torch.equal(rest, stage.classes >= 3)


def test_a_click_selects_what_is_in_front(stage, context):
    view = stage.views[0]
    for number in (2, 3, 4):
        y, x = (stage.labels(view) == number).nonzero().float().mean(0).long().tolist()
        assert int(stage.labels(view)[y, x]) == number
        assert torch.equal(picked(stage, context, f"click:{view.stem},{x},{y}"), stage.classes == number)
        alike = dataclasses.replace(context, instances=None)
        assert torch.equal(picked(stage, alike, f"click:{view.stem},{x},{y}"), stage.classes == number)


def test_a_click_weighs_what_a_pixel_shows():
    """One Gaussian of instance 1 hides three of instance 2 behind it."""
    means = torch.tensor([[0.0, 0.0, 3.0], [0.0, 0.0, 4.0], [0.0, 0.0, 4.1], [0.0, 0.0, 4.2]])
    quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(4, 4)
    gaussians = Gaussians(means, quats, torch.full((4, 3), 0.3), torch.full((4,), 0.9), torch.zeros(4, 1, 3))
    zero = (0.0, 0.0, 0.0)
    table = tuple(Instance(k, "default", 0, 1, 1, 1, 1.0, zero, (1.0, 0.0, 0.0, 0.0), zero) for k in (1, 2))
    ids = torch.tensor([1, 2, 2, 2], dtype=torch.int32)[None, :, None]
    counts = torch.full((4,), 9.0)
    found = InstanceMap(ids, torch.ones(1, 4, 1), counts, table, ("default",), gaussians.fingerprint)
    K = torch.tensor([[50.0, 0.0, 16.0], [0.0, 50.0, 16.0], [0.0, 0.0, 1.0]])
    view = View("a", Camera(K, torch.eye(4, dtype=torch.float64), 32, 32))
    session = EditSession(gaussians, EditContext(instances=found, views=(view,)))
    assert session.preview(Selection(("click:a,16,16",), clean=False)).tolist() == [True, False, False, False]


def test_a_click_on_a_copy_selects_the_copy(stage, context):
    """The lamp's copy stands in front of the wall, where the first view shows nothing else."""
    session = EditSession(stage.gaussians, context)
    session.apply(EditStep(Selection(("lamp",)), ops.Duplicate((0.0, 0.0, -0.8))))
    view = stage.views[0]
    shown = render(session.state.gaussians, view.camera, "features", features=session.state.selected.float()[:, None])
    y, x = (shown[..., 0] > 0.9).nonzero().float().mean(0).long().tolist()
    assert torch.equal(session.preview(Selection((f"click:{view.stem},{x},{y}",))), session.state.copies == 1)


def test_what_is_kept_stays_out_of_what_is_grown(stage, context):
    grown = picked(stage, context, "lamp", keep=("wall",), grow=1.0)
    wide = picked(stage, context, "lamp", grow=1.0)
    assert bool((wide & (stage.classes == 1)).any())
    assert torch.equal(grown, wide & (stage.classes != 1))


def test_growing_and_shrinking_are_distances(stage, context):
    lamp = stage.classes == 3
    distance = torch.cdist(stage.gaussians.means.double(), stage.gaussians.means[lamp].double()).amin(dim=1)
    assert torch.equal(picked(stage, context, "lamp", grow=0.35), distance <= 0.35)
    rest = torch.cdist(stage.gaussians.means.double(), stage.gaussians.means[~lamp].double()).amin(dim=1)
    small = grow(stage.gaussians.means, lamp, -0.6)
    assert torch.equal(small, lamp & (rest > 0.6))
    assert 0 < int(small.sum()) < int(lamp.sum())


def test_scattered_pieces_are_left_out(stage):
    lamp = stage.classes == 3
    dirty = lamp.clone()
    dirty[(stage.classes == 1).nonzero().flatten()[[10, 11, 900]]] = True
    assert torch.equal(largest_pieces(stage.gaussians.means, dirty), lamp)
    both = (stage.classes == 3) | (stage.classes == 4)
    assert torch.equal(largest_pieces(stage.gaussians.means, both), both), "two large pieces both stay"


@pytest.mark.parametrize(("sizes", "kept"), [((40, 5), 2), ((40, 4), 2), ((40, 3), 1), ((20, *[3] * 9), 10)])
def test_a_piece_is_compared_with_the_largest_one(sizes, kept):
    """A tenth of the largest piece is enough, however many there are."""
    rows = [torch.arange(size).float()[:, None] * 0.1 + 100.0 * k for k, size in enumerate(sizes)]
    means = torch.nn.functional.pad(torch.cat(rows), (0, 2))
    chosen = largest_pieces(means, torch.ones(len(means), dtype=torch.bool))
    assert [bool(part.all()) for part in chosen.split(list(sizes))] == [k < kept for k in range(len(sizes))]
    assert int(chosen.sum()) == sum(sizes[:kept])


@pytest.mark.parametrize("count", [2, 3, 40])
def test_pieces_of_few_gaussians(count):
    """Evenly spaced on a line they are one piece; the last, far away and not chosen, is in none."""
    means = torch.zeros(count + 1, 3)
    means[:, 0] = torch.arange(count + 1)
    chosen = torch.arange(count + 1) < count
    assert pieces(means, chosen).tolist() == [0] * count + [-1]


@pytest.mark.parametrize(
    ("term", "message"),
    [
        ("id:9", "instance 9: unknown id; this scene has 1 to 4"),
        ("copy:1", "there are 0 copies so far"),
        ("last", "selects no Gaussian"),
        ("box:5,5,5,6,6,6", "selects no Gaussian"),
        ("click:nowhere,1,1", "there is no such view"),
        ("click:0000,4000,1", "outside the image"),
    ],
)
def test_what_cannot_be_selected(stage, context, term, message):
    with pytest.raises(InputError, match=message):
        picked(stage, context, term)


@pytest.mark.parametrize(
    "term", ["", "  ", "id:x", "id:0", "id:1.5", "box:1,2,3", "box:1,0,0,0,1,1", "click:a", "text:"]
)
def test_malformed_terms(term):
    with pytest.raises(InputError, match="select"):
        parse_term(term)


def test_selections_need_what_they_ask_for(stage):
    for term in ("lamp", "id:1"):
        with pytest.raises(InputError, match="needs --"):
            picked(stage, EditContext(), term)
    with pytest.raises(InputError, match="at least one term"):
        Selection(())


# Sessions and scripts

STEPS = (
    EditStep(Selection(("lamp",)), ops.Move((0.0, 0.0, -0.3))),
    EditStep(Selection(("last",), clean=False), ops.Rotate((0.0, 1.0, 0.0), 40.0)),
    EditStep(Selection(("left door",)), ops.Recolor((0.1, 0.6, 0.15))),
    EditStep(Selection(("book",)), ops.Duplicate((-1.0, 0.0, 0.0))),
    EditStep(Selection(("copy:1",)), ops.Scale(1.5)),
    EditStep(Selection(("id:1",), clean=False), ops.Remove()),
)


def test_undo_and_redo_give_back_the_same_bits(stage, context):
    session = EditSession(stage.gaussians, context)
    states = [session.state, *(session.apply(step) for step in STEPS)]
    for state in states[-2::-1]:
        assert same(session.undo().gaussians, state.gaussians)
    assert same(session.state.gaussians, stage.gaussians)
    assert session.undone == STEPS
    for state in states[1:]:
        assert same(session.redo().gaussians, state.gaussians)
    assert session.steps == STEPS
    with pytest.raises(InputError, match="no step was undone"):
        session.redo()


def test_a_long_history_is_replayed(stage, context):
    session = EditSession(stage.gaussians, context)
    step = EditStep(Selection(("lamp",)), ops.Move((0.01, 0.0, 0.0)))
    states = [session.state.gaussians] + [session.apply(step).gaussians for _ in range(HISTORY + 6)]
    assert len(session._states) <= HISTORY + 1
    for wanted in states[-2::-1]:
        assert same(session.undo().gaussians, wanted)
    for wanted in states[1:]:
        assert same(session.redo().gaussians, wanted)


def test_a_new_step_forgets_what_was_undone(stage, context):
    session = EditSession(stage.gaussians, context)
    for step in STEPS[:3]:
        session.apply(step)
    session.undo()
    session.undo()
    state = session.apply(STEPS[3])
    assert session.steps == (STEPS[0], STEPS[3])
    assert session.undone == ()
    assert same(state.gaussians, edit(stage.gaussians, [STEPS[0], STEPS[3]], context).gaussians)


def test_a_failing_step_changes_nothing(stage, context):
    session = EditSession(stage.gaussians, context)
    before = session.apply(STEPS[0])
    with pytest.raises(InputError, match="would leave no Gaussian"):
        session.apply(EditStep(ALL, ops.Remove()))
    assert session.state is before
    assert session.steps == STEPS[:1]
    with pytest.raises(InputError, match="step 2: remove: would leave no Gaussian"):
        edit(stage.gaussians, [STEPS[0], EditStep(ALL, ops.Remove())], context)
    with pytest.raises(InputError, match="no step to apply"):
        edit(stage.gaussians, [], context)
    with pytest.raises(InputError, match="undo: no step"):
        EditSession(stage.gaussians).undo()


def test_copies_are_numbered_in_the_order_they_were_made(stage, context):
    steps = [EditStep(Selection((text,)), ops.Duplicate((0.0, 0.0, -1.0))) for text in ("lamp", "book")]
    state = edit(stage.gaussians, steps, context)
    for number, panel in ((1, 3), (2, 4)):
        copy = pick(state, Selection((f"copy:{number}",)), context)
        assert set(stage.classes[state.rows[copy]].tolist()) == {panel}


def test_rows_lead_back_to_the_scene(stage, context):
    state = edit(stage.gaussians, STEPS[3:], context)
    assert len(state.gaussians) == int((stage.classes > 1).sum() + (stage.classes == 4).sum())
    classes = stage.classes[state.rows]
    assert torch.equal(classes[state.copies == 1], torch.full((int((stage.classes == 4).sum()),), 4))
    assert int(classes.min()) == 2
    assert torch.equal(pick(state, Selection(("book",), clean=False), context), classes == 4)


def test_a_script_replays_to_the_same_bits(stage, context, tmp_path):
    path = tmp_path / "ops.json"
    save_script(STEPS, stage.gaussians, path)
    assert load_script(path, stage.gaussians) == STEPS
    one, other = edit(stage.gaussians, STEPS, context), edit(stage.gaussians, load_script(path), context)
    assert same(one.gaussians, other.gaussians)
    written = json.loads(path.read_text())["steps"]
    assert written[0] == {"select": ["lamp"], "do": "move", "by": [0.0, 0.0, -0.3]}


def test_damaged_scripts(stage, tmp_path):
    path = tmp_path / "ops.json"
    save_script(STEPS, stage.gaussians, path)
    with pytest.raises(InputError, match="was made for scene"):
        load_script(path, stage.gaussians.subset(torch.arange(5)))
    good = json.loads(path.read_text())
    cases = [
        ("{", "is not valid JSON"),
        (json.dumps([1]), "is no edit script"),
        (json.dumps(good | {"version": 2}), "has version 2"),
        (json.dumps(good | {"version": True}), "has version True"),
        (json.dumps(good | {"author": "me"}), "has no entry 'author'"),
        (json.dumps(good | {"steps": []}), "expected a list"),
        (json.dumps(good | {"steps": [3]}), "step 1: a step is an object"),
        (json.dumps(good | {"steps": [good["steps"][0], {"do": "remove"}]}), "step 2: select: is missing"),
        (json.dumps(good | {"steps": [{"select": ["a"], "do": "remove", "grow": "x"}]}), "step 1: grow"),
    ]
    for text, message in cases:
        path.write_text(text)
        with pytest.raises(InputError, match=message):
            load_script(path, stage.gaussians)


def test_a_context_of_another_scene_is_refused(stage, context):
    other = dataclasses.replace(stage.gaussians, means=stage.gaussians.means + 1)
    with pytest.raises(InputError, match="belong to scene"):
        EditSession(other, context)


def test_leakage_and_completeness_count_pixels():
    before, after = torch.zeros(4, 5, 3), torch.zeros(4, 5, 3)
    mask = torch.zeros(4, 5, dtype=torch.bool)
    mask[0] = True
    after[0, :4] = 0.5
    after[1, 0, 2] = 0.1
    after[2, 0] = 0.03  # too little to see
    found = measure_edit(before, after, mask)
    assert (found.leakage, found.completeness) == (pytest.approx(1 / 5), pytest.approx(4 / 5))
    with pytest.raises(InputError, match="the mask is empty"):
        measure_edit(before, after, torch.zeros_like(mask))


# Numbers that float32 cannot hold


@pytest.mark.parametrize(
    "operation", [ops.Scale(1e300), ops.Scale(1e-60), ops.Move((1e300, 0, 0)), ops.Duplicate((0, 1e39, 0))]
)
def test_what_no_file_can_hold_is_refused(stage, operation):
    session = EditSession(stage.gaussians)
    with pytest.raises(InputError, match=f"^{operation.name}: takes [0-9]+ Gaussians out of the range of 32-bit"):
        session.apply(EditStep(ALL, operation))
    assert session.state.gaussians is stage.gaussians


@pytest.mark.parametrize("size", [1e-300, 1e300])
def test_an_axis_of_any_length(size):
    quat = ops.axis_quaternion((0.0, 0.0, size), math.pi / 2)
    half = math.sqrt(0.5)
    assert quat.tolist() == pytest.approx([half, 0, 0, half])
    ops.Rotate((0, size, 0), 20)
