"""Keeping what a caller has set up for torch away from code that does not expect it."""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextlib import ExitStack
from functools import wraps
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")


def uncompiled(function: Callable[P, R]) -> Callable[P, R]:
    """Keep `torch.compile` out of a function: it breaks the graph there once, instead of tracing kernel launches.

    The compiler is not imported for that; it is asked only where somebody else has loaded it.
    """
    kept: list[Callable[P, R]] = []

    @wraps(function)
    def run(*args: P.args, **kwargs: P.kwargs) -> R:
        compiler = sys.modules.get("torch._dynamo")
        if compiler is None:
            return function(*args, **kwargs)
        if not kept:
            kept.append(compiler.disable(function))
        return kept[0](*args, **kwargs)

    return run


def isolated(function: Callable[P, R]) -> Callable[P, R]:
    """Make a function the same under `torch.autocast` and `torch.set_default_device` as without them.

    Autocast would take products in half precision that are exact by design, a default device would put tensors on the
    GPU that belong to the host. Backward passes are not concerned: they run with the precision of their forward pass.
    """

    @uncompiled
    @wraps(function)
    def run(*args: P.args, **kwargs: P.kwargs) -> R:
        import torch

        with ExitStack() as scope:
            for kind in ("cpu", "cuda"):
                if torch.is_autocast_enabled(kind):
                    scope.enter_context(torch.autocast(kind, enabled=False))
            if torch.get_default_device().type != "cpu":
                scope.enter_context(torch.device("cpu"))
            return function(*args, **kwargs)

    return run
