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
# # From photographs to answers
#
# Twelve photographs with known poses become a 3D Gaussian scene, and the scene answers questions: *where is the
# piano?* You see how a **fit** starts, how its quality grows with time, what its knobs trade against each other, and
# how the fitted scene is **lifted** and **asked**. The photographs ship with the package; here they are shrunk to a
# quarter, so that everything takes about a minute on two CPU cores. The same in one line of shell, at full size:
# `sgwarp fit photos/ --out scene.ply`.

# %%
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch

import sgwarp as sg

plt.rcParams.update({"figure.dpi": 110, "figure.constrained_layout.use": True, "font.size": 9, "axes.titlesize": 10})
ROOM = Path(sg.__file__).parent / "demo" / "room"

# %% [markdown]
# ## Photographs
#
# `sg.load_views` reads a `transforms.json` or a COLMAP model. Two more photographs are held out: nothing is fitted to
# them, so they tell how good the scene is where it was not looked at.

# %%
views, held_out = sg.load_views(ROOM), sg.load_views(ROOM / "held_out")
figure, axes = plt.subplots(2, 6, figsize=(11, 3))
for axis, view in zip(axes.flat, views, strict=True):
    axis.imshow(view.image().numpy())
    axis.set_title(view.stem)
    axis.axis("off")
plt.show()

# %% [markdown]
# ## A start
#
# Structure from motion leaves a cloud of coloured points, which `sg.load_points` reads from beside the photographs.
# This small data set has none, so every 16th centre of the finished scene that ships with it stands in, moved by a few
# centimetres. (Without any points a fit starts at random in front of the cameras, and takes longer.)

# %%
finished = sg.load_gaussians(ROOM / "room.compressed.ply")
random = torch.Generator().manual_seed(0)
every = finished.subset(torch.arange(0, len(finished), 16))
positions = every.means + 0.03 * torch.randn(every.means.shape, generator=random)
colours = (every.sh[:, 0] * 0.28209479 + 0.5).clamp(0, 1)
print(f"{len(positions):,} points")

# %% [markdown]
# ## The fit
#
# Each step renders the scene as one photograph's camera sees it, compares (absolute difference and structural
# similarity), and moves, reshapes and recolours those Gaussians that were seen. Every `refine_every` steps the
# transparent ones are moved to where they are needed, and some are added until the `cap` is reached. The curve is
# measured on the held-out photographs while it goes.

# %%
DOWNSCALE = 4
settings = sg.FitSettings(steps=240, cap=12_000, sh_degree=1, degree_every=120, evaluate_every=40, refine_every=20)
fitted = sg.fit(views, (positions, colours), held_out, settings, downscale=DOWNSCALE)
scene = fitted.gaussians
print(f"{len(scene):,} Gaussians, held-out PSNR {fitted.curve[-1].psnr:.1f} dB")

# %%
figure, axes = plt.subplots(1, 2, figsize=(9, 2.8))
seconds = [point.seconds for point in fitted.curve]
axes[0].plot(seconds, [point.psnr for point in fitted.curve], "o-")
axes[0].set(xlabel="seconds of fitting", ylabel="held-out PSNR [dB]")
axes[1].plot(seconds, [point.loss for point in fitted.curve], "o-")
axes[1].set(xlabel="seconds of fitting", ylabel="loss, running mean")
for axis in axes:
    axis.grid(alpha=0.3)
plt.show()

# %%
figure, axes = plt.subplots(len(held_out), 3, figsize=(10, 2.6 * len(held_out)))
for row, view in zip(axes, held_out, strict=True):
    height, width = (size // DOWNSCALE for size in view.camera.size)
    small = view.image().unfold(0, DOWNSCALE, DOWNSCALE).unfold(1, DOWNSCALE, DOWNSCALE).mean(dim=(3, 4))
    rendering = sg.render(scene, view.camera.resized(height, width)).clamp(0, 1)
    row[0].imshow(small.numpy())
    row[0].set_title(f"held-out photograph {view.stem}")
    row[1].imshow(rendering.numpy())
    row[1].set_title(f"rendering, {fitted.held_out[view.stem]:.1f} dB")
    row[2].imshow((rendering - small).abs().mean(dim=2).numpy(), vmin=0, vmax=0.25, cmap="inferno")
    row[2].set_title("difference, 0 to 0.25")
    for axis in row:
        axis.axis("off")
plt.show()

# %% [markdown]
# ## Quality against size
#
# Fewer Gaussians are quicker to fit, to lift and to ask, and show less. The cap is the knob.

# %%
caps = (1500, 4000, 12_000)
quality = {}
for cap in caps[:-1]:
    smaller = sg.fit(
        views,
        (positions, colours),
        held_out,
        sg.FitSettings(steps=80, cap=cap, sh_degree=0, refine_every=20),
        downscale=DOWNSCALE,
    )
    quality[cap] = smaller.curve[-1]
quality[caps[-1]] = next(point for point in fitted.curve if point.step == 80)
for cap, point in quality.items():
    print(f"cap {cap:6,}: {point.psnr:.1f} dB after {point.step} steps")

# %% [markdown]
# ## Answers
#
# Lifting does not ask where a scene comes from. The default encoder describes every photograph, the scene carries that
# over to its Gaussians, and a text is scored against each of them.

# %%
encoder = sg.make_encoder("conse", views)
semantics = sg.lift(scene, views, encoder)
words = ["couch", "plant", "lamp"]
scores = sg.evidence(sg.query(semantics, words, encoder), semantics)
print(f"{semantics.coverage:.1%} of the Gaussians were seen")

# %%
view = held_out[0]
figure, axes = plt.subplots(1, len(words), figsize=(11, 2.9))
hits = {}
for axis, word, column in zip(axes, words, scores.T, strict=True):
    pixel, score_map = sg.localize(column.contiguous(), scene, view.camera, seen=semantics.seen, box=9)
    hits[word] = pixel
    axis.imshow(view.image().numpy())
    axis.imshow(np.ma.masked_invalid(score_map.numpy()), cmap="turbo", alpha=0.5)
    axis.plot(*pixel, "w+", markersize=14, markeredgewidth=2)
    axis.set_title(word)
    axis.axis("off")
plt.show()

# %% [markdown]
# To keep the scene: `sg.save_gaussians(scene, "scene.ply")`, or `scene.compressed.ply` for a file of 16 bytes per
# Gaussian and a byte per coefficient beyond the first. A long fit keeps checkpoints (`checkpoint=Path(...)`), and goes
# on from them with `resume=True` as if it had never stopped.
