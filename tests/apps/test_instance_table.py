"""The table of instances field by field, on Gaussians and masks small enough to count by hand."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sgwarp.apps.instances import evidence as evidence_module
from sgwarp.apps.instances import maps
from sgwarp.apps.instances.description import GroupFacts, describe, find_doubts
from sgwarp.apps.instances.evidence import ViewEvidence, gather_evidence
from sgwarp.apps.instances.finder import _called, find, join_evidence
from sgwarp.apps.instances.maps import draw_ids
from sgwarp.apps.instances.settings import InstanceSettings
from sgwarp.commands.instances import LISTED, listing
from sgwarp.encoders.base import MissingMap
from sgwarp.encoders.masks.sources import ViewMasks
from sgwarp.errors import InputError
from sgwarp.io.views import load_views
from sgwarp.ops.splatting.settings import RasterSettings
from sgwarp.rendering.renderer import render
from sgwarp.runs.log import RunLog
from sgwarp.scene import Gaussians, Instance, InstanceMap

ZERO, FORWARD = (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)

RANGES = {  # the last values that are taken, and the first that are refused
    "least_iou": ((0.0, 0.99), (-0.01, 1.0)),
    "least_shared": ((0.0, 0.99), (-0.01, 1.0)),
    "least_confidence": ((0.0, 0.99), (-0.01, 1.0)),
    "least_cosine": ((-1.0, 1.0, None), (-1.01, 1.01)),
    "pixel_weight": ((1e-6, 1e6), (0.0, -1.0, float("inf"))),
    "samples_per_mask": ((0, 1), (-1,)),
    "neighbors": ((0, 1), (-1,)),
    "least_gaussians": ((1,), (0,)),
    "candidates": ((1,), (0,)),
    "levels": ((("s", "m", "l"), ("default",)), ((), ("s", "s"), ("x",))),
    "grouping": (("name", "association"), ("names",)),
}


@pytest.mark.parametrize("name", RANGES)
def test_ranges_of_the_settings(name):
    taken, refused = RANGES[name]
    for value in taken:
        assert getattr(InstanceSettings(**{name: value}), name) == value
    for value in refused:
        with pytest.raises(InputError, match=f"^{name}: "):
            InstanceSettings(**{name: value})


# The evidence of the views


class Source:
    """Masks of all views but one; notes the images that it is given."""

    def __init__(self, needs_image: bool, missing: str = ""):
        self.needs_image, self.missing, self.images = needs_image, missing, {}

    def read(self, view, image):
        self.images[view.stem] = image
        if view.stem == self.missing:
            raise MissingMap("none")
        return ViewMasks(torch.ones(1, *view.camera.size, dtype=torch.bool), torch.tensor([-1]))


def test_what_a_source_of_masks_looks_at(stage, stage_files, monkeypatch):
    """The photograph where there is one, else the scene, with the thresholds of the run and in [0, 1]."""
    coarse, log, seen, told = RasterSettings(alpha_min=0.3), RunLog(), [], []
    bright = replace(stage.gaussians, sh=stage.gaussians.sh + 2.0)
    original = evidence_module.weigh_pairs

    def weigh_pairs(gaussians, camera, ids, settings):
        seen.append(settings)
        return original(gaussians, camera, ids, settings)

    monkeypatch.setattr(evidence_module, "weigh_pairs", weigh_pairs)
    views = [load_views(stage_files.views)[0], stage.views[1], stage.views[2]]
    source = Source(True, views[2].stem)
    found = gather_evidence(bright, views, source, coarse, log, lambda *given: told.append(given))
    assert [one.stem for one in found] == [view.stem for view in views[:2]]
    assert torch.equal(source.images[views[0].stem], views[0].image())
    wanted = render(bright, views[1].camera, settings=coarse).clamp(0.0, 1.0)
    torch.testing.assert_close(source.images[views[1].stem], wanted, rtol=0, atol=1e-6)
    assert seen == [coarse, coarse]
    assert told == [(0, 3, ""), *((k + 1, 3, view.stem) for k, view in enumerate(views))]
    assert log.left_out["views_without_masks"] == 1
    assert {"read", "render", "masks", "lift"} <= set(log.stages)
    blind = Source(False)
    gather_evidence(stage.gaussians, views[:1], blind, coarse, RunLog(), lambda *given: None)
    assert blind.images[views[0].stem] is None


def test_what_speaks_for_nothing_is_noted(stage):
    log = RunLog()
    found, _ = find(stage.gaussians, stage.views, Source(False), InstanceSettings(), log=log)
    ids = found.instance()
    assert log.error["undecided"] == pytest.approx((ids < 0).float().mean().item())
    assert log.error["nothing"] == pytest.approx((ids == 0).float().mean().item())


def view_of(stem, masks, *, ranks=None, names=(), shows=12) -> ViewEvidence:
    """Masks that do not overlap, each a list of Gaussians; the view shows the first so many with weight 9."""
    owner = np.arange(shows, dtype=np.int32)
    sets = np.full(shows, len(masks), np.int16)
    for number, mask in enumerate(masks):
        sets[list(mask)] = number
    members = np.concatenate([np.eye(len(masks), dtype=bool), np.zeros((1, len(masks)), bool)])
    ranks = np.full(len(masks), -1) if ranks is None else np.array(ranks)
    return ViewEvidence(stem, owner, sets, np.full(shows, 9.0, np.float32), members, ranks, tuple(names))


@pytest.fixture
def line() -> Gaussians:
    """Twelve Gaussians a meter apart, of opacities 0.1 to 0.65."""
    means = torch.arange(12.0)[:, None] * torch.tensor([[1.0, 0.0, 0.0]])
    opacities = 0.1 + 0.05 * torch.arange(12.0)
    return Gaussians(means, torch.tensor([FORWARD]).expand(12, 4), torch.full((12, 3), 0.1), opacities, means[:, None])


LOOSE = InstanceSettings(least_gaussians=2, neighbors=0)


def test_the_table_by_hand(line):
    """Two objects of five and four Gaussians; two views agree about the first, one shows the second."""
    first, second = range(1, 6), range(7, 11)
    views = [
        view_of("a", [first, second], names=("chair", "7")),
        view_of("b", [first], names=("chair",), shows=6),
        view_of("c", [first], names=("bench",), shows=6),
    ]
    one, two = join_evidence(line, views, LOOSE).table
    assert (one.id, one.level, one.parent, one.gaussians, one.masks, one.views) == (1, "default", 0, 5, 3, 3)
    assert (one.label, one.label_score) == ("chair", pytest.approx(2 / 3))
    opacities = line.opacities.numpy()[1:6]
    assert one.centroid == pytest.approx((float(np.average(np.arange(1, 6), weights=opacities)), 0.0, 0.0), abs=1e-4)
    # Three views of weight 9, each 81 / 82 of an observation, all for it: (n + 1) / (n + 2).
    observations = 3 * 81 / 82
    assert one.confidence == pytest.approx((observations + 1) / (observations + 2), abs=1e-3)
    assert one.extent == pytest.approx((0.96 * 4, 0.0, 0.0), abs=1e-6)  # without 2 % at either end
    assert (two.id, two.gaussians, two.masks, two.views, two.label) == (2, 4, 1, 1, "")  # a number is no name
    assert two.confidence == pytest.approx((81 / 82 + 1) / (81 / 82 + 2), abs=1e-3)


def test_views_that_show_no_mask_speak_for_nothing(line):
    """One view of three has a mask of the second object; the others see its Gaussians in no mask."""
    views = [view_of("a", [range(1, 6), range(7, 11)]), view_of("b", [range(1, 6)]), view_of("c", [range(1, 6)])]
    found = join_evidence(line, views, replace(LOOSE, least_confidence=0.0))
    assert found.candidates[0, 8, :2].tolist() == [0, -1]  # what owns no Gaussian is no instance
    assert found.shares[0, 8, :2].tolist() == pytest.approx([2 / 3, 1 / 3], abs=1e-3)
    assert found.observations[8].item() == pytest.approx(3 * 81 / 82, abs=1e-3)
    assert [row.gaussians for row in found.table] == [5]


def test_levels_are_numbered_one_after_the_other(line):
    views = [view_of("a", [range(3), range(3, 6), range(6, 12)], ranks=(0, 0, 2))]
    found = join_evidence(line, views, replace(LOOSE, levels=("s", "l")))
    assert [(row.id, row.level) for row in found.table] == [(1, "s"), (2, "s"), (3, "l")]
    assert found.levels == ("s", "l")
    assert found.instance("s")[:6].tolist() == [1, 1, 1, 2, 2, 2]
    assert found.instance("l")[7].item() == 3
    with pytest.raises(InputError, match="level 'm': the source has no mask of it"):
        join_evidence(line, views, replace(LOOSE, levels=("m",)))


def test_masks_of_a_level():
    """SAM's small, middle and large ones have ranks 0, 1 and 2; all of them are "default"."""
    view = view_of("a", [[0], [1], [2], [3]], ranks=(0, 1, 2, -1))
    found = {level: view.masks_of(level).tolist() for level in ("default", "s", "m", "l")}
    assert found == {"default": [0, 1, 2, 3], "s": [0], "m": [1], "l": [2]}


