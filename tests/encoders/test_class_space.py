"""The joint space: what is stored in the package, and where texts and images come to lie."""

import numpy as np
import pytest
import torch

from sgwarp.encoders.images.conse.class_space import (
    TEMPERATURE,
    TOP_CLASSES,
    ClassSpace,
    imagenet_classes,
    imagenet_space,
)


def test_stored_space_belongs_to_the_names():
    space = imagenet_space()
    assert len(imagenet_classes()) == len(space.embeddings) == len(space.groups) == 1000
    assert space.channels == 512
    assert sorted(set(space.groups.tolist())) == list(range(511))
    torch.testing.assert_close(space.embeddings.norm(dim=1), torch.ones(1000), rtol=1e-3, atol=1e-3)


def test_names_in_the_order_of_the_classifier():
    """Places that the literature gives for some classes of ILSVRC 2012."""
    known = {
        0: "tench",
        207: "golden retriever",
        281: "tabby",
        430: "basketball",
        546: "electric guitar",
        849: "teapot",
    }
    for number, name in known.items():
        assert imagenet_classes()[number][0] == name
    assert imagenet_classes()[831] == ("studio couch", "day bed")


@pytest.fixture
def small():
    """Twelve classes on eight axes."""
    embeddings = torch.nn.functional.normalize(torch.randn(12, 5, generator=torch.Generator().manual_seed(0)), dim=1)
    return ClassSpace(embeddings, torch.tensor([0, 1, 2, 3, 4, 5, 6, 7, 0, 1, 2, 0]))


def test_texts(small):
    queries = small.embeddings[:3] * 0.6 + small.embeddings[3:6] * 0.4
    queries = torch.nn.functional.normalize(queries, dim=1)
    found = small.place_texts(queries)
    for query, vector in zip(queries.double(), found, strict=True):
        wanted = np.zeros(9)
        for name, group in zip(small.embeddings.double(), small.groups, strict=True):
            wanted[group] += np.exp((float(query @ name) - 1) / TEMPERATURE)
        np.testing.assert_allclose(vector, wanted / np.linalg.norm(wanted), rtol=1e-4, atol=1e-7)
    assert (found[:, -1] == 0).all()


def test_images(small):
    logits = torch.randn(4, 3, 12, generator=torch.Generator().manual_seed(1)) * 2
    probabilities = logits.softmax(dim=-1)
    found = small.place_images(probabilities)
    for row in range(4):
        for column in range(3):
            p = probabilities[row, column].double().numpy()
            wanted = np.zeros(9)
            for k in sorted(range(12), key=lambda k: -p[k])[:TOP_CLASSES]:
                wanted[small.groups[k]] += p[k]
            wanted[-1] = np.sqrt(1 - (wanted**2).sum())
            np.testing.assert_allclose(found[row, column], wanted, rtol=1e-5, atol=1e-6)


def test_a_sure_image_has_nothing_left_over(small):
    sure = torch.zeros(1, 12)
    sure[0, 3] = 1.0
    assert small.place_images(sure).tolist() == [[0, 0, 0, 1, 0, 0, 0, 0, 0]]


def test_cosine_is_the_share_of_evidence(small):
    """Whatever the rest of the evidence says, a text of one class scores its probability."""
    text = small.place_texts(small.embeddings[4:5])
    for share in (0.2, 0.5, 0.9):
        spread = torch.full((1, 12), (1 - share) / 11)
        spread[0, 4] = share
        score = (small.place_images(spread) @ text.T).item()
        own = text[0, small.groups[4]].item()
        assert own * share <= score <= own * share + (1 - share) / 11 * 3 * text[0].sum().item()
