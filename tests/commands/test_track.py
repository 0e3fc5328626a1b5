"""`sgwarp track` on files in Dynamic3DGaussians' layout: what it writes, and that a killed run ends the same."""

import json
import shutil
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from sgwarp.apps.tracking import run as tracking_run
from sgwarp.apps.tracking.answers import Questions
from sgwarp.apps.tracking.association import Associated
from sgwarp.apps.tracking.sources import LabelFrames
from sgwarp.apps.tracking.state import read_features
from sgwarp.apps.tracking.tracker import Tracker, track
from sgwarp.cli import main
from sgwarp.datasets.moving import LABELS, make_moving_scene
from sgwarp.datasets.moving_files import save_moving_scene
from sgwarp.errors import InputError
from sgwarp.files.images import read_ids, read_rgb
from sgwarp.io.moving_views import load_moving_views
from sgwarp.io.scenes import save_gaussians
from sgwarp.io.sequences import load_sequence
from sgwarp.scene import FeatureMap

FRAMES = 6


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("moving")
    scene = make_moving_scene(0, FRAMES, 2500, cameras=4, width=64, height=48, moving_share=0.5)
    save_moving_scene(scene, folder, held_out=1, noise=0.1)
    return folder


def arguments(files, out, *more):
    parts = ["track", files / "params.npz", "--views", files, "--encoder", f"files:{files / 'labels'}", "--out", out]
    return [*map(str, parts), "--no-pictures", *more]


@pytest.fixture(scope="module")
def tracked(files, tmp_path_factory):
    out = tmp_path_factory.mktemp("tracked") / "out"
    assert main(arguments(files, out, "--features")) == 0
    return out


def written(folder):
    """Content of everything that a run answers with."""
    paths = [path for path in sorted(folder.rglob("*")) if path.is_file()]
    return {str(p.relative_to(folder)): p.read_bytes() for p in paths if p.name not in ("run.json", "state.pt")}


def test_masks_and_tracks(files, tracked):
    good = total = 0
    for frame in range(1, FRAMES):
        for stem in ("0", "1", "2"):
            found = read_ids(tracked / f"{frame:05d}" / f"{stem}.png")
            truth = read_ids(files / "truth" / f"{frame:05d}" / f"{stem}.png")
            good += int((found == truth).sum())
            total += truth.size
        assert not (tracked / f"{frame:05d}" / "3.png").exists()  # held out
    assert good / total > 0.75
    tracks = json.loads((tracked / "tracks.json").read_text())
    assert tracks["frames"] == list(range(FRAMES))
    assert tracks["views"] == ["0", "1", "2"]
    ball = tracks["objects"][str(LABELS.index("ball") + 1)]
    assert {len(values) for values in ball.values()} == {FRAMES}
    assert ball["visible"][2]
    seen = read_ids(tracked / "00002" / "1.png") == LABELS.index("ball") + 1
    assert ball["pixels"][2]["1"] == int(seen.sum())
    floor = tracks["objects"][str(LABELS.index("floor") + 1)]
    assert np.abs(floor["centroid"]).max() < 0.4  # its middle is the origin; it reaches to 2.2
    assert tracks["switches"][0] is None
    assert len(tracks["left_out"]) == FRAMES


@pytest.mark.slow
def test_the_run_says_what_it_left_out(tracked):
    run = json.loads((tracked / "run.json").read_text())
    assert run["command"].startswith("sgwarp track")
    assert {"read", "lift", "encode", "fuse", "ask", "write"} <= set(run["stages"])
    assert run["left_out"]["projections"] > 0
    assert 0 < run["error"]["share_of_tiles_left_out"] < 1
    assert str(tracked / "tracks.json") in run["outputs"]


@pytest.mark.slow
def test_pictures(files, tracked, tmp_path):
    import cv2

    assert not {"video.mp4", "contact_sheet.jpg", "trajectories.png"} & {path.name for path in tracked.iterdir()}
    assert main([*arguments(files, tmp_path, "--frames", "3"), "--pictures"]) == 0
    height, width = read_rgb(tmp_path / "overlays" / "00000.jpg").shape[:2]
    sheet = read_rgb(tmp_path / "contact_sheet.jpg")
    assert sheet.shape[0] >= 2 * height
    assert sheet.shape[1] >= 2 * width
    assert read_rgb(tmp_path / "trajectories.png").std() > 5
    video = cv2.VideoCapture(str(tmp_path / "video.mp4"))
    frames = 0
    while video.read()[0]:
        frames += 1
    assert frames == 3


