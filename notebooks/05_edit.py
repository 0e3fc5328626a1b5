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
# # Editing a scene by language
#
# "Remove the lamp", "make the couch green": a text selects Gaussians, an operation changes them, and the result is a
# new scene. You see how a **selection** comes from a text, with and without instances, what the **operations** do,
# how a session **undoes** and replays them, and two figures for how well an edit stays with its object: *leakage* and
# *completeness*. The same from the shell: `sgwarp edit scene.ply --select lamp --remove --out edited.ply`.

# %%
import json
from pathlib import Path

import matplotlib.pyplot as plt
import torch

import sgwarp as sg
from sgwarp.apps.editing.measurement import measure_edit
from sgwarp.apps.editing.operations import COLORS, Duplicate, Move, Recolor, Remove, Rotate
from sgwarp.files.images import read_ids

plt.rcParams.update({"figure.dpi": 110, "figure.constrained_layout.use": True, "font.size": 9, "axes.titlesize": 10})
ROOM = Path(sg.__file__).parent / "demo" / "room"
scene = sg.load_gaussians(ROOM / "room.compressed.ply")
views, held_out = sg.load_views(ROOM), sg.load_views(ROOM / "held_out")

# %% [markdown]
# ## What a selection needs
#
# Semantics, lifted with the default encoder, answer texts. Instances, here from the label images that come with the
# room, say where an object ends: a text then selects the whole instance whose Gaussians fit it best on the mean.

# %%
some = views[::2]
encoder = sg.make_encoder("conse", some)
semantics = sg.lift(scene, some, encoder)
instances = sg.instances(scene, views, f"files:{ROOM / 'labels'}")
alone = sg.EditContext(semantics, encoder)
context = sg.EditContext(semantics, encoder, instances, views)

view = held_out[0]
couch = sg.Selection(("couch",))
figure, axes = plt.subplots(1, 2, figsize=(10, 3.6))
for axis, what, given in zip(axes, ("semantics alone", "with instances"), (alone, context), strict=True):
    chosen = sg.EditSession(scene, given).preview(couch)
    shown = sg.render(scene, view.camera, "features", features=chosen.float()[:, None])[..., 0]
    axis.imshow(view.image().numpy())
    axis.imshow(shown.numpy(), cmap="magma", alpha=0.6, vmin=0, vmax=1)
    axis.set_title(f"couch, {what}: {int(chosen.sum()):,} Gaussians")
    axis.axis("off")
plt.show()

# %% [markdown]
# ## Operations
#
# Every step is plain data: a selection and an operation. Turning an object turns its centers, its shapes, and the
# harmonics that say how its color depends on the direction. Recoloring keeps the shading.

# %%
session = sg.EditSession(scene, context)
session.apply(sg.EditStep(couch, Recolor(COLORS["green"])))
session.apply(sg.EditStep(sg.Selection(("electric guitar",)), Remove()))
session.apply(sg.EditStep(sg.Selection(("lamp",)), Duplicate((0.45, 0.0, 0.0))))
session.apply(sg.EditStep(sg.Selection(("last",), clean=False), Rotate((0.0, 0.0, 1.0), 90.0)))
session.apply(sg.EditStep(sg.Selection(("last",), clean=False), Move((0.1, 0.0, 0.0))))
print(json.dumps([step.content for step in session.steps], indent=1))

# %%
before, after = (sg.render(part, view.camera).clamp(0, 1) for part in (scene, session.state.gaussians))
figure, axes = plt.subplots(1, 2, figsize=(10, 3.6))
for axis, picture, title in zip(axes, (before, after), ("before", "after five steps"), strict=True):
    axis.imshow(picture.numpy())
    axis.set_title(title)
    axis.axis("off")
plt.show()

# %% [markdown]
# ## Undo
#
# Undoing gives back the same bits. The steps can be written as a script (`save_script`), which replays on the scene
# it was made for and on no other.

# %%
while session.steps:
    session.undo()
untouched = all(
    torch.equal(getattr(session.state.gaussians, name), getattr(scene, name))
    for name in ("means", "quats", "scales", "opacities", "sh")
)
print(f"everything undone, same bits as before: {untouched}")

# %% [markdown]
# ## Did the edit stay with its object?
#
# Completeness is the share of the object's true pixels that changed, leakage the number of changed pixels outside it,
# over the same number.

# %%
classes = {name: int(number) for number, name in json.loads((ROOM / "classes.json").read_text()).items()}
truth = torch.from_numpy(read_ids(ROOM / "held_out" / "labels" / f"{view.stem}.png") == classes["couch"])
figures = {}
step = sg.EditStep(couch, Recolor(COLORS["green"]))
fig, axes = plt.subplots(1, 2, figsize=(10, 3.6))
for axis, what, given in zip(axes, ("semantics alone", "with instances"), (alone, context), strict=True):
    picture = sg.render(sg.edit(scene, [step], given).gaussians, view.camera)
    figures[what] = measure_edit(before, picture, truth)
    axis.imshow(picture.clamp(0, 1).numpy())
    axis.set_title(f"make the couch green, {what}")
    axis.axis("off")
plt.show()
for what, found in figures.items():
    print(f"{what}: completeness {found.completeness:.2f}, leakage {found.leakage:.2f}")