def test_names_are_those_of_most_masks():
    """Of equally many the first by the alphabet; masks that belong to no instance do not vote."""
    views = [
        view_of("a", [[0], [1], [2]], names=("lamp", "b", "x")),
        view_of("b", [[0], [1], [2]], names=("lamp", "a", "x")),
        view_of("c", [[0]], names=("12",)),
        view_of("d", [[0], [1]]),
    ]
    groups = np.array([0, 1, -1, 0, 1, -1, 0, 0, 1])
    assert _called(views, "default", groups, 3) == (["lamp", "a", ""], [1.0, 0.5, 0.0])


def test_a_description_leaves_out_what_is_not_finite(line):
    means, opacities = line.means.clone(), line.opacities.clone()
    means[0], opacities[1] = float("nan"), float("nan")
    ids = torch.ones(1, 12, 1, dtype=torch.int32)
    table = (Instance(1, "default", 0, 0, 0, 0, 0.0, ZERO, FORWARD, ZERO),)
    found = InstanceMap(ids, torch.ones(1, 12, 1), torch.full((12,), 9.0), table, ("default",), "x")
    no = np.zeros((1, 1), bool)
    facts = [GroupFacts(np.array([6]), np.array([4]), no, no, ("lamp",), np.array([0.75]))]
    (row,) = describe(replace(line, means=means, opacities=opacities), found, facts)
    assert (row.gaussians, row.masks, row.views, row.label, row.label_score) == (10, 6, 4, "lamp", 0.75)
    assert row.centroid[0] == pytest.approx(np.average(np.arange(2, 12), weights=line.opacities[2:].numpy()), abs=1e-4)


