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
# # The kernels, one launch at a time
#
# This notebook renders a small scene of 3D Gaussians and lifts 2D semantics onto it by launching the Warp kernels in
# `kernels/` one after the other, with nothing in between but NumPy. At the end you know what every stage reads and
# writes - **project**, **bin**, **composite**, **lift** - how a pixel comes to its colour and its depth, why lifting
# is the transpose of rendering, and how to use a single kernel in code of your own. The scene is made here, so no data
# is needed; everything runs on the CPU in well under a minute once the kernels are compiled. Equation numbers are those
# of the paper, [Semantic Gaussians](https://arxiv.org/abs/2403.15624).

# %%
import math

import matplotlib.pyplot as plt
import numpy as np
import torch
import warp as wp
from matplotlib.collections import EllipseCollection
from matplotlib.patches import Rectangle

import sgwarp as sg
from sgwarp.kernels import binning_lanes
from sgwarp.kernels.compositing import block as compositing_block
from sgwarp.kernels.compositing import lanes as compositing_lanes
from sgwarp.kernels.compositing import lanes_features as compositing_lanes_features
from sgwarp.kernels.gaussian import Pinhole, Splat
from sgwarp.kernels.harmonics import forward as harmonics
from sgwarp.kernels.lifting import lanes as lifting_lanes
from sgwarp.kernels.lifting import shared as lifting
from sgwarp.kernels.native import GROUP, Seen
from sgwarp.kernels.projection import forward as projection
from sgwarp.kernels.projection import lanes as projection_lanes
from sgwarp.kernels.transmittance import LaneIds, Lanes
from sgwarp.ops.splatting.lifting import (  # only to compare with; importing it starts Warp without its banner
    LiftSums,
    lift_view,
)

wp.set_device("cpu")
plt.rcParams.update({"figure.dpi": 110, "figure.constrained_layout.use": True, "font.size": 9, "axes.titlesize": 10})


def show(ax, image, title, **options):
    """An image without axes."""
    ax.imshow(image if image.ndim == 2 else image.clip(0, 1), **options)
    ax.set_title(title)
    ax.axis("off")


# %% [markdown]
# ## A scene
#
# Four objects, covered with flat Gaussians: a floor that fades out, a ball, a box and a ring. A Gaussian is a centre,
# a rotation (a quaternion, *w* first), three standard deviations, an opacity and colour coefficients. Light and shadow
# are baked into the colours; the ball and the ring also have a sheen that depends on the direction (spherical harmonics
# of degree 1). You can skip the next cell: it only makes the arrays.

# %%
rng = np.random.default_rng(0)
NAMES = ("floor", "ball", "box", "ring")
PALETTE = np.array([(0.62, 0.66, 0.72), (0.93, 0.42, 0.22), (0.10, 0.58, 0.60), (0.55, 0.34, 0.74)])
LIGHT = np.array([-0.45, -0.55, 0.85]) / np.linalg.norm([-0.45, -0.55, 0.85])


def spread(n):
    """n points that fill the unit square evenly (the R2 sequence)."""
    return (0.5 + np.arange(n)[:, None] * np.array([0.7548776662, 0.5698402910])) % 1.0


