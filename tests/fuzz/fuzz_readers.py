"""Every reader of files of others, with small files that it accepts: what the fuzzer starts from."""

import json
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch

from sgwarp.encoders.cache import _read, pack
from sgwarp.encoders.instances.vlpart import VLPartFiles
from sgwarp.encoders.maps.deva import read_predictions
from sgwarp.encoders.maps.files import FileMaps
from sgwarp.encoders.masks.files import FileMasks
from sgwarp.encoders.pixels.lseg import read_checkpoint
from sgwarp.files.archives import gunzip
from sgwarp.files.images import read_alpha, read_ids, read_rgb, read_size
from sgwarp.files.tensors import write_tensors
from sgwarp.io.openscene import load_openscene
from sgwarp.io.points import load_points
from sgwarp.io.scenes import load_gaussians, save_gaussians
from sgwarp.io.store import load_semantics, read_notes, save_semantics
from sgwarp.io.views import load_views
from sgwarp.network.checkpoint import read_weights
from sgwarp.network.semantic_network import load_network
from sgwarp.reconstruction.fitting.checkpoint import Checkpoint
from sgwarp.reconstruction.fitting.initial import depth_from_folder
from sgwarp.reconstruction.fitting.settings import FitSettings
from sgwarp.scene import Camera, FeatureMap, Gaussians, Semantics, View

HEIGHT, WIDTH, COUNT = 12, 16, 5


@dataclass(frozen=True)
class Reader:
    """A reader and a file for it.

    Attributes:
        name: Of the pair.
        file: The file that is mutated; other files that the reader wants lie beside it.
        read: Reads it.
        fits: Whether the file is accepted as it is.
    """

    name: str
    file: Path
    read: Callable[[], object]
    fits: bool = True


def gaussians(degree: int = 1) -> Gaussians:
    generator = torch.Generator().manual_seed(0)
    random = torch.rand(COUNT, 20, generator=generator)
    sh = torch.randn(COUNT, (degree + 1) ** 2, 3, generator=generator)
    return Gaussians(random[:, :3], random[:, 3:7] + 0.1, random[:, 7:10] + 0.01, random[:, 10], sh)


def camera() -> Camera:
    K = torch.tensor([[20.0, 0, WIDTH / 2], [0, 20.0, HEIGHT / 2], [0, 0, 1]])
    return Camera(K, torch.eye(4), WIDTH, HEIGHT)


def image(channels: int = 3, kind: type = np.uint8) -> np.ndarray:
    random = np.random.default_rng(0)
    shape = (HEIGHT, WIDTH, channels) if channels > 1 else (HEIGHT, WIDTH)
    return random.integers(0, 255, shape).astype(kind)


def readers(root: Path) -> list[Reader]:
    """All pairs, with their files in folders below `root`."""
    made: list[Reader] = []
    for make in (_scenes, _views, _points, _images, _maps, _masks, _tensors, _others):
        made += make(root / make.__name__)
    return made


def folder_of(root: Path, name: str) -> Path:
    folder = root / name
    folder.mkdir(parents=True)
    return folder


def _scenes(root: Path) -> list[Reader]:
    import plyfile

    folder = folder_of(root, "ply")
    plain, packed, text = folder / "a.ply", folder / "a.compressed.ply", folder / "text.ply"
    save_gaussians(gaussians(), plain)
    save_gaussians(gaussians(), packed)
    content = plyfile.PlyData.read(str(plain))
    content.text = True
    content.write(str(text))
    mesh = folder / "list.ply"
    faces = np.array([([0, 1, 2],), ([1, 2, 3, 4],)], dtype=[("vertex_indices", "O")])
    plyfile.PlyData([content["vertex"], plyfile.PlyElement.describe(faces, "face")]).write(str(mesh))
    return [Reader(f"scene {file.name}", file, lambda file=file: load_gaussians(file)) for file in folder.iterdir()]


