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
    "sgwarp.querying.segmentation": ("segment", "localize", "splat_scores", "segment_votes"),
    "sgwarp.querying.scores": ("query", "relevancy"),
    "sgwarp.network.inputs": ("voxelize", "input_features"),
}
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
                if not mine.requires_grad and not mine.is_inference():
                    mine.copy_(moved.cpu())
        return each_tensor(result, back)

    return call


def replace_operations(module: Any, patch: pytest.MonkeyPatch) -> None:
    """Put the operations that a test module names onto the device, also those it names by their modules."""
    replaced = {}
    for path, names in OPERATIONS.items():
        home = importlib.import_module(path)
        replaced |= {getattr(home, name): on_device(getattr(home, name)) for name in names}
    modules = [value for value in vars(module).values() if getattr(value, "__name__", None) in OPERATIONS]
    for holder in (module, *modules):
        for name, value in list(vars(holder).items()):
            if callable(value) and isinstance(value.__hash__, Callable) and value in replaced:
                patch.setattr(holder, name, replaced[value])
