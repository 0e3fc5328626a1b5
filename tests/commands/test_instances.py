"""`sgwarp instances` and `sgwarp edit` in this process: files in, files and exit codes out."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from plyfile import PlyData

from sgwarp.apps.editing import operations as ops
from sgwarp.apps.editing.script import EditStep
from sgwarp.apps.editing.selection import Selection
from sgwarp.cli import main
from sgwarp.commands.instances import Instances, listing
from sgwarp.errors import InputError
from sgwarp.files.images import read_ids
from sgwarp.io.instances import load_instances, save_instances
from sgwarp.io.scenes import load_gaussians, save_gaussians
from sgwarp.io.store import save_semantics
from sgwarp.lifting.lifter import lift
from sgwarp.runs.log import RunLog
from sgwarp.runs.progress import hide_progress


def succeeds(*arguments) -> None:
    assert main([str(a) for a in arguments]) == 0


def fails(capsys, *arguments) -> str:
    """Run a command that has to end with code 2; returns its one line on stderr."""
    capsys.readouterr()
    assert main([str(a) for a in arguments]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1, lines
    return lines[0]


@pytest.fixture(scope="module")
def found(stage_files, tmp_path_factory):
    """Instances and id maps by the command line, from label images of all views but the last."""
    folder = tmp_path_factory.mktemp("found")
    out = folder / "i.safetensors"
    succeeds(
        *("instances", stage_files.scene, "--views", stage_files.views, "--masks", f"files:{stage_files.labels}"),
        *("--out", out, "--ply", folder / "with.ply", "--render-out", folder / "maps"),
    )
    return out


def test_instances_writes_what_it_found(stage, stage_files, found):
    instances = load_instances(found, stage_files.gaussians)
    assert len(instances.table) == 4
    table = json.loads(found.with_suffix(".table.json").read_text())
    assert [row["id"] for row in table["instances"]] == [1, 2, 3, 4]
    run = json.loads((found.parent / "run.json").read_text())
    assert run["error"]["instances"] == 4
    assert 14 < run["error"]["bytes_per_gaussian"] < 20
    assert run["left_out"]["views_without_masks"] == 1
    assert set(run["outputs"]) >= {str(found), str(found.parent / "with.ply")}
    view = stage.views[-1]  # it gave no masks
    ids = read_ids(found.parent / "maps" / f"{view.stem}.png")
    assert (found.parent / "maps" / "pictures" / f"{view.stem}.png").is_file()
    truth = stage.labels(view).numpy()
    for number in range(1, 5):
        name = np.bincount(ids[truth == number]).argmax()
        assert name > 0
        assert ((ids == name) & (truth == number)).sum() > 0.85 * ((ids == name) | (truth == number)).sum()


def test_progress_says_that_it_renders(stage, stage_files, found, tmp_path, monkeypatch):
    titles = []

    def show(title):
        titles.append(title)
        return hide_progress(title)

    monkeypatch.setattr("sgwarp.commands.instances.show_progress", show)
    where = {"scene": stage_files.scene, "views": stage_files.views, "out": tmp_path / "i.safetensors"}
    command, log = Instances(**where, masks="", render_out=tmp_path), RunLog()
    scene = stage_files.gaussians
    command._render(scene, stage.views[:1], load_instances(found, scene), log)
    assert titles == ["render"]
    assert [path.endswith(f"{stage.views[0].stem}.png") for path in log.outputs] == [True, True]


@pytest.mark.slow
def test_the_scene_has_columns(stage_files, found):
    rows = PlyData.read(str(found.parent / "with.ply"))["vertex"].data
    instances = load_instances(found, stage_files.gaussians)
    np.testing.assert_array_equal(rows["instance"], instances.instance().numpy())
    np.testing.assert_allclose(rows["confidence"], instances.confidence().numpy())
    assert set(np.unique(rows["label"])) == {-1}
    again = load_gaussians(found.parent / "with.ply")
    assert again.fingerprint == stage_files.gaussians.fingerprint
    assert set(again.extras) == {"instance", "label", "confidence"}
    assert load_gaussians(stage_files.scene).extras is None


def write_parts(stage, folder) -> None:
    """A detector's files: the lamp and the book by name in every view, in two views with names exchanged."""
    folder.mkdir()
    for number, view in enumerate(stage.views):
        labels = stage.labels(view).numpy()
        names = ["lamp", "book"] if number not in (1, 4) else ["book", "lamp"]
        masks = np.stack([labels == 3, labels == 4])
        np.savez(
            folder / f"{view.stem}.npz",
            boxes=np.array([[0, 0, 5, 5]] * 2, np.float32),
            names=np.array(names),
            scores=np.ones(2),
            masks=masks,
        )