def test_stored_features_are_those_of_the_frame(files, tracked):
    """What was left out differs by less than a hundredth of a row's length, and is less than everything."""
    for one in track(load_sequence(files), load_moving_views(files), LabelFrames(files / "labels")):
        stored = torch.from_numpy(read_features(tracked / "features", one.index)).float()
        wanted = torch.where(one.weight[:, None] > 0, one.features, 0.0)
        assert float((stored - wanted).abs().max()) <= 0.011
    run = json.loads((tracked / "run.json").read_text())
    assert run["left_out"]["stored_features_that_did_not_change"] > 0


@pytest.mark.slow
@pytest.mark.parametrize("after", [1, 4])
def test_a_killed_run_goes_on_to_the_same_bytes(files, tracked, tmp_path, monkeypatch, after):
    out, write = tmp_path / "out", tracking_run._write
    monkeypatch.setattr(tracking_run, "Output", partial(tracking_run.Output, every=2))

    def dies(output, one, *rest):
        if one.index == after:
            raise SystemExit(9)
        write(output, one, *rest)

    monkeypatch.setattr(tracking_run, "_write", dies)
    with pytest.raises(SystemExit):
        main(arguments(files, out, "--features"))
    assert not (out / "tracks.json").exists()
    monkeypatch.setattr(tracking_run, "_write", write)
    assert main(arguments(files, out, "--features", "--resume")) == 0
    first = after // 2 * 2  # behind the last checkpoint
    run = json.loads((out / "run.json").read_text())
    assert run["left_out"].get("frames_done_before", 0) == first
    mine, whole = written(out), written(tracked)
    rows = [json.loads(found.pop(f"{first:05d}/frame.json")) for found in (mine, whole)]
    tracks = [json.loads(found.pop("tracks.json")) for found in (mine, whole)]
    # What is kept of the views is not stored: the first frame is lifted in full.
    assert (rows[0].pop("left_out"), tracks[0]["left_out"].pop(first)) == (0.0, 0.0)
    rows[1].pop("left_out"), tracks[1]["left_out"].pop(first)
    assert (rows[0], tracks[0]) == (rows[1], tracks[1])
    assert mine == whole


@pytest.mark.slow
def test_resume_needs_the_same_options(files, tracked, capsys):
    assert main(arguments(files, tracked, "--features", "--resume", "--forgetting", "0.5")) == 2
    assert "had forgetting 0.9, now 0.5" in capsys.readouterr().err
    assert main(arguments(files, tracked, "--features", "--resume", "--mask-views", str(files))) == 2
    assert "had mask_views None, now [" in capsys.readouterr().err


CARRIED = ("forgetting", "patience", "change", "foreground", "scoring", "temperature", "unknown_below", "photographs")


def test_resume_compares_whatever_changes_the_answer(stopped, tmp_path):
    """Of the options, and of scene, views and encoder; not of those that change only what is drawn or how fast."""
    plain = stopped().output.settings
    for name in (*CARRIED, "split"):
        value = OPTIONS[name][0]
        option = f"--{name.replace('_', '-')}"
        given = [option, value] if not isinstance(value, bool) else [option if value else f"--no-{option[2:]}"]
        settings = stopped(*given).output.settings
        assert [key for key in plain if plain[key] != settings[key]] == [name]
    np.savetxt(tmp_path / "t.txt", np.eye(4))
    assert stopped("--transform", tmp_path / "t.txt").output.settings != plain
    asked = stopped("--classes", "1", "--text", "x", "--encoder", f"files:{plain['views']}/truth").output.settings
    assert {key for key in plain if plain[key] != asked[key]} == {"classes", "text", "encoder"}
    for option in ("--no-incremental", "--features", "--no-pictures"):
        assert stopped(option).output.settings == plain


def test_incremental_or_not_is_the_same(files, tracked, tmp_path):
    assert main(arguments(files, tmp_path, "--features", "--no-incremental")) == 0
    mine = {name: data for name, data in written(tmp_path).items() if name.endswith((".png", ".npz"))}
    theirs = {name: data for name, data in written(tracked).items() if name.endswith((".png", ".npz"))}
    assert mine == theirs


