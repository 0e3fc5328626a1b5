"""A training run without its steps: schedules, figures and progress; its processes; and when a network is needed."""

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from sgwarp.errors import InputError
from sgwarp.network.layers.sparse import pool
from sgwarp.network.prediction import Prediction
from sgwarp.network.quality import ProjectionQuality, filled, projection_quality
from sgwarp.network.training import processes as sharing
from sgwarp.network.training import trainer
from sgwarp.network.training.batches import batch_results, is_batch
from sgwarp.network.training.data import TrainingScene
from sgwarp.network.training.processes import Processes, joined
from sgwarp.network.training.settings import DistillSettings
from sgwarp.network.training.trainer import _identity, _Run, distill
from sgwarp.ops.sparse.voxels import pack_voxels
from sgwarp.runs.log import RunLog
from sgwarp.scene import Semantics

SETTINGS = DistillSettings(arch="tiny", inputs="ones", voxel=0.2, epochs=3, scenes_per_step=2, learning_rate=0.1)
pytestmark = pytest.mark.usefixtures("tiny_architecture")


@pytest.fixture
def scenes(stage) -> list[TrainingScene]:
    n = len(stage.gaussians)
    semantics = Semantics(
        torch.eye(4)[stage.classes - 1], torch.ones(n), torch.ones(n), "t", stage.gaussians.fingerprint
    )
    return [TrainingScene(f"{k}", lambda: (stage.gaussians, semantics), stamp=f"s{k}") for k in range(5)]


@pytest.fixture
def steps(monkeypatch):
    """`steps(losses)`: every step gives the next of these pairs; what it was asked for."""

    def make(losses):
        asked, left = [], list(losses)

        def step(self, epoch, chosen, scenes):
            asked.append((epoch, tuple(chosen), self.optimizer.param_groups[0]["lr"], self.network.net.training))
            return left.pop(0)

        monkeypatch.setattr(_Run, "_step", step)
        monkeypatch.setattr(_Run, "validate", lambda self, scenes: {"cosine": 0.5, "miou": None})
        return asked

    return make


@pytest.mark.slow
def test_epochs_take_every_scene_once_and_tell_how_far_they_are(scenes, steps):
    asked, told, log = steps([(2.0, 2.0), (1.0, 1.0), (0.5, 1.0)] * 3), [], RunLog()
    _, history = distill(scenes, SETTINGS, progress=lambda *given: told.append(given), log=log)
    assert [(done, total) for done, total, _ in told] == [(k, 15) for k in (2, 4, 5, 7, 9, 10, 12, 14, 15)]
    assert [text for *_, text in told[:4]] == [
        *["epoch 1, loss 1.0000", "epoch 1, loss 1.0000"],
        *["epoch 1, loss 0.8750", "epoch 2, loss 1.0000"],
    ]
    for epoch in range(3):
        part = asked[3 * epoch : 3 * epoch + 3]
        assert sorted(k for _, chosen, *_ in part for k in chosen) == [0, 1, 2, 3, 4]
        assert [len(chosen) for _, chosen, *_ in part] == [2, 2, 1]
        rate = 0.05 + 0.05 * math.cos(math.pi * epoch / 3)
        assert [(at, lr, training) for at, _, lr, training in part] == [(epoch, pytest.approx(rate), True)] * 3
        figures = history[epoch]
        assert (figures.epoch, figures.loss, figures.cosine) == (epoch + 1, pytest.approx(3.5 / 4), None)
        assert figures.learning_rate == pytest.approx(rate)
        assert 0 <= figures.seconds < 60
    assert log.left_out == {"scenes_without_target": 1}
    assert log.error == {"loss": pytest.approx(3.5 / 4)}


@pytest.mark.slow
def test_scenes_without_a_target_are_said(scenes, steps):
    told = []
    steps([(0.0, 0.0), (0.5, 1.0), (0.0, 0.0)])
    log = RunLog()
    distill(scenes, replace(SETTINGS, epochs=1), progress=lambda *given: told.append(given[2]), log=log)
    assert told == ["epoch 1, no target yet", "epoch 1, loss 0.5000", "epoch 1, loss 0.5000"]
    assert log.left_out == {"scenes_without_target": 4}
    steps([(0.0, 0.0)] * 3)
    with pytest.raises(InputError, match=r"0: no Gaussian of this scene, or of any other, has a voxel of 0\.2 m"):
        distill(scenes, replace(SETTINGS, epochs=1))


