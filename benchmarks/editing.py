"""Edits by language in the demo room: how much of the object they reach, and what else they change; seconds at 1M.

    python -m benchmarks.editing [quality] [objects] [time] [rotation] [--out benchmarks/editing.json] [--pictures DIR]

Five edits, seen in the held-out views that show the object, such as remove the lamp or move the teddy bear. Each is
done with four selections: the Gaussians whose lifted true label is the object's, and the text with
semantics of the default encoder alone, with instances of the true masks, and with instances of OpenCV's proposals.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

import sgwarp as sg
from benchmarks.room import FullRoom
from sgwarp.apps.editing import operations as ops
from sgwarp.apps.editing.measurement import measure_edit
from sgwarp.apps.editing.picker import EditContext, EditState, largest_pieces, pick
from sgwarp.demo.data import FURNITURE, Room
from sgwarp.encoders.base import TextEncoder
from sgwarp.files.images import read_ids, write_rgb
from sgwarp.ops.reference import rasterizer as reference
from sgwarp.ops.splatting.settings import RasterSettings
from sgwarp.querying.scores import class_votes
from sgwarp.querying.scoring import score_texts
from sgwarp.scene import Camera, FeatureMap, Gaussians, View

RESULTS = Path(__file__).with_name("editing.json")
LEAST_PIXELS = 50  # of an object in a view that counts
COUNT = 1_000_000
NEAR = 1e-4  # relative distance to a cut-off that rounding in float32 may bridge
TIE = 3e-7  # the same of two depths


@dataclass(frozen=True)
class Task:
    """An edit: what the text says, the class that is meant, and what is done to it."""

    name: str
    text: str
    label: str
    operation: ops.Operation


TASKS = (
    Task("remove the lamp", "lamp", "lamp", ops.Remove()),
    Task("move the teddy bear", "teddy bear", "teddy bear", ops.Move((0.0, -0.3, 0.0))),
    Task("make the couch green", "couch", "couch", ops.Recolor(ops.COLORS["green"])),
    Task("remove the plant", "plant", "plant", ops.Remove()),
    Task("make the piano red", "piano", "piano", ops.Recolor(ops.COLORS["red"])),
)


def true_selection(room: Room, number: int) -> Tensor:
    """Gaussians whose lifted true label is this class, bool [N]."""
    semantics = sg.lift(room.gaussians, room.views, room.label_map)
    best, channel = class_votes(semantics, room.names).max(dim=1)
    return (best > 0) & (channel == number)


def seen_at(scene: Gaussians, chosen: Tensor, camera: Camera) -> Tensor:
    """Pixels that show the chosen Gaussians more than anything else, bool [H, W]."""
    return sg.render(scene, camera, "features", features=chosen.float()[:, None])[..., 0] > 0.5


def quality(pictures: Path | None) -> dict:
    """Completeness and leakage in every held-out view that shows the object."""
    room = Room.load()
    scene, views = room.gaussians, room.views
    encoder = sg.make_encoder("conse", views)
    semantics = sg.lift(scene, views, encoder)
    contexts = {"semantics alone": EditContext(semantics, encoder)}
    for name, source in {"true masks": f"files:{room.folder / 'labels'}", "proposals": "graph"}.items():
        contexts[f"instances of {name}"] = EditContext(semantics, encoder, sg.instances(scene, views, source))
    rows: dict[str, dict] = {}
    for task in TASKS:
        number = room.names.index(task.label)
        truth = true_selection(room, number)
        chosen = {"true selection": truth} | {name: by_text(scene, task.text, one) for name, one in contexts.items()}
        rows[task.name] = {}
        for name, selection in chosen.items():
            row: dict = {"Gaussians": int(selection.sum()), "right": int((selection & truth).sum())}
            if row["Gaussians"]:
                row |= measured(room, task, truth, selection, pictures and pictures / f"{task.name} {name}")
            rows[task.name][name] = row
            print(task.name, name, row, flush=True)
    return rows


def objects(pictures: Path | None) -> dict:
    """What the name of each object selects in the demo room, and in the full one where SGWARP_DATA holds it."""
    room = Room.load()
    scene, views = room.gaussians, room.views
    encoder = sg.make_encoder("conse", views)
    rows = {"demo room": selected(scene, views, room.folder, encoder, room.names, room.label_map)}
    if "SGWARP_DATA" in os.environ:
        full = FullRoom.build(Path(os.environ["SGWARP_DATA"]) / "room", 100_000)
        encoder = sg.make_encoder("conse", full.views[::2])

        def labels(view: View) -> FeatureMap:
            ids = torch.from_numpy(read_ids(full.folder / "labels" / f"{view.stem}.png")).int() - 1
            return FeatureMap("labels", ids=ids, labels=room.names)

        rows["full room"] = selected(full.gaussians, full.views[::2], full.folder, encoder, room.names, labels)
    return rows


def selected(
    scene: Gaussians,
    views: Sequence[View],
    folder: Path,
    encoder: TextEncoder,
    names: tuple[str, ...],
    labels: Callable[[View], FeatureMap],
) -> dict:
    """IoU of what the name of each object selects with the Gaussians that bear its true label.

    Gaussians count as much as the views show of them. "one threshold" is what `Selection.threshold` alone would select.
    """
    semantics, true = sg.lift(scene, views, encoder), sg.lift(scene, views, labels)
    best, channel = class_votes(true, names).max(dim=1)
    contexts = {"semantics alone": EditContext(semantics, encoder)}
    for name, source in {"true masks": f"files:{folder / 'labels'}", "proposals": "graph"}.items():
        contexts[f"instances of {name}"] = EditContext(semantics, encoder, sg.instances(scene, views, source))
    return compared(scene, contexts, names[:FURNITURE], torch.where(best > 0, channel, -1), true.weight)


def compared(
    scene: Gaussians, contexts: dict[str, EditContext], names: tuple[str, ...], classes: Tensor, weight: Tensor
) -> dict:
    """IoU by object and selection, and their means."""
    alone = contexts["semantics alone"]
    assert alone.semantics is not None
    values = score_texts(alone.semantics, names, alone.encoder).values
    rows: dict[str, dict] = {}
    for number, text in enumerate(names):
        truth = classes == number
        chosen = {"one threshold": largest_pieces(scene.means, values[:, number] > 0.5)}
        chosen |= {name: by_text(scene, text, context) for name, context in contexts.items()}
        rows[text] = {
            name: {
                "IoU": float(weight[one & truth].sum() / weight[one | truth].sum()),
                "Gaussians": int(one.sum()),
                "right": int((one & truth).sum()),
            }
            for name, one in chosen.items()
        }
        print(text, {name: round(row["IoU"], 3) for name, row in rows[text].items()}, flush=True)
    rows["mean IoU"] = {name: sum(row[name]["IoU"] for row in rows.values()) / len(names) for name in rows[names[0]]}
    return rows


def measured(room: Room, task: Task, truth: Tensor, chosen: Tensor, pictures: Path | None) -> dict:
    """Figures of one edit by view; pixels where a moved object comes to lie count as its own."""
    scene, number = room.gaussians, room.names.index(task.label)
    edited = task.operation.apply(scene, chosen).gaussians
    rows = {}
    for view in room.held_out:
        mask = room.truth[view.stem] == number
        if int(mask.sum()) < LEAST_PIXELS:
            continue
        if isinstance(task.operation, ops.Move):
            mask = mask | seen_at(task.operation.apply(scene, truth).gaussians, truth, view.camera)
        before, after = (sg.render(one, view.camera).clamp(0, 1) for one in (scene, edited))
        found = measure_edit(before, after, mask)
        rows[view.stem] = {"completeness": found.completeness, "leakage": found.leakage}
        if pictures is not None:
            write_rgb(pictures.with_name(f"{pictures.name} {view.stem}.png"), torch.cat([before, after], dim=1))
    return rows


def by_text(scene: Gaussians, text: str, context: EditContext) -> Tensor:
    """What a text selects; nothing where it names nothing."""
    try:
        return sg.EditSession(scene, context).preview(sg.Selection((text,)))
    except sg.InputError:
        return torch.zeros(len(scene), dtype=torch.bool)


def cloud(count: int, degree: int = 3) -> Gaussians:
    random = torch.Generator().manual_seed(0)
    means = torch.rand(count, 3, generator=random) * torch.tensor([6.0, 3.0, 5.0])
    quats = torch.nn.functional.normalize(torch.randn(count, 4, generator=random), dim=1)
    scales = 0.002 + 0.02 * torch.rand(count, 3, generator=random)
    sh = 0.3 * torch.randn(count, (degree + 1) ** 2, 3, generator=random)
    return Gaussians(means, quats, scales, 0.1 + 0.9 * torch.rand(count, generator=random), sh)


def seconds(pictures: Path | None) -> dict:
    """Seconds of selecting a tenth of 1,000,000 Gaussians of degree 3, and of each operation on it."""
    scene = cloud(COUNT)
    nothing = torch.zeros(COUNT, dtype=torch.int32)
    state = EditState(scene, torch.arange(COUNT), nothing, nothing.bool())
    rows: dict[str, float] = {}
    selections = {
        "box": sg.Selection(("box:0,0,0,0.6,3,5",), clean=False),
        "box, cleaned": sg.Selection(("box:0,0,0,0.6,3,5",)),
        "box, cleaned, grown": sg.Selection(("box:0,0,0,0.6,3,5",), grow=0.05),
        "box, cleaned, shrunk": sg.Selection(("box:0,0,0,0.6,3,5",), grow=-0.05),
    }
    chosen = torch.zeros(COUNT, dtype=torch.bool)
    for name, selection in selections.items():
        start = time.perf_counter()
        found = pick(state, selection, EditContext())
        rows[f"select {name}"] = time.perf_counter() - start
        chosen = found if name == "box, cleaned" else chosen
    operations = (ops.Remove(), ops.Isolate(0.1), ops.Move((0.1, 0, 0)), ops.Rotate((0, 0, 1), 30.0), ops.Scale(1.5))
    for operation in (*operations, ops.Recolor((0.1, 0.6, 0.15)), ops.Duplicate((1.0, 0, 0))):
        start = time.perf_counter()
        operation.apply(scene, chosen)
        rows[operation.name] = time.perf_counter() - start
    start = time.perf_counter()
    ops.Rotate((0, 0, 1), 30.0).apply(scene, torch.ones(COUNT, dtype=torch.bool))
    rows["rotate all"] = time.perf_counter() - start
    print(json.dumps(rows, indent=1))
    return {"Gaussians": COUNT, "selected": int(chosen.sum()), "threads": torch.get_num_threads(), "seconds": rows}


def rotation(pictures: Path | None) -> dict:
    """How a picture differs from that of the turned scene and camera, in the demo room, and why.

    Of the pixels that differ by more than 1e-5 the float64 oracle says whether the two scenes themselves differ there,
    by what they round to, or else what decision of the rasterizer is so near that float32 may turn it.
    """
    room = Room.load()
    scene = room.gaussians
    quat = torch.nn.functional.normalize(torch.tensor([0.7, -0.3, 0.5, 0.4], dtype=torch.float64), dim=0)
    center = scene.means[scene.finite].double().mean(dim=0)
    turned = ops.rotate_gaussians(scene, torch.ones(len(scene), dtype=torch.bool), quat, center)
    R = ops.rotation_matrix(quat)
    back = torch.eye(4, dtype=torch.float64)  # x' = R (x - c) + c
    back[:3, :3], back[:3, 3] = R.T, center - R.T @ center
    rows = {}
    exact = RasterSettings(alpha_min=2.0**-16, transmittance_min=0.0)
    for name, settings in (("default cut-offs", RasterSettings()), ("without cut-offs", exact)):
        for view in room.held_out:
            camera = view.camera
            other = Camera(camera.K, camera.world_to_camera @ back, camera.width, camera.height)
            pair = [sg.render(one, eye, settings=settings) for one, eye in ((scene, camera), (turned, other))]
            error = (pair[0] - pair[1]).abs()
            row = {"largest": float(error.max()), "over 1e-5": float((error > 1e-5).float().mean())}
            y, x = (error.amax(dim=2) > 1e-5).nonzero().unbind(1)
            row |= causes((scene, camera), (turned, other), x, y, settings)
            rows[f"{name}, view {view.stem}"] = row
            print(name, view.stem, json.dumps(row), flush=True)
    return rows


def causes(
    one: tuple[Gaussians, Camera], other: tuple[Gaussians, Camera], x: Tensor, y: Tensor, settings: RasterSettings
) -> dict[str, float]:
    """Why pixels differ between two scenes that should look the same: counts of pixels."""
    first, second = (in_float64(*scene, x, y, settings) for scene in (one, other))
    apart = (first[0] - second[0]).abs().amax(dim=1)
    margin, order = (torch.minimum(a, b) for a, b in zip(first[1:], second[1:], strict=True))
    rounded = apart > 1e-5
    cut = ~rounded & (margin < NEAR)
    tied = ~rounded & ~cut & (order < TIE)
    rest = ~rounded & ~cut & ~tied
    return {
        "pixels": len(x),
        "differ in float64": int(rounded.sum()),
        "alpha or transmittance at a cut-off": int(cut.sum()),
        "two Gaussians of one depth": int(tied.sum()),
        "neither": int(rest.sum()),
        "largest in float64 elsewhere": float(apart[~rounded].max()) if bool((~rounded).any()) else 0.0,
    }


def in_float64(
    scene: Gaussians, camera: Camera, x: Tensor, y: Tensor, settings: RasterSettings
) -> tuple[Tensor, Tensor, Tensor]:
    """Colors of pixels by the oracle, float64 [P, 3], and how near they are to a cut-off and to another order, [P]."""
    knobs = reference.ReferenceSettings(alpha_min=settings.alpha_min, transmittance_min=settings.transmittance_min)
    shown = reference.project_scene(scene, camera, knobs)
    colors = reference.spherical_harmonics(scene.means.double(), scene.sh.double(), camera.world_to_camera)[shown.index]
    low, high = shown.mean2d - 1.01 * shown.extent - 1, shown.mean2d + 1.01 * shown.extent + 1
    found = []
    for px, py in zip(x.tolist(), y.tolist(), strict=True):
        pixel = torch.tensor([px, py])
        rows = ((low <= pixel + 1) & (high >= pixel)).all(dim=1).nonzero()[:, 0]
        blend = reference.blend_pixels(shown, rows, pixel[:1], pixel[1:], camera.width, knobs)
        found.append((blend.weights[0] @ colors[rows], blend.margin[0], blend.order_margin[0]))
    if not found:
        return torch.zeros(0, 3), torch.zeros(0), torch.zeros(0)
    color, margin, order = (torch.stack(part) for part in zip(*found, strict=True))
    return color, margin, order


PARTS = {"quality": quality, "objects": objects, "time": seconds, "rotation": rotation}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", default=list(PARTS), help=", ".join(PARTS))
    parser.add_argument("--out", type=Path, default=RESULTS)
    parser.add_argument("--pictures", type=Path, help="folder for before and after of each edit")
    options = parser.parse_args()
    results = json.loads(options.out.read_text()) if options.out.is_file() else {}
    for name in options.parts:
        results[name] = PARTS[name](options.pictures)
        options.out.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