def test_every_frame_alone_differs_from_fused(files, tracked, tmp_path):
    assert main(arguments(files, tmp_path, "--forgetting", "0")) == 0
    assert (tmp_path / "00000" / "1.png").read_bytes() == (tracked / "00000" / "1.png").read_bytes()
    assert (tmp_path / "00003" / "1.png").read_bytes() != (tracked / "00003" / "1.png").read_bytes()


@pytest.mark.slow
def test_a_class_may_appear_in_a_later_frame(files, tmp_path, caplog):
    """An id that no image of the first frames shows is a class that is not there yet; one in no frame is said."""
    ids = {frame: set() for frame in range(FRAMES)}
    for path in (files / "truth").rglob("*.png"):
        ids[int(path.parent.name)] |= set(np.unique(read_ids(path)).tolist())
    later = str(next(name for name in sorted(ids[3]) if name not in ids[0]))
    parts = ["track", files / "params.npz", "--views", files, "--encoder", f"files:{files / 'truth'}", "--no-pictures"]
    assert main([*map(str, parts), "--out", str(tmp_path), "--classes", f"1,{later},99"]) == 0
    objects = json.loads((tmp_path / "tracks.json").read_text())["objects"]
    assert list(objects) == ["1", later, "99"]
    assert objects[later]["gaussians"][0] == 0 < max(objects[later]["gaussians"])
    assert objects["1"]["visible"][0]
    assert [record.message for record in caplog.records] == ["--classes: '99' was found in no frame; check the name"]


def test_a_scene_that_is_empty_throughout(files, tmp_path):
    """As Dynamic3DGaussians' arrays without rows; every mask is empty, and the pictures are drawn."""
    with np.load(files / "params.npz") as stored:
        arrays = {name: stored[name] for name in stored}
    arrays = {name: a[:, :0] if a.ndim == 3 else a if name.startswith("cam") else a[:0] for name, a in arrays.items()}
    np.savez(tmp_path / "params.npz", **arrays)
    parts = ["track", tmp_path / "params.npz", "--views", files, "--encoder", f"files:{files / 'labels'}"]
    assert main([*map(str, parts), "--frames", "2", "--out", str(tmp_path / "out")]) == 0
    assert not read_ids(tmp_path / "out" / "00001" / "0.png").any()
    assert (tmp_path / "out" / "trajectories.png").is_file()


def test_masks_of_cameras_that_were_not_lifted(files, tmp_path):
    assert main(arguments(files, tmp_path, "--mask-views", str(files), "--frames", "3")) == 0
    assert sorted(path.name for path in (tmp_path / "00002").iterdir()) == ["3.png", "frame.json"]
    truth = read_ids(files / "truth" / "00002" / "3.png")
    assert float((read_ids(tmp_path / "00002" / "3.png") == truth).mean()) > 0.7
    assert not (tmp_path / "00003").exists()


def test_masks_are_those_of_the_cameras_of_their_frame(files, tmp_path):
    asked = []

    class Noted:
        def at(self, frame):
            asked.append(frame)
            return views.at(frame)

    views, source = load_moving_views(files), LabelFrames(files / "labels")
    output = tracking_run.Output(tmp_path, Noted(), pictures=False)
    tracking_run.run_tracking(load_sequence(files), views, Tracker(source), Questions(), output, frames=3)
    assert asked == [0, 1, 2]


def test_a_folder_of_ply_with_cameras_that_stay(files, tmp_path):
    scene = make_moving_scene(0, FRAMES, 2500, cameras=4, width=64, height=48, moving_share=0.5)
    (tmp_path / "ply").mkdir()
    frames = []
    for index in range(3):
        save_gaussians(scene.gaussians(index), tmp_path / "ply" / f"{index}.ply")
    for view in scene.cameras[:3]:
        to_world = np.linalg.inv(view.camera.world_to_camera.numpy()) @ np.diag([1.0, -1, -1, 1])
        K = view.camera.K
        lens = {"fl_x": float(K[0, 0]), "fl_y": float(K[1, 1]), "cx": float(K[0, 2]), "cy": float(K[1, 2])}
        frames.append({"file_path": f"{view.stem}.png", "transform_matrix": to_world.tolist(), **lens})
    (tmp_path / "transforms.json").write_text(json.dumps({"w": 64, "h": 48, "frames": frames}))
    parts = ["track", tmp_path / "ply", "--views", tmp_path, "--encoder", f"files:{files / 'truth'}"]
    assert main([*map(str, parts), "--out", str(tmp_path / "out")]) == 0
    truth = read_ids(files / "truth" / "00002" / "1.png")
    assert float((read_ids(tmp_path / "out" / "00002" / "1.png") == truth).mean()) > 0.8


