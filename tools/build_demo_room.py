"""Make the data of the demonstration: `python -m tools.build_demo_room [--scene FILE]`.

Reads the full data set of the room, the folder `room` below $SGWARP_DATA: 60 rendered views with points and label
images, every eighth of them held out. The scene is fitted to the others, in about ten minutes, or was before; a dozen
of them and two held-out views are shipped.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sgwarp.demo.data import CLASSES_FILE, FURNITURE, HELD_OUT, ROOM, SCENE_FILE
from sgwarp.errors import InputError
from sgwarp.files.atomic import atomic_path
from sgwarp.files.images import read_ids, write_ids, write_rgb
from sgwarp.io.points import load_points
from sgwarp.io.scenes import load_gaussians, save_gaussians
from sgwarp.io.views import load_views
from sgwarp.reconstruction.fitting.settings import FitSettings
from sgwarp.reconstruction.fitting.trainer import fit
from sgwarp.runs.progress import show_progress
from sgwarp.scene import View

SETTINGS = FitSettings(steps=10_000, strategy="mcmc", cap=100_000, sh_degree=1)  # 25 bytes per Gaussian
VIEWS = 12
HOLD_OUT = 8  # every eighth view is held out
SHOWN = ("0016", "0024")  # held-out views that are shipped: between them they show every object
NEAR, SIMILAR = 0.5, 25.0  # of two views this close [m] that look the same way [degrees], one is enough


def build_room(source: Path, out: Path, scene: Path | None = None, settings: FitSettings = SETTINGS) -> None:
    """Write the scene, the posed photographs and the label images.

    Args:
        source: Folder with transforms.json, its points, images/, labels/ and classes.json.
        out: Folder to write into.
        scene: The views that are not held out, fitted before; None fits them.
        settings: Of the fit.

    Raises:
        InputError: Something is missing in `source`.
    """
    views = load_views(source)
    train = [view for index, view in enumerate(views) if index % HOLD_OUT]
    held_out = [view for view in views[::HOLD_OUT] if view.stem in SHOWN]

    if scene is None:
        with show_progress("fit") as progress:
            gaussians = fit(train, load_points(source), settings=settings, progress=progress).gaussians
    else:
        gaussians = load_gaussians(scene)
    save_gaussians(gaussians, out / SCENE_FILE)
    labels = {view.stem: read_ids(source / "labels" / f"{view.stem}.png") for view in views}
    lifted = choose_views(train, [labels[view.stem] for view in train], VIEWS)
    meta = json.loads((source / "transforms.json").read_text(encoding="utf-8"))
    _write_views(lifted, labels, meta, out)
    _write_views(held_out, labels, meta, out / HELD_OUT)
    names = json.loads((source / "classes.json").read_text(encoding="utf-8"))
    _write_json(out / CLASSES_FILE, names)
    print(f"{out}: {len(gaussians)} Gaussians, views {' '.join(view.stem for view in lifted)}")


def choose_views(views: Sequence[View], labels: Sequence[NDArray[np.int32]], count: int) -> list[View]:
    """Greedily choose views from different places that show every furniture class often and large, in their order."""
    pixels = np.stack([np.bincount(image.ravel(), minlength=FURNITURE + 1)[1 : FURNITURE + 1] for image in labels])
    shown = pixels / pixels.max(axis=0).clip(min=1)
    places = np.stack([view.camera.position.numpy() for view in views])
    forward = np.stack([view.camera.world_to_camera[2, :3].numpy() for view in views])
    apart = np.linalg.norm(places[:, None] - places, axis=2) > NEAR
    different = (forward @ forward.T < np.cos(np.radians(SIMILAR))) | apart
    chosen: list[int] = []
    while len(chosen) < count:
        open_ = [k for k in range(len(views)) if k not in chosen and different[k, chosen].all()]
        if not open_:
            raise InputError(f"only {len(chosen)} of {count} views are different enough")
        # The logarithm makes the class that has been shown least count most.
        gains = [np.log(0.2 + shown[[*chosen, k]].sum(axis=0)).sum() for k in open_]
        chosen.append(open_[int(np.argmax(gains))])
    return [views[k] for k in sorted(chosen)]


def _write_views(views: Sequence[View], labels: dict[str, NDArray[np.int32]], meta: dict[str, Any], out: Path) -> None:
    poses = {Path(frame["file_path"]).stem: frame["transform_matrix"] for frame in meta["frames"]}
    frames = []
    for view in views:
        name = f"images/{view.stem}.jpg"
        write_rgb(out / name, view.image())
        write_ids(out / "labels" / f"{view.stem}.png", labels[view.stem].astype(np.uint8))
        frames.append({"file_path": name, "transform_matrix": poses[view.stem]})
    shipped = {key: value for key, value in meta.items() if key != "ply_file_path"}  # the points stay behind
    _write_json(out / "transforms.json", {**shipped, "frames": frames})


def _write_json(path: Path, content: Any) -> None:
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", type=Path, help="the fitted scene, if there is one already")
    options = parser.parse_args()
    data = os.environ.get("SGWARP_DATA")
    if data is None:
        raise SystemExit("set SGWARP_DATA to the folder that holds room/")
    build_room(Path(data) / "room", ROOM, options.scene)


if __name__ == "__main__":
    main()
