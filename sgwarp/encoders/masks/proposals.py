"""Masks without a mask model: partitions of an image by OpenCV, in place of SAM where no weights are at hand.

The graph segmentation of Felzenszwalb and Huttenlocher (Efficient Graph-Based Image Segmentation, 2004) gives them in
under a tenth of a second; on plain surfaces its regions follow objects more closely than superpixels of equal size do,
so it is the default.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sgwarp.encoders.base import UNRANKED, MaskGenerator, Masks
from sgwarp.encoders.building import Request, own
from sgwarp.encoders.compose import as_pixels, combine_masks
from sgwarp.encoders.names import Part
from sgwarp.errors import InputError
from sgwarp.scene import View

SMOOTHING = 0.5  # standard deviation of the blur before segmentation [pixels]
DEFAULT_SCALES = {"graph": 300.0, "slic": 24.0, "seeds": 24.0, "selective": 24.0}

Proposal = Literal["graph", "slic", "seeds", "selective"]


@dataclass(frozen=True)
class Proposals:
    """A MaskGenerator: the regions of an image at one or several scales. Lengths and areas refer to an image of `side`.

    Attributes:
        method: As in `propose_regions`.
        scales: Scale of each partition, as in `propose_regions`; three of them are ranked small, middle and large in
            the order of their scale.
        side: Longest side of the image that is segmented, and of the masks [pixels].
        smallest: Least area of a region [pixels].
    """

    method: Proposal = "graph"
    scales: tuple[float, ...] = ()
    side: int = 480
    smallest: int = 60

    def __post_init__(self) -> None:
        if self.method not in get_args(Proposal):
            raise InputError(f"proposals: '{self.method}' is not one of {', '.join(get_args(Proposal))}")
        if not self.scales:
            object.__setattr__(self, "scales", (DEFAULT_SCALES[self.method],))
        if not all(scale > 0 for scale in self.scales) or self.side < 8 or self.smallest < 1:
            raise InputError(f"proposals: scales, side and smallest must be positive, got {self}")

    @property
    def identity(self) -> str:
        import cv2

        return f"{self!r} of OpenCV {cv2.__version__}"

    def identity_of(self, view: View) -> str:
        return ""

    def everything(self, view: View, image: Tensor) -> Masks:
        """The regions of all scales, each a mask of its own."""
        small = self._small(as_pixels(image))
        smallest = max(1, round(self.smallest * (max(small.shape[:2]) / self.side) ** 2))
        ranked = sorted(self.scales)
        parts = []
        for scale in self.scales:
            regions = torch.from_numpy(propose_regions(small, self.method, scale, smallest))
            count = int(regions.max()) + 1
            masks = regions == torch.arange(count, dtype=regions.dtype)[:, None, None]
            rank = ranked.index(scale) if len(ranked) == 3 else UNRANKED
            parts.append(Masks(masks, torch.ones(count), torch.full((count,), rank)))
        return combine_masks(parts)

    def in_boxes(self, image: Tensor, boxes: Tensor) -> Tensor:
        raise InputError(f"proposals '{self.method}' cannot be asked for the mask of a box; use sam:PATH for that")

    def _small(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The image at the size that is segmented."""
        import cv2

        scale = self.side / max(image.shape[:2])
        if scale >= 1:
            return image
        height, width = (max(1, round(side * scale)) for side in image.shape[:2])
        return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), np.uint8)


def propose_regions(image: NDArray[np.uint8], method: Proposal, scale: float, smallest: int = 1) -> NDArray[np.int32]:
    """Partition an image, uint8 [H, W, 3] RGB, into regions: their numbers from 0 on, int32 [H, W].

    Args:
        image: The image.
        method: "graph" (`segment_regions`), superpixels "slic" or "seeds" (Achanta et al. 2012; Van den Bergh et al.
            2012), or "selective" (Uijlings et al. 2013): the boxes of a fast selective search, painted from the
            largest to the smallest.
        scale: k of the graph segmentation, else the side of a superpixel or of the smallest box [pixels].
        smallest: Least area of a region of the graph segmentation [pixels].

    Raises:
        InputError: The method is unknown, or OpenCV comes without its contributed modules.
    """
    if method not in get_args(Proposal):
        raise InputError(f"proposals: '{method}' is not one of {', '.join(get_args(Proposal))}")
    if method == "graph":
        return segment_regions(image, scale, smallest)
    if method == "selective":
        return _paint_boxes(image, round(scale))
    return _superpixels(image, method, max(4, round(scale)))


def _superpixels(image: NDArray[np.uint8], method: str, side: int) -> NDArray[np.int32]:
    import cv2

    _segmentation()
    lab = cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2LAB)
    height, width = image.shape[:2]
    if method == "slic":
        slic = cv2.ximgproc.createSuperpixelSLIC(lab, cv2.ximgproc.SLICO, side)
        slic.iterate(10)
        slic.enforceLabelConnectivity()
        return _numbered(np.asarray(slic.getLabels()))
    count = max(1, height * width // side**2)
    seeds = cv2.ximgproc.createSuperpixelSEEDS(width, height, 3, count, 4)
    seeds.iterate(lab, 10)
    return _numbered(np.asarray(seeds.getLabels()))


def _paint_boxes(image: NDArray[np.uint8], least: int) -> NDArray[np.int32]:
    search = _segmentation().createSelectiveSearchSegmentation()
    search.setBaseImage(np.ascontiguousarray(image[:, :, ::-1]))
    search.switchToSelectiveSearchFast()
    boxes = np.asarray(search.process())
    boxes = boxes[boxes[:, 2:].min(axis=1) >= least]
    painted = np.zeros(image.shape[:2], np.int32)
    order = np.argsort(-boxes[:, 2].astype(np.int64) * boxes[:, 3], kind="stable")
    for number, (x, y, wide, high) in enumerate(boxes[order], start=1):
        painted[y : y + high, x : x + wide] = number
    return _numbered(painted)


def _numbered(labels: NDArray[Any]) -> NDArray[np.int32]:
    """The same partition with numbers from 0 on without gaps."""
    return np.unique(labels, return_inverse=True)[1].reshape(labels.shape).astype(np.int32)


def segment_regions(image: NDArray[np.uint8], scale: float, smallest: int) -> NDArray[np.int32]:
    """Partition an image, uint8 [H, W, 3] RGB, into regions: their numbers from 0 on, int32 [H, W].

    Args:
        image: The image.
        scale: k of the paper: the larger, the larger the regions.
        smallest: Regions of fewer pixels are merged with a neighbour.

    Raises:
        InputError: OpenCV comes without its contributed modules.
    """
    segmenter = _segmentation().createGraphSegmentation(SMOOTHING, scale, smallest)
    regions: NDArray[np.int32] = segmenter.processImage(np.ascontiguousarray(image[:, :, ::-1]))
    return regions


def _segmentation() -> Any:
    import cv2

    if not hasattr(cv2, "ximgproc"):
        raise InputError("this OpenCV lacks ximgproc; replace it: pip install opencv-contrib-python-headless")
    return cv2.ximgproc.segmentation


def make_masks(part: Part, request: Request) -> MaskGenerator:
    """The generator of OpenCV whose name the part has."""
    return Proposals(part.kind.name, **own(part, Proposals))  # type: ignore[arg-type]
