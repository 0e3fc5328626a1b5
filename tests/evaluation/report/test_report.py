"""`sgwarp report` on a small scene: its oracle, its sweeps, its files."""

import json
import sys
from dataclasses import asdict, replace

import cv2
import numpy as np
import pytest
import torch

from sgwarp.cli import main
from sgwarp.errors import InputError
from sgwarp.evaluation.report import oracle
from sgwarp.evaluation.report.extremes import Extreme
from sgwarp.evaluation.report.page import Findings, Stability, write_json, write_page
from sgwarp.evaluation.report.run import split_views
from sgwarp.evaluation.report.stability import GradientResult, ImageResult
from sgwarp.evaluation.report.sweep import Trial, pareto_front, rendering_variants
from sgwarp.files.images import read_rgb
from sgwarp.io.scenes import save_gaussians
from sgwarp.ops.reference import rasterizer as reference
from sgwarp.ops.splatting.forward import rasterize
from sgwarp.runs.log import RunLog
from sgwarp.scene import View

WIDTH, HEIGHT = 72, 56


@pytest.fixture(scope="module")
def cloud(scenes):
    """300 Gaussians before four cameras beside each other."""
    gaussians = scenes.cloud(300, seed=1, scale=(0.1, 0.4), opacity=(0.3, 1.0), degree=1)
    places = (-0.6, -0.2, 0.2, 0.6)
    cameras = [scenes.pinhole(WIDTH, HEIGHT, position=(x, 0.0, -1.0), target=(0.0, 0.0, 4.0)) for x in places]
    return gaussians, [View(f"v{k}", camera) for k, camera in enumerate(cameras)]


@pytest.fixture(scope="module")
def on_disk(cloud, tmp_path_factory):
    """The cloud as a user would have it: a PLY file, posed photographs, and label images of its left and right half."""
    gaussians, views = cloud
    folder = tmp_path_factory.mktemp("cloud")
    save_gaussians(gaussians, folder / "cloud.ply")
    (folder / "labels").mkdir()
    right = (gaussians.means[:, 0] > 0).float()
    frames = []
    for view in views:
        seen = rasterize(gaussians, view.camera)
        cv2.imwrite(
            str(folder / f"{view.stem}.png"), (seen.features.clamp(0, 1).numpy()[..., ::-1] * 255).astype("uint8")
        )
        share = rasterize(gaussians, view.camera, torch.stack([1 - right, right], dim=1)).features
        labels = torch.where(seen.alpha > 0.5, share.argmax(dim=2) + 1, 0)
        cv2.imwrite(str(folder / "labels" / f"{view.stem}.png"), labels.numpy().astype(np.uint8))
        to_world = torch.linalg.inv(view.camera.world_to_camera) @ torch.diag(torch.tensor([1.0, -1, -1, 1]).double())
        frames.append({"file_path": f"{view.stem}.png", "transform_matrix": to_world.tolist()})
    K = views[0].camera.K
    intrinsics = {"fl_x": K[0, 0].item(), "fl_y": K[1, 1].item(), "cx": K[0, 2].item(), "cy": K[1, 2].item()}
    meta = {"w": WIDTH, "h": HEIGHT, **intrinsics, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(meta))
    return folder


def report(folder, out, *options) -> int:
    return main(["report", str(folder / "cloud.ply"), "--views", str(folder), "--out", str(out), *options])


def fails(capsys, *arguments) -> str:
    assert report(*arguments) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    return lines[0]


@pytest.fixture(scope="module")
def written(on_disk, tmp_path_factory):
    """The folder of a whole report, without the extreme scenes."""
    out = tmp_path_factory.mktemp("report")
    options = ("--labels", str(on_disk / "labels"), "--held-out", "1", "--patches", "9", "--repeats", "1")
    assert report(on_disk, out, *options, "--no-extremes") == 0
    return out


