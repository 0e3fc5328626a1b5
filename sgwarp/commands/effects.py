"""Options that have no effect beside others: a command says so in one line, instead of taking them silently.

`NEEDS` lists every option that depends on another one, with what it goes with; all others of a command are in
`ALWAYS`. A new option belongs into one of the two, which a test asks for. Combinations that contradict each other are
refused by the commands themselves.
"""

from __future__ import annotations

import logging
import shlex
from collections.abc import Callable, Iterable
from dataclasses import fields
from pathlib import Path
from typing import Any, NamedTuple

logger = logging.getLogger("sgwarp")
LABELS = "the semantics were lifted from label images, whose names are asked as they are"
IDS = "the maps hold ids, which are not asked in words"


class Need(NamedTuple):
    """What an option goes with, in words, and whether a command has it."""

    words: str
    met: Callable[[Any], bool]


def _has(name: str) -> Callable[[Any], bool]:
    return lambda command: getattr(command, name) not in (None, "", ())


def _is(name: str, *values: Any) -> Callable[[Any], bool]:
    return lambda command: getattr(command, name) in values


def _moving_cameras(folder: str, split: str) -> Callable[[Any], bool]:
    def met(command: Any) -> bool:
        path: Path | None = getattr(command, folder)
        return path is not None and (path / f"{getattr(command, split)}_meta.json").is_file()

    return met


def _lifts(command: Any) -> bool:
    return not command.semantics or command.profile in ("room-instances", "scannet-instances", "panoptic-4d")


def _looks(command: Any) -> bool:
    clicks = any(word.startswith("click:") for word in (*command.select, *command.keep))
    return command.view is not None or clicks or command.script is not None


def _video(command: Any) -> bool:
    from sgwarp.reconstruction.sfm.video import is_video

    return is_video(command.photographs)


def _plain_ply(command: Any) -> bool:
    name = command.out.name.lower()
    return name.endswith(".ply") and not name.endswith(".compressed.ply")


def _one_scene(command: Any) -> bool:
    return command.data_set is None and command.scene.is_file() and command.scene.suffix != ".npz"


