"""Faults under whole commands: a disk without room, a folder that refuses, two runs of one output, a stop."""

import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from sgwarp.cli import main
from sgwarp.datasets.moving import make_moving_scene
from sgwarp.datasets.moving_files import save_moving_scene
from sgwarp.files.atomic import atomic_path
from sgwarp.io.scenes import load_gaussians

ROOT = str(Path(__file__).resolve().parents[2])


@pytest.fixture(scope="module")
def lifted(stage_files, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("lifted") / "S.safetensors"
    files = ["--views", stage_files.views, "--encoder", f"files:{stage_files.labels}", "--out", out, "--cache", "none"]
    assert main(["lift", *map(str, [stage_files.scene, *files])]) == 0
    return out


@pytest.fixture(scope="module")
def others(stage_files, lifted, tmp_path_factory):
    """What the commands on networks, moving scenes and lists of scenes read."""
    root = tmp_path_factory.mktemp("others")
    save_moving_scene(make_moving_scene(0, 2, 300, cameras=2, width=32, height=24, moving_share=0.5), root / "moving")
    shutil.copytree(stage_files.views, root / "list" / "one")
    shutil.copy(stage_files.scene, root / "list" / "one" / "scene.ply")
    (root / "data").mkdir()
    shutil.copy(stage_files.scene, root / "data" / "room.ply")
    shutil.copy(lifted, root / "data" / "room.safetensors")
    make = ["distill", root / "data", "--out", root / "net.safetensors", *TRAINING]
    assert main([*map(str, make)]) == 0
    # Its kernels are compiled, as those of the other commands are by now: a full disk has no room for them either.
    assert main(arguments("track", stage_files, lifted, root, root / "tracked")) == 0
    return root


TRAINING = ("--epochs", "1", "--voxel", "0.25", "--up", "y", "--arch", "14A")


def arguments(name: str, files, lifted: Path, others: Path, out: Path) -> list[str]:
    """A small run of a command that writes to `out`."""
    scene, views = files.scene, ["--views", files.views]
    maps = ["--encoder", f"files:{files.labels}", "--cache", "none"]
    moving = others / "moving"
    lines = {
        "lift": [scene, *views, *maps, "--out", out / "S.safetensors"],
        "distill": [others / "data", "--out", out / "n.safetensors", *TRAINING],
        "predict": [scene, "--net", others / "net.safetensors", "--out", out / "P.safetensors"],
        "track": [*(moving / "params.npz", "--views", moving, "--encoder", f"files:{moving / 'labels'}", "--out", out)],
        "batch": [others / "list", "--do", "render", "--out", out, "--threads", "1"],
        "poses": [files.views, "--out", out / "posed"],
        "render": [scene, *views, "--view", "0001", "--out", out / "a.png"],
        "segment": [scene, "--semantics", lifted, *views, "--classes", "1,2", "--out", out],
        "query": [scene, "--semantics", lifted, *views, "--view", "0001", "--text", "1", "--out", out / "q.png"],
        "convert": [scene, out / "a.splat"],
        "edit": [scene, "--select", "box:-9,-9,-9,9,9,9", "--scale", "2", "--out", out / "e.ply"],
        "fit": [files.views, "--out", out / "f.ply", "--steps", "4", "--cap", "300", "--init", "random"],
        "instances": [scene, *views, "--masks", f"files:{files.labels}", "--out", out / "I.safetensors"],
        "report": [scene, *views, "--out", out, "--patches", "1", "--repeats", "1", "--no-extremes"],
    }
    return [name, *map(str, lines[name])]


COMMANDS = ("render", "segment", "query", "convert", "edit", "fit", "instances", "report")
COMMANDS += ("lift", "distill", "predict", "track", "batch")


@pytest.mark.slow
@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_on_a_full_disk(stage_files, lifted, others, tmp_path, capsys, disk, name):
    """One line that names the file, exit code 2, and no rest of anything."""
    out = tmp_path / "out"
    out.mkdir()
    with disk(60):
        assert main(arguments(name, stage_files, lifted, others, out)) == 2
    last = capsys.readouterr().err.strip().splitlines()[-1]
    assert last.startswith(f"sgwarp: {out}")
    assert "cannot be written (File too large)" in last
    assert [path for path in out.rglob("*") if path.is_file() and path.stat().st_size] == []


def test_poses_on_a_full_disk(stage_files, lifted, others, tmp_path, capsys, disk):
    pytest.importorskip("pycolmap")
    with disk(60):
        assert main(arguments("poses", stage_files, lifted, others, tmp_path)) == 2
    last = capsys.readouterr().err.strip().splitlines()[-1]
    assert last.startswith(f"sgwarp: {tmp_path / 'posed' / 'database.db'}: structure from motion cannot go on")
    assert "if the disk is full" in last


@pytest.mark.parametrize("name", [*COMMANDS, "poses"])
def test_a_command_in_a_place_that_refuses(stage_files, lifted, others, tmp_path, capsys, name):
    """A file stands where the folder should be; nothing is computed before that is said."""
    blocked = tmp_path / "file"
    blocked.write_text("here first")
    assert main(arguments(name, stage_files, lifted, others, blocked / "out")) == 2
    last = capsys.readouterr().err.strip().splitlines()[-1]
    assert last.startswith("sgwarp: ")
    assert str(blocked) in last
    assert blocked.read_text() == "here first"


WRITER = """
import sys
from pathlib import Path
import torch
from sgwarp.io.scenes import save_gaussians
from sgwarp.scene import Gaussians
value = float(sys.argv[2])
fields = (torch.full((4000, *shape), value) for shape in ((3,), (4,), (3,), (), (1, 3)))
scene = Gaussians(*fields)
for _ in range(15):
    save_gaussians(scene, Path(sys.argv[1]))
"""


@pytest.mark.slow
def test_two_writers_of_one_file(tmp_path):
    """Whoever comes last wins with a whole file, and no reader ever meets half of one."""
    path = tmp_path / "scene.ply"
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", WRITER, str(path), value], env={**os.environ, "PYTHONPATH": ROOT}, text=True
        )
        for value in ("0.25", "0.75")
    ]
    seen = set()
    while any(process.poll() is None for process in processes):
        if path.exists():
            seen.add(tuple(load_gaussians(path).means.unique().tolist()))
    assert [process.returncode for process in processes] == [0, 0]
    seen.add(tuple(load_gaussians(path).means.unique().tolist()))
    assert seen <= {(0.25,), (0.75,)}
    assert os.listdir(tmp_path) == ["scene.ply"]


