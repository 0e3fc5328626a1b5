"""The table in kernels/README.md names every kernel with all its arguments, and its example runs."""

import ast
import re
from pathlib import Path

import pytest

KERNELS = Path(__file__).resolve().parents[2] / "kernels"
README = (KERNELS / "README.md").read_text(encoding="utf-8")
COMMON = {"base", "slot", "knobs", "width", "height"}  # explained once above the table
HEADER = ["kernel", "device", "launch", "reads", "writes", "equation"]


def is_kernel(node: ast.AST) -> bool:
    return isinstance(node, ast.FunctionDef) and any("wp.kernel" in ast.unparse(d) for d in node.decorator_list)


def kernels_in_the_sources() -> dict[str, tuple[list[str], str | None]]:
    """Arguments of every kernel and the signature of the factory that makes it, read from the sources."""
    found = {}
    for path in sorted(KERNELS.rglob("*.py")):
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            for kernel in filter(is_kernel, ast.walk(node)):
                factory = f"{node.name}({', '.join(a.arg for a in node.args.args)})" if kernel is not node else None
                found[kernel.name] = ([a.arg for a in kernel.args.args], factory)
    return found


def rows_of_the_table() -> dict[str, list[str]]:
    """Cells of each row, by the name of its kernel."""
    rows: dict[str, list[str]] = {}
    in_table = False
    for line in README.splitlines():
        cells = [cell.strip() for cell in line.strip().strip("|").split("|")] if line.startswith("|") else []
        if cells == HEADER:
            in_table = True
        elif not cells:
            in_table = False
        elif in_table and not set(cells[0]) <= {"-"}:
            name = re.match(r"`(\w+)`", cells[0])
            assert name, f"a row begins without a kernel: {line}"
            assert name[1] not in rows, f"two rows for {name[1]}"
            rows[name[1]] = cells
    return rows


SOURCES = kernels_in_the_sources()
ROWS = rows_of_the_table()


def test_the_sources_were_read():
    assert {"project_gaussians", "composite_colors", "lift_dense_block", "sum_rows"} <= set(SOURCES)
    assert SOURCES["composite_colors"][1] == "make_composite_colors(depth, record)"


def test_the_table_names_every_kernel_and_no_other():
    assert set(ROWS) == set(SOURCES)


@pytest.mark.parametrize("name", sorted(SOURCES))
def test_a_row_names_all_arguments_and_the_factory(name):
    arguments, factory = SOURCES[name]
    kernel, device, launch, reads, writes, _ = ROWS[name]
    assert len(ROWS[name]) == len(HEADER)
    assert device
    assert launch
    assert factory is None or f"`{factory}`" in kernel
    outputs = {a for a in arguments if a.endswith("_out")}
    written = set(re.findall(r"`(\w+)`", writes))
    assert outputs <= written, "outputs belong into the column 'writes'"
    named = written | set(re.findall(r"`(\w+)`", reads))
    assert set(arguments) - COMMON <= named
    stale = {word for word in named if word.endswith("_out")} - outputs
    assert not stale


def test_every_file_is_listed():
    files = {path.relative_to(KERNELS).as_posix() for path in KERNELS.rglob("*.py")}
    assert files == set(re.findall(r"`([\w/]+\.py)`", README.split("## Files")[1].split("## Two schedules")[0]))


# What the README says in numbers, and where the code says it: file, constant, sentence with {} for its value.
FIGURES = [
    (
        "points/neighbors.py",
        "FAN",
        "boxes around {} points `low`, `high`, around {} boxes `large_low`, `large_high`, and around {} of those",
    ),
    ("binning.py", "TILE", "owns a {} x {} tile"),
    ("transmittance.py", "LANES", "the {} pixels of a row are one vector"),
    ("native.py", "GROUP", "take 16 Gaussians to a vector, {} to a thread"),
    ("blocks.py", "BLOCK", "{} threads own a tile"),
    ("binning_lanes.py", "PATCH", "patches of {} x {} tiles"),
    ("native.py", "BATCH", "`batch` [slots, {}] splats"),
    ("compositing/lanes_features.py", "PASS", "`features` [N, S, 1] of {} channels"),
    ("lifting/shared.py", "MAX_IDS", "`tile_ids` [tiles, {}]"),
    ("sparse/convolution_lanes.py", "COLUMNS", "C_out / {}, C_in, {}] flat"),
    ("sparse/convolution_lanes.py", "GRADIENT_GROUP", "groups of {} C_in"),
    ("binning_lanes.py", "SPANS", "first {} tile rows"),
]


def constant(file: str, name: str) -> float:
    """A number, or `wp.constant` of one, at the top of a kernel file."""
    for node in ast.parse((KERNELS / file).read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == name:
            value = node.value.args[0] if isinstance(node.value, ast.Call) else node.value
            return ast.literal_eval(value)
    raise AssertionError(f"{file} has no constant {name}")


@pytest.mark.parametrize(("file", "name", "sentence"), FIGURES)
def test_figures_are_those_of_the_code(file, name, sentence):
    assert sentence.replace("{}", str(constant(file, name))) in " ".join(README.split())


def test_the_example_runs(capsys):
    examples = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
    assert len(examples) == 1
    exec(compile(examples[0], "kernels/README.md", "exec"), {})
    assert capsys.readouterr().out.splitlines() == ["0 visible [345. 240.]", "1 outside_depth [0. 0.]"]
