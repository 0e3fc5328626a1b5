"""`import sgwarp` and `sgwarp --help` are quick because nothing heavy comes with them."""

import ast
import importlib
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

import sgwarp

HEAVY = ("torch", "warp", "cv2", "matplotlib", "transformers", "safetensors", "plyfile", "scipy")
COMMANDS = (
    "lift",
    "query",
    "segment",
    "render",
    "info",
    "encoders",
    "demo",
    "fit",
    "distill",
    "predict",
    "report",
    "instances",
    "edit",
    "batch",
    "view",
)


def heavy_modules_after(code: str) -> list[str]:
    """Heavy top-level modules in sys.modules of a fresh interpreter that has run `code`."""
    report = f"\nimport sys\nprint('loaded', *(name for name in {HEAVY!r} if name in sys.modules))"
    done = subprocess.run([sys.executable, "-c", code + report], capture_output=True, text=True, check=True)
    return done.stdout.splitlines()[-1].split()[1:]


def test_import_is_light():
    assert heavy_modules_after("import sgwarp") == []


@pytest.mark.parametrize("arguments", [["--help"], ["--version"], *([name, "--help"] for name in COMMANDS)])
def test_help_is_light(arguments):
    code = f"from sgwarp.cli import main\ntry: main({arguments!r})\nexcept SystemExit as end: assert end.code == 0"
    assert heavy_modules_after(code) == []


def test_the_measure_works():
    assert heavy_modules_after("import sgwarp; sgwarp.Gaussians") == ["torch"]


@pytest.mark.parametrize("name", sgwarp.__all__)
def test_public_names_resolve(name):
    value = getattr(sgwarp, name)
    assert not isinstance(value, ModuleType)
    if name != "__version__":
        assert value is getattr(importlib.import_module(sgwarp._HOME[name]), name)


def test_type_checkers_see_the_same_names():
    tree = ast.parse(Path(sgwarp.__file__).read_text(encoding="utf-8"))
    block = next(node for node in tree.body if isinstance(node, ast.If))
    seen = {alias.asname: node.module for node in block.body for alias in node.names}
    assert seen == sgwarp._HOME


def test_unknown_names_are_refused():
    with pytest.raises(AttributeError, match="no attribute 'lifted'"):
        sgwarp.lifted  # noqa: B018


def test_a_public_name_is_the_function_of_its_module():
    heavy_modules_after(
        "import sgwarp.lifting.lifter\nfrom sgwarp.lifting.lifter import lift\nassert sgwarp.lift is lift"
    )
    assert set(dir(sgwarp)) == set(sgwarp.__all__)
