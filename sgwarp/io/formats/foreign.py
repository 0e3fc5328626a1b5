"""What a file is that holds no scene of 3D Gaussians, so that the message can say so."""

from __future__ import annotations

import os
from collections.abc import Collection
from pathlib import Path

SPLAT_TRANSFORM = "convert it to .ply or .spz with splat-transform (npm)"
# Columns that only one kind of PLY file has: prefix, what it is, what to do.
PLY_KINDS = (
    ("f_anchor_feat", "an anchor file of Scaffold-GS or a relative", "its networks make the Gaussians; export those"),
    ("f_offset", "an anchor file of Scaffold-GS or a relative", "its networks make the Gaussians; export those"),
    ("trbf_", "a scene of SpacetimeGaussians, which moves", "export one moment as a 3DGS scene"),
    ("motion_", "a scene that moves (SpacetimeGaussians)", "export one moment as a 3DGS scene"),
    ("sb_params", "a scene of Deformable Beta Splatting", "it has no Gaussians; export a 3DGS scene"),
    ("packed_position", "a PlayCanvas compressed scene without its chunks", "copy or export it again"),
)
SUFFIXES = {
    ".ksplat": (".ksplat (mkkellogg's viewer)", SPLAT_TRANSFORM),
    ".lcc": (".lcc (XGRIDS)", SPLAT_TRANSFORM),
    ".lcc2": (".lcc2 (XGRIDS)", SPLAT_TRANSFORM),
    ".usd": ("USD", "convert it to .ply first"),
    ".usda": ("USD", "convert it to .ply first"),
    ".usdc": ("USD", "convert it to .ply first"),
    ".usdz": ("USD", "convert it to .ply first"),
    ".obj": ("a mesh (.obj)", "a scene of Gaussians is needed"),
    ".stl": ("a mesh (.stl)", "a scene of Gaussians is needed"),
    ".fbx": ("a mesh (.fbx)", "a scene of Gaussians is needed"),
    ".las": ("a point cloud (.las)", "fit a scene to photographs first: sgwarp fit"),
    ".laz": ("a point cloud (.laz)", "fit a scene to photographs first: sgwarp fit"),
    ".e57": ("a point cloud (.e57)", "fit a scene to photographs first: sgwarp fit"),
    ".zip": ("an archive", "unpack it and give the scene in it"),
    ".pcd": ("a point cloud (.pcd)", "fit a scene to photographs first: sgwarp fit"),
    ".xyz": ("a point cloud (.xyz)", "fit a scene to photographs first: sgwarp fit"),
    ".ckpt": ("a trainer's checkpoint", "export it as .ply with the trainer (nerfstudio: ns-export gaussian-splat)"),
    ".pt": ("a trainer's checkpoint", "export it as .ply with the trainer"),
    ".pth": ("a trainer's checkpoint", "export it as .ply with the trainer"),
    ".4dgs": ("a scene that moves (.4dgs)", "export one moment as .ply"),
}

# What is downloaded or copied in place of a file, by its first bytes.
POINTERS = (
    (b"version https://git-lfs", "is a pointer of Git LFS, not the file itself; run: git lfs pull"),
    (b"/annex/objects", "is a pointer of git-annex, not the file itself; run: git annex get"),
    (b"<!doctype html", "is a web page, not the file itself; download it again, signed in where that is asked for"),
    (b"<html", "is a web page, not the file itself; download it again, signed in where that is asked for"),
)


def describe_pointer(head: bytes) -> str | None:
    """What a file is that stands for another, by its first bytes (at least 24), and the remedy."""
    text = head.lstrip().lower()
    return next((what for start, what in POINTERS if text.startswith(start)), None)


def describe_file(path: str | os.PathLike[str]) -> str | None:
    """What a file is by its name, and the remedy, if it is known to hold no scene that is read here."""
    known = SUFFIXES.get(Path(path).suffix.lower())
    return None if known is None else f"is {known[0]}, which is not read; {known[1]}"


def describe_ply(names: Collection[str], elements: Collection[str]) -> str | None:
    """What a PLY file is by the columns of its element `vertex`, and the remedy, if it is no 3DGS scene."""
    for prefix, what, remedy in PLY_KINDS:
        if any(name.startswith(prefix) for name in names):
            return f"is {what}, not a 3DGS scene; {remedy}"
    geometry = {"opacity", "scale_0", "rot_0"}
    if geometry & set(names):
        return None
    if "face" in elements:
        return "is a mesh, not a 3DGS scene"
    return "is a point cloud, not a 3DGS scene; fit a scene to photographs first: sgwarp fit"
