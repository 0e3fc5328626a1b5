"""A generated room as a labelled folder: photographs rendered, labels and depth by rays, without any Gaussians."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from sgwarp.datasets.synthetic import CLASSES, Room, room_cameras
from sgwarp.files.atomic import atomic_path
from sgwarp.files.images import write_ids, write_rgb
from sgwarp.io.scenes import save_gaussians
from sgwarp.ops.splatting.forward import rasterize
from sgwarp.scene import Camera

RAYS_AT_ONCE = 2048
NEAR = 0.01  # what is nearer to a camera is not seen [m]
LABEL = "label"  # column of the scene's PLY file: class of each Gaussian


def room_truth(room: Room, camera: Camera) -> tuple[Tensor, Tensor]:
    """What a camera sees by intersecting the ray of each pixel's center with the faces of the room.

    Returns:
        classes: Index into CLASSES, -1 where the ray leaves the room, int64 [H, W].
        depth: Along the optical axis [m], 0 where the ray leaves the room, float64 [H, W].
    """
    pieces, depth = room_pieces(room, camera)
    return torch.where(pieces >= 0, room.class_of_piece[pieces], -1), depth


def room_pieces(room: Room, camera: Camera) -> tuple[Tensor, Tensor]:
    """As `room_truth`, with the number of the wall or piece of furniture in place of its class."""
    y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) + 0.5 for n in camera.size), indexing="ij")
    rays = torch.stack([x, y, torch.ones_like(x)], dim=2).reshape(-1, 3) @ torch.linalg.inv(camera.K).T
    rays = rays @ camera.world_to_camera[:3, :3]  # z along the optical axis stays 1: the distance is the depth
    found = [_first_face(room, camera.position, part) for part in rays.split(RAYS_AT_ONCE)]
    face, depth = (torch.cat(each) for each in zip(*found, strict=True))
    seen = torch.isfinite(depth)
    pieces = torch.where(seen, room.piece_of_face[face], -1)
    return pieces.view(camera.size), torch.where(seen, depth, 0.0).view(camera.size)


def _first_face(room: Room, origin: Tensor, rays: Tensor) -> tuple[Tensor, Tensor]:
    """The first face on each ray and its distance in lengths of the ray, infinity where there is none, [rays] each."""
    corner, u, v = room.faces.double().unbind(1)
    normal = torch.linalg.cross(u, v)
    distance = ((corner - origin) * normal).sum(dim=1) / (rays @ normal.T)  # [rays, faces]
    inside = distance > NEAR
    for side, other in ((u, v), (v, u)):
        across = torch.linalg.cross(other, normal)
        across = across / (side * across).sum(dim=1, keepdim=True)  # how far along a side a point lies is linear in it
        share = ((origin - corner) * across).sum(dim=1) + distance * (rays @ across.T)
        inside &= (share >= 0) & (share <= 1)
    nearest, face = torch.where(inside, distance, torch.inf).min(dim=1)
    return face, nearest


def save_room(
    room: Room, folder: str | os.PathLike[str], views: int = 24, width: int = 160, height: int = 120, seed: int = 0
) -> None:
    """Write a room.

    | file | holds |
    |---|---|
    | transforms.json, images/{stem}.png | cameras on a round through the room, and what they see, rendered |
    | labels/{stem}.png, classes.json | ids, class k is k + 1 and 0 nothing; names |
    | instances/{stem}.png | ids, piece k is k + 1 and 0 nothing |
    | depth/{stem}.png | uint16 [mm] |
    | scene.ply | the Gaussians, with their class in the column `label` |

    Args:
        room: What to write.
        folder: Created if needed.
        views, width, height: Number and size of the photographs [pixels].
        seed: Of the cameras.
    """
    folder = Path(folder)
    cameras = room_cameras(room, seed, views, width, height)
    for number, camera in enumerate(cameras):
        pieces, depth = room_pieces(room, camera)
        classes = torch.where(pieces >= 0, room.class_of_piece[pieces], -1)
        name = f"{number:04d}.png"
        write_rgb(folder / "images" / name, rasterize(room.gaussians, camera).features.clamp(0, 1))
        write_ids(folder / "labels" / name, (classes + 1).numpy().astype(np.uint8))
        write_ids(folder / "instances" / name, (pieces + 1).numpy().astype(np.uint16))
        write_ids(folder / "depth" / name, (1000 * depth).round().clamp(max=65535).numpy().astype(np.uint16))
    named = replace(room.gaussians, extras={LABEL: room.classes.numpy().astype(np.int32)})
    save_gaussians(named, folder / "scene.ply")
    _write_text(folder / "transforms.json", json.dumps(transforms_of(cameras)))
    _write_text(folder / "classes.json", json.dumps({str(k + 1): name for k, name in enumerate(CLASSES)}))


def transforms_of(cameras: Sequence[Camera]) -> dict[str, object]:
    """The content of a transforms.json, images named images/{number:04d}.png."""
    flip = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
    K = cameras[0].K
    frames = [
        {
            "file_path": f"images/{number:04d}.png",
            "transform_matrix": (torch.linalg.inv(camera.world_to_camera) @ flip).tolist(),
        }
        for number, camera in enumerate(cameras)
    ]
    names = {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
    lens = {name: float(value) for name, value in names.items()}
    return {"w": cameras[0].width, "h": cameras[0].height, **lens, "frames": frames}


def _write_text(path: Path, text: str) -> None:
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
