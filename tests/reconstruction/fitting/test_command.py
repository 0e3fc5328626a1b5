"""`sgwarp fit`: files in, files and exit codes out."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch

from sgwarp.cli import main
from sgwarp.errors import InputError
from sgwarp.files.images import read_rgb
from sgwarp.io.scenes import load_gaussians
from sgwarp.reconstruction.fitting.coverage import seen_by_any

pytestmark = pytest.mark.slow


def fails(capsys, *arguments) -> str:
    """Run a command that has to end with code 2; returns the line that says why."""
    assert main(["fit", *map(str, arguments)]) == 2
    return capsys.readouterr().err.strip().splitlines()[-1]  # after notices about the data set


def test_a_folder_of_photographs_becomes_a_scene(boards, tmp_path, capsys):
    out = tmp_path / "new" / "scene.ply"
    arguments = ["--out", out, "--steps", 120, "--hold-out", 4, "--cap", 1200, "--sh-degree", 0, "--threads", 2]
    assert main(["fit", str(boards.folder), *map(str, arguments)]) == 0
    assert "held_out_psnr" in capsys.readouterr().out
    scene = load_gaussians(out)
    assert 600 < len(scene) <= 1200  # of the wall about half lies outside all photographs
    assert bool(seen_by_any(scene, [view.camera for view in boards.views]).all())
    run = json.loads((out.parent / "run.json").read_text())
    assert run["error"]["held_out_psnr"] > 19
    assert set(run["stages"]) == {"start", "read", "fit", "measure", "write"}
    assert run["left_out"]["updates_of_unseen_gaussians"] > 0
    steps = [point["step"] for point in run["curve"]]
    assert steps == list(range(12, 121, 12))
    seconds = [point["seconds"] for point in run["curve"]]
    assert seconds == sorted(seconds)
    assert run["curve"][-1]["psnr"] == run["error"]["held_out_psnr"] > run["curve"][0]["psnr"]
    assert [Path(name).name for name in run["outputs"]] == ["scene.ply", "scene.held_out.jpg", "scene.curve.png"]
    sheet = read_rgb(out.with_name("scene.held_out.jpg"))
    assert sheet.shape == (2 * (300 + 6), 3 * 400 + 2 * 6, 3)
    assert read_rgb(out.with_name("scene.curve.png")).std() > 5
    assert not list(out.parent.glob("*.checkpoint"))


def test_refined_poses_are_a_data_set(boards, tmp_path):
    from sgwarp.io.views import load_views

    out = tmp_path / "scene.ply"
    options = ["--steps", "60", "--cap", "1200", "--sh-degree", "0", "--hold-out", "4", "--refine-poses"]
    assert main(["fit", str(boards.folder), "--out", str(out), *options]) == 0
    refined = load_views(tmp_path / "scene.ply.refined")
    fitted = [view for index, view in enumerate(boards.views) if index % 4]
    assert [view.stem for view in refined] == [view.stem for view in fitted]
    shifts = [(one.camera.position - other.camera.position).norm() for one, other in zip(refined, fitted, strict=True)]
    assert min(shifts) > 0
    assert max(shifts) < 0.1
    assert str(tmp_path / "scene.ply.refined" / "transforms.json") in (tmp_path / "run.json").read_text()
    error = json.loads((tmp_path / "run.json").read_text())["error"]
    assert error["held_out_psnr"] != error["held_out_psnr_refined_poses"]
    assert error["overfitting_gap"] == pytest.approx(error["fitted_psnr"] - error["held_out_psnr_refined_poses"])


def test_the_contact_sheet_shows_truth_rendering_and_difference(boards, tmp_path):
    from sgwarp.reconstruction.fitting.photographs import read_photographs
    from sgwarp.reconstruction.fitting.report import write_contact_sheet
    from sgwarp.scene import Gaussians

    (photograph,) = read_photographs(boards.views[:1])
    nothing = Gaussians(*(torch.zeros(1, *shape) for shape in ((3,), (4,), (3,), (), (1, 3))))
    write_contact_sheet(nothing, [photograph], tmp_path / "sheet.png")
    truth, rendering, difference = (read_rgb(tmp_path / "sheet.png")[60:300, k : k + 400] for k in (0, 406, 812))
    means = photograph.image()[10:].mean(dim=(0, 1)) * 255
    assert abs(truth.mean(axis=(0, 1)) - means.numpy()).max() < 4
    assert rendering.max() == 0
    assert difference.mean() > 150  # all of it is wrong, which is the bright end of the colours


def test_narrow_rows_of_the_contact_sheet_end_in_white(monkeypatch, tmp_path):
    from sgwarp.reconstruction.fitting import report

    rows = [np.full((4, width, 3), width, np.uint8) for width in (10, 6, 8)]
    monkeypatch.setattr(report, "_row", lambda gaussians, photograph, white: photograph)
    report.write_contact_sheet(None, rows, tmp_path / "sheet.png")
    expected = np.full((3 * (4 + 6), 10, 3), 255, np.uint8)
    for k, row in enumerate(rows):
        expected[10 * k : 10 * k + 4, : row.shape[1]] = row
    np.testing.assert_array_equal(read_rgb(tmp_path / "sheet.png"), expected)


def test_a_fit_starts_from_depth(boards, tmp_path):
    out = tmp_path / "scene.compressed.ply"
    depth = ["--depth", str(boards.folder / "depth"), "--hold-out", "0", "--cap", "900", "--steps", "5"]
    assert main(["fit", str(boards.folder), "--out", str(out), *depth]) == 0
    assert len(load_gaussians(out)) > 100
    run = json.loads((tmp_path / "run.json").read_text())
    assert run["error"]["held_out_psnr"] is None
    assert run["outputs"] == [str(out)]
    assert run["curve"][-1]["psnr"] is None


def test_depth_that_the_data_set_names_is_used(boards, tmp_path, capsys):
    folder = Path(shutil.copytree(boards.folder, tmp_path / "stage"))
    meta = json.loads((folder / "transforms.json").read_text())
    for frame in meta["frames"]:
        frame["depth_file_path"] = frame["file_path"].replace("images/", "depth/").replace(".png", ".npy")
    (folder / "transforms.json").write_text(json.dumps(meta | {"depth_unit_scale_factor": 1.0}))
    options = ["--hold-out", "0", "--cap", "900", "--steps", "2", "--out"]
    assert main(["fit", str(folder), *options, str(tmp_path / "auto.ply")]) == 0
    assert "start: from the depth images that the data set names" in capsys.readouterr().err
    given = ["--depth", str(boards.folder / "depth")]
    assert main(["fit", str(boards.folder), *options, str(tmp_path / "given.ply"), *given]) == 0
    assert (tmp_path / "auto.ply").read_bytes() == (tmp_path / "given.ply").read_bytes()


def test_depth_that_contradicts_itself_is_not_started_from(boards, tmp_path, capsys):
    folder = Path(shutil.copytree(boards.folder, tmp_path / "stage"))
    meta = json.loads((folder / "transforms.json").read_text())
    for number, frame in enumerate(meta["frames"]):
        path = Path(frame["file_path"].replace("images/", "depth/").replace(".png", ".npy"))
        frame["depth_file_path"] = str(path)
        np.save(folder / path, np.load(folder / path) * 1.5**number)
    (folder / "transforms.json").write_text(json.dumps(meta))
    options = ["--hold-out", "0", "--cap", "900", "--steps", "2", "--out", str(tmp_path / "scene.ply")]
    assert main(["fit", str(folder), *options]) == 0
    assert "the views contradict each other" in capsys.readouterr().err
    assert "the views contradict each other" in fails(capsys, folder, *options, "--init", "depth")


@pytest.mark.parametrize(("strategy", "count"), [("default", 250), ("mcmc", 500)])
def test_a_fit_starts_from_nothing(boards, tmp_path, strategy, count):
    """What photographs agree on fills nearly the cap, or half of it where Gaussians are added later."""
    out = tmp_path / "scene.ply"
    options = ["--init", "random", "--steps", "3", "--cap", "500", "--downscale", "2", "--strategy", strategy]
    assert main(["fit", str(boards.folder), "--out", str(out), *options, "--background", "random", "--exposure"]) == 0
    assert 0.85 * count < len(load_gaussians(out)) <= count


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--hold-out", "-1"], "--hold-out: expected 0 or more, got -1"),
        (["--hold-out", "1"], "0 photographs are left to fit to; a scene needs at least 3"),
        (["--steps", "0"], "steps: expected at least 1, got 0"),
        (["--downscale", "0"], "downscale: expected a whole number of at least 1"),
        (["--init", "depth"], "--init depth: needs --depth"),
        (["--points", "missing.ply"], "missing.ply: no such file or folder; check the path"),
        (["--resume"], "scene.ply.checkpoint: no such file"),
        (["--checkpoint-every", "0"], "--checkpoint-every: expected at least 1"),
        (["--masks", "."], "holds no mask of any view"),
        (["--cap", "2"], "cap: a scene starts from at least 4 points"),
    ],
)
def test_bad_options(boards, tmp_path, capsys, monkeypatch, options, message):
    monkeypatch.chdir(tmp_path)
    assert message in fails(capsys, boards.folder, "--out", tmp_path / "scene.ply", *options)
    assert not list(tmp_path.glob("*.ply"))


def test_bad_names(boards, tmp_path, capsys):
    assert "the name must end in .ply" in fails(capsys, boards.folder, "--out", tmp_path / "scene.splat")
    assert "holds no views" in fails(capsys, tmp_path, "--out", tmp_path / "scene.ply")


def test_a_damaged_photograph_costs_itself(boards, tmp_path, capsys):
    folder = Path(shutil.copytree(boards.folder, tmp_path / "stage"))
    (folder / "images" / "0002.png").write_bytes(b"")
    assert main(["fit", str(folder), "--out", str(tmp_path / "scene.ply"), "--steps", "3", "--cap", "1100"]) == 0
    assert "0002.png: image is cut short (0 bytes); copy or download it again" in capsys.readouterr().err
    assert len(load_gaussians(tmp_path / "scene.ply"))


def start(boards, out: Path) -> subprocess.Popen:
    options = ["--steps", "4000", "--cap", "1100", "--checkpoint-every", "20", "--out", str(out), "--threads", "1"]
    code = "import sys; from sgwarp.cli import main; sys.exit(main(sys.argv[1:]))"
    command = [sys.executable, "-c", code, "fit", str(boards.folder), *options]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env={**os.environ})
    until = time.monotonic() + 300
    while not out.with_name(f"{out.name}.checkpoint").exists():
        if process.poll() is not None:
            pytest.fail(process.stderr.read())
        if time.monotonic() > until:
            process.kill()
            pytest.fail("no checkpoint after five minutes")
        time.sleep(0.01)
    return process


def test_ctrl_c_leaves_a_scene_and_a_checkpoint(boards, tmp_path):
    out = tmp_path / "scene.ply"
    process = start(boards, out)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 130, errors
    assert errors.strip().endswith("sgwarp: interrupted")
    scene = load_gaussians(out)
    assert not scene.non_finite
    checkpoint = torch.load(out.with_name("scene.ply.checkpoint"), weights_only=True)
    assert len(checkpoint["model"]["steps"]) == len(scene)
    run = json.loads((tmp_path / "run.json").read_text())
    assert run["curve"][-1]["step"] == checkpoint["step"] < 4000


def test_sigterm_ends_like_ctrl_c(boards, tmp_path):
    """What batch queues and containers send before they kill."""
    out = tmp_path / "scene.ply"
    process = start(boards, out)
    process.send_signal(signal.SIGTERM)
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 143, errors
    assert errors.strip().endswith("sgwarp: terminated")
    scene = load_gaussians(out)
    checkpoint = torch.load(out.with_name("scene.ply.checkpoint"), weights_only=True)
    assert len(checkpoint["model"]["steps"]) == len(scene)
    assert json.loads((tmp_path / "run.json").read_text())["curve"][-1]["step"] == checkpoint["step"] < 4000
    assert not list(tmp_path.glob(".*"))


def test_a_checkpoint_that_cannot_be_written_costs_a_notice(boards, tmp_path, capsys, monkeypatch):
    """It is tried again, and the fit goes on to its scene."""
    from sgwarp.files import torch_files

    save, tries = torch_files.torch.save, []

    def full(content, file):
        tries.append(content["step"])
        if len(tries) < 3:
            raise OSError(28, "No space left on device")
        save(content, file)

    monkeypatch.setattr(torch_files.torch, "save", full)
    out = tmp_path / "scene.ply"
    options = ["--steps", "20", "--cap", "1200", "--checkpoint-every", "5", "--out", str(out)]
    assert main(["fit", str(boards.folder), *options]) == 0
    assert tries == [5, 10, 15, 20]
    lines = [line for line in capsys.readouterr().err.splitlines() if "cannot be written" in line]
    assert len(lines) == 2
    assert all("scene.ply.checkpoint" in line and "No space left on device" in line for line in lines)
    assert json.loads((tmp_path / "run.json").read_text())["left_out"]["checkpoints"] == 2
    assert len(load_gaussians(out)) > 600
    assert {path.name for path in tmp_path.iterdir()} >= {"scene.ply", "run.json"}
    assert not list(tmp_path.glob(".*"))


def test_a_scene_that_cannot_be_written_costs_no_run(boards, tmp_path, capsys, monkeypatch):
    """The checkpoint of the last step stays until the scene is on the disk."""
    out = tmp_path / "scene.ply"
    arguments = ["fit", str(boards.folder), "--out", str(out), "--steps", "20", "--cap", "1200"]

    def full(*_: object) -> None:
        raise InputError("no space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("sgwarp.io.scenes.save_gaussians", full)
        assert main(arguments) == 2
    assert out.with_name("scene.ply.checkpoint").is_file()
    assert main([*arguments, "--resume"]) == 0
    assert len(load_gaussians(out)) > 600
    assert not out.with_name("scene.ply.checkpoint").exists()


def test_names_that_would_be_taken_for_something_else(boards, tmp_path, capsys):
    (tmp_path / "folder.ply").mkdir()
    assert "is a folder; choose another name" in fails(capsys, boards.folder, "--out", tmp_path / "folder.ply")
    folder = Path(shutil.copytree(boards.folder, tmp_path / "stage"))
    assert "is a name of the points" in fails(capsys, folder, "--out", folder / "point_cloud.ply")


def test_a_damaged_checkpoint(boards, tmp_path, capsys):
    (tmp_path / "scene.ply.checkpoint").write_text("junk")
    message = fails(capsys, boards.folder, "--out", tmp_path / "scene.ply", "--steps", "5", "--resume")
    assert "is not a checkpoint, or is damaged" in message


def test_a_missing_point_file_is_a_notice(boards, tmp_path, capsys):
    """A list that names points which were not copied along; --depth does not even look for them."""
    folder = Path(shutil.copytree(boards.folder, tmp_path / "stage"))
    meta = json.loads((folder / "transforms.json").read_text()) | {"ply_file_path": "gone.ply"}
    for name in ("points3D.ply", "sparse_pc.ply", "point_cloud.ply"):
        (folder / name).unlink(missing_ok=True)
    (folder / "transforms.json").write_text(json.dumps(meta))
    out = tmp_path / "scene.ply"
    assert main(["fit", str(folder), "--out", str(out), "--steps", "2", "--cap", "1200"]) == 0
    assert "its 'ply_file_path' 'gone.ply' does not exist" in capsys.readouterr().err
    assert out.is_file()


def test_the_shipped_room_can_be_fitted(tmp_path):
    from sgwarp.demo.data import ROOM

    options = ["--steps", "2", "--cap", "1000", "--downscale", "4", "--out", str(tmp_path / "room.ply")]
    assert main(["fit", str(ROOM), *options]) == 0
    assert (tmp_path / "room.ply").is_file()


def test_short_runs_reach_their_degree(boards, tmp_path):
    out = tmp_path / "scene.ply"
    assert main(["fit", str(boards.folder), "--out", str(out), "--steps", "16", "--cap", "1200"]) == 0
    assert load_gaussians(out).sh.shape[1] == 16
