"""What the scores of an encoder mean: the scoring that its answers are calibrated for."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from torch import Tensor

    from sgwarp.encoders.base import TextEncoder

Scoring = Literal["evidence", "cosine", "relevancy"]


@dataclass(frozen=True)
class Calibration:
    """How a class is chosen from the cosines with the texts of the classes: softmax(score / temperature).

    | scoring | score | "none of these" |
    |---|---|---|
    | `cosine` | the cosine (paper, Sec. III-D) | never |
    | `relevancy` | the cosine | the strongest of the canonical phrases (LERF, 2023) |
    | `evidence` | the cosine standardized over the scene | `level` |

    Attributes:
        scoring: See above.
        temperature: Of the softmax, in units of the score.
        level: Evidence that a class has to exceed.
        least_deviation: Smallest deviation of a text's cosines over the scene that counts as such: a text that varies
            less is not made as loud as one that the scene shows.
        certain: Cosine that reaches `level` by itself: what fills the scene does not stand out from its mean.
        counterparts: "module:function" that tells which texts mean something to the encoder, bool [Q] from Q texts; ""
            if all of them do. The others get no Gaussian, and what they would name is unknown.
    """

    scoring: Scoring
    temperature: float
    level: float = 1.0
    least_deviation: float = 0.0
    certain: float = math.inf
    counterparts: str = ""

    def known(self, texts: Sequence[str]) -> Tensor:
        """Texts that mean something to the encoder, bool [Q]."""
        import torch

        if not self.counterparts:
            return torch.ones(len(texts), dtype=torch.bool)
        module, _, function = self.counterparts.partition(":")
        find: Callable[[Sequence[str]], Tensor] = getattr(import_module(module), function)
        return find(texts)


PAPER = Calibration("cosine", 0.1)  # for spaces of which nothing is known
# Each scoring with the other encoders' temperatures, for those who ask for it by name.
PLAIN: dict[Scoring, Calibration] = {
    "evidence": Calibration("evidence", 0.3),
    "cosine": PAPER,
    "relevancy": Calibration("relevancy", 0.1),
}


def calibration_of(encoder: TextEncoder, scoring: Scoring | None = None) -> Calibration:
    """What an encoder states, by itself (attribute `calibration`) or in the catalogue's row of its space.

    Args:
        encoder: Text side.
        scoring: Another one than it states; its temperature is then that of PLAIN.
    """
    stated = getattr(encoder, "calibration", None)
    own = stated if isinstance(stated, Calibration) else calibration_of_space(encoder.space)
    return own if scoring in (None, own.scoring) else PLAIN[scoring]


def calibration_of_space(space: str) -> Calibration:
    """What the catalogue states of a space; of an ensemble, that of the member with the largest weight."""
    from sgwarp.encoders.catalogue import KINDS

    def weight(member: str) -> float:
        return float(member.rpartition("@")[2]) if "@" in member else 1.0

    heaviest = max(space.split(" ++ "), key=weight)
    kind = heaviest.partition("-")[0]
    return (KINDS[kind].calibration if kind in KINDS else None) or PAPER
