"""Data sets whose poses are not read: named with the remedy, so that nobody waits for them to be used."""

from __future__ import annotations

import os
import re
from collections import Counter
from fnmatch import fnmatch
from pathlib import Path

from sgwarp.files.access import reading
from sgwarp.io.lens_models import PANORAMA_REMEDY

# What tells a capture, relative to its folder: a pattern, what it is, and what makes a data set of it that is read.
CAPTURES = (
    ("poses_bounds.npy", "LLFF's list of poses (poses_bounds.npy)", "to a transforms.json"),
    ("keyframes/cameras/*.json", "a Polycam capture", "ns-process-data polycam"),
    ("EXR_RGBD/metadata.json", "a Record3D capture", "ns-process-data record3d"),
    ("rgbd/*.depth", "a Record3D capture, unpacked", "ns-process-data record3d, of the .r3d file"),
    ("*.r3d", "a Record3D capture (.r3d)", "ns-process-data record3d"),
    (
        "results/depth*.png",
        "a capture in Replica's layout (traj.txt)",
        "to a transforms.json with its camera-to-world poses",
    ),
    ("pose/*.txt", "a capture in ScanNet's layout (pose/*.txt)", "to a transforms.json with its camera-to-world poses"),
    ("cameras_sphere.npz", "a list of DTU cameras (cameras_sphere.npz)", "to a transforms.json"),
    ("cameras.npz", "a list of DTU cameras (cameras.npz)", "to a transforms.json"),
    ("cams/*_cam.txt", "a capture in MVSNet's layout (cams/*_cam.txt)", "to a transforms.json"),
    ("bundle.out", "a Bundler file (bundle.out)", "COLMAP's import, or RealityCapture's COLMAP export"),
    ("*.nvm", "a VisualSFM file (.nvm)", "COLMAP's import"),
    ("calib.txt", "a KITTI calibration (calib.txt)", "to a transforms.json"),
    ("reconstruction.json", "an OpenSfM reconstruction", "opensfm export_colmap"),
    ("sfm_data.json", "an OpenMVG reconstruction", "openMVG_main_openMVG2Colmap"),
    ("cameras.sfm", "a Meshroom reconstruction", "Meshroom's ExportColmap node, or ns-process-data"),
    ("*.psx", "a Metashape project", "Metashape's COLMAP export (File, Export, Export Cameras)"),
    ("*.rcproj", "a RealityCapture project", "its COLMAP export"),
)
# The same of files whose names say little: also what their first bytes hold.
LISTS = (
    ("*.log", rb"\A\s*\d+\s+\d+\s+\d+\s*\n", "a list of Tanks and Temples poses (.log)", "to a transforms.json"),
    ("*.xml", rb"<chunk|<cameras", "Metashape's list of cameras (.xml)", "its COLMAP export, or ns-process-data"),
    (
        "cameras.json",
        rb"img_name",
        "the list of cameras of a 3DGS trainer's output (cameras.json)",
        "give the data set that it was trained on, which cfg_args names as source_path",
    ),
    ("*.csv", rb"\A#name", "RealityCapture's list of cameras (.csv)", "its COLMAP export, or ns-process-data"),
)
# The same of panoramas, which those tools cannot convert: the patterns of the lists above, and how each names the lens.
PANORAMIC = (
    ("reconstruction.json", rb'"projection_type"\s*:\s*"(spherical|equirectangular)"', "an OpenSfM reconstruction"),
    ("sfm_data.json", rb'"polymorphic_name"\s*:\s*"spherical"', "an OpenMVG reconstruction"),
    ("cameras.sfm", rb'"type"\s*:\s*"(equirectangular|spherical)"', "a Meshroom reconstruction"),
    ("*.xml", rb"<sensor\b[^>]*\btype=[\"'](spherical|cylindrical)[\"']", "Metashape's list of cameras (.xml)"),
)
MOST_BYTES = 1 << 26  # of such a list that are looked at
HEAD_BYTES = 4096
# Endings of photographs that are not decoded, and what decodes them.
UNREAD = {
    **dict.fromkeys((".heic", ".heif"), "HEIC"),
    ".avif": "AVIF",
    ".jxl": "JPEG XL",
    ".gif": "GIF",
    **dict.fromkeys((".exr", ".hdr"), "HDR"),
    **dict.fromkeys((".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2"), "raw"),
}
MOST_FILES = 100_000  # that are looked at


def describe_capture(folder: Path) -> str | None:
    """What poses a folder holds that are not read, and the remedy; None if none of the known kinds."""
    if not folder.is_dir():
        return None
    for pattern, content, what in PANORAMIC:
        if any(path.is_file() and re.search(content, _head(path, MOST_BYTES)) for path in folder.glob(pattern)):
            return (
                f"holds {what} of panoramas, which are not read; {PANORAMA_REMEDY}, and find their poses (sgwarp poses)"
            )
    for pattern, what, remedy in CAPTURES:
        if next(folder.glob(pattern), None) is not None:
            return _not_read(what, remedy)
    for pattern, content, what, remedy in LISTS:
        if any(path.is_file() and re.search(content, _head(path)) for path in folder.glob(pattern)):
            return _not_read(what, remedy)
    return None


def _not_read(what: str, remedy: str) -> str:
    if remedy.startswith("give "):
        return f"holds {what}, which is not read; {remedy}"
    return f"holds {what}, which is not read; convert it ({remedy}), or find poses anew (sgwarp poses)"


def describe_list(file: Path) -> str | None:
    """The same of one file that was given by its name."""
    for pattern, content, what in PANORAMIC:
        if fnmatch(file.name, pattern) and re.search(content, _head(file, MOST_BYTES)):
            return f"is {what} of panoramas, which are not read; {PANORAMA_REMEDY}, and find their poses (sgwarp poses)"
    known = [(what, remedy) for pattern, what, remedy in CAPTURES if fnmatch(file.name, pattern)]
    known += [
        (what, remedy)
        for pattern, content, what, remedy in LISTS
        if fnmatch(file.name, pattern) and re.search(content, _head(file))
    ]
    return _not_read(*known[0]).replace("holds", "is", 1) if known else None


def _head(path: Path, size: int = HEAD_BYTES) -> bytes:
    with reading(path), open(path, "rb") as file:
        return file.read(size)


def describe_unread(folder: Path) -> str | None:
    """How many photographs of formats that are not decoded a folder holds, and the remedy; None without any."""
    kinds: Counter[str] = Counter()
    count = 0
    for _, _, names in os.walk(folder):
        count += len(names)
        if count > MOST_FILES:
            break
        kinds.update(UNREAD[ending] for name in names if (ending := os.path.splitext(name)[1].lower()) in UNREAD)
    if not kinds:
        return None
    listed = ", ".join(f"{number} {kind}" for kind, number in kinds.most_common())
    return f"holds photographs that are not decoded ({listed} files); convert them to JPEG or PNG, full size"
