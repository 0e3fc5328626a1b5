"""Feature maps and label images from files, written here with the libraries that others write them with."""

import json
import struct
import zlib

import cv2
import numpy as np
import pytest
import torch
from safetensors.numpy import save_file

from sgwarp.encoders.base import MissingMap
from sgwarp.encoders.maps.files import FileMaps
from sgwarp.encoders.registry import make_encoder
from sgwarp.errors import InputError
from sgwarp.scene import Camera, View

HEIGHT, WIDTH = 48, 64


def view(stem: str = "a", height: int = HEIGHT, width: int = WIDTH) -> View:
    K = torch.tensor([[50.0, 0, width / 2], [0, 50.0, height / 2], [0, 0, 1]])
    return View(stem, Camera(K, torch.eye(4), width, height))


VIEWS = [view("a"), view("b"), view("c")]


def grey_png(path, pixels: np.ndarray) -> None:
    """A grey PNG of 8 or 16 bits, byte by byte after the specification."""
    bits = pixels.dtype.itemsize * 8
    rows = b"".join(b"\x00" + row.astype(f">u{pixels.dtype.itemsize}").tobytes() for row in pixels)
    header = struct.pack(">IIBBBBB", pixels.shape[1], pixels.shape[0], bits, 0, 0, 0, 0)
    chunks = [(b"IHDR", header), (b"IDAT", zlib.compress(rows)), (b"IEND", b"")]
    body = b"".join(struct.pack(">I", len(d)) + k + d + struct.pack(">I", zlib.crc32(k + d)) for k, d in chunks)
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + body)


@pytest.fixture
def labels(tmp_path):
    """Label images of two of three views, 8 and 16 bits, and what is in them."""
    rng = np.random.default_rng(0)
    first = rng.choice([0, 3, 7], size=(HEIGHT, WIDTH)).astype(np.uint8)
    second = rng.choice([0, 3, 40000], size=(HEIGHT, WIDTH)).astype(np.uint16)
    grey_png(tmp_path / "a.png", first)
    grey_png(tmp_path / "b.png", second)
    return tmp_path, {"a": first, "b": second}


def test_label_images_share_the_channels_of_the_scene(labels):
    folder, images = labels
    source = make_encoder(f"files:{folder}", VIEWS)
    assert source.space == "labels"
    assert not source.needs_image
    for stem, pixels in images.items():
        found = source.encode(view(stem), None)
        assert found.labels == ("3", "7", "40000")
        assert found.channels == 3
        wanted = [[{0: -1, 3: 0, 7: 1, 40000: 2}[int(p)] for p in row] for row in pixels]
        assert found.ids.tolist() == [wanted]


def test_only_wanted_views_make_the_channels(labels):
    folder, _ = labels
    assert FileMaps(folder, [view("a")]).labels == ("3", "7")


def test_a_view_without_file_can_be_told_from_a_broken_one(labels):
    folder, _ = labels
    with pytest.raises(MissingMap, match=r"no map of view c"):
        FileMaps(folder, VIEWS).encode(view("c"))


