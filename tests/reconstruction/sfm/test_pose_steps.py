"""A run from photographs to a model and its notes, step by step; a stand-in takes the place of COLMAP."""

import json
import logging
import os
from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from sgwarp.errors import InputError
from sgwarp.files.images import write_rgb
from sgwarp.reconstruction.sfm import features, poses
from sgwarp.reconstruction.sfm.features import SfmSettings
from sgwarp.reconstruction.sfm.poses import Registration, estimate_poses

SETTINGS = SfmSettings(seed=17, threads=3)


class Model:
    """What the mapper returns: all photographs but the last, with errors that an adjustment halves."""

    def __init__(self, names):
        self.names, self.error = names, 0.5

    def num_reg_images(self):
        return len(self.names)

    def reg_image_ids(self):
        return range(1, len(self.names) + 1)

    def image(self, number):
        return SimpleNamespace(name=self.names[::-1][number - 1])

    def num_points3D(self):
        return 123

    def compute_mean_reprojection_error(self):
        return self.error

    def update_point_3d_errors(self):
        assert self.error == 0.25  # they are those after the adjustment

    def write_binary(self, folder):
        assert os.listdir(folder) == []
        (Path(folder) / "images.bin").write_text(" ".join(self.names))


@pytest.fixture
def colmap(library, monkeypatch):
    """The stand-in, whose calls have their effects; `given` are the names of the photographs that it reads."""
    found = SimpleNamespace(given=[], resumed=[], config=[], options=None, library=library)

    def extract(database, folder, image_names, **rest):
        found.resumed.append(database.exists())
        database.touch()
        assert all((folder / name).is_file() for name in image_names)
        found.given.append(image_names)

    def mapping(database, folder, work, **rest):
        assert database.is_file()
        assert (folder / found.given[-1][0]).is_file()
        assert os.listdir(work) == []
        work.rmdir()  # it may leave nothing behind
        return {0: Model(found.given[-1][:-1])}

    def adjuster(options, config, model):
        found.options = options
        return SimpleNamespace(solve=lambda: setattr(model, "error", model.error / 2))

    empty = SimpleNamespace(read_all_images=lambda: [], read_two_view_geometries=lambda: ([], []))
    config = SimpleNamespace(add_image=found.config.append, fix_gauge=found.config.append)
    library.extract_features, library.incremental_mapping = extract, mapping
    library.create_default_bundle_adjuster, library.BundleAdjustmentConfig = adjuster, lambda: config
    library.BundleAdjustmentGauge = SimpleNamespace(TWO_CAMS_FROM_WORLD="two cameras")
    library.LossFunctionType = SimpleNamespace(CAUCHY="Cauchy")
    library.Database = SimpleNamespace(open=lambda path: nullcontext(empty))
    return found


def take(folder: Path, names: str = "a.png b.png sub/c.png d.png") -> Path:
    for name in names.split():
        write_rgb(folder / name, np.zeros((8, 8, 3), np.uint8))
    return folder


@pytest.fixture
def folder(tmp_path) -> Path:
    return take(tmp_path / "photos")


def test_a_run_leaves_the_model_its_notes_and_a_link_and_nothing_else(colmap, folder, tmp_path):
    out = tmp_path / "not" / "yet"
    found = estimate_poses(folder, out, SETTINGS)
    assert colmap.library.calls[0] == ("set_random_seed", (17,), {})
    assert colmap.given == [["a.png", "b.png", "d.png", "sub/c.png"]]
    reasons = {"sub/c.png": "only 0 features: blurred, dark, or of something even"}
    assert found == Registration(("a.png", "b.png", "d.png"), reasons, 123, 0.25)
    assert sorted(os.listdir(out)) == ["images", "sfm.json", "sparse"]
    assert os.listdir(out / "sparse" / "0") == ["images.bin"]
    assert (out / "images").is_symlink()
    assert (out / "images").resolve() == folder.resolve()
    notes = json.loads((out / "sfm.json").read_text())
    assert notes.pop("fingerprint")
    assert notes == asdict(found) | {"registered": ["a.png", "b.png", "d.png"]}


def test_the_last_adjustment_is_of_all_that_was_placed(colmap, folder, tmp_path):
    """Cauchy's loss of half a pixel; two cameras hold what a similarity could change."""
    estimate_poses(folder, tmp_path / "out", SETTINGS)
    assert colmap.config == [1, 2, 3, "two cameras"]
    ceres = colmap.options.ceres
    assert (ceres.loss_function_type, ceres.loss_function_scale) == ("Cauchy", 0.5)
    assert (ceres.solver_options.max_num_iterations, ceres.solver_options.num_threads) == (200, 3)
    assert not colmap.options.print_summary


