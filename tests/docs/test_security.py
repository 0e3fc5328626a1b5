"""SECURITY.md: each claim has tests, which are named here; and what it says of the lock file holds."""

import ast
import re
from pathlib import Path

from sgwarp.io.views import load_views
from tools.lock import LOCAL, LOCK, entries, normalized

ROOT = Path(__file__).parents[2]
CLAIMS = {
    "Run code": (
        "test_loaders.py: test_nothing_else_opens_files_of_others, test_no_loader_runs_anything",
        "files/test_torch_files.py: test_nothing_of_a_hostile_file_runs",
    ),
    "Take memory or time without end": (
        "fuzz/test_fuzz.py: test_nothing_but_input_errors",
        "files/test_strange_files.py: test_a_sog_whose_members_unpack_to_more",
        "io/test_ply_header.py: test_a_pipe_is_refused",
        "files/test_torch_files.py: test_a_pipe_is_not_waited_for",
    ),
    "Name other files of the machine": (
        "io/test_names.py: test_names_outside_are_followed_only_when_allowed, test_a_photograph_of_colmap_outside",
        "docs/test_security.py: test_links_inside_a_data_set_are_followed",
    ),
    "Write anywhere but to `--out`": (
        "commands/test_inputs_kept.py: test_no_option_of_any_command_is_written_over",
        "docs/test_security.py: test_names_of_views_have_no_folders",
    ),
    "Act on a terminal": (
        "test_errors.py: test_what_a_terminal_would_act_on_is_written_out",
        "io/test_names.py: test_a_name_that_would_clear_a_terminal",
    ),
    "Come from elsewhere": (
        "viewer/test_bounds.py: test_only_this_machine_is_let_in, test_a_token_is_asked_for_and_kept_in_a_cookie",
        "viewer/test_server.py: test_a_page_of_somebody_else_cannot_connect, "
        "test_other_hosts_get_a_token_and_a_warning",
    ),
    "Open a tunnel": (
        "viewer/test_bounds.py: test_other_messages_are_dropped",
        "viewer/test_server.py: test_hostile_clients_harm_nobody_else",
    ),
    "Name a file": ("viewer/test_server.py: test_hostile_clients_harm_nobody_else",),
    "End the program, or take its memory": (
        "viewer/test_bounds.py: test_uploads_of_a_tab_are_limited, test_phrases_are_bounded",
        "viewer/test_drawn.py: test_an_uploaded_picture_is_bounded_by_its_pixels",
        "viewer/test_server.py: test_a_tab_too_many_is_told",
    ),
}


def test_every_claim_has_tests():
    text = (ROOT / "SECURITY.md").read_text(encoding="utf-8")
    assert re.findall(r"^- \*\*(.+?)\.\*\*", text, re.MULTILINE) == list(CLAIMS)
    for claims in CLAIMS.values():
        for line in claims:
            file, names = line.split(": ")
            tree = ast.parse((ROOT / "tests" / file).read_text(encoding="utf-8"))
            there = {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}
            assert set(names.split(", ")) <= there, line


def test_every_package_has_hashes():
    pinned = {}
    for line in (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines():
        if match := re.match(r"([\w.-]+)==([^\s;]+)", line):
            pinned.setdefault(normalized(match[1]), set()).add(match[2])
    locked = {**entries(LOCK), **entries(LOCAL)}
    assert len(locked) > 100
    assert all(locked.values()), [key for key, hashes in locked.items() if not hashes]
    names = {name for name, _ in locked}
    for name in ("warp-lang", "numpy", "torch", "opencv-contrib-python-headless", "plyfile", "viser", "pycolmap"):
        assert name in names
        versions = {version.partition("+")[0] for other, version in locked if other == name}
        assert versions & {version.partition("+")[0] for version in pinned[name]}, name


def test_links_inside_a_data_set_are_followed(stage_files, tmp_path):
    folder = tmp_path / "set"
    folder.mkdir()
    for path in Path(stage_files.views).iterdir():
        (folder / path.name).symlink_to(path)
    assert [view.stem for view in load_views(folder)] == [view.stem for view in load_views(stage_files.views)]


def test_names_of_views_have_no_folders(stage_files, tmp_path, monkeypatch):
    """Also where a data set that leaves its folder is allowed to: results are named by the stem."""
    folder = tmp_path / "a" / "set"
    folder.mkdir(parents=True)
    source = Path(stage_files.views)
    listing = (source / "transforms.json").read_text(encoding="utf-8")
    monkeypatch.setenv("SGWARP_OUTSIDE", "1")
    (tmp_path / "photos").symlink_to(source)
    moved = re.sub(r'"file_path": "(?:\./)?', '"file_path": "../../photos/', listing)
    (folder / "transforms.json").write_text(moved, encoding="utf-8")
    views = load_views(folder)
    assert len(views) > 1
    assert not any("/" in view.stem or view.stem.startswith(".") for view in views)