VIEWS = Need("--views", _has("views"))
CACHE = Need("a cache, but --cache is none", lambda command: command.cache != "none")
TWO = Need("--predicted", _has("predicted"))
BOTH = Need("an --ensemble of both, not 2d", lambda command: command.ensemble != "2d")
LIFT = Need("lifting, and --semantics are lifted already", _lifts)
NEEDS: dict[str, dict[str, Need]] = {
    "lift": {
        **dict.fromkeys(("tau", "border"), Need("--mode center", _is("mode", "center"))),
        "passes": Need("--mode robust", _is("mode", "robust")),
        **dict.fromkeys(("ridge", "iterations"), Need("--mode solve", _is("mode", "solve"))),
        "cache_limit": CACHE,
        "deterministic": Need("--device cuda; the CPU always is", lambda command: command.device.startswith("cuda")),
    },
    "query": {
        "predicted": BOTH,
        "ensemble": TWO,
        "canonical": Need("--score relevancy", lambda command: command.score != "cosine"),
    },
    "segment": {
        "predicted": BOTH,
        "ensemble": TWO,
        **dict.fromkeys(("encoder", "templates", "scoring", "temperature"), Need("--classes", _has("classes"))),
    },
    "distill": {
        **dict.fromkeys(
            ("encoder", "images", "views_per_step"), Need("--loss contrastive", _is("loss", "contrastive"))
        ),
        "up": Need("--augment", _is("augment", True)),
    },
    "predict": {"always": Need("--projection", _has("projection"))},
    "instances": {
        **dict.fromkeys(("least_iou", "least_cosine"), Need("--group association", _is("group", "association")))
    },
    "edit": {
        "transform": VIEWS,
        "images": VIEWS,
        "views": Need("--view, click: or --script", _looks),
        **dict.fromkeys(
            ("negatives", "threshold"),
            Need("texts, which need --semantics", lambda one: one.semantics is not None or one.script is not None),
        ),
    },
    "render": {
        **dict.fromkeys(("transform", "images"), VIEWS),
        **dict.fromkeys(("frames", "size", "up"), Need("a turn around the scene, without --views", _is("views", None))),
        "background": Need("--mode rgb", _is("mode", "rgb")),
    },
    "track": {
        "split": Need("cameras of Dynamic3DGaussians ({split}_meta.json)", _moving_cameras("views", "split")),
        "mask_split": Need(
            "--mask-views with {split}_meta.json of Dynamic3DGaussians", _moving_cameras("mask_views", "mask_split")
        ),
        **dict.fromkeys(("scoring", "temperature"), Need("--classes", _has("classes"))),
        "foreground": Need("params.npz of Dynamic3DGaussians", lambda command: command.scene.suffix == ".npz"),
        "cache_limit": CACHE,
    },
    "evaluate": {
        "ensemble": TWO,
        "epochs": Need("--ablate inputs", lambda command: "inputs" in (command.ablate or "").split(",")),
        "count": Need("Gaussians made of depth, without --gaussians", _is("gaussians", "")),
        **dict.fromkeys(("encoder", "levels", "method", "share_of_views", "cache"), LIFT),
        "forgetting": Need("profile panoptic-4d", _is("profile", "panoptic-4d")),
        "classes": Need("profile parts", _is("profile", "parts")),
    },
    "fit": {
        "init": Need("a new fit, not --resume", _is("resume", False)),
        "depth": Need(
            "--init auto or depth, without --resume", lambda one: one.init in ("auto", "depth") and not one.resume
        ),
        "points": Need(
            "--init points, or auto without --depth, and no --resume",
            lambda one: not one.resume and (one.init == "points" or (one.init == "auto" and one.depth is None)),
        ),
        "mask_hides": Need("--masks", lambda one: one.masks is not None and str(one.masks) != "none"),
        "held_out_poses": Need("--hold-out", lambda one: one.hold_out > 0),
    },
    "poses": {"every": Need("a video", _video)},
    "info": {
        "axes": Need("one scene, not a folder or a data set", _one_scene),
        "semantics": Need("one scene, not --data-set", _is("data_set", None)),
    },
    "convert": {
        "spz_version": Need(".spz", lambda command: command.out.name.lower().endswith(".spz")),
        "plain": Need(".ply; other formats have no further columns", _plain_ply),
        "device": Need("computing, which convert does not do", lambda command: command.device == "cpu"),
    },
    "view": {
        **dict.fromkeys(("transform", "images"), VIEWS),
        **dict.fromkeys(("encoder", "min_weight"), Need("--semantics", _has("semantics"))),
    },
}
COMMON = {"device", "threads", "command_line"}
SCENE = COMMON | {"scene", "axes"}
ALWAYS: dict[str, set[str]] = {
    "poses": COMMON | {"photographs", "out", "matching", "one_camera", "seed"},
    "fit": COMMON
    | {"views", "out", "steps", "hold_out", "strategy", "cap", "sh_degree", "downscale", "max_size", "background"}
    | {"masks", "exposure", "refine_poses", "sparse", "checkpoint_every", "resume", "seed", "images", "view"},
    "lift": SCENE
    | {"views", "transform", "out", "encoder", "cache", "mode", "reliability", "fill", "share_of_views"}
    | {"photographs", "images", "view"},
    "distill": COMMON
    | {"scenes", "out", "validation", "classes", "arch", "inputs", "voxel", "epochs", "learning_rate"}
    | {"scenes_per_step", "loss", "by_reliability", "augment", "half", "seed", "checkpoint"},
    "predict": SCENE | {"net", "out", "projection", "inputs", "voxel", "space"},
    "query": SCENE
    | {"semantics", "encoder", "templates", "min_weight", "views", "transform", "text", "view", "out", "score"}
    | {"threshold", "box", "images"},
    "segment": SCENE
    | {"semantics", "min_weight", "views", "transform", "out", "classes", "view", "unknown_below", "images"},
    "track": COMMON
    | {"scene", "views", "out", "encoder", "transform", "mask_views", "classes", "text", "forgetting", "patience"}
    | {"change", "associate", "frames", "unknown_below", "photographs", "incremental", "features", "pictures"}
    | {"resume", "cache"},
    "instances": SCENE
    | {"views", "transform", "images", "masks", "out", "group", "levels", "least_gaussians", "least_confidence"}
    | {"neighbors", "semantics", "classes", "ply", "render_views", "render_out"},
    "edit": SCENE
    | {"out", "select", "keep", "grow", "clean", "semantics", "instances", "encoder", "remove", "extract", "isolate"}
    | {"duplicate", "scale", "rotate", "move", "recolor", "plain", "script", "undo", "view"},
    "view": SCENE | {"semantics", "instances", "predicted", "views", "host", "port"},
    "render": SCENE | {"out", "views", "view", "mode"},
    "batch": {"scenes", "do", "out", "options", "engine", "address", "shard", "workers", "threads", "device", "gpus"}
    | {"retry_failed", "time_limit", "memory_limit", "command_line"},
    "info": COMMON | {"scene", "data_set", "json"},
    "convert": {"scene", "out", "axes", "out_axes", "threads", "command_line"},
    "encoders": {"json"},
    "evaluate": COMMON
    | {"profile", "data", "out", "scenes", "gaussians", "semantics", "predicted", "scoring", "threshold", "views"}
    | {"hold_out", "every", "share_of_gaussians", "ablate", "train", "sheets", "seed"},
    "report": SCENE
    | {"views", "transform", "images", "out", "labels", "held_out", "patches", "repeats", "seed", "extremes"},
    "demo": COMMON | {"out", "view"},
}


def say_without_effect(command: Any) -> None:
    """Log a line for every option that was given and has no effect beside the others."""
    for name, need in NEEDS.get(type(command).__name__.lower(), {}).items():
        if was_given(command, name) and not need.met(command):
            logger.warning("%s has no effect: it goes with %s", _flag(command, name), need.words)


def say_unused(command: Any, names: Iterable[str], why: str) -> None:
    """The same for options that what was read makes useless; `why` says so."""
    for name in names:
        if was_given(command, name):
            logger.warning("%s has no effect: %s", _flag(command, name), why)


def was_given(command: Any, name: str) -> bool:
    """Whether an option stood on the command line, or, where there was none, has another value than by default."""
    if command.command_line:
        words = {word.partition("=")[0].replace("_", "-") for word in shlex.split(command.command_line)}
        option = name.replace("_", "-")
        return bool(words & {f"--{option}", f"--no-{option}"})
    field = next(one for one in fields(command) if one.name == name)
    return bool(getattr(command, name) != field.default)


def _flag(command: Any, name: str) -> str:
    off = getattr(command, name) is False
    return f"--{'no-' * off}{name.replace('_', '-')}"
