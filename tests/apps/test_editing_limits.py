"""Where the steps of an edit begin and end: the last value that is taken, and the first that is refused."""

import dataclasses
import math
import re

import pytest
import torch

from sgwarp.apps.editing import operations as ops
from sgwarp.apps.editing.picker import EditContext, _name_instances, grow
from sgwarp.apps.editing.script import step_from
from sgwarp.apps.editing.selection import Selection
from sgwarp.apps.editing.session import EditSession
from sgwarp.errors import InputError
from sgwarp.scene import Gaussians, Instance, InstanceMap, Semantics

NOWHERE = (0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def parts(stage):
    """Semantics and instances of the stage's four panels."""
    count, fingerprint = len(stage.classes), stage.gaussians.fingerprint
    features = torch.nn.functional.one_hot(stage.classes - 1, 5).float()
    table = tuple(
        Instance(k, "default", 0, 1, 1, 1, 1.0, NOWHERE, (1.0, 0.0, 0.0, 0.0), NOWHERE, f"panel {k}")
        for k in range(1, 5)
    )
    ids, shares = stage.classes[None, :, None], torch.ones(1, count, 1)
    return {
        "semantics": Semantics(features, torch.ones(count), torch.ones(count), "toy", fingerprint),
        "instances": InstanceMap(ids, shares, torch.full((count,), 9.0), table, ("default",), fingerprint),
    }


@pytest.mark.parametrize("name", ["semantics", "instances"])
def test_each_part_of_the_context_is_of_the_scene(stage, parts, name):
    other = dataclasses.replace(stage.gaussians, means=stage.gaussians.means + 1)
    context = EditContext(**{name: parts[name]})
    EditSession(stage.gaussians, context)
    with pytest.raises(InputError, match="belong"):
        EditSession(other, context)


@pytest.mark.parametrize("name", ["semantics", "instances"])
@pytest.mark.parametrize(("x", "y", "inside"), [(95, 71, True), (96, 71, False), (95, 72, False), (0, 0, True)])
def test_clicks_at_the_border_of_an_image(stage, parts, name, x, y, inside):
    """Pictures of the stage are 96 wide and 72 high, and panels fill them up to the corner."""
    view = stage.views[0]
    assert (view.camera.width, view.camera.height) == (96, 72)
    session = EditSession(stage.gaussians, EditContext(**{name: parts[name]}, views=stage.views))
    selection = Selection((f"click:{view.stem},{x},{y}",))
    if inside:
        try:
            session.preview(selection)
        except InputError as error:  # a corner may show nothing
            message = str(error)
        else:
            message = "selects no Gaussian"
        assert "selects no Gaussian" in message
        return
    with pytest.raises(InputError, match=f"click:{view.stem},{x},{y}: outside the image, which is 96 x 72"):
        session.preview(selection)


@pytest.mark.parametrize(
    ("term", "message"),
    [
        ("click:0001,1,1", "needs --instances, or --semantics for what looks alike"),
        ("click:none,1,1", "there is no such view (0001, 0002, 0003, 0004, 0005)"),
        ("id:1", "needs --instances, what `sgwarp instances` wrote"),
        ("lamp", "needs --semantics, what `sgwarp lift` wrote for this scene"),
    ],
)
def test_what_a_selection_needs_is_named(stage, term, message):
    views = [dataclasses.replace(stage.views[0], stem=f"{k:04d}") for k in range(1, 8)]
    with pytest.raises(InputError, match=re.escape(message)):
        EditSession(stage.gaussians, EditContext(views=views)).preview(Selection((term,)))
    if term.startswith("click:none"):
        with pytest.raises(InputError, match=re.escape("(none; give --views)")):
            EditSession(stage.gaussians, EditContext()).preview(Selection((term,)))


def test_the_last_row_of_the_scene_is_the_last_that_can_be_selected(stage):
    session, count = EditSession(stage.gaussians), len(stage.gaussians)
    chosen = session.preview(Selection((f"rows:0,{count - 2}-{count - 1}",)))
    assert chosen.nonzero().flatten().tolist() == [0, count - 2, count - 1]
    with pytest.raises(InputError, match=f"has rows 0 to {count - 1} at this step"):
        session.preview(Selection((f"rows:{count - 1}-{count}",)))


def test_a_box_holds_its_corners():
    means = torch.tensor([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0], [1.0, 2.0, 6.01], [0.99, 2.0, 3.0], [1.0, 5.01, 3.0]])
    quats = torch.tensor([[1.0, 0, 0, 0]]).expand(5, 4)
    scene = Gaussians(means, quats, torch.full((5, 3), 0.1), torch.full((5,), 0.5), torch.zeros(5, 1, 3))
    chosen = EditSession(scene).preview(Selection(("box:1,2,3,4,5,6",), clean=False))
    assert chosen.tolist() == [True, True, False, False, False]


@pytest.mark.parametrize(("distance", "expected"), [(1.5, [1, 2, 3, 4]), (0.5, [2, 3]), (-1.5, []), (-0.5, [2, 3])])
def test_growing_and_shrinking_on_a_line(distance, expected):
    """Six Gaussians one meter apart, of which two in the middle are chosen."""
    means = torch.arange(6.0)[:, None] * torch.tensor([[1.0, 0.0, 0.0]])
    chosen = torch.tensor([False, False, True, True, False, False])
    assert grow(means, chosen, distance).nonzero().flatten().tolist() == expected


