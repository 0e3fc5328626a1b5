"""Random numbers that depend on the seed, the step and their purpose alone, so that a resumed run draws the same."""

from __future__ import annotations

import hashlib

import torch


def number(seed: int, step: int, purpose: str) -> int:
    """31 bits."""
    digest = hashlib.sha256(f"{seed} {step} {purpose}".encode()).digest()
    return int.from_bytes(digest[:4], "little") >> 1


def generator(seed: int, step: int, purpose: str) -> torch.Generator:
    """A generator on the CPU."""
    return torch.Generator().manual_seed(number(seed, step, purpose))


def view_at(seed: int, step: int, count: int) -> int:
    """Index of the training image of a step, below `count`: a new permutation for each epoch."""
    turn, place = divmod(step, count)
    return int(torch.randperm(count, generator=generator(seed, turn, "views"))[place])
