"""CMU Panoptic, as Dynamic3DGaussians prepared it: sports seen by 27 and 4 cameras.

| file, below {sequence} | holds |
|---|---|
| params.npz | the moving Gaussians (it may lie in `output/.../{sequence}` of a training run) |
| train_meta.json, test_meta.json | cameras of every frame |
| ims/{camera}/{frame:06d}.jpg, seg/{camera}/{frame:06d}.png | photographs, and foreground |
| labels.json, truth/{frame:05d}/{camera}.png | names of labels, and ids of the pixels, if somebody drew them |
"""

from __future__ import annotations

from pathlib import Path

from sgwarp.datasets.base import SceneData, absent, folders_in, read_class_names, scene_folder
from sgwarp.files.documents import read_json

NAME = "panoptic"
ABOUT = "CMU Panoptic (Dynamic3DGaussians): {sequence}/params.npz, train_meta.json, test_meta.json, ims, seg"
SEQUENCES = ("basketball", "boxes", "football", "juggle", "softball", "tennis")


def list_scenes(root: Path) -> list[str]:
    """The root itself, or the sequences in it."""
    if (root / "train_meta.json").is_file():
        return [root.absolute().name]
    return [folder.name for folder in folders_in(root) if (folder / "train_meta.json").is_file()]


def open_scene(root: Path, name: str) -> SceneData:
    """A sequence: cameras and Gaussians are opened by `sgwarp.io.moving_views` and `sgwarp.io.sequences`.

    Raises:
        InputError: There is none of that name, or its cameras cannot be read.
    """
    root = root.absolute()
    folder = scene_folder(root, name, list_scenes(root))
    rows = read_json(folder / "train_meta.json").get("fn") or ()
    drawn = folder / "truth"
    params = folder / "params.npz"
    return SceneData(
        name,
        folder,
        frames=len(rows),
        missing=absent(folder, ("params.npz", "train_meta.json", "test_meta.json", "ims", "seg")),
        classes=read_class_names(folder / "labels.json") if (folder / "labels.json").is_file() else (),
        labelled=tuple(place.name for place in folders_in(drawn)) if drawn.is_dir() else (),
        gaussians=params if params.is_file() else None,
    )