def placed(points, normals, degrees, position):
    """Turn a shape about the z axis and move it."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    return np.add(points @ turn, position), normals @ turn


def floor(n, half=4.0):
    xy = (2 * spread(n) - 1) * half
    dark = (xy // 0.5).sum(1) % 2 > 0
    colours = np.where(dark[:, None], (0.36, 0.42, 0.50), (0.88, 0.88, 0.85))
    return *placed(np.pad(xy, ((0, 0), (0, 1))), np.tile([0.0, 0, 1], (n, 1)), 0, (0, 0, 0)), colours, 4 * half**2


def ball(n, radius=0.6):
    phi, z = (spread(n) * (2 * math.pi, 2) - (0, 1)).T
    normals = np.column_stack([np.cos(phi) * np.sqrt(1 - z * z), np.sin(phi) * np.sqrt(1 - z * z), z])
    colours = np.where((np.sin(4 * phi + 5 * z) > 0)[:, None], (0.97, 0.90, 0.76), (0.91, 0.38, 0.20))
    return *placed(normals * radius, normals, 0, (-0.70, -0.10, radius)), colours, 4 * math.pi * radius**2


def box(n, half=(0.42, 0.36, 0.52)):
    uv, k = np.repeat(2 * spread(n // 6) - 1, 6, axis=0), np.arange(n)  # the same points on every face
    normals = np.zeros((n, 3))
    normals[k, k % 3] = np.where(k // 3 % 2, 1.0, -1.0)
    points = normals.copy()
    points[k, (k + 1) % 3], points[k, (k + 2) % 3] = uv.T
    colours = np.where(np.abs(uv).max(1, keepdims=True) > 0.86, (0.80, 0.93, 0.90), (0.10, 0.60, 0.62))
    area = 8 * (half[0] * half[1] + half[1] * half[2] + half[2] * half[0])
    return *placed(points * half, normals, 28, (0.45, 0.95, half[2])), colours, area


def ring(n, major=0.42, minor=0.15):
    u, v = 2 * math.pi * spread(n).T
    normals = np.column_stack([np.cos(u) * np.cos(v), np.sin(v), np.sin(u) * np.cos(v)])
    points = normals * minor + major * np.column_stack([np.cos(u), np.zeros(n), np.sin(u)])
    colours = np.where((np.sin(6 * u) > 0)[:, None], (0.58, 0.36, 0.80), (0.44, 0.24, 0.66))
    return *placed(points, normals, -20, (0.55, -0.55, major + minor)), colours, 4 * math.pi**2 * major * minor


shapes = [floor(22000), ball(10000), box(12000), ring(10000)]
points, normals, colours = (np.concatenate([shape[k] for shape in shapes]) for k in range(3))
counts = [len(shape[0]) for shape in shapes]
labels = np.repeat(np.arange(4), counts)
spacing = np.repeat([math.sqrt(shape[3] / len(shape[0])) for shape in shapes], counts)
N = len(points)

# A shadow map seen from the light: a point is lit where nothing lies before it, averaged over nearby cells.
toward_light, cells = points @ LIGHT, points @ np.linalg.svd(LIGHT[None])[2][1:].T / 0.05 + 200
nearest = np.full((400, 400), -np.inf)
np.maximum.at(nearest, tuple(cells.astype(int).T), toward_light)
around = (cells[:, None] + rng.normal(0, 1.2, (1, 24, 2))).astype(int)
lit = (toward_light[:, None] > nearest[around[..., 0], around[..., 1]] - 0.18).mean(1)
colours *= (0.38 + 0.66 * np.maximum(normals @ LIGHT, 0) * lit)[:, None]

quats = np.column_stack([1.001 + normals[:, 2], -normals[:, 1], normals[:, 0], np.zeros(N)])  # turns z into the normal
scales = spacing[:, None] * np.column_stack([rng.uniform(0.5, 0.85, (N, 2)), np.full(N, 0.08)])
fading = np.clip((3.9 - np.linalg.norm(points[:, :2], axis=1)) / 1.4, 0, 1) ** 2
opacities = rng.uniform(0.85, 0.98, N) * np.where(labels == 0, fading, 1)

sh = np.zeros((N, 4, 3))
sh[:, 0] = (colours - 0.5) / 0.28209479
mirrored = (2 * (normals @ LIGHT)[:, None] * normals - LIGHT) * np.isin(labels, (1, 3))[:, None]
sh[:, [3, 1, 2]] = (mirrored * (1, 1, -1))[..., None] * 0.16 / 0.48860251

# A trained scene is never clean: a few rows are not finite, and a few Gaussians have blown up.
quats[rng.choice(N, 40, replace=False), 0] = np.nan
scales[rng.choice(N, 40, replace=False)] = 1e25

means = wp.array(points, dtype=wp.vec3)  # [N] centres [m]
rotations = wp.array(quats, dtype=wp.vec4)  # [N] (w, x, y, z), of any length
deviations = wp.array(scales, dtype=wp.vec3)  # [N] standard deviations [m]
opacity = wp.array(opacities, dtype=float)  # [N]
coefficients = wp.array(sh, dtype=wp.vec3)  # [N, 4] spherical harmonics of degree 0 and 1

fig, axes = plt.subplots(1, 2, figsize=(9, 4.4))
drawn = np.argsort(points[:, 2])  # the highest on top
for ax, paint, title in zip(axes, (colours, PALETTE[labels]), ("baked colours", "labels"), strict=True):
    ax.scatter(*points[drawn, :2].T, c=paint[drawn].clip(0, 1), s=4, alpha=opacities[drawn], linewidths=0)
    ax.set(title=f"{N} Gaussians from above: {title}", xlabel="x [m]", ylabel="y [m]", aspect="equal")
for name, colour in zip(NAMES, PALETTE, strict=True):
    axes[1].scatter([], [], color=colour, label=name)
axes[1].legend(loc="lower right")
plt.show()

# %% [markdown]
# ## A camera
#
# A kernel takes its camera as the struct `Pinhole`: the rotation from the world to the camera (x right, y down, z
# forward), the centre in two floats, so that scenes far from the origin lose no digits, and focal lengths and principal
# point in pixels. `tangent_min` and `tangent_max` bound where the projection is linearised. The rasterizer's
# approximations travel in a second struct, `Knobs`.

# %%
WIDTH, HEIGHT, FOCAL, NEAR, FAR = 640, 400, 540.0, 0.05, 100.0
COLUMNS, ROWS = -(-WIDTH // 16), -(-HEIGHT // 16)
TILES = COLUMNS * ROWS


def pose(azimuth, elevation=24.0, distance=3.1, target=(0.0, 0.05, 0.42)):
    """Rotation and position of a camera that circles the scene; angles in degrees."""
    a, e = math.radians(azimuth), math.radians(elevation)
    forward = -np.array([math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)])
    right = np.array([-math.sin(a), math.cos(a), 0.0])
    return np.stack([right, np.cross(forward, right), forward]), target - distance * forward


def pinhole(rotation, position):
    camera = Pinhole()
    camera.rotation = wp.mat33(*rotation.ravel())
    rounded = position.astype(np.float32)
    camera.center, camera.center_rest = wp.vec3(*rounded), wp.vec3(*(position - rounded))
    camera.focal, camera.principal = wp.vec2(FOCAL, FOCAL), wp.vec2(WIDTH / 2, HEIGHT / 2)
    camera.tangent_max = wp.vec2(0.65 * WIDTH / FOCAL, 0.65 * HEIGHT / FOCAL)
    camera.tangent_min = -camera.tangent_max
    camera.width, camera.height, camera.near, camera.far = WIDTH, HEIGHT, NEAR, FAR
    return camera


knobs = projection.Knobs()
knobs.alpha_min, knobs.alpha_max = 1 / 255, 0.999  # a fainter Gaussian is left out of a pixel; none is fully opaque
knobs.transmittance_min = 1e-4  # a pixel is closed before it lets less through
knobs.dilation = 0.3  # low-pass filter [pixels^2]
knobs.surface_transmittance = 0.5  # 1 - alpha_d: the depth of a pixel is where it has become half opaque
knobs.alpha_min_level = math.log2(knobs.alpha_min)

first_pose, second_pose = pose(-62), pose(38, elevation=30)

# %% [markdown]
# ## Project
#
# `project_groups` takes 16 Gaussians at a time, one to a lane (on CUDA `project_gaussians` takes one): it builds
# $\Sigma = R S S^T R^T$ (eq. 3) and its image $\Sigma' = J W \Sigma W^T J^T$ (eq. 2), and decides whether any pixel can
# see the result. `base`, the first argument of every kernel that the CPU runs in chunks, is the first index of the
# launch; `sgwarp.ops` uses it to share a launch among threads, here it is 0. Outputs come last and end in `_out`.


# %%
def project(camera):
    splats, status, depths = wp.zeros(N, dtype=Splat), wp.zeros(N, dtype=wp.uint8), wp.zeros(N, dtype=float)
    inputs = [0, means, rotations, deviations, opacity, coefficients, -1, camera, knobs]  # -1: no colours yet
    invalid = wp.zeros(1, dtype=int)  # set if some scale is negative, or an opacity outside [0, 1]
    wp.launch(projection_lanes.project_groups, -(-N // GROUP), inputs, [splats, status, depths, invalid])
    return splats, status, depths


camera = pinhole(*first_pose)
splats, status, depths = project(camera)
culled = {name: int((status.numpy() == k).sum()) for k, name in enumerate(projection.STATUS_NAMES)}
print(culled)

# %% [markdown]
# Green is what the camera keeps: the part of the floor inside the outline of the image, and what stands on it. The
# faded rim of the floor is too transparent to reach any pixel; a sliver lies behind the camera (the dot). Rows that are
# not finite (red) and Gaussians whose image overflows (black) are told apart and stay in the arrays, so that indices
# never shift.

# %%
STATUS_COLOURS = np.array(["#2f9e6e", "#d62728", "#c9c9d2", "#e8a33d", "#5b8def", "#222222"])
fig, (left, right) = plt.subplots(1, 2, figsize=(9.6, 4.2), width_ratios=(1.25, 1))
for k, name in enumerate(projection.STATUS_NAMES):
    rare = {"s": 40, "marker": "x", "linewidths": 1.2} if name in ("non_finite", "degenerate") else {"linewidths": 0}
    left.scatter(*points[status.numpy() == k, :2].T, c=STATUS_COLOURS[k], **{"s": 2, **rare})
rotation, position = first_pose
corners = np.array([(-WIDTH, -HEIGHT), (WIDTH, -HEIGHT), (WIDTH, HEIGHT), (-WIDTH, HEIGHT)]) / (2 * FOCAL)
rays = np.column_stack([corners, np.ones(4)]) @ rotation
left.fill(*(position - rays * (position[2] / rays[:, 2:]))[:, :2].T, fill=False, linewidth=0.9)  # where they meet z = 0
left.plot(*position[:2], marker="o", color="black", markersize=7)
left.set(title="from above: what the camera keeps", xlabel="x [m]", ylabel="y [m]", aspect="equal")
left.set(xlim=(-4.3, 4.3), ylim=(-4.3, 4.3))
right.bar_label(right.barh(projection.STATUS_NAMES, list(culled.values()), color=STATUS_COLOURS), padding=3)
right.set(title="status", xscale="log", xlim=(10, 3e5), xlabel="Gaussians")
right.invert_yaxis()
plt.show()

# %% [markdown]
# ## The splats
#
# A `Splat` is an ellipse in pixels: $\alpha(d) = 2^{\,level - u^2 - v^2}$ with $u = a\,d_x + b\,d_y$ and
# $v = c\,d_y$, the Cholesky factor of $\Sigma'^{-1}$. Painting the one-sigma ellipses from back to front already gives
# the picture. A footprint, which ends where alpha falls below `alpha_min`, is some three times as wide.


# %%
def front_to_back(status, depths):
    """The visible Gaussians by (depth, index)."""
    visible = np.flatnonzero(status.numpy() == projection.VISIBLE)
    return visible[np.argsort(depths.numpy()[visible], kind="stable")]


def draw_ellipses(ax, splats, q, **style):
    """Add the contours u^2 + v^2 = q to an axis in pixels."""
    factors = np.zeros((len(splats), 2, 2))
    factors[:, 0, 0], factors[:, 0, 1], factors[:, 1, 1] = splats["a"], splats["b"], splats["c"]
    axes, lengths, _ = np.linalg.svd(np.linalg.inv(factors))
    size, angles = 2 * np.sqrt(q) * lengths.T, np.degrees(np.arctan2(axes[:, 1, 0], axes[:, 0, 0]))
    where = {"units": "xy", "offsets": splats["mean"], "offset_transform": ax.transData}
    ax.add_collection(EllipseCollection(*size, angles, **where, **style))


ONE_SIGMA = 0.5 * math.log2(math.e)
order = front_to_back(status, depths)
ordered = splats.numpy()[order]
reach = ordered["level"] - knobs.alpha_min_level  # u^2 + v^2 at the border of the footprint

fig, (left, right) = plt.subplots(1, 2, figsize=(11, 3.8), width_ratios=(1.2, 1))
face = np.column_stack([colours[order].clip(0, 1), opacities[order]])
draw_ellipses(left, ordered[::-1], ONE_SIGMA, facecolors=face[::-1])
left.set(xlim=(0, WIDTH), ylim=(HEIGHT, 0), title=f"{len(order)} visible splats, one sigma, back to front")
draw_ellipses(right, ordered[::-1], ONE_SIGMA, facecolors=face[::-1], edgecolors=(1, 1, 1, 0.5), linewidths=0.4)
left.add_patch(Rectangle((250, 150), 80, 56, fill=False))
framed = (np.abs(ordered["mean"] - (290, 178)) < (40, 28)).all(1)
some = np.flatnonzero(framed)[:400:20]
draw_ellipses(right, ordered[some], reach[some], facecolors="none", edgecolors="black", linewidths=0.9)
right.set(xlim=(250, 330), ylim=(206, 150), title="the framed part; black: the footprints of twenty")
for ax in (left, right):
    ax.set(aspect="equal", xlabel="x [pixels]", ylabel="y [pixels]")
plt.show()

# %% [markdown]
# ## Bin
#
# Tiles are 16 x 16 pixels. `count_tiles` brings the splats into depth order and counts, `fill_tiles` writes their
# *ranks*, places in that order, into the lists of their tiles, front to back: no list is ever sorted. Both work on
# slices of the order; one is enough here. Copies of the splats in the lists would cost more to write than reading
# front to back saves: a splat is one line of the cache, asked for six places ahead (`prefetch`).


# %%
def starts(counts):
    """First place of each group, and the total at the end."""
    return np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)


def bin_splats(camera, splats, status, depths):
    order = wp.array(front_to_back(status, depths), dtype=int)
    count = len(order)
    colors, ordered = wp.zeros(count, dtype=wp.vec3), wp.zeros(count, dtype=Splat)
    wp.launch(harmonics.evaluate_harmonics, count, [0, order, means, coefficients, 1, camera], [colors])
    cursors, totals = wp.zeros((1, TILES), dtype=int), wp.zeros((2, 2), dtype=wp.int64)
    sizes = [count, WIDTH, HEIGHT]
    spans = wp.zeros(2 * count, dtype=wp.uint64)  # columns that a splat touches, kept for filling the lists
    rows, patches = wp.zeros(count, dtype=int), wp.zeros(count, dtype=int)  # the tile rows; for gradients
    nothing = wp.zeros((0, 2), dtype=int)  # rows of sums: only gradients need them
    outputs = [ordered, cursors, totals, spans, rows, patches, nothing]
    wp.launch(binning_lanes.count_tiles, 1, [0, order, splats, colors, *sizes], outputs)
    offsets = wp.zeros(TILES + 1, dtype=int)
    wp.launch(binning_lanes.place_slices, 1, [0], [cursors, totals, offsets])
    listed, places, tiles = (wp.zeros(int(offsets.numpy()[-1]), dtype=int) for _ in range(3))
    lists = {
        "order": order,  # [V] Gaussians front to back
        "splats": ordered,  # [V] likewise
        "offsets": offsets,  # [tiles + 1] first place of each tile
        "listed": listed,  # [I] the lists: ranks, tile by tile
        "entries": wp.zeros(count + 1, dtype=int),  # [V + 1] first entry of each, one per tile
        "places": places,  # [I] place of each entry
        "tiles": tiles,  # [I] tile of each entry
    }
    inputs = [0, order, ordered, *sizes, totals, spans, rows, patches, cursors]
    wp.launch(binning_lanes.fill_tiles, 1, inputs, [listed, lists["entries"], places, tiles, nothing, nothing])
    return lists


lists = bin_splats(camera, splats, status, depths)
per_tile = np.diff(lists["offsets"].numpy()).reshape(ROWS, COLUMNS)

# %% [markdown]
# Crowded tiles are those where a surface is seen at a slant, or several lie behind each other. On the right, the splat
# for which the exact test saves most: its bounding box would put it into the hatched tiles too, but it reaches no pixel
# of theirs.

# %%
half = np.column_stack([ordered["half_width"], ordered["half_height"]])
first = np.ceil((ordered["mean"] - half).clip(0) - 0.5).astype(int) // 16
last = np.floor(np.minimum(ordered["mean"] + half, (WIDTH, HEIGHT)) - 0.5).astype(int) // 16
in_box = (last - first + 1).prod(1)
one = int(np.argmax(in_box - np.diff(lists["entries"].numpy())))
touched = lists["tiles"].numpy()[slice(*lists["entries"].numpy()[one : one + 2])]

fig, (left, right) = plt.subplots(1, 2, figsize=(11, 3.9), width_ratios=(1.6, 1))
crowd = left.imshow(per_tile, cmap="magma", extent=(0, WIDTH, HEIGHT, 0))
fig.colorbar(crowd, ax=left, label="splats", shrink=0.9)
left.set_title(f"{len(order)} splats, {per_tile.sum()} ranks in {TILES} lists, at most {per_tile.max()} in one")
for row in range(first[one, 1], last[one, 1] + 1):
    for column in range(first[one, 0], last[one, 0] + 1):
        reached = row * COLUMNS + column in touched
        style = {"facecolor": "#cfe8d8"} if reached else {"facecolor": "none", "hatch": "///", "edgecolor": "0.8"}
        right.add_patch(Rectangle((16 * column, 16 * row), 16, 16, **style))
draw_ellipses(right, ordered[[one]], reach[[one]], facecolors=(1, 0.55, 0, 0.45), edgecolors="#d95f02", linewidths=1.5)
right.add_patch(Rectangle(ordered["mean"][one] - half[one], *2 * half[one], fill=False, linestyle="--"))
low, high = 16 * first[one], 16 * last[one] + 16
right.set(xlim=(low[0] - 8, high[0] + 8), ylim=(high[1] + 8, low[1] - 8), aspect="equal")
right.set(xticks=np.arange(low[0], high[0] + 1, 16), yticks=np.arange(low[1], high[1] + 1, 16))
right.grid(color="0.6", linewidth=0.6)
right.set_title(f"one splat: {len(touched)} tiles touched, {in_box[one]} in its box")
plt.show()

# %% [markdown]
# ## Composite
#
# One thread walks a tile's list front to back and adds $c_i\,\alpha_i\,T_i$ to every pixel, where
# $T_i = \prod_{j<i} (1 - \alpha_j)$ is the light that the Gaussians in front let through (eq. 1). This is the *lane*
# schedule, made for CPUs: 16 pixels of a row are one vector. `make_composite_colors(True, False)` keeps both depths,
# but not what training needs (`None`); the rest is scratch, one slot for each host thread: the state of every row, and
# 32 splats at a time as the tile sees them, with the rows that they reach.


# %%
def batch():
    """Scratch for 32 splats as a tile sees them, and for the rows that each reaches: 16 bits, two in an integer."""
    return wp.zeros((1, 32), dtype=Seen), wp.zeros((1, 16), dtype=int)


def composite(lists):
    """Colours, transmittance, accumulated opacity, sum of alpha T z and the depth of the surface."""
    outputs = [wp.zeros((HEIGHT, WIDTH), dtype=kind) for kind in (wp.vec3, float, float, float, float)]
    state = wp.zeros((1, 16, 6), dtype=Lanes)
    inputs = [0, 0, lists["offsets"], lists["listed"], lists["splats"], knobs, WIDTH, HEIGHT, state, *batch()]
    wp.launch(compositing_lanes.make_composite_colors(True, False), TILES, inputs, [*outputs, None, None])
    return [output.numpy() for output in outputs]


def over_backdrop(image, transmittance):
    """The image before a sky, which shows through what is left of T."""
    return image + transmittance[..., None] * np.linspace((0.80, 0.86, 0.93), (0.97, 0.97, 0.96), HEIGHT)[:, None]


image, transmittance, accumulated, depth_sum, surface = composite(lists)
fig, axes = plt.subplots(1, 2, figsize=(11, 3.6))
show(axes[0], over_backdrop(image, transmittance), "colour, over a backdrop seen through what is left of T")
show(axes[1], accumulated, "accumulated opacity 1 - T", cmap="gray", vmin=0, vmax=1)
plt.show()

# %% [markdown]
# The same image through the package's front door: `sg.render` launches the same kernels, from as many host threads as
# there are cores. Threads write disjoint memory, so their number changes no bit.

# %%
gaussians = sg.Gaussians(*(torch.tensor(a, dtype=torch.float32) for a in (points, quats, scales, opacities, sh)))
world_to_camera = np.eye(4)
world_to_camera[:3, :3], world_to_camera[:3, 3] = rotation, -rotation @ position
K = torch.tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
same_camera = sg.Camera(K, torch.from_numpy(world_to_camera), WIDTH, HEIGHT, near=NEAR, far=FAR)
difference_to_render = float(np.abs(sg.render(gaussians, same_camera).numpy() - image).max())
print(f"largest difference to sg.render: {difference_to_render:.1e}")

# %% [markdown]
# ### One ray
#
# What happens at one pixel, in plain NumPy from the list of its tile. Every Gaussian takes its share
# $\alpha_i T_i$ of the light that the ones in front let through: a step of the line, drawn in its own colour. The
# paper's depth is $z$ of the Gaussian at which accumulated opacity passes $\alpha_d$ = 0.5: here the ring, although a
# good part of the light comes from the floor behind it.

# %%
column, row = 369, 193  # on the inner edge of the ring
tile = (row // 16) * COLUMNS + column // 16
ranks = lists["listed"].numpy()[slice(*lists["offsets"].numpy()[tile : tile + 2])]
ray = lists["splats"].numpy()[ranks]
dx, dy = (np.float32([column + 0.5, row + 0.5]) - ray["mean"]).T
u, v = ray["a"] * dx + ray["b"] * dy, ray["c"] * dy
alpha = np.minimum(np.exp2(ray["level"] - u**2 - v**2), knobs.alpha_max)
ray, alpha = ray[alpha >= knobs.alpha_min], alpha[alpha >= knobs.alpha_min]
T = np.concatenate([[1], np.cumprod(1 - alpha)])
T = T[T > knobs.transmittance_min]  # the pixel is closed behind the last of them
ray, share = ray[: len(T) - 1], -np.diff(T)  # alpha T is what T loses
ray_error = float(np.abs(share @ ray["color"] - image[row, column]).max())

fig, axes = plt.subplots(1, 2, figsize=(11, 3.4), width_ratios=(1, 2))
show(axes[0], image[row - 24 : row + 25, column - 24 : column + 25], "the pixel")
axes[0].add_patch(Rectangle((23.5, 23.5), 1, 1, fill=False, edgecolor="white"))
axes[1].step([ray["depth"][0] - 0.1, *ray["depth"], ray["depth"][-1] + 0.1], [*T, T[-1]], where="post", color="0.6")
axes[1].vlines(ray["depth"], T[1:], T[:-1], color=ray["color"].clip(0, 1), linewidth=6)
axes[1].axvline(surface[row, column], color="#d62728", linestyle="--", label=r"depth: $T \leq 1 - \alpha_d$")
axes[1].axvline(share @ ray["depth"] / share.sum(), color="#1f77b4", linestyle=":", label="expected depth")
axes[1].set(xlabel="depth z [m]", ylabel="light let through, T", ylim=(0, 1.02))
axes[1].set_title(f"{len(ray)} of {len(ranks)} splats reach it; difference to the kernel {ray_error:.0e}")
axes[1].legend()
plt.show()

# %% [markdown]
# ### Depth
#
# Both depths come from the same walk. The surface depth jumps from one object to the next; the expected depth
# $\sum \alpha T z \,/ \sum \alpha T$ blends them, so at edges it lies in the empty space between.

# %%
covered = transmittance < 0.5
expected = np.divide(depth_sum, accumulated, out=np.full_like(depth_sum, np.nan), where=covered)
seen_depth = np.where(covered, surface, np.nan)
fig, axes = plt.subplots(1, 2, figsize=(11, 3.5))
show(axes[0], seen_depth, "depth of the surface [m]", cmap="viridis_r")
show(axes[1], expected - seen_depth, "expected depth - depth of the surface [m]", cmap="RdBu", vmin=-0.3, vmax=0.3)
for ax in axes:
    fig.colorbar(ax.images[0], ax=ax, shrink=0.9)
plt.show()

# %% [markdown]
# ### The other schedule
#
# On CUDA a *block* of 256 threads owns a tile, one thread for each pixel, and stages the splats through shared memory.
# The maths is the same, and so is the picture. Without a GPU, Warp can run a block as cooperative fibers on the CPU:
# slow, but enough for a crop, which is nothing but a choice of tile lists, and splats moved by its corner.

# %%
crop = (slice(112, 192), slice(240, 400))
kept_tiles = np.arange(TILES).reshape(ROWS, COLUMNS)[7:12, 15:25].ravel()
kept = [lists["listed"].numpy()[slice(*lists["offsets"].numpy()[t : t + 2])] for t in kept_tiles]
kept_offsets, kept_lists = wp.array(starts([len(piece) for piece in kept])), wp.array(np.concatenate(kept))
moved = lists["splats"].numpy().copy()
moved["mean"] -= (240, 112)

block = [wp.zeros((80, 160), dtype=kind) for kind in (wp.vec3, float, float, float, float)]
kernel = compositing_block.make_composite_colors_block(True, False)
wp.config.enable_cpu_blocks = True
inputs = [kept_offsets, kept_lists, wp.array(moved, dtype=Splat), knobs, 160, 80]
wp.launch_tiled(kernel, dim=[len(kept)], inputs=inputs, outputs=[*block, None, None], block_dim=256)
wp.config.enable_cpu_blocks = False

lanes = (image, transmittance, accumulated, depth_sum, surface)
pairs = [(lane[crop], other.numpy()) for lane, other in zip(lanes, block, strict=True)]
lane_block_difference = max(float(np.abs(lane - other).max()) for lane, other in pairs)
fig, axes = plt.subplots(1, 3, figsize=(11, 2.3))
show(axes[0], pairs[0][0], "lanes")
show(axes[1], pairs[0][1], "block, on CPU fibers")
show(axes[2], np.abs(pairs[0][0] - pairs[0][1]).max(-1), "largest difference of a channel", cmap="magma")
fig.colorbar(axes[2].images[0], ax=axes[2], shrink=0.8)
plt.show()

# %% [markdown]
# ## Lift
#
# Rendering is a matrix: $A$ has one row per pixel, one column per Gaussian, and the entries $\alpha_i T_i$. What a
# Gaussian should carry, given features $f$ of the pixels, is the mean of $f$ under the weights of its column: the sums
# $A^T f$ divided by $A^T 1$. So lifting walks the same lists as compositing, with the same weights, in the other
# direction.
#
# ### Labels of one view
#
# First, features go the usual way, from Gaussians to pixels: `make_composite_features` blends any number of channels,
# in slices of 16. Blending one-hot labels and taking the largest stands in for a 2D segmentation model here.


# %%
def in_lanes(values):
    """Up to 16 channels as one vector: [..., C] to an array of Lanes [..., 1]."""
    padding = [(0, 0)] * (values.ndim - 1) + [(0, 16 - values.shape[-1])]
    return wp.array(np.pad(values, padding).astype(np.float32)[..., None, :], dtype=Lanes)


def composite_features(lists, features):
    """Blend up to 16 channels per Gaussian, [N, C], into an image [H, W, C]."""
    blended = wp.zeros((HEIGHT, WIDTH, features.shape[1]), dtype=float)
    transmittance, accumulated = (wp.zeros((HEIGHT, WIDTH), dtype=float) for _ in range(2))
    scratch = [wp.zeros((1, 16, 17), dtype=Lanes), *batch()]
    slices = in_lanes(features).reshape((N, 1, 1))
    inputs = [0, 0, lists["offsets"], lists["listed"], lists["splats"], slices, 0, knobs, WIDTH, HEIGHT, *scratch]
    outputs = [blended, transmittance, accumulated, None]
    wp.launch(compositing_lanes_features.make_composite_features(1, False), TILES, inputs, outputs)
    return blended.numpy()


def largest(image):
    """Channel with the largest value, -1 where all of them together are small."""
    return np.where(image.sum(-1) > 0.5, image.argmax(-1), -1)


one_hot = np.eye(len(NAMES))[labels]
first_labels = largest(composite_features(lists, one_hot))

# %% [markdown]
# Walking the pixels of an id map costs the same whether an id stands for one of 4 classes or for a vector of 512
# channels, because only weights are summed:
#
# 1. `localize_ids` lists the distinct ids of each tile;
# 2. `lift_ids` walks each tile once and writes one weight for every (place, id);
# 3. `sum_id_weights` adds them up, one thread per Gaussian, found through `places`. Threads write disjoint memory,
#    so no atomic additions are needed, and the sums have the same bits every time.


# %%
def lift_ids(lists, id_map, classes):
    """Weight of every class for each Gaussian, [N, classes]."""
    tile_ids, counts = wp.zeros((TILES, 256), dtype=int), wp.zeros(TILES, dtype=int)
    local_ids, uniform = wp.zeros((TILES, 16), dtype=LaneIds), wp.zeros((TILES, 16), dtype=int)
    every_tile = wp.empty(0, dtype=int)
    inputs = [0, every_tile, wp.array(id_map, dtype=int), WIDTH, HEIGHT]
    wp.launch(lifting.localize_ids, TILES, inputs, [tile_ids, counts, local_ids, uniform])
    row_starts = starts(np.diff(lists["offsets"].numpy()) * counts.numpy())
    weights, first_weights = wp.zeros(int(row_starts[-1]), dtype=float), wp.zeros(len(lists["tiles"]), dtype=int)
    state = wp.zeros((1, 16, 1), dtype=Lanes)
    inputs = [0, 0, every_tile, lists["offsets"], lists["listed"], lists["splats"]]
    inputs += [local_ids, uniform, wp.array(row_starts)]
    wp.launch(lifting_lanes.lift_ids, TILES, [*inputs, knobs, WIDTH, HEIGHT, state], [weights, first_weights])
    sums = [wp.zeros((N, classes), dtype=float), wp.zeros(N, dtype=float), wp.zeros(N, dtype=float)]
    inputs = [0, lists["order"], lists["entries"], lists["places"], first_weights, lists["tiles"]]
    wp.launch(lifting.sum_id_weights, len(lists["order"]), [*inputs, tile_ids, counts, weights, 1], sums)
    return sums[0].numpy()


def mean_under(weights, sums, least):
    """Sums divided by weights [N]; zero, and so unknown, where the weight does not exceed `least` [pixels]."""
    return np.divide(sums, weights[:, None], out=np.zeros_like(sums), where=(weights > least)[:, None])


id_weights = lift_ids(lists, first_labels, len(NAMES))
second = pinhole(*second_pose)
second_lists = bin_splats(second, *project(second))
second_picture = over_backdrop(*composite(second_lists)[:2])
second_truth = largest(composite_features(second_lists, one_hot))

# %% [markdown]
# From a second camera one sees how far the labels of the first reach. What it never saw is unknown (white). But no
# surface is quite opaque: the floor behind the ring has got a trickle of weight through the ring, and with it the label
# "ring", as if cast by a lamp. The total weight tells the two apart: a Gaussian that showed in a tenth of a pixel or
# less had better stay unknown.

# %%
coloured = np.vstack([PALETTE, (1, 1, 1)])  # the last row is for -1
label_accuracies = []
fig, axes = plt.subplots(2, 2, figsize=(10, 6.6))
show(axes[0, 0], coloured[first_labels], "labels of the first view: the input")
show(axes[0, 1], second_picture, "second view")
for ax, least in zip(axes[1], (0.0, 0.1), strict=True):
    found = largest(composite_features(second_lists, mean_under(id_weights.sum(1), id_weights, least)))
    known = (found >= 0) & (second_truth >= 0)
    label_accuracies.append(float((found == second_truth)[known].mean()))
    show(ax, coloured[found], f"lifted, weight > {least} pixels: {label_accuracies[-1]:.1%} of the known are right")
plt.show()

# %% [markdown]
# ### Dense features of several views
#
# A vision-language model gives every pixel a vector, noisy and sometimes wrong, differently in every view. Here each
# class has a unit vector of 16 channels; a pixel gets the vector of its class, or in a quarter of the cells of 20 x 20
# pixels that of a random class, plus noise. `make_lift_dense` sums $\alpha_i T_i f$ over the pixels of a tile,
# `sum_rows` and `sum_weights` add up the tiles of a Gaussian. `find_center_pixels` is the paper's own projection, for
# comparison: a Gaussian takes the feature at the pixel of its centre, if the depth there is its own.

# %%
VIEWS = 12
CHANNELS = 16
vectors = np.linalg.qr(rng.normal(size=(CHANNELS, len(NAMES))))[0].T  # [4, 16], orthonormal


def noisy_features(classes):
    """What a model might say about a view, [H, W, 16]; zero where there is nothing."""
    cells = (HEIGHT // 20, WIDTH // 20)
    wrong = np.where(rng.random(cells) < 0.25, rng.integers(0, len(NAMES), cells), -1)
    wrong = wrong.repeat(20, axis=0).repeat(20, axis=1)
    features = vectors[np.where(wrong >= 0, wrong, classes)] + rng.normal(0, 0.35, (HEIGHT, WIDTH, CHANNELS))
    return np.where(classes[..., None] >= 0, features, 0).astype(np.float32)


def lift_dense(lists, features, valid):
    """Sums A^T f [N, 16] and A^T 1 [N] over the valid pixels of a view."""
    total, visible = len(lists["tiles"]), len(lists["order"])
    mask = wp.array(valid.astype(np.float32).reshape(HEIGHT, COLUMNS, 1, 16), dtype=Lanes)  # WIDTH is 16 COLUMNS
    rows, weights = wp.zeros((total, 1), dtype=Lanes), wp.zeros(total, dtype=float)
    state = wp.zeros((1, 16, 1), dtype=Lanes)
    inputs = [0, 0, lists["offsets"], lists["listed"], lists["splats"], in_lanes(features), mask, 0, knobs]
    wp.launch(lifting_lanes.make_lift_dense(1), TILES, [*inputs, WIDTH, HEIGHT, state], [rows, weights])
    sums, weight, squared = wp.zeros((N, 1), dtype=Lanes), wp.zeros(N, dtype=float), wp.zeros(N, dtype=float)
    own = [0, lists["order"], lists["entries"], lists["places"]]
    wp.launch(lifting.sum_rows, visible, [*own, rows, 0, 1], [sums])
    wp.launch(lifting.sum_weights, visible, [*own, weights], [weight, squared])
    return sums.numpy()[:, 0], weight.numpy()


def seen_centers(splats, status, surface, tau=0.05, border=10):
    """Gaussians whose centre lies on the surface that the depth shows, bool [N]."""
    pixels = wp.zeros(N, dtype=int)
    inputs = [0, splats, status, wp.array(surface, dtype=float), tau, border]
    wp.launch(lifting.find_center_pixels, N, inputs, [pixels])
    return pixels.numpy() >= 0


feature_sum, weight_sum, centers_seen = np.zeros((N, CHANNELS)), np.zeros(N), np.zeros(N, dtype=bool)
coverage = {"weighted": [], "weighted, over 0.1 pixels": [], "centre": []}
showable = np.isfinite(quats).all(1) & (opacities >= knobs.alpha_min)
for k in range(VIEWS):
    camera = pinhole(*pose(-62 + 137.5 * k))  # the golden angle goes around evenly, wherever one stops
    projected = project(camera)
    lists = bin_splats(camera, *projected)
    classes = largest(composite_features(lists, one_hot))
    features = noisy_features(classes)
    sums, weight = lift_dense(lists, features, classes >= 0)
    feature_sum, weight_sum = feature_sum + sums, weight_sum + weight
    centers_seen |= seen_centers(*projected[:2], composite(lists)[4])
    for name, seen in zip(coverage, (weight_sum > 0, weight_sum > 0.1, centers_seen), strict=True):
        coverage[name].append(float(seen[showable].mean()))
    if k == 0:
        first_view = (lists, features, classes, sums, weight)

# %% [markdown]
# A query is a vector, too: its cosine to the features says where "ring" is. One view is speckled and wrong in blocks;
# the mean of twelve, rendered from a camera that is none of them, has forgotten the noise and outvoted most of the
# blocks.

# %%
lists, features, classes, *_ = first_view
semantics = mean_under(weight_sum, feature_sum, 0.1)
rows = (
    ("one view, as the model sees it", features, classes),
    (f"{VIEWS} views, lifted", composite_features(second_lists, semantics), second_truth),
)
class_accuracies = []
fig, axes = plt.subplots(2, 2, figsize=(10, 6.3))
for (title, found, truth), (left, right) in zip(rows, axes, strict=True):
    along, length = found @ vectors.T, np.linalg.norm(found, axis=-1)  # how much of each class's vector
    known = (truth >= 0) & (length > 0.3)
    class_accuracies.append(float((along.argmax(-1) == truth)[known].mean()))
    mixed = np.where(known[..., None], along.clip(0, 1) @ PALETTE, 1)
    show(left, mixed, f"{title}: {class_accuracies[-1]:.1%} of the classes right")
    cosine = np.divide(along[..., NAMES.index("ring")], length, out=np.full(length.shape, np.nan), where=known)
    show(right, cosine, 'cosine to "ring"', vmin=0, vmax=1)
    fig.colorbar(right.images[0], ax=right, shrink=0.9)
plt.show()

# %% [markdown]
# ### Coverage
#
# Weighted lifting soon reaches every Gaussian that takes part in some pixel, hidden ones included; the paper's centre
# pixel reaches only those whose own centre shows. What no view has seen (red) has no semantics, and must not get any
# by accident.

# %%
fig, axes = plt.subplots(1, 3, figsize=(12, 2.8), width_ratios=(1.15, 1.2, 1.2))
for (name, shares), style, colour in zip(coverage.items(), "o^s", ("#9ad1b5", "#2f9e6e", "#e8a33d"), strict=True):
    axes[0].plot(np.arange(1, VIEWS + 1), shares, marker=style, color=colour, label=name, markersize=4)
axes[0].set(xlabel="views", ylabel="share of the Gaussians", ylim=(0, 1.05), title="coverage")
axes[0].legend(loc="lower right")
grey = second_picture.mean(-1, keepdims=True)
for ax, weight, title in zip(axes[1:], (first_view[-1], weight_sum), ("1 view", f"{VIEWS} views"), strict=True):
    unseen = 0.8 * composite_features(second_lists, (weight <= 0.1)[:, None])
    show(ax, grey * (1 - unseen) + unseen * (0.85, 0.1, 0.1), f"unseen after {title}")
plt.show()

# %% [markdown]
# ### Two checks
# That lifting is the transpose of rendering takes one number to see:
# $\langle A x, y \rangle = \langle x, A^T y \rangle$ for random $x$ and $y$.
# `sgwarp.ops.splatting.lifting` launches the same kernels, so it gives the same sums.

# %%
x, y = rng.normal(size=(N, CHANNELS)), rng.normal(size=(HEIGHT, WIDTH, CHANNELS))
forward = composite_features(lists, x) * y
back = lift_dense(lists, y, np.ones((HEIGHT, WIDTH)))[0] * x
transpose_gap = float(abs(forward.sum() - back.sum()) / np.abs(forward).sum())

by_package = LiftSums.zeros(N, CHANNELS)
dense, valid = torch.from_numpy(features), torch.from_numpy(classes >= 0)
lift_view(gaussians, same_camera, sg.FeatureMap(space="toy", dense=dense, valid=valid), by_package)
by_hand = first_view[3]
difference_to_lift = float(np.abs(by_package.features.numpy() - by_hand).max() / np.abs(by_hand).max())
print(f"<A x, y> and <x, A' y> differ by {transpose_gap:.1e} of their size")
print(f"largest difference to ops.lift: {difference_to_lift:.1e} of the largest sum")

# %% [markdown]
# ## On your own
#
# - Set `knobs.alpha_min` to 0.05 and look at the length of the lists and at the difference to the image above.
# - Paint the first 10, 20, 50 splats of every tile: shorten the lists as the crop did.
# - Move `knobs.surface_transmittance`: how does the paper's depth change at edges and on the thin rim of the floor?
# - Lift the colours of the first view as features and render them from the second: what happens to the sheen?
# - Replace `noisy_features` by the maps of a real model, and this scene by `sg.load_gaussians("scene.ply")`.
#
# `kernels/README.md` lists every kernel with what it reads and writes. `sgwarp/ops/` holds the host side of what was
# done here, for torch tensors, any image size and any number of threads; `sg.lift`, `sg.query` and `sg.segment` stand
# on top.
