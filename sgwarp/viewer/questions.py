"""What a tab asks: queries with colors, what they have to beat, and the answers."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import torch
from torch import Tensor

from sgwarp.encoders.base import TextEncoder
from sgwarp.encoders.calibration import Calibration, calibration_of
from sgwarp.encoders.prompts import TEMPLATE_SETS, fill_templates
from sgwarp.errors import InputError
from sgwarp.querying.ensembles import Ensemble
from sgwarp.querying.scoring import TextScores, score_texts
from sgwarp.scene import InstanceMap, Semantics
from sgwarp.viewer import bounds
from sgwarp.visualization.pictures import Picture, class_colours

BINS = 40  # of the histogram
LOW, HIGH = -0.5, 1.5  # its ends, and those of the threshold: 0 is the scene's median, 1 its best thousandth
TOP = 10  # instances that are listed
PICTURE = "picture {}"  # name of a picture in a box of queries
OWN = "own"  # templates: those of the encoder


@dataclass(frozen=True)
class Questions:
    """What is asked.

    Attributes:
        queries: Phrases, or names of pictures.
        negatives: Phrases that a query has to fit better than; none: plain scores.
        templates: What phrases are put into: "own" for the encoder's, the name of a set, or one with {}.
        ensemble: How the scores of lifted and predicted semantics become one.
    """

    queries: tuple[str, ...]
    negatives: tuple[str, ...] = ()
    templates: str = OWN
    ensemble: Ensemble = "max"

    @classmethod
    def parse(cls, queries: str, negatives: str = "", templates: str = OWN, ensemble: Ensemble = "max") -> Questions:
        """From the boxes of a page; phrases are separated by semicolons.

        Raises:
            InputError: A box is too long, or a template has no {}.
        """
        templates = bounds.text("templates", templates, bounds.MOST_PHRASE) or OWN
        if templates != OWN and templates not in TEMPLATE_SETS:
            fill_templates((), (templates,))
        return cls(bounds.phrases("query", queries), bounds.phrases("negatives", negatives), templates, ensemble)

    @property
    def colors(self) -> Picture:
        """One color a query, uint8 [Q, 3]."""
        return class_colours(len(self.queries))


@dataclass(frozen=True)
class Ranked:
    """An instance and how well a query fits it on the mean, on the scale of the threshold."""

    id: int
    name: str
    score: float


@dataclass(frozen=True, eq=False)
class Answers:
    """The scores of a scene's Gaussians, as loaded.

    Attributes:
        questions: What was asked.
        scores: As `score_texts` gives them.
    """

    questions: Questions
    scores: TextScores

    def carried(self, rows: Tensor) -> TextScores:
        """The scores of a scene whose Gaussians come from these rows."""
        evidence = None if self.scores.evidence is None else self.scores.evidence[rows]
        return replace(self.scores, values=self.scores.values[rows], evidence=evidence, seen=self.scores.seen[rows])

    @property
    def unknown(self) -> tuple[str, ...]:
        """Queries that mean nothing to the encoder."""
        known = self.scores.known.tolist()
        return tuple(text for text, means in zip(self.questions.queries, known, strict=True) if not means)

    @property
    def first(self) -> int | None:
        """The first query that means something to the encoder; histogram and list are about it. None if none does."""
        known = self.scores.known.nonzero().flatten().tolist()
        return known[0] if known else None

    def histogram(self, query: int = 0) -> tuple[Tensor, Tensor]:
        """How many seen Gaussians score how much: centers of the bins, float64 [40], and counts, float64 [40]."""
        known = self.scores.values[self.scores.seen, query].double().cpu().clamp(LOW, HIGH)
        edges = torch.linspace(LOW, HIGH, BINS + 1, dtype=torch.float64)
        return (edges[1:] + edges[:-1]) / 2, torch.histc(known, BINS, LOW, HIGH)

    def rank(self, instances: InstanceMap | None, query: int = 0, most: int = TOP) -> list[Ranked]:
        """The instances of the coarsest level that a query fits best, by the mean over their seen Gaussians."""
        if instances is None or not instances.table:
            return []
        seen = self.scores.seen.cpu()
        ids = torch.where(seen, instances.instance().cpu().clamp(min=0), 0)
        size = torch.bincount(ids, minlength=len(instances.table) + 1)
        total = torch.bincount(ids, weights=self.scores.values[:, query].double().cpu(), minlength=len(size))
        mean = torch.where(size > 0, total / size.clamp(min=1), -torch.inf)[1:]
        best = mean.argsort(descending=True, stable=True)[:most].tolist()
        return [
            Ranked(k + 1, instances.table[k].label or f"object {k + 1}", float(mean[k]))
            for k in best
            if mean[k] > -torch.inf
        ]


@dataclass
class Asker:
    """Asks a scene's semantics; text sides are kept by their templates.

    Attributes:
        semantics: Lifted, or None: then nothing can be asked.
        encoder: Text encoder of their space; None for lifted labels.
        predicted: By the network, or None.
        with_templates: Makes the text encoder for other templates, or None if there are none but its own.
        make_tower: Makes what encodes images in that space, where the text encoder does not; None if nothing does.
    """

    semantics: Semantics | None
    encoder: TextEncoder | None = None
    predicted: Semantics | None = None
    with_templates: Callable[[str], TextEncoder] | None = None
    make_tower: Callable[[], Any] | None = None
    _tower: Any = field(default=None, repr=False)
    _encoders: dict[str, TextEncoder] = field(default_factory=dict)

    def ask(self, questions: Questions, pictures: Mapping[str, Tensor] | None = None) -> Answers:
        """Scores of every Gaussian for every query.

        Args:
            questions: What is asked.
            pictures: Unit vectors [C] of pictures, by the names that stand for them among the queries.

        Raises:
            InputError: There are no semantics or no query, or as `score_texts`.
        """
        if self.semantics is None:
            raise InputError("a query needs semantics: start the viewer with --semantics, what `sgwarp lift` wrote")
        if not questions.queries:
            raise InputError("query: is empty; write what to look for, such as couch; lamp")
        encoder = self._encoder(questions.templates)
        if encoder is not None and pictures:
            encoder = WithPictures(encoder, pictures, encoder.space, _with_names(calibration_of(encoder), pictures))
        options = {"measure": "relevancy", "canonical": questions.negatives} if questions.negatives else {}
        scores = score_texts(
            self.semantics,
            questions.queries,
            encoder,
            predicted=None if questions.ensemble == "2d" else self.predicted,
            ensemble=questions.ensemble,
            **options,  # type: ignore[arg-type]
        )
        # The values of a phrase without meaning are noise that `rescale` has blown up.
        values = torch.where(scores.known.to(scores.values.device), scores.values, 0.0)
        return Answers(questions, replace(scores, values=values))

    def _encoder(self, templates: str) -> TextEncoder | None:
        if self.encoder is None or templates == OWN or self.with_templates is None:
            return self.encoder
        if templates not in self._encoders:
            self._encoders[templates] = self.with_templates(templates)
        return self._encoders[templates]

    @property
    def sees_pictures(self) -> bool:
        """Whether a picture can be asked for: the encoder has an image tower."""
        return callable(getattr(self.encoder, "encode_images", None)) or self.make_tower is not None

    def picture_vector(self, image: Picture) -> Tensor:
        """Unit vector of a picture in the space of the semantics, float32 [C].

        Raises:
            InputError: The encoder has no image tower.
        """
        import cv2

        if self._tower is None:
            own = callable(getattr(self.encoder, "encode_images", None)) or self.make_tower is None
            self._tower = self.encoder if own else self.make_tower()  # type: ignore[misc]
        encode, side = getattr(self._tower, "encode_images", None), getattr(self._tower, "side", 224)
        if not callable(encode):
            raise InputError("picture: the encoder of these semantics has no image tower; ask in words")
        edge = min(image.shape[:2])
        top, left = ((length - edge) // 2 for length in image.shape[:2])
        square = image[top : top + edge, left : left + edge]
        resized = cv2.resize(square, (side, side), interpolation=cv2.INTER_AREA)
        vector: Tensor = encode(torch.from_numpy(resized)[None])[0]
        return torch.nn.functional.normalize(vector.to("cpu", torch.float32), dim=0)


@dataclass(frozen=True)
class _PicturesKnown(Calibration):
    """A calibration for which the names of pictures mean something."""

    names: frozenset[str] = frozenset()

    def known(self, texts: Sequence[str]) -> Tensor:
        """Texts that mean something to the encoder, and names of pictures, bool [Q]."""
        return super().known(texts) | torch.tensor([text in self.names for text in texts], dtype=torch.bool)


def _with_names(calibration: Calibration, pictures: Mapping[str, Tensor]) -> Calibration:
    own = {one.name: getattr(calibration, one.name) for one in fields(Calibration)}
    return _PicturesKnown(**own, names=frozenset(pictures))


@dataclass
class WithPictures:
    """A TextEncoder for which some phrases are names of pictures."""

    encoder: TextEncoder
    pictures: Mapping[str, Tensor]
    space: str
    calibration: Calibration

    def encode_text(self, texts: Sequence[str]) -> Tensor:
        """Unit vectors of phrases and pictures, float32 [Q, C]."""
        plain = [text for text in texts if text not in self.pictures]
        vectors = iter(self.encoder.encode_text(plain)) if plain else iter(())
        return torch.stack([self.pictures[text] if text in self.pictures else next(vectors) for text in texts])
