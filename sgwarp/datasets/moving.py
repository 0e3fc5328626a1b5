"""A labelled scene that moves: a figure that walks, a ball, a crate, a cart that comes and goes, a lamp that goes on.

Floor, pillar and table stay; the pillar hides what passes behind it. Axes as in OpenCV: x right, y down, z forward; the
floor is y = 0. The cameras stay on a circle around the scene, with principal points off centre.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from sgwarp.datasets.bodies import Body
from sgwarp.errors import InputError
from sgwarp.scene import Camera, Gaussians, View

LABELS = (
    *("floor", "pillar", "table", "ball", "crate", "head", "torso", "left arm", "right arm", "left leg", "right leg"),
    *("cart", "lamp off", "lamp on"),
)
LAMP_OFF, LAMP_ON = LABELS.index("lamp off"), LABELS.index("lamp on")
STILL_BODIES = 4  # floor, pillar, table and lamp come first
AWAY = -7.0  # height of the cart while it is not there: above every camera's image [m]
SH_C0 = 0.5 / math.sqrt(math.pi)
LIT = (1.0, 0.95, 0.5)


def _bodies() -> list[Body]:
    at = LABELS.index
    skin, shirt, jeans = (0.85, 0.65, 0.5), (0.2, 0.35, 0.8), (0.15, 0.15, 0.35)
    bodies = [
        Body("box", (2.2, 0.05, 2.2), at("floor"), (0.55, 0.5, 0.45)),
        Body("box", (0.18, 0.7, 0.18), at("pillar"), (0.7, 0.7, 0.72)),
        Body("box", (0.35, 0.25, 0.3), at("table"), (0.5, 0.3, 0.15)),
        Body("ball", (0.16,), LAMP_OFF, (0.35, 0.35, 0.3)),
        Body("ball", (0.2,), at("ball"), (0.9, 0.45, 0.1)),
        Body("box", (0.22, 0.22, 0.22), at("crate"), (0.2, 0.6, 0.25)),
        Body("box", (0.3, 0.2, 0.2), at("cart"), (0.75, 0.1, 0.5)),
        Body("ball", (0.14,), at("head"), skin),
        Body("capsule", (0.16, 0.22), at("torso"), shirt),
    ]
    for side in ("left", "right"):
        bodies += [Body("capsule", (0.055, 0.12), at(f"{side} arm"), skin)] * 2  # upper and lower
        bodies += [Body("capsule", (0.07, 0.16), at(f"{side} leg"), jeans)] * 2
    return bodies


@dataclass(frozen=True, eq=False)
class MovingScene:
    """A generated scene with its truth.

    Attributes:
        frames: How many there are.
        cameras: Views that stay; their stems are "0", "1", ...
        bodies: What it consists of.
        owner: Body of each Gaussian, int64 [N].
        labels: Names; pixel value k of a label image is labels[k - 1], 0 is nothing.
        switch: Frame from which on the lamp is lit.
    """

    frames: int
    cameras: list[View]
    bodies: list[Body]
    owner: Tensor
    switch: int
    local_means: Tensor  # float32 [N, 3] in the body's axes [m]
    local_quats: Tensor  # float32 [N, 4]
    scales: Tensor  # float32 [N, 3] [m]
    opacities: Tensor  # float32 [N]
    shades: Tensor  # float32 [N] brightness of each Gaussian
    still: bool = False  # nothing moves
    labels: tuple[str, ...] = LABELS

    @property
    def moving(self) -> Tensor:
        """Gaussians of bodies that move, bool [N]."""
        return self.owner >= STILL_BODIES

    def classes(self, frame: int) -> Tensor:
        """Index into `labels` of every Gaussian, int64 [N]."""
        table = torch.tensor([self._label(body, frame) for body in self.bodies])
        return table[self.owner]

    def _label(self, body: Body, frame: int) -> int:
        return LAMP_ON if body.label == LAMP_OFF and frame >= self.switch else body.label

    def poses(self, frame: int) -> tuple[Tensor, Tensor]:
        """Rotation, float64 [B, 3, 3], and position, float64 [B, 3], of every body."""
        return _poses(0.0 if self.still else frame / max(1, self.frames))

    def gaussians(self, frame: int) -> Gaussians:
        """The scene at a frame."""
        rotations, positions = self.poses(frame)
        turn, place = rotations.float()[self.owner], positions.float()[self.owner]
        means = torch.einsum("nij,nj->ni", turn, self.local_means) + place
        quats = _product(_quaternions(rotations).float()[self.owner], self.local_quats)
        colors = torch.tensor([LIT if self._label(b, frame) == LAMP_ON else b.color for b in self.bodies])
        rgb = (colors[self.owner] * self.shades[:, None]).clamp(0, 1)
        return Gaussians(means, quats, self.scales, self.opacities, ((rgb - 0.5) / SH_C0)[:, None])

    def truth(self, frame: int, camera: Camera) -> Tensor:
        """What each pixel's ray hits first, label + 1 or 0, int64 [H, W]; of the bodies, not of their Gaussians."""
        x = (torch.arange(camera.width, dtype=torch.float64) + 0.5 - camera.K[0, 2]) / camera.K[0, 0]
        y = (torch.arange(camera.height, dtype=torch.float64) + 0.5 - camera.K[1, 2]) / camera.K[1, 1]
        columns, rows = torch.meshgrid(x, y, indexing="xy")
        rays = torch.stack([columns, rows, torch.ones_like(columns)], dim=-1).reshape(-1, 3)
        directions = rays @ camera.world_to_camera[:3, :3]
        nearest = torch.full((len(rays),), math.inf, dtype=torch.float64)
        seen = torch.zeros(len(rays), dtype=torch.int64)
        rotations, positions = self.poses(frame)
        unit = torch.nn.functional.normalize(directions, dim=1)
        for body, turn, place in zip(self.bodies, rotations, positions, strict=True):
            away = place - camera.position
            along = unit @ away
            close = ((away @ away - along.square()) <= body.reach**2).nonzero().flatten()
            length = body.hit(turn.T @ -away, directions[close] @ turn)
            nearer = length < nearest[close]
            nearest[close[nearer]] = length[nearer]
            seen[close[nearer]] = self._label(body, frame) + 1
        return seen.view(camera.size)