@pytest.mark.parametrize(("every", "measured"), [(1, [1, 2, 3, 4, 5]), (2, [2, 4, 5]), (3, [3, 5]), (5, [5]), (9, [5])])
def test_validation_has_its_turns_and_the_last_epoch(scenes, steps, every, measured):
    steps([(1.0, 1.0)] * 25)
    settings = replace(SETTINGS, epochs=5, validate_every=every)
    log = RunLog()
    history = distill(scenes[:1], settings, validation=scenes[1:], log=log)[1]
    assert [epoch.epoch for epoch in history if epoch.cosine is not None] == measured
    assert log.error == {"loss": 1.0, "cosine": 0.5}
    assert "validate" in log.stages
    assert log.left_out == {}


def test_a_run_belongs_to_its_scenes_in_their_roles(scenes):
    plain = _identity(scenes[:2], scenes[2:3])
    assert plain == _identity(list(scenes[:2]), list(scenes[2:3]))
    others = [
        _identity(scenes[:3], []),
        _identity(scenes[1::-1], scenes[2:3]),
        _identity([replace(scenes[0], stamp="other"), scenes[1]], scenes[2:3]),
        _identity([replace(scenes[0], name="other"), scenes[1]], scenes[2:3]),
    ]
    assert len({plain, *others}) == 5
    assert len(plain) == 16


@pytest.mark.parametrize(("device", "fused"), [("cpu", None), ("cuda", True), ("cuda:1", True)])
def test_the_optimizer_takes_its_step_in_one_launch_on_cuda(device, fused):
    assert _Run._fused.fget(SimpleNamespace(device=torch.device(device))) is fused


@pytest.mark.slow
def test_validation_counts_gaussians_of_all_scenes_alike(scenes, stage, monkeypatch):
    """Seen, with a voxel, and with finite features; by class vectors where there are no labels."""
    n = len(stage.gaussians)
    g = torch.Generator().manual_seed(1)
    hidden, matrix, vectors = (
        torch.randn(n, 3, generator=g),
        torch.randn(3, 4, generator=g),
        torch.randn(5, 4, generator=g),
    )
    rows = torch.where(torch.rand(n, generator=g) < 0.2, -1, torch.arange(n))
    prediction = Prediction(hidden, rows, matrix, "t", stage.gaussians.fingerprint)
    monkeypatch.setattr(trainer, "predict", lambda gaussians, network: prediction)
    parts, cosines, pairs = [], [], []
    for k, share in enumerate((0.9, 0.1)):
        weight = (torch.rand(n, generator=g) < share).float()
        features = torch.randn(n, 4, generator=g)
        semantics = Semantics(features, weight, weight, "t", stage.gaussians.fingerprint)
        features[k, 0] = math.nan  # after the check of Semantics, as from a file
        parts.append(TrainingScene(f"{k}", lambda semantics=semantics: (stage.gaussians, semantics)))
        counted = (weight > 0) & (rows >= 0) & torch.isfinite(features).all(dim=1)
        ours, theirs = (hidden @ matrix)[counted].double(), features[counted].double()
        cosines.append((ours * theirs).sum(1) / ours.norm(dim=1) / theirs.norm(dim=1))
        pairs.append(torch.stack([(one @ vectors.double().T).argmax(1) for one in (ours, theirs)]))
    run = _Run(SETTINGS, ("t", 4, None), vectors, Processes(), torch.device("cpu"), RunLog())
    figures = run.validate(parts)
    assert figures["cosine"] == pytest.approx(float(torch.cat(cosines).mean()), abs=1e-5)
    ours, theirs = torch.cat(pairs, dim=1)
    ious = []
    for c in range(5):
        both, either = ((ours == c) & (theirs == c)).sum(), ((ours == c) | (theirs == c)).sum()
        if (theirs == c).any():
            ious.append(float(both / either))
    assert figures["miou"] == pytest.approx(sum(ious) / len(ious), abs=1e-5)
    assert run.network.net.training
    assert run.validate([]) == {"cosine": None, "miou": None}
    run.class_vectors = None
    assert set(run.validate(parts[:1])) == {"cosine"}


