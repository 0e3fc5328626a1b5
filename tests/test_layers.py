"""The arrows between the packages: imports point down, kernels stand alone, optional libraries wait until needed."""

import ast
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

# Bottom to top. A module may import from its own package and from what stands before it.
ORDER = (
    "version",
    "errors",
    "io.atomic",
    "io.files",
    "io.images",
    "runlog",
    "progress",
    "scene",
    "kernels",
    "ops",
    "compat",
    "io",
    "rgbd",
    "from_depth",
    "datasets",
    "encoders",
    "pictures",
    "nn",
    "network",
    "predict",
    "ensemble",
    "render",
    "orbit",
    "fitting",
    "fit",
    "residual",
    "lift",
    "query",
    "segment",
    "evaluate",
    "distill",
    "report",
    "demo",
    "commands",
    "cli",
)
# Module-level imports of these would make everybody wait for, or install, what few use.
ON_DEMAND = {"cv2", "matplotlib", "transformers", "plyfile", "safetensors", "rich", "tyro", "viser", "sklearn", "scipy"}


def imports(path: Path, module_level: bool = False) -> Iterator[str]:
    """Dotted names that a file imports, anywhere or only when it is loaded."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    nodes = list(ast.walk(tree))
    if module_level:
        later = {
            id(sub) for node in nodes if isinstance(node, ast.FunctionDef) or for_types(node) for sub in ast.walk(node)
        }
        nodes = [node for node in nodes if id(node) not in later]
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def for_types(node: ast.AST) -> bool:
    """Whether a statement is only for type checkers."""
    return isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"


def files(folder: str) -> list[Path]:
    found = sorted((ROOT / folder).rglob("*.py"))
    assert found, f"no sources below {folder}"
    return found


def unit(dotted: str) -> str:
    """The entry of ORDER that a dotted name below `sgwarp` belongs to."""
    parts = dotted.split(".")
    for name in (".".join(parts[:2]), parts[0]):
        if name in ORDER:
            return name
    raise AssertionError(f"sgwarp.{dotted}: not in ORDER; say where it stands")


def dotted(path: Path) -> str:
    return ".".join(path.relative_to(ROOT / "sgwarp").with_suffix("").parts).removesuffix(".__init__")


@pytest.mark.parametrize("path", files("sgwarp"), ids=dotted)
def test_imports_point_down(path):
    if path == ROOT / "sgwarp" / "__init__.py":
        loaded = {name for name in imports(path, module_level=True) if name.startswith("sgwarp")}
        assert loaded == {"sgwarp.version.__version__"}
        return
    mine = unit(dotted(path))
    for name in imports(path):
        if name.split(".")[0] != "sgwarp":
            continue
        assert name != "sgwarp", f"{path.name} imports the whole package; import the module that is needed"
        other = unit(name.removeprefix("sgwarp."))
        inside = other.split(".")[0] == mine.split(".")[0]
        assert ORDER.index(other) < ORDER.index(mine) or (inside and other == mine), f"{mine} imports {name}, above it"


@pytest.mark.parametrize("path", files("kernels"), ids=lambda path: path.stem)
def test_kernels_import_warp_and_each_other(path):
    for name in imports(path):
        top = name.split(".")[0]
        fine = top == "warp" or name.startswith("sgwarp.kernels") or top in sys.stdlib_module_names
        assert fine, f"kernels/{path.name} imports {name}"
        # It turns annotations into strings, in which a kernel's closure cannot be looked up.
        assert name != "__future__.annotations", f"kernels/{path.name} imports {name}"


def test_kernels_are_no_package():
    """The name `kernels` belongs to somebody else; sgwarp/kernels.py lends the folder an identity."""
    assert not (ROOT / "kernels" / "__init__.py").exists()


@pytest.mark.parametrize("path", files("sgwarp"), ids=dotted)
def test_warp_stays_in_ops(path):
    if dotted(path).split(".")[0] == "ops":
        return
    names = [name for name in imports(path) if name.split(".")[0] == "warp" or name.startswith("sgwarp.kernels")]
    assert not names


@pytest.mark.parametrize("path", files("sgwarp"), ids=dotted)
def test_optional_libraries_are_imported_in_functions(path):
    banned = ON_DEMAND - ({"tyro"} if dotted(path).split(".")[0] == "commands" else set())
    names = [name for name in imports(path, module_level=True) if name.split(".")[0] in banned]
    assert not names


def test_plyfile_stays_in_one_place():
    """It is under the GPL: a user chooses it by reading or writing PLY files."""
    users = {dotted(path) for path in files("sgwarp") if any(n.split(".")[0] == "plyfile" for n in imports(path))}
    assert users <= {"io.ply", "io.compressed_ply"}
    assert users
