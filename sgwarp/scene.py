"""The scene types every stage speaks: Gaussians, Camera, View, FeatureMap, Semantics.

All are frozen and validated once, at construction. World coordinates are metres where known, cameras follow OpenCV
(x right, y down, z forward), quaternions are (w, x, y, z), pixel centres lie at .5.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from sgwarp.errors import InputError

SH_COUNTS = (1, 4, 9, 16)  # coefficients per colour for degree 0..3


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise InputError(message)


def _float32(name: str, value: Any, shape: tuple[int | None, ...]) -> Tensor:
    """Convert to a contiguous float32 tensor of `shape` (None matches any size)."""
    tensor = torch.as_tensor(value)
    _require(tensor.is_floating_point(), f"{name}: expected floating point values, got {tensor.dtype}")
    fits = tensor.ndim == len(shape) and all(w is None or w == s for w, s in zip(shape, tensor.shape, strict=False))
    wanted = ", ".join("any" if s is None else str(s) for s in shape)
    _require(fits, f"{name}: expected shape [{wanted}], got {list(tensor.shape)}")
    return tensor.to(torch.float32).contiguous()


def _version(*tensors: Tensor) -> tuple[int, ...]:
    """Changes whenever one of the tensors is written to in place."""
    return tuple(0 if tensor.is_inference() else tensor._version for tensor in tensors)


def _first_bad(name: str, bad: Tensor, rule: str, values: Tensor) -> None:
    """Raise naming the first row where `bad` is set."""
    rows = bad.flatten(1).any(dim=1) if bad.ndim > 1 else bad  # reshape(0, -1) is ambiguous
    if bool(rows.any()):
        index = int(rows.nonzero()[0])
        raise InputError(f"{name}[{index}] = {values[index].tolist()}: {rule} ({int(rows.sum())} such rows)")


@dataclass(frozen=True, eq=False)
class Gaussians:
    """A 3D Gaussian scene with activated parameters.

    Attributes:
        means: Centres [m], float32 [N, 3].
        quats: Rotations (w, x, y, z), normalised by the renderer, float32 [N, 4].
        scales: Standard deviations along the local axes [m], not logarithms, float32 [N, 3].
        opacities: In [0, 1], not logits, float32 [N].
        sh: Spherical-harmonic colour coefficients, float32 [N, K, 3], K in 1, 4, 9, 16 (degree 0 to 3).

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

    def __post_init__(self) -> None:
        put = object.__setattr__
        put(self, "means", _float32("means", self.means, (None, 3)))
        n = len(self.means)
        put(self, "quats", _float32("quats", self.quats, (n, 4)))
        put(self, "scales", _float32("scales", self.scales, (n, 3)))
        put(self, "opacities", _float32("opacities", self.opacities, (n,)))
        put(self, "sh", _float32("sh", self.sh, (n, None, 3)))
        _require(
            self.sh.shape[1] in SH_COUNTS,
            f"sh: expected 1, 4, 9 or 16 coefficients per colour, got {self.sh.shape[1]}",
        )
        devices = {name: getattr(self, name).device for name in ("means", "quats", "scales", "opacities", "sh")}
        _require(len(set(devices.values())) == 1, f"all fields must be on one device, got {devices}")
        _first_bad("scales", self.scales < 0, "a scale is a standard deviation and cannot be negative", self.scales)
        outside = (self.opacities < 0) | (self.opacities > 1)
        _first_bad("opacities", outside, "expected a value in [0, 1]; apply the sigmoid to logits", self.opacities)

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
        """What `find` says of the tensors, remembered until one of them is written to."""
        version = _version(*tensors)
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
        return torch.stack([torch.isfinite(f).all(dim=1) for f in flat]).all(dim=0)

    @property
    def colors_may_be_non_finite(self) -> bool:
        """Whether some colour coefficient might hold NaN or infinity; one sum over them tells, in one pass."""
        may_be: bool = self._known(
            "colors_may_be_non_finite", (self.sh,), lambda: not bool(torch.isfinite(self.sh.detach().sum()))
        )
        return may_be

    @property
    def non_finite(self) -> int:
        """How many rows hold NaN or infinity; the renderer leaves them out."""
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
        return self._map(lambda t: t.to(device))

    def subset(self, index: Tensor) -> Gaussians:
        """The Gaussians at `index` (integers or a boolean mask)."""
        return self._map(lambda t: t[index])

    def _map(self, change: Callable[[Tensor], Tensor]) -> Gaussians:
        names = ("means", "quats", "scales", "opacities", "sh")
        return Gaussians(**{name: change(getattr(self, name)) for name in names})


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera.

    Attributes:
        K: Intrinsics with the real principal point [pixels], float64 [3, 3].
        world_to_camera: Rigid transform, OpenCV axes, float64 [4, 4].
        width, height: Image size [pixels].
        near, far: Range of depth along the optical axis that is rendered [m].

    Raises:
        InputError: K is singular or not a pinhole matrix, the pose is not rigid, the size not positive.
    """

    K: Tensor
    world_to_camera: Tensor
    width: int
    height: int
    near: float = 0.01
    far: float = 1e10

    def __post_init__(self) -> None:
        put = object.__setattr__
        # Copies: a caller may go on using the tensors, a rendering's backward pass still needs the camera.
        K = torch.as_tensor(self.K, dtype=torch.float64).detach().cpu().clone()
        pose = torch.as_tensor(self.world_to_camera, dtype=torch.float64).detach().cpu().clone()
        _require(K.shape == (3, 3), f"K: expected shape [3, 3], got {list(K.shape)}")
        _require(pose.shape == (4, 4), f"world_to_camera: expected shape [4, 4], got {list(pose.shape)}")
        _require(bool(torch.isfinite(K).all()), "K: holds NaN or infinity")
        _require(bool(torch.isfinite(pose).all()), "world_to_camera: holds NaN or infinity")
        bottom = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
        _require(bool((K[2] == bottom).all()), f"K: last row must be [0, 0, 1], got {K[2].tolist()}")
        focal = f"fx = {K[0, 0].item():g}, fy = {K[1, 1].item():g}"
        _require(bool((K.diagonal() > 0).all()), f"K: singular or mirrored ({focal}); focal lengths must be positive")
        _require(bool(K[0, 1] == 0) and bool(K[1, 0] == 0), "K: skew is not supported; rectify the images first")
        R = pose[:3, :3]
        error = (R @ R.T - torch.eye(3, dtype=torch.float64)).abs().max().item()
        _require(error < 1e-3, f"world_to_camera: not a rigid transform (R Rt differs from I by {error:.2g})")
        _require(bool(torch.linalg.det(R) > 0), "world_to_camera: mirrors the world (determinant -1)")
        affine = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64)
        _require(bool((pose[3] == affine).all()), "world_to_camera: last row must be [0, 0, 0, 1]")
        whole = self.width == int(self.width) and self.height == int(self.height)
        _require(whole, f"image size: expected whole pixels, got {self.width} x {self.height}")
        _require(self.width > 0 and self.height > 0, f"image size must be positive, got {self.width} x {self.height}")
        _require(0 < self.near < self.far, f"near: expected 0 < near < far, got {self.near} and {self.far}")
        put(self, "K", K)
        put(self, "world_to_camera", pose)
        put(self, "width", int(self.width))
        put(self, "height", int(self.height))

    @property
    def position(self) -> Tensor:
        """Camera centre in the world [m], float64 [3]."""
        return -self.world_to_camera[:3, :3].T @ self.world_to_camera[:3, 3]

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) [pixels], as tensors are shaped."""
        return self.height, self.width

    def resized(self, height: int, width: int) -> Camera:
        """The same view at another resolution."""
        scale = torch.tensor([[width / self.width], [height / self.height], [1.0]], dtype=torch.float64)
        return replace(self, K=self.K * scale, width=width, height=height)


