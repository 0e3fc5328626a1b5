"""Defaults that `--help` prints and guides, figures and scripts of users rely on: to change one is a decision."""

from dataclasses import fields

import pytest

from sgwarp.commands import COMMANDS

DEFAULTS = {
    "batch": {"engine": "local", "workers": 1, "retry_failed": False},
    "convert": {"spz_version": 4, "plain": False, "axes": None, "out_axes": None},
    "distill": {
        **{"arch": "34A", "inputs": "full", "voxel": 0.02, "epochs": 100, "learning_rate": 1e-3, "up": "z"},
        **{"scenes_per_step": 1, "loss": "cosine", "encoder": "conse", "views_per_step": 2, "augment": True, "seed": 0},
        **{"by_reliability": False},
    },
    "edit": {"threshold": 0.5, "grow": 0.0, "clean": True, "remove": False, "extract": False},
    "evaluate": {
        **{"method": "weighted", "ensemble": "max", "share_of_views": 1.0, "share_of_gaussians": 1.0},
        **{"count": 100_000, "forgetting": 0.9, "epochs": 30, "sheets": 3, "seed": 0},
    },
    "fit": {
        **{"steps": 10_000, "hold_out": 8, "strategy": "mcmc", "cap": 100_000, "sh_degree": 3, "downscale": 1},
        **{
            "max_size": 1600,
            "background": "black",
            "init": "auto",
            "sparse": True,
            "checkpoint_every": 1000,
            "seed": 0,
        },
    },
    "instances": {
        **{"group": "association", "levels": "default", "least_iou": 0.3, "least_gaussians": 10},
        **{"least_confidence": 0.55, "neighbors": 8, "least_cosine": None},
    },
    "lift": {
        **{"encoder": "conse", "cache_limit": 10.0, "mode": "weighted", "tau": 0.05, "border": 10, "passes": 4},
        **{"ridge": 0.0, "iterations": 4, "fill": 0, "share_of_views": 1.0, "photographs": True},
        **{"reliability": False, "deterministic": False},
    },
    "poses": {"matching": "auto", "one_camera": True, "every": None, "seed": 0},
    "predict": {"projection": None, "always": False, "inputs": None, "voxel": None},
    "query": {
        **{"min_weight": 0.0, "ensemble": "max", "threshold": 0.5, "box": 9, "score": None},
        "canonical": ("object", "things", "stuff", "texture"),
    },
    "render": {"mode": "rgb", "background": "black", "frames": 12, "size": (640, 480), "up": "y-down"},
    "report": {"held_out": 2, "patches": 60, "repeats": 5, "extremes": True, "seed": 0},
    "segment": {"min_weight": 0.0, "ensemble": "max", "unknown_below": 0.0},
    "track": {
        **{"encoder": "conse", "split": "train", "mask_split": "test", "forgetting": 0.9, "patience": 3},
        **{"unknown_below": 0.0, "photographs": True, "incremental": True, "pictures": True, "cache_limit": 10.0},
    },
    "view": {"min_weight": 0.0, "host": "127.0.0.1", "port": 8080},
}


@pytest.mark.parametrize("name", DEFAULTS)
def test_defaults_are_those_that_users_rely_on(name):
    found = {field.name: field.default for field in fields(COMMANDS[name])}
    assert found["device"] == "cpu"
    assert {option: found[option] for option in DEFAULTS[name]} == DEFAULTS[name]
