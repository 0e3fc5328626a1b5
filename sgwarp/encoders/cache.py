"""Feature maps on disk, so that a view is encoded once: a second lift of the same views runs no network.

A map is found by the content of its image and by all that its encoder depends on (settings, a hash of the weights, the
content of files it reads). It is stored as the id map it is, ids in as few bytes as they need, vectors in half
precision; maps come back rounded the same way on the first run as on later ones. Files appear whole or not at all, a
damaged one is encoded again, and above a limit the maps that were not used for longest go first.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import shutil
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sgwarp.encoders.base import MapSource, TextEncoder
from sgwarp.errors import InputError
from sgwarp.files.arrays import read_arrays
from sgwarp.files.atomic import TEMPORARY, atomic_path, remove_leftovers
from sgwarp.files.documents import parse_json
from sgwarp.files.inputs import own_files
from sgwarp.scene import FeatureMap, View
from sgwarp.version import __version__

SUFFIX = ".map.npz"
DEFAULT_LIMIT = 10.0  # gigabytes
HALF_MAX, HALF_MIN = 65504.0, 2.0**-14  # between them rounding to half precision is relative
GIGABYTE = 1e9


def default_folder() -> Path:
    """$SGWARP_CACHE, or where caches belong on this platform."""
    chosen = os.environ.get("SGWARP_CACHE")
    if chosen:
        return Path(chosen)
    if sys.platform == "darwin":
        base = Path.home() / "Library" / "Caches"
    elif sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local")
    else:
        base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return base / "sgwarp" / "maps"


class CachedMaps:
    """A MapSource that remembers the maps of another.

    Args:
        source: Makes the maps. One without `cache_key(view) -> str | None`, or that gives None, is always asked.
        folder: Where the maps are kept.
        limit: Their size together, at most [gigabytes].

    Attributes:
        hits: Maps that came from the cache so far.

    Raises:
        InputError: The folder cannot be written to, or the limit is not positive.
    """

    def __init__(
        self, source: MapSource, folder: str | os.PathLike[str] | None = None, limit: float = DEFAULT_LIMIT
    ) -> None:
        if not limit > 0:
            raise InputError(f"cache: expected a limit above 0 gigabytes, got {limit}")
        self.source, self.limit = source, limit
        self.folder = default_folder() if folder is None else Path(folder)
        self.space, self.needs_image = source.space, source.needs_image
        self.hits = 0
        self._told = False
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            reason = error.strerror or error
            raise InputError(f"cache {self.folder}: cannot be made ({reason}); choose another, or none") from None

    def has_map(self, view: View) -> bool:
        """As of the source."""
        known = getattr(self.source, "has_map", None)
        return known is None or bool(known(view))

    def encode(self, view: View, image: Tensor | None) -> FeatureMap:
        """The map of a view, from the cache if it is there."""
        key = getattr(self.source, "cache_key", lambda view: None)(view)
        if key is None or image is None:
            return self.source.encode(view, image)
        name = self._name(key, image)
        path = self.folder / f"{name}{SUFFIX}"
        stored = _read(path, name)
        if stored is None:
            stored = pack(self.source.encode(view, image), name)
            self._write(path, stored)
        else:
            self.hits += 1
            with suppress(OSError):  # another process may have removed it, or the folder is write protected
                os.utime(path)
        return unpack(stored)

    def encode_text(self, texts: Sequence[str]) -> Tensor:
        """As of the source.

        Raises:
            InputError: It has no text side.
        """
        if not isinstance(self.source, TextEncoder):
            raise InputError(f"space '{self.space}' has no text side here")
        return self.source.encode_text(texts)

    @staticmethod
    def _name(key: str, image: Tensor) -> str:
        pixels = image.detach().to("cpu").contiguous()
        digest = hashlib.blake2b(f"{__version__}|{key}|{pixels.dtype}{list(pixels.shape)}".encode(), digest_size=20)
        digest.update(pixels.numpy().tobytes())
        return digest.hexdigest()

    def _write(self, path: Path, stored: dict[str, NDArray[Any]]) -> None:
        # Ids compress a hundredfold; features hardly, and slowly.
        save = np.savez if "dense" in stored else np.savez_compressed
        try:
            if path.is_dir():
                shutil.rmtree(path)
            with atomic_path(path, durable=False) as temporary:
                save(temporary, **stored)  # type: ignore[arg-type]
            shrink(self.folder, self.limit, keep=path)
        except (InputError, OSError) as error:
            if not self._told:  # what was encoded is not lost: the lift goes on without its cache
                logging.getLogger("sgwarp").warning("cache %s: maps are not kept (%s)", self.folder, error)
            self._told = True


def shrink(folder: Path, limit: float, keep: Path | None = None) -> None:
    """Remove the maps that were not used for longest until the rest is within `limit` gigabytes; `keep` stays.

    What killed processes left goes first, and what others are writing counts.
    """
    remove_leftovers(folder)
    entries = []
    for path in folder.iterdir():
        if not path.name.endswith(SUFFIX) and not TEMPORARY.fullmatch(path.name):
            continue
        try:
            facts = path.stat()
        except FileNotFoundError:  # somebody else shrinks too
            continue
        entries.append((facts.st_mtime_ns, facts.st_size, path))
    total = sum(size for _, size, _ in entries)
    for _, size, path in sorted(entries, key=lambda entry: entry[:2]):
        if total <= limit * GIGABYTE:
            return
        if path != keep and path.name.endswith(SUFFIX):
            with suppress(OSError):
                path.unlink(missing_ok=True)
                total -= size


def pack(found: FeatureMap, name: str = "") -> dict[str, NDArray[Any]]:
    """A feature map as arrays to be stored, under the name that says what it was made from."""
    header = {"space": found.space, "labels": found.labels, "name": name}
    arrays: dict[str, NDArray[Any]] = {"header": np.frombuffer(json.dumps(header).encode(), np.uint8)}
    if found.dense is not None:
        arrays["dense"] = _half(found.dense)
        if found.valid is not None:
            arrays["valid"] = found.valid.cpu().numpy()
    else:
        assert found.ids is not None
        ids = found.ids.cpu().numpy()
        kind = next(kind for kind in (np.int8, np.int16, np.int32) if ids.max() <= np.iinfo(kind).max)
        arrays["ids"] = ids.astype(kind)
        if found.vectors is not None:
            arrays["vectors"] = _half(found.vectors)
    return arrays


def unpack(stored: dict[str, NDArray[Any]]) -> FeatureMap:
    """The feature map that `pack` took apart.

    Raises:
        InputError, KeyError, ValueError: The arrays do not belong to one.
    """
    header = _header(stored)
    tensors = {name: torch.from_numpy(values) for name, values in stored.items() if name != "header"}
    if "ids" in tensors:
        tensors["ids"] = tensors["ids"].to(torch.int32)
    labels = header["labels"]
    return FeatureMap(header["space"], labels=None if labels is None else tuple(labels), **tensors)


def _header(stored: dict[str, NDArray[Any]]) -> dict[str, Any]:
    header = parse_json("header", stored["header"].tobytes())
    if not isinstance(header, dict) or not isinstance(header.get("space"), str):
        raise InputError("header: names no space")
    return header


def _half(values: Tensor) -> NDArray[Any]:
    """Numbers in half precision if that keeps them, else as they are."""
    kept = values.detach().cpu()
    largest = float(kept.abs().max()) if kept.numel() else 0.0
    fits = largest == 0.0 or HALF_MIN <= largest <= HALF_MAX
    return kept.to(torch.float16 if fits else torch.float32).contiguous().numpy()


def _read(path: Path, name: str) -> dict[str, NDArray[Any]] | None:
    """Arrays of a stored map, or None if it is not there, damaged (every array has a checksum) or another one's."""
    if not path.is_file():
        return None
    try:
        with own_files():
            stored = read_arrays(path)
        unpack(stored)
        if _header(stored).get("name") == name:
            return stored
    except (InputError, KeyError, ValueError, TypeError, RuntimeError):
        pass
    with suppress(OSError):
        path.unlink(missing_ok=True)
    return None
