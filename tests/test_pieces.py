"""How much is done at a time changes no result: each constant that bounds memory, once large and once tiny."""

from importlib import import_module
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from sgwarp.apps.instances.evidence import view_evidence
from sgwarp.apps.instances.settings import InstanceSettings
from sgwarp.encoders.masks.sources import ViewMasks
from sgwarp.io.scenes import load_gaussians
from sgwarp.lifting.lifter import lift
from sgwarp.lifting.settings import LiftSettings
from sgwarp.ops.splatting.settings import RasterSettings
from sgwarp.scene import FeatureMap, Instance, InstanceMap, Semantics


@pytest.fixture(scope="module")
def given(stage, stage_files):
    """Semantics, evidence and instances of the stage, each Gaussian in doubt between its panel and the next one."""
    lifted = lift(stage.gaussians, stage.views[:3], stage.dense)
    evidence = []
    for view in stage.views[:4]:
        labels = stage.labels(view)
        masks = torch.stack(
            [(labels == k) & (torch.arange(labels.shape[1]) % 2 == j) for k in range(1, 5) for j in (0, 1)]
        )
        found = ViewMasks.without_empty(masks, torch.full((8,), -1))
        evidence.append(view_evidence(stage.gaussians, view, found, RasterSettings()))
    zero = (0.0, 0.0, 0.0)
    table = tuple(Instance(k, "default", 0, 9, 1, 1, 1.0, zero, (1.0, 0.0, 0.0, 0.0), zero) for k in range(1, 5))
    candidates = torch.stack([stage.classes, stage.classes % 4 + 1], dim=1)[None]
    shares = torch.tensor([0.5, 0.3]).expand(1, len(stage.classes), 2)
    observations = torch.full((len(stage.classes),), 9.0)
    found = InstanceMap(candidates, shares, observations, table, ("default",), stage.gaussians.fingerprint, 0.4)
    return SimpleNamespace(stage=stage, files=stage_files, lifted=lifted, evidence=evidence, found=found)


def render_ids(given):
    from sgwarp.apps.instances.maps import render_ids

    ids, share = render_ids(given.stage.gaussians, given.found, given.stage.views[0].camera)
    assert set(ids.unique().tolist()) == {0, 1, 2, 3, 4}
    return ids, share


def mean_features(given):
    from sgwarp.apps.instances.finder import mean_features

    return [mean_features(given.found, given.lifted)]


def overlaps(given):
    from sgwarp.apps.instances.association import build_graph

    count = len(given.stage.gaussians)
    graph = build_graph(given.evidence, "default", count, InstanceSettings(samples_per_mask=0))
    assert len(graph.first) > 8
    dense = np.zeros((len(graph.view_of),) * 2)
    dense[graph.first, graph.second] = graph.shared
    return torch.from_numpy(dense), torch.from_numpy(graph.visible)


def counts(given):
    from sgwarp.apps.instances.counts import count_groups

    groups = np.concatenate([np.arange(len(view.ranks)) for view in given.evidence])
    found = count_groups(given.evidence, "default", groups, len(given.stage.gaussians), 1.0)
    return [torch.from_numpy(found.toarray())]


def holes(given):
    from sgwarp.lifting.holes import fill_holes

    seen = given.lifted.seen & (torch.arange(len(given.lifted)) % 3 > 0)
    weight = torch.where(seen, given.lifted.weight, 0.0)
    features = given.lifted.features * seen[:, None]
    holed = Semantics(features, weight, weight.sign(), "toy", given.lifted.fingerprint)
    filled = fill_holes(given.stage.gaussians, holed)
    return filled.features, filled.weight


def modes(mode):
    def run(given):
        settings = LiftSettings(passes=2, ridge=1.0, iterations=2)
        found = lift(given.stage.gaussians, given.stage.views[:2], given.stage.dense, mode, lift_settings=settings)
        return [found.features]

    return run