def test_parts_by_name_become_consistent(stage, stage_files, tmp_path):
    """A third of the views errs: two of C(6, 2) = 15 pairs are 1 + 6 that agree; lifted, all of them do."""
    write_parts(stage, tmp_path / "parts")
    out = tmp_path / "p.safetensors"
    succeeds(
        *("instances", stage_files.scene, "--views", stage_files.views, "--masks", f"vlpart:{tmp_path / 'parts'}"),
        *("--group", "name", "--out", out),
    )
    instances = load_instances(out)
    assert sorted(row.label for row in instances.table) == ["book", "lamp"]
    error = json.loads((tmp_path / "run.json").read_text())["error"]
    assert error["consistency_before"] == pytest.approx(7 / 15, abs=0.06)
    assert error["consistency_after"] > 0.95
    lamp = next(row.id for row in instances.table if row.label == "lamp")
    assert int(instances.instance()[stage.classes == 3].mode().values) == lamp


def test_names_from_semantics(stage, stage_files, toy_text, tmp_path, monkeypatch):
    monkeypatch.setattr("sgwarp.encoders.registry.text_encoder_for", lambda space, *rest: toy_text)
    save_semantics(lift(stage_files.gaussians, stage.views, stage.dense), tmp_path / "s.safetensors")
    out = tmp_path / "i.safetensors"
    succeeds(
        *("instances", stage_files.scene, "--views", stage_files.views, "--masks", f"files:{stage_files.labels}"),
        *("--out", out, "--semantics", tmp_path / "s.safetensors", "--classes", "wall,left door,lamp,book"),
    )
    instances = load_instances(out)
    for number, name in enumerate(("wall", "left door", "lamp", "book"), start=1):
        mine = int(instances.instance()[stage.classes == number].mode().values)
        assert instances.table[mine - 1].label == name
        assert instances.table[mine - 1].label_score > 0.5


def test_instances_refuses_bad_input(stage_files, found, tmp_path, capsys):
    base = ["instances", stage_files.scene, "--views", stage_files.views, "--out", tmp_path / "o.safetensors"]
    assert "gives no masks" in fails(capsys, *base, "--masks", "conse")
    assert "does not exist" in fails(capsys, *base, "--masks", "nosuch:thing")
    assert "no such folder" in fails(capsys, *base, "--masks", f"files:{tmp_path / 'none'}")
    masks = [*base, "--masks", f"files:{stage_files.labels}"]
    assert "needs --render-out" in fails(capsys, *masks, "--render-views", stage_files.views)
    assert "need --semantics" in fails(capsys, *masks, "--classes", "a,b")
    assert "is read by this command" in fails(capsys, *masks, "--ply", stage_files.scene)
    assert "levels: expected" in fails(capsys, *masks, "--levels", "s,x")
    assert not list(tmp_path.iterdir())


def test_damaged_instances_files(stage_files, found, tmp_path):
    instances = load_instances(found)
    with pytest.raises(InputError, match="belong to scene"):
        load_instances(found, stage_files.gaussians.subset(torch.arange(9)))
    path = tmp_path / "i.safetensors"
    data = found.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(InputError, match="cut short"):
        load_instances(path)
    path.write_bytes(data.replace(b'\\"gaussians\\": ', b'\\"gaussianz\\": '))
    with pytest.raises(InputError, match="metadata is damaged"):
        load_instances(path)
    with pytest.raises(InputError, match="are written as"):
        save_instances(instances, tmp_path / "i.bin")


# sgwarp edit


@pytest.fixture
def edit(stage_files, found, tmp_path):
    return ["edit", stage_files.scene, "--instances", found, "--out", tmp_path / "o.ply"]


def number_of(found, stage, panel: int) -> int:
    return int(load_instances(found).instance()[stage.classes == panel].mode().values)


def test_edit_removes_and_replays(stage, stage_files, found, edit, tmp_path):
    lamp = number_of(found, stage, 3)
    succeeds(*edit, "--select", f"id:{lamp}", "--remove", "--views", stage_files.views, "--view", "0000")
    after = load_gaussians(tmp_path / "o.ply")
    left = len(stage_files.gaussians) - int((stage.classes == 3).sum())
    assert left <= len(after) < left + 10
    assert (tmp_path / "o.png").is_file()
    script = tmp_path / "o.ops.json"
    again = tmp_path / "again.ply"
    succeeds("edit", stage_files.scene, "--instances", found, "--script", script, "--out", again)
    assert again.read_bytes() == (tmp_path / "o.ply").read_bytes()
    run = json.loads((tmp_path / "run.json").read_text())
    assert {str(again), str(tmp_path / "again.ops.json")} <= set(run["outputs"])


