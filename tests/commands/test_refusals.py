"""Every value that a command refuses by itself: one line that names the option, code 2, and no file anywhere."""

import json
import shutil
from pathlib import Path

import pytest
import torch

from sgwarp.apps.editing.picker import EditContext, EditState, pick
from sgwarp.apps.editing.selection import Selection
from sgwarp.cli import main
from sgwarp.errors import InputError
from sgwarp.io.store import save_semantics
from sgwarp.lifting.lifter import lift


@pytest.fixture(scope="module")
def files(stage, stage_files, tmp_path_factory) -> Path:
    """A folder as a user has it; every test runs in it and leaves it as it was."""
    home = tmp_path_factory.mktemp("home")
    shutil.copy(stage_files.scene, home / "scene.ply")
    shutil.copytree(stage_files.views, home / "views")
    shutil.copytree(stage_files.labels, home / "labels")
    (home / "rooms" / "one").mkdir(parents=True)
    shutil.copy(stage_files.scene, home / "rooms" / "one" / "scene.ply")
    save_semantics(lift(stage_files.gaussians, stage.views, stage.dense), home / "s.safetensors", {"encoder": "x"})
    steps = [{"select": ["all"], "do": "scale", "factor": 2}]
    script = {"format": "sgwarp-edit", "version": 1, "scene": stage_files.gaussians.fingerprint, "steps": steps}
    (home / "steps.json").write_text(json.dumps(script))
    return home