# Processes


def test_sums_over_processes_keep_their_shapes(monkeypatch):
    sent = []

    def all_reduce(flat):
        sent.append(flat.clone())
        flat += 10.0

    monkeypatch.setattr(sharing.dist, "all_reduce", all_reduce)
    tensors = [torch.tensor([[1.0, 2.0], [3.0, 4.0]]), torch.tensor(5.0), torch.zeros(0), torch.tensor([6.0])]
    Processes(0, 1).add_up(tensors)
    assert sent == []
    Processes(1, 2).add_up(iter(tensors))
    assert [flat.tolist() for flat in sent] == [[1, 2, 3, 4, 5, 6]]
    assert tensors[0].tolist() == [[11, 12], [13, 14]]
    assert (float(tensors[1]), tensors[3].tolist()) == (15.0, [16.0])
    assert [Processes(k, 2).leads for k in range(2)] == [True, False]


@pytest.mark.parametrize(("device", "backend"), [("cpu", "gloo"), ("cuda", "nccl")])
@pytest.mark.parametrize("fails", [False, True])
def test_processes_of_torchrun_meet_and_part(monkeypatch, device, backend, fails):
    calls = []
    for name, value in {"WORLD_SIZE": "3", "LOCAL_RANK": "2"}.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr("torch.cuda.set_device", lambda number: calls.append(("device", number)))
    monkeypatch.setattr(sharing.dist, "init_process_group", lambda name: calls.append(("meet", name)))
    monkeypatch.setattr(sharing.dist, "destroy_process_group", lambda: calls.append("part"))
    monkeypatch.setattr(sharing.dist, "get_rank", lambda: 1)
    monkeypatch.setattr(sharing.dist, "get_world_size", lambda: 3)
    expected = [*([("device", 2)] if device == "cuda" else []), ("meet", backend)]
    try:
        with joined(device) as found:
            assert (found.rank, found.count) == (1, 3)
            assert calls == expected
            if fails:
                raise RuntimeError
    except RuntimeError:
        assert fails
    assert calls == [*expected, "part"]
    with pytest.raises(InputError, match="device cuda:1: several processes take one device each"), joined("cuda:1"):
        pass
    monkeypatch.setenv("WORLD_SIZE", "1")
    with joined("cuda:1") as alone:
        assert (alone.rank, alone.count) == (0, 1)


# Results of a batch


def test_folders_that_a_batch_left(tmp_path):
    assert not is_batch(tmp_path)
    for name in ("a", "b", ".c"):
        (tmp_path / name).mkdir()
    assert not is_batch(tmp_path)
    (tmp_path / ".c" / "done.json").write_text("{}")
    assert not is_batch(tmp_path), "what is hidden is not finished"
    (tmp_path / "a" / "failed.json").write_text("{}")
    assert is_batch(tmp_path)
    assert is_batch(tmp_path / "a")
    assert batch_results(tmp_path) == []
    (tmp_path / "b" / "done.json").write_text('{"options": {"fit": ["x"]}}')
    with pytest.raises(InputError, match=r"b/done\.json: the batch did not lift this scene"):
        batch_results(tmp_path)
    (tmp_path / "b" / "done.json").write_text('{"options": {"lift": ["s.ply", "--views"]}}')
    with pytest.raises(InputError, match="did not lift this scene"):
        batch_results(tmp_path)


# Whether a network is needed


@pytest.mark.parametrize(
    ("coverage", "reliability", "enough"),
    [(0.98, 0.8, True), (0.97, 1.0, False), (1.0, 0.79, False), (0.99, 0.9, True), (0.0, 0.0, False)],
)
def test_a_projection_suffices_where_nearly_all_was_seen_by_several_views(coverage, reliability, enough):
    assert ProjectionQuality(coverage, reliability).suffices() is enough
    assert ProjectionQuality(0.5, 0.5).suffices(0.5, 0.5)


