"""What a moving scene holds, from a few of its frames."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from sgwarp.io.sequences import Frame, GaussianSequence
from sgwarp.ops.splatting.incremental import changed_rows

SAMPLES = 8  # pairs of frames that are compared


def sequence_facts(sequence: GaussianSequence) -> dict[str, Any]:
    """Frames, Gaussians, identity, foreground, and how much moves from one frame to the next.

    Motion is that of at most 8 pairs of neighboring frames, evenly spread: share of the Gaussians whose geometry
    changed, and median and largest step of the finite ones among them [scene units].
    """
    count = len(sequence)
    starts = sorted({round(k * max(0, count - 2) / max(1, SAMPLES - 1)) for k in range(SAMPLES)}) if count > 1 else []
    shares: list[float] = []
    steps: list[Tensor] = []
    sizes: set[int] = set()
    non_finite, together = 0, True
    first = sequence.frame(0)
    sizes.add(len(first.gaussians))
    for start in starts:
        before, after = sequence.frame(start), sequence.frame(start + 1)
        sizes |= {len(before.gaussians), len(after.gaussians)}
        non_finite = max(non_finite, before.gaussians.non_finite, after.gaussians.non_finite)
        pair = _rows_together(before, after)
        if pair is None:
            together = False
            continue
        old, new = pair
        changed = changed_rows(old, new).bool()
        shares.append(float(changed.float().mean()) if len(new) else 0.0)
        step = (new.means - old.means).norm(dim=1)[changed]
        steps.append(step[torch.isfinite(step)])
    moved = torch.cat(steps) if steps else torch.empty(0)
    return {
        "frames": count,
        "gaussians": f"{min(sizes)} to {max(sizes)}" if len(sizes) > 1 else min(sizes),
        "identity": ("ids" if first.ids is not None else "rows") if together else "none",
        "foreground_share": float(first.foreground.float().mean()) if first.foreground is not None else None,
        "moving_share": sum(shares) / len(shares) if shares else None,
        "median_step": float(moved.median()) if len(moved) else 0.0,
        "largest_step": float(moved.max()) if len(moved) else 0.0,
        "non_finite_rows": non_finite,
    }


def _rows_together(before: Frame, after: Frame) -> tuple[Any, Any] | None:
    """The Gaussians that both frames have, row by row; None if nothing says which belong together."""
    if before.ids is None or after.ids is None:
        return (before.gaussians, after.gaussians) if len(before.gaussians) == len(after.gaussians) else None
    order = before.ids.argsort()
    place = torch.searchsorted(before.ids[order], after.ids).clamp(max=max(0, len(order) - 1))
    if not len(order):
        return before.gaussians, after.gaussians.subset(torch.empty(0, dtype=torch.int64))
    row = order[place]
    kept = before.ids[row] == after.ids
    return before.gaussians.subset(row[kept]), after.gaussians.subset(kept)
