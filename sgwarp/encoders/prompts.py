"""Prompt templates: what a phrase is wrapped in before it is embedded."""

from __future__ import annotations

from collections.abc import Sequence

from sgwarp.errors import InputError

PLAIN = ("{}",)
PHOTO = ("a photo of a {}",)


def fill_templates(texts: Sequence[str], templates: Sequence[str]) -> list[str]:
    """Every text in every template, text by text: T templates and Q texts give Q * T prompts.

    Raises:
        InputError: There is no template, or one does not hold exactly one {}.
    """
    wrong = [template for template in templates if template.count("{}") != 1]
    if wrong or not templates:
        raise InputError(f"prompt template {wrong[0]!r}: expected one {{}}" if wrong else "no prompt template given")
    return [template.replace("{}", text.strip()) for text in texts for template in templates]
