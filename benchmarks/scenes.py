"""A synthetic furnished room of n Gaussians, a camera in it, and tile lists made without the package's kernels."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch

from sgwarp.ops.reference.rasterizer import ReferenceSettings, project_scene, spherical_harmonics
from sgwarp.scene import Camera, Gaussians

TILE = 16  # side of a tile [pixels]
ROOM = (6.0, 2.7, 5.0)  # width (x), height (y, pointing down), depth (z) of the room [m]
SPREAD = 1.1  # tangential standard deviation over the mean spacing of the Gaussians of a surface
LABELS = ("floor", "ceiling", "wall", "table", "sofa", "cabinet", "shelf", "stool", "lamp")

# Boxes: label, centre and size [m]. Balls: label, centre and radius [m].
BOXES = (
    ("table", (3.2, 2.0, 3.0), (1.6, 0.08, 0.9)),
    ("table", (3.2, 2.35, 3.0), (0.2, 0.7, 0.2)),
    ("sofa", (1.1, 2.35, 3.4), (0.9, 0.7, 2.0)),
    ("sofa", (0.8, 1.9, 3.4), (0.3, 0.9, 2.0)),
    ("cabinet", (5.6, 1.7, 3.6), (0.7, 2.0, 1.4)),
    ("shelf", (3.0, 1.0, 4.85), (2.4, 0.06, 0.3)),
    ("shelf", (3.0, 1.4, 4.85), (2.4, 0.06, 0.3)),
)
BALLS = (
    ("stool", (2.3, 2.4, 2.2), 0.3),
    ("stool", (4.2, 2.4, 2.1), 0.3),
    ("lamp", (3.2, 1.0, 3.0), 0.22),
)


@dataclass(frozen=True, eq=False)
class Projected:
    """What compositing reads, numpy. `order` maps the M rows back to the scene's Gaussians.

    Attributes:
        mean2d: [pixels], float32 [M, 2].
        conic: a, b, c [1 / pixels^2], float32 [M, 3].
        opacity: float32 [M].
        color: float32 [M, 3].
        offsets: First entry of each tile in `ids`, row-major, int32 [tiles + 1].
        ids: Rows that reach each tile, front to back, int32 [intersections].
        order: int64 [M].
        width, height: Of the image [pixels].
    """

    mean2d: np.ndarray
    conic: np.ndarray
    opacity: np.ndarray
    color: np.ndarray
    offsets: np.ndarray
    ids: np.ndarray
    order: np.ndarray
    width: int
    height: int


@dataclass(frozen=True, eq=False)
class Surface:
    """A labelled parallelogram centre +- u +- v [m], or, without u and v, a sphere around the centre."""

    label: str
    centre: np.ndarray
    u: np.ndarray | None = None
    v: np.ndarray | None = None
    radius: float = 0.0

    @property
    def area(self) -> float:
        if self.u is None or self.v is None:
            return 4 * math.pi * self.radius**2
        return 4 * float(np.linalg.norm(np.cross(self.u, self.v)))

    def sample(self, rng: np.random.Generator, n: int) -> tuple[np.ndarray, np.ndarray]:
        """n uniform points and their unit normals, [n, 3] each."""
        if self.u is None or self.v is None:
            normals = rng.normal(size=(n, 3))
            normals /= np.linalg.norm(normals, axis=1, keepdims=True)
            return self.centre + self.radius * normals, normals
        a, b = rng.uniform(-1, 1, (2, n, 1))
        normal = np.cross(self.u, self.v)
        return self.centre + a * self.u + b * self.v, np.tile(normal / np.linalg.norm(normal), (n, 1))


def _box(label: str, centre: tuple[float, ...], size: tuple[float, ...]) -> list[Surface]:
    """The six sides of a box; those of the room itself are its ceiling, floor and walls."""
    half = np.diag(np.asarray(size) / 2)
    surfaces = []
    for axis in range(3):
        for sign in (-1, 1):
            name = label
            if label == "room":
                name = "wall" if axis != 1 else "floor" if sign > 0 else "ceiling"
            surfaces.append(Surface(name, np.asarray(centre) + sign * half[axis], half[axis - 1], half[axis - 2]))
    return surfaces


def _surfaces() -> list[Surface]:
    surfaces = _box("room", tuple(x / 2 for x in ROOM), ROOM)
    for label, centre, size in BOXES:
        surfaces += _box(label, centre, size)
    return surfaces + [Surface(label, np.asarray(centre), radius=radius) for label, centre, radius in BALLS]


def _facing(normals: np.ndarray, spin: np.ndarray) -> np.ndarray:
    """Quaternions (w, x, y, z) that turn the z axis to `normals` after a turn by `spin` about z."""
    x, y, z = normals.T
    tilt = np.stack([1 + z, -y, x, np.zeros_like(z)], axis=1)
    tilt[z < -0.999999] = (0, 1, 0, 0)
    tilt /= np.linalg.norm(tilt, axis=1, keepdims=True)
    w, a, b, _ = tilt.T
    c, s = np.cos(spin / 2), np.sin(spin / 2)
    return np.stack([w * c, a * c + b * s, b * c - a * s, w * s], axis=1)


def room(n: int, seed: int = 0) -> tuple[Gaussians, Camera, np.ndarray]:
    """A room of n flattened Gaussians on walls, floor and furniture, seen at 640 x 480.

    Spacing, and with it the size of the Gaussians, goes with 1 / sqrt(n). Most opacities are high, a fifth are faint.

    Returns:
        The Gaussians (degree 0), the camera, and the index into LABELS of every Gaussian, int32 [n].
    """
    rng = np.random.default_rng(seed)
    surfaces = _surfaces()
    areas = np.array([surface.area for surface in surfaces])
    counts = rng.multinomial(n, areas / areas.sum())
    parts: list[tuple[np.ndarray, ...]] = []
    palette = rng.uniform(0.2, 0.9, (len(surfaces), 3))
    for surface, count, base in zip(surfaces, counts, palette, strict=True):
        p, normal = surface.sample(rng, count)
        texture = 0.15 * np.sin(7.0 * p.sum(axis=1, keepdims=True)) + rng.normal(0, 0.05, (count, 3))
        parts.append(
            (p, normal, np.clip(base + texture, 0, 1), np.full(count, LABELS.index(surface.label), dtype=np.int32))
        )
    points, normals, colors, labels = (np.concatenate(part) for part in zip(*parts, strict=True))

    spacing = math.sqrt(areas.sum() / n)
    tangential = SPREAD * spacing * np.exp(rng.normal(0, 0.6, (n, 2)))
    scales = np.concatenate([tangential, 0.1 * tangential.min(axis=1, keepdims=True)], axis=1)
    points = points + normals * rng.normal(0, 0.05 * spacing, (n, 1))
    faint = rng.random(n) < 0.2
    opacities = np.where(faint, rng.uniform(0.02, 0.4, n), rng.uniform(0.6, 1.0, n))
    sh = (colors - 0.5)[:, None, :] * 2 * math.sqrt(math.pi)
    shuffle = rng.permutation(n)  # a trained scene comes in no spatial order

    def tensor(a: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(a[shuffle].astype(np.float32))

    quats = _facing(normals, rng.uniform(0, 2 * math.pi, n))
    gaussians = Gaussians(tensor(points), tensor(quats), tensor(scales), tensor(opacities), tensor(sh))
    return gaussians, room_camera(), labels[shuffle]


def with_harmonics(gaussians: Gaussians, seed: int = 0) -> Gaussians:
    """The same scene with small random coefficients of degree 3, as a trained scene has them."""
    generator = torch.Generator().manual_seed(seed)
    rest = 0.1 * torch.randn(len(gaussians), 15, 3, generator=generator)
    return replace(gaussians, sh=torch.cat([gaussians.sh, rest], dim=1))


def room_camera() -> Camera:
    """640 x 480, 65 degrees wide, standing in a corner and looking across the room, slightly down."""
    position, target = np.array([0.6, 1.1, 0.5]), np.array([3.6, 1.6, 4.0])
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(forward, right), forward])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = R, -R @ position
    K = np.array([[502.0, 0.0, 320.0], [0.0, 502.0, 240.0], [0.0, 0.0, 1.0]])
    return Camera(torch.from_numpy(K), torch.from_numpy(pose), 640, 480)


def tile_lists(
    mean2d: np.ndarray, conic: np.ndarray, opacity: np.ndarray, width: int, height: int, alpha_min: float = 1 / 255
) -> tuple[np.ndarray, np.ndarray]:
    """Which rows, already in depth order, reach which tile: exactly those with alpha >= alpha_min in its rectangle.

    Returns:
        offsets int32 [tiles + 1] and ids int32 [intersections], as in Projected.
    """
    across, down = -(-width // TILE), -(-height // TILE)
    mean2d, (a, b, c) = mean2d.astype(np.float64), conic.astype(np.float64).T
    reach = 2 * np.log(np.maximum(opacity.astype(np.float64) / alpha_min, 1.0))  # d^T conic d at the edge
    half = np.sqrt(reach[:, None] * np.stack([c, a], axis=1) / (a * c - b * b)[:, None])
    first = np.clip(np.floor((mean2d - half) / TILE), 0, [across, down]).astype(np.int64)
    last = np.clip(np.floor((mean2d + half) / TILE), -1, [across - 1, down - 1]).astype(np.int64)
    span = np.maximum(last - first + 1, 0)

    row = np.repeat(np.arange(len(mean2d)), span.prod(axis=1))  # one entry for each tile of each bounding box
    nth = np.arange(len(row)) - np.repeat(np.cumsum(span.prod(axis=1)) - span.prod(axis=1), span.prod(axis=1))
    tile = first[row] + np.stack([nth % np.maximum(span[row, 0], 1), nth // np.maximum(span[row, 0], 1)], axis=1)

    low = tile * TILE + 0.5 - mean2d[row]  # the rectangle of the tile's pixel centres, around the mean
    high = np.minimum((tile + 1) * TILE, [width, height]) - 0.5 - mean2d[row]
    A, B, C = a[row], b[row], c[row]
    nearest = np.where(((low <= 0) & (high >= 0)).all(axis=1), 0.0, np.inf)
    for x in (low[:, 0], high[:, 0]):  # a convex form outside its centre is smallest on an edge of the rectangle
        y = np.clip(-B * x / C, low[:, 1], high[:, 1])
        nearest = np.minimum(nearest, A * x * x + 2 * B * x * y + C * y * y)
    for y in (low[:, 1], high[:, 1]):
        x = np.clip(-B * y / A, low[:, 0], high[:, 0])
        nearest = np.minimum(nearest, A * x * x + 2 * B * x * y + C * y * y)

    kept = nearest <= reach[row]
    index = (tile[:, 1] * across + tile[:, 0])[kept]
    order = np.argsort(index, kind="stable")
    offsets = np.concatenate([[0], np.cumsum(np.bincount(index, minlength=across * down))])
    return offsets.astype(np.int32), row[kept][order].astype(np.int32)


def projected(gaussians: Gaussians, camera: Camera, settings: ReferenceSettings | None = None) -> Projected:
    """Project a scene with the float64 oracle and build its tile lists."""
    p = project_scene(gaussians, camera, settings)
    means, sh = gaussians.means[p.index].double(), gaussians.sh[p.index].double()
    rgb = spherical_harmonics(means, sh, camera.world_to_camera)
    mean2d, conic, opacity, color = (x.float().numpy() for x in (p.mean2d, p.conic, p.opacity, rgb))
    alpha_min = (settings or ReferenceSettings()).alpha_min
    offsets, ids = tile_lists(mean2d, conic, opacity, camera.width, camera.height, alpha_min)
    return Projected(mean2d, conic, opacity, color, offsets, ids, p.index.numpy(), camera.width, camera.height)
