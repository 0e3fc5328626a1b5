"""How much a compressed scene may unpack to."""

from __future__ import annotations

LEAST_LIMIT = 1 << 16  # Gaussians that any file may claim


def most_gaussians(size: int) -> int:
    """How many Gaussians a compressed scene of `size` bytes may hold: one a byte, where real ones take 8 and more.

    Deflate would make 1032 bytes of one, Zstandard 30,000: a small file could then fill the memory.
    """
    return max(size, LEAST_LIMIT)