def _turn(axis: int, angle: float) -> Tensor:
    """Rotation matrix about a coordinate axis, float64 [3, 3]."""
    c, s = math.cos(angle), math.sin(angle)
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    turn = torch.eye(3, dtype=torch.float64)
    turn[i, i], turn[i, j], turn[j, i], turn[j, j] = c, -s, s, c
    return turn


def _poses(time: float) -> tuple[Tensor, Tensor]:
    """Where every body of `_bodies` is; `time` runs from 0 to 1."""
    one = torch.eye(3, dtype=torch.float64)
    around = 2 * math.pi * time
    poses = [(one, (0.0, 0.05, 0.0)), (one, (-0.7, -0.7, 0.5)), (one, (0.9, -0.25, -0.7)), (one, (0.9, -0.66, -0.7))]
    bounce = abs(math.sin(3 * around))
    poses.append((_turn(2, 4 * around), (1.6 * math.cos(around) - 0.3, -0.2 - 0.5 * bounce, 1.0)))
    poses.append((_turn(1, 2 * around), (0.8 * math.sin(around), -0.22, -1.1 + 0.3 * math.cos(around))))
    lowered = max(0.0, min(1.0, 8 * (time - 0.2), 8 * (0.8 - time)))  # comes down, stays, goes up again
    poses.append((_turn(1, around), (0.9, -0.2 + (1 - lowered) * AWAY, 0.5)))
    return _stack(poses + _figure(around))


