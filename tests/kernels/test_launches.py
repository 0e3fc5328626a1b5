"""The column "device" of the table in kernels/README.md: what it says of the CPU is what the package launches there."""

import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import warp as wp

import sgwarp as sg
from sgwarp.compat import gsplat
from sgwarp.network.inputs import voxelize
from sgwarp.network.layers.mink_unet import ARCHITECTURES, Architecture, MinkUNet
from sgwarp.ops.deformation import deformed
from sgwarp.ops.photometric import photometric_loss
from sgwarp.ops.splatting.id_weights import weigh_pairs
from sgwarp.ops.splatting.incremental import IncrementalLift
from sgwarp.reconstruction.fitting.densify import Densify
from sgwarp.reconstruction.fitting.initial import gaussians_from_points
from sgwarp.reconstruction.fitting.mcmc import MarkovChain
from sgwarp.reconstruction.fitting.model import Gradients, Model

pytestmark = pytest.mark.slow

README = Path(__file__).resolve().parents[2] / "kernels" / "README.md"
COUNT, CHANNELS = 200, 20


@pytest.fixture
def launched(monkeypatch) -> set[str]:
    """Names of the kernels that are launched from now on."""
    names: set[str] = set()
    for how in ("launch", "launch_tiled"):
        original = getattr(wp, how)

        def spy(kernel, *arguments, original=original, **options):
            names.add(kernel.key.split("__locals__")[-1])
            return original(kernel, *arguments, **options)

        monkeypatch.setattr(wp, how, spy)
    return names


def claimed() -> dict[str, str]:
    """Devices of each kernel, as the table says."""
    rows = re.findall(r"^\| `(\w+)`[^|]*\|([^|]*)\|(?:[^|]*\|){4}$", README.read_text(encoding="utf-8"), re.MULTILINE)
    assert len(rows) > 40
    return {name: device.strip() for name, device in rows}


def everything_that_has_kernels(monkeypatch) -> None:
    g = torch.Generator().manual_seed(0)
    camera = sg.Camera(torch.tensor([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]), torch.eye(4), 64, 48)
    scene = sg.Gaussians(
        torch.randn(COUNT, 3, generator=g) + torch.tensor([0.0, 0, 4]),
        torch.randn(COUNT, 4, generator=g),
        0.02 + 0.1 * torch.rand(COUNT, 3, generator=g),
        0.05 + 0.9 * torch.rand(COUNT, generator=g),
        torch.randn(COUNT, 16, 3, generator=g),
    )
    shape = scene.means, scene.quats, scene.scales, scene.opacities
    rich = {"sh": scene.sh, "means2d": torch.zeros(COUNT, 2, requires_grad=True), "absgrad": True}
    features = {"features": torch.rand(COUNT, CHANNELS, generator=g)}
    for what in ({"sh": scene.sh, "expected_depth": True}, rich, features):
        leaves = [tensor.clone().requires_grad_() for tensor in shape]
        pose = torch.eye(4).requires_grad_()
        sg.rasterize(*leaves, pose, camera.K, 64, 48, **what).features.sum().backward()

    views, ids = [sg.View("a", camera), sg.View("b", camera)], torch.randint(0, 5, (48, 64), generator=g)
    dense = sg.FeatureMap("toy", dense=torch.rand(48, 64, CHANNELS, generator=g))
    by_id = sg.FeatureMap("toy", ids=ids, vectors=torch.rand(5, CHANNELS, generator=g))
    wide = sg.FeatureMap("toy", dense=torch.rand(48, 64, 128, generator=g))
    for feature_map, mode in ((dense, "weighted"), (wide, "weighted"), (by_id, "weighted"), (dense, "center")):
        sg.lift(scene, views, dict.fromkeys("ab", feature_map), mode)
    weigh_pairs(scene, camera, ids)
    sg.top_contributors(scene, camera, k=8)
    frames = IncrementalLift()
    for shift in (0.0, 0.05):  # a few Gaussians move from one frame to the next
        moved = scene.means + shift * (torch.arange(COUNT) < 5)[:, None]
        frames.begin(replace(scene, means=moved))
        frames.add("a", camera, by_id)
        frames.finish()

    _, _, meta = gsplat.rasterization(*shape, scene.sh[:, 0], torch.eye(4)[None], camera.K.float()[None], 64, 48)
    splats = [meta[name] for name in ("means2d", "conics")]
    lists = 64, 48, 16, meta["isect_offsets"], meta["flatten_ids"]
    gsplat.rasterize_to_pixels(*splats, scene.sh[meta["gaussian_ids"], 0], meta["opacities"], *lists, packed=True)
    gsplat.rasterize_to_indices_in_range(
        0, 1000, torch.ones(1, 48, 64), *(t[None] for t in splats), meta["opacities"][None], *lists
    )

    image = torch.rand(48, 64, 3, generator=g, requires_grad=True)
    photometric_loss(image, torch.rand(48, 64, 3, generator=g), 0.2).backward()
    model = Model.starting(scene)
    slopes = Gradients(**{name: torch.ones_like(model[name]) for name in model.groups}, means2d=torch.ones(COUNT, 2))
    taken = model.update(slopes, 0.1, sg.FitSettings())
    density = Densify(sg.FitSettings(strategy="default"), 1.0, 100, COUNT, torch.device("cpu"))
    for strategy in (density, MarkovChain(sg.FitSettings(), 1.0, 100)):
        strategy.after_step(model, 1, slopes, taken, camera)
    gaussians_from_points(scene.means.numpy(), scene.sh[:, 0].sigmoid().numpy(), sg.FitSettings(), 1.0, "cpu")
    deformed(scene, scene.means, torch.eye(3).expand(COUNT, 3, 3))

    monkeypatch.setitem(ARCHITECTURES, "tiny", Architecture((1,) * 8, (16,) * 8))
    voxels, _ = voxelize(scene, "full", 0.2)
    MinkUNet(10, 4, "tiny")(voxels).features.sum().backward()


def test_the_table_says_what_the_cpu_runs(launched, monkeypatch):
    everything_that_has_kernels(monkeypatch)
    table = claimed()
    on_the_cpu = {name for name, device in table.items() if "CPU" in device}
    assert launched - on_the_cpu == set(), "launched on the CPU, but the table says otherwise"
    assert on_the_cpu - launched == set(), "in the table for the CPU, where nothing launches it"


def test_schedules_are_where_the_table_says():
    """`lanes` is the CPU's schedule and `block` that of CUDA; a file holds one of them."""
    for name, device in claimed().items():
        assert "block" in device or not name.endswith("_block"), name
        assert "lanes" not in device or "CUDA" not in device, name
        assert "block" not in device or "CPU" not in device, name
