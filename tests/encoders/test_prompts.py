import pytest

from sgwarp.encoders.prompts import PHOTO, PLAIN, fill_templates
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
