"""What goes wrong around a command: closed pipes, full and read-only disks, signals, kernels that cannot be kept."""

import logging
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch

from sgwarp import cli
from sgwarp.cli import main
from sgwarp.errors import InputError

CODE = "import sys; from sgwarp.cli import main; sys.exit(main(sys.argv[1:]))"
ROOT = str(Path(__file__).resolve().parents[2])


def command(*arguments: str, **environment: str) -> dict:
    """What subprocess needs to run `sgwarp`."""
    kept = {**os.environ, "PYTHONPATH": ROOT, **environment}
    return {"args": [sys.executable, "-c", CODE, *arguments], "env": kept, "text": True, "stderr": subprocess.PIPE}


def test_a_closed_pipe_is_quiet():
    """`sgwarp encoders | head -0`"""
    process = subprocess.Popen(**command("encoders"), stdout=subprocess.PIPE)
    process.stdout.close()
    assert process.stderr.read() == ""
    assert process.wait(60) == 141
    process.stderr.close()


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs a device that is always full")
@pytest.mark.parametrize("arguments", [("encoders",), ("--version",)])
def test_a_full_output_is_one_line(arguments):
    with open("/dev/full", "w") as full:
        done = subprocess.run(**command(*arguments), stdout=full, check=False)
    assert done.returncode == 2
    assert done.stderr == "sgwarp: output cannot be read or written (No space left on device)\n"


@pytest.mark.parametrize("closed", [(0,), (1,), (0, 1, 2)])
def test_closed_streams(tmp_path, closed):
    """`sgwarp ... >&-`: no traceback, and no file is opened under the number of a standard stream."""
    code = (
        "import os, sys\n"
        f"for number in {closed}: os.close(number)\n"
        "sys.stdin, sys.stdout, sys.stderr = (None if n in "
        f"{closed} else s for n, s in enumerate((sys.stdin, sys.stdout, sys.stderr)))\n"
        "from sgwarp.cli import main\n"
        "code = main(['--version'])\n"
        "kept = open(sys.argv[1], 'w')\n"
        'kept.write(f\'{code} {kept.fileno() > 2} {main(["info", "/nowhere/a.ply"])}\')'
    )
    done = subprocess.run(
        [sys.executable, "-c", code, tmp_path / "a"], env={**os.environ, "PYTHONPATH": ROOT},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    assert (tmp_path / "a").read_text() == "0 True 2"


def test_a_terminal_without_the_characters_gets_escapes():
    environment = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0", "PYTHONIOENCODING": "ascii"}
    done = subprocess.run(**command("--help", **environment), stdout=subprocess.PIPE, check=False)
    assert done.returncode == 0, done.stderr
    assert "usage: sgwarp" in done.stdout


MEMORY = "there is not enough memory ({}); use fewer views, pixels or channels"


def raising(monkeypatch, error: BaseException) -> None:
    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr("sgwarp.commands.encoders.Encoders.run", fail)


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (KeyboardInterrupt(), 130, "interrupted"),
        (InputError("a\nsgwarp: forged \x1b[2J"), 2, r"a\nsgwarp: forged \x1b[2J"),
        (PermissionError(13, "No", "/x/a.png"), 2, "/x/a.png: cannot be read or written (No)"),
        (MemoryError("Unable to allocate 2 TiB"), 2, MEMORY.format("Unable to allocate 2 TiB")),
        (RuntimeError("Allocator: can't allocate memory: x"), 2, MEMORY.format("Allocator: can't allocate memory: x")),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, BaseException) else None,
)  # fmt: skip
def test_errors_become_one_line(monkeypatch, capsys, error, code, line):
    raising(monkeypatch, error)
    assert main(["encoders"]) == code
    assert capsys.readouterr().err == f"sgwarp: {line}\n"


def test_a_mistake_of_ours_stays_a_traceback(monkeypatch):
    raising(monkeypatch, RuntimeError("a mistake"))
    with pytest.raises(RuntimeError, match="a mistake"):
        main(["encoders"])


def test_sigterm_interrupts_a_command(monkeypatch, capsys, tmp_path):
    """In the middle of a write: nothing is left of it."""
    from sgwarp.files.atomic import atomic_path

    def write(*_: object) -> None:
        with atomic_path(tmp_path / "a.txt") as temporary:
            temporary.write_text("half")
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(5)

    monkeypatch.setattr("sgwarp.commands.encoders.Encoders.run", write)
    before = signal.getsignal(signal.SIGTERM)
    assert main(["encoders"]) == 143
    assert capsys.readouterr().err == "sgwarp: terminated\n"
    assert signal.getsignal(signal.SIGTERM) is before
    assert os.listdir(tmp_path) == []


def test_notices_act_on_no_terminal(capsys):
    with cli._notices():
        logging.getLogger("sgwarp").warning("left out %s", "a\x1b[2J\nsgwarp: forged")
    assert capsys.readouterr().err == "sgwarp: left out a\\x1b[2J\\nsgwarp: forged\n"


def test_progress_takes_names_for_what_they_are(monkeypatch):
    """A name with the markup of rich, which would end the run, and with control characters."""
    import io

    from sgwarp.runs.progress import show_progress

    stream = io.StringIO()
    stream.isatty = lambda: True
    with show_progress("lift", stream) as report:
        report(1, 2, "[/bold] \x1b]0;title\x07")
    assert "\x1b]0;" not in stream.getvalue()