def test_info_of_a_sequence(files, capsys):
    assert main(["info", str(files / "params.npz"), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert (facts["frames"], facts["gaussians"], facts["identity"]) == (FRAMES, 2500, "rows")
    assert facts["foreground_share"] == pytest.approx(0.5, abs=0.01)
    assert facts["moving_share"] == pytest.approx(0.5, abs=0.01)
    assert facts["largest_step"] > facts["median_step"] > 0


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--forgetting", "1.5"], "forgetting: expected 0 to 1"),
        (["--frames", "99"], "frames: 99 are asked for"),
        (["--unknown-below", "2"], "--unknown-below"),
        (["--temperature", "nan"], "temperature: expected a number from 1e-6 on, got nan"),
        (["--associate", "--resume"], "--associate: keeps no state"),
        (["--encoder", "files:nowhere"], "nowhere: no such folder"),
        (["--text", "open"], "texts: need features in a text space"),
    ],
)
def test_bad_input_is_one_line_and_code_2(files, tmp_path, capsys, more, message):
    out = tmp_path / "out"
    assert main(arguments(files, out, *more)) == 2
    error = capsys.readouterr().err.strip().splitlines()
    assert len([line for line in error if " has no effect: " not in line]) == 1
    assert message in error[-1]
    assert not (out / "tracks.json").exists()
    assert not (out / "run.json").exists()


# Every option reaches what does the work


@pytest.fixture
def stopped(files, tmp_path, monkeypatch, capsys):
    """`stopped(*more)` runs the command up to the tracking; what that would have been told."""
    monkeypatch.setenv("SGWARP_CACHE", str(tmp_path / "cache"))

    def called(*more):
        seen = []

        def stop(sequence, views, tracker, questions, output, **keywords):
            seen.append(SimpleNamespace(**{**locals(), **keywords}))
            raise InputError("stopped here")

        with monkeypatch.context() as patch:
            patch.setattr(tracking_run, "run_tracking", stop)
            parts = ["track", files / "params.npz", "--views", files, "--out", tmp_path / "out"]
            assert main([str(part) for part in (*parts, "--encoder", f"files:{files / 'labels'}", *more)]) == 2
        assert "stopped here" in capsys.readouterr().err
        (call,) = seen
        return call

    return called


