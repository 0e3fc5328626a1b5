"""Lift modes and their rivals: error beside seconds and bytes, on two labelled rooms.

    SGWARP_DATA=FOLDER python -m benchmarks.lifting_modes [choose] [sweep] [rivals] [encoder] [plot] [--out FILE.json]

What is lifted are true labels, corrupted as `labelled_rooms` states. choose: settings of the modes on the generated
room. sweep: every mode with them on both rooms, at 100, 50, 20 and 10 % of the views and of the Gaussians. rivals:
nearest points, and features fitted by gradient descent, measured along the way. time: the seconds of the rows with all
views again, for a machine that was busy. encoder: the default encoder's maps in place of labels, on the rendered room.
plot: accuracy against seconds. Parts not asked for keep their figures in the file.

Per row: share of the Gaussians with the true class (an unseen one has none), mIoU on held-out views, share of the
pixels there whose rendered label is not the true one (`residual`), coverage, seconds without making the maps, bytes of
the features and of all arrays of their size that are held at once.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args

import torch

import sgwarp as sg
from benchmarks.labelled_rooms import LabelledRoom, generated_room, rendered_room
from sgwarp.evaluation.rivals.nearest_points import fuse_nearest_points
from sgwarp.evaluation.rivals.optimization import Snapshot, fit_features
from sgwarp.lifting.residuals import residual
from sgwarp.lifting.settings import LiftMode, LiftSettings
from sgwarp.metrics.segmentation import ConfusionMatrix
from sgwarp.querying.scores import class_votes
from sgwarp.querying.segmentation import segment_votes
from sgwarp.runs.log import RunLog
from sgwarp.scene import FeatureMap, Semantics, View

Row = dict[str, Any]
SHARES = (1.0, 0.5, 0.2, 0.1)
ARRAYS = {"weighted": 1, "center": 1, "squared": 1, "strongest": 1, "robust": 4, "solve": 2, "reliable": 2}
FITTED_ARRAYS = 4  # features, gradient, and both moments of Adam
FITS = {"fitted": None, "fitted, 8 channels": 8}
LOOK_AT = (10, 30, 100, 300, 1000, 3000)
CHOICES: dict[str, list[dict[str, Any]]] = {
    "center": [{"tau": tau, "border": border} for tau in (0.02, 0.05, 0.25) for border in (0, 10)],
    "robust": [{"passes": p, "smoothing": s} for p, s in ((2, 1e-3), (4, 1e-3), (8, 1e-3), (4, 1e-1))],
    "solve": [{"ridge": r, "iterations": n} for r, n in ((1.0, 4), (10.0, 4), (100.0, 4), (10.0, 8))],
}


def measure(room: LabelledRoom, semantics: Semantics, seconds: float, arrays: int) -> Row:
    """The figures of lifted labels."""
    known = room.of_gaussians >= 0
    best = torch.where(semantics.seen, semantics.features.argmax(dim=1), -1)
    votes = class_votes(semantics, None)
    confusion = ConfusionMatrix.empty(len(room.classes))
    missed = []
    for view in room.held_out:
        confusion.add(segment_votes(room.gaussians, view.camera, votes, semantics.seen)[0], room.truth[view.stem])
        weight = semantics.weight.sign()
        missed.append(residual(room.gaussians, view.camera, room.true(view), semantics.features, weight))
    size = semantics.features.nbytes
    return {
        "accuracy": float((best == room.of_gaussians)[known].float().mean()),
        "mIoU": confusion.miou,
        "residual": sum(missed) / len(missed),
        "coverage": semantics.coverage,
        "seconds": seconds,
        "bytes": size + semantics.weight.nbytes + semantics.effective_views.nbytes,
        "bytes held": arrays * size,
    }


def lift_with(room: LabelledRoom, mode: LiftMode, settings: LiftSettings, arrays: int) -> Row:
    """Lift corrupted labels and measure; maps are made before."""
    maps = {view.stem: room.noisy(view) for view in room.views}
    log = RunLog()
    start = time.perf_counter()
    semantics = sg.lift(room.gaussians, room.views, maps, mode, lift_settings=settings, log=log)
    seconds = time.perf_counter() - start - log.stages.get("residual", 0.0)
    row = measure(room, semantics, seconds, arrays)
    return row | {name: log.error[name] for name in ("ridge", "least_reliability") if name in log.error}


def tuned(results: Row) -> dict[str, tuple[LiftMode, LiftSettings, int]]:
    """Every mode with the settings chosen on the generated room, and the weighted mean of reliable views."""
    chosen = {name: part["settings"] for name, part in results.get("choose", {}).items()}
    modes: dict[str, tuple[LiftMode, LiftSettings, int]] = {
        mode: (mode, LiftSettings(**chosen.get(mode, {})), ARRAYS[mode]) for mode in get_args(LiftMode)
    }
    return modes | {"reliable": ("weighted", LiftSettings(reliability=True), ARRAYS["reliable"])}


def choose(rooms: dict[str, LabelledRoom], results: Row, save: Callable[[Row], None]) -> None:
    """The settings of each mode with the highest mIoU on held-out views of the generated room."""
    found: Row = {}
    for mode, options in CHOICES.items():
        rows = [lift_with(rooms["generated"], mode, LiftSettings(**one), ARRAYS[mode]) for one in options]  # type: ignore[arg-type]
        best = max(range(len(rows)), key=lambda k: rows[k]["mIoU"])
        tried = [{**one, "mIoU": row["mIoU"]} for one, row in zip(options, rows, strict=True)]
        found[mode] = {"settings": options[best], "tried": tried}
        print(mode, options[best], f"mIoU {rows[best]['mIoU']:.3f}", flush=True)
    save(found)


def sweep(rooms: dict[str, LabelledRoom], results: Row, save: Callable[[Row], None]) -> None:
    """Every mode at every share."""
    rows: Row = {}
    parts = {name: _parts(room) for name, room in rooms.items()}
    for what in next(iter(parts.values())):
        for name, part in ((name, found[what]) for name, found in parts.items()):
            for method, (mode, settings, arrays) in tuned(results).items():
                row = rows[f"{name}, {what}, {method}"] = lift_with(part, mode, settings, arrays)
                _tell(name, what, method, row)
            save(rows)


def share_name(share: float) -> str:
    return f"{share:.0%} of views"


def _parts(room: LabelledRoom) -> dict[str, LabelledRoom]:
    views = {share_name(share): room.with_views(share) for share in SHARES}
    return views | {f"{share:.0%} of Gaussians": room.with_gaussians(share) for share in SHARES[1:]}


def rivals(rooms: dict[str, LabelledRoom], results: Row, save: Callable[[Row], None]) -> None:
    """What others do with the same maps."""
    rows: Row = {}
    for name, room in rooms.items():
        maps = {view.stem: room.noisy(view) for view in room.views}
        confusion = ConfusionMatrix.empty(len(room.classes))
        for view in room.held_out:
            confusion.add(room.noisy(view).ids[0], room.truth[view.stem])  # type: ignore[index]
        rows[f"{name}, 2D alone"] = {"mIoU": confusion.miou, "residual": 1 - confusion.pixel_accuracy}
        start = time.perf_counter()
        semantics = fuse_nearest_points(room.gaussians, room.views, maps)
        rows[f"{name}, nearest points"] = measure(room, semantics, time.perf_counter() - start, 2)
        for what, channels in FITS.items():

            def look(at: Snapshot, what: str = what, name: str = name, room: LabelledRoom = room) -> None:
                weight = at.features.abs().amax(dim=1).sign()
                semantics = Semantics(at.features, weight, weight, "labels", room.gaussians.fingerprint, room.classes)
                row = rows[f"{name}, {what}, {at.step} steps"] = measure(room, semantics, at.seconds, FITTED_ARRAYS)
                _tell(name, what, str(at.step), row)

            fit_features(
                room.gaussians, room.views, maps, steps=LOOK_AT[-1], channels=channels, look=look, look_at=LOOK_AT
            )
            save(rows)


def measure_time(rooms: dict[str, LabelledRoom], results: Row, save: Callable[[Row], None]) -> None:
    """Seconds of the modes with all views and Gaussians, and of a step of each fit, put into the other parts' rows."""
    for name, room in rooms.items():
        maps = {view.stem: room.noisy(view) for view in room.views}
        few = {view.stem: maps[view.stem] for view in room.views[:2]}
        for method, (mode, settings, _) in tuned(results).items():
            sg.lift(room.gaussians, room.views[:2], few, mode, lift_settings=settings)  # compiles
            log = RunLog()
            start = time.perf_counter()
            sg.lift(room.gaussians, room.views, maps, mode, lift_settings=settings, log=log)
            seconds = time.perf_counter() - start - log.stages.get("residual", 0.0)
            results["sweep"][f"{name}, {share_name(1.0)}, {method}"]["seconds"] = seconds
        start = time.perf_counter()
        fuse_nearest_points(room.gaussians, room.views, maps)
        results["rivals"][f"{name}, nearest points"]["seconds"] = time.perf_counter() - start
        for what, channels in FITS.items():
            seen: list[Snapshot] = []
            fit_features(
                *(room.gaussians, room.views, maps), steps=60, channels=channels, look=seen.append, look_at=(10, 60)
            )
            per_step = (seen[1].seconds - seen[0].seconds) / 50
            for step in LOOK_AT:
                if (key := f"{name}, {what}, {step} steps") in results["rivals"]:
                    results["rivals"][key]["seconds"] = step * per_step
    save({"seconds": "of the rows with all views, and of a step of each fit"})


