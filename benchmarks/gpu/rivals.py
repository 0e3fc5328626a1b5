"""gsplat 1.5.3 on the same tensors, where it builds."""

from __future__ import annotations

from typing import Any

import torch

from benchmarks.gpu.bench import PAIRS, Bench, backward
from benchmarks.gpu.checks import difference


def gsplat(bench: Bench) -> dict[str, Any]:
    """Its images beside ours, and its times."""
    if not bench.on_cuda:
        return {"left_out": "gsplat runs on CUDA alone"}
    import gsplat
    from gsplat.cuda._backend import _C

    if _C is None:
        return {"left_out": "gsplat has no CUDA code here; build it first"}
    found: dict[str, Any] = {}
    for count, size in PAIRS:
        gaussians, camera = bench.scene(count), bench.camera(size)
        pose, K = (t.float().to(bench.device)[None].contiguous() for t in (camera.world_to_camera, camera.K))

        def image(leaves: list[torch.Tensor], degree: int | None = 3, pose=pose, K=K, camera=camera) -> torch.Tensor:
            size = (camera.width, camera.height)
            return gsplat.rasterization(*leaves, pose, K, *size, sh_degree=degree, packed=False)[0]

        leaves, tag = bench.leaves(gaussians), f"{count} {size}"
        ours = bench.rasterize(leaves, camera).features
        found[f"difference of the images, {tag}"] = difference(image(leaves)[0], ours.cpu())
        found[f"forward, {tag}"] = bench.time(f"gsplat forward, {tag}", lambda x=leaves, i=image: i(x))

        def both(leaves: list[torch.Tensor] = leaves, image: Any = image, degree: int | None = 3) -> None:
            for leaf in leaves:
                leaf.grad = None
            image(leaves, degree).mean().backward()

        found[f"forward + backward, {tag}"] = bench.time(f"gsplat forward + backward, {tag}", both)
        wide = bench.leaves(gaussians, torch.rand(len(gaussians), 64, device=bench.device))
        name = f"64 channels, forward + backward, {tag}"
        found[name] = bench.time(f"gsplat {name}", lambda x=wide, i=image: both(x, i, None), 8)
        ours = f"sgwarp, 64 channels, forward + backward, {tag}"
        job = lambda x=wide, c=camera: backward(x, bench.rasterize(x, c, colors=False))  # noqa: E731
        found[ours] = bench.time(ours, job, 8)
    return found