@dataclass(frozen=True, eq=False)
class View:
    """A camera with the name and, where there is one, the photograph it took.

    Attributes:
        stem: Name without folder or extension; label images and feature files are matched by it.
        camera: The (undistorted) pinhole camera.
        image_path: The photograph, or None: then it is rendered from the scene where one is needed.
        undistort: Maps the photograph as stored, uint8 [H, W, 3], to the pinhole image; None if there is nothing to do.
    """

    stem: str
    camera: Camera
    image_path: Path | None = None
    undistort: Callable[[Any], Any] | None = field(default=None, repr=False)

    def image(self) -> Tensor:
        """Read the photograph, float32 [H, W, 3] in [0, 1].

        Raises:
            InputError: There is none, it cannot be read, or its size is not the camera's.
        """
        from sgwarp.io.images import read_rgb

        if self.image_path is None:
            raise InputError(f"view {self.stem}: has no photograph; render one from the scene")
        pixels = read_rgb(self.image_path)
        if self.undistort is not None:
            pixels = self.undistort(pixels)
        if pixels.shape[:2] != self.camera.size:
            got, want = f"{pixels.shape[1]} x {pixels.shape[0]}", f"{self.camera.width} x {self.camera.height}"
            raise InputError(f"{self.image_path}: image is {got}, its camera says {want}; resize one of them")
        return torch.from_numpy(pixels).to(torch.float32) / 255.0