def encoder(rooms: dict[str, LabelledRoom], results: Row, save: Callable[[Row], None]) -> None:
    """The default encoder on the rendered room: 3D accuracy of its furniture, and the residual of its own maps."""
    from sgwarp.encoders.cache import CachedMaps, default_folder

    room = rooms["rendered"]
    source = CachedMaps(sg.make_encoder("conse"), default_folder())
    stems = [view.stem for view in (*room.views, *room.held_out)]
    maps = {stem: source.encode(room.photographs[stem], room.photographs[stem].image()) for stem in stems}
    furniture = room.classes[: room.classes.index("floor")]
    known = (room.of_gaussians >= 0) & (room.of_gaussians < len(furniture))
    rows: Row = {}
    for method, (mode, settings, arrays) in tuned(results).items():
        log = RunLog()
        start = time.perf_counter()
        semantics = sg.lift(room.gaussians, room.views, maps, mode, lift_settings=settings, log=log)
        seconds = time.perf_counter() - start - log.stages.get("residual", 0.0)
        votes = class_votes(semantics, furniture, source)
        best = torch.where(votes.amax(dim=1) > 1 - votes.sum(dim=1), votes.argmax(dim=1), -1)
        confusion = ConfusionMatrix.empty(len(furniture) + 1)
        errors = []
        for view in room.held_out:
            found = segment_votes(room.gaussians, view.camera, votes, semantics.seen)[0]
            background = len(furniture)
            confusion.add(found.where(found >= 0, background), room.truth[view.stem].clamp(max=background))
            errors.append(_missed(room, view, maps[view.stem], semantics))
        row = rows[method] = {
            "accuracy": float((best == room.of_gaussians)[known].float().mean()),
            "mIoU": float(confusion.iou[: len(furniture)].mean()),
            "residual": sum(errors) / len(errors),
            "coverage": semantics.coverage,
            "seconds": seconds,
            "bytes": semantics.features.nbytes,
            "bytes held": arrays * semantics.features.nbytes,
        }
        _tell("conse", "100%", method, row)
        save(rows)


