"""The floors of the package: imports point down, kernels stand alone, optional libraries wait until they are used.

Each check reads every source file and reports all violations at once.
"""

import ast
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]

# Bottom to top. A package imports from itself and from lower floors, never from its neighbors.
FLOORS = (
    ("version", "errors"),
    ("files", "kernels"),
    ("runs", "scene"),
    ("io", "metrics", "ops", "visualization"),
    ("compat", "datasets", "encoders", "rendering"),
    ("lifting", "network", "reconstruction"),
    ("fitting", "querying"),
    ("apps",),
    ("cluster", "evaluation", "viewer"),
    ("demo",),
    ("commands",),
    ("cli",),
    ("__main__",),
)
FLOOR = {name: level for level, names in enumerate(FLOORS) for name in names}
# What few use, and what makes `import sgwarp` slow or impossible where it is not installed.
ON_DEMAND = {
    *("cv2", "matplotlib", "plyfile", "pycolmap", "ray", "rich", "safetensors", "scipy", "sklearn", "transformers"),
    *("tyro", "viser"),
}
ORACLE_USERS = {"ops.reference", "evaluation.report"}  # beside tests and benchmarks
PLYFILE_USERS = {"io.ply", "io.compressed_ply"}  # it is under the GPL: a user chooses it by opening a PLY file


def is_for_types(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"


@cache
def parse(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


@cache
def imports(path: Path, module_level: bool = False) -> tuple[str, ...]:
    """Dotted names that a file imports, anywhere or only when it is loaded."""
    return tuple(_imports(path, module_level))


def _imports(path: Path, module_level: bool) -> Iterator[str]:
    nodes = list(ast.walk(parse(path)))
    if module_level:
        later = {
            id(sub)
            for node in nodes
            if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)) or is_for_types(node)
            for sub in ast.walk(node)
        }
        nodes = [node for node in nodes if id(node) not in later]
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def files(folder: str) -> list[Path]:
    found = sorted((ROOT / folder).rglob("*.py"))
    assert found, f"no sources below {folder}"
    return found


def dotted(path: Path) -> str:
    return ".".join(path.relative_to(ROOT / "sgwarp").with_suffix("").parts).removesuffix(".__init__")


PACKAGE = [path for path in files("sgwarp") if path != ROOT / "sgwarp" / "__init__.py"]


def test_every_package_has_a_floor():
    assert {dotted(path).split(".")[0] for path in PACKAGE} <= set(FLOOR), "a new package: say on which floor it is"


def test_imports_point_down():
    wrong = []
    for path in PACKAGE:
        mine = dotted(path).split(".")[0]
        for name in imports(path):
            if name.split(".")[0] != "sgwarp":
                continue
            if name == "sgwarp":
                wrong.append(f"{dotted(path)} imports the whole package")
                continue
            other = name.split(".")[1]
            if other != mine and FLOOR.get(other, len(FLOORS)) >= FLOOR[mine]:
                wrong.append(f"{dotted(path)} imports {name}")
    assert not wrong


def test_the_door_imports_nothing():
    door = imports(ROOT / "sgwarp" / "__init__.py", module_level=True)
    assert {name for name in door if name.startswith("sgwarp")} == {"sgwarp.version.__version__"}


def test_no_circle_between_modules():
    """Modules of one package may import each other, but not in a circle."""
    names = {dotted(path) for path in PACKAGE}
    graph = {}
    for path in PACKAGE:
        targets = (name.removeprefix("sgwarp.") for name in imports(path, module_level=True) if "sgwarp." in name)
        found = {next((t for t in (name, name.rpartition(".")[0]) if t in names), None) for name in targets}
        graph[dotted(path)] = found - {None, dotted(path)}
    done: set[str] = set()

    def visit(name: str, above: tuple[str, ...]) -> None:
        assert name not in above, " -> ".join((*above, name))
        if name not in done:
            for other in graph[name]:
                visit(other, (*above, name))
            done.add(name)

    for name in graph:
        visit(name, ())


def test_kernels_import_warp_and_each_other():
    wrong = []
    for path in files("kernels"):
        for name in imports(path):
            top = name.split(".")[0]
            fine = top == "warp" or name.startswith("sgwarp.kernels") or top in sys.stdlib_module_names
            # It turns annotations into strings, in which a kernel's closure cannot be looked up.
            if not fine or name == "__future__.annotations":
                wrong.append(f"{path.relative_to(ROOT)} imports {name}")
    assert not wrong


def test_kernels_are_no_package():
    """The PyPI name `kernels` is taken; sgwarp/kernels.py makes the folder importable as `sgwarp.kernels`."""
    assert not list((ROOT / "kernels").rglob("__init__.py"))


def users_of(*tops: str, module_level: bool = False) -> set[str]:
    """Modules that import a library, or a part of the package."""
    return {
        dotted(path)
        for path in PACKAGE
        for name in imports(path, module_level)
        if any(name == top or name.startswith(top + ".") for top in tops)
    }


def test_warp_stays_in_ops():
    assert {name.split(".")[0] for name in users_of("warp", "sgwarp.kernels")} == {"ops"}


def test_production_does_not_import_an_oracle():
    users = users_of("sgwarp.ops.reference")
    assert users
    assert {".".join(name.split(".")[:2]) for name in users} <= ORACLE_USERS


def test_optional_libraries_are_imported_in_functions():
    users = {top: users_of(top, module_level=True) for top in ON_DEMAND}
    users["tyro"] = {name for name in users["tyro"] if name.split(".")[0] != "commands"}
    assert not {top: names for top, names in users.items() if names}


def test_plyfile_stays_in_one_place():
    users = users_of("plyfile")
    assert users
    assert users <= PLYFILE_USERS


def test_no_module_has_the_name_of_its_function():
    """`sgwarp.lifting.lifter.lift`, not `lift.lift`: a name means one thing."""
    wrong = [
        dotted(path)
        for path in PACKAGE
        if not dotted(path).startswith("commands.")
        for node in parse(path).body
        if isinstance(node, ast.FunctionDef) and node.name == path.stem
    ]
    assert not wrong