def test_several_operations_change_the_same_gaussians(stage, stage_files, found, edit, tmp_path):
    """The box that selects is left by what it selected; the color goes where it went."""
    box = "box:-9,-9,2.9,9,9,3.1"
    succeeds(*edit, "--select", box, "--move", 0, 0, 5, "--rotate", 0, 0, 1, 30, "--recolor", "green")
    before, after = stage_files.gaussians, load_gaussians(tmp_path / "o.ply")
    door = stage.classes == 2
    assert bool((after.means[door, 2] > 7.9).all())
    assert torch.equal((after.sh != before.sh).flatten(1).any(dim=1), door)
    torch.testing.assert_close(after.means[~door], before.means[~door])


def test_columns_of_the_old_scene_are_kept(stage, stage_files, tmp_path):
    scene = tmp_path / "columns.ply"
    number = np.arange(len(stage.classes), dtype=np.int32)
    extras = {"number": number, "half": (number / 2).astype(np.float64)}
    save_gaussians(replace(stage_files.gaussians, extras=extras), scene)
    out = tmp_path / "o.ply"
    succeeds("edit", scene, "--out", out, "--select", "box:-9,-9,2.9,9,9,3.1", "--no-clean", "--remove")
    columns = load_gaussians(out).extras
    np.testing.assert_array_equal(columns["number"], number[(stage.classes != 2).numpy()])
    np.testing.assert_array_equal(columns["half"], columns["number"] / 2)
    succeeds("edit", scene, "--out", out, "--select", "box:-9,-9,2.9,9,9,3.1", "--remove", "--plain")
    assert load_gaussians(out).extras is None


def test_edit_by_text(stage, stage_files, found, toy_text, tmp_path, monkeypatch):
    monkeypatch.setattr("sgwarp.encoders.registry.text_encoder_for", lambda space, *rest: toy_text)
    semantics = tmp_path / "s.safetensors"
    save_semantics(lift(stage_files.gaussians, stage.views, stage.dense), semantics)
    out = tmp_path / "o.ply"
    succeeds(
        *("edit", stage_files.scene, "--semantics", semantics, "--instances", found, "--out", out),
        *("--select", "left door", "--extract"),
    )
    after = load_gaussians(out)
    door = int((stage.classes == 2).sum())
    assert 0.95 * door < len(after) < 1.05 * door
    torch.testing.assert_close(after.means[:, 2], torch.full((len(after),), 3.0), rtol=0, atol=1.01)


def test_edit_refuses_bad_input(stage_files, found, edit, tmp_path, capsys):
    assert "unknown id" in fails(capsys, *edit, "--select", "id:99", "--remove")
    assert "selects no Gaussian" in fails(capsys, *edit, "--select", "box:90,90,90,91,91,91", "--remove")
    assert "would leave no Gaussian" in fails(capsys, *edit, "--select", "all", "--no-clean", "--remove")
    assert "give --select" in fails(capsys, *edit, "--select", "all")
    assert "give --select" in fails(capsys, *edit, "--remove")
    assert "give it alone" in fails(capsys, *edit, "--select", "all", "--remove", "--scale", 2)
    assert "needs --semantics" in fails(capsys, *edit, "--select", "sofa", "--remove")
    assert "color 'mud'" in fails(capsys, *edit, "--select", "all", "--recolor", "mud")
    assert "needs --views" in fails(capsys, *edit, "--select", "all", "--scale", 2, "--view", "0000")
    assert "out of the range" in fails(capsys, *edit, "--select", "all", "--move", 1e39, 0, 0)
    seen = ["--views", stage_files.views, "--view", "nowhere"]
    assert "has no view 'nowhere'" in fails(capsys, *edit, "--select", "all", "--scale", 2, *seen)
    itself = ["edit", stage_files.scene, "--out", stage_files.scene, "--select", "all", "--scale", 2]
    assert "is read by this command" in fails(capsys, *itself)
    other = tmp_path / "other.json"
    steps = [{"select": ["all"], "do": "scale", "factor": 2}]
    other.write_text(json.dumps({"format": "sgwarp-edit", "version": 1, "scene": "0" * 16, "steps": steps}))
    assert "was made for scene" in fails(capsys, *edit, "--script", other)
    other.unlink()
    assert not list(tmp_path.iterdir())


# Every option reaches what does the work


INSTANCE_OPTIONS = {
    "group": ("name", "grouping"),
    "levels": ("s, l", "levels"),
    "least_iou": (0.5, "least_iou"),
    "least_gaussians": (25, "least_gaussians"),
    "least_confidence": (0.75, "least_confidence"),
    "neighbors": (3, "neighbors"),
    "least_cosine": (0.25, "least_cosine"),
}


