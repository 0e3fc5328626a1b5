import pytest
import torch

from sgwarp.encoders.base import TextEncoder
from sgwarp.encoders.building import Request
from sgwarp.encoders.catalogue import KINDS
from sgwarp.encoders.names import Part
from sgwarp.encoders.prompts import BATCH, PHOTO, PLAIN, ROOM, Phrases, fill_templates, named_templates
from sgwarp.errors import InputError


def test_every_text_in_every_template():
    found = fill_templates(["a cat", " dog "], [*PLAIN, *PHOTO])
    assert found == ["a cat", "a photo of a a cat", "dog", "a photo of a dog"]


def test_braces_in_a_text_are_text():
    assert fill_templates(["{x}"], ["the {}"]) == ["the {x}"]


@pytest.mark.parametrize("templates", [(), ("a photo",), ("{} and {}",)])
def test_bad_templates(templates):
    with pytest.raises(InputError, match="template"):
        fill_templates(["a"], templates)


class Network:
    """Embeds prompts by their letters, and remembers what it was asked."""

    def __init__(self):
        self.batches = []

    def __call__(self, prompts):
        self.batches.append(len(prompts))
        return torch.nn.functional.normalize(torch.stack([letters(prompt) for prompt in prompts]), dim=1)


def letters(prompt: str) -> torch.Tensor:
    return torch.tensor([prompt.count(letter) + 0.1 for letter in "abcdefgh"])


def test_vectors_of_templates_are_averaged():
    phrases = Phrases("s", Network(), ("{}", "a big {}"))
    found = phrases.encode_text(["bed", "cab"])
    assert isinstance(phrases, TextEncoder)
    for vector, name in zip(found, ("bed", "cab"), strict=True):
        both = [torch.nn.functional.normalize(letters(text), dim=0) for text in (name, f"a big {name}")]
        torch.testing.assert_close(vector, torch.nn.functional.normalize(both[0] + both[1], dim=0))


def test_long_lists_go_in_batches_and_only_once():
    network = Network()
    phrases = Phrases("s", network, ("{}", "the {}"))
    names = [f"bed {number}" for number in range(BATCH)]
    first = phrases.encode_text(names)
    assert network.batches == [BATCH, BATCH]
    again = phrases.encode_text([names[5], "cab", names[5]])
    assert network.batches == [BATCH, BATCH, 2]
    assert torch.equal(again[0], first[5])
    assert torch.equal(again[0], again[2])


def test_no_phrases():
    with pytest.raises(InputError, match="at least one phrase"):
        Phrases("s", Network(), PLAIN).encode_text([])


def test_named_templates():
    assert named_templates(["plain", "the {}"]) == ("{}", "the {}")
    assert named_templates(["room"]) == ROOM
    with pytest.raises(InputError, match="prompt template 'rooms'"):
        named_templates(["rooms"])


@pytest.mark.parametrize(
    ("asked", "named", "expected"),
    [
        (None, None, {}),  # the encoder's own
        (None, ("room",), {"templates": ROOM}),
        (("plain",), None, {"templates": PLAIN}),
        (("plain",), ("room",), {"templates": PLAIN}),  # what is asked for goes before what the name says
        (("the {}", "photo"), ("room",), {"templates": ("the {}", *PHOTO)}),
    ],
)
def test_whose_templates_are_taken(asked, named, expected):
    part = Part("conse", KINDS["conse"], "", {} if named is None else {"templates": named})
    assert Request("conse", templates=asked).templates_of(part) == expected
