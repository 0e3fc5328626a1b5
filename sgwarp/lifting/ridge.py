"""Features whose rendering fits the maps best: a ridge problem, solved by preconditioned conjugate gradients.

With A the renderer of all views, F their maps, R the worth of the views, M the weighted means and k the ridge, the
features X minimize |R^(1/2) (A X - F)|^2 + k |X - M|^2. With X = M + Z this is (A^T R A + k) Z = A^T R (F - A M); the
preconditioner is the diagonal, sum R a^2 + k. The matrix is never made: a product is a rendering and a lift of each
view. Channels are solved in blocks, so memory beyond the features is that of a few blocks.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from sgwarp.lifting.map_reader import MapReader
from sgwarp.lifting.residuals import residual
from sgwarp.ops.splatting.forward import rasterize
from sgwarp.ops.splatting.lifting import LiftSums, lift_view
from sgwarp.ops.splatting.pixel_lifting import read_at
from sgwarp.scene import FeatureMap, View

BLOCK = 64  # channels solved together
RIDGES = (1.0, 10.0, 100.0)  # that are tried
HOLD_OUT = 6  # every so many-th view is held out to choose the ridge
CHANNELS_TO_CHOOSE = 32  # those with the largest features, of maps that are no labels


@dataclass(frozen=True, eq=False)
class Problem:
    """The ridge problem of some views.

    Attributes:
        reader: Of their maps.
        views: To be fitted.
        worth: Factor of each view by stem; 1 if missing.
        deterministic: As of `lift_view`.
        done: Called with its stem after each product with a view.
        channels: Of the maps, int64 [c]; None for all.
    """

    reader: MapReader
    views: Sequence[View]
    worth: Mapping[str, float]
    deterministic: bool | None = None
    done: Callable[[str], None] = lambda stem: None
    channels: Tensor | None = None

    def solve(self, prior: Tensor, ridge: float, iterations: int) -> Tensor:
        """Features [N, C] after so many iterations from the prior [N, C]."""
        diagonal = self.diagonal() + ridge
        solved = prior.clone()
        for first in range(0, prior.shape[1], BLOCK):
            channels = slice(first, first + BLOCK)
            rest = self.gradient(prior[:, channels], channels)
            solved[:, channels] += conjugate_gradients(
                lambda z: self.normal_product(z) + ridge * z, rest, diagonal, iterations
            )
        return solved

    def diagonal(self) -> Tensor:
        """Sum over all pixels of the squares of a Gaussian's weights, float32 [N]."""
        total = torch.zeros(len(self.reader.gaussians), device=self.reader.gaussians.device)
        for view, found, worth in self._maps():
            ones = FeatureMap("ones", dense=torch.ones(*found.size, 1), valid=_valid(found))
            total += worth * self._transpose(view, ones, "squared").weight
        return total

    def gradient(self, features: Tensor, channels: slice) -> Tensor:
        """A^T R (F - A X) for some channels, float32 [N, c]."""
        total = torch.zeros_like(features)
        for view, found, worth in self._maps():
            target, valid = map_at_pixels(found, view, channels, features.device)
            missed = target - self._render(view, found, features)
            difference = FeatureMap("difference", dense=missed, valid=valid)
            total += worth * self._transpose(view, difference).features
        return total

    def normal_product(self, features: Tensor) -> Tensor:
        """A^T R A X, float32 [N, c]."""
        total = torch.zeros_like(features)
        for view, found, worth in self._maps():
            rendered = FeatureMap("rendered", dense=self._render(view, found, features), valid=_valid(found))
            total += worth * self._transpose(view, rendered).features
        return total

    def _maps(self) -> Iterator[tuple[View, FeatureMap, float]]:
        """The views that have a map, with it and their worth."""
        for view in self.views:
            found = self.map_of(view)
            if found is not None:
                with self.reader.log.stage("solve"):
                    yield view, found, self.worth.get(view.stem, 1.0)
                self.done(view.stem)

    def map_of(self, view: View) -> FeatureMap | None:
        """The chosen channels of a view's map."""
        found = self.reader.read(view)
        if found is None or self.channels is None:
            return found
        if found.vectors is not None:
            return FeatureMap(found.space, ids=found.ids, vectors=found.vectors[:, self.channels])
        assert found.dense is not None
        return FeatureMap(found.space, dense=found.dense[..., self.channels], valid=found.valid)

    def _render(self, view: View, found: FeatureMap, features: Tensor) -> Tensor:
        camera = view.camera.resized(*found.size)
        return rasterize(self.reader.gaussians, camera, features.contiguous(), settings=self.reader.settings).features

    def _transpose(self, view: View, found: FeatureMap, mode: str = "weighted") -> LiftSums:
        gaussians = self.reader.gaussians
        sums = LiftSums.zeros(len(gaussians), found.channels, gaussians.device)
        camera = view.camera.resized(*found.size)
        options = {"settings": self.reader.settings, "deterministic": self.deterministic}
        lift_view(gaussians, camera, found, sums, mode=mode, **options)  # type: ignore[arg-type]
        return sums