@pytest.mark.parametrize("name", INSTANCE_OPTIONS)
def test_instance_options_change_what_they_name_alone(stage, stage_files, stopped, tmp_path, name):
    save_semantics(lift(stage_files.gaussians, stage.views, stage.dense), tmp_path / "s.safetensors")
    parts = ["instances", stage_files.scene, "--views", stage_files.views, "--masks", f"files:{stage_files.labels}"]
    parts += ["--out", tmp_path / "i.safetensors", "--semantics", tmp_path / "s.safetensors"]
    value, field = INSTANCE_OPTIONS[name]
    target = "sgwarp.apps.instances.finder.find"
    plain, changed = (stopped(target, *parts, *more) for more in ([], [f"--{name.replace('_', '-')}", value]))
    assert [view.stem for view in plain.positional[1]] == [view.stem for view in stage.views]
    assert plain.semantics.space == "toy"
    wanted = tuple(value.split(", ")) if name == "levels" else value
    assert getattr(plain.positional[3], field) != wanted
    assert replace(plain.positional[3], **{field: wanted}) == changed.positional[3]


@pytest.mark.parametrize(
    ("option", "value"), [("--least-iou", "nan"), ("--neighbors", -1), ("--least-gaussians", 0), ("--levels", "s,s")]
)
def test_a_message_names_the_option(stage_files, capsys, tmp_path, option, value):
    parts = ["instances", stage_files.scene, "--views", stage_files.views, "--masks", f"files:{stage_files.labels}"]
    line = fails(capsys, *parts, "--out", tmp_path / "i.safetensors", option, value)
    assert line.startswith(f"sgwarp: {option}: expected ")


def test_a_file_named_like_an_option_keeps_its_name(stage_files, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    line = fails(
        capsys, "instances", stage_files.scene, "--views", "masks", "--masks", "graph", "--out", "i.safetensors"
    )
    assert line.startswith("sgwarp: masks: ")


def test_edit_options_become_steps(stage, stage_files, found, stopped, edit):
    """A selection with all it was given, and operations in the order in which they make sense."""
    target = "sgwarp.apps.editing.session.edit"
    _, (plain,), context = stopped(target, *edit, "--select", "id:1", "--remove").positional
    assert plain == EditStep(Selection(("id:1",)), ops.Remove())
    assert len(context.instances.table) == 4
    assert (context.semantics, context.views) == (None, ())
    more = ["--keep", "id:2", "box:0,0,0,1,1,1", "--negatives", "wall", "--threshold", 0.25, "--grow", -0.5]
    given = ["--move", 1, 2, 3, "--recolor", "#ff0000", "--rotate", 0, 1, 0, 30, "--scale", 2, "--isolate", 0.25]
    given += ["--duplicate", 4, 5, 6, "--extract", "--views", stage_files.views]
    call = stopped(target, *edit, "--select", "id:1", "lamp", *more, "--no-clean", *given)
    _, steps, context = call.positional
    first = Selection(("id:1", "lamp"), ("id:2", "box:0,0,0,1,1,1"), ("wall",), 0.25, -0.5, clean=False)
    assert [step.selection for step in steps] == [first, *[Selection(("last",), clean=False)] * 6]
    assert [step.operation for step in steps] == [
        ops.Duplicate((4, 5, 6)),
        ops.Scale(2),
        ops.Rotate((0, 1, 0), 30),
        ops.Recolor((1, 0, 0)),
        ops.Move((1, 2, 3)),
        ops.Isolate(0.25),
        ops.Extract(),
    ]
    assert [view.stem for view in context.views] == [view.stem for view in stage.views]


def test_edit_asks_the_encoder_of_its_semantics(stage, stage_files, stopped, toy_text, edit, tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr("sgwarp.encoders.registry.text_encoder_for", lambda *names: asked.append(names) or toy_text)
    path = tmp_path / "s.safetensors"
    save_semantics(lift(stage_files.gaussians, stage.views, stage.dense), path, {"encoder": "clip:somewhere"})
    for more in ([], ["--encoder", "other"]):
        _, _, context = stopped(
            *("sgwarp.apps.editing.session.edit", *edit, "--select", "lamp", "--remove", "--semantics", path, *more)
        ).positional
        assert context.encoder is toy_text
    assert asked == [("toy", "clip:somewhere", "cpu"), ("toy", "other", "cpu")]


def test_the_largest_instances_are_listed(found, monkeypatch):
    instances = load_instances(found)
    first, *rows = listing(instances).splitlines()
    assert first.split()[:4] == ["id", "Gaussians", "views", "sure"]
    by_size = sorted(instances.table, key=lambda row: row.gaussians, reverse=True)
    assert [int(row.split()[0]) for row in rows] == [row.id for row in by_size]
    assert [int(row.split()[1].replace(",", "")) for row in rows] == [row.gaussians for row in by_size]
    monkeypatch.setattr("sgwarp.commands.instances.LISTED", 3)
    assert listing(instances).splitlines()[1:] == [*rows[:3], "1 smaller ones are in the table"]
