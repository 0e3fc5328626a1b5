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
# # From a moving scene to tracked objects
#
# A walker, a ball, a crate, a cart that comes and goes, and a lamp that goes on: a generated scene whose Gaussians move
# and whose truth is known at every pixel. Label images with mistakes, others in every frame and view, become **objects
# with trajectories**. You see what lifting every frame by itself gives, what **fusion over time** adds, how a **change
# of state** is found, and what is **left out** because it did not move. In one line of shell:
# `sgwarp track params.npz --views scene/ --encoder files:scene/labels --out tracked/`.

# %%
import matplotlib.pyplot as plt
import numpy as np
import torch

import sgwarp as sg
from sgwarp.apps.tracking.answers import Questions, answer
from sgwarp.datasets.moving import LABELS, make_moving_scene, with_label_noise
from sgwarp.io.moving_views import FrameView
from sgwarp.io.sequences import Frame
from sgwarp.metrics.segmentation import ConfusionMatrix
from sgwarp.metrics.tracking import point_tracking
from sgwarp.visualization.pictures import class_colours, overlay

plt.rcParams.update({"figure.dpi": 110, "figure.constrained_layout.use": True, "font.size": 9, "axes.titlesize": 10})
FRAMES = 16
scene = make_moving_scene(seed=0, frames=FRAMES, count=5000, cameras=6, width=128, height=96, moving_share=0.5)

# %% [markdown]
# ## The scene
#
# Two cameras at four moments, and below what their rays hit first. The truth comes from the bodies, not from the
# Gaussians that cover them.

# %%
colors = np.vstack([np.zeros((1, 3), np.uint8), class_colours(len(LABELS))])
moments = (0, 4, 8, 12)
figure, axes = plt.subplots(2, 4, figsize=(10, 4))
for column, moment in enumerate(moments):
    camera = scene.cameras[0].camera
    axes[0, column].imshow(sg.render(scene.gaussians(moment), camera).clamp(0, 1).numpy())
    axes[0, column].set_title(f"frame {moment}")
    axes[1, column].imshow(colors[scene.truth(moment, camera).numpy()])
for axis in axes.flat:
    axis.axis("off")
plt.show()

# %% [markdown]
# ## Label images with mistakes
#
# A 2D network sees one picture at a time and mistakes whole objects. Here every region gets a wrong label with a
# probability of 20 %, anew in each frame and view.


# %%
class Sequence:
    """The scene as `sg.load_sequence` would read it from files."""

    def __len__(self):
        return FRAMES

    def frame(self, index):
        return Frame(index, scene.gaussians(index), None, scene.moving)


random = torch.Generator().manual_seed(0)
truth = {(t, view.stem): scene.truth(t, view.camera) for t in range(FRAMES) for view in scene.cameras}
names = tuple(str(k + 1) for k in range(len(LABELS)))
maps = {
    key: sg.FeatureMap("labels", ids=with_label_noise(labels, 0.2, random) - 1, labels=names)
    for key, labels in truth.items()
}

# %% [markdown]
# ## Every frame alone, and fused
#
# `sg.track` is an iterator over frames, and no frame depends on a later one. A forgetting factor of 0 is the paper's
# lifting per frame; with 0.9 the Gaussians carry the evidence of earlier frames along.


# %%
def followed(forgetting):
    """mIoU of every frame, its answers, and how much of the tiles was left out."""
    settings = sg.TrackSettings(sg.FusionSettings(forgetting))
    quality, answers, left_out = [], [], []
    for frame in sg.track(Sequence(), lambda index: scene.cameras, maps, settings=settings):
        found = answer(frame, Questions(), scene.cameras[::2])
        counts = ConfusionMatrix.empty(len(LABELS))
        for view in scene.cameras[::2]:
            counts.add(
                torch.from_numpy(found.images[view.stem].astype(np.int64)) - 1, truth[frame.index, view.stem] - 1
            )
        quality.append(counts.miou)
        answers.append(found)
        left_out.append(frame.work.left_out)
    return quality, answers, left_out