def residuals(given):
    """Of more channels than are rendered at once."""
    from sgwarp.lifting.residuals import residual

    stage, view = given.stage, given.stage.views[1]
    vectors = torch.randn(5, 40, generator=torch.Generator().manual_seed(2))
    found = FeatureMap("t", ids=stage.labels(view), vectors=vectors)
    features = vectors[stage.classes] + 0.5 * vectors.roll(1, dims=0)[stage.classes]
    many = tuple(str(k) for k in range(40))
    labels = FeatureMap("labels", ids=stage.labels(view) * 8 - 1, labels=many)
    one_hot = torch.nn.functional.one_hot(stage.classes * 8 - 1, 40).float()
    ones = torch.ones(len(features))
    sums = [(found, features), (labels, one_hot)]
    errors = [residual(stage.gaussians, view.camera, *one, ones) for one in sums]
    assert 0.05 < errors[0] < 1.0
    assert errors[1] < 0.1
    return torch.tensor(errors), torch.zeros(1)


def colors(given):
    from sgwarp.viewer.paints import feature_colors

    return [feature_colors(given.lifted)]


def examples(given):
    from sgwarp.network.training.data import make_example

    found = make_example(given.stage.gaussians, given.lifted, "ones", 0.2, by_reliability=True)
    return found.targets, found.weights, found.rows


def means_of_masks(given):
    from sgwarp.encoders.painting import interpolation, spread

    masks = torch.stack([given.stage.labels(view) == k for view in given.stage.views[:2] for k in range(1, 5)])
    return [spread(masks, interpolation(72, 9), interpolation(96, 12))]


def ply(given):
    found = load_gaussians(given.files.scene)
    return found.means, found.sh, found.opacities


def finite(given):
    from sgwarp.io.store import load_semantics, save_semantics

    path = given.files.scene.with_name("pieces.safetensors")
    save_semantics(given.lifted, path)
    return [load_semantics(path).features]


def lenses(given):
    from sgwarp.io.undistort import Lens, _sampling_positions

    _sampling_positions.cache_clear()
    x, y = _sampling_positions(Lens(80.0, 80.0, 48.0, 36.0, 96, 72, (-0.1, 0.02, 0.0, 0.0)), 96, 72)
    _sampling_positions.cache_clear()
    return torch.from_numpy(x), torch.from_numpy(y)


def prints(given):
    from sgwarp.cluster.records import fingerprint

    (found,) = fingerprint((str(given.files.scene),), contents=True).values()
    return [torch.tensor(list(bytes.fromhex(found["sha256"])))]


CASES = {
    "sgwarp.apps.instances.maps:CHANNELS": (1, render_ids),
    "sgwarp.apps.instances.finder:CHUNK": (500, mean_features),
    "sgwarp.apps.instances.association:BLOCK": (3, overlaps),
    "sgwarp.apps.instances.counts:VIEWS_AT_ONCE": (1, counts),
    "sgwarp.lifting.holes:ROWS": (100, holes),
    "sgwarp.lifting.robust:ROWS": (700, modes("robust")),
    "sgwarp.lifting.ridge:BLOCK": (2, modes("solve")),
    "sgwarp.lifting.residuals:IMAGE_BYTES": (1, residuals),
    "sgwarp.viewer.paints:CHUNK": (300, colors),
    "sgwarp.network.training.data:CHUNK": (200, examples),
    "sgwarp.encoders.painting:MASKS_AT_ONCE": (3, means_of_masks),
    "sgwarp.io.ply:ROWS_PER_BLOCK": (130, ply),
    "sgwarp.io.store:ROWS_PER_CHECK": (1000, finite),
    "sgwarp.io.undistort:ROWS": (7, lenses),
    "sgwarp.cluster.records:CHUNK": (1000, prints),
}


@pytest.mark.parametrize("name", CASES)
def test_pieces_change_nothing(given, monkeypatch, name):
    small, make = CASES[name]
    module, constant = name.split(":")
    whole = make(given)
    monkeypatch.setattr(import_module(module), constant, small)
    for one, other in zip(whole, make(given), strict=True):
        torch.testing.assert_close(other, one, rtol=1e-4, atol=1e-5)
