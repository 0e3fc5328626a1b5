# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Swapping the rasterizer in
#
# You have code that calls gsplat, or Inria's `diff-gaussian-rasterization`, and it needs CUDA. This notebook changes
# the import and nothing else. It writes one small training loop twice, as users of either library write it, fits the
# same Gaussians to the photographs that ship with the package, and shows what one may rely on: both calls give the
# image and the gradients of the native rasterizer, down to the rounding of float32, and training follows the same
# curve. Everything runs on the CPU, in under half a minute once the kernels are compiled; on a CUDA device the same
# lines run there.

# %%
from pathlib import Path

import matplotlib.pyplot as plt
import torch

import sgwarp as sg
from sgwarp.compat.gsplat import rasterization  # was: from gsplat import rasterization
from sgwarp.compat.inria import (  # was: from diff_gaussian_rasterization import ...
    GaussianRasterizationSettings,
    GaussianRasterizer,
)
from sgwarp.compat.inria import dist2 as distCUDA2  # was: from simple_knn._C import distCUDA2

plt.rcParams.update({"figure.dpi": 110, "figure.constrained_layout.use": True, "font.size": 9, "axes.titlesize": 10})


def show(ax, image, title, **options):
    """An image without axes."""
    image = image.detach().numpy()
    ax.imshow(image if image.ndim == 2 else image.clip(0, 1), **options)
    ax.set_title(title)
    ax.axis("off")


# %% [markdown]
# ## Photographs and points
#
# Twelve photographs of a room to fit to, two to judge by, all at a quarter of their size. Where others start from the
# points of structure from motion, we take three thousand centres of the Gaussians that come with the room, and forget
# everything else about them.

# %%
WIDTH, HEIGHT = 120, 90
ROOM = Path(sg.__file__).parent / "demo" / "room"


def load(folder):
    """Views at the small size, and their photographs [H, W, 3]."""
    views = sg.load_views(folder)
    photographs = [
        torch.nn.functional.interpolate(view.image().permute(2, 0, 1)[None], size=(HEIGHT, WIDTH), mode="area")[0]
        for view in views
    ]
    return [view.camera.resized(HEIGHT, WIDTH) for view in views], [p.permute(1, 2, 0) for p in photographs]


cameras, photographs = load(ROOM)
held_out_cameras, held_out_photographs = load(ROOM / "held_out")
rng = torch.Generator().manual_seed(0)
room = sg.load_gaussians(ROOM / "room.compressed.ply")
points = room.means[torch.randperm(len(room), generator=rng)[:3000]]

fig, axes = plt.subplots(2, 6, figsize=(11, 3))
for k, ax in enumerate(axes.flat):
    show(ax, photographs[k], f"photograph {k}")
plt.show()

# %% [markdown]
# ## Parameters
#
# What an optimizer holds are raw numbers: logarithms of scales, logits of opacities. The first scale of a Gaussian is
# the distance to its neighbours, which is what `distCUDA2` is for. Colours are spherical harmonics of degree 1, grey at
# first.

# %%
RATES = {"means": 2e-3, "log_scales": 2e-2, "quats": 1e-2, "logits": 5e-2, "sh": 1e-2}


def parameters():
    """Leaves to optimise, the same every time."""
    count = len(points)
    spacing = distCUDA2(points).clamp(min=1e-7).sqrt()
    values = {
        "means": points.clone(),
        "log_scales": spacing.log()[:, None].repeat(1, 3),
        "quats": torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        "logits": torch.full((count,), 0.2).logit(),
        "sh": torch.zeros(count, 4, 3),
    }
    return {name: value.requires_grad_() for name, value in values.items()}


# %% [markdown]
# ## gsplat's call
#
# Cameras come as batches of world-to-camera matrices and intrinsics, images as `[C, H, W, 3]`; `info` holds the
# projected centres, whose gradient densification looks at.


# %%
def render_gsplat(p, camera):
    """Image [H, W, 3], and the tensor of projected centres."""
    colors, _alphas, info = rasterization(
        means=p["means"],
        quats=p["quats"],
        scales=p["log_scales"].exp(),
        opacities=p["logits"].sigmoid(),
        colors=p["sh"],
        viewmats=camera.world_to_camera[None].float(),
        Ks=camera.K[None].float(),
        width=WIDTH,
        height=HEIGHT,
        near_plane=0.2,
        sh_degree=1,
        packed=False,
    )
    if colors.requires_grad:
        info["means2d"].retain_grad()
    return colors[0], info["means2d"]


# %% [markdown]
# ## Inria's call
#
# Inria's code speaks OpenGL: both matrices are transposed, the second one holds the projection, and fields of view
# take the place of focal lengths. `screenspace_points` are zeros that only exist to receive a gradient.


