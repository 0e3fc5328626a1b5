"""The contrastive loss: rows against the dense renderer, the loss against numpy, and that a network learns by it."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from sgwarp.cli import main
from sgwarp.errors import InputError
from sgwarp.io.scenes import load_gaussians, save_gaussians
from sgwarp.io.store import save_semantics
from sgwarp.network.augmentation import Augmentation
from sgwarp.network.prediction import predict
from sgwarp.network.training.contrastive import MaskedView, MaskRows, contrastive_loss, mask_rows
from sgwarp.network.training.data import TrainingScene
from sgwarp.network.training.settings import DistillSettings
from sgwarp.network.training.trainer import distill
from sgwarp.ops.splatting.forward import rasterize
from sgwarp.scene import FeatureMap, Semantics

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("tiny_architecture")]


def test_rows_are_means_of_the_rendering_over_the_masks(stage):
    """Two levels of masks, Gaussians that share voxels, some without one."""
    g = torch.Generator().manual_seed(0)
    view = stage.views[0]
    ids = torch.stack([stage.labels(view) - 1, torch.randint(-1, 3, view.camera.size, generator=g) + 4])
    ids[1][ids[1] == 3] = -1
    masks = MaskedView(view.camera, FeatureMap("t", ids=ids, vectors=torch.randn(7, 5, generator=g)))
    voxels = torch.arange(len(stage.gaussians)) // 3
    voxels[::7] = -1
    found = mask_rows(stage.gaussians, voxels, masks, 64)
    features = torch.randn(int(voxels.max()) + 1, 5, generator=g)
    pooled = torch.zeros(len(found.vectors), 5).index_add_(0, found.mask, found.weight[:, None] * features[found.voxel])
    own = torch.where((voxels >= 0)[:, None], features[voxels.clamp(min=0)], 0.0)
    own = torch.cat([own, (voxels >= 0).float()[:, None]], dim=1)
    image = rasterize(stage.gaussians, view.camera, own).features
    expected = []
    for level in ids:
        for mask in level[level >= 0].unique().tolist():
            mean = image[level == mask].mean(dim=0)
            if mean[-1] >= 0.5:
                expected.append((mask, mean[:-1]))
    expected.sort(key=lambda pair: pair[0])
    assert len(expected) == len(found.vectors) >= 4
    torch.testing.assert_close(pooled, torch.stack([mean for _, mean in expected]), atol=1e-4, rtol=1e-3)
    unit = torch.nn.functional.normalize(masks.masks.vectors, dim=1)[[mask for mask, _ in expected]]
    torch.testing.assert_close(found.vectors, unit)


def test_the_loss_against_numpy():
    g = torch.Generator().manual_seed(1)
    vectors = torch.nn.functional.normalize(torch.randn(4, 3, generator=g), dim=1)
    vectors[2] = vectors[0]  # two masks that mean the same
    rows = MaskRows(torch.tensor([0, 0, 1, 2, 3]), torch.tensor([0, 1, 2, 3, 0]), torch.rand(5, generator=g), vectors)
    predicted = torch.randn(4, 3, generator=g)
    B = np.zeros((4, 4))
    np.add.at(B, (rows.mask.numpy(), rows.voxel.numpy()), rows.weight.numpy())
    z = B @ predicted.numpy()
    logits = z / np.linalg.norm(z, axis=1, keepdims=True) @ vectors.numpy().T / 0.2
    shares = np.exp(logits) / np.exp(logits).sum(axis=1, keepdims=True)
    own = [shares[0, [0, 2]].sum(), shares[1, 1], shares[2, [0, 2]].sum(), shares[3, 3]]
    assert float(contrastive_loss(predicted, rows, 0.2)) == pytest.approx(-np.log(own).mean(), rel=1e-4)


SETTINGS = DistillSettings(
    arch="tiny",
    voxel=0.2,
    epochs=40,
    learning_rate=0.01,
    augment=Augmentation(up=1, elastic=()),
    loss="contrastive",
    contributors=4,
)


def test_a_network_learns_from_masks_alone(stage):
    """The lifted features, which the other loss would read, say nothing: all of them are label 1."""
    seen = torch.ones(len(stage.gaussians))
    shares = torch.eye(4)[torch.zeros(len(seen), dtype=torch.int64)]
    semantics = Semantics(shares, seen, seen, "labels", stage.gaussians.fingerprint, ("1", "2", "3", "4"))
    masks = [lambda view=view: MaskedView(view.camera, stage.one_hot(view)) for view in stage.views]
    scene = TrainingScene("stage", lambda: (stage.gaussians, semantics), masks=lambda: masks)
    network, history = distill([scene], replace(SETTINGS, augment=None))
    assert history[-1].loss < 0.1 * history[0].loss
    found = predict(stage.gaussians, network).semantics().features.argmax(dim=1)
    front = stage.classes > 1  # what no other panel hides
    assert (found == stage.classes - 1)[front].float().mean() > 0.9
    again = distill([scene], replace(SETTINGS, epochs=1))[1]
    assert again[0].loss == distill([scene], replace(SETTINGS, epochs=1))[1][0].loss


def test_masks_are_needed(stage):
    seen = torch.ones(len(stage.gaussians))
    semantics = Semantics(torch.eye(4)[stage.classes - 1], seen, seen, "t", stage.gaussians.fingerprint)
    scene = TrainingScene("bare", lambda: (stage.gaussians, semantics))
    with pytest.raises(InputError, match="bare: the contrastive loss needs the masks"):
        distill([scene], replace(SETTINGS, epochs=1))
    with pytest.raises(InputError, match="needs masks"):
        MaskedView(stage.views[0].camera, stage.dense(stage.views[0]))
    with pytest.raises(InputError, match="loss: expected one of cosine, contrastive"):
        DistillSettings(loss="hinge")


def test_the_command_finds_the_views_beside_the_scene(stage, stage_files, tmp_path):
    scene = tmp_path / "stage.ply"
    save_gaussians(stage_files.gaussians, scene)
    gaussians = load_gaussians(scene)
    seen = torch.ones(len(gaussians))
    labels = ("1", "2", "3", "4")
    semantics = Semantics(torch.eye(4)[stage.classes - 1], seen, seen, "labels", gaussians.fingerprint, labels)
    save_semantics(semantics, tmp_path / "stage.safetensors")
    (tmp_path / "stage").symlink_to(stage_files.views)
    arguments = [scene, "--out", tmp_path / "net.safetensors", "--voxel", 0.3, "--epochs", 1, "--up", "y"]
    arguments += ["--loss", "contrastive", "--encoder", f"files:{stage_files.labels}", "--arch", "14A"]
    assert main(["distill", *map(str, arguments)]) == 0
    error = json.loads((tmp_path / "run.json").read_text())["error"]
    assert 0 < error["loss"] < 20