def conjugate_gradients(
    product: Callable[[Tensor], Tensor], right: Tensor, diagonal: Tensor, iterations: int, tolerance: float = 1e-5
) -> Tensor:
    """Solve K z = right for each column, K symmetric positive definite, preconditioned with its diagonal.

    Args:
        product: K times columns, [N, c] -> [N, c].
        right: [N, c].
        diagonal: Of K, [N].
        iterations: At most so many.
        tolerance: Ends when every column's residual is so small against its right-hand side.
    """
    z, rest = torch.zeros_like(right), right.clone()
    scaled = rest / diagonal[:, None]
    direction, size = scaled.clone(), _dots(rest, scaled)
    enough = tolerance * tolerance * size
    for _ in range(iterations):
        if bool((size <= enough).all()):
            break
        image = product(direction)
        step = _ratio(size, _dots(direction, image))
        z += step * direction
        rest -= step * image
        scaled = rest / diagonal[:, None]
        before, size = size, _dots(rest, scaled)
        direction = scaled + _ratio(size, before) * direction
    return z


def _dots(a: Tensor, b: Tensor) -> Tensor:
    """Scalar product of each pair of columns, summed in float64, float32 [c]."""
    return torch.stack([torch.dot(a[:, k].double(), b[:, k].double()) for k in range(a.shape[1])]).to(a.dtype)


def _ratio(a: Tensor, b: Tensor) -> Tensor:
    return torch.where(b > 0, a / torch.where(b > 0, b, 1.0), 0.0)


def _valid(found: FeatureMap) -> Tensor | None:
    """Pixels of a map that carry semantics, bool [h, w]; None for all."""
    return (found.ids >= 0).any(dim=0) if found.ids is not None else found.valid


def map_at_pixels(found: FeatureMap, view: View, channels: slice, device: torch.device) -> tuple[Tensor, Tensor | None]:
    """Some channels of a map, zero where it says nothing, float32 [h, w, c], and where it does."""
    valid = _valid(found)
    if found.dense is not None:
        dense = found.dense[..., channels].to(device, torch.float32)
        return (dense if valid is None else torch.where(valid.to(device)[..., None], dense, 0.0)), valid
    h, w = found.size
    part = (
        found if found.vectors is None else FeatureMap(found.space, ids=found.ids, vectors=found.vectors[:, channels])
    )
    y, x = torch.meshgrid(torch.arange(h, device=device), torch.arange(w, device=device), indexing="ij")
    features, _ = read_at(part, view.camera.resized(h, w), y.flatten(), x.flatten())
    features = features if found.vectors is not None else features[:, channels]
    return features.view(h, w, -1), valid


def choose_ridge(problem: Problem, iterations: int) -> tuple[float, float]:
    """The ridge of RIDGES whose features fit views best that had no part in them.

    Returns:
        The ridge, and the mean residual over the held-out views with it; NaN if there are too few views to hold one
        out, where the ridge is the middle one.
    """
    held = problem.views[HOLD_OUT // 2 :: HOLD_OUT]
    rest = [view for view in problem.views if view not in held]
    middle = RIDGES[len(RIDGES) // 2]
    if not held or not rest:
        return middle, math.nan
    reader = problem.reader
    means, weight = _weighted(problem, rest)
    few = None
    if reader.kind[2] is None and means.shape[1] > CHANNELS_TO_CHOOSE:  # labels have few channels
        few = means.square().sum(dim=0).topk(CHANNELS_TO_CHOOSE).indices.cpu()
        means = means[:, few.to(means.device)]
    part = replace(problem, views=rest, channels=few)
    best = (middle, math.inf)
    for ridge in RIDGES:
        error = _missed(part, held, part.solve(means, ridge, iterations), weight)
        if error < best[1]:
            best = ridge, error
    return best if math.isfinite(best[1]) else (middle, math.nan)


def _weighted(problem: Problem, views: Sequence[View]) -> tuple[Tensor, Tensor]:
    """Weighted means over some views, float32 [N, C], and 1 where they see a Gaussian, float32 [N]."""
    reader = problem.reader
    sums = LiftSums.zeros(len(reader.gaussians), reader.kind[1], reader.gaussians.device)
    for view in views:
        found = reader.read(view)
        if found is not None:
            lift_view(
                *(reader.gaussians, view.camera, found, sums),
                settings=reader.settings,
                deterministic=problem.deterministic,
            )
    return sums.features / torch.where(sums.weight > 0, sums.weight, 1.0)[:, None], sums.weight.sign()


def _missed(problem: Problem, views: Sequence[View], features: Tensor, weight: Tensor) -> float:
    """Mean residual of features over some views; NaN if none has a map."""
    reader, errors = problem.reader, []
    for view in views:
        found = problem.map_of(view)
        if found is not None:
            errors.append(residual(reader.gaussians, view.camera, found, features, weight, reader.settings))
    return sum(errors) / len(errors) if errors else math.nan
