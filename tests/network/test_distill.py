"""Training: it learns, it goes on exactly where it stopped, and two processes do what one does."""

import json
import math
import os
import subprocess
import sys
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from sgwarp.cli import main
from sgwarp.errors import InputError
from sgwarp.io.scenes import load_gaussians, save_gaussians
from sgwarp.io.store import save_semantics
from sgwarp.network.augmentation import Augmentation
from sgwarp.network.inputs import voxelize
from sgwarp.network.layers.mink_unet import MinkUNet
from sgwarp.network.prediction import predict
from sgwarp.network.semantic_network import load_network
from sgwarp.network.training import trainer
from sgwarp.network.training.data import TrainingScene, make_example, reliability, scenes_in
from sgwarp.network.training.processes import Processes
from sgwarp.network.training.settings import DistillSettings
from sgwarp.network.training.trainer import distill, state_path
from sgwarp.runs.log import RunLog
from sgwarp.scene import Gaussians, Semantics

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("tiny_architecture")]

SETTINGS = DistillSettings(arch="tiny", voxel=0.12, epochs=2, augment=Augmentation(up=1, elastic=()))


def lifted(gaussians: Gaussians, classes: torch.Tensor, seen: torch.Tensor | None = None) -> Semantics:
    """Perfect label semantics of the stage."""
    seen = torch.ones(len(gaussians), dtype=torch.bool) if seen is None else seen
    shares = torch.eye(4)[classes - 1] * seen[:, None]
    labels = ("1", "2", "3", "4")
    return Semantics(shares, seen.float(), 2.0 * seen.float(), "labels", gaussians.fingerprint, labels)


def in_memory(name: str, gaussians: Gaussians, semantics: Semantics) -> TrainingScene:
    return TrainingScene(name, lambda: (gaussians, semantics))


@pytest.fixture(scope="module")
def scenes(stage) -> list[TrainingScene]:
    """Three different parts of the stage."""
    parts = []
    for number in range(3):
        chosen = torch.arange(number, len(stage.gaussians), 4)
        gaussians = stage.gaussians.subset(chosen)
        parts.append(in_memory(str(number), gaussians, lifted(gaussians, stage.classes[chosen])))
    return parts


def weights_of(network) -> dict[str, torch.Tensor]:
    return {name: tensor.clone() for name, tensor in network.net.state_dict().items()}


def test_a_network_learns_what_it_is_shown(stage):
    """One scene by heart: its Gaussians get their class from shape and colour alone."""
    scene = in_memory("stage", stage.gaussians, lifted(stage.gaussians, stage.classes))
    log = RunLog()
    settings = replace(SETTINGS, epochs=40, learning_rate=0.01, augment=None, validate_every=20)
    network, history = distill([scene], settings, validation=[scene], log=log)
    assert history[-1].loss < 0.1 * history[0].loss
    assert history[-1].miou > 0.9
    assert history[-1].cosine > 0.9
    assert [epoch.epoch for epoch in history] == list(range(1, 41))
    assert [epoch.epoch for epoch in history if epoch.miou is not None] == [20, 40]
    assert log.error["miou"] == history[-1].miou
    semantics = predict(stage.gaussians, network).semantics()
    assert float((semantics.features.argmax(dim=1) == stage.classes - 1).float().mean()) > 0.9


def test_the_learning_rate_falls_along_a_cosine():
    settings = replace(SETTINGS, epochs=4, learning_rate=1.0)
    assert [settings.rate(k) for k in range(4)] == pytest.approx([1, 0.5 + 0.5 * math.cos(math.pi / 4), 0.5, 0.1464466])


def test_training_repeats_and_depends_on_the_seed(scenes):
    one, two = (distill(scenes, SETTINGS) for _ in range(2))
    other = distill(scenes, replace(SETTINGS, seed=1))
    assert [e.loss for e in one[1]] == [e.loss for e in two[1]]
    assert [e.loss for e in one[1]] != [e.loss for e in other[1]]


