"""Every shell and Python block of the README and the documentation runs, on a small version of the room.

A block that cannot run here is preceded by `<!-- not run: reason -->`. Only options that would take minutes are
changed (SHORTER).
"""

import hashlib
import json
import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import pytest
import torch

import sgwarp as sg
from sgwarp.cli import main
from sgwarp.demo.data import ROOM

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
BLOCK = re.compile(r"(?:<!-- not run: (?P<reason>[^>]+) -->\n)?^```(?P<kind>\w+)\n(?P<code>.*?)^```", re.M | re.S)
SHORTER = {"--steps": "4", "--cap": "1200"}  # a fit of some seconds
SHRINK = 4  # images are this much smaller


@dataclass(frozen=True)
class Block:
    page: str
    line: int
    kind: str
    code: str
    reason: str | None

    def __str__(self) -> str:
        return f"{self.page}:{self.line}"


def blocks(path: Path) -> Iterator[Block]:
    text = path.read_text(encoding="utf-8")
    for found in BLOCK.finditer(text):
        line = text[: found.start("code")].count("\n")
        yield Block(path.relative_to(ROOT).as_posix(), line, found["kind"], found["code"], found["reason"])


BLOCKS = [block for page in PAGES for block in blocks(page)]


def test_blocks_are_found_and_reasons_are_few():
    assert {"sh", "python"} <= {block.kind for block in BLOCKS} <= {"sh", "python", "text", "json"}
    run = [block for block in BLOCKS if block.kind in ("sh", "python")]
    assert sum(block.reason is None for block in run) > len(run) / 2


def shrink_views(source: Path, target: Path, every: int) -> None:
    """Copy a transforms.json with each `every`-th image, shrunk."""
    layout = json.loads((source / "transforms.json").read_text())
    layout.pop("ply_file_path", None)
    for name in ("w", "h"):
        layout[name] //= SHRINK
    for name in ("fl_x", "fl_y", "cx", "cy"):
        layout[name] /= SHRINK
    layout["frames"] = layout["frames"][::every]
    (target / "images").mkdir(parents=True)
    for frame in layout["frames"]:
        image = cv2.imread(str(source / frame["file_path"]))
        small = cv2.resize(image, (layout["w"], layout["h"]), interpolation=cv2.INTER_AREA)
        cv2.imwrite(str(target / frame["file_path"]), small)
    (target / "transforms.json").write_text(json.dumps(layout))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the examples speak of: photos/, scene.ply, and the room under its path in the repository."""
    folder = tmp_path_factory.mktemp("examples")
    scene = sg.load_gaussians(ROOM / "room.compressed.ply")
    few = scene.subset(torch.arange(0, len(scene), 40))
    sg.save_gaussians(few, folder / "scene.ply")
    room = folder / "sgwarp" / "demo" / "room"
    shrink_views(ROOM, room, 4)
    shrink_views(ROOM / "held_out", room / "held_out", 1)
    sg.save_gaussians(few, room / "room.compressed.ply")
    shrink_views(ROOM, folder / "photos", 2)
    layout = json.loads((folder / "photos" / "transforms.json").read_text())
    held_out = json.loads((room / "held_out" / "transforms.json").read_text())["frames"]
    for frame in held_out:  # the examples ask for view 0016
        (folder / "photos" / frame["file_path"]).write_bytes((room / "held_out" / frame["file_path"]).read_bytes())
    layout["frames"] += held_out
    (folder / "photos" / "transforms.json").write_text(json.dumps(layout))
    return folder


def shell_commands(code: str, variables: dict[str, str]) -> Iterator[list[str]]:
    """The command lines of a block, with the page's variables put in and long runs made short."""
    for line in code.replace("\\\n", " ").splitlines():
        assignment = re.fullmatch(r"(\w+)=(\S+)", line.strip())
        if assignment:
            variables[assignment[1]] = assignment[2]
            continue
        for name, value in variables.items():
            line = line.replace(f"${name}", value)
        words = shlex.split(line, comments=True)
        for place, word in enumerate(words[:-1]):
            if word in SHORTER:
                words[place + 1] = SHORTER[word]
        if words:
            yield words


@pytest.mark.parametrize("page", [page.relative_to(ROOT).as_posix() for page in PAGES])
def test_the_examples_of_a_page_run(page, folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    scope: dict[str, object] = {}
    variables: dict[str, str] = {}
    for block in BLOCKS:
        if block.page != page or block.reason is not None or block.kind not in ("sh", "python"):
            continue
        if block.kind == "python":
            exec(compile(block.code, str(block), "exec"), scope)
            continue
        for words in shell_commands(block.code, variables):
            assert words[0] == "sgwarp", f"{block}: say why `{words[0]}` cannot run here"
            assert main(words[1:]) == 0, f"{block}: {shlex.join(words)}\n{capsys.readouterr().err}"


@pytest.mark.parametrize("page", [page.relative_to(ROOT).as_posix() for page in [*PAGES, ROOT / "CONTRIBUTING.md"]])
def test_links_lead_somewhere(page):
    text = (ROOT / page).read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)#\s]+)", text):
        if "://" not in target:
            assert (ROOT / page).parent.joinpath(target).exists(), f"{page}: {target} does not exist"


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 120


def test_rendered_notebooks_are_those_of_the_folder():
    """Pages of notebooks carry a hash of their source; `python -m tools.render_notebooks` makes them again."""
    for source in sorted((ROOT / "notebooks").glob("*.py")):
        page = ROOT / "docs" / "notebooks" / f"{source.stem}.md"
        digest = hashlib.sha256(source.read_bytes()).hexdigest()[:16]
        assert page.read_text(encoding="utf-8").startswith(f"<!-- notebooks/{source.name} {digest} -->"), source.name