def _figure(around: float) -> list[tuple[Tensor, tuple[float, ...]]]:
    """Head, torso, and for both sides upper and lower arm, upper and lower leg of a walker."""
    heading = _turn(1, -around)
    place = torch.tensor([-0.5 + 0.5 * math.cos(around), -0.78, -0.3 + 0.5 * math.sin(around)], dtype=torch.float64)

    def at(turn: Tensor, *where: float) -> tuple[Tensor, tuple[float, ...]]:
        return heading @ turn, tuple((place + heading @ torch.tensor(where, dtype=torch.float64)).tolist())

    one = torch.eye(3, dtype=torch.float64)
    parts = [at(one, 0.0, -0.62, 0.0), at(one, 0.0, -0.2, 0.0)]
    for side, phase in ((-1.0, 0.0), (1.0, math.pi)):
        swing = 0.7 * math.sin(6 * around + phase)
        for joint, half, bend, width in (((-0.36), 0.12, 0.5, 0.24), ((0.1), 0.16, -0.4, 0.09)):
            angle = swing if half == 0.12 else -swing
            upper, lower = _turn(0, angle), _turn(0, angle + bend * abs(math.sin(3 * around + phase)))
            reach = 2 * half + 0.03
            parts.append(at(upper, side * width, *_hang(joint, 0.0, angle, reach / 2)))
            knee_y, knee_z = _hang(joint, 0.0, angle, reach)
            below = angle + bend * abs(math.sin(3 * around + phase))
            parts.append(at(lower, side * width, *_hang(knee_y, knee_z, below, reach / 2)))
    return parts


def _hang(y: float, z: float, angle: float, length: float) -> tuple[float, float]:
    """End (y, z) of a limb that hangs from (y, z), turned about x."""
    return y + length * math.cos(angle), z + length * math.sin(angle)


def _stack(poses: list[tuple[Tensor, tuple[float, ...]]]) -> tuple[Tensor, Tensor]:
    positions = torch.tensor([place for _, place in poses], dtype=torch.float64)
    return torch.stack([turn for turn, _ in poses]), positions


def make_moving_scene(
    seed: int = 0,
    frames: int = 60,
    count: int = 8000,
    *,
    cameras: int = 8,
    width: int = 160,
    height: int = 120,
    moving_share: float | None = None,
) -> MovingScene:
    """A moving scene of `count` Gaussians.

    Args:
        seed: Of the Gaussians' places; the motion is always the same.
        frames: Number of frames of one round.
        count: N.
        cameras: How many look on.
        width, height: Of their images [pixels].
        moving_share: Share of the Gaussians on moving bodies; by area if None, 0 for a scene in which nothing moves, 1
            for one in which nothing else is.

    Raises:
        InputError: A number is out of range.
    """
    if min(frames, count, cameras) < 1 or (moving_share is not None and not 0 <= moving_share <= 1):
        raise InputError("a moving scene needs frames, Gaussians and cameras, and a share of 0 to 1")
    random = torch.Generator().manual_seed(seed)
    bodies = _bodies()
    areas = torch.tensor([body.area for body in bodies])
    shares = areas / areas.sum()
    moves = torch.arange(len(bodies)) >= STILL_BODIES
    if moving_share is not None and moving_share > 0:
        shares[moves] *= moving_share / shares[moves].sum()
        shares[~moves] *= (1 - moving_share) / shares[~moves].sum()
    edges = (shares.cumsum(0) * count).round().long()
    counts = torch.diff(edges, prepend=torch.zeros(1, dtype=torch.int64)).tolist()
    parts = [_covered(body, n, random) for body, n in zip(bodies, counts, strict=True)]
    means, quats, scales = (torch.cat(column) for column in zip(*parts, strict=True))
    n = len(means)
    return MovingScene(
        frames=frames,
        cameras=[View(str(k), _camera(k, cameras, width, height)) for k in range(cameras)],
        bodies=bodies,
        owner=torch.repeat_interleave(torch.arange(len(bodies)), torch.tensor(counts)),
        switch=frames // 2,
        local_means=means,
        local_quats=quats,
        scales=scales,
        opacities=torch.full((n,), 0.95),
        shades=0.85 + 0.3 * torch.rand(n, generator=random),
        still=moving_share == 0,
    )


