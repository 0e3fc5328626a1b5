"""Loading networks by transformers, from a folder or by their name on the hub, and preparing images for them.

Images are resized and normalised here, after the model's own preprocessor_config.json: the processors of transformers
would want torchvision or Pillow for it.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate

from sgwarp.errors import InputError
from sgwarp.files.documents import read_json

SAMPLE = 64  # numbers per tensor that tell one set of weights from another
WAYS = {0: "nearest-exact", 2: "bilinear", 3: "bicubic"}  # Pillow's numbers


def require(package: str, extra: str, what: str) -> Any:
    """Import a package of an extra.

    Raises:
        InputError: It is not installed; the message says how to install it.
    """
    try:
        return import_module(package)
    except ImportError as error:
        raise InputError(f'{what} needs the package {error.name or package}: pip install "sgwarp[{extra}]"') from None


def load_config(path: str, what: str, types: tuple[str, ...]) -> Any:
    """Configuration of a model whose type is one of `types`.

    Raises:
        InputError: It cannot be had, or is of another type.
    """
    transformers = require("transformers", "models", what)
    if path.startswith(("/", "./", "../", "~")) and not Path(path).expanduser().is_dir():
        raise InputError(f"{what}: {path}: no such folder")
    with _loading(path, what):
        config = transformers.AutoConfig.from_pretrained(path)
    if config.model_type not in types:
        raise InputError(f"{what}: {path} holds a model of type '{config.model_type}', not {' or '.join(types)}")
    return config


def load_model(name: str, path: str, what: str, device: str | torch.device) -> Any:
    """A model of transformers with its weights, ready to be asked.

    Args:
        name: Its class in transformers.
        path: Folder, or name on the hub.
        what: The encoder, for messages.
        device: Where it runs.

    Raises:
        InputError: The weights cannot be had, or some of them are missing and would be random.
    """
    transformers = require("transformers", "models", what)
    with _loading(path, what), no_progress_bar():
        model, info = getattr(transformers, name).from_pretrained(path, output_loading_info=True, dtype=torch.float32)
    missing = sorted(info["missing_keys"])
    wrong = sorted(str(key) for key in info.get("mismatched_keys", ()))
    if missing or wrong:
        listed = ", ".join((missing + wrong)[:3])
        raise InputError(f"{what}: {path} lacks {len(missing + wrong)} weights of {name}, such as {listed}")
    return model.eval().requires_grad_(False).to(device)


def load_tokenizer(path: str, what: str) -> Any:
    """The tokenizer that belongs to a model.

    Raises:
        InputError: It cannot be had.
    """
    transformers = require("transformers", "models", what)
    with _loading(path, what):
        return transformers.AutoTokenizer.from_pretrained(path)


@contextmanager
def _loading(path: str, what: str) -> Iterator[None]:
    """Turn what transformers, the hub and safetensors object to into one line."""
    try:
        yield
    except (OSError, ValueError, RuntimeError, KeyError, ImportError) as error:
        line = (str(error).strip().splitlines() or [type(error).__name__])[0]
        if not Path(path).exists():
            line += f"; without network, fetch it elsewhere (hf download {path} --local-dir DIR) and give the folder"
        raise InputError(f"{what}: {path} cannot be loaded ({line})") from None
    except Exception as error:
        if type(error).__module__.split(".")[0] not in ("safetensors", "huggingface_hub", "pickle", "_pickle"):
            raise
        raise InputError(f"{what}: {path} is damaged ({error}); fetch it again") from None


@contextmanager
def no_progress_bar() -> Iterator[None]:
    """Loading from disk is quick; the bar of transformers would stand between our own lines."""
    from transformers.utils import logging

    shown = logging.is_progress_bar_enabled()
    logging.disable_progress_bar()
    try:
        yield
    finally:
        if shown:
            logging.enable_progress_bar()


def identity_of_weights(weights: nn.Module | Mapping[str, Tensor], beginnings: tuple[str, ...] = ("",)) -> str:
    """Hash of the weights whose names begin with one of `beginnings`, 12 hex digits.

    The same weights have the same hash wherever they were loaded from; a few numbers of every tensor are read.
    """
    named = weights.state_dict() if isinstance(weights, nn.Module) else weights
    digest = hashlib.sha256()
    for name in sorted(key for key in named if key.startswith(beginnings)):
        values = named[name].detach().flatten()
        step = max(1, len(values) // SAMPLE)
        digest.update(f"{name}{list(named[name].shape)}".encode())
        digest.update(values[::step].to("cpu", torch.float32).numpy().tobytes())
    return digest.hexdigest()[:12]


@dataclass(frozen=True)
class Preparation:
    """Image preprocessing of a model.

    Attributes:
        mean, deviation: Of the values in [0, 1], per channel.
        size: The "size" of preprocessor_config.json, such as {"height": 224, "width": 224}.
        way: Interpolation.
    """

    mean: tuple[float, ...] = (0.5, 0.5, 0.5)
    deviation: tuple[float, ...] = (0.5, 0.5, 0.5)
    size: tuple[tuple[str, int], ...] = ()
    way: str = "bicubic"

    @classmethod
    def load(cls, path: str, what: str) -> Preparation:
        """Read preprocessor_config.json, or the newer processor_config.json that contains it.

        Raises:
            InputError: There is neither.
        """
        require("transformers", "models", what)
        from transformers.utils.hub import cached_file

        content: dict[str, Any] = {}
        for name in ("preprocessor_config.json", "processor_config.json"):
            with _loading(path, what):
                found = cached_file(
                    path, name, _raise_exceptions_for_missing_entries=False, _raise_exceptions_for_gated_repo=False
                )
            if found:
                stored = read_json(found, f"fetch {what} again")
                content = stored.get("image_processor", stored) if isinstance(stored, Mapping) else {}
            if "image_mean" in content:
                break
        else:
            raise InputError(f"{what}: {path} holds no preprocessor_config.json, which says how to prepare images")
        size = content.get("size") or {}
        size = {"shortest_edge": size} if isinstance(size, int) else size
        try:
            mean, deviation = (tuple(map(float, content[key])) for key in ("image_mean", "image_std"))
            sides = tuple(sorted((key, int(value)) for key, value in size.items() if value is not None))
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise InputError(f"{what}: {found} does not say how to prepare images ({error!r})") from None
        return cls(mean, deviation, sides, WAYS.get(content.get("resample", 3), "bicubic"))

    @property
    def side(self) -> int | None:
        """Side of the square the model wants, if its configuration gives one."""
        size = dict(self.size)
        return size.get("height") or size.get("shortest_edge")

    def resize(self, images: Tensor, height: int, width: int) -> Tensor:
        """Images, float32 [B, 3, H, W] in [0, 1], at another size, antialiased."""
        if tuple(images.shape[2:]) == (height, width):
            return images
        smooth = {"antialias": True, "align_corners": False} if self.way != "nearest-exact" else {}
        return interpolate(images, (height, width), mode=self.way, **smooth).clamp(0.0, 1.0)

    def normalise(self, images: Tensor) -> Tensor:
        """Values in [0, 1], [B, 3, H, W], as the model was trained on them."""
        mean, deviation = (torch.tensor(v, device=images.device)[:, None, None] for v in (self.mean, self.deviation))
        return (images - mean) / deviation


def channels_first(images: Tensor, device: str | torch.device) -> Tensor:
    """Images as float32 [B, 3, H, W] in [0, 1] on a device, from [B, H, W, 3] or one [H, W, 3], uint8 or floating."""
    batch = images if images.ndim == 4 else images[None]
    moved = batch.to(device).permute(0, 3, 1, 2)
    return moved.to(torch.float32) / 255.0 if images.dtype == torch.uint8 else moved.to(torch.float32)


def fitted(height: int, width: int, longest: int, multiple: int) -> tuple[int, int]:
    """Size of an image whose longest side is `longest`, both sides rounded to a positive multiple."""
    scale = longest / max(height, width)
    high, wide = (max(1, round(side * scale / multiple)) * multiple for side in (height, width))
    return high, wide