def test_a_run_that_was_interrupted_goes_on_as_if_it_had_not_been(scenes, tmp_path):
    settings = replace(SETTINGS, epochs=3)
    whole, history = distill(scenes, settings, state=tmp_path / "whole.state.pt")

    def interrupt(done, total, figures):
        if figures.startswith("epoch 3"):
            raise KeyboardInterrupt

    state = tmp_path / "run.state.pt"
    with pytest.raises(KeyboardInterrupt):
        distill(scenes, settings, state=state, progress=interrupt)
    log = RunLog()
    resumed, again = distill(scenes, settings, state=state, log=log)
    assert log.left_out["epochs_done_before"] == 2
    assert [e.loss for e in again] == [e.loss for e in history]
    mine, theirs = weights_of(resumed), weights_of(whole)
    assert all(torch.equal(mine[name], theirs[name]) for name in theirs)
    with pytest.raises(InputError, match=r"another learning_rate \(0\.001, now 0\.01\)"):
        distill(scenes, replace(settings, learning_rate=0.01), state=state)


def test_one_process_alone_writes_the_state(scenes, tmp_path):
    class Follower(Processes):
        leads = False

    for processes, written in ((Follower(), False), (Processes(), True)):
        path = state_path(tmp_path / "n.safetensors")
        distill(scenes[:1], replace(SETTINGS, epochs=1), state=path, processes=processes)
        assert path.exists() == written


def test_a_damaged_state_is_refused(scenes, tmp_path):
    (tmp_path / "s.pt").write_bytes(b"nothing")
    with pytest.raises(InputError, match=r"s\.pt: is damaged, or was not written by torch\.save"):
        distill(scenes, SETTINGS, state=tmp_path / "s.pt")


def test_scenes_of_a_step_share_it(scenes):
    """The gradient of a step is the mean over its scenes: one step of three is not three steps."""
    together = distill(scenes, replace(SETTINGS, epochs=1, scenes_per_step=3))[1][0].loss
    apart = distill(scenes, replace(SETTINGS, epochs=1))[1][0].loss
    first = distill(scenes, replace(SETTINGS, epochs=1, scenes_per_step=3, learning_rate=1e-30))[1][0].loss
    assert together == pytest.approx(first, rel=1e-6)  # all losses are taken before the only step
    assert apart != pytest.approx(first, rel=1e-6)


def test_scenes_without_any_target_are_skipped(scenes, stage):
    g = stage.gaussians
    nothing = in_memory("unseen", g, lifted(g, stage.classes, torch.zeros(len(g), dtype=torch.bool)))
    with pytest.raises(InputError, match="unseen: no Gaussian of this scene, or of any other"):
        distill([nothing], replace(SETTINGS, epochs=1))
    log = RunLog()
    both = distill([nothing, *scenes], replace(SETTINGS, epochs=1, scenes_per_step=2), log=log)[1]
    assert both[0].loss is not None
    assert log.left_out["scenes_without_target"] == 1


def test_voxels_that_hold_no_gaussian_are_refused(scenes):
    with pytest.raises(InputError, match="take larger voxels"):
        distill(scenes, replace(SETTINGS, voxel=1e-9, epochs=1))


def test_a_loss_that_is_not_finite_ends_the_run(scenes, tmp_path):
    state = tmp_path / "s.pt"
    with pytest.raises(InputError, match=r"the loss is not finite in epoch \d"):
        distill(scenes, replace(SETTINGS, epochs=3, learning_rate=1e30), state=state)
    if state.exists():
        stored = torch.load(state, weights_only=True)["net"]
        assert all(bool(torch.isfinite(t).all()) for t in stored.values())


def test_lifted_features_that_are_not_finite_are_no_targets(scenes, stage):
    g = stage.gaussians
    semantics = lifted(g, stage.classes)
    features = semantics.features.clone()
    features[::50] = float("nan")
    broken = in_memory("broken", g, replace(semantics, features=features))
    _, history = distill([broken], replace(SETTINGS, epochs=1), validation=[broken])
    assert math.isfinite(history[0].loss)
    assert math.isfinite(history[0].cosine)


def test_a_state_belongs_to_its_scenes_and_first_weights(scenes, tmp_path):
    state = tmp_path / "s.pt"
    network, _ = distill(scenes, replace(SETTINGS, epochs=1), state=state)
    with pytest.raises(InputError, match="another scenes"):
        distill(scenes[:2], replace(SETTINGS, epochs=1), state=state)
    with pytest.raises(InputError, match="another first weights"):
        distill(scenes, replace(SETTINGS, epochs=1), state=state, weights=network.net.state_dict())


