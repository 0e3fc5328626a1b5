"""The disk cache: nothing is encoded twice, nothing wrong is ever given back."""

import io
import json
import os
import shutil
import zipfile
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from sgwarp.encoders import cache
from sgwarp.encoders.base import MapSource, TextEncoder
from sgwarp.encoders.cache import CachedMaps, default_folder, pack, shrink, unpack
from sgwarp.errors import InputError
from sgwarp.scene import Camera, FeatureMap, View


class Source:
    """Counts how often it is asked."""

    space, needs_image = "toy-8", True

    def __init__(self, key="settings"):
        self.key, self.asked = key, 0

    def cache_key(self, view):
        return self.key

    def encode(self, view, image):
        self.asked += 1
        ids = (image[..., 0] * 3).long() - 1
        vectors = torch.randn(3, 8, generator=torch.Generator().manual_seed(int(image.sum())))
        return FeatureMap(self.space, ids=ids, vectors=vectors)

    def encode_text(self, texts):
        return torch.ones(len(texts), 8)


def same(one: FeatureMap, other: FeatureMap) -> bool:
    return torch.equal(one.ids, other.ids) and torch.equal(one.vectors, other.vectors)


def test_encoded_once(tmp_path, view, image):
    source = Source()
    cached = CachedMaps(source, tmp_path)
    assert isinstance(cached, MapSource)
    assert isinstance(cached, TextEncoder)
    first = cached.encode(view, image)
    assert same(cached.encode(view, image), first)  # the same bits, not only nearly
    assert (source.asked, cached.hits) == (1, 1)
    later = Source()
    assert same(CachedMaps(later, tmp_path).encode(view, image.clone()), first)
    assert later.asked == 0
    exact = Source().encode(view, image)
    torch.testing.assert_close(first.vectors, exact.vectors, rtol=2**-11, atol=1e-6)
    assert torch.equal(first.ids, exact.ids)


def test_everything_that_matters_makes_another_map(tmp_path, view, image):
    changed = image.clone()
    changed[3, 4, 1] += 1 / 255
    source = Source()
    for picture in (image, changed, image[:40], image.transpose(0, 1)):
        CachedMaps(source, tmp_path).encode(view, picture)
    assert source.asked == 4
    other = Source("other settings")
    CachedMaps(other, tmp_path).encode(view, image)
    assert other.asked == 1


def test_another_version_encodes_again(tmp_path, view, image, monkeypatch):
    source = Source()
    CachedMaps(source, tmp_path).encode(view, image)
    monkeypatch.setattr(cache, "__version__", "99.0")
    CachedMaps(source, tmp_path).encode(view, image)
    assert source.asked == 2