def test_what_an_instance_needs_to_be_named(stage, parts):
    """Its mean is over the seen members alone, above what is asked for, and above its rival's."""
    instances = parts["instances"]
    scores = torch.tensor([3.0, 2.5, 2.39, -1.0])[stage.classes - 1]
    seen, nothing = torch.ones(len(scores), dtype=torch.bool), torch.full_like(scores, -torch.inf)

    def named(scores, rivals, seen, least):
        chosen = _name_instances(scores, rivals, seen, instances, least)[0]
        return sorted({int(k) for k in stage.classes[chosen]})

    assert named(scores, nothing, seen, 0.0) == [1, 2]  # 2.39 is less than 80 % of 3
    assert named(scores, nothing, seen, 2.5) == [1]
    assert named(scores, nothing, seen, 3.0) == []
    rivals = torch.where(stage.classes == 1, 3.0, 0.0)
    assert named(scores, rivals, seen, 0.0) == [2, 3]
    half = torch.arange(len(scores)) % 2 == 0
    assert named(torch.where(half, scores, 100.0), nothing, half, 0.0) == [1, 2]


TAKEN = (
    *({"do": "isolate", "fade": value} for value in (0.0, 0.999)),
    *({"do": "fade", "factor": value} for value in (0.0, 1.0)),
    {"do": "scale", "factor": 1e-3},
    *({"do": "recolor", "color": value} for value in ([0, 0, 1], [1, 1, 1], "#00ff00", "0 0.5 1")),
    {"do": "rotate", "axis": [0, 0, -1e-9], "degrees": -720},
    *({"do": "remove", "threshold": value} for value in (0.0, 1.0)),
)
REFUSED = (
    ({"do": "isolate", "fade": 1.0}, "isolate: fade is a factor from 0 to less than 1, got 1.0"),
    ({"do": "isolate", "fade": -0.01}, "isolate: fade is a factor"),
    ({"do": "isolate", "fade": "0.1"}, "isolate: fade: expected a finite number"),
    ({"do": "fade", "factor": 1.01}, "fade: factor is a number from 0 to 1, got 1.01"),
    ({"do": "fade", "factor": -0.01}, "fade: factor is a number from 0 to 1"),
    ({"do": "fade", "factor": math.inf}, "fade: factor: expected a finite number"),
    ({"do": "scale", "factor": 0.0}, "scale: expected a positive factor"),
    ({"do": "scale", "factor": -1.0}, "scale: expected a positive factor"),
    ({"do": "recolor", "color": [0, 0, 1.01]}, "recolor: a color is red, green and blue from 0 to 1"),
    ({"do": "recolor", "color": [-0.01, 0, 1]}, "recolor: a color is red, green and blue from 0 to 1"),
    ({"do": "recolor", "color": "#00ff0"}, "color '#00ff0': give #rrggbb, three numbers, or one of"),
    ({"do": "recolor", "color": "0 0.5"}, "color '0 0.5': give #rrggbb"),
    ({"do": "rotate", "axis": [0, 0, 0]}, "rotate: the axis has no direction"),
    ({"do": "rotate", "degrees": math.nan}, "rotate: degrees: expected a finite number"),
    ({"do": "duplicate", "by": [1, 2, 3, 4]}, "duplicate: by is three numbers"),
    ({"do": "move", "by": "123"}, "move: by is three numbers"),
    ({"do": "remove", "threshold": math.nan}, "threshold: expected a finite number"),
    ({"do": "remove", "clean": "no"}, "clean: expected true or false"),
    ({"do": "remove", "select": [""]}, "select"),
)


@pytest.mark.parametrize("content", TAKEN)
def test_values_that_are_taken(content):
    assert step_from({"select": ["all"]} | content).operation.name == content["do"]


@pytest.mark.parametrize(("content", "message"), REFUSED)
def test_values_that_are_refused(content, message):
    with pytest.raises(InputError, match=re.escape(message)):
        step_from({"select": ["all"]} | content)


def test_removing_or_keeping_nothing_is_refused(stage):
    everything = torch.ones(len(stage.gaussians), dtype=torch.bool)
    for operation, chosen in ((ops.Remove(), everything), (ops.Extract(), ~everything)):
        with pytest.raises(InputError, match=f"{operation.name}: would leave no Gaussian"):
            operation.apply(stage.gaussians, chosen)


@pytest.mark.parametrize("weight", [1.0, 0.25])
def test_the_centroid_is_weighted_with_opacity(weight):
    means = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [math.inf, 0.0, 0.0], [9.0, 9.0, 9.0]])
    quats, opacities = torch.tensor([[1.0, 0, 0, 0]]).expand(4, 4), torch.tensor([0.5, 0.5 * weight, 0.5, 0.5])
    scene = Gaussians(means, quats, torch.full((4, 3), 0.1), opacities, torch.zeros(4, 1, 3))
    found = ops.centroid(scene, torch.tensor([True, True, True, False]))
    assert found.tolist() == pytest.approx([weight / (1 + weight), 0.0, 0.0], abs=1e-6)