def test_targets_are_mean_directions_of_the_seen_gaussians(stage):
    g = stage.gaussians
    seen = torch.arange(len(g)) % 3 > 0
    features = torch.randn(len(g), 6, generator=torch.Generator().manual_seed(1)) * seen[:, None]
    semantics = Semantics(features, seen.float(), seen.float(), "toy", g.fingerprint)
    example = make_example(g, semantics, "full", 0.2)
    rows = voxelize(g, "full", 0.2).rows
    for place in (0, 3, len(example.rows) - 1):
        mine = (rows == example.rows[place]) & seen
        unit = torch.nn.functional.normalize(features[mine], dim=1).sum(dim=0)
        torch.testing.assert_close(example.targets[place], unit / unit.norm())
    assert set(example.rows.tolist()) == set(rows[seen].tolist())
    assert torch.equal(example.weights, torch.ones(len(example.rows)))


def test_a_scene_of_which_three_gaussians_were_seen(stage):
    """There are more voxels than Gaussians that say what they should be."""
    g = stage.gaussians
    seen = torch.zeros(len(g))
    seen[-3:] = 1.0
    features = torch.eye(3)[torch.arange(len(g)) % 3] * seen[:, None]
    example = make_example(g, Semantics(features, seen, seen, "toy", g.fingerprint), "full", 0.05)
    rows = voxelize(g, "full", 0.05).rows
    assert set(example.rows.tolist()) == set(rows[-3:].tolist())
    assert len(example.voxels.features) > 3


def test_augmentation_needs_no_generator(stage):
    g, one = stage.gaussians, torch.ones(len(stage.gaussians))
    semantics = Semantics(torch.ones(len(g), 2), one, one, "toy", g.fingerprint)
    plain, changed = (make_example(g, semantics, "full", 0.2, augment=a) for a in (None, Augmentation()))
    assert not torch.equal(plain.of_gaussians, changed.of_gaussians)


def test_reliability_grows_with_weight_and_views(stage):
    weight = torch.tensor([0.0, 1.0, 1.0, 4.0, 4.0])
    views = torch.tensor([0.0, 1.0, 4.0, 1.0, 9.0])
    r = reliability(Semantics(torch.ones(5, 2), weight, views, "toy", "0" * 16))
    assert r[0] == 0
    assert bool((r[1:] > 0).all())
    assert bool((r <= 1).all())
    assert r[1] < r[2] < r[4]
    assert r[1] < r[3] < r[4]


def test_unreliable_targets_count_less(stage):
    """A third of the scene is mislabelled, and says so by its weight: by reliability the targets are true."""
    g = stage.gaussians
    wrong = torch.arange(len(g)) % 3 == 0
    truth = lifted(g, stage.classes)
    shares = torch.where(wrong[:, None], torch.eye(4)[(stage.classes + 1) % 4], truth.features)
    weight = torch.where(wrong, 0.02, 1.0)
    noisy = replace(truth, features=shares, weight=weight, effective_views=torch.where(wrong, 1.0, 5.0))
    clean = make_example(g, truth, "full", 0.12).targets

    def agreement(by_reliability: bool) -> float:
        """Cosine with the true targets, weighted as in the loss."""
        example = make_example(g, noisy, "full", 0.12, by_reliability=by_reliability)
        return float(((example.targets * clean).sum(dim=1) * example.weights).sum() / example.weights.sum())

    assert agreement(True) > 0.99
    assert agreement(False) < 0.9


@pytest.mark.parametrize("by_reliability", [False, True])
def test_the_loss_weighs_voxels_by_their_reliability(stage, by_reliability):
    """The mean of 1 - cosine, in float64 from what the network says and what the example holds."""
    g = stage.gaussians
    random = torch.Generator().manual_seed(3)
    weight = 10 ** (3 * torch.rand(len(g), generator=random) - 2)
    semantics = replace(lifted(g, stage.classes), weight=weight, effective_views=torch.full((len(g),), 2.0))
    settings = replace(SETTINGS, augment=None, by_reliability=by_reliability)
    kind = "labels", 4, ("1", "2", "3", "4")
    run = trainer._Run(settings, kind, None, trainer.Processes(), torch.device("cpu"), RunLog())
    example = run._example(in_memory("stage", g, semantics), torch.Generator())
    assert (example.weights.std() > 0.05) == by_reliability
    said = torch.randn(len(example.voxels.features), 4, generator=random)
    run.network = SimpleNamespace(net=lambda voxels: SimpleNamespace(features=said))
    ours = torch.nn.functional.normalize(said[example.rows].double(), dim=1)
    cosine = (ours * example.targets.double()).sum(dim=1)
    expected = ((1 - cosine) * example.weights.double()).sum() / example.weights.double().sum()
    assert float(run._loss(example)) == pytest.approx(float(expected), abs=1e-6)
    assert by_reliability == (abs(float(expected) - float((1 - cosine).mean())) > 1e-4)