@pytest.mark.parametrize("damage", ["cut", "flipped", "empty", "text"])
def test_damaged_files_are_made_again(tmp_path, view, image, damage):
    source = Source()
    cached = CachedMaps(source, tmp_path)
    first = cached.encode(view, image)
    (path,) = tmp_path.glob("*.npz")
    content = bytearray(path.read_bytes())
    if damage == "cut":
        content = content[: len(content) // 2]
    elif damage == "flipped":
        content[len(content) // 3] ^= 255
    elif damage == "empty":
        content = bytearray()
    else:
        content = bytearray(b"not an archive at all")
    path.write_bytes(bytes(content))
    assert same(cached.encode(view, image), first)
    assert source.asked == 2
    assert same(cached.encode(view, image), first)
    assert source.asked == 2


def test_the_least_recently_used_go_first(tmp_path, view, image):
    source = Source()
    pictures = [(image + k / 10).clamp(0, 1) for k in range(4)]
    cached = CachedMaps(source, tmp_path)
    names = []
    for age, picture in enumerate(pictures[:3]):
        before = set(tmp_path.iterdir())
        cached.encode(view, picture)
        (path,) = set(tmp_path.iterdir()) - before
        os.utime(path, (1000 + age, 1000 + age))
        names.append(path)
    cached.encode(view, pictures[0])  # used again: now the second is the oldest
    size = max(path.stat().st_size for path in names)
    CachedMaps(source, tmp_path, limit=3.2 * size / 1e9).encode(view, pictures[3])
    assert names[0].exists()
    assert not names[1].exists()
    assert names[2].exists()
    assert len(list(tmp_path.iterdir())) == 3


def test_a_map_larger_than_the_limit_stays_until_the_next(tmp_path, view, image):
    cached = CachedMaps(Source(), tmp_path, limit=1e-9)
    cached.encode(view, image)
    assert len(list(tmp_path.iterdir())) == 1
    cached.encode(view, image / 2)
    assert len(list(tmp_path.iterdir())) == 1
    (tmp_path / "mine.txt").touch()
    shrink(tmp_path, 1e-12)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]  # only maps are removed


MAPS = {
    "ids": FeatureMap("s", ids=torch.tensor([[0, -1], [1, 1]]), vectors=torch.tensor([[0.5, 0.25], [1.0, 2.0]])),
    "labels": FeatureMap("labels", ids=torch.tensor([[0, -1], [1, 1]]), labels=("3", "40000")),
    "many ids": FeatureMap("s", ids=torch.arange(40000).view(200, 200), vectors=torch.zeros(40000, 1)),
    "dense": FeatureMap("s", dense=torch.rand(2, 3, 4).half(), valid=torch.tensor([[True, False, True]] * 2)),
    "shares": FeatureMap("labels", dense=torch.rand(2, 3, 2), labels=("a", "b")),
    "huge": FeatureMap("s", dense=torch.tensor([[[1e6, 1.0, 3.3]]])),
    "tiny": FeatureMap("s", dense=torch.tensor([[[1e-6, 2e-7]]])),
    "nothing": FeatureMap("s", ids=torch.tensor([[-1]]), vectors=torch.zeros(0, 3)),
}


@pytest.mark.parametrize("needs_image", [True, False])
def test_a_cache_needs_the_image_if_its_source_does(tmp_path, needs_image):
    source = SimpleNamespace(space="toy", needs_image=needs_image)
    assert CachedMaps(source, tmp_path).needs_image is needs_image


@pytest.mark.parametrize("name", MAPS)
def test_every_kind_of_map_survives(name):
    found = unpack(pack(MAPS[name]))
    assert (found.space, found.labels) == (MAPS[name].space, MAPS[name].labels)
    for part in ("ids", "valid"):
        mine, theirs = getattr(found, part), getattr(MAPS[name], part)
        assert (mine is None) == (theirs is None)
        assert mine is None or torch.equal(mine, theirs)
    for part in ("dense", "vectors"):
        mine, theirs = getattr(found, part), getattr(MAPS[name], part)
        assert (mine is None) == (theirs is None)
        if mine is not None:
            torch.testing.assert_close(mine.float(), theirs.float(), rtol=2**-11, atol=0)


def test_maps_are_small_on_disk(tmp_path, view):
    image = torch.full((480, 640, 3), 0.5)
    CachedMaps(Source(), tmp_path).encode(view, image)
    (path,) = tmp_path.iterdir()
    with np.load(path) as stored:
        assert stored["ids"].dtype == np.int8
        assert stored["vectors"].dtype == np.float16
    assert path.stat().st_size < 480 * 640 / 100


def test_features_are_not_compressed(tmp_path, view, image):
    """That would take longer than it saves."""
    source = Source()
    source.encode = lambda view, image: FeatureMap("toy-8", dense=torch.ones(48, 64, 8))
    CachedMaps(source, tmp_path).encode(view, image)
    (path,) = tmp_path.iterdir()
    with zipfile.ZipFile(path) as archive:
        assert {entry.compress_type for entry in archive.infolist()} == {zipfile.ZIP_STORED}
        assert archive.getinfo("dense.npy").file_size < 1.1 * 48 * 64 * 8 * 2


@pytest.mark.parametrize(
    ("values", "kind"),
    [
        ([0.0, 0.0], "float16"),
        ([0.0, 65504.0], "float16"),
        ([0.0, -65504.0], "float16"),
        ([2.0**-14, 0.0], "float16"),
        ([65520.0, 1.0], "float32"),
        ([2.0**-15, 0.0], "float32"),
    ],
)
def test_half_precision_is_taken_where_it_keeps_the_numbers(values, kind):
    assert pack(FeatureMap("s", dense=torch.tensor([[values]])))["dense"].dtype == kind


def test_its_folder_is_made_with_all_above_it(tmp_path, view, image):
    CachedMaps(Source(), tmp_path / "over" / "there").encode(view, image)
    assert len(list((tmp_path / "over" / "there").iterdir())) == 1
    CachedMaps(Source(), tmp_path / "over" / "there")


def test_phrases_go_to_the_source(tmp_path):
    assert CachedMaps(Source(), tmp_path).encode_text(["a", "b"]).tolist() == [[1.0] * 8] * 2
    mute = SimpleNamespace(space="mute", needs_image=True)
    with pytest.raises(InputError, match="space 'mute' has no text side here"):
        CachedMaps(mute, tmp_path).encode_text(["a"])


def test_sources_without_a_key_are_always_asked(tmp_path, view, image):
    source = Source(key=None)
    cached = CachedMaps(source, tmp_path)
    for _ in range(2):
        cached.encode(view, image)
    assert source.asked == 2
    assert not list(tmp_path.iterdir())


def test_a_source_that_knows_no_keys_is_always_asked(tmp_path, view, image):
    source = Source()
    plain = SimpleNamespace(space=source.space, needs_image=True, encode=source.encode)
    cached = CachedMaps(plain, tmp_path)
    for _ in range(2):
        cached.encode(view, image)
    assert (source.asked, cached.hits) == (2, 0)
    assert not list(tmp_path.iterdir())


def test_default_folder(monkeypatch, tmp_path):
    monkeypatch.setenv("SGWARP_CACHE", str(tmp_path / "here"))
    assert default_folder() == tmp_path / "here"
    monkeypatch.delenv("SGWARP_CACHE")
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert default_folder() == tmp_path / "sgwarp" / "maps"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert default_folder() == tmp_path / ".cache" / "sgwarp" / "maps"
    monkeypatch.setattr("sys.platform", "darwin")
    assert default_folder() == tmp_path / "Library" / "Caches" / "sgwarp" / "maps"
    monkeypatch.setattr("sys.platform", "win32")
    monkeypatch.delenv("LOCALAPPDATA", raising=False)
    assert default_folder() == tmp_path / "AppData" / "Local" / "sgwarp" / "maps"
    monkeypatch.setenv("LOCALAPPDATA", str(tmp_path / "local"))
    assert default_folder() == tmp_path / "local" / "sgwarp" / "maps"


def test_bad_places(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match=r"cannot be made .*; choose another, or none"):
        CachedMaps(Source(), tmp_path / "file" / "below")
    with pytest.raises(InputError, match=r"cannot be made \(File exists\)"):
        CachedMaps(Source(), tmp_path / "file")
    with pytest.raises(InputError, match="limit above 0"):
        CachedMaps(Source(), tmp_path, limit=0.0)


class Failing:
    """A source of id maps with a cache key."""

    space, needs_image = "mine", True

    def __init__(self) -> None:
        self.asked = 0

    def cache_key(self, view):
        return view.stem

    def encode(self, view, image):
        self.asked += 1
        ids = torch.full(image.shape[:2], int(view.stem) % 2)
        return FeatureMap("mine", ids=ids, vectors=torch.eye(2))


def two_views() -> list[View]:
    K = torch.tensor([[10.0, 0, 8], [0, 10, 6], [0, 0, 1]])
    return [View(stem, Camera(K, torch.eye(4), 16, 12)) for stem in ("0", "1")]


def test_maps_that_cannot_be_kept_cost_one_notice(tmp_path, caplog, disk):
    source = Failing()
    cached = CachedMaps(source, tmp_path)
    with disk(50):
        maps = [cached.encode(view, torch.zeros(12, 16, 3)) for view in two_views() for _ in range(2)]
    assert [int(found.ids.flatten()[0]) for found in maps] == [0, 0, 1, 1]
    assert source.asked == 4
    assert caplog.text.count("maps are not kept") == 1
    assert os.listdir(tmp_path) == []


def test_the_entry_of_another_view_is_not_used(tmp_path):
    source = Failing()
    first, second = two_views()
    image = torch.zeros(12, 16, 3)
    CachedMaps(source, tmp_path).encode(first, image)
    (one,) = tmp_path.iterdir()
    CachedMaps(source, tmp_path).encode(second, image)
    (two,) = set(tmp_path.iterdir()) - {one}
    shutil.copy(one, two)
    cached = CachedMaps(source, tmp_path)
    assert int(cached.encode(second, image).ids.flatten()[0]) == 1
    assert source.asked == 3
    assert cached.hits == 0
    assert int(cached.encode(second, image).ids.flatten()[0]) == 1
    assert cached.hits == 1


HEADER = b"\x93NUMPY\x01\x00\x3c\x00{'descr':'<f4','fortran_order':False,'shape':((((2,2,3)}     \n"


@pytest.mark.parametrize(
    "damage", ["folder", "header", "deep", "empty", "huge", "list", "number", "no ids", "no such row", "no name"]
)
def test_a_damaged_entry_is_made_again(tmp_path, damage):
    source = Failing()
    view, image = two_views()[1], torch.zeros(12, 16, 3)
    CachedMaps(source, tmp_path).encode(view, image)
    (path,) = tmp_path.iterdir()
    with np.load(path) as archive:
        stored = dict(archive)
    name = path.name.removesuffix(cache.SUFFIX)
    path.unlink()
    odd = {
        "list": {**stored, "header": as_header([name])},
        "number": {**stored, "header": as_header({"space": 3, "labels": None, "name": name})},
        "no ids": {key: value for key, value in stored.items() if key != "ids"},
        "no such row": {**stored, "ids": stored["ids"] + 2},
        "no name": {**stored, "header": as_header({"space": "mine", "labels": None})},
    }
    if damage in odd:
        np.savez(path, **odd[damage])
    elif damage == "folder":
        (path / "below").mkdir(parents=True)
    elif damage == "empty":
        path.touch()
    else:
        content = {
            "header": {"header": HEADER},
            "deep": {"header": numpy_bytes(b"[" * 100_000)},
            "huge": {"header": HEADER.replace(b"((((2,2,3)", b"(99999999,)")},
        }[damage]
        with zipfile.ZipFile(path, "w") as archive:
            for name, data in content.items():
                archive.writestr(f"{name}.npy", data)
    for _ in range(2):
        assert int(CachedMaps(source, tmp_path).encode(view, image).ids.flatten()[0]) == 1
    assert source.asked == 2
    assert path.is_file()


def as_header(content) -> np.ndarray:
    return np.frombuffer(json.dumps(content).encode(), np.uint8)


def numpy_bytes(text: bytes) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, np.frombuffer(text, np.uint8))
    return buffer.getvalue()


def test_the_limit_counts_what_others_write_and_removes_what_they_left(tmp_path):
    from sgwarp.files.atomic import _machine

    dead = tmp_path / f".a.map.{_machine()}-4194999-00000000.npz"
    writing = tmp_path / f".b.map.{_machine()}-1-00000000.npz"
    old, new = tmp_path / "old.map.npz", tmp_path / "new.map.npz"
    for number, path in enumerate((dead, writing, old, new)):
        path.write_bytes(bytes(1000))
        os.utime(path, (10**9 + number, 10**9 + number) if path != writing else None)
    shrink(tmp_path, 2500 / 1e9)
    assert {path.name for path in tmp_path.iterdir()} == {writing.name, new.name}


def test_maps_that_somebody_else_removes_meanwhile_do_not_count(tmp_path):
    """A link to nowhere is there when the folder is listed, and gone when its size is asked for."""
    for number in range(12):
        path = tmp_path / f"{number}.map.npz"
        if number % 4 == 1:
            path.write_bytes(bytes(100))
        else:
            path.symlink_to(tmp_path / "nowhere")
    shrink(tmp_path, 1e-12)
    assert not [path for path in tmp_path.iterdir() if not path.is_symlink()]
