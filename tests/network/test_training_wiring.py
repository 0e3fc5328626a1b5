"""What a training is told reaches the place where it acts: order, random numbers, augmentation, modes, masks."""

from dataclasses import replace

import pytest
import torch

from sgwarp.network.augmentation import Augmentation
from sgwarp.network.prediction import predict
from sgwarp.network.training import trainer
from sgwarp.network.training.data import TrainingScene, reliability
from sgwarp.network.training.settings import DistillSettings
from sgwarp.network.training.trainer import distill
from sgwarp.scene import Semantics

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("tiny_architecture")]
TURNED = Augmentation(up=1, elastic=())


@pytest.fixture
def scenes(stage) -> list[TrainingScene]:
    """Four parts of the stage, in memory."""

    def part(k: int) -> TrainingScene:
        rows = torch.arange(k, len(stage.gaussians), 4)
        gaussians = stage.gaussians.subset(rows)
        shares, one = torch.eye(4)[stage.classes[rows] - 1], torch.ones(len(rows))
        labels = ("1", "2", "3", "4")
        semantics = Semantics(shares, one, 2.0 * one, "labels", gaussians.fingerprint, labels)
        return TrainingScene(f"part {k}", lambda: (gaussians, semantics))

    return [part(k) for k in range(4)]


@pytest.fixture
def made(monkeypatch):
    """Gaussians, first random number and augmentation of every example that is made."""
    calls = []
    original = trainer.make_example

    def noted(gaussians, semantics, *arguments, generator, augment, **options):
        state = generator.get_state()
        calls.append((gaussians.fingerprint, torch.rand(1, generator=generator).item(), augment))
        generator.set_state(state)
        return original(gaussians, semantics, *arguments, generator=generator, augment=augment, **options)

    monkeypatch.setattr(trainer, "make_example", noted)
    return calls


SETTINGS = DistillSettings(arch="tiny", voxel=0.2, epochs=3, augment=TURNED, scenes_per_step=2)


def test_order_and_random_numbers_of_the_epochs(scenes, made):
    distill(scenes, SETTINGS)
    epochs = [made[4 * k : 4 * k + 4] for k in range(3)]
    orders = [[name for name, _, _ in epoch] for epoch in epochs]
    assert all(len(set(order)) == 4 for order in orders)
    assert len({tuple(order) for order in orders}) > 1  # another order in another epoch
    assert len({number for _, number, _ in made}) == 12  # no two examples are changed alike
    assert {augment for _, _, augment in made} == {TURNED}


def test_it_trains_in_the_mode_of_training_after_a_validation(scenes, monkeypatch):
    modes = []
    step = trainer._Run._step

    def watched(run, *arguments):
        modes.append(run.network.net.training)
        return step(run, *arguments)

    monkeypatch.setattr(trainer._Run, "_step", watched)
    original = trainer._Run.validate

    def validated(run, chosen):
        figures = original(run, chosen)
        modes.append(run.network.net.training)
        return figures

    monkeypatch.setattr(trainer._Run, "validate", validated)
    distill(scenes[:2], replace(SETTINGS, epochs=2, validate_every=1), validation=scenes[2:3])
    assert modes == [True] * 4


def test_gaussians_that_no_view_has_seen_are_not_validated_on(scenes):
    """Their targets are wrong on purpose; the figures are those of the others alone."""
    gaussians, semantics = scenes[3].load()
    unseen = torch.arange(len(gaussians)) % 2 == 0
    wrong = torch.where(unseen[:, None], semantics.features.roll(1, dims=1), semantics.features)
    weight = torch.where(unseen, 0.0, 1.0)
    partly = replace(semantics, features=wrong, weight=weight, effective_views=2.0 * weight)
    network, history = distill(
        scenes[:2], replace(SETTINGS, epochs=1), validation=[TrainingScene("partly", lambda: (gaussians, partly))]
    )
    prediction = predict(gaussians, network)
    seen = (~unseen & prediction.known).nonzero()[:, 0]
    ours = prediction.hidden[prediction.rows[seen]] @ prediction.matrix
    cosine = torch.nn.functional.cosine_similarity(ours.double(), semantics.features[seen].double(), dim=1).mean()
    assert history[-1].cosine == pytest.approx(cosine.item(), abs=1e-5)


def test_gradients_and_statistics_are_means_over_the_scenes_of_a_step(scenes, monkeypatch):
    """A step of one scene twice is a step of that scene once."""
    monkeypatch.setattr(trainer, "_generator", lambda *numbers: torch.Generator().manual_seed(0))
    settings = replace(SETTINGS, epochs=1, augment=None)
    once, twice = (
        distill([scenes[0]] * count, replace(settings, scenes_per_step=count))[0].net.state_dict() for count in (1, 2)
    )
    for name, value in once.items():
        if not value.is_floating_point():
            continue  # how many batches there were
        torch.testing.assert_close(twice[name].float(), value.float(), rtol=1e-4, atol=2e-5, msg=name)
    # Running means of the batch normalizations: with weights that stay as they are, that of two scenes is in between.
    still = replace(settings, learning_rate=1e-12)
    first, second = (distill([scene], still)[0].net.state_dict() for scene in scenes[:2])
    both = distill(scenes[:2], replace(still, scenes_per_step=2))[0].net.state_dict()
    means = [name for name in both if name.endswith("running_mean")]
    for name in means:
        torch.testing.assert_close(both[name], (first[name] + second[name]) / 2, rtol=1e-4, atol=1e-6, msg=name)
    assert any(not torch.allclose(first[name], second[name], rtol=1e-2) for name in means)


def test_reliability_by_its_formula():
    weight, views = torch.tensor([0.0, 1.0, 2.0, 8.0]), torch.tensor([0.0, 1.0, 3.0, 9.0])
    found = reliability(Semantics(torch.ones(4, 2), weight, views, "toy", "0" * 16))
    median = 2.0  # of the three that were seen
    expected = [0.0] + [w / (w + median) * v / (v + 1) for w, v in ((1, 1), (2, 3), (8, 9))]
    assert found.tolist() == pytest.approx(expected)


def test_augmentation_scales_within_its_range(stage):
    """Only the factor is left: sizes and distances change alike, by another factor in another epoch."""
    change = Augmentation(up=1, tilt=0.0, turn=0.0, scale=(0.5, 0.8), mirror=False, elastic=(), shift=0.0)
    factors = []
    for seed in range(20):
        changed = change(stage.gaussians, 0.1, torch.Generator().manual_seed(seed))
        ratio = changed.scales / stage.gaussians.scales
        factors.append(ratio.mean().item())
        torch.testing.assert_close(changed.means, stage.gaussians.means * factors[-1], rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(ratio, torch.full_like(ratio, factors[-1]), rtol=1e-5, atol=0)
    assert 0.5 <= min(factors) < 0.58
    assert 0.72 < max(factors) <= 0.8
