"""A scene of 3D Gaussians."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sgwarp.scene.checks import float32, require, require_rows, version_of

FIELDS = ("means", "quats", "scales", "opacities", "sh")
SH_COUNTS = (1, 4, 9, 16)  # coefficients per color channel for degree 0 to 3
ROWS = 1 << 16  # that are looked at at a time


@dataclass(frozen=True, eq=False)
class Gaussians:
    """A 3D Gaussian scene with activated parameters.

    Attributes:
        means: Centres [m], float32 [N, 3].
        quats: Rotations (w, x, y, z), normalised by the renderer, float32 [N, 4].
        scales: Standard deviations along the local axes [m], not logarithms, float32 [N, 3].
        opacities: In [0, 1], not logits, float32 [N].
        sh: Spherical-harmonic colour coefficients, float32 [N, K, 3], K in 1, 4, 9, 16 (degree 0 to 3).
        extras: Other columns of the file by name, such as labels, [N] each, on the host; kept and written back. None
            if there are none.

    Rows with NaN or infinity are kept, so that indices stay those of the file; the renderer leaves them out and counts
    them (`non_finite`).

    Raises:
        InputError: A field has the wrong shape, type or device, a scale is negative, an opacity outside [0, 1].
    """

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    sh: Tensor
    extras: Any = None  # Mapping[str, NDArray] or None

    def __post_init__(self) -> None:
        put = object.__setattr__
        put(self, "means", float32("means", self.means, (None, 3)))
        n = len(self.means)
        put(self, "quats", float32("quats", self.quats, (n, 4)))
        put(self, "scales", float32("scales", self.scales, (n, 3)))
        put(self, "opacities", float32("opacities", self.opacities, (n,)))
        put(self, "sh", float32("sh", self.sh, (n, None, 3)))
        require(
            self.sh.shape[1] in SH_COUNTS,
            f"sh: expected 1, 4, 9 or 16 coefficients per colour, got {self.sh.shape[1]}",
        )
        devices = {name: getattr(self, name).device for name in ("means", "quats", "scales", "opacities", "sh")}
        require(len(set(devices.values())) == 1, f"all fields must be on one device, got {devices}")
        require_rows("scales", self.scales < 0, "a scale is a standard deviation and cannot be negative", self.scales)
        outside = (self.opacities < 0) | (self.opacities > 1)
        require_rows("opacities", outside, "expected a value in [0, 1]; apply the sigmoid to logits", self.opacities)
        for name, column in (self.extras or {}).items():
            require(column.shape == (n,), f"extras: column {name} has shape {list(column.shape)}, expected [{n}]")

    @classmethod
    def unchecked(cls, means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, sh: Tensor) -> Gaussians:
        """Gaussians of tensors that are known to be float32, contiguous and of the right shapes; nothing is read."""
        gaussians = object.__new__(cls)
        gaussians.__dict__.update(means=means, quats=quats, scales=scales, opacities=opacities, sh=sh)
        return gaussians

    def __len__(self) -> int:
        return len(self.means)

    @property
    def device(self) -> torch.device:
        return self.means.device

    @property
    def sh_degree(self) -> int:
        return math.isqrt(self.sh.shape[1]) - 1

    def _known(self, name: str, tensors: tuple[Tensor, ...], find: Callable[[], Any]) -> Any:
        """The cached result of `find`, until one of the tensors is written to."""
        version = version_of(*tensors)
        known = self.__dict__.get(f"_{name}")
        if known is None or known[0] != version:
            known = (version, find())
            object.__setattr__(self, f"_{name}", known)
        return known[1]

    @property
    def used_sh_degree(self) -> int:
        """Highest degree with a coefficient that is not zero."""
        degree: int = self._known("used_sh_degree", (self.sh,), self._find_used_sh_degree)
        return degree

    def _find_used_sh_degree(self) -> int:
        for degree in range(self.sh_degree, 0, -1):
            part = self.sh.detach()[:, degree * degree : (degree + 1) ** 2]
            # A few rows mostly decide it; all are read only where these are zero.
            if bool((part[:: max(1, len(part) // 256)] != 0).any()) or bool((part != 0).any()):
                return degree
        return 0

    @property
    def finite(self) -> Tensor:
        """Rows whose every field is finite, bool [N]."""
        fields = (self.means, self.quats, self.scales, self.opacities, self.sh)
        rows: Tensor = self._known("finite", fields, self._find_finite)
        return rows

    def _find_finite(self) -> Tensor:
        flat = (self.means, self.quats, self.scales, self.opacities[:, None], self.sh.flatten(1))
        rows = torch.ones(len(self), dtype=torch.bool, device=self.device)
        for start in range(0, len(self), ROWS):  # what lies between would be as large as the scene
            part = slice(start, start + ROWS)
            rows[part] = torch.stack([torch.isfinite(f[part]).all(dim=1) for f in flat]).all(dim=0)
        return rows

    @property
    def colors_may_be_non_finite(self) -> bool:
        """Whether some colour coefficient might hold NaN or infinity; one sum over them tells, in one pass."""
        may_be: bool = self._known(
            "colors_may_be_non_finite", (self.sh,), lambda: not bool(torch.isfinite(self.sh.detach().sum()))
        )
        return may_be

    @property
    def non_finite(self) -> int:
        """Number of rows with NaN or infinity; the renderer leaves them out."""
        return len(self) - int(self.finite.sum())

    @property
    def fingerprint(self) -> str:
        """Hash of geometry and order, 16 hex digits: features belong to exactly one scene."""
        fields = (self.means, self.quats, self.scales, self.opacities)
        found: str = self._known("fingerprint", fields, self._find_fingerprint)
        return found

    def _find_fingerprint(self) -> str:
        digest = hashlib.sha256()
        for tensor in (self.means, self.quats, self.scales, self.opacities):
            digest.update(tensor.detach().cpu().numpy().tobytes())
        return digest.hexdigest()[:16]

    def to(self, device: str | torch.device) -> Gaussians:
        if torch.device(device) == self.device:
            return self
        return self._map(lambda t: t.to(device), self.extras)

    def subset(self, index: Tensor) -> Gaussians:
        """The Gaussians at `index` (integers or a boolean mask)."""
        if self.extras is None:
            return self._map(lambda t: t[index], None)
        rows = torch.as_tensor(index).cpu().numpy()
        return self._map(lambda t: t[index], {name: column[rows] for name, column in self.extras.items()})

    def _map(self, change: Callable[[Tensor], Tensor], extras: Mapping[str, NDArray[Any]] | None) -> Gaussians:
        means, quats, scales, opacities, sh = (change(getattr(self, name)) for name in FIELDS)
        return Gaussians(means, quats, scales, opacities, sh, extras)


def join_gaussians(parts: Sequence[Gaussians]) -> Gaussians:
    """Several scenes as one, in this order; the highest degree of harmonics is kept, and the columns all have."""
    count = max(part.sh.shape[1] for part in parts)
    padded = [torch.nn.functional.pad(part.sh, (0, 0, 0, count - part.sh.shape[1])) for part in parts]
    means, quats, scales, opacities = (torch.cat([getattr(part, name) for part in parts]) for name in FIELDS[:-1])
    names = set.intersection(*(set(part.extras or {}) for part in parts))
    extras = {name: np.concatenate([(part.extras or {})[name] for part in parts]) for name in sorted(names)}
    return Gaussians(means, quats, scales, opacities, torch.cat(padded), extras or None)
