"""How much a compressed scene may unpack to, and the blocks in which it is unpacked."""

from __future__ import annotations

from collections.abc import Iterator

LEAST_LIMIT = 1 << 16  # Gaussians that any file may claim
ROWS = 1 << 15  # Gaussians of a block: what lies between file and scene stays within a few MB


def most_gaussians(size: int) -> int:
    """How many Gaussians a compressed scene of `size` bytes may hold: one a byte, where real ones take 8 and more.

    Deflate would make 1032 bytes of one, Zstandard 30,000: a small file could then fill the memory.
    """
    return max(size, LEAST_LIMIT)


def blocks(count: int) -> Iterator[slice]:
    """Rows of a scene of `count` Gaussians, some at a time."""
    return (slice(start, min(start + ROWS, count)) for start in range(0, count, ROWS))
