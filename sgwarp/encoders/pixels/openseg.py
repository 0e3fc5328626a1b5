"""OpenSeg (Ghiasi et al., Scaling Open-Vocabulary Image Segmentation with Image-Level Labels, 2022), in TensorFlow.

The exported model `openseg_exported_clip` takes an encoded image and gives features in the space of CLIP ViT-L/14@336,
which therefore has to be at hand as the text side: `openseg:DIR+text:clip:PATH`.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from sgwarp.encoders.base import MapSource, TextEncoder
from sgwarp.encoders.building import Request, source_of_pixels
from sgwarp.encoders.compose import as_pixels
from sgwarp.encoders.names import Member
from sgwarp.encoders.weights import require
from sgwarp.errors import InputError

OUTPUTS = {
    True: "ppixel_ave_feat",
    False: "image_embedding_feat",
}  # features pooled over the model's own regions, or not


class OpenSeg:
    """A PixelEncoder, in the space of the text encoder it is given, and by its help a TextEncoder.

    Args:
        path: Folder of the SavedModel.
        text: CLIP ViT-L/14@336.
        pooled: Whether features are averaged over the regions that the model proposes.

    Raises:
        InputError: TensorFlow is not installed, or the folder holds no such model.
    """

    def __init__(self, path: str, text: TextEncoder, pooled: bool = True) -> None:
        what = f"encoder openseg:{path}"
        if not (Path(path) / "saved_model.pb").is_file():
            raise InputError(f"{what}: is no folder of a SavedModel (saved_model.pb is not there)")
        os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # TensorFlow otherwise prints a page at its import
        self._tensorflow: Any = require("tensorflow", "openseg", what)
        try:
            self._model = self._tensorflow.saved_model.load(path, tags=["serve"])
            self._run = self._model.signatures["serving_default"]
        except (OSError, RuntimeError, ValueError, KeyError) as error:
            line = (str(error).strip().splitlines() or [type(error).__name__])[0]
            raise InputError(f"{what}: cannot be loaded as an OpenSeg SavedModel ({line})") from None
        self.text, self.space = text, text.space
        self.output = OUTPUTS[pooled]
        outputs = self._run.structured_outputs
        missing = [name for name in (self.output, "image_info") if name not in outputs]
        if missing:
            raise InputError(f"{what}: has no output {missing[0]}; its outputs are {', '.join(sorted(outputs))}")
        self.channels = int(outputs[self.output].shape[-1])
        self.identity = f"openseg, {_hash_of(Path(path))}, {self.output}, {self.space}"

    def encode_pixels(self, image: Tensor) -> Tensor:
        """Unit vectors, float32 [h, w, C], at the resolution the model works at."""
        import cv2

        done, encoded = cv2.imencode(".png", np.ascontiguousarray(as_pixels(image)[:, :, ::-1]))
        assert done
        tf = self._tensorflow
        found = self._run(
            inp_image_bytes=tf.convert_to_tensor(encoded.tobytes()),
            inp_text_emb=tf.zeros([1, 1, self.channels]),  # queries are compared later, in 3D
        )
        info = found["image_info"].numpy()
        # Rows: the image's size, the size it is padded to, the scale in between, an offset.
        height, width = (int(info[0, axis] * info[2, axis]) for axis in (0, 1))
        features = torch.from_numpy(found[self.output].numpy()[0, :height, :width].astype(np.float32))
        return normalize(features, dim=2)

    def encode_text(self, texts: Sequence[str]) -> Tensor:
        """Unit vectors by the text encoder, float32 [Q, C].

        Raises:
            InputError: Its vectors have another length than the features.
        """
        vectors = self.text.encode_text(texts)
        if vectors.shape[1] != self.channels:
            raise InputError(
                f"openseg: features have {self.channels} channels, phrases in space '{self.space}' have "
                f"{vectors.shape[1]}; its text side is CLIP ViT-L/14@336"
            )
        return vectors


def _hash_of(folder: Path) -> str:
    """Hash of the files' sizes and of the graph, 12 hex digits."""
    digest = hashlib.sha256((folder / "saved_model.pb").read_bytes())
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            digest.update(f"{path.relative_to(folder)} {path.stat().st_size}".encode())
            with open(path, "rb") as file:
                digest.update(file.read(1 << 20))
    return digest.hexdigest()[:12]


def make_source(member: Member, request: Request) -> MapSource:
    """Features of every pixel, in the space of the text side that is named beside it."""
    part = member.source
    encoder = OpenSeg(part.argument, request.text(member), part.options.get("pooled", True))
    return source_of_pixels(encoder, member.masks, request)