QUERY = "query scene.ply --semantics s.safetensors --views views --view 0001 --out q.png"
SEGMENT = "segment scene.ply --semantics s.safetensors --views views --out o"
EDIT = "edit scene.ply --out e.ply"
INSTANCES = "instances scene.ply --views views --masks files:labels --out i.safetensors"
FIT, TRACK = "fit views --out f.ply", "track p.npz --views views --out o"
BATCH = "batch rooms --do lift --out o"
EVALUATE = "evaluate room --data rooms --out o"
REFUSED = [
    ("convert scene.ply a.txt", "a.txt: scenes are written as "),
    ("convert scene.ply scene.ply", "scene.ply: is read by this command"),
    ("convert scene.ply ./views/../scene.ply", "is read by this command"),
    ("lift scene.ply --views views --out s.ply", "--out s.ply: the name must end in .safetensors"),
    ("lift scene.ply --views views --out views", "--out views: the name must end in .safetensors"),
    ("predict scene.ply --net n --out p.ply", "--out p.ply: the name must end in .safetensors"),
    ("predict scene.ply --net n --out s.safetensors", "--out s.safetensors: holds semantics that were lifted"),
    ("distill rooms --out n.ply", "--out n.ply: the name must end in .safetensors"),
    ("distill rooms --out s.safetensors", "--out s.safetensors: holds semantics that were lifted"),
    ("poses nowhere --out o", "nowhere: no such file or folder"),
    ("poses views --out scene.ply/o", "--out scene.ply/o: "),
    ("fit nowhere --out f.ply", "nowhere: no such file or folder"),
    ("fit views --out f.spz", "--out f.spz: the name must end in .ply"),
    ("fit views --out views/points3D.ply", "is a name of the points that a fit starts from"),
    (f"{FIT} --hold-out -1", "--hold-out: expected 0 or more, got -1"),
    (f"{FIT} --init depth", "--init depth: needs --depth"),
    (f"{QUERY} --text EMPTY", "--text: is empty"),
    (f"{QUERY} --text lamp --threshold nan", "--threshold: expected a finite number, got nan"),
    (f"{QUERY} --text lamp --threshold inf", "--threshold: expected a finite number, got inf"),
    (f"{QUERY} --text lamp --box 0", "--box: expected a side of 1 pixel or more, got 0"),
    (f"{QUERY} --text lamp --min-weight 1e9", "--min-weight 1e+09: no Gaussian has as much"),
    (f"{QUERY} --text lamp --ensemble 3d", "--ensemble 3d: needs --predicted"),
    (QUERY.replace("q.png", "q.jpg") + " --text lamp", "--out q.jpg: the name must end in .png"),
    (QUERY.replace("0001", "9") + " --text lamp", "views: has no view '9'; its 6 views are named 0000, 0001, "),
    (f"{SEGMENT} --unknown-below 1.01", "--unknown-below: expected a confidence from 0 to 1, got 1.01"),
    (f"{SEGMENT} --unknown-below -0.01", "--unknown-below: expected a confidence from 0 to 1, got -0.01"),
    (f"{SEGMENT} --classes lamp,,wall", "--classes 'lamp,,wall': name 2 is empty"),
    (f"{SEGMENT} --classes lamp,wall,lamp", "--classes 'lamp,wall,lamp': 'lamp' stands there twice"),
    (f"{SEGMENT} --classes lamp --view 9", "has no view '9'"),
    ("segment scene.ply --semantics s.safetensors --views views --out scene.ply", "--out scene.ply: "),
    ("render scene.ply --view 0001 --out o", "--view 0001: needs --views"),
    ("render scene.ply --views views --out o.png", "--out o.png: is one file for 6 views"),
    ("render scene.ply --frames 2 --out o.png", "--out o.png: is one file for 2 views"),
    ("render scene.ply --frames 0 --out o", "an orbit needs one view or more, got 0"),
    ("edit scene.ply --out e.spz --select all --scale 2", "--out e.spz: the name must end in .ply"),
    ("edit scene.ply --out scene.ply --select all --scale 2", "--out scene.ply: is read by this command"),
    (f"{EDIT} --select all --scale 2 --view 0001", "--view 0001: needs --views"),
    (f"{EDIT} --select all --scale 2 --undo 1", "--undo 1: needs --script"),
    (f"{EDIT} --select all --scale 2 --encoder x", "--encoder x: needs --semantics"),
    (f"{EDIT} --select all", "give --select and at least one of --remove"),
    (f"{EDIT} --scale 2", "give --select and at least one of --remove"),
    (f"{EDIT} --select id:1 --scale 2 --remove", "--remove: leaves nothing that another operation could change"),
    (f"{EDIT} --script steps.json --select all", "--script: already says what to do"),
    (f"{EDIT} --script steps.json --scale 2", "--script: already says what to do"),
    (f"{EDIT} --script steps.json --keep id:1", "--keep: goes with --select"),
    (f"{EDIT} --script steps.json --negatives a", "--negatives: goes with --select"),
    (f"{EDIT} --script steps.json --threshold 0.4", "--threshold: goes with --select"),
    (f"{EDIT} --script steps.json --grow 1", "--grow: goes with --select"),
    (f"{EDIT} --script steps.json --no-clean", "--no-clean: goes with --select"),
    (f"{EDIT} --script steps.json --undo 1", "--undo 1: steps.json has 1 steps"),
    (f"{EDIT} --script steps.json --undo -1", "--undo -1: steps.json has 1 steps"),
    (INSTANCES.replace("i.safetensors", "i.ply"), "--out i.ply: the name must end in .safetensors"),
    (INSTANCES.replace("i.safetensors", "s.safetensors"), "--out s.safetensors: holds semantics that were lifted"),
    (f"{INSTANCES} --ply i.spz", "--ply i.spz: the name must end in .ply"),
    (f"{INSTANCES} --ply scene.ply", "--ply scene.ply: is read by this command"),
    (f"{INSTANCES} --render-views views", "--render-views: needs --render-out"),
    (f"{INSTANCES} --render-out labels", "--render-out labels: holds the images of files:labels"),
    (f"{INSTANCES} --render-out scene.ply", "--render-out scene.ply: "),
    (f"{INSTANCES} --classes lamp", "--classes and --least-cosine need --semantics"),
    (f"{INSTANCES} --least-cosine 0.5", "--classes and --least-cosine need --semantics"),
    (f"{TRACK} --unknown-below 1.5", "--unknown-below: expected a confidence from 0 to 1, got 1.5"),
    (f"{TRACK} --unknown-below -1", "--unknown-below: expected a confidence from 0 to 1, got -1"),
    ("track p.npz --views views --out scene.ply", "--out scene.ply: "),
    ("view scene.ply --predicted s.safetensors", "--predicted: needs --semantics"),
    ("report scene.ply --views views --out scene.ply", "--out scene.ply: "),
    (f"{BATCH} --options lift.tau", "--options: expected option=value, got 'lift.tau'"),
    (f"{BATCH} --options =0.5", "--options: expected option=value, got '=0.5'"),
    (f"{BATCH} --options tau=1 lift.tau=1 tau=2", "--options: 'tau' stands there twice"),
    (f"{BATCH} --workers 0", "--workers: expected 1 or more, got 0"),
    (f"{BATCH} --threads 0", "--threads: expected 1 or more, got 0"),
    (f"{BATCH} --time-limit 0", "--time-limit: expected a positive number, got 0"),
    (f"{BATCH} --time-limit inf", "--time-limit: expected a positive number, got inf"),
    (f"{BATCH} --memory-limit 0", "--memory-limit: expected a positive number, got 0"),
    (f"{BATCH} --memory-limit -1", "--memory-limit: expected a positive number, got -1"),
    (f"{BATCH} --memory-limit nan", "--memory-limit: expected a positive number, got nan"),
    (f"{BATCH} --address x:1", "--address and --gpus: are for --engine ray"),
    (f"{BATCH} --gpus 0.5", "--address and --gpus: are for --engine ray"),
    ("batch nowhere --do lift --out o", "nowhere: no such folder, list or pattern"),
    ("batch rooms --do lift --out scene.ply", "--out scene.ply: "),
    (f"{EVALUATE} --epochs 0 --encoder truth", "--epochs: expected 1 or more, got 0"),
    (f"{EVALUATE} --train rooms --encoder truth", "--train rooms: goes with --ablate inputs"),
    (f"{EVALUATE} --train rooms --ablate views --encoder truth", "--train rooms: goes with --ablate inputs"),
    (f"{EVALUATE} --ablate views --semantics s.safetensors", "--ablate: lifts anew each time"),
    (f"{EVALUATE} --encoder clip:PATH", "--encoder: profile room is published with clip:PATH"),
    ("evaluate room --data rooms --out scene.ply --encoder truth", "--out scene.ply: "),
    ("info scene.ply --data-set scannet", "scene.ply: "),
]


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.mark.parametrize(("command", "message"), REFUSED, ids=[command for command, _ in REFUSED])
def test_a_refusal_is_one_line_before_any_file(files, toy_text, monkeypatch, capsys, command, message):
    monkeypatch.setattr("sgwarp.encoders.registry.text_encoder_for", lambda *given: toy_text)
    monkeypatch.chdir(files)
    before = contents(files)
    assert main([" " if word == "EMPTY" else word for word in command.split()]) == 2
    *notices, refusal = capsys.readouterr().err.strip().splitlines()
    assert all("has no effect" in notice for notice in notices), notices
    assert message in refusal
    assert contents(files) == before


@pytest.mark.parametrize(
    ("x", "y", "inside"),
    [(0, 0, True), (95, 71, True), (96, 71, False), (95, 72, False), (-1, 0, False), (0, -1, False)],
)
def test_a_click_is_inside_the_image(stage, toy_text, x, y, inside):
    semantics = lift(stage.gaussians, stage.views, stage.dense)
    none = torch.zeros(len(stage.gaussians), dtype=torch.int32)
    state = EditState(stage.gaussians, torch.arange(len(none)), none, none.bool())
    context = EditContext(semantics, toy_text, None, stage.views)
    view = stage.views[0]
    assert (view.camera.width, view.camera.height) == (96, 72)
    term = Selection((f"click:{view.stem},{x},{y}",))
    refusal = "selects no Gaussian" if inside else f"click:{view.stem},{x},{y}: outside the image, which is 96 x 72"
    with pytest.raises(InputError, match=refusal):  # nothing is seen in the corners
        pick(state, term, context)