def test_label_images_may_be_smaller(tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), np.full((HEIGHT // 4, WIDTH // 4), 5, np.uint8))
    assert FileMaps(tmp_path, VIEWS).encode(view()).size == (HEIGHT // 4, WIDTH // 4)


def features(channels: int = 5, height: int = 12, width: int = 16) -> np.ndarray:
    return np.random.default_rng(1).normal(size=(height, width, channels)).astype(np.float32)


def write(path, array: np.ndarray, valid: np.ndarray | None = None) -> None:
    arrays = {"features": array} | ({} if valid is None else {"valid": valid})
    if path.suffix == ".npy":
        np.save(path, array)
    elif path.suffix == ".npz":
        np.savez(path, **arrays)
    elif path.suffix == ".safetensors":
        save_file({k: np.ascontiguousarray(v) for k, v in arrays.items()}, path)
    else:
        tensors = {k: torch.from_numpy(v) for k, v in arrays.items()}
        torch.save(tensors if valid is not None else tensors["features"], path)


@pytest.mark.parametrize("suffix", [".npy", ".npz", ".pt", ".pth", ".safetensors"])
@pytest.mark.parametrize("layout", ["chw", "hwc"])
def test_dense_features(tmp_path, suffix, layout):
    values = features()
    write(tmp_path / f"a{suffix}", values if layout == "hwc" else values.transpose(2, 0, 1))
    source = FileMaps(tmp_path, VIEWS)
    assert source.space == "files:5"
    assert source.encode(view()).dense.tolist() == values.tolist()
    assert FileMaps(tmp_path, VIEWS, layout=layout).encode(view()).dense.tolist() == values.tolist()


@pytest.mark.parametrize("suffix", [".npz", ".pt", ".safetensors"])
def test_mask_of_valid_pixels(tmp_path, suffix):
    valid = np.random.default_rng(2).random((12, 16)) < 0.5
    write(tmp_path / f"a{suffix}", features(), valid)
    assert FileMaps(tmp_path, VIEWS).encode(view()).valid.tolist() == valid.tolist()


def test_half_precision_is_kept(tmp_path):
    np.save(tmp_path / "a.npy", features().astype(np.float16))
    assert FileMaps(tmp_path, VIEWS).encode(view()).dense.dtype == torch.float16


def test_ambiguous_layout_must_be_named(tmp_path):
    """16 channels of 12 x 16: [16, 12, 16] has the shape of the view in the last two axes and in no others;
    [12, 16, 12] of a 4:3 view in the first two; but [16, 16, 16] of a square view in both."""
    np.save(tmp_path / "a.npy", np.zeros((16, 16, 16), np.float32))
    square = view("a", 64, 64)
    with pytest.raises(InputError, match=r"a\.npy.*may be chw or hwc.*layout="):
        FileMaps(tmp_path, [square])
    assert FileMaps(tmp_path, [square], layout="chw").encode(square).channels == 16
    assert make_encoder(f"files:{tmp_path}?layout=hwc", [square]).encode(square).channels == 16


@pytest.mark.parametrize(("shape", "layout"), [((5, 16, 12), None), ((12, 16, 5), "chw"), ((5, 12, 16), "hwc")])
def test_features_of_another_shape(tmp_path, shape, layout):
    np.save(tmp_path / "a.npy", np.zeros(shape, np.float32))
    with pytest.raises(InputError, match=r"a\.npy.*shape of the view, 48 x 64"):
        FileMaps(tmp_path, VIEWS, layout=layout)


def test_the_folder_names_the_space(tmp_path):
    np.save(tmp_path / "a.npy", features())
    (tmp_path / "space.json").write_text(json.dumps({"space": "clip-vit-b32-512"}))
    assert FileMaps(tmp_path, VIEWS).encode(view()).space == "clip-vit-b32-512"


@pytest.mark.parametrize("text", ["{", "[1]", '{"space": 5}', '{"space": ""}', '{"name": "x"}'])
def test_bad_space_file(tmp_path, text):
    np.save(tmp_path / "a.npy", features())
    (tmp_path / "meta.json").write_text(text)
    with pytest.raises(InputError, match=r"meta\.json"):
        FileMaps(tmp_path, VIEWS)


@pytest.fixture
def pair(tmp_path):
    """A LangSplat pair of four levels, ids stored as floats as some writers do."""
    ids = np.random.default_rng(3).integers(-1, 6, size=(4, HEIGHT, WIDTH)).astype(np.float32)
    vectors = np.random.default_rng(4).normal(size=(6, 8)).astype(np.float16)
    np.save(tmp_path / "a_s.npy", ids)
    np.save(tmp_path / "a_f.npy", vectors)
    return tmp_path, ids, vectors


def test_langsplat_pair(pair):
    folder, ids, vectors = pair
    source = FileMaps(folder, VIEWS)
    found = source.encode(view())
    assert source.space == "files:8"
    assert found.ids.tolist() == ids.tolist()
    assert found.vectors.tolist() == vectors.astype(np.float32).tolist()
    chosen = make_encoder(f"files:{folder}?levels=3,1", VIEWS).encode(view())
    assert chosen.ids.tolist() == ids[[3, 1]].tolist()


def test_langsplat_ids_must_have_vectors(pair):
    folder, ids, vectors = pair
    np.save(folder / "a_f.npy", vectors[:5])
    with pytest.raises(InputError, match=r"a_s\.npy: ids go from -1 to 5, a_f\.npy has 5 rows"):
        FileMaps(folder, VIEWS).encode(view())
    (folder / "a_f.npy").unlink()
    with pytest.raises(InputError, match=r"a_f\.npy: no such file"):
        FileMaps(folder, VIEWS)
    np.save(folder / "a_s.npy", ids + 0.5)
    with pytest.raises(InputError, match=r"a_s\.npy: expected integer ids"):
        FileMaps(folder, VIEWS)


def test_level_out_of_range(pair):
    with pytest.raises(InputError, match=r"has no level 4; its levels are 0 to 3"):
        FileMaps(pair[0], VIEWS, levels=[1, 4])
    with pytest.raises(InputError, match=r"has no level -1; its levels are 0 to 3"):
        FileMaps(pair[0], VIEWS, levels=[-1])
    assert FileMaps(pair[0], VIEWS, levels=[0, 3]).encode(view()).ids.tolist() == pair[1][[0, 3]].tolist()


@pytest.mark.parametrize(
    ("name", "array", "message"),
    [
        ("a_s", np.zeros((2, WIDTH, HEIGHT)), r"a_s\.npy: is 48 x 64, not the shape of view a"),
        ("a_s", np.zeros((HEIGHT, WIDTH)), r"a_s\.npy: expected integer ids"),
        ("a_s", np.zeros((0, HEIGHT, WIDTH)), r"a_s\.npy: expected integer ids"),
        ("a_s", np.zeros((2, HEIGHT, WIDTH), complex), r"a_s\.npy: expected integer ids"),
        ("a_f", np.zeros((6, 8), np.int64), r"a_f\.npy: expected floating point \[M, C\], got int64"),
        ("a_f", np.zeros((6, 8, 1)), r"a_f\.npy: expected floating point \[M, C\]"),
    ],
)
def test_pairs_that_are_none(pair, name, array, message):
    np.save(pair[0] / f"{name}.npy", array)
    with pytest.raises(InputError, match=message):
        FileMaps(pair[0], VIEWS)


@pytest.mark.parametrize("suffix", [".npy", ".npz", ".pt", ".safetensors"])
@pytest.mark.parametrize("share", [0.0, 0.5])
def test_files_cut_short(tmp_path, suffix, share):
    path = tmp_path / f"a{suffix}"
    write(path, features())
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(InputError, match=rf"a\{suffix}: is (not a|no archive|empty|cut short)"):
        FileMaps(tmp_path, VIEWS)


class Payload:
    def __reduce__(self):
        return (print, ("a pickle was run",))


def test_pickled_code_is_not_run(tmp_path, capsys):
    torch.save({"features": Payload()}, tmp_path / "a.pt")
    with pytest.raises(InputError, match=r"a\.pt: holds nothing; store one array"):
        FileMaps(tmp_path, VIEWS)
    np.save(tmp_path / "a.npy", np.array([Payload()], dtype=object), allow_pickle=True)
    (tmp_path / "a.pt").unlink()
    with pytest.raises(InputError, match=r"a\.npy: holds object; expected numbers"):
        FileMaps(tmp_path, VIEWS)
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (np.zeros((12, 16), np.float32), "expected floating point"),
        (np.zeros((5, 12, 16), np.int32), "expected floating point"),
    ],
)
def test_arrays_that_are_no_features(tmp_path, content, message):
    np.save(tmp_path / "a.npy", content)
    with pytest.raises(InputError, match=message):
        FileMaps(tmp_path, VIEWS)


@pytest.mark.parametrize("name", ["features", "feat", "dense", "arr_0"])
def test_features_beside_other_arrays(tmp_path, name):
    values = features()
    np.savez(tmp_path / "a.npz", **{"scale": np.ones(3), name: values, "other": features(7)})
    assert FileMaps(tmp_path, VIEWS).encode(view()).dense.tolist() == values.tolist()


def test_several_arrays_without_a_known_name(tmp_path):
    np.savez(tmp_path / "a.npz", one=features(), two=features())
    with pytest.raises(InputError, match=r"a\.npz: holds one, two; store one array, or name it 'features'"):
        FileMaps(tmp_path, VIEWS)


def test_two_maps_of_one_view(tmp_path):
    np.save(tmp_path / "a.npy", features())
    cv2.imwrite(str(tmp_path / "a.png"), np.ones((HEIGHT, WIDTH), np.uint8))
    with pytest.raises(InputError, match=r"view a has another map, a\.npy"):
        FileMaps(tmp_path, VIEWS)


def test_two_kinds_in_a_folder(tmp_path):
    np.save(tmp_path / "b.npy", features())
    cv2.imwrite(str(tmp_path / "a.png"), np.ones((HEIGHT, WIDTH), np.uint8))
    with pytest.raises(InputError, match=r"b\.npy: holds dense, the maps before it labels"):
        FileMaps(tmp_path, VIEWS)


def test_empty_label_images(tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((HEIGHT, WIDTH), np.uint8))
    with pytest.raises(InputError, match=r"1 label images are 0 everywhere"):
        FileMaps(tmp_path, VIEWS)


def test_label_image_of_another_shape(tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), np.ones((WIDTH, HEIGHT), np.uint8))
    source = FileMaps(tmp_path, VIEWS)
    with pytest.raises(InputError, match=r"a\.png: is 48 x 64, not the shape of view a \(64 x 48\)"):
        source.encode(view())


