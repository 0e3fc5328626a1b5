"""Keeping what a caller has set up for torch away from code that does not expect it."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from functools import wraps
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")


def isolated(function: Callable[P, R]) -> Callable[P, R]:
    """Make a function the same under `torch.autocast` and `torch.set_default_device` as without them.

    Autocast would take products in half precision that are exact by design, a default device would put tensors on the
    GPU that belong to the host. Backward passes are not concerned: they run with the precision of their forward pass.
    """

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
