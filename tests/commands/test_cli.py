"""The command line in this process: files in, files and exit codes out."""

import json
import shutil
import subprocess
import sys

import cv2
import numpy as np
import pytest
import torch
from plyfile import PlyData, PlyElement

from sgwarp.cli import main
from sgwarp.files.images import read_ids
from sgwarp.io.scenes import save_gaussians
from sgwarp.io.store import load_semantics, save_semantics
from sgwarp.lifting.lifter import lift
from sgwarp.metrics.segmentation import ConfusionMatrix
from sgwarp.scene import Gaussians

RUN_KEYS = ["command", "version", "device", "threads", "stages", "left_out", "error", "outputs"]
NAMES = ["wall", "left door", "lamp", "book"]


def fails(capsys, *arguments) -> str:
    """Run a command that has to end with code 2; returns its one line on stderr."""
    assert main([str(a) for a in arguments]) == 2
    captured = capsys.readouterr()
    lines = captured.err.strip().splitlines()
    assert len(lines) == 1, captured.err
    assert lines[0].startswith("sgwarp: ")
    return lines[0]


@pytest.fixture(scope="module")
def lifted(stage_files, tmp_path_factory):
    """Labels lifted by the command line."""
    out = tmp_path_factory.mktemp("lifted") / "s.safetensors"
    arguments = [
        stage_files.scene,
        "--views",
        stage_files.views,
        "--encoder",
        f"files:{stage_files.labels}",
        "--out",
        out,
    ]
    assert main(["lift", *map(str, arguments), "--threads", "2"]) == 0
    return out


@pytest.fixture
def text_semantics(stage, stage_files, toy_text, tmp_path, monkeypatch):
    """Semantics of a toy text space on disk, and its text encoder in the registry."""
    monkeypatch.setattr("sgwarp.encoders.registry.text_encoder_for", lambda space, *rest: toy_text)
    path = tmp_path / "text.safetensors"
    save_semantics(lift(stage_files.gaussians, stage.views, stage.dense), path)
    return path


def test_lift_writes_semantics_and_the_run(stage_files, lifted):
    semantics = load_semantics(lifted, stage_files.gaussians)
    assert semantics.space == "labels"
    assert semantics.coverage > 0.9
    run = json.loads((lifted.parent / "run.json").read_text())
    assert list(run) == RUN_KEYS
    assert run["command"].startswith("sgwarp lift ")
    assert (run["device"], run["threads"]) == ("cpu", 2)
    assert {"read", "encode", "lift", "residual", "write"} <= set(run["stages"])
    assert run["left_out"]["views_without_map"] == 1
    assert run["error"]["coverage"] == pytest.approx(semantics.coverage)
    assert 0 < run["error"]["residual"] < 0.15
    assert run["outputs"] == [str(lifted)]
    assert sorted(p.name for p in lifted.parent.iterdir()) == ["run.json", lifted.name]


def test_segment_without_classes_writes_the_ids(stage, stage_files, lifted, tmp_path, capsys):
    out = tmp_path / "out"
    arguments = ["segment", stage_files.scene, "--semantics", lifted, "--views", stage_files.views, "--out", out]
    assert main([str(a) for a in arguments]) == 0
    assert "unknown" in capsys.readouterr().out
    matrix = ConfusionMatrix.empty(5)
    for view in stage.views:
        raw = cv2.imread(str(out / f"{view.stem}.png"), cv2.IMREAD_UNCHANGED)
        assert raw.dtype == np.uint8
        assert raw.shape == view.camera.size
        matrix.add(torch.from_numpy(raw), stage.labels(view))
        assert cv2.imread(str(out / "overlays" / f"{view.stem}.png")) is not None
    assert matrix.miou > 0.85
    run = json.loads((out / "run.json").read_text())
    assert len(run["outputs"]) == 2 * len(stage.views)
    assert 0 < run["error"]["unknown"] < 0.6


