"""Answers of the method that lifts nothing, from maps whose pixels are written out here."""

from pathlib import Path

import pytest
import torch

from sgwarp.datasets.base import SceneData
from sgwarp.evaluation.answers import Answers
from sgwarp.evaluation.cases import Case
from sgwarp.evaluation.settings import Settings
from sgwarp.runs.log import RunLog
from sgwarp.scene import FeatureMap, View

SIZE = (2, 3)
IDS = torch.tensor([[0, 1, 1], [1, -1, 0]])


class Source:
    """Gives one map for every view."""

    needs_image = False

    def __init__(self, found):
        self.space, self.found = found.space, found

    def encode(self, view, image=None):
        return self.found


class Text:
    """Unit vectors for two phrases, a third one for any other."""

    space = "toy:3"

    def encode_text(self, texts):
        return torch.eye(3)[[{"lamp": 0, "cup": 1}.get(text, 2) for text in texts]]


@pytest.fixture
def answers(scenes):
    camera = scenes.pinhole(SIZE[1], SIZE[0], position=(0.0, 0.0, -1.0), target=(0.0, 0.0, 4.0))
    view = View("0000", camera)

    def make(found: FeatureMap, classes: tuple[str, ...] = ()) -> tuple[Answers, View]:
        scene = SceneData("attic", Path("attic"), 1, classes=classes)
        gaussians = scenes.cloud(3, seed=0, scale=(0.1, 0.4), opacity=(0.3, 1.0), degree=0)
        case = Case(scene, Settings(), gaussians, [], [view], RunLog(), [Source(found)], text=Text())
        return Answers(case), view

    return make


def test_labels_that_are_ids_get_the_names_of_the_data_set(answers):
    """Class k of the data set has id k + 1: "3" is the cup and "1" the sofa."""
    ours, view = answers(FeatureMap("labels", ids=IDS, labels=("3", "1")), ("sofa", "lamp", "cup"))
    assert ours.labels(view, ("lamp", "cup", "sofa")).tolist() == [[1, 2, 2], [2, -1, 1]]
    assert ours.labels(view, ("lamp", "sofa")).tolist() == [[-1, 1, 1], [1, -1, -1]]


def test_labels_are_found_by_name(answers):
    ours, view = answers(FeatureMap("labels", ids=IDS, labels=("lamp", "cup")))
    found = ours.relevancy(view, ("cup", "sofa", "lamp"))[0]
    assert torch.equal(found, torch.stack([IDS == 1, torch.zeros(SIZE), IDS == 0]).float())


@pytest.mark.parametrize("ask", ["labels", "relevancy"])
def test_features_with_names_are_asked_by_their_features(answers, ask):
    dense = torch.randn(*SIZE, 3, generator=torch.Generator().manual_seed(0))
    found = []
    for labels in (None, ("a", "b", "c")):
        ours, view = answers(FeatureMap(Text.space, dense=dense, labels=labels), ("lamp", "cup"))
        found.append(getattr(ours, ask)(view, ("lamp", "cup")))
    assert torch.equal(*found)
    assert len(found[0].unique()) > 1