# %%
def render_inria(p, camera):
    """Image [H, W, 3], and the tensor that receives the gradient of the centres."""
    tanfovx, tanfovy = WIDTH / (2 * camera.K[0, 0]), HEIGHT / (2 * camera.K[1, 1])
    znear, zfar = 0.01, 100.0
    projection = torch.zeros(4, 4, dtype=torch.float64)
    projection[0, 0], projection[1, 1] = 1 / tanfovx, 1 / tanfovy
    projection[0, 2], projection[1, 2] = 2 * camera.K[0, 2] / WIDTH - 1, 2 * camera.K[1, 2] / HEIGHT - 1
    projection[2, 2], projection[2, 3], projection[3, 2] = zfar / (zfar - znear), -zfar * znear / (zfar - znear), 1.0
    world_view = camera.world_to_camera.T
    settings = GaussianRasterizationSettings(
        image_height=HEIGHT,
        image_width=WIDTH,
        tanfovx=float(tanfovx),
        tanfovy=float(tanfovy),
        bg=torch.zeros(3),
        scale_modifier=1.0,
        viewmatrix=world_view.float(),
        projmatrix=(world_view @ projection.T).float(),
        sh_degree=1,
        campos=camera.position.float(),
        prefiltered=False,
        debug=False,
    )
    screenspace_points = torch.zeros_like(p["means"], requires_grad=True)
    image, _radii = GaussianRasterizer(settings)(
        means3D=p["means"],
        means2D=screenspace_points,
        opacities=p["logits"].sigmoid()[:, None],
        shs=p["sh"],
        scales=p["log_scales"].exp(),
        rotations=p["quats"],
    )
    return image.permute(1, 2, 0), screenspace_points


# %% [markdown]
# ## The native call
#
# One camera, one image, in pixels and metres. The two facades translate to the same kernels.


# %%
def render_native(p, camera):
    """Image [H, W, 3], and the tensor that receives the gradient of the centres."""
    means2d = torch.zeros(len(p["means"]), 2, requires_grad=True)
    rendering = sg.rasterize(
        p["means"],
        p["quats"],
        p["log_scales"].exp(),
        p["logits"].sigmoid(),
        camera.world_to_camera,
        camera.K,
        WIDTH,
        HEIGHT,
        sh=p["sh"],
        means2d=means2d,
        near=0.2,
    )
    return rendering.features, means2d


CALLS = {"native": render_native, "gsplat's call": render_gsplat, "Inria's call": render_inria}

# %% [markdown]
# ## The same image, the same gradients
#
# One photograph, one loss, three calls. Shapes and colours are drawn at random here, so that there is something to see.
# The differences are those of rounding. (In another view a single pixel may differ by a thousandth: where the opacity
# of a Gaussian is 1/255 to the last digits, rounding decides whether it counts.)


# %%
VIEW = 3


def random_parameters():
    """The same for every call."""
    rng, p = torch.Generator().manual_seed(1), parameters()
    with torch.no_grad():
        p["sh"] += 0.6 * torch.randn(p["sh"].shape, generator=rng)
        p["log_scales"] += 0.5 * torch.randn(p["log_scales"].shape, generator=rng)
        p["quats"] += torch.randn(p["quats"].shape, generator=rng)
        p["logits"] += 2.0 * torch.rand(p["logits"].shape, generator=rng)
    return p


images, gradients, centres = {}, {}, {}
for name, render in CALLS.items():
    p = random_parameters()
    images[name], centre = render(p, cameras[VIEW])
    (images[name] - photographs[VIEW]).square().mean().backward()
    gradients[name] = {key: value.grad for key, value in p.items()}
    centres[name] = centre.grad.reshape(len(points), -1)[:, :2]

image_differences, gradient_differences = {}, {}
for name in ("gsplat's call", "Inria's call"):
    image_differences[name] = float((images[name] - images["native"]).detach().abs().max())
    gradient_differences[name] = {
        key: float((gradients[name][key] - exact).norm() / exact.norm()) for key, exact in gradients["native"].items()
    }
    print(f"{name}: image within {image_differences[name]:.1e}; relative difference of gradients: ", end="")
    print(", ".join(f"{key} {value:.0e}" for key, value in gradient_differences[name].items()))

fig, axes = plt.subplots(1, 5, figsize=(12, 2.2))
for ax, name in zip(axes, CALLS, strict=False):
    show(ax, images[name], name)
for ax, name in zip(axes[3:], image_differences, strict=True):
    difference = (images[name] - images["native"]).abs().amax(-1)
    show(ax, difference, f"{name} - native", cmap="magma", vmin=0, vmax=1e-6)
fig.colorbar(axes[4].images[0], ax=axes[3:], shrink=0.8)
plt.show()

# %% [markdown]
# Densification splits Gaussians whose projected centres pull hard, and here the two libraries differ by a unit:
# gsplat's gradient is per pixel, Inria's per half of the image. Multiply by half the image's size, and they are the
# same numbers; thresholds tuned for either keep their meaning.