def test_a_model_of_the_same_photographs_is_kept(colmap, folder, tmp_path, caplog):
    out = tmp_path / "out"
    first = estimate_poses(folder, out, SETTINGS)
    with caplog.at_level(logging.INFO, "sgwarp"):
        assert estimate_poses(folder, out, SETTINGS) == first
    assert len(colmap.given) == 1
    assert f"{out}: holds the poses of these photographs already" in caplog.text
    (out / "sparse/0/images.bin").unlink()  # by whom ever
    assert estimate_poses(folder, out, SETTINGS) == first
    assert len(colmap.given) == 2


def test_another_photograph_makes_another_model(colmap, folder, tmp_path):
    out = tmp_path / "out"
    estimate_poses(folder, out, SETTINGS)
    (out / "sparse/0/left.over").touch()
    (out / "database.db").touch()  # of photographs that are not the same any more
    (out / "whole").mkdir()
    (out / "whole" / "half written").touch()
    (out / "mapping").mkdir()
    (out / "mapping" / "half written").touch()
    take(folder, "e.png")
    assert len(estimate_poses(folder, out, SETTINGS).registered) == 4
    assert colmap.resumed == [False, False]
    assert os.listdir(out / "sparse/0") == ["images.bin"]
    assert sorted(os.listdir(out)) == ["images", "sfm.json", "sparse"]


def test_an_interrupted_run_goes_on_where_it_was(colmap, folder, tmp_path, monkeypatch):
    def interrupted(*arguments, **rest):
        raise KeyboardInterrupt

    with monkeypatch.context() as during:
        during.setattr(colmap.library, "incremental_mapping", interrupted)
        with pytest.raises(KeyboardInterrupt):
            estimate_poses(folder, tmp_path / "out", SETTINGS)
    estimate_poses(folder, tmp_path / "out", SETTINGS)
    assert colmap.resumed == [False, True]


def test_the_link_is_to_the_photographs_of_the_model(colmap, folder, tmp_path):
    other = take(tmp_path / "others")
    for photographs in (folder, other):
        estimate_poses(photographs, tmp_path / "out", SETTINGS)
        assert (tmp_path / "out/images").resolve() == photographs.resolve()


def test_frames_that_lie_in_the_folder_stay_there(colmap, tmp_path):
    frames = take(tmp_path / "out/images")
    estimate_poses(frames, tmp_path / "out", SETTINGS)
    assert not frames.is_symlink()
    assert (frames / "a.png").is_file()


def test_where_no_link_can_be_made_the_remedy_is_named(colmap, folder, tmp_path, monkeypatch, caplog):
    def refuse(*arguments, **options):
        raise OSError

    monkeypatch.setattr(Path, "symlink_to", refuse)
    estimate_poses(folder, tmp_path / "out", SETTINGS)
    link = tmp_path / "out" / "images"
    said = f"{link}: cannot be made a link to the photographs; name them with --images {folder}"
    assert said in caplog.text


@pytest.mark.parametrize("place", ["mapping", "whole/sub", "sparse/0"])
def test_photographs_are_not_taken_from_where_results_go(colmap, tmp_path, place):
    photographs = take(tmp_path / place)
    with pytest.raises(InputError, match="would be removed by the results, which go there; choose another --out"):
        estimate_poses(photographs, tmp_path, SETTINGS)
    assert (photographs / "a.png").is_file()


@pytest.mark.parametrize("notes", ["[]", "{", "5"])
def test_notes_that_are_none_are_those_of_another_program(colmap, folder, tmp_path, notes):
    out = tmp_path / "out"
    out.mkdir()
    (out / "sfm.json").write_text(notes)
    (out / "database.db").write_text("days of work")
    with pytest.raises(InputError, match=r"database\.db: is there already, and `sgwarp poses` did not make it"):
        estimate_poses(folder, out, SETTINGS)
    assert (out / "database.db").read_text() == "days of work"


def test_photographs_of_formats_that_are_not_read_are_named(colmap, folder, tmp_path, caplog):
    (folder / "e.heic").touch()
    estimate_poses(folder, tmp_path / "out", SETTINGS)
    assert f"{folder}: holds photographs that are not decoded (1 HEIC files)" in caplog.text


