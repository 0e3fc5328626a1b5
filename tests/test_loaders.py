"""Every place that opens a file of torch, pickle or NumPy goes through the bounded readers, and none of them runs code.

The package is walked, so that a new loader cannot be forgotten: whoever calls `load_torch` must be listed in LOADERS
below, and whoever calls what can run code of a file fails at once.
"""

import ast
import importlib.util
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

import sgwarp
from sgwarp.errors import InputError

ROOT = Path(sgwarp.__file__).resolve().parent
BANNED = {
    *("torch.load", "torch.jit.load", "torch.hub.load", "np.load", "numpy.load", "np.fromfile", "np.loadtxt"),
    *(
        "pickle.load",
        "pickle.loads",
        "pickle.Unpickler",
        "joblib.load",
        "yaml.load",
        "yaml.unsafe_load",
        "marshal.loads",
    ),
    *("eval", "exec", "shelve.open", "np.lib.format.read_array", "json.load", "json.loads", "zipfile.ZipFile"),
    *("mmap.mmap", "np.memmap", "torch.UntypedStorage.from_file", "torch.from_file"),  # end the process if it shrinks
    *("safe_open", "load_file", "cv2.imread", "gzip.open", "gzip.decompress", "tarfile.open"),
}
# What the readers themselves are made of.
ALLOWED = {
    ("files.arrays", "np.fromfile"),
    ("files.archives", "zipfile.ZipFile"),
    ("files.documents", "json.loads"),
    # Rows of a binary PLY, as many as its header says and the file holds.
    ("io.ply", "np.fromfile"),
    # The configuration in a folder of weights that the user names, as transformers reads it, too.
    ("encoders.weights", "json.loads"),
    # Bounded by their own limits: one frame of a sequence, one image of a scene.
    ("io.archives", "zipfile.ZipFile"),
    ("io.formats.sog", "zipfile.ZipFile"),
    # Lines that the processes of one run send each other.
    ("cluster.local", "json.loads"),
    ("cluster.worker", "json.loads"),
    # Memory of this process in large pages, of no file.
    ("ops.memory", "mmap.mmap"),
}


def calls(name: str) -> list[tuple[str, str]]:
    """(module, dotted name) of every call in the package whose name is or ends in one of BANNED, or equals `name`."""
    found = []
    for path in sorted(ROOT.rglob("*.py")):
        module = ".".join(path.relative_to(ROOT).with_suffix("").parts)
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call):
                called = ast.unparse(node.func)
                if called == name or (not name and called in BANNED):
                    found.append((module, called))
    return found


def test_nothing_else_opens_files_of_others():
    assert set(calls("")) <= ALLOWED


def test_the_walk_sees_calls():
    assert ("files.arrays", "np.fromfile") in calls("")
    assert calls("load_torch")


def trainer_state(path: Path) -> object:
    from sgwarp.network.training import trainer

    (kind,) = [value for value in vars(trainer).values() if hasattr(value, "restore")]
    run = SimpleNamespace(_signature=dict, network=SimpleNamespace(net=torch.nn.Linear(1, 1)), optimizer=None)
    return kind.restore(run, path)


def openscene(path: Path) -> object:
    from sgwarp.io.openscene import load_openscene

    return load_openscene(path, SimpleNamespace(fingerprint="0"))


def fit_checkpoint(path: Path) -> object:
    from sgwarp.reconstruction.fitting.checkpoint import Checkpoint
    from sgwarp.reconstruction.fitting.settings import FitSettings

    return Checkpoint.load(path, FitSettings(), "0", torch.device("cpu"))


def features(path: Path) -> object:
    from sgwarp.encoders.maps.feature_files import load_features

    return load_features(path)


def lseg(path: Path) -> object:
    from sgwarp.encoders.pixels.lseg import read_checkpoint

    return read_checkpoint(str(path))


def weights(path: Path) -> object:
    from sgwarp.network.checkpoint import read_weights

    return read_weights(path)


def tracking_state(path: Path) -> object:
    from sgwarp.apps.tracking import state

    path.rename(path.with_name(state.STATE))
    return state.load_state(path.parent, SimpleNamespace(), {})


LOADERS = {
    "apps.tracking.state": tracking_state,
    "encoders.maps.feature_files": features,
    "encoders.pixels.lseg": lseg,
    "io.openscene": openscene,
    "network.checkpoint": weights,
    "network.training.trainer": trainer_state,
    "reconstruction.fitting.checkpoint": fit_checkpoint,
}
SHIPPED = {"encoders.images.conse.classifier"}  # reads the file of a package that is installed


def test_every_loader_is_listed():
    assert {module for module, _ in calls("load_torch")} == set(LOADERS) | SHIPPED


def _hostile():
    """The crafted files of tests/files/test_torch_files.py, which importlib mode does not put on sys.path."""
    path = Path(__file__).parent / "files" / "test_torch_files.py"
    spec = importlib.util.spec_from_file_location("sgwarp_hostile_files", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


HOSTILE = _hostile()


@pytest.mark.parametrize("module", LOADERS)
@pytest.mark.parametrize("name", HOSTILE.hostile(""))
def test_no_loader_runs_anything(tmp_path, monkeypatch, module, name):
    """The hostile object as a value, as the state dict and as the whole file."""
    monkeypatch.chdir(tmp_path)
    program = HOSTILE.hostile(f"__import__('os').mkdir({str(tmp_path / 'PWNED')!r})")[name]
    text = HOSTILE.text
    shapes = (program, b"}" + text("net.x") + program + b"s", b"}" + text("state_dict") + program + b"s")
    for number, shape in enumerate(shapes):
        for container in (HOSTILE.as_archive, HOSTILE.as_stream):
            path = container(tmp_path / f"{number}.pt", shape)
            with pytest.raises(InputError):
                LOADERS[module](path)
    assert not (tmp_path / "PWNED").exists()