@pytest.mark.slow
def test_patches_are_pieces_of_the_whole_image(cloud):
    gaussians, views = cloud
    everything = 5 * 4  # 72 x 56 in squares of 16, the last ones cut
    patches = oracle.see_patches(gaussians, views[1], everything, oracle.SAME, seed=3)
    whole = reference.rasterize(gaussians, views[1].camera)
    assert patches.pixels == WIDTH * HEIGHT
    mine, exact = patches.pairs(whole.features)
    torch.testing.assert_close(mine, exact, rtol=0, atol=1e-12)
    assert patches.rounding(whole.features + 0.5).min() > 0.49
    few = oracle.see_patches(gaussians, views[1], 3, oracle.SAME, seed=3)
    assert len(few.colors) == 3


def test_psnr():
    zeros = torch.zeros(10, 3)
    assert oracle.psnr(zeros, zeros + 0.1) == pytest.approx(20.0, abs=1e-5)
    assert oracle.psnr(zeros, zeros) == float("inf")


def test_pareto_front_holds_what_nothing_beats():
    points = {"slow best": (9, 5.0), "beaten": (8, 2.0), "middle": (4, 3.0), "fastest": (1, 1.0), "tie": (4, 2.5)}
    trials = [Trial(name, "", seconds, 0.0, {"psnr": value}) for name, (seconds, value) in points.items()]
    assert [trial.knob for trial in pareto_front(trials, "psnr")] == ["fastest", "middle", "slow best"]


def test_views_are_split_evenly(cloud):
    _, views = cloud
    train, held_out = split_views(views, 2)
    assert [view.stem for view in train] == ["v0", "v2"]
    assert [view.stem for view in held_out] == ["v1", "v3"]
    for count in (0, 4):
        with pytest.raises(InputError, match="--held-out"):
            split_views(views, count)


def test_shares_of_the_gaussians(cloud):
    gaussians, views = cloud
    first, again, other = (
        {(knob, setting): draw for knob, setting, draw in rendering_variants(gaussians, seed)} for seed in (0, 0, 1)
    )
    image = {key: draw(views[0].camera) for key, draw in first.items()}
    key = ("random Gaussians", "50%")
    assert torch.equal(image[key], again[key](views[0].camera))
    assert not torch.equal(image[key], other[key](views[0].camera))
    assert torch.equal(image["default", ""], rasterize(gaussians, views[0].camera).features)
    errors = [(image["largest Gaussians", f"{share}%"] - image["default", ""]).abs().mean() for share in (75, 25, 10)]
    assert 0 < errors[0] < errors[1] < errors[2]
    assert image["resolution", "1/8"].shape == (HEIGHT, WIDTH, 3)


@pytest.mark.slow
def test_knobs_and_errors_go_together(written):
    record = json.loads((written / "report.json").read_text())
    assert record["about"]["gaussians"] == 300
    assert record["about"]["held_out"] == ["v2"]
    assert record["rounding"] < 2e-5
    rendering = {(trial["knob"], trial["setting"]): trial for trial in record["rendering"]}
    assert record["rendering"][0]["knob"] == "default"
    assert all(trial["seconds"] > 0 for trial in record["rendering"])
    error = {key: trial["errors"]["mean"] for key, trial in rendering.items()}
    default = error["default", ""]
    assert 1e-6 < default < 1e-2, "the default cut-offs are an approximation, not a mistake"
    assert error["alpha_min", "1/1024"] < default < error["alpha_min", "1/128"] < error["alpha_min", "1/32"]
    assert error["transmittance_min", "0.1"] > error["transmittance_min", "0.01"] > default
    assert error["SH degree", "0"] > default
    assert error["random Gaussians", "10%"] > error["random Gaussians", "75%"] > default
    assert rendering["default", ""]["errors"]["psnr_photograph"] > 30, "the photographs are renderings"
    assert any(trial["on_front"] for trial in record["rendering"])
    lifting = {(trial["knob"], trial["setting"]): trial["errors"]["miou"] for trial in record["lifting"]}
    assert lifting["default", ""] > 0.8
    assert lifting["features", "fp16"] == pytest.approx(lifting["default", ""], abs=0.01)
    assert {knob for knob, _ in lifting} == {
        *("default", "lift mode", "features", "views", "alpha_min", "transmittance_min")
    }
    assert record["stability"] == []