def _views(root: Path) -> list[Reader]:
    folder = folder_of(root, "nerfstudio")
    cv2.imwrite(str(folder / "a.png"), image())
    frame = {"file_path": "a.png", "transform_matrix": torch.eye(4).tolist()}
    meta = {"fl_x": 20.0, "fl_y": 20.0, "cx": 8.0, "cy": 6.0, "w": WIDTH, "h": HEIGHT, "k1": 0.1, "frames": [frame] * 1}
    (folder / "transforms.json").write_text(json.dumps(meta))
    found = [Reader("transforms.json", folder / "transforms.json", lambda: load_views(folder))]
    for suffix in ("txt", "bin"):
        model = folder_of(root, f"colmap_{suffix}")
        _write_colmap(model, suffix)
        for name in ("cameras", "images"):
            read = lambda model=model: load_views(model, photographs=False)  # noqa: E731
            found.append(Reader(f"COLMAP {name}.{suffix}", model / f"{name}.{suffix}", read))
        file = model / f"points3D.{suffix}"
        found.append(Reader(f"COLMAP {file.name}", file, lambda file=file: load_points(file)))
    return found


def _write_colmap(model: Path, suffix: str) -> None:
    import struct

    if suffix == "txt":
        (model / "cameras.txt").write_text(f"# cameras\n1 OPENCV {WIDTH} {HEIGHT} 20 20 8 6 0.1 0 0 0\n")
        (model / "images.txt").write_text("1 1 0 0 0 0 0 1 1 a.png\n1 2 3\n2 0.9 0.1 0 0 0 0 1 1 b.png\n\n")
        (model / "points3D.txt").write_text("1 0.5 1 2 255 0 10 0.1 1 2\n2 1 1 2 25 0 10 0.1 1 2\n")
        return
    head = struct.pack("<QiiQQ8d", 1, 1, 4, WIDTH, HEIGHT, 20, 20, 8, 6, 0.1, 0, 0, 0)
    (model / "cameras.bin").write_bytes(head)
    pose = struct.pack("<i7di", 1, 1, 0, 0, 0, 0, 0, 1, 1) + b"a.png\0" + struct.pack("<Q2dQ", 1, 1, 2, 3)
    (model / "images.bin").write_bytes(struct.pack("<Q", 1) + pose)
    point = struct.pack("<Q3d3BdQ2i", 1, 0.5, 1, 2, 255, 0, 10, 0.1, 1, 1, 2)
    (model / "points3D.bin").write_bytes(struct.pack("<Q", 2) + point + point)


def _points(root: Path) -> list[Reader]:
    import plyfile

    file = folder_of(root, "points") / "points3D.ply"
    rows = np.array(
        [(0, 1, 2, 255, 0, 9)] * 3, dtype=[*((n, "f4") for n in "xyz"), *((n, "u1") for n in ("red", "green", "blue"))]
    )
    plyfile.PlyData([plyfile.PlyElement.describe(rows, "vertex")]).write(str(file))
    return [Reader("points.ply", file, lambda: load_points(file))]


def _images(root: Path) -> list[Reader]:
    folder = folder_of(root, "images")
    files = {
        "rgb.png": image(),
        "alpha.png": image(4),
        "grey.png": image(1),
        "deep.png": image(1, np.uint16),
        "a.jpg": image(),
        "a.webp": image(),
        "a.tif": image(),
        "a.bmp": image(),
    }
    for name, pixels in files.items():
        cv2.imwrite(str(folder / name), pixels)
    (folder / "palette.png").write_bytes(palette_png())
    cv2.imwrite(str(folder / "progressive.jpg"), image(), [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])
    cv2.imwrite(str(folder / "lossless.webp"), image(), [cv2.IMWRITE_WEBP_QUALITY, 101])

    def read(file: Path) -> None:
        # Each reader in turn; the first error ends the input, as it ends a user's run.
        read_size(file)
        read_rgb(file)
        read_alpha(file)
        if file.suffix == ".png" and file.name != "alpha.png":  # transparent, or lossy
            read_ids(file)

    return [Reader(f"image {file.name}", file, lambda file=file: read(file)) for file in sorted(folder.iterdir())]


