"""Weights from elsewhere: files of MinkowskiEngine networks, their prefixes, and what to say when they do not fit."""

from __future__ import annotations

import os
from functools import lru_cache
from pathlib import Path

import torch
from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.files.tensors import read_tensors
from sgwarp.files.torch_files import load_torch
from sgwarp.network.layers.mink_unet import ARCHITECTURES, MinkUNet

PREFIXES = ("module.", "net3d.")  # of DistributedDataParallel and of OpenScene
SHOWN = 3  # names of each kind in a message


def read_weights(path: str | os.PathLike[str]) -> dict[str, Tensor]:
    """State dict of a file: .safetensors, or what torch.save wrote, bare or under "state_dict"; prefixes removed.

    Raises:
        InputError: The file is missing or damaged, or holds no tensors by name.
    """
    if Path(path).suffix == ".safetensors":
        return without_prefixes(read_tensors(path)[1])
    content = load_torch(path)
    for name in ("state_dict", "model_state_dict", "model"):
        if isinstance(content, dict) and isinstance(content.get(name), dict):
            content = content[name]
    tensors = isinstance(content, dict) and all(isinstance(value, Tensor) for value in content.values())
    if not tensors or not content:
        raise InputError(f"{path}: holds no tensors by name; save the network's state_dict")
    return without_prefixes(content)


def without_prefixes(state: dict[str, Tensor]) -> dict[str, Tensor]:
    """The same under names without the prefixes that all of them share."""
    while prefix := next((p for p in PREFIXES if state and all(name.startswith(p) for name in state)), ""):
        state = {name.removeprefix(prefix): tensor for name, tensor in state.items()}
    return state


def difference(state: dict[str, Tensor], net: MinkUNet) -> str:
    """Differences between a state dict and a network, in one line; empty if it fits."""
    wanted = net.state_dict()
    missing = [name for name in wanted if name not in state]
    unknown = [name for name in state if name not in wanted]
    shapes = [
        f"{name} {list(state[name].shape)} instead of {list(tensor.shape)}"
        for name, tensor in wanted.items()
        if name in state and state[name].shape != tensor.shape
    ]
    parts = []
    for count, what in ((missing, "missing"), (unknown, "unknown"), (shapes, "of another shape")):
        if count:
            some = ", ".join(count[:SHOWN]) + (", ..." if len(count) > SHOWN else "")
            parts.append(f"{len(count)} {what}: {some}")
    return "; ".join(parts)


@lru_cache(maxsize=8)
def _bare(in_channels: int, out_channels: int, arch: str) -> MinkUNet:
    """A network without memory for its weights, to compare with."""
    with torch.device("meta"):
        return MinkUNet(in_channels, out_channels, arch)


def net_for(state: dict[str, Tensor], path: str | os.PathLike[str] = "checkpoint") -> MinkUNet:
    """The network that a state dict belongs to, with its weights.

    Raises:
        InputError: It fits no architecture; the message compares it with the nearest.
    """
    first, last = state.get("conv0p1s1.kernel"), state.get("final.kernel")
    if first is None or last is None or first.ndim != 3 or last.ndim != 2:
        some = ", ".join(list(state)[:SHOWN])
        raise InputError(f"{path}: is no MinkUNet, which has conv0p1s1.kernel and final.kernel; it holds {some}, ...")
    misses: dict[str, tuple[int, str]] = {}
    for arch in ARCHITECTURES:
        net = _bare(first.shape[1], last.shape[1], arch)
        text = difference(state, net)
        if not text:
            net = MinkUNet(first.shape[1], last.shape[1], arch)
            net.load_state_dict(state)
            return net
        names = net.state_dict().keys()
        shapes = sum(tuple(state[n].shape) != tuple(t.shape) for n, t in net.state_dict().items() if n in state)
        misses[arch] = (len(names ^ state.keys()) + shapes, text)
    nearest = min(misses, key=lambda arch: misses[arch][0])
    raise InputError(f"{path}: fits none of {', '.join(ARCHITECTURES)}; against {nearest}: {misses[nearest][1]}")


def load_into(net: MinkUNet, state: dict[str, Tensor], path: str | os.PathLike[str] = "checkpoint") -> None:
    """Give a network the weights of a state dict.

    Raises:
        InputError: They do not fit; the message lists what is missing, unknown and of another shape.
    """
    text = difference(state, net)
    if text:
        raise InputError(f"{path}: does not fit MinkUNet{net.arch} {net.in_channels} -> {net.out_channels}: {text}")
    net.load_state_dict(state)