def test_files_are_whole(written):
    assert sorted(path.name for path in written.iterdir()) == [
        *("error_and_time.png", "report.json", "report.md", "run.json")
    ]
    plot = read_rgb(written / "error_and_time.png")
    assert min(plot.shape[:2]) > 400
    assert plot.std() > 10
    page = (written / "report.md").read_text()
    assert "](error_and_time.png)" in page
    assert page.count("| **default** |") == 2
    for row in page.splitlines():
        assert not row.startswith("|") or row.count("|") in (10, 9), row
    run = json.loads((written / "run.json").read_text())
    assert {"oracle", "rendering", "lifting", "write"} <= run["stages"].keys()
    assert run["error"]["default_miou"] > 0.8
    assert run["error"]["rounding"] < 2e-5
    assert len(run["outputs"]) == 3


ABOUT = {"scene": "attic", "gaussians": 1234, "width": 640, "height": 480, "device": "CPU", "threads": 2}
ABOUT |= {"version": "1.2.3", "repeats": 5, "pixels": 4608, "patch": 48, "held_out": ["v1", "v3"], "lifted": 7}


def row_of(page: str, start: str) -> list[str]:
    """Cells of the one row of a page's tables that starts so."""
    (row,) = [line for line in page.splitlines() if line.startswith(f"| {start} |")]
    return [cell.strip() for cell in row.strip("|").split("|")]


def test_every_figure_stands_in_its_column(tmp_path):
    seen = {"max": 0.05, "mean": 0.002, "psnr": 41.25, "psnr_photograph": 31.5}
    rendering = [
        Trial("default", "", 0.004, 0.0001, seen),
        Trial("SH degree", "0", 0.002, 0.0002, {**seen, "psnr": 30}),
    ]
    lifting = [Trial("default", "", 2.5, 0.125, {"miou": 0.75, "pixel_accuracy": 0.875, "coverage": 0.5})]
    findings = Findings(ABOUT, 3e-6, rendering, lifting)
    write_page(findings, tmp_path / "report.md")
    write_json(findings, tmp_path / "report.json")
    page = (tmp_path / "report.md").read_text()
    assert "1,234 Gaussians, 640 x 480 pixels, CPU with 2 threads, sgwarp 1.2.3" in page
    assert "medians of 5 runs" in page
    assert "at 4,608 pixels in patches of 48 x 48 of the held-out views v1, v3;" in page
    assert "the renderer is 0.05 off at worst" in page
    assert "with the same cut-offs it is 3.0e-06, the rounding" in page
    assert "Label images of 7 views lifted into the scene, the 2 held-out" in page
    figures = ["2.0 ± 0.2", "2.00", "0.05", "0.002", "30.0", "31.50"]
    assert row_of(page, "SH degree") == ["SH degree", "0", *figures, "●"]
    assert page.count("| **default** |  | 2.500 ± 0.125 | 1.00 | 0.7500 | 0.8750 | 50.0% | ● |") == 1
    record = json.loads((tmp_path / "report.json").read_text())
    assert (record["about"], record["rounding"]) == (ABOUT, 3e-6)
    assert record["lifting"][0]["errors"] == lifting[0].errors


@pytest.mark.parametrize(("device", "told"), [("CPU", "the worse of the two is shown"), ("H100", "of GPUs on H100.")])
def test_the_page_says_in_which_schedule_the_extremes_were_drawn(tmp_path, device, told):
    extreme = Extreme("flat", "one scale is 0", lambda: None, "as it is", image_bound=1e-4)
    image = ImageResult(finite=True, error=1e-5, depth_error=0.0, undecidable=0.0, culled={}, seconds=0.1)
    stability = [Stability(extreme, "lanes", 200, image, None)]
    rendering = [Trial("default", "", 0.004, 0.0001, {"max": 0.05, "mean": 0.002, "psnr": 41.25})]
    write_page(Findings({**ABOUT, "device": device}, 3e-6, rendering, stability=stability), tmp_path / "report.md")
    page = (tmp_path / "report.md").read_text()
    assert told in page
    assert ("in the schedule of GPUs on" in page) is (device != "CPU")