def palette_png() -> bytes:
    def chunk(kind: bytes, content: bytes) -> bytes:
        return len(content).to_bytes(4, "big") + kind + content + zlib.crc32(kind + content).to_bytes(4, "big")

    head = WIDTH.to_bytes(4, "big") + HEIGHT.to_bytes(4, "big") + b"\x04\x03\x00\x00\x00"
    rows = b"".join(b"\0" + bytes(range(k, k + WIDTH // 2)) for k in range(HEIGHT))
    parts = chunk(b"IHDR", head) + chunk(b"PLTE", bytes(range(48))) + chunk(b"IDAT", zlib.compress(rows))
    return b"\x89PNG\r\n\x1a\n" + parts + chunk(b"tEXt", b"a\0b") + chunk(b"IEND", b"")


def _maps(root: Path) -> list[Reader]:
    view = View("a", camera())
    features = np.random.default_rng(0).normal(size=(3, HEIGHT, WIDTH)).astype(np.float32)

    def read(folder: Path) -> None:
        FileMaps(folder, [view]).encode(view)

    found = []
    for suffix in ("npy", "npz", "pt", "safetensors", "png"):
        folder = folder_of(root, suffix)
        file = folder / f"a.{suffix}"
        if suffix == "npy":
            np.save(file, features)
        elif suffix == "npz":
            np.savez_compressed(file, features=features.astype(">f4"), valid=np.ones((HEIGHT, WIDTH), bool))
        elif suffix == "pt":
            torch.save({"features": torch.from_numpy(features)}, file)
        elif suffix == "safetensors":
            from safetensors.torch import save_file

            save_file({"features": torch.from_numpy(features)}, file)
        else:
            cv2.imwrite(str(file), image(1) % 5)
        (folder / "space.json").write_text('{"space": "mine"}')
        found.append(Reader(f"features .{suffix}", file, lambda folder=folder: read(folder)))
        if suffix == "npy":
            found.append(Reader("space.json", folder / "space.json", lambda folder=folder: read(folder)))
    pair = folder_of(root, "langsplat")
    np.save(pair / "a_s.npy", (np.arange(2 * HEIGHT * WIDTH) % 4 - 1).reshape(2, HEIGHT, WIDTH).astype(np.float32))
    np.save(pair / "a_f.npy", features[:, :3, :4].reshape(-1, 4))
    found += [Reader(f"LangSplat {end}", pair / f"a_{end}.npy", lambda: read(pair)) for end in "sf"]
    depth = folder_of(root, "depth")
    np.save(depth / "a.npy", features[0])
    return [*found, Reader("depth .npy", depth / "a.npy", lambda: depth_from_folder(depth)(view))]


def _masks(root: Path) -> list[Reader]:
    view = View("a", camera())
    pixels = torch.from_numpy(image())
    masks = folder_of(root, "masks")
    np.savez_compressed(masks / "a.npz", masks=np.ones((2, HEIGHT, WIDTH), bool), scores=np.ones(2), ranks=np.zeros(2))
    found = [Reader("masks .npz", masks / "a.npz", lambda: FileMasks(masks).everything(view, pixels))]
    vlpart = folder_of(root, "vlpart")
    rle = {"size": [HEIGHT, WIDTH], "counts": [10, HEIGHT * WIDTH - 10]}
    row = {"box": [1, 2, 5, 6], "name": "dog:head", "score": 0.5, "mask": rle}
    (vlpart / "a.json").write_text(json.dumps({"instances": [row, row | {"mask": {**rle, "counts": "0`6"}}][:1]}))
    boxes = folder_of(root, "boxes")
    np.savez(boxes / "a.npz", boxes=np.array([[1.0, 2, 5, 6]]), names=np.array(["dog"]), scores=np.ones(1))
    for folder, name in ((vlpart, "a.json"), (boxes, "a.npz")):
        read = lambda folder=folder: VLPartFiles(folder).find(view, pixels)  # noqa: E731
        found.append(Reader(f"instances {name}", folder / name, read))
    deva = folder_of(root, "deva") / "pred.json"
    frame = {"file_name": "a.jpg", "segments_info": [{"id": 1, "score": 0.5}, {"id": 2}]}
    deva.write_text(json.dumps({"annotations": [frame]}))
    return [*found, Reader("pred.json", deva, lambda: read_predictions(deva))]


def _tensors(root: Path) -> list[Reader]:
    scene = gaussians()
    folder = folder_of(root, "tensors")
    mask = torch.tensor([True, False, True, True, False])
    torch.save({"feat": torch.randn(3, 4).half(), "mask_full": mask}, folder / "openscene.pt")
    net = {f"net.layer{k}.weight": torch.randn(3, 2) for k in range(3)}
    torch.save({"state_dict": net, "lightning": {"epoch": 3, "scores": np.float64(1.0)}}, folder / "lseg.ckpt")
    torch.save({"state_dict": net}, folder / "old.pth", _use_new_zipfile_serialization=False)
    settings = FitSettings(steps=10)
    _checkpoint(settings).save(folder / "fit.checkpoint")
    unit = Semantics(torch.randn(COUNT, 4), torch.ones(COUNT), torch.ones(COUNT), "mine", scene.fingerprint)
    save_semantics(unit, folder / "semantics.safetensors", {"encoder": "mine"})
    few = {"conv0p1s1.kernel": torch.zeros(125, 3, 2), "final.kernel": torch.zeros(2, 2)}
    about = {"format": "sgwarp-network", "version": "1", "arch": "14A", "inputs": "signed-rgb", "voxel": "0.02"}
    write_tensors(folder / "net.safetensors", few, about | {"space": "mine", "labels": "null", "notes": "{}"})
    device = torch.device("cpu")
    found = {
        "openscene.pt": lambda: load_openscene(folder / "openscene.pt", scene),
        "lseg.ckpt": lambda: read_checkpoint(str(folder / "lseg.ckpt")),
        "old.pth": lambda: read_weights(folder / "old.pth"),
        "fit.checkpoint": lambda: Checkpoint.load(folder / "fit.checkpoint", settings, "0", device),
        "semantics.safetensors": lambda: (
            load_semantics(folder / "semantics.safetensors"),
            read_notes(folder / "semantics.safetensors"),
        ),
        "net.safetensors": lambda: load_network(folder / "net.safetensors"),
    }
    # A whole network would be 30 MB.
    return [Reader(name, folder / name, read, fits=name != "net.safetensors") for name, read in found.items()]


def _checkpoint(settings: FitSettings) -> Checkpoint:
    import dataclasses

    scene = gaussians()
    fields = {name: getattr(scene, name) for name in ("means", "quats", "scales", "opacities", "sh")}
    model = {
        f"{name}.{part}": value
        for name, value in fields.items()
        for part in ("parameters", "first", "second", "values")
    }
    model |= {name: torch.zeros(COUNT, dtype=torch.int32) for name in ("steps", "skipped")}
    return Checkpoint(dataclasses.asdict(settings), "0", 3, 1.5, model, {}, {}, {}, [[0.1, 20.0], [1.0, 2.0, 3.0]])


def _others(root: Path) -> list[Reader]:
    import gzip

    folder = folder_of(root, "cache")
    found = FeatureMap("mine", ids=torch.zeros(HEIGHT, WIDTH, dtype=torch.int64), vectors=torch.randn(2, 4))
    np.savez_compressed(folder / "0.map.npz", **pack(found, "0"))
    packed = folder_of(root, "gzip") / "a.gz"
    packed.write_bytes(gzip.compress(bytes(range(256)) * 8))

    def cached() -> None:
        _read(folder / "0.map.npz", "0")

    return [
        Reader("cache entry", folder / "0.map.npz", cached),
        Reader("gzip", packed, lambda: gunzip(packed, packed.read_bytes())),
    ]