def test_a_home_that_cannot_be_written_names_the_variable(tmp_path):
    """Kernels are then compiled for this run alone; that Warp starts and where is seen without compiling any."""
    code = (
        "import logging; logging.basicConfig(); import sgwarp.ops.launcher, warp; print(warp.config.kernel_cache_dir)"
    )
    (tmp_path / "file").touch()
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "PYTHONPATH": ROOT, "TMPDIR": str(tmp_path), "WARP_CACHE_PATH": f"{tmp_path}/file/x"},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "set WARP_CACHE_PATH to a folder that can be written to" in done.stderr
    assert Path(done.stdout.strip()).parent.parent == tmp_path or Path(done.stdout.strip()).parent == tmp_path
    assert [path.name for path in tmp_path.iterdir()] == ["file"]  # removed at the end


class Kernel:
    class module:
        @staticmethod
        def get_module_identifier(block_dim: int) -> str:
            return f"wp_mine_{block_dim}"


def test_a_broken_object_in_the_cache_of_kernels_is_built_again(tmp_path, monkeypatch):
    from sgwarp.ops import kernel_cache

    monkeypatch.setattr(kernel_cache.wp.config, "kernel_cache_dir", str(tmp_path))
    (tmp_path / "wp_mine_1").mkdir()
    (tmp_path / "wp_mine_1" / "a.o").write_text("broken")
    (tmp_path / "wp_other_1").mkdir()

    def run() -> str:
        if (tmp_path / "wp_mine_1").exists():
            raise Exception("Failed to load CPU module 'mine'")
        return "ran"

    assert kernel_cache.mended(Kernel, run) == "ran"
    assert os.listdir(tmp_path) == ["wp_other_1"]


def test_a_cache_of_kernels_that_is_full_names_the_variable(tmp_path, monkeypatch):
    from sgwarp.ops import kernel_cache

    monkeypatch.setattr(kernel_cache.wp.config, "kernel_cache_dir", str(tmp_path))

    def full() -> None:
        raise OSError(28, "No space left on device")

    def mistake() -> None:
        raise RuntimeError("a mistake")

    with pytest.raises(InputError, match=r"cannot be written \(No space left on device\); set WARP_CACHE_PATH"):
        kernel_cache.mended(Kernel, full)
    with pytest.raises(RuntimeError, match="a mistake"):
        kernel_cache.mended(Kernel, mistake)


# Every writer on a disk that is full: one line that names the file, no rest, and what was there stays.


def scene():
    from sgwarp.scene import Gaussians

    numbers = torch.rand(600, 20, generator=torch.Generator().manual_seed(0))
    return Gaussians(
        numbers[:, :3], numbers[:, 3:7] + 0.1, numbers[:, 7:10], numbers[:, 10], numbers[:, 11:14, None].mT
    )


def semantics():
    from sgwarp.scene import Semantics

    return Semantics(torch.rand(600, 8), torch.ones(600), torch.ones(600), "mine", "0")


def write_ply(path: Path) -> None:
    from sgwarp.io.scenes import save_gaussians

    save_gaussians(scene(), path)


def write_semantics(path: Path) -> None:
    from sgwarp.io.store import save_semantics

    save_semantics(semantics(), path)


def write_torch(path: Path) -> None:
    from sgwarp.files.torch_files import save_torch

    save_torch(path, {"a": torch.rand(5000)})


def write_picture(path: Path) -> None:
    from sgwarp.files.images import write_rgb

    write_rgb(path, np.random.default_rng(0).random((40, 40, 3)))


def write_ids(path: Path) -> None:
    from sgwarp.files.images import write_ids

    write_ids(path, np.random.default_rng(0).integers(0, 255, (80, 80)).astype(np.uint8))


def write_log(path: Path) -> None:
    from sgwarp.runs.log import RunLog

    RunLog(command="x" * 2000).write(path.parent)


def write_curve(path: Path) -> None:
    from sgwarp.reconstruction.fitting.measurement import Measurement
    from sgwarp.reconstruction.fitting.report import draw_curve

    draw_curve([Measurement(k, k, k, k, k) for k in range(3)], path)


WRITERS = {
    "scene.ply": write_ply,
    "scene.compressed.ply": write_ply,
    "semantics.safetensors": write_semantics,
    "state.pt": write_torch,
    "picture.png": write_picture,
    "picture.jpg": write_picture,
    "ids.png": write_ids,
    "run.json": write_log,
    "curve.png": write_curve,
}


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.parametrize("size", [0, 100, 1000])
def test_every_writer_on_a_full_disk(tmp_path, disk, name, size):
    path = tmp_path / name
    path.write_text("old")
    with disk(size), pytest.raises(InputError, match=r"cannot be written \(File too large\)") as caught:
        WRITERS[name](path)
    assert name in str(caught.value)
    assert os.listdir(tmp_path) == [name]
    assert path.read_text() == "old"
    WRITERS[name](path)
    assert path.stat().st_size > 1000


def test_a_network_on_a_full_disk(tmp_path, disk):
    from sgwarp.network.layers.mink_unet import MinkUNet
    from sgwarp.network.semantic_network import SemanticNetwork, save_network

    network = SemanticNetwork(MinkUNet(3, 2, "14A"), "signed-rgb", 0.02, "mine")
    with disk(10_000), pytest.raises(InputError, match="cannot be written"):
        save_network(network, tmp_path / "net.safetensors")
    assert os.listdir(tmp_path) == []


def test_a_lift_on_a_full_disk(stage_files, tmp_path, capsys, disk):
    """One line, and nothing left; the next run, with room, is whole."""
    out = tmp_path / "S.safetensors"
    files = ["--views", stage_files.views, "--encoder", f"files:{stage_files.labels}", "--out", out, "--cache", "none"]
    arguments = ["lift", *map(str, [stage_files.scene, *files])]
    with disk(300):
        assert main(arguments) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert lines == [f"sgwarp: {out}: cannot be written (File too large); make room, or choose another folder"]
    assert list(tmp_path.iterdir()) == []
    assert main(arguments) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["S.safetensors", "run.json"]