def test_photographs_that_cannot_be_read_are_left_out_with_the_reason(colmap, folder, tmp_path):
    (folder / "broken.png").write_bytes(b"no image")
    write_rgb(folder / "e.png", np.zeros((8, 8, 3), np.uint8))
    (folder / "e.png").rename(folder / "E.WEBP")
    found = estimate_poses(folder, tmp_path / "out", SETTINGS)
    assert colmap.given == [["a.png", "b.png", "d.png", "sub/c.png"]]
    assert found.left_out["broken.png"] == "cannot be read"
    assert found.left_out["E.WEBP"].startswith("needs another format: COLMAP reads no webp, convert it")
    assert list(found.left_out) == sorted(found.left_out)


@pytest.mark.parametrize(("whole", "enough"), [(2, False), (3, True)])
def test_three_photographs_have_to_be_left(colmap, tmp_path, whole, enough):
    take(tmp_path / "photos", "a.png b.png c.png" if enough else "a.png b.png")
    (tmp_path / "photos/0.png").write_bytes(b"no image")
    if enough:
        assert len(estimate_poses(tmp_path / "photos", tmp_path / "out", SETTINGS).registered) == whole - 1
    else:
        with pytest.raises(InputError, match=r"0\.png: cannot be read \(1 of 3 photographs\)"):
            estimate_poses(tmp_path / "photos", tmp_path / "out", SETTINGS)


@pytest.mark.parametrize(("placed", "told"), [(0, 2), (1, 3), (3, 5), (9, 5)])
def test_progress_counts_the_photographs_that_are_placed(library, tmp_path, monkeypatch, placed, told):
    """The first two are placed together; those that are tried in vain are counted, too."""
    reports = []

    def mapping(*arguments, next_image_callback, **options):
        for _ in range(placed):
            next_image_callback()
        return {0: Model(["a", "b", "c"])}

    library.incremental_mapping = mapping
    monkeypatch.setattr(poses, "run_cancellable", lambda database, call, watch: (call("t"), watch())[0])
    poses._map(tmp_path / "d.db", tmp_path, tmp_path, SETTINGS, 5, lambda *call: reports.append(call))
    assert reports == [(told, 5, "placing photographs")]


def test_results_of_earlier_versions_are_known(tmp_path):
    (tmp_path / "a.png").write_bytes(b"abc")
    os.utime(tmp_path / "a.png", ns=(0, 1_500_000_000_123_456_789))
    assert poses._fingerprint(tmp_path, ["a.png"], SfmSettings()) == "35d98bc350bbc23d"


def test_the_room_that_features_and_matches_need(library, tmp_path, monkeypatch):
    """At most 8192 features of six floats and 128 bytes; as many pairs of numbers, as found and as checked."""
    asked = []
    for name in ("a.png", "b.png"):
        write_rgb(tmp_path / name, np.zeros((8, 8, 3), np.uint8))
    monkeypatch.setattr(features, "require_room", lambda database, more: asked.append((database, more)))
    database = tmp_path / "d.db"
    features.store_features(database, tmp_path, ["a.png", "b.png"], SETTINGS, None)
    one, pair = 8192 * (6 * 4 + 128), 2 * 8192 * 2 * 4
    for spaced in ("", " "):
        names = [f"{k}{spaced}.png" for k in range(13)]
        features.match_features(database, features.choose_pairs(names, "exhaustive"), SETTINGS, lambda *call: None)
    assert asked == [(database, 2 * one), *((database, count * pair) for count in (64, 14, 78))]


def test_every_call_can_be_canceled(colmap, folder, tmp_path, monkeypatch):
    tokens = []
    calls = ("extract_features", "match_image_pairs", "match_exhaustive", "match_sequential", "incremental_mapping")
    for name in calls:
        original = getattr(colmap.library, name)

        def noted(*arguments, name=name, original=original, cancellation_token=None, **options):
            tokens.append((name, cancellation_token))
            return original(*arguments, **options)

        monkeypatch.setattr(colmap.library, name, noted)
    estimate_poses(folder, tmp_path / "out", SETTINGS)
    for matching in ("exhaustive", "sequential"):
        pairs = features.choose_pairs([f"a {k}" for k in range(20)], matching)
        features.match_features(tmp_path / "d.db", pairs, SETTINGS, lambda *call: None)
    assert sorted(tokens) == sorted((name, "t") for name in calls)