def test_rates_and_decay_reach_the_optimizer(scenes, monkeypatch):
    taken = []
    step = torch.optim.AdamW.step

    def watched(optimizer, *arguments):
        taken.extend((group["lr"], group["weight_decay"]) for group in optimizer.param_groups)
        return step(optimizer, *arguments)

    monkeypatch.setattr(torch.optim.AdamW, "step", watched)
    settings = replace(SETTINGS, epochs=4, learning_rate=0.01, weight_decay=0.03)
    distill(scenes[:1], settings)
    cosine = [0.01 * (1 + math.cos(math.pi * epoch / 4)) / 2 for epoch in range(4)]
    assert [rate for rate, _ in taken] == pytest.approx(cosine)
    assert {decay for _, decay in taken} == {0.03}


@pytest.mark.parametrize("field", ["space", "features", "labels"])
def test_scenes_of_another_kind_are_refused(field, scenes, stage):
    g, semantics = scenes[1].load()
    changes = {
        "space": {"space": "else"},
        "features": {"features": semantics.features[:, :3], "labels": ("1", "2", "3")},
        "labels": {"labels": ("a", "b", "c", "d")},
    }
    other = in_memory("odd one", g, replace(semantics, **changes[field]))
    with pytest.raises(InputError, match="odd one: semantics have"):
        distill([scenes[0], other], replace(SETTINGS, epochs=1))


@pytest.mark.parametrize("bad", [{"epochs": 0}, {"voxel": -1.0}, {"learning_rate": math.nan}, {"scenes_per_step": 0}])
def test_settings_that_cannot_be_are_refused(bad):
    with pytest.raises(InputError, match=next(iter(bad))):
        replace(SETTINGS, **bad)


def test_no_scenes_no_training():
    with pytest.raises(InputError, match="no scenes"):
        distill([], SETTINGS)


def test_training_in_bfloat16_stays_near_float32(scenes):
    exact, rounded = (distill(scenes, replace(SETTINGS, epochs=1, half=half))[1][0].loss for half in (False, True))
    assert exact != rounded
    assert rounded == pytest.approx(exact, rel=0.05)


@pytest.fixture
def folder(scenes, tmp_path):
    """Two training scenes and a validation scene on disk."""
    for name, scene in zip(("a", "b", "c"), scenes, strict=True):
        gaussians, semantics = scene.load()
        place = tmp_path / ("validation" if name == "c" else "training")
        place.mkdir(exist_ok=True)
        save_gaussians(gaussians, place / f"{name}.ply")
        stored = load_gaussians(place / f"{name}.ply")
        save_semantics(replace(semantics, fingerprint=stored.fingerprint), place / f"{name}.safetensors")
    return tmp_path


OPTIONS = ["--arch", "14A", "--voxel", "0.12", "--epochs", "2", "--scenes-per-step", "2", "--up", "y"]


def test_distill_writes_a_network_and_its_curves(folder, capsys):
    out = folder / "out" / "net.safetensors"
    arguments = [folder / "training", "--validation", folder / "validation", "--out", out, *OPTIONS]
    assert main(["distill", *map(str, arguments)]) == 0
    network = load_network(out)
    assert (network.inputs, network.voxel, network.labels) == ("full", 0.12, ("1", "2", "3", "4"))
    curves = json.loads((out.parent / "net_curves.json").read_text())
    assert [set(row) >= {"loss", "cosine", "miou"} for row in curves] == [True, True]
    assert (out.parent / "net_curves.png").read_bytes()[:4] == b"\x89PNG"
    assert not state_path(out).exists()  # done
    log = json.loads((out.parent / "run.json").read_text())
    assert log["error"] == {name: curves[-1][name] for name in ("loss", "cosine", "miou")}
    assert {"prepare", "train", "validate", "write"} <= set(log["stages"])
    assert main(["distill", *map(str, arguments)]) == 0  # begins anew
    assert "epochs_done_before" not in json.loads((out.parent / "run.json").read_text())["left_out"]


