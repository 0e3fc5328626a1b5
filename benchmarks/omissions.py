"""What leaving out saves: every omission of a rendering and of a lift, with and without it, on three scenes.

    python -m benchmarks.omissions [--out benchmarks/omissions.json]

For each: milliseconds with everything computed, milliseconds with what is not needed left out, and the largest
difference between the two results. Times are the smallest of several runs that take turns.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

import sgwarp as sg
from sgwarp.ops import launcher
from sgwarp.ops.splatting import forward
from sgwarp.ops.splatting.autograd import rasterize
from sgwarp.ops.splatting.lifting import LiftSums, lift_view
from sgwarp.ops.splatting.plan import RenderPlan, plan_render
from sgwarp.scene import Camera, FeatureMap, Gaussians

sys.path.insert(0, str(Path(__file__).parent))

import scenes
from timing import Run, fastest

ROUNDS = 9
Pair = tuple[Callable[[], Tensor], Callable[[], Tensor]]


def with_zero_harmonics(gaussians: Gaussians) -> Gaussians:
    """The scene as many tools store it: sixteen coefficients, of which only the first is used."""
    sh = torch.zeros(len(gaussians), 16, 3)
    sh[:, :1] = gaussians.sh[:, :1]
    return dataclasses.replace(gaussians, sh=sh)


def three_scenes() -> dict[str, tuple[Gaussians, Camera]]:
    """A synthetic room, the trained room of the demo, and a cloud around the camera of which most is behind it."""
    room, camera, _ = scenes.room(100_000)
    folder = Path(sg.__file__).parent / "demo" / "room"
    trained = sg.load_gaussians(folder / "room.compressed.ply")
    view = sg.load_views(folder / "held_out")[0].camera
    rng = torch.Generator().manual_seed(0)
    count = 200_000
    around = Gaussians(
        4.0 * torch.randn(count, 3, generator=rng),
        torch.randn(count, 4, generator=rng),
        0.005 + 0.03 * torch.rand(count, 3, generator=rng),
        torch.rand(count, generator=rng) ** 4,
        torch.randn(count, 1, 3, generator=rng),
    )
    inside = Camera(camera.K, torch.eye(4), 640, 480)
    return {"synthetic room": (room, camera), "demo room": (trained, view), "cloud around": (around, inside)}


def omissions(gaussians: Gaussians, camera: Camera) -> dict[str, Pair]:
    """(everything, only what is needed) of each omission, both giving what was asked for."""
    zeros = with_zero_harmonics(gaussians)
    zeros.used_sh_degree  # noqa: B018 - found once per scene
    rng = torch.Generator().manual_seed(1)
    features = torch.nn.functional.normalize(torch.randn(len(gaussians), 64, generator=rng), dim=1)
    query = torch.randn(64, 3, generator=rng)
    ids = torch.arange(camera.height)[:, None] // 60 * 8 + torch.arange(camera.width) // 80
    labels = tuple(str(i) for i in range(int(ids.max()) + 1))
    id_map = FeatureMap(space="labels", ids=ids[None].to(torch.int32), labels=labels)
    one_hot = FeatureMap(space="labels", dense=torch.nn.functional.one_hot(ids, len(labels)).float())

    def planned(scene: Gaussians, change: dict[str, object], **wanted: bool) -> Callable[[], Tensor]:
        plan: RenderPlan = dataclasses.replace(plan_render(scene, **wanted), **change)
        return lambda: forward.rasterize(scene, camera, plan=plan).features

    def recorded() -> Tensor:
        leaf = gaussians.means.clone().requires_grad_()
        rest = (gaussians.quats, gaussians.scales, gaussians.opacities, camera.world_to_camera, camera.K)
        return rasterize(leaf, *rest, camera.width, camera.height, sh=gaussians.sh, near=camera.near).features.detach()

    def lifted(feature_map: FeatureMap) -> Callable[[], Tensor]:
        def job() -> Tensor:
            sums = LiftSums.zeros(len(gaussians), len(labels))
            lift_view(gaussians, camera, feature_map, sums)
            return sums.features

        return job

    def alpha(plan: RenderPlan) -> Callable[[], Tensor]:
        return lambda: forward.rasterize(gaussians, camera, plan=plan).alpha

    return {
        "harmonics that are zero": (planned(zeros, {"sh_degree": 3}), planned(zeros, {})),
        "depth, for an image": (planned(gaussians, {}, depth=True), planned(gaussians, {})),
        "colours, for opacity": (alpha(plan_render(gaussians)), alpha(plan_render(gaussians, "nothing"))),
        "records, without gradients": (recorded, planned(gaussians, {})),
        "64 channels, for 3 queries": (
            lambda: sg.render(gaussians, camera, "features", features) @ query,
            lambda: sg.render(gaussians, camera, "features", features @ query),
        ),
        f"{len(labels)} channels, for a label map": (lifted(one_hot), lifted(id_map)),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path(__file__).with_name("omissions.json"))
    options = parser.parse_args()
    results: dict[str, dict[str, dict[str, float]]] = {}
    for scene, (gaussians, camera) in three_scenes().items():
        print(f"\n{scene}: {len(gaussians):,} Gaussians, {camera.width} x {camera.height}")
        results[scene] = {}
        for name, (everything, needed) in omissions(gaussians, camera).items():
            whole, part = everything(), needed()
            difference = float((whole - part).abs().max()) / max(float(whole.abs().max()), 1e-30)
            threads = launcher.get_threads()
            times = fastest({"everything": Run(everything, threads), "needed": Run(needed, threads)}, ROUNDS)
            results[scene][name] = {**times, "relative difference": difference}
            line = f"{times['everything']:8.2f} -> {times['needed']:7.2f} ms, difference {difference:.1e}"
            print(f"  {name:36s} {line}")
    options.out.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
