"""Instances from masks with shuffled ids, faulty masks and levels, against the ray-traced truth of the stage."""

import dataclasses

import numpy as np
import pytest
import torch

from sgwarp.apps.instances.evidence import view_evidence
from sgwarp.apps.instances.finder import find, instances, join_evidence
from sgwarp.apps.instances.maps import draw_ids, render_ids
from sgwarp.apps.instances.settings import InstanceSettings
from sgwarp.apps.instances.view_agreement import consistency
from sgwarp.encoders.base import MissingMap
from sgwarp.encoders.masks.sources import ViewMasks
from sgwarp.errors import InputError
from sgwarp.ops.splatting.settings import RasterSettings
from sgwarp.rendering.renderer import render
from sgwarp.runs.log import RunLog
from sgwarp.scene import Camera, Gaussians, Semantics, View


class Masks:
    """Masks by view stem, in random order so that no number means anything in two views."""

    needs_image = False

    def __init__(self, by_stem, names=None, ranks=None):
        self.by_stem, self.names, self.ranks = by_stem, names, ranks

    def read(self, view, image):
        if view.stem not in self.by_stem:
            raise MissingMap(f"no masks of {view.stem}")
        masks = self.by_stem[view.stem]
        order = np.random.default_rng(int(view.stem)).permutation(len(masks))
        ranks = torch.full((len(masks),), -1) if self.ranks is None else torch.tensor(self.ranks)
        names = () if self.names is None else tuple(self.names[k] for k in order)
        return ViewMasks(torch.stack([masks[k] for k in order]), ranks[torch.from_numpy(order)], names)


def panel_masks(stage, view):
    labels = stage.labels(view)
    return [labels == k for k in labels.unique().tolist() if k]


@pytest.fixture(scope="module")
def shuffled(stage):
    return Masks({view.stem: panel_masks(stage, view) for view in stage.views})


@pytest.fixture(scope="module")
def found(stage, shuffled):
    return instances(stage.gaussians, stage.views, shuffled)