def test_distill_starts_from_a_checkpoint(folder, tmp_path):
    torch.manual_seed(5)
    state = MinkUNet(10, 4, "14A").state_dict()
    torch.save({"state_dict": {"module." + k: v for k, v in state.items()}}, tmp_path / "start.pth")
    out = tmp_path / "net.safetensors"
    arguments = [folder / "training", "--out", out, *OPTIONS, "--learning-rate", "1e-30"]
    assert main(["distill", *map(str, arguments), "--checkpoint", str(tmp_path / "start.pth")]) == 0
    assert torch.equal(load_network(out).net.final.kernel, state["final.kernel"])


def test_distill_names_what_is_missing(folder, capsys, tmp_path):
    def fails(*arguments) -> str:
        assert main(["distill", *map(str, arguments), "--out", str(tmp_path / "n.safetensors")]) == 2
        return capsys.readouterr().err

    (folder / "training" / "a.safetensors").unlink()
    assert "has no a.safetensors beside it" in fails(folder / "training")
    (tmp_path / "empty").mkdir()
    assert "holds no scene" in fails(tmp_path / "empty")
    assert "no such file" in fails(tmp_path / "none.ply")
    assert "no scenes to learn from" in fails()
    assert "name scenes with --validation" in fails(folder / "validation", "--classes", "x,y")


def test_lifted_semantics_are_not_written_over(folder, capsys):
    lifted_file = folder / "training" / "b.safetensors"
    before = lifted_file.read_bytes()
    assert main(["distill", str(folder / "training"), "--out", str(lifted_file), *OPTIONS]) == 2
    assert "holds semantics that were lifted" in capsys.readouterr().err
    assert lifted_file.read_bytes() == before


def test_names_with_dots_keep_them(stage, tmp_path):
    for name in ("a.v1.ply", "b.compressed.ply"):
        save_gaussians(stage.gaussians, tmp_path / name)
        g = load_gaussians(tmp_path / name)
        beside = name.removesuffix(".ply").removesuffix(".compressed") + ".safetensors"
        save_semantics(lifted(g, stage.classes), tmp_path / beside)
    assert [scene.name.rpartition("/")[2] for scene in scenes_in([tmp_path])] == ["a.v1.ply", "b.compressed.ply"]


def test_two_processes_train_as_one_does(folder):
    """Two gloo processes with a scene each against one process with both: losses and weights agree.

    The sums of a gradient are taken in another order, which AdamW's first steps, of the size of the learning rate
    whatever the gradient, enlarge where a gradient is almost zero.
    """
    alone, shared = folder / "one" / "net.safetensors", folder / "two" / "net.safetensors"
    arguments = [str(folder / "training"), "--validation", str(folder / "validation"), *OPTIONS, "--threads", "1"]
    assert main(["distill", *arguments, "--out", str(alone)]) == 0
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    script = folder / "run.py"
    script.write_text("import sys\nfrom sgwarp.cli import main\nsys.exit(main())\n")
    done = subprocess.run(
        [*command, str(script), "distill", *arguments, "--out", str(shared)],
        capture_output=True,
        text=True,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
    )
    assert done.returncode == 0, done.stderr[-2000:]
    one, two = (json.loads((out.parent / "net_curves.json").read_text()) for out in (alone, shared))
    assert [row["loss"] for row in two] == pytest.approx([row["loss"] for row in one], rel=1e-4)
    assert [row["cosine"] for row in two] == pytest.approx([row["cosine"] for row in one], abs=1e-3)
    first, second = load_network(alone).net, load_network(shared).net
    for (name, mine), other in zip(first.named_parameters(), second.parameters(), strict=True):
        assert float((mine - other).detach().abs().mean()) < 1e-4, name
    assert sorted(path.name for path in shared.parent.iterdir()) == sorted(path.name for path in alone.parent.iterdir())


def test_processes_that_cannot_share_a_step_are_refused(scenes):
    with pytest.raises(InputError, match="take a multiple of 2"):
        distill(scenes, SETTINGS, processes=Processes(0, 2))
