"""What structure from motion is told reaches the library, seen by a stand-in for it that notes what it is given."""

from contextlib import nullcontext
from itertools import combinations, pairwise
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch

from sgwarp.errors import InputError
from sgwarp.files.images import write_rgb
from sgwarp.reconstruction.sfm import features, poses, triangulation
from sgwarp.reconstruction.sfm.features import SfmSettings, choose_pairs
from sgwarp.reconstruction.stereo import choose_neighbors
from sgwarp.scene import Camera

SETTINGS = SfmSettings(camera_model="OPENCV", seed=17, threads=3)


@pytest.mark.parametrize(("width", "height", "faint"), [(999, 600, True), (600, 999, True), (1000, 600, False)])
@pytest.mark.parametrize(("one_camera", "camera"), [(True, 5), (False, None)])
def test_options_of_features(library, tmp_path, width, height, faint, one_camera, camera):
    """Small photographs alone give features that are fainter than COLMAP's 0.0067."""
    write_rgb(tmp_path / "a.png", np.zeros((height, width, 3), np.uint8))
    settings = SfmSettings(camera_model="OPENCV", threads=3, one_camera=one_camera)
    features.store_features(tmp_path / "d.db", tmp_path, ["a.png", "b.png"], settings, camera)
    ((name, arguments, options),) = library.calls
    assert (name, arguments) == ("extract_features", (tmp_path / "d.db", tmp_path))
    assert options["image_names"] == ["a.png", "b.png"]
    assert options["camera_mode"] == ("single" if one_camera else "each")
    reader, extraction = options["reader_options"], options["extraction_options"]
    assert reader.camera_model == "OPENCV"
    assert vars(reader).get("existing_camera_id") == camera
    assert (extraction.max_image_size, extraction.num_threads, extraction.use_gpu) == (1600, 3, False)
    assert vars(extraction.sift).get("peak_threshold") == (0.0015 if faint else None)


def test_photographs_of_one_size_go_together(library, monkeypatch, tmp_path):
    sizes = {f"{k:02d}.png": (60, 80) if k % 3 else (80, 60) for k in range(30)}
    stored, told = [], []
    monkeypatch.setattr(features, "read_size", lambda path: sizes[path.name])
    monkeypatch.setattr(features, "store_features", lambda d, f, names, s, camera: stored.append((names, camera)))
    monkeypatch.setattr(features, "_camera_of", lambda database, names: len(names))
    features.extract_features(tmp_path / "d.db", tmp_path, list(sizes), SETTINGS, lambda *call: told.append(call))
    assert sorted(name for names, _ in stored for name in names) == list(sizes)
    assert all(len(names) <= 8 and len({sizes[name] for name in names}) == 1 for names, _ in stored)
    assert {camera for _, camera in stored} == {10, 20}
    assert told[0][0] == 0
    assert told[-1] == (30, 30, "finding features")
    assert all(after[0] > before[0] for before, after in pairwise(told))


@pytest.mark.parametrize("spaced", [False, True])
def test_options_of_matching(library, tmp_path, monkeypatch, spaced):
    names = ["a b.png" if spaced else "a.png", *(f"{k}.png" for k in range(12))]
    pairs, listed, told = choose_pairs(names, "exhaustive"), [], []
    monkeypatch.setattr(
        library, "match_image_pairs", lambda *a, **o: listed.append((o, (tmp_path / "pairs.txt").read_text()))
    )
    features.match_features(tmp_path / "d.db", pairs, SETTINGS, lambda *call: told.append(call))
    if spaced:
        ((name, _, options),) = library.calls
        assert name == "match_exhaustive"
        matching = options["matching_options"]
    else:
        assert "".join(text for _, text in listed) == "".join(f"{a} {b}\n" for a, b in pairs)
        assert [text.count("\n") for _, text in listed] == [64, 14]
        assert [done for done, _, _ in told] == [0, 64, 78]
        assert not (tmp_path / "pairs.txt").exists()
        options = listed[0][0]
        matching = options["matching_options"]
        assert options["pairing_options"].match_list_path == tmp_path / "pairs.txt"
    assert (matching.num_threads, matching.use_gpu, options["device"]) == (3, False, "cpu")


def test_a_sequence_with_spaces_is_matched_as_one(library, tmp_path):
    pairs = choose_pairs([f"a {k}" for k in range(40)], "sequential")
    features.match_features(tmp_path / "d.db", pairs, SETTINGS, lambda *call: None)
    ((name, _, options),) = library.calls
    assert name == "match_sequential"
    assert (options["pairing_options"].overlap, options["pairing_options"].quadratic_overlap) == (12, True)
    assert options["matching_options"].num_threads == 3