def _covered(body: Body, count: int, random: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
    """Centres, rotations and scales of flat Gaussians that cover a body; centres, [count, 3], lie on it."""
    points, normals = body.surface(count, random)
    spacing = math.sqrt(body.area / max(1, count))
    size = 0.7 * spacing * torch.exp(0.2 * torch.randn(count, 2, generator=random))
    return points, _facing(normals), torch.cat([size, 0.1 * size.amin(dim=1, keepdim=True)], dim=1)


def _facing(normals: Tensor) -> Tensor:
    """Quaternions that turn the z axis to unit `normals`, [K, 4]."""
    x, y, z = normals.unbind(1)
    turn = torch.stack([1 + z, -y, x, torch.zeros_like(z)], dim=1)
    turn[z < -0.999999] = torch.tensor([0.0, 1.0, 0.0, 0.0])
    return torch.nn.functional.normalize(turn, dim=1)


def _quaternions(rotations: Tensor) -> Tensor:
    """Unit quaternions (w, x, y, z) of rotation matrices, float64 [B, 4], by the largest component."""
    quats = torch.empty(len(rotations), 4, dtype=torch.float64)
    for row, R in enumerate(rotations):
        trace = torch.stack([R.trace(), *(2 * R[i, i] - R.trace() for i in range(3))])
        k = int(trace.argmax())
        if k == 0:
            q = torch.stack([1 + R.trace(), R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
        else:
            i, j, m = k - 1, k % 3, (k + 1) % 3
            q = torch.empty(4, dtype=torch.float64)
            q[0], q[1 + i] = R[m, j] - R[j, m], 1 + R[i, i] - R[j, j] - R[m, m]
            q[1 + j], q[1 + m] = R[j, i] + R[i, j], R[m, i] + R[i, m]
        quats[row] = q / q.norm()
    return quats


def _product(p: Tensor, q: Tensor) -> Tensor:
    """Hamilton product, [N, 4]."""
    w, v, s, u = p[:, :1], p[:, 1:], q[:, :1], q[:, 1:]
    real = w * s - (v * u).sum(dim=1, keepdim=True)
    return torch.cat([real, w * u + s * v + torch.linalg.cross(v, u)], dim=1)


def _camera(number: int, count: int, width: int, height: int) -> Camera:
    """A camera on the circle; its principal point lies off centre."""
    angle = 2 * math.pi * (number + 0.3) / count
    position = torch.tensor([3.6 * math.cos(angle), -1.7 - 0.3 * (number % 3), 3.6 * math.sin(angle)]).double()
    forward = torch.nn.functional.normalize(torch.tensor([0.0, -0.45, 0.0]).double() - position, dim=0)
    right = torch.linalg.cross(torch.tensor([0.0, 1.0, 0.0]).double(), forward)
    right = torch.nn.functional.normalize(right, dim=0)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ position
    shift = 0.02 * width * (1 if number % 2 else -1)
    focal = 0.85 * width
    K = torch.tensor([[focal, 0.0, width / 2 + shift], [0.0, focal, height / 2 - shift / 2], [0.0, 0.0, 1.0]])
    return Camera(K, pose, width, height)


def with_label_noise(truth: Tensor, rate: float, random: torch.Generator, labels: int = len(LABELS)) -> Tensor:
    """Each region of one label turns into another label at the given rate, as a 2D network mistakes whole objects."""
    table = torch.arange(labels + 1)
    wrong = torch.rand(labels + 1, generator=random) < rate
    other = torch.randint(1, labels, (labels + 1,), generator=random)
    other = other + (other >= table).long()  # any label but the right one
    wrong[0] = False
    return torch.where(wrong, other, table)[truth]
