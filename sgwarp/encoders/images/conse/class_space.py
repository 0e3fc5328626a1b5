"""The joint space of ConSE: where phrases and the evidence of an ImageNet classifier meet.

ConSE (Norouzi et al., Zero-Shot Learning by Convex Combination of Semantic Embeddings, 2014) places an image at the sum
over its most probable classes of p(k) times the sentence embedding of their names, and compares it with a phrase by
cosine. Sentence embeddings of nouns have cosines of 0.3 to 0.6 with each other whatever they mean, so such sums all
look alike. Here every class keeps an axis of its own, and the similarity of phrases is taken sharper:

    score(image, phrase) = sum over k of p(k) * kernel(phrase, name_k),   kernel = exp((cosine - 1) / TEMPERATURE)

up to the phrase's norm. Classes that the classifier itself can hardly tell apart (coffee mug, cup and espresso; grand
and upright piano) share an axis, which pools their evidence. One more axis, zero for all phrases, fills an image up to
a unit vector: a cosine with a phrase is then the share of the evidence that speaks for it, also after averaging.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib.resources import as_file, files

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize, pad

from sgwarp.files.arrays import read_arrays

SPACE = "conse-efficientnet-lite2-minilm-512"
NAMES_FILE = "imagenet_classes.txt"
SPACE_FILE = "imagenet_class_space.npz"

TEMPERATURE = 0.05  # a cosine of 0.8 counts 0.02
TOP_CLASSES = 10  # as in ConSE


@dataclass(frozen=True, eq=False)
class ClassSpace:
    """Axes for classes, and sentence embeddings of their names.

    Attributes:
        embeddings: Unit vectors of the class names, the mean over the synonyms of a class, float32 [K, S].
        groups: Axis of each class, from 0 on without a gap, int64 [K].
    """

    embeddings: Tensor
    groups: Tensor

    @property
    def channels(self) -> int:
        return int(self.groups.max()) + 2

    def place_texts(self, embeddings: Tensor) -> Tensor:
        """Take unit vectors of the sentence encoder, [Q, S], into the space: unit vectors, float32 [Q, C]."""
        kernel = torch.exp((embeddings.to(torch.float32) @ self.embeddings.T - 1.0) / TEMPERATURE)
        return normalize(pad(self._by_group(kernel), (0, 1)), dim=-1)

    def place_images(self, probabilities: Tensor, top: int = TOP_CLASSES) -> Tensor:
        """Take class probabilities, [..., K], into the space: unit vectors, float32 [..., C].

        Only the `top` most probable classes count, each with its probability.
        """
        values, classes = probabilities.to(torch.float32).topk(top, dim=-1)
        evidence = self._by_group(torch.zeros_like(probabilities).scatter(-1, classes, values))
        rest = (1.0 - evidence.square().sum(dim=-1, keepdim=True)).clamp(min=0.0).sqrt()
        return torch.cat([evidence, rest], dim=-1)

    def _by_group(self, values: Tensor) -> Tensor:
        """Sum over the classes of each group, [..., K] -> [..., C - 1]."""
        sums = values.new_zeros(*values.shape[:-1], self.channels - 1)
        return sums.index_add_(-1, self.groups.to(values.device), values)


@cache
def imagenet_classes() -> tuple[tuple[str, ...], ...]:
    """Synonyms of the 1000 classes of ImageNet, in the order of a classifier's outputs."""
    lines = files("sgwarp.encoders.images.conse").joinpath(NAMES_FILE).read_text(encoding="utf-8").splitlines()
    return tuple(tuple(line.split(", ")) for line in lines if not line.startswith("#"))


@cache
def imagenet_space() -> ClassSpace:
    """The space of those classes as stored in the package, so that lifted features mean the same everywhere.

    The embeddings are those of all-MiniLM-L6-v2. The groups are average-linkage clusters (511 of them) of the weight
    vectors of EfficientNet-Lite2's last layer, less their mean, under cosine distance.
    """
    with as_file(files("sgwarp.encoders.images.conse").joinpath(SPACE_FILE)) as path:
        stored = read_arrays(path)
    embeddings = torch.from_numpy(stored["embeddings"].astype(np.float32))
    groups = torch.from_numpy(stored["groups"].astype(np.int64))
    return ClassSpace(embeddings, groups)
