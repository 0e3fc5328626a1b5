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
# # Instances: which Gaussians belong to one object?
#
# Masks of single views agree in nothing: SAM numbers them anew in every image. What they have in common is the
# Gaussians that they show. You see how masks with **shuffled ids** become instances without training, how sure each
# Gaussian is, what **"undecided"** means, and how well the id maps of views that were left out agree with the truth.
# The same from the shell: `sgwarp instances scene.ply --views photos/ --masks sam:PATH --out I.safetensors`.

# %%
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch

import sgwarp as sg
from sgwarp.apps.instances.maps import draw_ids, render_ids
from sgwarp.encoders.masks.sources import ViewMasks
from sgwarp.files.images import read_ids

plt.rcParams.update({"figure.dpi": 110, "figure.constrained_layout.use": True, "font.size": 9, "axes.titlesize": 10})
ROOM = Path(sg.__file__).parent / "demo" / "room"
scene = sg.load_gaussians(ROOM / "room.compressed.ply")
views, held_out = sg.load_views(ROOM), sg.load_views(ROOM / "held_out")
print(f"{len(scene):,} Gaussians, {len(views)} views with masks, {len(held_out)} without")

# %% [markdown]
# ## Masks whose numbers mean nothing
#
# A source of masks is any object with `read(view, image)`. This one takes the label images that come with the room
# and deals out the numbers at random in each view. Names such as "files:DIR", "sam:PATH" or "graph" work as well.


# %%
class ShuffledMasks:
    needs_image = False

    def read(self, view, image):
        ids = read_ids(ROOM / "labels" / f"{view.stem}.png")
        numbers = np.random.default_rng(int(view.stem)).permutation(np.unique(ids[ids > 0]))
        masks = torch.from_numpy(np.stack([ids == number for number in numbers]))
        return ViewMasks.without_empty(masks, torch.full((len(masks),), -1))


def numbered(view):
    masks = ShuffledMasks().read(view, None).masks
    return (masks * torch.arange(1, len(masks) + 1)[:, None, None]).sum(0)


figure, axes = plt.subplots(1, 4, figsize=(11, 2.2))
for axis, view in zip(axes, views, strict=False):
    axis.imshow(np.ma.masked_equal(numbered(view).numpy(), 0), cmap="tab20", vmin=0, vmax=19)
    axis.set_title(f"view {view.stem}: one color per number")
    axis.axis("off")
plt.show()

# %% [markdown]
# ## Joining them
#
# Every mask is lifted as an id: it gives each Gaussian the weight with which it shows it. Masks of two views that
# claim the same Gaussians, among those that both views show, are joined, best partners first, and never two masks of
# one view.

# %%
found = sg.instances(scene, views, ShuffledMasks())
ids = found.instance()
for row in found.table:
    side = " x ".join(f"{length:.2f}" for length in row.extent)
    print(f"{row.id:3}: {row.gaussians:6,} Gaussians, {row.views:2} views, {side} m, confidence {row.confidence:.2f}")
print(f"undecided: {float((ids < 0).float().mean()):.1%}, in no mask: {float((ids == 0).float().mean()):.1%}")

# %% [markdown]
# ## How sure is a Gaussian?
#
# Views are counted like votes: a Gaussian that n views show, with a share s of them for its instance, has the
# confidence (n s + 1) / (n + 2). Below 0.55 it is undecided; where nothing was seen it is 1/2.

# %%
figure, axis = plt.subplots(figsize=(6, 2.5))
axis.hist(found.confidence().numpy(), bins=60)
axis.axvline(found.least_confidence, color="k", linestyle="--")
axis.set(xlabel="confidence", ylabel="Gaussians")
plt.show()

# %% [markdown]
# ## Views that gave no masks
#
# The instances are rendered into the views that were left out. Each class of the truth is matched with the instance
# that overlaps it most.

# %%
figure, axes = plt.subplots(1, 2, figsize=(11, 3.4))
counts = np.zeros((15, len(found.table) + 1))
for axis, view in zip(axes, held_out, strict=True):
    shown, _ = render_ids(scene, found, view.camera)
    truth = read_ids(ROOM / "held_out" / "labels" / f"{view.stem}.png")
    np.add.at(counts, (truth.ravel(), shown.numpy().ravel()), 1)
    axis.imshow(draw_ids(view.image(), shown, found))
    axis.set_title(f"held-out view {view.stem}")
    axis.axis("off")
plt.show()

# %%
inside = counts[1:, 1:]
iou = inside / np.maximum(counts[1:].sum(1)[:, None] + inside.sum(0)[None] - inside, 1)
present = counts[1:].sum(1) > 0
mean_iou = iou[present].max(axis=1).mean()
print(f"mean IoU over the {present.sum()} classes in these views: {mean_iou:.3f}")
