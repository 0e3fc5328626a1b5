"""The same tests on another device: `SGWARP_TEST_DEVICE=cuda make test` (or cuda:1, or `pretended` to try this file).

In a test module every public operation that works on tensors is replaced by one that moves its tensors to the device,
and its results back. Autograd passes through the moves, so leaves on the CPU get their gradients; what an operation
changes in place is copied back. Calls for the schedule of the CPU stay there. A test marked `cpu_only` is left alone,
and says why.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib
import os
from collections.abc import Callable
from types import ModuleType
from typing import Any

import pytest
import torch

NAME = os.environ.get("SGWARP_TEST_DEVICE", "cpu")
DEVICE = "cuda" if NAME == "pretended" else NAME

# Where an operation is defined: its names.
OPERATIONS = {
    "sgwarp.ops.splatting.forward": ("rasterize",),
    "sgwarp.ops.splatting.autograd": ("rasterize",),
    "sgwarp.ops.splatting.contributors": ("top_contributors",),
    "sgwarp.ops.splatting.lifting": ("lift_view",),
    "sgwarp.ops.planar.splats": ("composite_splats",),
    "sgwarp.ops.planar.projection": ("project_splats",),
    "sgwarp.ops.planar.pixel_lists": ("contributors_in_range", "composite_pairs"),
    "sgwarp.ops.sparse.convolution": ("sparse_conv",),
    "sgwarp.ops.sparse.normalization": ("convolve_and_normalize",),
    "sgwarp.ops.sparse.voxels": ("pack_voxels", "unpack_voxels", "key_points", "coarsen", "kernel_map"),
    "sgwarp.ops.adam": ("count_steps", "update", "note_gradients", "add_noise"),
    "sgwarp.ops.photometric": ("photometric_loss",),
    "sgwarp.ops.neighbors": ("mean_squared_neighbor_distance",),
    "sgwarp.ops.deformation": ("deformed",),
    "sgwarp.compat.gsplat.facade": (
        "rasterization",
        "fully_fused_projection",
        "isect_tiles",
        "isect_offset_encode",
        "rasterize_to_pixels",
        "rasterize_to_indices_in_range",
        "accumulate",
        "spherical_harmonics",
        "quat_scale_to_covar_preci",
    ),
    "sgwarp.compat.inria": ("dist2",),
    "sgwarp.rendering.renderer": ("render",),
    "sgwarp.rendering.strongest": ("render_strongest",),
    "sgwarp.querying.scoring": ("score_texts", "best_texts"),
    "sgwarp.querying.segmentation": ("segment", "localize", "splat_scores", "segment_votes"),
    "sgwarp.querying.scores": ("query", "relevancy", "evidence", "standardise"),
    "sgwarp.network.inputs": ("voxelize", "input_features"),
}
BY_OTHER_NAMES = {"sgwarp", "sgwarp.compat.gsplat", "sgwarp.compat.inria"}  # modules that hand on what others define
ON_THE_HOST = {"Camera", "View", "SplatJob"}
_busy = False


def each_tensor(value: Any, change: Callable[[torch.Tensor], torch.Tensor]) -> Any:
    """The value with every tensor in it changed: in containers, and in dataclasses of the package."""
    if isinstance(value, torch.Tensor):
        return change(value)
    if isinstance(value, tuple) and hasattr(value, "_fields"):
        return type(value)(*(each_tensor(v, change) for v in value))
    if isinstance(value, (list, tuple)):
        return type(value)(each_tensor(v, change) for v in value)
    if isinstance(value, dict):
        return {name: each_tensor(v, change) for name, v in value.items()}
    kind = type(value)
    if not dataclasses.is_dataclass(value) or not kind.__module__.startswith("sgwarp") or kind.__name__ in ON_THE_HOST:
        return value
    new = object.__new__(kind)  # without checks, some of which would wait for the device
    for field in dataclasses.fields(value):
        object.__setattr__(new, field.name, each_tensor(getattr(value, field.name), change))
    return new


def on_device(operation: Callable[..., Any]) -> Callable[..., Any]:
    """The operation with its tensors on the device; within another such call, the operation itself."""

    @functools.wraps(operation)
    def call(*args: Any, **kwargs: Any) -> Any:
        global _busy
        if _busy or kwargs.get("schedule") == "lanes":
            return operation(*args, **kwargs)
        there: dict[int, tuple[torch.Tensor, torch.Tensor]] = {}

        def move(tensor: torch.Tensor) -> torch.Tensor:
            return there.setdefault(id(tensor), (tensor, tensor.to(DEVICE)))[1]

        def back(tensor: torch.Tensor) -> torch.Tensor:
            same = next((mine for mine, moved in there.values() if moved is tensor), None)
            return tensor.cpu() if same is None else same

        _busy = True
        try:
            result = operation(*each_tensor(args, move), **each_tensor(kwargs, move))
        finally:
            _busy = False
        with torch.no_grad():
            for mine, moved in there.values():
                changed = not (mine.requires_grad or mine.is_inference()) and not torch.equal(mine, moved.cpu())
                if changed:  # else autograd would take what it keeps for its backward pass to be written over
                    mine.copy_(moved.cpu())
        return each_tensor(result, back)

    return call


def rasterizer_of(kind: Any) -> Any:
    """In place of `sgwarp.compat.inria.GaussianRasterizer`, whose settings hold tensors as well."""

    class Rasterizer:
        def __init__(self, raster_settings: Any) -> None:
            self.settings = raster_settings

        def __call__(self, *args: Any, **kwargs: Any) -> Any:
            return on_device(lambda settings, *a, **k: kind(settings)(*a, **k))(self.settings, *args, **kwargs)

        def markVisible(self, positions: torch.Tensor) -> Any:
            return on_device(lambda settings, points: kind(settings).markVisible(points))(self.settings, positions)

    return Rasterizer


def replace_operations(module: Any, patch: pytest.MonkeyPatch) -> None:
    """Put the operations that a test module names onto the device, also those it names by their modules."""
    kind = importlib.import_module("sgwarp.compat.inria").GaussianRasterizer
    replaced = {kind: rasterizer_of(kind)}
    for path, names in OPERATIONS.items():
        home = importlib.import_module(path)
        replaced |= {getattr(home, name): on_device(getattr(home, name)) for name in names}
    known = OPERATIONS.keys() | BY_OTHER_NAMES
    modules = [v for v in vars(module).values() if isinstance(v, ModuleType) and v.__name__ in known]
    for holder in (module, *modules):
        names = holder.__all__ if holder.__name__ == "sgwarp" else list(vars(holder))  # those of sgwarp load on use
        for name in names:
            value = getattr(holder, name)
            if callable(value) and isinstance(value.__hash__, Callable) and value in replaced:
                patch.setattr(holder, name, replaced[value])