@pytest.mark.parametrize(
    ("count", "matching", "all_pairs"),
    [(150, "auto", True), (151, "auto", False), (151, "exhaustive", True), (20, "sequential", False)],
)
def test_which_photographs_are_compared(count, matching, all_pairs):
    found = {tuple(map(int, pair)) for pair in choose_pairs([str(k) for k in range(count)], matching)}
    expected = set(combinations(range(count), 2))
    if not all_pairs:  # the twelve that follow, then the 16th, the 32nd, ...
        expected = {(a, b) for a, b in expected if b - a <= 12 or (b - a) & (b - a - 1) == 0}
    assert found == expected


def looking(place, axis=(0.0, 0.0, 1.0)) -> Camera:
    """At a place, along an axis in the plane of x and z."""
    z = np.array(axis) / np.linalg.norm(axis)
    x = np.cross([0.0, 1.0, 0.0], z)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([x, np.cross(z, x), z])
    pose[:3, 3] = -pose[:3, :3] @ np.array(place, np.float64)
    K = torch.tensor([[50.0, 0, 32], [0, 50, 24], [0, 0, 1]])
    return Camera(K, torch.from_numpy(pose), 64, 48)


def turned(degrees: float) -> tuple[float, float, float]:
    return float(np.sin(np.radians(degrees))), 0.0, float(np.cos(np.radians(degrees)))


def test_each_is_matched_with_its_nearest_twenty():
    cameras = [looking((1.03**k, 0, 0)) for k in range(60)]  # at distances that all differ
    found = triangulation._pairs(cameras)
    for a in range(60):
        others = sorted((b for b in range(60) if b != a), key=lambda b: abs(1.03**a - 1.03**b))[:20]
        assert {(min(a, b), max(a, b)) for b in others} <= found
    assert (0, 59) not in found
    assert all(a < b for a, b in found)


@pytest.mark.parametrize(("degrees", "matched", "neighbors"), [(50, True, True), (55, True, False), (75, False, False)])
def test_what_looks_another_way_is_not_matched(degrees, matched, neighbors):
    """Cosines of 0.3 for features, which are found again from farther off, and 0.6 for the comparison of pixels."""
    cameras = [looking((0, 0, 0)), looking((1.0, 0, 0), turned(degrees))]
    assert (triangulation._pairs(cameras) == {(0, 1)}) == matched
    assert (choose_neighbors(cameras, 1.0) == [[1], [0]]) == neighbors


@pytest.mark.parametrize("extent", [1.0, 100.0])
def test_neighbors_lie_a_little_beside_whatever_the_unit(extent):
    """Not closer than a fiftieth of the extent, and then the nearest three, the fifth, the eighth and the twelfth."""
    places = [0.0, 0.019, *(0.021 + 0.1 * k for k in range(14))]
    found = choose_neighbors([looking((extent * x, 0, 0)) for x in places], extent)
    assert found[0] == [2, 3, 4, 6, 9, 13]


def test_of_those_equally_far_the_first_are_taken():
    cameras = [looking((0, 0, 0)), *[looking((1.0, 0, 0))] * 60]
    assert choose_neighbors(cameras, 1.0)[0] == [1, 2, 3, 5, 8, 12]
    assert {b for a, b in triangulation._pairs(cameras) if a == 0} == {*range(1, 21)}


@pytest.mark.parametrize("first", [True, False])
def test_options_of_mapping(library, tmp_path, monkeypatch, first):
    """COLMAP's own first; where no two photographs can be placed so, two that are closer together."""
    models = {0: SimpleNamespace(num_reg_images=lambda: 4), 1: SimpleNamespace(num_reg_images=lambda: 7)}
    given = []

    def mapping(*arguments, options, **rest):
        assert arguments == (tmp_path / "d.db", tmp_path / "photos", tmp_path / "mapping")
        given.append((options.random_seed, options.num_threads, options.min_model_size, dict(vars(options.mapper))))
        return models if first or len(given) == 2 else {}

    monkeypatch.setattr(library, "incremental_mapping", mapping)
    found = poses._map(tmp_path / "d.db", tmp_path / "photos", tmp_path, SETTINGS, 12, lambda *call: None)
    assert found is models[1]
    assert given[0] == (17, 3, 3, {})
    assert given[1:] == ([] if first else [(17, 3, 3, {"init_min_tri_angle": 4.0, "init_min_num_inliers": 30})])
    assert not (tmp_path / "mapping").exists()


@pytest.mark.parametrize(("count", "warned"), [(12, True), (7, False)])
def test_parts_that_could_not_be_joined_are_named(library, tmp_path, monkeypatch, caplog, count, warned):
    models = {0: SimpleNamespace(num_reg_images=lambda: 4), 1: SimpleNamespace(num_reg_images=lambda: 7)}
    monkeypatch.setattr(library, "incremental_mapping", lambda *a, **o: models)
    poses._map(tmp_path / "d.db", tmp_path, tmp_path, SETTINGS, count, lambda *call: None)
    said = "falls into 2 parts that could not be joined; the largest is used (7 photographs; others: 4)"
    assert (said in caplog.text) == warned