def test_label_that_came_later(labels):
    folder, _ = labels
    source = FileMaps(folder, VIEWS)
    cv2.imwrite(str(folder / "a.png"), np.full((HEIGHT, WIDTH), 5, np.uint8))
    with pytest.raises(InputError, match=r"a\.png: id 5 was not there"):
        source.encode(view())
    ids = np.full((HEIGHT, WIDTH), 7, np.uint16)
    ids[5, 6] = 60000  # beyond all that were there
    cv2.imwrite(str(folder / "a.png"), ids)
    with pytest.raises(InputError, match=r"a\.png: id 60000 was not there"):
        source.encode(view())


def test_a_kind_that_came_later(labels):
    folder, _ = labels
    source = FileMaps(folder, VIEWS)
    assert [source.has_map(one) for one in VIEWS] == [True, True, False]
    np.save(folder / "c.npy", features())
    with pytest.raises(InputError, match=r"c\.npy: holds dense, the maps before it labels"):
        FileMaps(folder, VIEWS[:2]).encode(VIEWS[2])


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("files:nowhere", "nowhere: no such folder"),
        ("files:", "write files:DIR"),
        ("files:.?layout=abc", "layout is chw or hwc"),
        ("files:.?levels=s", "levels are numbers"),
        ("files:.?colour=1", "files has no option 'colour'"),
        ("files:.?layout", "option layout has no value; write it as key=value"),
    ],
)
def test_bad_names(name, message):
    with pytest.raises(InputError, match=message):
        make_encoder(name, VIEWS)


def test_folder_without_maps(tmp_path):
    np.save(tmp_path / "z.npy", features())
    with pytest.raises(InputError, match=r"holds no map of any of the 3 views; looked for \{stem\}\.png"):
        FileMaps(tmp_path, VIEWS)