def shown(stage) -> torch.Tensor:
    """Gaussians whose center is traced to their own panel in two views or more, bool [N]."""
    times = torch.zeros(len(stage.classes), dtype=torch.int64)
    for view in stage.views:
        camera = view.camera
        local = stage.gaussians.means.double() @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
        x, y = ((local[:, k] / local[:, 2] * camera.K[k, k] + camera.K[k, 2]).floor().long() for k in (0, 1))
        inside = (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
        labels = stage.labels(view)[y.clamp(0, camera.height - 1), x.clamp(0, camera.width - 1)]
        times += inside & (labels == stage.classes)
    return times >= 2


def assert_partition(ids: torch.Tensor, classes: torch.Tensor, least: float) -> None:
    """Each class has an id of its own, which that share of its Gaussians bear."""
    majority = {}
    for number in classes.unique().tolist():
        names, counts = ids[classes == number].unique(return_counts=True)
        assert counts.max() >= least * int((classes == number).sum()), f"class {number}: {names}, {counts}"
        majority[number] = int(names[counts.argmax()])
    assert min(majority.values()) >= 1
    assert len(set(majority.values())) == len(majority)


def test_shuffled_ids_become_one_instance_each(stage, found):
    assert len(found.table) == 4
    assert_partition(found.instance()[shown(stage)], stage.classes[shown(stage)], 0.95)
    for row in found.table:
        assert (row.masks, row.views) == (6, 6)
        assert row.gaussians == int(found.members(row.id).sum())
        assert row.may_be == ()
    sizes = [row.gaussians for row in found.table]
    assert sizes == sorted(sizes, reverse=True)


def test_the_result_is_always_the_same(stage, shuffled, found):
    again = instances(stage.gaussians, stage.views, shuffled)
    assert torch.equal(again.candidates, found.candidates)
    assert torch.equal(again.shares, found.shares)
    assert again.table == found.table
    turned = instances(stage.gaussians, stage.views[::-1], shuffled)
    assert torch.equal(turned.instance(), found.instance())


def test_the_table_says_where_the_panels_are(stage, found):
    """Centers and sides of the rectangles as they were laid out."""
    door = found.table[int(found.instance()[stage.classes == 2].mode().values) - 1]
    np.testing.assert_allclose(door.centroid, (-0.75, 0.2, 3.0), atol=0.03)
    assert door.extent[0] == pytest.approx(0.96 * 1.94, rel=0.06)  # the outermost 2 % at either end left out
    assert door.extent[1] == pytest.approx(0.96 * 0.84, rel=0.09)
    assert door.extent[2] < 0.01
    assert 0.55 < door.confidence < 7 / 8 + 1e-6  # six views that agree: (6 + 1) / (6 + 2) at most


def test_id_maps_of_a_view_that_gave_no_masks(stage, shuffled):
    left_out = stage.views[2]
    found = instances(stage.gaussians, [view for view in stage.views if view is not left_out], shuffled)
    ids, confidence = render_ids(stage.gaussians, found, left_out.camera)
    truth = stage.labels(left_out)
    for number in range(1, 5):
        mine = ids[truth == number].mode().values
        inside = (ids == mine) & (truth == number)
        union = (ids == mine) | (truth == number)
        assert inside.sum() > 0.85 * union.sum()
    assert int(ids[truth == 0].bincount().argmax()) == 0
    assert bool(((confidence > 0) == (ids > 0)).all())
    picture = draw_ids(torch.zeros(*left_out.camera.size, 3), ids, found)
    assert picture.shape[0] >= left_out.camera.height
    assert picture.shape[1] > left_out.camera.width


@pytest.mark.parametrize("fault", ["dropped", "merged", "split"])
def test_faults_of_some_views_are_outvoted(stage, fault):
    by_stem = {}
    for number, view in enumerate(stage.views):
        masks = panel_masks(stage, view)
        if number < 4:  # no panel more than twice in its six views
            which = number
            if fault == "dropped":
                del masks[which]
            elif fault == "merged":
                one, other = ((0, 1), (2, 3), (0, 2), (1, 3))[number]
                masks[one] = masks[one] | masks.pop(other)
            else:
                half = torch.arange(masks[which].shape[1]) < masks[which].nonzero()[:, 1].median()
                masks += [masks[which] & ~half]
                masks[which] = masks[which] & half
        by_stem[view.stem] = masks
    found = instances(stage.gaussians, stage.views, Masks(by_stem))
    assert_partition(found.instance()[shown(stage)], stage.classes[shown(stage)], 0.7)


def panel(x: float, z: float, count: int = 14, side: float = 0.7) -> torch.Tensor:
    at = torch.linspace(-side / 2, side / 2, count)
    grid = torch.cartesian_prod(at, at)
    return torch.cat([grid + torch.tensor([x, 0.0]), torch.full((len(grid), 1), z)], dim=1)


def flat_scene(*parts: torch.Tensor) -> tuple[Gaussians, torch.Tensor]:
    means = torch.cat(parts)
    n = len(means)
    gaussians = Gaussians(
        means=means,
        quats=torch.tensor([1.0, 0, 0, 0]).expand(n, 4),
        scales=torch.tensor([0.03, 0.03, 0.002]).expand(n, 3),
        opacities=torch.full((n,), 0.95),
        sh=torch.full((n, 1, 3), 0.3),
    )
    return gaussians, torch.cat([torch.full((len(part),), k) for k, part in enumerate(parts)])


def camera_at(scenes, x: float, z: float, toward: float) -> Camera:
    return scenes.pinhole(position=(x, 0.0, z), target=(0.0, 0.0, toward))


def masks_of(gaussians, classes, view, count) -> list[torch.Tensor]:
    one_hot = torch.nn.functional.one_hot(classes, count).float()
    shown = render(gaussians, view.camera, "features", features=one_hot)
    return [shown[..., k] > 0.5 for k in range(count) if bool((shown[..., k] > 0.5).any())]


def word(gaussians: Gaussians) -> Semantics:
    """Features that say the same of every Gaussian."""
    n = len(gaussians)
    return Semantics(torch.ones(n, 4), torch.ones(n), torch.ones(n), "toy", gaussians.fingerprint)


def test_two_chairs_alike_stay_two(scenes):
    """Same shape, same color, same features, same name: what tells them apart is where they are."""
    gaussians, classes = flat_scene(panel(-0.6, 3.0), panel(0.6, 3.0))
    views = [View(f"{k}", camera_at(scenes, x, 0.0, 3.0)) for k, x in enumerate((-0.5, -0.2, 0.1, 0.4))]
    masks = {view.stem: masks_of(gaussians, classes, view, 2) for view in views}
    settings = InstanceSettings(least_cosine=0.5)
    found = instances(gaussians, views, Masks(masks, names=["chair", "chair"]), settings, semantics=word(gaussians))
    assert [row.label for row in found.table] == ["chair", "chair"]
    assert_partition(found.instance(), classes, 0.95)
    assert all(row.may_be == () for row in found.table)


def two_sided(scenes):
    """A thick board: front and back, 0.2 m apart, each hidden from the cameras of the other."""
    gaussians, classes = flat_scene(panel(0.0, 3.0), panel(0.0, 3.2))
    front = [View(f"{k}", camera_at(scenes, 0.3 * k - 0.3, 0.0, 3.0)) for k in range(3)]
    back = [View(f"{k + 3}", camera_at(scenes, 0.3 * k - 0.3, 6.2, 3.2)) for k in range(3)]
    views = front + back
    masks = {view.stem: [render(gaussians, view.camera, "alpha") > 0.5] for view in views}
    return gaussians, classes, views, masks


def test_two_sides_without_a_common_view_are_not_joined_by_their_word(scenes):
    gaussians, classes, views, masks = two_sided(scenes)
    found = instances(
        gaussians,
        views,
        Masks(masks, names=["board"]),
        InstanceSettings(least_cosine=0.5, least_gaussians=20),
        semantics=word(gaussians),
    )
    assert_partition(found.instance(), classes, 0.8)
    assert len(found.table) == 2
    assert [row.may_be for row in found.table] == [(2,), (1,)], "the table says that it cannot tell"


def test_a_view_of_both_sides_settles_it(scenes):
    """Seen edge-on as one mask, the two sides are one."""
    gaussians, _, views, masks = two_sided(scenes)
    for k, x in enumerate((2.5, -2.5)):
        side = View(f"{k + 6}", scenes.pinhole(position=(x, 0.0, 0.9), target=(0.0, 0.0, 3.1)))
        other = View(f"{k + 8}", scenes.pinhole(position=(x, 0.0, 5.3), target=(0.0, 0.0, 3.1)))
        edge = View(f"{k + 10}", scenes.pinhole(position=(x, 0.0, 3.1), target=(0.0, 0.0, 3.1)))
        for view in (side, other, edge):
            views.append(view)
            masks[view.stem] = [render(gaussians, view.camera, "alpha") > 0.5]
    found = instances(gaussians, views, Masks(masks), InstanceSettings(least_gaussians=20))
    assert len(found.table) == 1
    assert float((found.instance() == 1).float().mean()) > 0.9


def test_names_of_a_tracker_are_trusted_if_asked(scenes):
    """The same two sides, joined by a video tracker that followed the object around."""
    gaussians, _, views, masks = two_sided(scenes)
    found = instances(gaussians, views, Masks(masks, names=["7"]), InstanceSettings(grouping="name"))
    assert [row.label for row in found.table] == ["7"]
    assert float((found.instance() == 1).float().mean()) > 0.9


def test_levels_form_a_tree(stage):
    """Halves of the panels as small masks, the panels as large ones."""
    by_stem = {}
    for view in stage.views:
        wholes = [stage.labels(view) == k for k in range(1, 5)]
        at = {2: -0.75, 3: 0.55, 4: 0.7, 1: 0.0}
        parts = []
        for k, mask in enumerate(wholes, start=1):
            depth = stage.depth(view)
            pixels = (torch.arange(view.camera.width) + 0.5 - view.camera.K[0, 2]) / view.camera.K[0, 0]
            rows = (torch.arange(view.camera.height) + 0.5 - view.camera.K[1, 2]) / view.camera.K[1, 1]
            rays = torch.stack([*torch.meshgrid(pixels, rows, indexing="xy"), torch.ones(view.camera.size)], -1)
            world = (
                view.camera.position
                + (rays.double() * depth[..., None].nan_to_num(0, 0)) @ (view.camera.world_to_camera[:3, :3])
            )
            left = world[..., 0] < at[k]
            parts += [mask & left, mask & ~left]
        by_stem[view.stem] = wholes + parts
    source = Masks(by_stem, ranks=[2] * 4 + [0] * 8)
    found = instances(stage.gaussians, stage.views, source, InstanceSettings(levels=("s", "l")))
    small, large = ([row for row in found.table if row.level == level] for level in ("s", "l"))
    assert (len(small), len(large)) == (8, 4)
    assert sorted(row.parent for row in small) == sorted([row.id for row in large] * 2)
    assert all(row.parent == 0 for row in large)
    for row in small:
        inside = found.instance("l")[found.members(row.id)]
        assert float((inside == row.parent).float().mean()) > 0.85
    assert torch.equal(found.instance(), found.instance("l"))
    with pytest.raises(InputError, match="level 'm': the source has no mask of it"):
        instances(stage.gaussians, stage.views, source, InstanceSettings(levels=("m",)))


def test_what_no_mask_and_no_view_shows(stage):
    """Only the door has masks: the rest is nothing; what no view shows is undecided, with no observation."""
    hidden = dataclasses.replace(
        stage.gaussians, means=torch.cat([stage.gaussians.means[:-5], torch.tensor([[0.0, 0.0, -9.0]]).expand(5, 3)])
    )
    source = Masks({view.stem: [stage.labels(view) == 2] for view in stage.views})
    log = RunLog()
    found = instances(hidden, stage.views, source, InstanceSettings(neighbors=0), log=log)
    ids = found.instance()
    assert bool((ids[-5:] == -1).all())
    assert bool((found.observations[-5:] == 0).all())
    assert bool((found.confidence()[-5:] == 0.5).all())
    assert float((ids[shown(stage) & (stage.classes == 1)] == 0).float().mean()) > 0.95
    assert float((ids[shown(stage) & (stage.classes == 2)] == 1).float().mean()) > 0.9
    assert log.error["undecided"] == pytest.approx(float((ids < 0).float().mean()))
    assert log.error["nothing"] == pytest.approx(float((ids == 0).float().mean()))


def test_mean_features_are_those_of_the_members(stage, shuffled):
    semantics = Semantics(
        torch.nn.functional.one_hot(stage.classes, 5).float(),
        torch.ones(len(stage.classes)),
        torch.ones(len(stage.classes)),
        "toy",
        stage.gaussians.fingerprint,
    )
    found = instances(stage.gaussians, stage.views, shuffled, semantics=semantics)
    assert found.space == "toy"
    assert float(found.features.max(dim=1).values.min()) > 0.9


def test_views_that_show_different_instances_agree_after_lifting(stage, found):
    """The right half of a view lacks the left door: its instances have other places in the list of what is shown."""
    whole = stage.views[0]
    K = whole.camera.K.clone()
    K[0, 2] -= whole.camera.width / 2
    right = View("right", Camera(K, whole.camera.world_to_camera, whole.camera.width // 2, whole.camera.height))
    evidence = []
    for view in (whole, right):
        labels = stage.labels(view)
        numbers = [k for k in labels.unique().tolist() if k]
        masks = ViewMasks(
            torch.stack([labels == k for k in numbers]), torch.full((len(numbers),), -1), tuple(map(str, numbers))
        )
        evidence.append(view_evidence(stage.gaussians, view, masks, RasterSettings()))
    assert evidence[0].names == ("1", "2", "3", "4")
    assert evidence[1].names == ("1", "3", "4")
    before, after = consistency(stage.gaussians, [whole, right], evidence, found, RasterSettings())
    assert before > 0.9  # Gaussians at the borders of panels show in two masks
    assert after > 0.9


def test_other_settings_need_no_second_look(stage, shuffled, found):
    first, evidence = find(stage.gaussians, stage.views, shuffled)
    assert torch.equal(first.candidates, found.candidates)
    strict = join_evidence(stage.gaussians, evidence, InstanceSettings(least_confidence=0.8, neighbors=0))
    assert int((strict.instance() < 0).sum()) > int((found.instance() < 0).sum())


def test_views_without_masks_are_counted(stage, shuffled):
    log = RunLog()
    some = Masks({stem: masks for stem, masks in shuffled.by_stem.items() if stem != "0001"})
    instances(stage.gaussians, stage.views, some, log=log)
    assert log.left_out["views_without_masks"] == 1


def test_bad_input(stage, shuffled):
    with pytest.raises(InputError, match="no mask in any of the 6 views"):
        instances(stage.gaussians, stage.views, Masks({}))
    with pytest.raises(InputError, match="at least one view"):
        instances(stage.gaussians, [], shuffled)
    with pytest.raises(InputError, match="gives no names"):
        instances(stage.gaussians, stage.views, shuffled, InstanceSettings(grouping="name"))
    with pytest.raises(InputError, match="least_cosine: compares lifted features"):
        instances(stage.gaussians, stage.views, shuffled, InstanceSettings(least_cosine=0.5))
    with pytest.raises(InputError, match="belong to scene"):
        instances(stage.gaussians, stage.views, shuffled, semantics=word(stage.gaussians.subset(torch.arange(9))))
    with pytest.raises(InputError, match="no instance of 99999 Gaussians"):
        instances(stage.gaussians, stage.views, shuffled, InstanceSettings(least_gaussians=99999))
    away = dataclasses.replace(stage.gaussians, means=stage.gaussians.means + 1e6)
    with pytest.raises(InputError, match="same world frame"):
        instances(away, stage.views, shuffled)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"grouping": "magic"}, "grouping: 'magic'"),
        ({"levels": ("s", "s")}, "levels: expected different"),
        ({"levels": ("huge",)}, "levels: expected different"),
        ({"least_iou": 1.0}, "least_iou"),
        ({"least_cosine": 2.0}, "least_cosine"),
        ({"pixel_weight": 0.0}, "pixel_weight"),
        ({"candidates": 0}, "candidates: expected 1 or more"),
    ],
)
def test_settings_are_checked(options, message):
    with pytest.raises(InputError, match=message):
        InstanceSettings(**options)