def test_segment_ids_past_255_need_16_bits(stage_files, lifted, tmp_path):
    from dataclasses import replace

    semantics = replace(load_semantics(lifted), labels=("1", "2", "300", "4"))
    path, out = tmp_path / "big.safetensors", tmp_path / "out"
    save_semantics(semantics, path)
    arguments = ["segment", stage_files.scene, "--semantics", path, "--views", stage_files.views, "--out", out]
    assert main([*map(str, arguments), "--view", "0002"]) == 0
    raw = cv2.imread(str(out / "0002.png"), cv2.IMREAD_UNCHANGED)
    assert raw.dtype == np.uint16
    assert set(np.unique(raw)) == {0, 1, 2, 300, 4}


def test_segment_with_classes(stage, stage_files, text_semantics, tmp_path):
    out = tmp_path / "out"
    arguments = [
        "segment",
        stage_files.scene,
        "--semantics",
        text_semantics,
        "--views",
        stage_files.views,
        "--out",
        out,
    ]
    assert main([*map(str, arguments), "--classes", "book, wall ,lamp,left door", "--view", "0001"]) == 0
    assert sorted(p.name for p in out.glob("*.png")) == ["0001.png"]
    found, truth = read_ids(out / "0001.png"), stage.labels(stage.views[1]).numpy()
    order = np.array([255, 1, 3, 2, 0])  # void, wall, left door, lamp, book as indices into the list above
    assert (found == order[truth]).mean() > 0.93
    assert set(np.unique(found)) == {0, 1, 2, 3, 255}


@pytest.mark.parametrize("score", ["cosine", "relevancy"])
def test_query_marks_the_object(stage, stage_files, text_semantics, tmp_path, capsys, score):
    out = tmp_path / "mask.png"
    arguments = ["query", stage_files.scene, "--semantics", text_semantics, "--views", stage_files.views, "--out", out]
    assert main([*map(str, arguments), "--text", "left door", "--view", "0003", "--score", score]) == 0
    mask, truth = read_ids(out), stage.labels(stage.views[3]).numpy() == 2
    assert set(np.unique(mask)) == {0, 255}
    assert ((mask == 255) & truth).sum() / ((mask == 255) | truth).sum() > 0.85
    assert (tmp_path / "mask_heat.png").is_file()
    assert capsys.readouterr().out.startswith("left door: best pixel (")
    assert json.loads((tmp_path / "run.json").read_text())["outputs"] == [str(out), str(tmp_path / "mask_heat.png")]


def test_query_for_a_lifted_label(stage, stage_files, lifted, tmp_path):
    out = tmp_path / "mask.png"
    arguments = ["query", stage_files.scene, "--semantics", lifted, "--views", stage_files.views, "--out", out]
    assert main([*map(str, arguments), "--text", "4", "--view", "0002"]) == 0
    mask, truth = read_ids(out) == 255, stage.labels(stage.views[2]).numpy() == 4
    assert (mask & truth).sum() / (mask | truth).sum() > 0.8


def test_render_views(stage, stage_files, tmp_path):
    arguments = ["render", stage_files.scene, "--views", stage_files.views, "--out", tmp_path]
    assert main([*map(str, arguments), "--mode", "depth", "--view", "0002"]) == 0
    depth, truth = np.load(tmp_path / "0002.npy"), stage.depth(stage.views[2]).numpy()
    assert depth.dtype == np.float32
    assert np.median(np.abs(depth - truth)[np.isfinite(truth)]) < 0.02
    assert main([*map(str, arguments)]) == 0
    assert len(list(tmp_path.glob("*.png"))) == len(stage.views)
    drawn = cv2.imread(str(tmp_path / "0002.png"))[..., ::-1]
    photograph = cv2.imread(str(stage_files.views / "images" / "0002.png"))[..., ::-1]
    assert np.median(np.abs(drawn.astype(int) - photograph)) < 8


def test_render_one_view_to_a_named_file(stage_files, tmp_path, capsys):
    arguments = ["render", stage_files.scene, "--views", stage_files.views, "--out", tmp_path / "picture.png"]
    assert main([*map(str, arguments), "--view", "0001"]) == 0
    assert sorted(p.name for p in tmp_path.iterdir()) == ["picture.png", "run.json"]
    capsys.readouterr()
    assert "one file for 6 views" in fails(capsys, *arguments)