def test_one_part_that_lacks_photographs_is_no_part_among_others(library, tmp_path, monkeypatch, caplog):
    models = {0: SimpleNamespace(num_reg_images=lambda: 7)}
    monkeypatch.setattr(library, "incremental_mapping", lambda *a, **o: models)
    assert poses._map(tmp_path / "d.db", tmp_path, tmp_path, SETTINGS, 12, lambda *call: None) is models[0]
    assert not caplog.records


def test_photographs_that_cannot_be_placed_are_an_error(library, tmp_path, monkeypatch):
    monkeypatch.setattr(library, "incremental_mapping", lambda *a, **o: {})
    with pytest.raises(InputError, match="no two photographs overlap enough"):
        poses._map(tmp_path / "d.db", tmp_path, tmp_path, SETTINGS, 12, lambda *call: None)


def test_reasons_for_photographs_without_a_pose(library, tmp_path, monkeypatch):
    keypoints = {1: 199, 2: 200, 3: 5000, 4: 5000, 5: 5000}
    matches = {(2, 5): 29, (3, 5): 30, (4, 5): 10}
    data = SimpleNamespace(
        read_all_images=lambda: [SimpleNamespace(name=str(k), image_id=k) for k in keypoints],
        read_two_view_geometries=lambda: (
            list(matches),
            [SimpleNamespace(inlier_matches=[0] * n) for n in matches.values()],
        ),
        num_keypoints_for_image=keypoints.get,
    )
    library.Database = SimpleNamespace(open=lambda path: nullcontext(data))
    library.pair_id_to_image_pair = lambda pair: pair
    found = poses._reasons(tmp_path, {"0": "cannot be read"}, ["1", "2", "3", "4", "5", "6"], ["4", "5"])
    begins = {"0": "cannot be read", "1": "only 199 features", "2": "overlaps no other photograph enough"}
    begins |= {"3": "overlaps others, but shows too few", "6": "only 0 features"}
    assert list(found) == list(begins)
    assert all(found[name].startswith(text) for name, text in begins.items())


@pytest.mark.parametrize(
    "change", [{"matching": "sequential"}, {"one_camera": False}, {"camera_model": "OPENCV"}, {"seed": 1}]
)
def test_poses_are_kept_for_the_same_settings_alone(tmp_path, change):
    (tmp_path / "a.png").write_bytes(b"a")
    plain = poses._fingerprint(tmp_path, ["a.png"], SfmSettings())
    assert plain == poses._fingerprint(tmp_path, ["a.png"], SfmSettings(threads=2))  # which decide nothing
    assert plain != poses._fingerprint(tmp_path, ["a.png"], SfmSettings(**change))
    (tmp_path / "a.png").write_bytes(b"ab")
    assert plain != poses._fingerprint(tmp_path, ["a.png"], SfmSettings())


def test_settings_of_structure_from_motion():
    assert vars(SfmSettings()) == {
        "matching": "auto",
        "one_camera": True,
        "camera_model": "SIMPLE_RADIAL",
        "seed": 0,
        "threads": -1,
    }


@pytest.mark.parametrize(("lengths", "kept"), [((2, 2, 3, 3, 4), 3), ((2, 2, 2, 3, 4), 0), ((3, 3), 2), ((), 0)])
def test_points_of_wrong_poses_are_not_used(caplog, lengths, kept):
    """Three of five points in three photographs or more is what right poses have at the least."""
    points = [SimpleNamespace(track=SimpleNamespace(length=lambda n=n: n)) for n in lengths]
    assert len(triangulation._consistent(points)) == kept
    assert ("contradict the photographs" in caplog.text) == (bool(lengths) and not kept)


@pytest.mark.parametrize(("size", "stored"), [((1200, 1600), (1200, 1600)), ((2400, 3200), (1200, 1600))])
def test_photographs_are_made_small_for_features_with_their_camera(tmp_path, size, stored):
    K = torch.tensor([[2000.0, 0, size[1] / 2], [0, 2000, size[0] / 2], [0, 0, 1]])
    given = Camera(K, torch.eye(4), size[1], size[0])
    view = SimpleNamespace(camera=given, image=lambda: torch.zeros(*size, 3))
    camera = triangulation._store(view, tmp_path, "a.png")
    assert camera.size == stored
    assert camera.K[0, 0].item() == pytest.approx(2000 * stored[1] / size[1])
    assert cv2.imread(str(tmp_path / "a.png")).shape == (*stored, 3)