@dataclass(frozen=True, eq=False)
class FeatureMap:
    """2D semantics of one view: dense vectors, or an id map with one vector per id.

    Attributes:
        space: Name of the embedding space (model and dimension); two spaces never mix.
        dense: Features, floating point [h, w, C], or None.
        valid: Pixels of `dense` that carry semantics, bool [h, w], or None for all.
        ids: Row of `vectors` seen at each pixel, per level, int32 [L, h, w], -1 where there is none; or None.
        vectors: One feature per id, float32 [M, C]. None means one-hot: id k is channel k of `labels`.
        labels: Names of the one-hot channels, length C; the same for every view of a scene.

    The map may be smaller than the image; it is then read at the nearest (ids) or bilinear (dense) position.
    """

    space: str
    dense: Tensor | None = None
    valid: Tensor | None = None
    ids: Tensor | None = None
    vectors: Tensor | None = None
    labels: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        put = object.__setattr__
        _require(bool(self.space), "space: a feature map must name its embedding space")
        _require((self.dense is None) != (self.ids is None), "give either dense features or ids, not both or none")
        if self.dense is not None:
            dense = torch.as_tensor(self.dense)
            ok = dense.ndim == 3 and dense.is_floating_point() and dense.numel() > 0
            _require(ok, f"dense: expected floating point [h, w, C], got {dense.dtype} {list(dense.shape)}")
            put(self, "dense", dense)
            if self.valid is not None:
                valid = torch.as_tensor(self.valid, dtype=torch.bool)
                fits = valid.shape == dense.shape[:2]
                _require(fits, f"valid: expected {list(dense.shape[:2])}, got {list(valid.shape)}")
                put(self, "valid", valid)
            return
        ids = torch.as_tensor(self.ids)
        _require(not ids.is_floating_point(), f"ids: expected integers, got {ids.dtype}")
        ids = ids[None] if ids.ndim == 2 else ids
        _require(ids.ndim == 3 and ids.numel() > 0, f"ids: expected shape [L, h, w], got {list(ids.shape)}")
        put(self, "ids", ids.to(torch.int32).contiguous())
        _require((self.vectors is None) != (self.labels is None), "ids: give either vectors or labels")
        if self.vectors is not None:
            put(self, "vectors", _float32("vectors", self.vectors, (None, None)))
        count = len(self.vectors) if self.vectors is not None else len(self.labels or ())
        top, low = int(self.ids.max()), int(self.ids.min())  # type: ignore[union-attr]
        _require(low >= -1 and top < count, f"ids: expected -1 to {count - 1}, got {low} to {top}")

    @property
    def channels(self) -> int:
        if self.dense is not None:
            return self.dense.shape[2]
        return self.vectors.shape[1] if self.vectors is not None else len(self.labels or ())

    @property
    def size(self) -> tuple[int, int]:
        """(h, w) of the map."""
        shape = self.dense.shape[:2] if self.dense is not None else self.ids.shape[1:]  # type: ignore[union-attr]
        return int(shape[0]), int(shape[1])


@dataclass(frozen=True, eq=False)
class Semantics:
    """The semantic component of a scene's Gaussians.

    Attributes:
        features: Mean of the lifted features, float32 or float16 [N, C]; zero where nothing was seen.
        weight: Sum of alpha T (weighted) or number of views (center) behind each feature, float32 [N].
        effective_views: (sum_v w)^2 / sum_v w^2, how many views share that weight, float32 [N].
        space: Name of the embedding space.
        fingerprint: `Gaussians.fingerprint` of the scene.
        labels: Names of the channels if the features are one-hot lifted ids, else None.
    """

    features: Tensor
    weight: Tensor
    effective_views: Tensor
    space: str
    fingerprint: str
    labels: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        put = object.__setattr__
        features = torch.as_tensor(self.features)
        ok = features.ndim == 2 and features.is_floating_point()
        _require(ok, f"features: expected floating point [N, C], got {features.dtype} {list(features.shape)}")
        put(self, "features", features)
        n = len(features)
        put(self, "weight", _float32("weight", self.weight, (n,)))
        put(self, "effective_views", _float32("effective_views", self.effective_views, (n,)))
        _require(bool(self.space), "space: must name the embedding space")
        if self.labels is not None:
            named, channels = len(self.labels), features.shape[1]
            _require(named == channels, f"labels: expected {channels}, got {named}")

    def __len__(self) -> int:
        return len(self.features)

    @property
    def seen(self) -> Tensor:
        """Gaussians that at least one view saw, bool [N]."""
        return self.weight > 0

    @property
    def coverage(self) -> float:
        """Share of the Gaussians that at least one view saw."""
        return float(self.seen.float().mean()) if len(self) else 0.0

    def require_scene(self, gaussians: Gaussians) -> None:
        """Raise InputError if these features belong to another scene."""
        _require(
            self.fingerprint == gaussians.fingerprint,
            f"semantics belong to scene {self.fingerprint}, this scene is {gaussians.fingerprint}; lift it again",
        )

    def require_space(self, space: str) -> None:
        """Raise InputError if a query or feature map lives in another space."""
        _require(self.space == space, f"space '{space}' cannot be compared with semantics in space '{self.space}'")