# %%
half_size = torch.tensor([WIDTH / 2, HEIGHT / 2])
gsplats = (centres["gsplat's call"] * half_size).norm(dim=1)
inrias = centres["Inria's call"].norm(dim=1)
seen = inrias > 0
proxy_difference = float((inrias - gsplats).norm() / inrias.norm())

fig, ax = plt.subplots(figsize=(4.2, 3.6))
ends = [float(inrias[seen].min()), float(inrias.max())]
ax.plot(ends, ends, color="0.4", linewidth=0.7)
ax.scatter(gsplats[seen].numpy(), inrias[seen].numpy(), s=5, color="#2f9e6e", linewidths=0)
ax.set(xscale="log", yscale="log", xlabel="gsplat: |means2d.grad (W/2, H/2)|", ylabel="Inria: |means2D.grad|")
ax.set_title(f"gradient of {int(seen.sum())} projected centres")
plt.show()

# %% [markdown]
# ## The training loop
#
# Adam on an L1 loss, one photograph per step. The loop does not know which rasterizer it has got.

# %%
STEPS = 400


def fit(render, steps=STEPS):
    """Fitted parameters, and the loss of each step."""
    p = parameters()
    optimizer = torch.optim.Adam([{"params": [p[name]], "lr": rate} for name, rate in RATES.items()])
    order = torch.Generator().manual_seed(2)
    losses = []
    for _ in range(steps):
        k = int(torch.randint(len(cameras), (1,), generator=order))
        image, _ = render(p, cameras[k])
        loss = (image - photographs[k]).abs().mean()
        loss.backward()
        optimizer.step()
        optimizer.zero_grad()
        losses.append(loss.item())
    return p, torch.tensor(losses)


def psnr(p, render):
    """Mean over the photographs that nothing was fitted to [dB]."""
    with torch.no_grad():
        errors = [
            (render(p, camera)[0].clip(0, 1) - photograph).square().mean()
            for camera, photograph in zip(held_out_cameras, held_out_photographs, strict=True)
        ]
    return float((-10 * torch.stack(errors).log10()).mean())


fitted, losses, quality = {}, {}, {}
for name in ("gsplat's call", "Inria's call"):
    fitted[name], losses[name] = fit(CALLS[name])
    quality[name] = psnr(fitted[name], CALLS[name])
    first, last = losses[name][:12].mean(), losses[name][-12:].mean()
    print(f"{name}: loss {first:.3f} -> {last:.3f}, {quality[name]:.2f} dB on what it has not seen")
again = fit(render_gsplat, steps=40)[1]
same_bits = torch.equal(again, losses["gsplat's call"][:40])
print(f"the same call again, the same bits: {same_bits}")

# %% [markdown]
# Two calls, one curve. What rounding leaves between them at first, a few ten-millionths, grows along the path, as it
# does between two runs of the originals, which add gradients up in any order: after four hundred steps a single loss
# may differ by a third, and the scenes are as good as each other. A call that is run twice here, on the CPU, repeats
# every bit.

# %%
fig, (left, right) = plt.subplots(1, 2, figsize=(10, 3))
for (name, curve), width, colour in zip(losses.items(), (4, 1.2), ("#9ad1b5", "#222222"), strict=True):
    left.plot(curve.numpy(), label=name, linewidth=width, color=colour)
left.set(xlabel="step", ylabel="L1 loss", title="two calls, one curve")
left.legend()
apart = (losses["gsplat's call"] - losses["Inria's call"]).abs() / losses["Inria's call"]
right.semilogy(apart.clip(min=1e-9).numpy(), color="#d95f02", linewidth=0.9)
right.set(xlabel="step", title="relative difference of the losses")
plt.show()

# %%
fig, axes = plt.subplots(2, 3, figsize=(9.5, 5))
for k, row in enumerate(axes):
    show(row[0], held_out_photographs[k], "photograph, not fitted to")
    for ax, name in zip(row[1:], fitted, strict=True):
        show(ax, CALLS[name](fitted[name], held_out_cameras[k])[0], f"{name}, {quality[name]:.1f} dB")
plt.show()

# %% [markdown]
# ## What carries over
#
# - gsplat's strategies: `info` has gsplat's keys, so `DefaultStrategy` densifies with `packed` and `absgrad` as usual.
# - Extra arguments of both: any number of channels instead of colours, depth (`render_mode="RGB+ED"`), covariances,
#   antialiasing, backgrounds; gradients of `viewmats` for poses.
# - What is not supported (rolling shutters, the unscented transform) raises one error that names the argument.
#
# And what changes for the better: Gaussians with NaN or infinity are left out instead of spreading, and gradients on
# the CPU have the same bits for any number of threads. When you write new code, `sg.render` and
# `sg.rasterize` ask for less.
