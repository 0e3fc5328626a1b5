"""The unit and the origin of a data set change no picture and no label."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from sgwarp.cli import main
from sgwarp.datasets.synthetic import make_room
from sgwarp.datasets.synthetic_files import save_room
from sgwarp.io.scenes import load_gaussians, save_gaussians


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    folder = tmp_path_factory.mktemp("units") / "room"
    save_room(make_room(3, 1500), folder, views=4, width=80, height=60)
    return folder


def moved(room, folder, factor, shift):
    """The room in another unit, its cameras moved; the scene stays near the origin, as the notice says."""
    folder.mkdir(parents=True)
    for name in ("images", "labels"):
        (folder / name).symlink_to(room / name)
    meta = json.loads((room / "transforms.json").read_text())
    for frame in meta["frames"]:
        pose = np.array(frame["transform_matrix"])
        pose[:3, 3] = factor * pose[:3, 3] + shift
        frame["transform_matrix"] = pose.tolist()
    (folder / "transforms.json").write_text(json.dumps(meta))
    scene = load_gaussians(room / "scene.ply")
    save_gaussians(replace(scene, means=scene.means * factor, scales=scene.scales * factor), folder / "scene.ply")
    return folder


def pictures(folder):
    """Rendered and segmented views."""
    scene, views = str(folder / "scene.ply"), ["--views", str(folder)]
    lifted = str(folder / "L.safetensors")
    maps = ["--encoder", f"files:{folder / 'labels'}", "--cache", "none"]
    segment = ["--semantics", lifted, "--classes", "1,3,4,5"]
    assert main(["render", scene, *views, "--out", str(folder / "rendered")]) == 0
    assert main(["lift", scene, *views, *maps, "--mode", "center", "--out", lifted]) == 0
    assert main(["segment", scene, *views, *segment, "--out", str(folder / "segmented")]) == 0
    found = [*sorted((folder / "rendered").rglob("*.png")), *sorted((folder / "segmented").rglob("*.png"))]
    return {path.relative_to(folder): cv2.imread(str(path), cv2.IMREAD_UNCHANGED).astype(int) for path in found}


@pytest.mark.slow
def test_unit_and_origin_change_nothing(room, tmp_path, caplog):
    truth = pictures(moved(room, tmp_path / "m", 1.0, [0, 0, 0]))
    assert len(truth) >= 8
    for name, factor, shift in [("mm", 1e3, [0, 0, 0]), ("km", 1e-3, [0, 0, 0]), ("utm", 1.0, [1e6, 2e6, 0])]:
        caplog.clear()
        found = pictures(moved(room, tmp_path / name, factor, shift))
        assert found.keys() == truth.keys()
        for path, picture in truth.items():
            # The last digit of a float may turn a pixel on an edge.
            assert (np.abs(found[path] - picture) > 1).mean() < 1e-3, (name, path)
        assert ("relative to (1000000, 2000000, 0)" in caplog.text) == (name == "utm")
        assert "do not match" not in caplog.text
