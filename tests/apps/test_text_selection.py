"""What a text selects: lifted labels with instances and negatives, and texts that nothing in the scene shows."""

import dataclasses

import pytest
import torch

from sgwarp.apps.editing.picker import EditContext, spread
from sgwarp.apps.editing.selection import Selection
from sgwarp.apps.editing.session import EditSession
from sgwarp.encoders.calibration import Calibration
from sgwarp.errors import InputError
from sgwarp.scene import Instance, InstanceMap, Semantics

NAMES = ("wall", "left door", "lamp", "book")


@pytest.fixture(scope="module")
def labels(stage):
    """Lifted label images: of each Gaussian 0.7 its panel's label, 0.3 the next one's."""
    own = torch.nn.functional.one_hot(stage.classes - 1, 4).float()
    shares = 0.7 * own + 0.3 * own.roll(1, dims=1)
    weight = torch.ones(len(own))
    return Semantics(shares, weight, weight, "labels", stage.gaussians.fingerprint, NAMES)


@pytest.fixture(scope="module")
def instances(stage):
    """Two instances: the door with the lamp, mostly door, and the book."""
    ids = torch.tensor([0, 1, 1, 2], dtype=torch.int32)[stage.classes - 1][None, :, None]
    zero = (0.0, 0.0, 0.0)
    table = tuple(Instance(k, "default", 0, 1, 1, 1, 1.0, zero, (1.0, 0.0, 0.0, 0.0), zero) for k in (1, 2))
    count = ids.shape[1]
    shares, votes = torch.ones(1, count, 1), torch.full((count,), 9.0)
    return InstanceMap(ids, shares, votes, table, ("default",), stage.gaussians.fingerprint)


def picked(stage, context, *terms, **options) -> torch.Tensor:
    return EditSession(stage.gaussians, context).preview(Selection(terms, clean=False, **options))


def test_a_label_selects_what_bears_it(stage, labels):
    context = EditContext(labels)
    assert torch.equal(picked(stage, context, "lamp"), stage.classes == 3)
    both = picked(stage, context, "lamp", threshold=0.25)
    assert torch.equal(both, (stage.classes == 3) | (stage.classes == 2)), "the door bears 0.3 of it"


def test_negatives_of_labels_win_where_their_share_is_larger(stage, labels):
    context = EditContext(labels)
    alone = picked(stage, context, "lamp", threshold=0.25, negatives=("left door",))
    assert torch.equal(alone, stage.classes == 3)
    with pytest.raises(InputError, match="'shelf'"):
        picked(stage, context, "lamp", negatives=("shelf",))


def test_a_label_selects_whole_instances(stage, labels, instances):
    context = EditContext(labels, instances=instances)
    door = int((stage.classes == 2).sum()) / int(((stage.classes == 2) | (stage.classes == 3)).sum())
    assert 0.7 * door > 0.5, "the share of the label in the first instance"
    assert torch.equal(picked(stage, context, "left door"), (stage.classes == 2) | (stage.classes == 3))
    assert torch.equal(picked(stage, context, "book"), stage.classes == 4)
    with pytest.raises(InputError, match="selects no Gaussian"):
        picked(stage, context, "wall")  # 0.3 of the book, which is no instance of it
    with pytest.raises(InputError, match="selects no Gaussian"):
        picked(stage, context, "book", negatives=("book",))


class Faint:
    """A text encoder that needs an evidence of `level`."""

    def __init__(self, inner, level):
        self.space, self.encode_text = inner.space, inner.encode_text
        self.calibration = Calibration("evidence", 0.3, level)


def test_what_nothing_shows_is_not_selected_by_its_best_place(stage, toy_text, instances):
    """Evidence of the book is at most a few deviations; an encoder that needs more does not see one."""
    features = torch.nn.functional.one_hot(stage.classes - 1, 5).float()
    weight = torch.ones(len(features))
    semantics = Semantics(features, weight, weight, "toy", stage.gaussians.fingerprint)
    context = EditContext(semantics, Faint(toy_text, 0.5))
    assert torch.equal(picked(stage, context, "book"), stage.classes == 4)
    strict = dataclasses.replace(context, encoder=Faint(toy_text, 50.0))
    message = r"select 'book': nothing stands out as that \(evidence [0-9.]+, and this encoder needs more than 50.00\)"
    with pytest.raises(InputError, match=message):
        picked(stage, strict, "book")
    among = dataclasses.replace(strict, instances=instances)
    assert torch.equal(picked(stage, among, "book"), stage.classes == 4), "of given objects one is the best"


def test_each_term_is_cleaned_by_itself(stage):
    """A few rows beside a wall of thousands: small as a piece of both, whole as a term."""
    book = (stage.classes == 4).nonzero().flatten()[:9].tolist()
    terms = ("box:-9,-9,3.9,9,9,9", f"rows:{book[0]}-{book[-1]}")
    alone = [EditSession(stage.gaussians).preview(Selection((term,))) for term in terms]
    assert int(alone[1].sum()) == 9 < int(alone[0].sum()) / 10
    assert torch.equal(EditSession(stage.gaussians).preview(Selection(terms)), alone[0] | alone[1])


def test_what_is_connected_belongs_to_it_from_half_the_threshold_on():
    """Two rows of Gaussians, 1 mm apart in a row: one with a peak, one as high as the slopes of the first."""
    at = 0.001 * torch.arange(40.0)
    means = torch.cat([torch.stack([at, torch.full((40,), y), torch.zeros(40)], dim=1) for y in (0.0, 1.0)])
    scores = torch.cat([torch.linspace(0.0, 1.0, 40), torch.full((40,), 0.4)])
    chosen = spread(means, scores > 0.5, scores > 0.25)
    assert torch.equal(chosen, (scores > 0.25) & (means[:, 1] == 0))
    nothing = torch.zeros(80, dtype=torch.bool)
    assert torch.equal(spread(means, nothing, scores > 0.25), nothing)
    assert torch.equal(spread(means, scores > 0.5, nothing), scores > 0.5)


def test_a_text_takes_what_is_connected_with_its_best(stage, toy_text):
    """Panels whose features turn from the book's to the wall's: the book at both thresholds, the rest by half."""
    features = torch.nn.functional.one_hot(stage.classes - 1, 5).float()
    lamp = stage.classes == 3
    left = lamp & (stage.gaussians.means[:, 0] < stage.gaussians.means[lamp, 0].median())
    features[left] = 0.4 * features[left]  # a lamp by 0.4, seen as little else
    features[left, 4] = 0.9165
    weight = torch.ones(len(features))
    semantics = Semantics(features, weight, weight, "toy", stage.gaussians.fingerprint)
    session = EditSession(stage.gaussians, EditContext(semantics, Faint(toy_text, 0.0)))
    strong = session.preview(Selection(("lamp",), threshold=0.9, negatives=("wall",)))
    assert torch.equal(strong, lamp & ~left)
    assert torch.equal(session.preview(Selection(("lamp",), threshold=0.5, negatives=("wall",))), lamp)