def _missed(room: LabelledRoom, view: View, found: FeatureMap, semantics: Semantics) -> float:
    return residual(room.gaussians, view.camera, found, semantics.features, semantics.weight.sign())


def _tell(*row: Any) -> None:
    *names, figures = row
    shown = ", ".join(f"{name} {value:.4g}" for name, value in figures.items())
    print(f"{', '.join(names)}: {shown}", flush=True)


def plot(results: Row, path: Path) -> None:
    """Accuracy against seconds of every mode and rival, one panel for each room."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, panels = plt.subplots(1, 2, figsize=(11, 4.6), sharey=True)
    for panel, room in zip(panels, ("rendered", "generated"), strict=True):
        start = f"{room}, 100% of views, "
        rows = {key.removeprefix(start): row for key, row in results["sweep"].items() if key.startswith(start)}
        _mark(panel, rows | {"nearest points": results["rivals"][f"{room}, nearest points"]})
        for what, color in (("fitted", "tab:red"), ("fitted, 8 channels", "tab:orange")):
            keys = [f"{room}, {what}, {step} steps" for step in LOOK_AT]
            fits = [results["rivals"][key] for key in keys if key in results["rivals"]]
            panel.plot([r["seconds"] for r in fits], [r["mIoU"] for r in fits], "^-", color=color, label=what)
        alone = results["rivals"][f"{room}, 2D alone"]["mIoU"]
        panel.axhline(alone, color="grey", linestyle=":", label="2D maps alone")
        panel.set(title=f"{room} room", xscale="log", xlim=(0.02, 120), xlabel="seconds (without the maps)")
        panel.set_ylim(-0.03, 0.75)
        panel.grid(alpha=0.3)
    panels[0].set_ylabel("mIoU on held-out views")
    panels[1].legend(loc="lower right")
    figure.tight_layout()
    figure.savefig(path, dpi=110)


def _mark(panel: Any, rows: Row) -> None:
    """Points with names. Those of one walk over the views lie close together: their names stand in a column beside."""
    close = sorted((name for name in rows if rows[name]["seconds"] < 0.8), key=lambda name: -rows[name]["mIoU"])
    for name, row in rows.items():
        rival = name == "nearest points"
        panel.plot(row["seconds"], row["mIoU"], "s" if rival else "o", color="tab:green" if rival else "tab:blue")
        if name not in close:
            panel.annotate(name, (row["seconds"], row["mIoU"]), textcoords="offset points", xytext=(0, -13), fontsize=8)
    for place, name in enumerate(close):
        at = (rows[name]["seconds"], rows[name]["mIoU"])
        line = {"arrowstyle": "-", "color": "0.7", "linewidth": 0.7}
        panel.annotate(
            name, at, xytext=(0.16, 0.7 - 0.04 * place), ha="right", va="center", fontsize=8, arrowprops=line
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parts = {"choose": choose, "sweep": sweep, "rivals": rivals, "time": measure_time, "encoder": encoder}
    parser.add_argument("parts", nargs="*", choices=[*parts, "plot", []], help="all if none is named")
    parser.add_argument("--out", type=Path, default=Path(__file__).with_name("lifting_modes.json"))
    parser.add_argument("--picture", type=Path, default=Path("docs/images/lifting_modes.png"))
    parser.add_argument("--count", type=int, default=30_000, help="Gaussians of the rendered room")
    parser.add_argument("--cache", type=Path, default=Path(tempfile.gettempdir()) / "sgwarp-benchmark-rooms")
    options = parser.parse_args()
    data = os.environ.get("SGWARP_DATA")
    if data is None:
        raise SystemExit("set SGWARP_DATA to the folder that holds room/")
    results: Row = json.loads(options.out.read_text()) if options.out.is_file() else {}
    asked = options.parts or [*parts, "plot"]

    def save(part: str, found: Row) -> None:
        results[part] = found
        options.out.write_text(json.dumps(results, indent=1) + "\n")

    if set(asked) & set(parts):
        rooms = {
            "generated": generated_room(options.cache),
            "rendered": rendered_room(Path(data) / "room", options.count),
        }
        for part in parts:
            if part in asked:
                parts[part](rooms, results, lambda found, part=part: save(part, found))  # type: ignore[misc]
    if "plot" in asked:
        plot(results, options.picture)


if __name__ == "__main__":
    main()