def test_reliable_is_what_rests_on_more_than_one_view():
    views = torch.tensor([0.0, 1.0, 1.49, 1.5, 4.0])
    weight = torch.tensor([0.0, 1.0, 1.0, 1.0, 1.0])
    found = projection_quality(Semantics(torch.ones(5, 2), weight, views, "t", "0" * 16))
    assert found == pytest.approx((0.8, 0.5))
    nothing = Semantics(torch.zeros(5, 2), torch.zeros(5), torch.zeros(5), "t", "0" * 16)
    assert projection_quality(nothing) == (0.0, 0.0)


def test_predictions_fill_what_no_view_saw_with_the_usual_weight():
    weight = torch.tensor([0.0, 1.0, 3.0, 8.0, 0.0])
    projected = Semantics(torch.ones(5, 2) * (weight > 0)[:, None], weight, weight, "t", "0" * 16)
    known = torch.tensor([1.0, 1.0, 0.0, 1.0, 0.0])
    predicted = Semantics(torch.full((5, 2), 7.0) * known[:, None], known, torch.zeros(5), "t", "0" * 16)
    found = filled(projected, predicted)
    assert found.features[:, 0].tolist() == [7.0, 1.0, 1.0, 1.0, 0.0]
    assert found.weight.tolist() == [3.0, 1.0, 3.0, 8.0, 0.0]
    empty = Semantics(torch.zeros(5, 2), torch.zeros(5), torch.zeros(5), "t", "0" * 16)
    assert filled(empty, predicted).weight.tolist() == known.tolist()


# What a run is known by


def test_random_numbers_depend_on_every_number_and_its_place():
    numbers = [(), (0,), (0, 0), (1,), (0, 1), (1, 0), (0, 0, 1), (2**40, 3), (3, 2**40)]
    first = [torch.rand((), generator=trainer._generator(*given), dtype=torch.float64).item() for given in numbers]
    assert len(set(first)) == len(numbers)
    again = [torch.rand((), generator=trainer._generator(*given), dtype=torch.float64).item() for given in numbers]
    assert first == again


@pytest.mark.parametrize("name", ["net", "net.v2"])
def test_the_state_lies_beside_its_network(tmp_path, name):
    out = tmp_path / f"{name}.safetensors"
    assert trainer.state_path(out) == trainer.state_path(str(out)) == tmp_path / f"{name}.state.pt"


@pytest.mark.slow
def test_a_state_goes_on_with_the_same_run_alone(tmp_path):
    def run(settings=SETTINGS, kind=("t", 4, None), data="scenes") -> _Run:
        made = _Run(settings, kind, None, Processes(), torch.device("cpu"), RunLog())
        made.data = data
        return made

    path, first = tmp_path / "net.state.pt", run()
    first.history = [trainer.Epoch(1, 0.1, 0.5, 2.0)]
    first.save(path)
    second = run()
    with torch.no_grad():
        second.network.net.final.kernel.zero_()
    second.restore(path)
    assert second.history == first.history
    assert torch.equal(second.network.net.final.kernel, first.network.net.final.kernel)
    assert second.log.left_out == {"epochs_done_before": 1}
    others = {
        "epochs": run(replace(SETTINGS, epochs=4)),
        "seed": run(replace(SETTINGS, seed=1)),
        "augment": run(replace(SETTINGS, augment=None)),
        "space": run(kind=("other", 4, None)),
        "labels": run(kind=("t", 4, ("a", "b", "c", "d"))),
        "scenes": run(data="others"),
    }
    for name, other in others.items():
        with pytest.raises(InputError, match=rf"net\.state\.pt: is of a run with another {name} \("):
            other.restore(path)


@pytest.mark.slow
def test_batches_are_counted_in_training_alone():
    run = _Run(SETTINGS, ("t", 4, None), None, Processes(), torch.device("cpu"), RunLog())
    net = run.network.net
    counts = [module.num_batches_tracked for module in net.modules() if isinstance(module, torch.nn.BatchNorm1d)]
    places = torch.randint(0, 9, (40, 4), generator=torch.Generator().manual_seed(0)) * torch.tensor([0, 1, 1, 1])
    voxels = pool(pack_voxels(places), torch.ones(40, 3))[0]
    for training, expected in ((True, 1), (True, 2), (False, 2)):
        net.train(training)
        net(voxels)
        assert {int(count) for count in counts} == {expected}