def test_render_takes_sizes_from_the_photographs_if_need_be(stage, stage_files, tmp_path):
    views = tmp_path / "views"
    shutil.copytree(stage_files.views, views)
    meta = json.loads((views / "transforms.json").read_text())
    del meta["w"], meta["h"]
    (views / "transforms.json").write_text(json.dumps(meta))
    out = tmp_path / "out"
    assert main(["render", str(stage_files.scene), "--views", str(views), "--view", "0001", "--out", str(out)]) == 0
    assert cv2.imread(str(out / "0001.png")).shape[:2] == stage.views[1].camera.size


def test_render_without_views_turns_around_the_scene(stage_files, tmp_path):
    arguments = ["render", stage_files.scene, "--out", tmp_path, "--frames", "3", "--size", "64", "48"]
    assert main([*map(str, arguments), "--background", "white"]) == 0
    pictures = sorted(tmp_path.glob("*.png"))
    assert [p.stem for p in pictures] == ["orbit_000", "orbit_001", "orbit_002"]
    first = cv2.imread(str(pictures[0]))
    assert first.shape == (48, 64, 3)
    assert (first == 255).all(axis=2).any()
    assert (first < 250).any()


def test_info(stage_files, lifted, capsys):
    arguments = ["info", str(stage_files.scene), "--semantics", str(lifted)]
    assert main([*arguments, "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["gaussians"] == len(stage_files.gaussians)
    assert facts["bounds"][0] == pytest.approx([-1.97, -1.47, 2.7], abs=0.01)
    assert facts["opacity_histogram"] == [0] * 9 + [len(stage_files.gaussians)]
    assert (facts["sh_degree"], facts["non_finite_rows"]) == (0, 0)
    assert facts["fingerprint"] == stage_files.gaussians.fingerprint
    assert facts["semantics"]["space"] == "labels"
    assert facts["semantics"]["coverage"] > 0.9
    assert main(arguments) == 0
    text = capsys.readouterr().out
    assert f"gaussians: {len(stage_files.gaussians)}" in text
    assert f"  coverage: {facts['semantics']['coverage']:.4g}\n" in text


def test_info_names_the_rows_that_cannot_be_rendered(stage, tmp_path, capsys):
    means = stage.gaussians.means.clone()
    means[3, 1] = torch.nan
    scene = Gaussians(
        means, stage.gaussians.quats, stage.gaussians.scales, stage.gaussians.opacities, stage.gaussians.sh
    )
    save_gaussians(scene, tmp_path / "scene.ply")
    assert main(["info", str(tmp_path / "scene.ply"), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["non_finite_rows"] == 1
    assert sum(facts["opacity_histogram"]) == len(scene) - 1


def test_python_runs_the_package():
    command = [sys.executable, "-m", "sgwarp", "info", "no.ply"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith("sgwarp: no.ply: ")


def test_version(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.strip()


@pytest.mark.parametrize("arguments", [[], ["lift"], ["nonsense"], ["info", "a.ply", "--threads", "x"]])
def test_usage_errors_end_with_code_2(arguments, capsys):
    with pytest.raises(SystemExit) as end:
        main(arguments)
    assert end.value.code == 2


def test_bad_input_is_one_line(stage, stage_files, lifted, tmp_path, capsys):
    scene, views, out = stage_files.scene, stage_files.views, tmp_path / "s.safetensors"
    assert "absent.ply" in fails(capsys, "info", tmp_path / "absent.ply")
    cut = tmp_path / "cut.ply"
    cut.write_bytes(scene.read_bytes()[:-100])
    assert "cut.ply" in fails(capsys, "info", cut)
    lifting = ("lift", scene, "--encoder", f"files:{stage_files.labels}")
    assert "must end in .safetensors" in fails(capsys, *lifting, "--views", views, "--out", tmp_path / "s.pt")
    assert str(tmp_path / "none") in fails(capsys, *lifting, "--views", tmp_path / "none", "--out", out)
    assert "--threads" in fails(capsys, *lifting, "--views", views, "--out", out, "--threads", "0")
    assert "cannot be written" not in fails(capsys, *lifting, "--views", views, "--out", cut / "s.safetensors")
    assert "unheard-of" in fails(capsys, "lift", scene, "--views", views, "--out", out, "--encoder", "unheard-of")
    (tmp_path / "empty").mkdir()
    fails(capsys, "lift", scene, "--views", views, "--out", out, "--encoder", f"files:{tmp_path / 'empty'}")
    assert not out.exists()
    assert not (tmp_path / "run.json").exists()

    asking = ("segment", scene, "--semantics", lifted, "--views", views, "--out", tmp_path / "o")
    assert "has no view '9999'; its 6 views are named 0000" in fails(capsys, *asking, "--view", "9999")
    assert "class 'dog' is not among the lifted labels" in fails(capsys, *asking, "--classes", "dog")
    assert "name 2 is empty" in fails(capsys, *asking, "--classes", "1,,2")
    assert "'1' stands there twice" in fails(capsys, *asking, "--classes", "1,2,1")
    assert "needs --views" in fails(capsys, "render", scene, "--out", tmp_path / "o", "--view", "0001")
    assert "orbit" in fails(capsys, "render", scene, "--out", tmp_path / "o", "--frames", "0")
    finding = ("query", scene, "--semantics", lifted, "--views", views, "--view", "0000", "--out", tmp_path / "m.png")
    assert "--text: is empty" in fails(capsys, *finding, "--text", " ")
    assert "--threshold" in fails(capsys, *finding, "--text", "1", "--threshold", "nan")
    assert "--box" in fails(capsys, *finding, "--text", "1", "--box", "0")
    assert "--unknown-below" in fails(capsys, *asking, "--unknown-below", "7")
    assert "--threads" in fails(capsys, *asking, "--threads", "100000")
    (tmp_path / "taken" / "run.json").mkdir(parents=True)
    assert "run.json is a folder" in fails(capsys, *asking[:-1], tmp_path / "taken")

    other = tmp_path / "other.ply"
    save_gaussians(stage.gaussians.subset(torch.arange(100)), other)
    assert "belong to scene" in fails(capsys, "info", other, "--semantics", lifted)


def test_cuda_on_a_machine_without(stage_files, capsys, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    for name in ("cuda", "cuda:1"):
        assert f"--device {name}: this machine" in fails(capsys, "info", stage_files.scene, "--device", name)


def test_a_device_that_does_not_exist(stage_files, capsys):
    assert "expected cpu, cuda or cuda:N" in fails(capsys, "info", stage_files.scene, "--device", "tpu")


def test_interrupt_leaves_nothing_behind(stage_files, tmp_path, monkeypatch, capsys):
    def interrupted(*arguments, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr(sys.modules["sgwarp.lifting.lifter"], "lift_view", interrupted)
    out = tmp_path / "deep" / "s.safetensors"
    arguments = [
        stage_files.scene,
        "--views",
        stage_files.views,
        "--encoder",
        f"files:{stage_files.labels}",
        "--out",
        out,
    ]
    assert main(["lift", *map(str, arguments)]) == 130
    assert capsys.readouterr().err.strip() == "sgwarp: interrupted"
    assert list(tmp_path.rglob("*")) == []


def test_without_tyro_the_remedy_is_named(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "tyro", None)
    assert main(["info", "a.ply"]) == 2
    assert "pip install 'sgwarp[cli]'" in capsys.readouterr().err


def test_notices_go_to_stderr(stage_files, tmp_path, capsys):
    """What a reader leaves out is said in one line, where it does not disturb the answer."""
    vertices = PlyData.read(stage_files.scene)["vertex"].data
    wider = np.empty(len(vertices), dtype=[*vertices.dtype.descr, ("heat", "<f4")])
    for name in vertices.dtype.names:
        wider[name] = vertices[name]
    wider["heat"] = 1.0
    path = tmp_path / "scene.ply"
    PlyData([PlyElement.describe(wider, "vertex")]).write(path)
    for _ in range(2):
        assert main(["info", str(path), "--json"]) == 0
        captured = capsys.readouterr()
        assert json.loads(captured.out)["fingerprint"] == stage_files.gaussians.fingerprint
        (line,) = captured.err.splitlines()
        assert line.startswith(f"sgwarp: {path}: ")
        assert "heat" in line