alone, answers_alone, _ = followed(0.0)
fused, answers_fused, left_out = followed(0.9)
figure, axis = plt.subplots(figsize=(7, 2.6))
axis.plot(alone, label=f"every frame alone, mean {np.mean(alone):.3f}")
axis.plot(fused, label=f"fused, mean {np.mean(fused):.3f}")
axis.axvline(scene.switch, color="0.7", lw=1)
axis.annotate("the lamp goes on", (scene.switch, min(alone)), fontsize=8)
axis.set(xlabel="frame", ylabel="mIoU")
axis.legend()
plt.show()
assert np.mean(fused[3:]) > np.mean(alone[3:])

# %%
figure, axes = plt.subplots(2, 4, figsize=(10, 4))
view = scene.cameras[0]
for column, moment in enumerate((3, 7, 11, 15)):
    picture = sg.render(scene.gaussians(moment), view.camera).clamp(0, 1)
    for row, answers in enumerate((answers_alone, answers_fused)):
        labels = answers[moment].images[view.stem].astype(int) - 1
        axes[row, column].imshow(overlay(picture, labels, class_colours(len(LABELS))))
        axes[row, column].set_title(f"frame {moment}, {('alone', 'fused')[row]}")
        axes[row, column].axis("off")
plt.show()

# %% [markdown]
# ## A change of state
#
# Fusion believes in a new state once three frames in a row have contradicted the old one. Then the past is dropped, so
# that "off" and "on" do not blend.

# %%
on, off = (str(LABELS.index(name) + 1) for name in ("lamp on", "lamp off"))
figure, axis = plt.subplots(figsize=(7, 2.2))
for answers, style in ((answers_alone, ":"), (answers_fused, "-")):
    for name, color in ((off, "tab:blue"), (on, "tab:orange")):
        pixels = [sum(next(o for o in found.objects if o["name"] == name)["pixels"].values()) for found in answers]
        label = ("on" if name == on else "off") + (", fused" if style == "-" else ", alone")
        axis.plot(pixels, style, color=color, label=label)
axis.axvline(scene.switch, color="0.7", lw=1)
axis.set(xlabel="frame", ylabel="pixels of the lamp")
axis.legend(ncols=2, fontsize=8)
plt.show()

# %% [markdown]
# ## Trajectories
#
# Each object's centroid from above. Points ride on Gaussians: `sg.carry_points` gives their paths, and the median
# trajectory error tells how far they are from the truth.

# %%
figure, axis = plt.subplots(figsize=(5, 4))
for name in ("ball", "crate", "head", "pillar"):
    value = str(LABELS.index(name) + 1)
    rows = [next(o for o in found.objects if o["name"] == value) for found in answers_fused]
    path = np.array([row["centroid"] for row in rows if row["centroid"] and row["visible"]])
    axis.plot(path[:, 0], path[:, 2], "o-", ms=3, label=name)
axis.set(xlabel="x [m]", ylabel="z [m]", aspect="equal")
axis.legend()
plt.show()

picked = torch.randint(0, 5000, (200,), generator=random)
paths = sg.carry_points(Sequence(), scene.gaussians(0).means[picked])
wanted = torch.stack([scene.gaussians(t).means[picked] for t in range(FRAMES)])
figures = point_tracking(100 * paths, 100 * wanted)
print(f"median trajectory error {figures.median_error:.4f} cm, delta {figures.delta:.3f}")
assert figures.median_error < 1.0

# %% [markdown]
# ## What was left out
#
# Floor, pillar, table and lamp stay. Tiles in which neither a Gaussian nor a label changed are not walked again, and
# the result has the same bits. With labels that never repeat, as here, few tiles stay; with clean ones many do.

# %%
clean = {key: sg.FeatureMap("labels", ids=labels - 1, labels=names) for key, labels in truth.items()}
quiet = [f.work.left_out for f in sg.track(Sequence(), lambda index: scene.cameras, clean)]
print(f"tiles left out with mistakes: {np.mean(left_out[1:]):.0%}, without: {np.mean(quiet[1:]):.0%}")
views = [FrameView(view) for view in scene.cameras]
print(f"{len(views)} views of {scene.cameras[0].camera.width} x {scene.cameras[0].camera.height} pixels a frame")
assert np.mean(quiet[1:]) > np.mean(left_out[1:])
