"""The text side of every encoder: prompt templates, canonical negatives, and phrases that are embedded once."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor
from torch.nn.functional import normalize

from sgwarp.errors import InputError

PLAIN = ("{}",)
PHOTO = ("a photo of a {}",)
ROOM = ("a photo of a {}", "a {} in a room", "a cropped photo of a {}", "a dark photo of a {}", "a {} seen from afar")
TEMPLATE_SETS = {"plain": PLAIN, "photo": PHOTO, "room": ROOM}

CANONICAL = ("object", "things", "stuff", "texture")  # what fits anything: a phrase has to beat them (LERF, 2023)
BATCH = 128  # prompts that go through a network at once


def fill_templates(texts: Sequence[str], templates: Sequence[str]) -> list[str]:
    """Every text in every template, text by text: T templates and Q texts give Q * T prompts.

    Raises:
        InputError: There is no template, or one does not hold exactly one {}.
    """
    wrong = [template for template in templates if template.count("{}") != 1]
    if wrong or not templates:
        raise InputError(f"prompt template {wrong[0]!r}: expected one {{}}" if wrong else "no prompt template given")
    return [template.replace("{}", text.strip()) for text in texts for template in templates]


def named_templates(names: Sequence[str]) -> tuple[str, ...]:
    """Templates by the name of a set ("plain", "photo", "room") or as they are.

    Raises:
        InputError: A template does not hold exactly one {} and is no name.
    """
    templates = tuple(template for name in names for template in TEMPLATE_SETS.get(name, (name,)))
    fill_templates((), templates)
    return templates


class Phrases:
    """A TextEncoder around a network: templates are filled and averaged, and no phrase is embedded twice.

    Args:
        space: Of the vectors.
        embed: Unit vectors [P, E] of P prompts; asked for at most BATCH at a time.
        templates: Prompts that a phrase is put into; the mean of their vectors, normalised, is that of the phrase.
        place: Takes those means [Q, E] into the space, if that is another; unit vectors [Q, C].
    """

    def __init__(
        self,
        space: str,
        embed: Callable[[list[str]], Tensor],
        templates: Sequence[str],
        place: Callable[[Tensor], Tensor] | None = None,
    ) -> None:
        fill_templates((), templates)
        self.space = space
        self.templates = tuple(templates)
        self._embed, self._place = embed, place or (lambda means: means)
        self._known: dict[str, Tensor] = {}

    def encode_text(self, texts: Sequence[str]) -> Tensor:
        """Unit vectors, float32 [Q, C], one per phrase.

        Raises:
            InputError: There are no phrases.
        """
        if not texts:
            raise InputError("texts: expected at least one phrase")
        new = [text for text in dict.fromkeys(texts) if text not in self._known]
        if new:
            prompts = fill_templates(new, self.templates)
            parts = [self._embed(prompts[i : i + BATCH]) for i in range(0, len(prompts), BATCH)]
            vectors = torch.cat(parts).to("cpu", torch.float32)
            means = normalize(vectors.unflatten(0, (len(new), len(self.templates))).mean(dim=1), dim=1)
            self._known.update(zip(new, self._place(means), strict=True))
        return torch.stack([self._known[text] for text in texts])
