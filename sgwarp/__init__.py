"""Open-vocabulary understanding of 3D Gaussian Splatting scenes.

Nothing heavy is imported until a name is used: neither torch nor warp comes with `import sgwarp`.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from sgwarp.version import __version__ as __version__

if TYPE_CHECKING:
    from sgwarp.errors import InputError as InputError
    from sgwarp.scene import Camera as Camera
    from sgwarp.scene import FeatureMap as FeatureMap
    from sgwarp.scene import Gaussians as Gaussians
    from sgwarp.scene import Semantics as Semantics
    from sgwarp.scene import View as View

_HOME = {
    "InputError": "sgwarp.errors",
    "Camera": "sgwarp.scene",
    "FeatureMap": "sgwarp.scene",
    "Gaussians": "sgwarp.scene",
    "Semantics": "sgwarp.scene",
    "View": "sgwarp.scene",
}
__all__ = [*_HOME, "__version__"]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'sgwarp' has no attribute '{name}'")
    value = getattr(import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
