"""What prose says of the code is there: files, functions, options, names of the API, and tests that can fail."""

import ast
import re
from dataclasses import fields
from pathlib import Path

import pytest

import sgwarp
from sgwarp.commands import COMMANDS

ROOT = Path(__file__).resolve().parents[2]
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    ROOT / "kernels" / "README.md",
    *sorted((ROOT / "docs").glob("*.md")),
]
PLACES = (
    "",
    "sgwarp",
    "kernels",
    "kernels/projection",
    "kernels/compositing",
    "kernels/fitting",
    "sgwarp/ops/splatting",
)
# Of other programs: hf download, benchmarks.
FOREIGN = {"local-dir", "castle", "memory"}


def text_of(page: Path) -> str:
    return page.read_text(encoding="utf-8")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_source_files_that_are_named_exist(page):
    named = set(re.findall(r"`((?:[\w-]+/)*[\w-]+\.(?:py|h|cpp|sh))`", text_of(page)))
    missing = {name for name in named if not any((ROOT / place / name).is_file() for place in PLACES)}
    assert not {name for name in missing if "/" in name}


def test_the_walks_name_functions_of_their_files():
    """docs/architecture.md: "`file.py` `name`" is a function or method of that file."""
    walks = text_of(ROOT / "docs" / "architecture.md").split("## Three walks")[1].split("## Where")[0]
    named = re.findall(r"`([\w/]+\.py)` `(\w+)`", walks)
    assert len(named) >= 5
    for file, name in named:
        tree = ast.parse(text_of(ROOT / "sgwarp" / file))
        assert name in {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}, f"{file}: {name}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_options_that_are_named_exist(page):
    options = {field.name.replace("_", "-") for command in COMMANDS.values() for field in fields(command)}
    options |= {f"no-{name}" for name in options} | {"help"}
    spans = re.findall(r"`([^`\n]+)`", text_of(page))
    named = {option for span in spans for option in re.findall(r"(?<![\w-])--([a-z][a-z-]*)", span)}
    assert not named - options - FOREIGN


def test_the_api_pages_list_every_name():
    pages = [ROOT / "docs" / "reference" / name for name in ("api.md", "rasterizer.md")]
    listed = [name for page in pages for name in re.findall(r"^::: ([\w.]+)$", text_of(page), re.M)]
    assert len(listed) == len(set(listed))
    assert set(dir(sgwarp)) - {name for name in dir(sgwarp) if name.startswith("_")} <= {
        n.split(".")[-1] for n in listed
    }


def asserts(function: ast.AST) -> bool:
    """Whether a function asserts, calls what does, or lets no exception pass but one (files with random bytes)."""
    for node in ast.walk(function):
        if isinstance(node, ast.Assert):
            return not (isinstance(node.test, ast.Constant) and bool(node.test.value))
        called = ast.unparse(node.func) if isinstance(node, ast.Call) else ""
        if isinstance(node, ast.Try) or re.search(r"assert|raises|check|refuse|warns|suppress", called):
            return True
    return False


def can_fail(test: ast.FunctionDef, helpers: set[str]) -> bool:
    """Whether a test, a fixture that it takes or a helper of its file that it names asserts, or hypothesis feeds it."""
    takes = any(argument.arg.startswith(("assert", "survives")) for argument in test.args.args)
    given = any("given" in ast.unparse(decorator) for decorator in test.decorator_list)
    named = {node.id for node in ast.walk(test) if isinstance(node, ast.Name)}
    return takes or given or asserts(test) or bool(named & helpers)


def idle_tests(path: Path) -> list[str]:
    functions = [node for node in ast.walk(ast.parse(text_of(path))) if isinstance(node, ast.FunctionDef)]
    tests = [node for node in functions if node.name.startswith("test_")]
    helpers = {node.name for node in functions if node not in tests and asserts(node)}
    return [f"{path.relative_to(ROOT)}: {test.name}" for test in tests if not can_fail(test, helpers)]


def test_every_test_can_fail():
    assert not [idle for path in sorted((ROOT / "tests").rglob("test_*.py")) for idle in idle_tests(path)]
