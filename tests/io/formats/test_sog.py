import json
import math
import zipfile

import cv2
import numpy as np
import pytest
import torch

from sgwarp.errors import InputError
from sgwarp.io.formats.sog import read_sog, webp_size
from sgwarp.io.ply import read_ply, write_ply

COUNT = 7
CODEBOOK = np.linspace(-3, 3, 256).tolist()


def webp(rgba):
    """Lossless; OpenCV takes blue, green, red, alpha."""
    done, data = cv2.imencode(".webp", np.ascontiguousarray(rgba[..., [2, 1, 0, 3]]), [cv2.IMWRITE_WEBP_QUALITY, 101])
    assert done
    return data.tobytes()


def pictures(seed=0, bands=0, palettes=70):
    """Random pictures of a scene of COUNT Gaussians, and its meta.json."""
    rng = np.random.default_rng(seed)
    made = {name: rng.integers(0, 256, (2, 4, 4), dtype=np.uint8) for name in ("l", "u", "scales", "sh0", "labels")}
    made["quats"] = rng.integers(64, 192, (2, 4, 4), dtype=np.uint8)
    meta = {
        "version": 2,
        "count": COUNT,
        "means": {"mins": [-1, -2, -3], "maxs": [1, 2, 4], "files": ["l.webp", "u.webp"]},
        "scales": {"codebook": CODEBOOK, "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": CODEBOOK, "files": ["sh0.webp"]},
    }
    for rgba in made.values():
        rgba[..., 3] |= 1  # OpenCV's encoder blackens what is transparent
    made["quats"][..., 3] = 252 + rng.integers(0, 4, (2, 4))
    if bands:
        width = {1: 3, 2: 8, 3: 15}[bands]
        made["centroids"] = rng.integers(0, 256, (-(-palettes // 64), 64 * width, 4), dtype=np.uint8)
        made["centroids"][..., 3] = 255
        made["labels"][..., 0], made["labels"][..., 1] = rng.integers(0, palettes, (2, 4)), 0
        meta["shN"] = {
            "count": palettes,
            "bands": bands,
            "codebook": CODEBOOK,
            "files": ["centroids.webp", "labels.webp"],
        }
    else:
        del made["labels"]
    return made, meta


def write(path, made, meta):
    if path.suffix == ".sog":
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("meta.json", json.dumps(meta))
            for name, rgba in made.items():
                archive.writestr(f"{name}.webp", webp(rgba))
        return path
    path.mkdir(exist_ok=True)
    (path / "meta.json").write_text(json.dumps(meta))
    for name, rgba in made.items():
        (path / f"{name}.webp").write_bytes(webp(rgba))
    return path


@pytest.mark.parametrize("bands", [0, 1, 2, 3])
@pytest.mark.parametrize("name", ["a.sog", "folder"])
def test_pictures_mean_what_the_format_says(tmp_path, name, bands):
    made, meta = pictures(bands=bands)
    scene = read_sog(write(tmp_path / name, made, meta))
    assert len(scene) == COUNT
    flat = {key: rgba.reshape(-1, 4).astype(int) for key, rgba in made.items() if key != "centroids"}
    for i in range(COUNT):
        for axis in range(3):
            low, high = meta["means"]["mins"][axis], meta["means"]["maxs"][axis]
            log = low + (high - low) * (flat["u"][i, axis] * 256 + flat["l"][i, axis]) / 65535
            assert scene.means[i, axis].item() == pytest.approx(math.copysign(math.exp(abs(log)) - 1, log), abs=2e-5)
            assert scene.scales[i, axis].item() == pytest.approx(math.exp(CODEBOOK[flat["scales"][i, axis]]), rel=1e-5)
            assert scene.sh[i, 0, axis].item() == pytest.approx(CODEBOOK[flat["sh0"][i, axis]], abs=1e-6)
        assert scene.opacities[i].item() == pytest.approx(flat["sh0"][i, 3] / 255)
        largest = flat["quats"][i, 3] - 252
        smaller = [(value / 255 - 0.5) * math.sqrt(2) for value in flat["quats"][i, :3]]
        quat = list(smaller)
        quat.insert(largest, math.sqrt(1 - sum(value**2 for value in smaller)))
        assert scene.quats[i].tolist() == pytest.approx(quat, abs=1e-5)
        for k in range(scene.sh.shape[1] - 1):
            label = flat["labels"][i, 0]
            pixel = made["centroids"][label // 64, label % 64 * (scene.sh.shape[1] - 1) + k, :3]
            assert scene.sh[i, k + 1].tolist() == pytest.approx([CODEBOOK[value] for value in pixel], abs=1e-6)
    assert scene.sh.shape[1] == (bands + 1) ** 2


def test_independent_library_agrees(tmp_path, scene):
    """GaussForge writes SOG; what it reads of its own file is what we read."""
    forge = pytest.importorskip("gaussforge").GaussForge()
    write_ply(scene(50, 1), tmp_path / "a.ply")
    packed = forge.convert((tmp_path / "a.ply").read_bytes(), "ply", "sog")["data"]
    (tmp_path / "a.sog").write_bytes(packed)
    (tmp_path / "b.ply").write_bytes(forge.convert(packed, "sog", "ply")["data"])
    ours, theirs = read_sog(tmp_path / "a.sog"), read_ply(tmp_path / "b.ply")
    assert (ours.means - theirs.means).abs().max() < 1e-4
    assert (ours.scales.log() - theirs.scales.log()).abs().max() < 1e-4
    assert (ours.sh - theirs.sh).abs().max() < 1e-4
    assert (torch.einsum("ni,ni->n", ours.quats, theirs.quats).abs() - 1).abs().max() < 1e-4


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: m.pop("version"), "SOG of version 1, version 2 is read; convert it with splat-transform"),
        (lambda m: m.pop("quats"), "lacks 'quats'"),
        (lambda m: m.update(count=10**8), "'count' must be a whole number from 1 to 65536"),
        (lambda m: m["means"].update(files=["l.webp"]), "'means' must name 2 files"),
        (lambda m: m["means"].update(mins=[0, 1]), "'mins' of 'means' must be 3 finite numbers"),
        (lambda m: m["sh0"].update(codebook=[1]), "'codebook' of 'sh0' must be 256 finite numbers"),
        (lambda m: m.update(count=20000), "is 4 x 2, expected about 20000 pixels"),
        (lambda m: m["scales"].update(files=["gone.webp"]), "gone"),
    ],
)
@pytest.mark.parametrize("name", ["a.sog", "folder"])
def test_damaged(tmp_path, name, change, message):
    made, meta = pictures()
    change(meta)
    with pytest.raises(InputError, match=message):
        read_sog(write(tmp_path / name, made, meta))


def test_palette_out_of_range_and_names_outside(tmp_path):
    made, meta = pictures(bands=1)
    made["labels"][0, 0, 1] = 200
    with pytest.raises(InputError, match=r"has palette .* of 70"):
        read_sog(write(tmp_path / "a.sog", made, meta))
    made, meta = pictures()
    meta["quats"]["files"] = ["../quats.webp"]
    with pytest.raises(InputError, match="does not lie beside it"):
        read_sog(write(tmp_path / "folder", made, meta))


def test_size_by_the_header():
    for height, width in ((1, 1), (7, 300), (1000, 5)):
        rgba = np.random.default_rng(0).integers(0, 256, (height, width, 4), dtype=np.uint8)
        assert webp_size(webp(rgba)) == (width, height)
        lossy = cv2.imencode(".webp", rgba[..., :3], [cv2.IMWRITE_WEBP_QUALITY, 50])[1].tobytes()
        assert webp_size(lossy) == (width, height)
    assert webp_size(b"RIFF") is None


def test_mutated_files(tmp_path, survives):
    made, meta = pictures(bands=1)
    survives(write(tmp_path / "a.sog", made, meta), read_sog, 100)


def packed(path, root, made, meta, others=()):
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in others:
            archive.writestr(name, data)
        archive.writestr(f"{root}meta.json", json.dumps(meta))
        for name, rgba in made.items():
            archive.writestr(f"{root}{name}.webp", webp(rgba))
    return path


@pytest.mark.parametrize("other", ["__MACOSX/scene/._meta.json", "lod-meta.json", "scene/old/meta.json"])
def test_a_packed_folder_with_other_files(tmp_path, other):
    made, meta = pictures()
    plain = read_sog(write(tmp_path / "a.sog", made, meta))
    for root in ("scene/", "scene\\"):
        scene = read_sog(packed(tmp_path / "b.sog", root, made, meta, [(other, b"{}")]))
        assert torch.equal(scene.means, plain.means)
        assert torch.equal(scene.sh, plain.sh)


def test_two_packed_scenes_are_named(tmp_path):
    path = packed(tmp_path / "a.sog", "near/", *pictures(), others=[("far/meta.json", b"{}")])
    with pytest.raises(InputError, match=r"a\.sog: holds 2 scenes \(far/, near/\); unpack it and give one"):
        read_sog(path)