OPTIONS = {
    "forgetting": (0.25, lambda call: call.tracker.settings.fusion.forgetting),
    "patience": (7, lambda call: call.tracker.settings.fusion.patience),
    "change": (0.125, lambda call: call.tracker.settings.fusion.change),
    "foreground": (True, lambda call: call.tracker.settings.foreground),
    "incremental": (False, lambda call: call.tracker.settings.incremental),
    "scoring": ("evidence", lambda call: call.questions.scoring),
    "temperature": (0.5, lambda call: call.questions.temperature),
    "unknown_below": (0.5, lambda call: call.questions.unknown_below),
    "frames": (2, lambda call: call.frames),
    "resume": (True, lambda call: call.resume),
    "features": (True, lambda call: call.output.features),
    "pictures": (False, lambda call: call.output.pictures),
    "photographs": (False, lambda call: call.views.at(0)[0].view.image_path is not None),
    "split": ("test", lambda call: "test" if [one.view.stem for one in call.views.at(0)] == ["3"] else "train"),
    "associate": (True, lambda call: isinstance(call.tracker.source, Associated)),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", OPTIONS)
def test_an_option_changes_what_it_names_alone(stopped, name):
    value, read = OPTIONS[name]
    option = f"--{name.replace('_', '-')}"
    given = [option, value] if not isinstance(value, bool) else [option if value else f"--no-{option[2:]}"]
    plain, changed = stopped(), stopped(*given)
    assert read(plain) != value
    assert read(changed) == value
    others = set(OPTIONS) - {name}
    assert all(OPTIONS[other][1](plain) == OPTIONS[other][1](changed) for other in others)


def test_masks_and_questions_are_those_asked_for(stopped, files):
    call = stopped()
    assert (call.questions.classes, call.questions.texts, call.output.masks) == (None, (), None)
    call = stopped("--classes", "3, 1", "--text", "open,closed", "--mask-views", files)
    assert (call.questions.classes, call.questions.texts) == (("3", "1"), ("open", "closed"))
    assert call.questions.encoder is None  # label images know ids only
    assert [one.view.stem for one in call.output.masks.at(0)] == ["3"]
    call = stopped("--mask-views", files, "--mask-split", "train")
    assert [one.view.stem for one in call.output.masks.at(0)] == ["0", "1", "2"]


def test_the_encoder_is_made_with_cache_and_device(stopped, monkeypatch, tmp_path):
    asked = []

    class Nothing:
        space, needs_image = "toy", True

        def encode(self, view, image):
            raise AssertionError

    def make(*arguments):
        asked.append(arguments)
        return Nothing()

    monkeypatch.setattr("sgwarp.encoders.registry.make_encoder", make)
    monkeypatch.setattr("sgwarp.encoders.registry.make_text_encoder", lambda name, device: (name, device))
    assert stopped("--encoder", "conse").questions.encoder is None  # nothing is asked in words
    name, views, device, folder, limit = asked.pop()
    assert (name, [view.stem for view in views], device, limit) == ("conse", ["0", "1", "2"], "cpu", 10.0)
    assert Path(folder) == tmp_path / "cache"
    call = stopped("--encoder", "conse", "--text", "ball", "--cache", tmp_path / "mine", "--cache-limit", "0.5")
    assert call.questions.encoder == ("conse", "cpu")
    assert asked.pop()[3:] == (str(tmp_path / "mine"), 0.5)
    stopped("--encoder", "conse", "--cache", "none")
    assert asked.pop()[3] is None


def test_features_from_files_are_asked_in_words(stopped, files, monkeypatch, tmp_path, caplog):
    """Ids are not; so what the files hold decides, not how the source is called."""
    asked = []
    speak = "sgwarp.encoders.registry.text_encoder_for"
    monkeypatch.setattr(speak, lambda space, device: asked.append((space, device)) or "words")
    assert stopped("--classes", "a,b").questions.encoder is None
    stopped("--classes", "a,b", "--temperature", "0.5")
    assert caplog.messages == ["--temperature has no effect: the maps hold ids, which are not asked in words"]
    caplog.clear()
    (tmp_path / "maps" / "00000").mkdir(parents=True)
    for stem in ("0", "1", "2"):
        np.save(tmp_path / "maps" / "00000" / f"{stem}.npy", np.ones((12, 16, 2), np.float32))
    (tmp_path / "maps" / "00000" / "space.json").write_text('{"space": "mine"}')
    call = stopped("--encoder", f"files:{tmp_path / 'maps'}", "--classes", "a,b", "--temperature", "0.5")
    assert (call.questions.encoder, asked) == ("words", [("mine", "cpu")])
    assert not any("--temperature" in message for message in caplog.messages)


# Extremes, as files


def changed_params(files, folder, change):
    """A copy of the scene with other arrays, beside the same cameras and labels."""
    with np.load(files / "params.npz") as archive:
        arrays = {name: archive[name].copy() for name in archive}
    change(arrays)
    path = folder / "params.npz"
    np.savez(path, **arrays)
    return path


def track_other(scene, files, out, *more):
    parts = ["track", scene, "--views", files, "--encoder", f"files:{files / 'labels'}", "--out", out]
    return main([*map(str, parts), "--no-pictures", *more])


def test_nan_and_a_jump_in_one_frame_cost_that_frame_alone(files, tmp_path):
    def spoil(arrays):
        arrays["means3D"][2, 100:120] = np.nan
        arrays["means3D"][2, 130] = 1e4

    scene = changed_params(files, tmp_path, spoil)
    alone, wrong = tmp_path / "alone", tmp_path / "wrong"
    assert main(arguments(files, alone, "--forgetting", "0", "--frames", "4")) == 0
    assert track_other(scene, files, wrong, "--forgetting", "0", "--frames", "4") == 0
    for frame in (0, 1, 3):
        for stem in ("0", "1", "2"):
            name = f"{frame:05d}/{stem}.png"
            assert (wrong / name).read_bytes() == (alone / name).read_bytes()
    row = json.loads((wrong / "00002" / "frame.json").read_text())
    extents = [one["extent"] for one in row["objects"] if one["extent"]]
    assert np.abs(extents).max() < 10.0  # the one that jumped away is no part of an object's extent
    assert track_other(scene, files, tmp_path / "fused", "--frames", "4") == 0


def test_a_still_frame_is_answered_as_the_one_before(files, tmp_path):
    """Frames 1 and 2 show the scene of frame 0 with its labels: the same answers, and none is asked for twice."""

    def hold(arrays):
        for name in ("means3D", "unnorm_rotations", "rgb_colors"):
            arrays[name][1:3] = arrays[name][0]

    scene = changed_params(files, tmp_path, hold)
    labels = tmp_path / "labels"
    shutil.copytree(files / "labels", labels)
    for frame in (1, 2):
        shutil.rmtree(labels / f"{frame:05d}")
        shutil.copytree(labels / "00000", labels / f"{frame:05d}")
    options = ["--frames", "4", "--forgetting", "0", "--encoder", f"files:{labels}"]
    assert track_other(scene, files, tmp_path / "out", *options) == 0
    for stem in ("0", "1", "2"):
        first, second, third, other = (tmp_path / "out" / f"{frame:05d}" / f"{stem}.png" for frame in range(4))
        assert first.read_bytes() == second.read_bytes() == third.read_bytes() != other.read_bytes()
    run = json.loads((tmp_path / "out" / "run.json").read_text())
    assert run["left_out"]["answers_that_did_not_change"] == 2
    rows = [json.loads((tmp_path / "out" / f"{frame:05d}" / "frame.json").read_text()) for frame in range(3)]
    assert (rows[1]["left_out"], rows[1]["changed_object"]) == (1.0, 0)
    assert rows[0]["objects"] == rows[1]["objects"] == rows[2]["objects"]


def test_frames_without_gaussians_and_counts_that_change(files, tmp_path, capsys):
    scene = make_moving_scene(0, FRAMES, 2500, cameras=4, width=64, height=48, moving_share=0.5)
    folder = tmp_path / "ply"
    folder.mkdir()
    for index in (0, 2, 3):
        one = scene.gaussians(index)
        save_gaussians(one.subset(torch.arange(2400)) if index == 3 else one, folder / f"{index}.ply")
    header = (folder / "0.ply").read_bytes().partition(b"end_header\n")[0] + b"end_header\n"
    (folder / "1.ply").write_bytes(header.replace(b"element vertex 2500", b"element vertex 0"))
    assert track_other(folder, files, tmp_path / "out", "--frames", "3") == 0  # an empty frame changes nothing
    row = json.loads((tmp_path / "out" / "00001" / "frame.json").read_text())
    assert not any(one["visible"] for one in row["objects"])
    assert not read_ids(tmp_path / "out" / "00001" / "1.png").any()
    assert read_ids(tmp_path / "out" / "00002" / "1.png").any()
    capsys.readouterr()
    assert track_other(folder, files, tmp_path / "none") == 2
    error = capsys.readouterr().err.strip().splitlines()
    assert len(error) == 1
    assert "frame 3: has 2400 Gaussians, the frame before 2500, and no ids say" in error[0]
    assert track_other(folder, files, tmp_path / "alone", "--forgetting", "0") == 0
    capsys.readouterr()
    assert main(["info", str(folder), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["gaussians"] == "0 to 2500"


def test_a_missing_photograph_costs_its_view_in_that_frame(files, tmp_path, monkeypatch):
    """The others are still lifted, and the run says how many were left out."""

    class Gray:
        space, needs_image = "toy", True

        def encode(self, view, image):
            looked.append(view.stem)
            return FeatureMap("toy", dense=torch.ones(*image.shape[:2], 2))

        def encode_text(self, texts):
            return torch.nn.functional.normalize(torch.ones(len(texts), 2), dim=1)

    looked: list[str] = []
    monkeypatch.setattr("sgwarp.encoders.registry.make_encoder", lambda *rest: Gray())
    monkeypatch.setattr("sgwarp.encoders.registry.make_text_encoder", lambda *rest: Gray())
    views = tmp_path / "views"
    shutil.copytree(files / "ims", views / "ims")
    shutil.copy(files / "train_meta.json", views)
    next((views / "ims" / "1").glob("*000001.*")).unlink()
    parts = ["track", files / "params.npz", "--views", views, "--encoder", "conse", "--classes", "a,b"]
    parts += ["--out", tmp_path / "out", "--frames", "3", "--no-pictures"]
    assert main([str(part) for part in parts]) == 0
    assert looked == ["0", "1", "2", "0", "2", "0", "1", "2"]
    run = json.loads((tmp_path / "out" / "run.json").read_text())
    assert run["left_out"]["views_without_photograph"] == 1
