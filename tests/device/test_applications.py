"""What is built from the operations, on a pretended CUDA device: the CPU's results, with launches and waits counted."""

import ast
import inspect
from collections import Counter
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest
import torch

import sgwarp as sg
from sgwarp.apps.editing import operations as ops
from sgwarp.cli import main
from sgwarp.datasets.moving import LABELS, make_moving_scene
from sgwarp.datasets.moving_files import save_moving_scene
from sgwarp.encoders.masks.sources import ViewMasks
from sgwarp.files.images import read_ids
from sgwarp.io.sequences import Frame
from sgwarp.network.layers.mink_unet import ARCHITECTURES, Architecture
from sgwarp.rendering.agreement import compare
from sgwarp.rendering.strongest import render_strongest

COUNT = "ops/splatting/tiles.py"  # where the host waits for the number of intersections
# Public functions that compute nothing on a device: files, encoders by name, and geometry of views on the host.
ON_THE_HOST = {"carry_points", "gaussians_from_depth", "make_encoder", "orbit_views", "scenes_in", "text_encoder_for"}


def near(there, here, tolerance=1e-3):
    assert there.is_cuda
    torch.testing.assert_close(there.cpu(), here, rtol=tolerance, atol=tolerance)


def test_every_public_function_that_computes_runs_here():
    """On some device of these tests; a new one needs a test, or a line in ON_THE_HOST."""
    functions = {name for name in sg.__all__ if inspect.isfunction(getattr(sg, name))}
    computing = {name for name in functions if not name.startswith(("load_", "save_"))} - ON_THE_HOST
    called = set()
    for file in Path(__file__).parent.glob("test_*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "sg":
                called.add(node.attr)
    assert len(computing) > 15
    assert computing <= called, computing - called


def counted(device, of="waits"):
    """How often each file of the package waited for the device, or each kernel was launched."""
    if of == "launches":
        return Counter(device.launches)
    return Counter(place.split(":")[0] for _, place in device.waits)


@pytest.fixture
def lifted(stage):
    views = stage.views[:3]
    return sg.lift(stage.gaussians, views, {view.stem: stage.dense(view) for view in views})


def moved(semantics):
    return replace(semantics, features=semantics.features.to("cuda"), weight=semantics.weight.to("cuda"))


class Panels:
    """Masks of the stage's panels."""

    needs_image = False

    def __init__(self, stage):
        self.stage = stage

    def read(self, view, image):
        labels = self.stage.labels(view)
        masks = torch.stack([labels == k for k in labels.unique().tolist() if k])
        return ViewMasks(masks, torch.full((len(masks),), -1))


@pytest.mark.parametrize("kind", ["one_hot", "dense"])
def test_a_further_view_is_lifted_with_three_waits(kind, stage, pretended_cuda):
    """For the tile lists, and before and after its time is taken. What it launches does not depend on the view."""
    maps = {view.stem: getattr(stage, kind)(view) for view in stage.views}
    scene, found = stage.gaussians.to("cuda"), []
    for count in (2, 3, 4):
        pretended_cuda.reset()
        sg.lift(scene, stage.views[:count], maps, device="cuda")
        found.append((counted(pretended_cuda), counted(pretended_cuda, "launches")))
    for (waits, launches), (more_waits, more_launches) in pairwise(found):
        assert more_waits - waits == {"runs/log.py": 2, COUNT: 1}
        assert (more_launches - launches).total() == {"one_hot": 9, "dense": 8}[kind], more_launches - launches


def test_texts_are_scored(stage, lifted, toy_text, pretended_cuda):
    scene, camera, there = stage.gaussians.to("cuda"), stage.views[0].camera, moved(lifted)
    names = ["left door", "lamp"]
    here = sg.score_texts(lifted, names, toy_text)
    pretended_cuda.reset()
    scores = sg.score_texts(there, names, toy_text)
    near(scores.values, here.values)
    best = sg.best_texts(scene, camera, scores)
    assert (best.cpu() == sg.best_texts(stage.gaussians, camera, here)).float().mean() > 0.99
    cosines = sg.query(there, names, toy_text)
    near(sg.evidence(cosines, there), sg.evidence(cosines.cpu(), lifted))
    near(sg.standardise(cosines, there.seen), sg.standardise(cosines.cpu(), lifted.seen))


def test_plans_contributors_and_their_rendering(make_scene, pretended_cuda):
    scene = make_scene("sh3")
    there = scene.gaussians.to("cuda")
    assert sg.plan(there, "rgb") == sg.plan(scene.gaussians, "rgb")
    features = torch.rand(len(scene.gaussians), 5, generator=torch.Generator().manual_seed(1))
    pretended_cuda.reset()
    near(
        render_strongest(there, scene.camera, features.to("cuda"), 8),
        render_strongest(scene.gaussians, scene.camera, features, 8),
    )
    assert counted(pretended_cuda) == {COUNT: 1}


def test_views_that_match_the_scene(stage_files, pretended_cuda):
    views = sg.load_views(stage_files.views)
    here, there = (compare(stage_files.gaussians.to(device), views) for device in ("cpu", "cuda"))
    assert there.matches == here.matches


def test_instances_and_edits(stage, lifted, toy_text, pretended_cuda):
    masks, scene = Panels(stage), stage.gaussians.to("cuda")
    here = sg.instances(stage.gaussians, stage.views[:4], masks)
    there = sg.instances(scene, stage.views[:4], masks)
    assert not there.instance().is_cuda
    assert (there.instance() == here.instance()).float().mean() > 0.99
    steps = [
        sg.EditStep(sg.Selection(("lamp",)), ops.Recolor((0.1, 0.6, 0.15))),
        sg.EditStep(sg.Selection(("book",)), ops.Duplicate((-1.0, 0.0, 0.0))),
        sg.EditStep(sg.Selection(("copy:1",)), ops.Rotate((0.0, 1.0, 0.0), 40.0)),
        sg.EditStep(sg.Selection(("left door",)), ops.Remove()),
    ]
    states = [
        sg.edit(gaussians, steps, sg.EditContext(semantics=semantics, encoder=toy_text, instances=found))
        for gaussians, semantics, found in ((stage.gaussians, lifted, here), (scene, moved(lifted), there))
    ]
    assert states[1].gaussians.means.is_cuda
    assert torch.equal(states[1].rows.cpu(), states[0].rows)
    near(states[1].gaussians.means, states[0].gaussians.means)
    near(states[1].gaussians.sh, states[0].gaussians.sh)


@pytest.fixture(scope="module")
def moving():
    return make_moving_scene(0, 3, 800, cameras=3, width=48, height=36, moving_share=0.5)


@pytest.mark.parametrize("incremental", [True, False])
def test_tracking(moving, incremental, pretended_cuda):
    names = tuple(str(k + 1) for k in range(len(LABELS)))
    maps = {
        (t, view.stem): sg.FeatureMap("labels", ids=moving.truth(t, view.camera) - 1, labels=names)
        for t in range(3)
        for view in moving.cameras
    }

    class Frames:
        def __len__(self):
            return 3

        def frame(self, index):
            return Frame(index, moving.gaussians(index), None, moving.moving)

    results = []
    for device in ("cpu", "cuda"):
        settings = sg.TrackSettings(incremental=incremental, device=device)
        results.append(list(sg.track(Frames(), lambda frame: moving.cameras, maps, settings=settings)))
    for mine, exact in zip(results[1], results[0], strict=True):
        assert mine.features.is_cuda
        near(mine.features, exact.features)
        near(mine.weight, exact.weight, 1e-2)


def run(*arguments, device="cuda:0"):
    assert main([*map(str, arguments), "--device", device]) == 0


def test_the_commands_of_applications(stage_files, tmp_path, pretended_cuda):
    """As on the CPU: the same ids, and scenes of as many Gaussians."""
    scene, views, labels = stage_files.scene, stage_files.views, f"files:{stage_files.labels}"
    for device in ("cpu", "cuda:0"):
        out = tmp_path / device.replace(":", "")
        out.mkdir()
        run("lift", scene, "--views", views, "--encoder", labels, "--out", out / "S.safetensors", device=device)
        found = out / "I.safetensors"
        run("instances", scene, "--views", views, "--masks", labels, "--out", found, device=device)
        shown = ("--semantics", out / "S.safetensors", "--views", views)
        query = ("--text", "2", "--view", "0001", "--out", out / "query.png")
        run("query", scene, *shown, *query, device=device)
        edited = ("--instances", found, "--select", "id:1", "--remove", "--out", out / "edited.ply")
        run("edit", scene, *edited, device=device)
    here, there = (sg.load_instances(tmp_path / name / "I.safetensors") for name in ("cpu", "cuda0"))
    assert (here.instance() == there.instance()).float().mean() > 0.99
    counts = [len(sg.load_gaussians(tmp_path / name / "edited.ply")) for name in ("cpu", "cuda0")]
    assert 0 < counts[0] < len(stage_files.gaussians)
    assert abs(counts[1] - counts[0]) <= 0.01 * counts[0]
    assert (tmp_path / "cuda0" / "query.png").is_file()


def test_the_command_that_tracks(moving, tmp_path, pretended_cuda):
    save_moving_scene(moving, tmp_path / "files", held_out=1)
    parts = ("--views", tmp_path / "files", "--encoder", f"files:{tmp_path / 'files' / 'labels'}", "--no-pictures")
    for device in ("cpu", "cuda:0"):
        run("track", tmp_path / "files" / "params.npz", *parts, "--out", tmp_path / device[:3], device=device)
    images = sorted((tmp_path / "cpu").rglob("*.png"))
    assert images
    for image in images:
        there = tmp_path / "cud" / image.relative_to(tmp_path / "cpu")
        if not image.name.startswith("contact"):
            assert (read_ids(image) == read_ids(there)).mean() > 0.98


def test_the_command_that_distills_and_the_one_that_predicts(stage_files, tmp_path, pretended_cuda):
    """By the command line, from a scene with lifted labels; without augmentation, whose noise is the host's."""
    scene = tmp_path / "scene.ply"
    sg.save_gaussians(stage_files.gaussians.subset(torch.arange(0, len(stage_files.gaussians), 8)), scene)
    lifted, net = tmp_path / "scene.safetensors", tmp_path / "net.safetensors"
    labels = f"files:{stage_files.labels}"
    run("lift", scene, "--views", stage_files.views, "--encoder", labels, "--out", lifted)
    options = ("--voxel", "0.5", "--epochs", "1", "--arch", "14A", "--no-augment")
    pretended_cuda.reset()
    run("distill", tmp_path, *options, "--half", "--out", net)
    assert "normalize_backward_elements" in pretended_cuda.launches
    run("predict", scene, "--net", net, "--out", tmp_path / "P.safetensors")
    found = sg.load_semantics(tmp_path / "P.safetensors", sg.load_gaussians(scene))
    assert torch.isfinite(found.features).all()


def test_a_step_of_distillation_and_a_prediction_are_counted(stage, monkeypatch, pretended_cuda):
    """A step looks at the scene that it has read, and waits for the sizes of voxels; not for layers or Gaussians."""
    monkeypatch.setitem(ARCHITECTURES, "tiny", Architecture((1,) * 8, (16,) * 8))
    gaussians = stage.gaussians.subset(torch.arange(0, len(stage.gaussians), 4))
    shares, weight = torch.eye(4)[stage.classes[::4] - 1], torch.ones(len(gaussians))
    semantics = sg.Semantics(shares, weight, 2 * weight, "labels", gaussians.fingerprint, ("1", "2", "3", "4"))
    scene, found = sg.TrainingScene("stage", lambda: (gaussians, semantics)), []
    for epochs in (1, 2, 3):
        pretended_cuda.reset()
        settings = sg.DistillSettings(arch="tiny", voxel=0.4, epochs=epochs, augment=None)
        network, _ = sg.distill([scene], settings, device="cuda")
        found.append((counted(pretended_cuda), len(pretended_cuda.launches)))
    for (waits, launches), (more_waits, more_launches) in pairwise(found):
        assert more_launches - launches == 161
        assert (more_waits - waits).total() <= 36, more_waits - waits
    there = gaussians.to("cuda")
    pretended_cuda.reset()
    sg.predict(there, network.to("cuda"))
    assert len(pretended_cuda.launches) == 41
    assert len(pretended_cuda.waits) <= 30, counted(pretended_cuda)