@pytest.mark.slow
def test_distill_goes_on_after_a_stop(stage_files, lifted, tmp_path, monkeypatch):
    """SIGTERM in the second of three epochs: the state of the first is kept, and the end is as without the stop."""
    from sgwarp.network.training import trainer

    data = tmp_path / "data"
    data.mkdir()
    (data / "room.ply").write_bytes(stage_files.scene.read_bytes())
    (data / "room.safetensors").write_bytes(lifted.read_bytes())
    options = ["--epochs", "3", "--voxel", "0.25", "--up", "y", "--arch", "14A", "--seed", "1"]

    def distill(out: Path, *more: str) -> int:
        return main(["distill", str(data), "--out", str(out), *options, *more])

    whole, stopped = tmp_path / "whole.safetensors", tmp_path / "stopped.safetensors"
    assert distill(whole) == 0
    step, steps = trainer._Run._step, []

    def killed(run, epoch, *rest):
        steps.append(epoch)
        if epoch == 1 and len(steps) == 2:
            os.kill(os.getpid(), signal.SIGTERM)
        return step(run, epoch, *rest)

    monkeypatch.setattr(trainer._Run, "_step", killed)
    assert distill(stopped) == 143
    assert not stopped.exists()
    assert distill(stopped) == 0
    assert steps == [0, 1, 1, 2]
    assert stopped.read_bytes() == whole.read_bytes()


def test_a_write_that_fails_leaves_what_was_there(tmp_path, monkeypatch):
    """The rename itself fails, as on a disk that was taken away."""
    path = tmp_path / "a.json"
    path.write_text(json.dumps([1]))

    def gone(*_: object) -> None:
        raise OSError(5, "Input/output error")

    monkeypatch.setattr(os, "replace", gone)
    from sgwarp.errors import InputError

    with pytest.raises(InputError, match=r"a.json: cannot be written \(Input/output error\)"), atomic_path(path) as new:
        new.write_text("[2]")
    assert path.read_text() == "[1]"
    assert os.listdir(tmp_path) == ["a.json"]


@pytest.mark.parametrize(("call", "places"), [("save_file(", []), ("torch.save(", ["files/torch_files.py"])])
def test_libraries_write_in_one_place(call, places):
    """Their writers have errors of their own on a full disk, and safetensors' other bytes from run to run."""
    source = Path(ROOT) / "sgwarp"
    found = [str(path.relative_to(source)) for path in source.rglob("*.py") if call in path.read_text()]
    assert found == places