def test_every_figure_of_an_extreme_scene_stands_in_its_column(tmp_path):
    """The worse of both schedules on the page; each of them with its own bounds for machines."""
    extreme = Extreme("flat", "one scale is 0", lambda: None, "as it is", image_bound=1e-4, gradient_bound=3e-3)
    lanes = ImageResult(True, 1e-5, 0.25, 0.02, {"off_screen": 1200, "non_finite": 3}, 0.1)
    block = ImageResult(True, 2e-5, 0.5, 0.07, {"off_screen": 1200, "non_finite": 3}, 0.2)
    slopes = [GradientResult(True, {"means": 1e-3, "translation": value}) for value in (2e-3, 5e-4)]
    stability = [
        Stability(extreme, "lanes", 4321, lanes, slopes[0]),
        Stability(extreme, "block", 4321, block, slopes[1]),
    ]
    rendering = [Trial("default", "", 0.004, 0.0001, {"max": 0.05, "mean": 0.002, "psnr": 41.25})]
    findings = Findings(ABOUT, 3e-6, rendering, stability=stability)
    write_page(findings, tmp_path / "report.md")
    write_json(findings, tmp_path / "report.json")
    page = (tmp_path / "report.md").read_text()
    figures = [
        "4,321",
        "2.0e-05",
        "1.0e-04",
        "0.002",
        "0.003",
        "7%",
        "1,200 off screen, 3 non finite",
        "as it is",
        "yes",
    ]
    assert row_of(page, "**flat**: one scale is 0") == ["**flat**: one scale is 0", *figures]
    assert "1 of 1 extreme scenes" in page
    record = json.loads((tmp_path / "report.json").read_text())["stability"]
    for row, image, slope, schedule in zip(record, (lanes, block), slopes, ("lanes", "block"), strict=True):
        assert row == {
            **{"name": "flat", "what": "one scale is 0", "schedule": schedule, "gaussians": 4321, "within": True},
            **{"image_bound": 1e-4, "gradient_bound": 3e-3, "image": asdict(image), "gradient": asdict(slope)},
        }
    faint = [Stability(extreme, "lanes", 4321, replace(lanes, error=2e-4), None)]
    write_page(Findings(ABOUT, 3e-6, rendering, stability=faint), tmp_path / "report.md")
    row = row_of((tmp_path / "report.md").read_text(), "**flat**: one scale is 0")
    assert (row[2], row[4], row[-1]) == ("2.0e-04", "", "**no**")


@pytest.mark.slow
def test_extremes_are_on_the_page(cloud, tmp_path):
    from sgwarp.evaluation.report.run import make_report

    gaussians, views = cloud
    names, log = ("flat", "empty scene"), RunLog()
    findings = make_report(
        gaussians, views, tmp_path, "cloud", held_out=1, patches=2, repeats=1, extremes=names, log=log
    )
    assert [result.schedule for result in findings.stability] == ["lanes", "block"] * 2
    assert all(result.within for result in findings.stability)
    assert log.error["extremes_out_of_bounds"] == 0
    page = (tmp_path / "report.md").read_text()
    assert "2 of 2 extreme scenes" in page
    assert "| **flat**: one scale is exactly 0 | 200 |" in page
    assert "## Lifting" not in page
    stability = json.loads((tmp_path / "report.json").read_text())["stability"]
    assert len(stability) == 4
    assert stability[0]["gradient"]["finite"]


def test_bad_input_is_one_line(on_disk, tmp_path, capsys, monkeypatch):
    out = tmp_path / "out"
    assert "--held-out 4: expected 1 to 3" in fails(capsys, on_disk, out, "--held-out", "4")
    assert "--repeats 0" in fails(capsys, on_disk, out, "--repeats", "0")
    assert "--patches -1" in fails(capsys, on_disk, out, "--patches", "-1")
    assert "no such folder" in fails(capsys, on_disk, out, "--labels", str(tmp_path / "nowhere"))
    dense = tmp_path / "dense"
    dense.mkdir()
    np.save(dense / "v0.npy", np.zeros((4, HEIGHT, WIDTH), dtype=np.float32))
    assert "compares with label images" in fails(capsys, on_disk, out, "--labels", str(dense))
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert "sgwarp[plots]" in fails(capsys, on_disk, out)
    assert not out.exists() or not list(out.iterdir())