@pytest.mark.parametrize(
    ("distance", "together", "compared", "doubted"),
    [
        (2.9, False, False, True),
        (3.1, False, False, False),  # half diagonals of boxes of 1 x 2 x 2 [m] add up to 3
        (2.9, True, False, False),
        (2.9, False, True, False),
    ],
)
def test_doubts_are_about_what_lies_near_and_was_never_compared(distance, together, compared, doubted):
    table = [
        Instance(k, "default", 0, 9, 1, 1, 1.0, (distance * k, 0.0, 0.0), FORWARD, (1.0, 2.0, 2.0)) for k in (1, 2)
    ]
    once, both = np.ones(2, np.int64), np.ones((2, 2), bool)
    facts = [GroupFacts(once, once, both & together, both & compared, ("", ""), np.ones(2))]
    assert [row.may_be for row in find_doubts(table, facts, None)] == ([(2,), (1,)] if doubted else [(), ()])


def test_the_listing_line_by_line():
    rows = [
        Instance(1, "default", 0, 1234, 9, 7, 0.876, ZERO, FORWARD, (1.0, 0.25, 0.001), "lamp", 0.5),
        Instance(2, "m", 1, 99_999, 9, 12, 1.0, ZERO, FORWARD, (123.4, 2.0, 3.0)),
    ]
    rows += [Instance(k, "default", 0, 5, 1, 1, 0.6, ZERO, FORWARD, ZERO) for k in range(3, LISTED + 3)]
    found = InstanceMap(torch.zeros(1, 0, 1), torch.zeros(1, 0, 1), torch.zeros(0), tuple(rows), ("default",), "x")
    lines = listing(found).splitlines()
    assert lines[0].split() == ["id", "Gaussians", "views", "sure", "size", "[scene", "units]", "label"]
    assert lines[1].split() == ["2", "99,999", "12", "1.00", "123", "x", "2", "x", "3", "level", "m"]
    assert lines[2].split() == ["1", "1,234", "7", "0.88", "1", "x", "0.25", "x", "0.001", "lamp", "(0.50)"]
    assert len(lines) == 1 + LISTED + 1
    assert lines[-1] == "2 smaller ones are in the table"
    few = replace(found, table=tuple(rows[:LISTED]))
    assert len(listing(few).splitlines()) == 1 + LISTED


def test_the_legend_has_the_colors_of_the_picture(monkeypatch):
    """The largest first, by their ids and labels; what belongs to none has no color."""
    rows = [Instance(k, "default", 0, 9, 1, 1, 1.0, ZERO, FORWARD, ZERO, label) for k, label in enumerate("abcd", 1)]
    found = InstanceMap(torch.zeros(1, 0, 1), torch.zeros(1, 0, 1), torch.zeros(0), tuple(rows), ("default",), "x")
    ids = torch.zeros(8, 12, dtype=torch.int64)
    ids[0:2], ids[2:6], ids[6] = 4, 1, 3
    seen = []
    monkeypatch.setattr(maps, "with_legend", lambda *given: seen.append(given))
    draw_ids(torch.zeros(8, 12, 3), ids, found)
    ((picture, names, colors),) = seen
    assert names == ["1 a", "4 d", "3 c"]
    for color, number in zip(colors, (1, 4, 3), strict=True):
        shown = picture[ids.numpy() == number].reshape(-1, 3)
        np.testing.assert_allclose(shown, np.broadcast_to(0.6 * color, shown.shape), atol=1)  # over black
    assert not picture[ids.numpy() == 0].any()
    assert len({tuple(color) for color in colors.tolist()}) == 3
    monkeypatch.setattr(maps, "LINES", 2)
    draw_ids(torch.zeros(8, 12, 3), ids, found)
    assert seen[1][1] == ["1 a", "4 d"]
