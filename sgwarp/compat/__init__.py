"""Drop-in counterparts of two CUDA rasterizers, gsplat and Inria's: change the import, keep the code.

They translate names, shapes and conventions; the rasterizer behind both is `sgwarp.ops`, on the CPU and on CUDA.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sgwarp.compat import gsplat as gsplat
    from sgwarp.compat import inria as inria

__all__ = ["gsplat", "inria"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module 'sgwarp.compat' has no attribute '{name}'")
    return import_module(f"sgwarp.compat.{name}")
