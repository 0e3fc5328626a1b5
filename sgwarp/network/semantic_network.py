"""A trained semantic network with all that belongs to it, and its file.

The file is safetensors: the weights under MinkowskiEngine's names; in the metadata format, version, architecture, input
mode, voxel size, embedding space, labels, and notes as JSON.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from sgwarp.errors import InputError
from sgwarp.files.documents import parse_json
from sgwarp.files.tensors import read_tensors, write_tensors
from sgwarp.network.checkpoint import net_for, read_weights
from sgwarp.network.inputs import INPUT_CHANNELS, InputMode
from sgwarp.network.layers.mink_unet import MinkUNet

FORMAT = "sgwarp-network"
VERSION = 1


@dataclass(frozen=True, eq=False)
class SemanticNetwork:
    """The 3D semantic network, which predicts features from Gaussians (paper, Sec. III-C).

    Attributes:
        net: The U-Net.
        inputs: What it sees of a Gaussian, see `input_features`.
        voxel: Side of its voxels [m].
        space: Embedding space of its output.
        labels: Names of the output channels, if they are labels.
    """

    net: MinkUNet
    inputs: InputMode
    voxel: float
    space: str
    labels: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        if self.inputs not in INPUT_CHANNELS:
            raise InputError(f"inputs '{self.inputs}' do not exist; there are {', '.join(INPUT_CHANNELS)}")
        wanted = INPUT_CHANNELS[self.inputs]
        if self.net.in_channels != wanted:
            fitting = [mode for mode, channels in INPUT_CHANNELS.items() if channels == self.net.in_channels]
            hint = f"choose inputs {fitting[0]}" if fitting else "it was trained for other inputs"
            raise InputError(f"inputs '{self.inputs}' are {wanted}, the network takes {self.net.in_channels}; {hint}")
        if self.labels is not None and len(self.labels) != self.net.out_channels:
            raise InputError(f"labels: {len(self.labels)} names for {self.net.out_channels} output channels")

    @property
    def device(self) -> torch.device:
        return self.net.final.kernel.device

    def to(self, device: str | torch.device) -> SemanticNetwork:
        """The same network; its weights move."""
        self.net.to(device)
        return self


def save_network(
    network: SemanticNetwork, path: str | os.PathLike[str], notes: Mapping[str, Any] | None = None
) -> None:
    """Write a network; `load_network` reads it back.

    Raises:
        InputError: The name does not end in .safetensors, or it cannot be written.
    """
    if Path(path).suffix != ".safetensors":
        raise InputError(f"{path}: networks are written as .safetensors; change the name")
    metadata = {
        "format": FORMAT,
        "version": str(VERSION),
        "arch": network.net.arch,
        "inputs": network.inputs,
        "voxel": repr(network.voxel),
        "space": network.space,
        "labels": json.dumps(network.labels),
        "notes": json.dumps(dict(notes or {})),
    }
    write_tensors(path, network.net.state_dict(), metadata)


def load_network(
    path: str | os.PathLike[str],
    *,
    inputs: InputMode | None = None,
    voxel: float | None = None,
    space: str | None = None,
) -> SemanticNetwork:
    """Read a network that `save_network` wrote, or the checkpoint of a MinkowskiEngine network.

    Args:
        path: .safetensors, or a file of torch.save.
        inputs: Input mode, which a checkpoint does not store; by default the only mode with its number of channels.
        voxel: Edge of a voxel [m], 0.02 for a checkpoint. Must not contradict what the file stores.
        space: Embedding space of the output, by default the file's name. Must not contradict what the file stores.

    Raises:
        InputError: The file cannot be read or fits no architecture, or an argument contradicts it.
    """
    state = read_weights(path)
    metadata = _metadata(path)
    net = net_for(state, path)
    if metadata is None:
        fitting = [mode for mode, channels in INPUT_CHANNELS.items() if channels == net.in_channels]
        if inputs is None and len(fitting) > 1:
            raise InputError(
                f"{path}: takes {net.in_channels} channels, which may be {', '.join(fitting)}, and does not say which; "
                "name its inputs (OpenScene's networks take ones, or signed-rgb if trained with input_color)"
            )
        chosen = inputs or (fitting[0] if fitting else "raw56")
        return SemanticNetwork(net, chosen, 0.02 if voxel is None else voxel, space or Path(path).stem)  # type: ignore[arg-type]
    try:
        stored: dict[str, Any] = {name: metadata[name] for name in ("inputs", "space")}
        stored["voxel"] = float(metadata["voxel"])
        labels = parse_json(f"{path}: labels", metadata["labels"], "train it again")
        if not (labels is None or isinstance(labels, list)):
            raise ValueError("labels that are no list")
    except (KeyError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: its metadata is damaged ({error!r}); train it again") from None
    for name, value in (("inputs", inputs), ("voxel", voxel), ("space", space)):
        if value is not None and value != stored[name]:
            raise InputError(f"{path}: was trained with {name} {stored[name]}, not {value}; leave that option out")
    return SemanticNetwork(net, **stored, labels=None if labels is None else tuple(map(str, labels)))


def _metadata(path: str | os.PathLike[str]) -> dict[str, str] | None:
    """Metadata of a file of ours, None for any other."""
    if Path(path).suffix != ".safetensors":
        return None
    metadata, _ = read_tensors(path, ())
    if metadata.get("format") != FORMAT:
        return None
    if metadata.get("version") != str(VERSION):
        raise InputError(f"{path}: has version {metadata.get('version')}, this program reads {VERSION}; update it")
    return metadata
