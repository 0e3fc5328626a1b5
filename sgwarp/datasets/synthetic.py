"""Furnished rooms of Gaussians with the class and the piece of furniture of each, varied at random.

Walls, floor and furniture are boxes and balls, covered with flat Gaussians whose size goes with their spacing. Colours
say little about the class: every piece draws its own from one palette. Axes as in OpenCV: x right, y down, z forward.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import torch
from torch import Tensor

from sgwarp.scene import Camera, Gaussians

CLASSES = ("floor", "ceiling", "wall", "table", "chair", "sofa", "cabinet", "shelf", "lamp", "bed")
SPREAD = 1.0  # standard deviation of a Gaussian over the mean spacing of its surface
SH_C0 = 0.5 / math.sqrt(math.pi)


@dataclass(frozen=True, eq=False)
class Room:
    """A labelled room.

    Attributes:
        gaussians: The scene.
        classes: Index into CLASSES of every Gaussian, int64 [N].
        pieces: Number of the wall, floor or piece of furniture that every Gaussian belongs to, int64 [N].
        class_of_piece: Index into CLASSES, int64 [P].
        size: Width, height and depth [m].
        faces: Corner and two sides of every parallelogram that the room is made of [m], float32 [F, 3, 3].
        piece_of_face: Piece that each belongs to, int64 [F].
    """

    gaussians: Gaussians
    classes: Tensor
    pieces: Tensor
    class_of_piece: Tensor
    size: tuple[float, float, float]
    faces: Tensor
    piece_of_face: Tensor


@dataclass
class _Builder:
    """Faces of the boxes and balls so far."""

    rng: torch.Generator
    corners: list[Tensor] = field(default_factory=list)  # a face is corner + a u + b v, a and b in 0 to 1
    sides: list[Tensor] = field(default_factory=list)
    pieces: list[int] = field(default_factory=list)
    class_of_piece: list[int] = field(default_factory=list)

    def uniform(self, low: float, high: float) -> float:
        return low + (high - low) * float(torch.rand((), generator=self.rng))

    def piece(self, name: str) -> int:
        self.class_of_piece.append(CLASSES.index(name))
        return len(self.class_of_piece) - 1

    def face(self, piece: int, corner: Tensor, u: Tensor, v: Tensor) -> None:
        self.corners.append(corner)
        self.sides.append(torch.stack([u, v]))
        self.pieces.append(piece)

    def box(self, piece: int, low: tuple[float, float, float], high: tuple[float, float, float]) -> None:
        """All six sides."""
        a, b = torch.tensor(low), torch.tensor(high)
        edges = torch.diag(b - a)
        for axis in range(3):
            for corner in (a, a + edges[axis]):
                self.face(piece, corner, edges[axis - 1], edges[axis - 2])

    def ball(self, piece: int, centre: tuple[float, float, float], radius: float) -> None:
        """Narrow faces around a sphere."""
        steps = 8
        for i in range(steps):
            for j in range(2 * steps):
                at = [
                    _on_sphere(math.pi * (i + di) / steps, math.pi * (j + dj) / steps)
                    for di, dj in ((0, 0), (1, 0), (0, 1))
                ]
                corner, u, v = (torch.tensor(centre) + radius * torch.tensor(p) for p in at)
                self.face(piece, corner, u - corner, v - corner)


def _on_sphere(polar: float, around: float) -> tuple[float, float, float]:
    return math.sin(polar) * math.cos(around), math.cos(polar), math.sin(polar) * math.sin(around)


def _furnish(build: _Builder, name: str, x: float, z: float, w: float, d: float, floor: float, back: float) -> None:
    """One piece standing on the floor around (x, z), w wide and d deep; its back is towards `back` (+1 or -1) in z.

    y points down, so that the floor has the largest y.
    """
    piece, u = build.piece(name), build.uniform
    x0, x1, z0, z1 = x - w / 2, x + w / 2, z - d / 2, z + d / 2

    def upright(y_high: float, thickness: float) -> None:
        a, b = (z1 - thickness, z1) if back > 0 else (z0, z0 + thickness)
        build.box(piece, (x0, floor - y_high, a), (x1, floor - 0.3, b))

    def legs(height: float, thickness: float) -> None:
        for a in (x0, x1 - thickness):
            for b in (z0, z1 - thickness):
                build.box(piece, (a, floor - height, b), (a + thickness, floor, b + thickness))

    if name == "table":
        height = u(0.68, 0.8)
        build.box(piece, (x0, floor - height, z0), (x1, floor - height + 0.05, z1))
        legs(height, 0.07)
    elif name == "chair":
        build.box(piece, (x0, floor - 0.46, z0), (x1, floor - 0.4, z1))
        upright(u(0.8, 1.0), 0.06)
        legs(0.42, 0.05)
    elif name == "sofa":
        build.box(piece, (x0, floor - u(0.38, 0.48), z0), (x1, floor, z1))
        upright(u(0.75, 0.95), 0.25)
        for a in (x0, x1 - 0.18):
            build.box(piece, (a, floor - 0.62, z0), (a + 0.18, floor, z1))
    elif name == "cabinet":
        build.box(piece, (x0, floor - u(0.9, 2.1), z0), (x1, floor, z1))
    elif name == "shelf":
        height = u(1.2, 2.0)
        for a in (x0, x1 - 0.04):
            build.box(piece, (a, floor - height, z0), (a + 0.04, floor, z1))
        for level in range(5):
            y = floor - height * (level + 0.5) / 5
            build.box(piece, (x0, y - 0.03, z0), (x1, y, z1))
    elif name == "lamp":
        height = u(1.3, 1.7)
        build.box(piece, (x - 0.03, floor - height, z - 0.03), (x + 0.03, floor, z + 0.03))
        build.box(piece, (x - 0.15, floor - 0.04, z - 0.15), (x + 0.15, floor, z + 0.15))
        build.ball(piece, (x, floor - height, z), u(0.16, 0.24))
    else:
        build.box(piece, (x0, floor - u(0.4, 0.55), z0), (x1, floor, z1))
        upright(u(0.8, 1.1), 0.08)
        a, b = (z1 - 0.5, z1 - 0.12) if back > 0 else (z0 + 0.12, z0 + 0.5)
        build.box(piece, (x0 + 0.15, floor - 0.65, a), (x1 - 0.15, floor - 0.5, b))


# Name: smallest and largest width and depth [m], and whether it stands at a wall.
FURNITURE = {
    "table": (1.0, 1.8, 0.7, 1.0, False),
    "chair": (0.42, 0.52, 0.42, 0.52, False),
    "sofa": (1.5, 2.3, 0.8, 1.0, True),
    "cabinet": (0.6, 1.5, 0.4, 0.6, True),
    "shelf": (0.7, 1.2, 0.28, 0.4, True),
    "lamp": (0.4, 0.4, 0.4, 0.4, False),
    "bed": (1.2, 1.8, 1.9, 2.1, True),
}


def make_room(seed: int, count: int = 20_000) -> Room:
    """A room of `count` Gaussians; another seed is another room with other furniture, colours and sizes."""
    build = _Builder(torch.Generator().manual_seed(seed))
    width, height, depth = build.uniform(4.0, 6.5), build.uniform(2.4, 3.0), build.uniform(4.0, 6.0)
    x, y, z = torch.diag(torch.tensor([width, height, depth]))
    zero = torch.zeros(3)
    build.face(build.piece("floor"), y, x, z)
    build.face(build.piece("ceiling"), zero, x, z)
    for corner, u, v in ((zero, x, y), (z, x, y), (zero, z, y), (x, z, y)):
        build.face(build.piece("wall"), corner, u, v)
    _place_furniture(build, width, height, depth)
    return _cover(build, count, (width, height, depth))


def _place_furniture(build: _Builder, width: float, floor: float, depth: float) -> None:
    """Every kind once and some again, where there is room for them."""
    names = [*FURNITURE, "chair", "chair", "cabinet", "lamp", "shelf"]
    order = [names[i] for i in torch.randperm(len(names), generator=build.rng).tolist()]
    taken: list[tuple[float, float, float, float]] = []
    for name in order:
        w_low, w_high, d_low, d_high, at_wall = FURNITURE[name]
        for _ in range(20):
            w, d = build.uniform(w_low, w_high), build.uniform(d_low, d_high)
            x = build.uniform(w / 2 + 0.05, width - w / 2 - 0.05)
            z = build.uniform(d / 2 + 0.05, depth - d / 2 - 0.05)
            back = 1.0 if z > depth / 2 else -1.0
            if at_wall:
                z = depth - d / 2 - 0.02 if back > 0 else d / 2 + 0.02
            box = (x - w / 2 - 0.1, x + w / 2 + 0.1, z - d / 2 - 0.1, z + d / 2 + 0.1)
            if all(box[1] < t[0] or box[0] > t[1] or box[3] < t[2] or box[2] > t[3] for t in taken):
                taken.append(box)
                _furnish(build, name, x, z, w, d, floor, back)
                break


def _cover(build: _Builder, count: int, size: tuple[float, float, float]) -> Room:
    """Flat Gaussians, uniform over all faces."""
    rng = build.rng
    corners, sides = torch.stack(build.corners), torch.stack(build.sides)
    normals = torch.linalg.cross(sides[:, 0], sides[:, 1])
    areas = normals.norm(dim=1).clamp(min=1e-12)
    face = torch.multinomial(areas, count, replacement=True, generator=rng)
    a, b = torch.rand(2, count, 1, generator=rng)
    spacing = math.sqrt(float(areas.sum()) / count)
    normal = torch.nn.functional.normalize(normals, dim=1)[face]
    thin = torch.randn(count, 1, generator=rng) * 0.05 * spacing
    means = corners[face] + a * sides[face, 0] + b * sides[face, 1] + normal * thin
    tangential = SPREAD * spacing * torch.exp(0.4 * torch.randn(count, 2, generator=rng))
    scales = torch.cat([tangential, 0.1 * tangential.amin(dim=1, keepdim=True)], dim=1)
    pieces = torch.tensor(build.pieces)[face]
    palette = 0.15 + 0.7 * torch.rand(len(build.class_of_piece), 3, generator=rng)
    colours = palette[pieces] + 0.05 * torch.randn(count, 3, generator=rng)
    opacities = torch.where(torch.rand(count, generator=rng) < 0.2, 0.3, 0.95)
    gaussians = Gaussians(
        means=means,
        quats=_facing(normal, 2 * math.pi * torch.rand(count, generator=rng)),
        scales=scales,
        opacities=opacities,
        sh=((colours.clamp(0, 1) - 0.5) / SH_C0)[:, None],
    )
    class_of_piece = torch.tensor(build.class_of_piece)
    faces = torch.cat([corners[:, None], sides], dim=1)
    classes = class_of_piece[pieces]
    return Room(gaussians, classes, pieces, class_of_piece, size, faces, torch.tensor(build.pieces))


def _facing(normals: Tensor, spin: Tensor) -> Tensor:
    """Quaternions (w, x, y, z) that turn the z axis to unit `normals` after a turn by `spin` around z."""
    x, y, z = normals.unbind(1)
    tilt = torch.stack([1 + z, -y, x, torch.zeros_like(z)], dim=1)
    tilt[z < -0.999999] = torch.tensor([0.0, 1.0, 0.0, 0.0])
    w, i, j, _ = torch.nn.functional.normalize(tilt, dim=1).unbind(1)
    c, s = torch.cos(spin / 2), torch.sin(spin / 2)
    return torch.stack([w * c, i * c + j * s, j * c - i * s, w * s], dim=1)


def room_cameras(room: Room, seed: int, count: int, width: int = 160, height: int = 120) -> list[Camera]:
    """Cameras at eye height that look across the room, slightly down."""
    rng = torch.Generator().manual_seed(seed)
    size = torch.tensor(room.size, dtype=torch.float64)
    cameras = []
    for number in range(count):
        share = torch.rand(2, generator=rng).double()
        angle = 2 * math.pi * (number + float(share[0])) / count
        reach = torch.tensor([math.cos(angle), 0.0, math.sin(angle)], dtype=torch.float64)
        position = size / 2 + 0.38 * reach * size
        position[1] = size[1] - 1.2 - 0.6 * share[1]
        target = size / 2 - 0.2 * reach * size
        target[1] = size[1] - 0.5
        forward = torch.nn.functional.normalize(target - position, dim=0)
        right = torch.linalg.cross(torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64), forward)
        right = torch.nn.functional.normalize(right, dim=0)
        R = torch.stack([right, torch.linalg.cross(forward, right), forward])
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3], pose[:3, 3] = R, -R @ position
        focal = 0.6 * width
        K = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
        cameras.append(Camera(K, pose, width, height))
    return cameras
