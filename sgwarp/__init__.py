"""Open-vocabulary understanding of 3D Gaussian Splatting scenes.

Nothing heavy is imported until a name is used: neither torch nor warp comes with `import sgwarp`.
"""

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

from sgwarp.version import __version__ as __version__

if TYPE_CHECKING:
    from sgwarp.distill.data import TrainingScene as TrainingScene
    from sgwarp.distill.data import scenes_in as scenes_in
    from sgwarp.distill.settings import DistillSettings as DistillSettings
    from sgwarp.distill.train import distill as distill
    from sgwarp.encoders.registry import make_encoder as make_encoder
    from sgwarp.encoders.registry import text_encoder_for as text_encoder_for
    from sgwarp.errors import InputError as InputError
    from sgwarp.fit import fit as fit
    from sgwarp.fitting.settings import FitSettings as FitSettings
    from sgwarp.from_depth import gaussians_from_depth as gaussians_from_depth
    from sgwarp.io.openscene import load_openscene as load_openscene
    from sgwarp.io.points import load_points as load_points
    from sgwarp.io.scenes import load_gaussians as load_gaussians
    from sgwarp.io.scenes import save_gaussians as save_gaussians
    from sgwarp.io.store import load_semantics as load_semantics
    from sgwarp.io.store import save_semantics as save_semantics
    from sgwarp.io.views import load_views as load_views
    from sgwarp.lift import lift as lift
    from sgwarp.network import SemanticNetwork as SemanticNetwork
    from sgwarp.network import load_network as load_network
    from sgwarp.network import save_network as save_network
    from sgwarp.ops.contributors import top_contributors as top_contributors
    from sgwarp.ops.differentiable import rasterize as rasterize
    from sgwarp.ops.plan import RenderPlan as RenderPlan
    from sgwarp.ops.settings import RasterSettings as RasterSettings
    from sgwarp.orbit import orbit_views as orbit_views
    from sgwarp.predict import predict as predict
    from sgwarp.query import evidence as evidence
    from sgwarp.query import query as query
    from sgwarp.query import relevancy as relevancy
    from sgwarp.query import select as select
    from sgwarp.query import standardise as standardise
    from sgwarp.render import plan as plan
    from sgwarp.render import render as render
    from sgwarp.runlog import RunLog as RunLog
    from sgwarp.scene import Camera as Camera
    from sgwarp.scene import FeatureMap as FeatureMap
    from sgwarp.scene import Gaussians as Gaussians
    from sgwarp.scene import Semantics as Semantics
    from sgwarp.scene import View as View
    from sgwarp.segment import localize as localize
    from sgwarp.segment import segment as segment

_HOME = {
    "Camera": "sgwarp.scene",
    "DistillSettings": "sgwarp.distill.settings",
    "FeatureMap": "sgwarp.scene",
    "FitSettings": "sgwarp.fitting.settings",
    "Gaussians": "sgwarp.scene",
    "InputError": "sgwarp.errors",
    "RasterSettings": "sgwarp.ops.settings",
    "RenderPlan": "sgwarp.ops.plan",
    "RunLog": "sgwarp.runlog",
    "SemanticNetwork": "sgwarp.network",
    "Semantics": "sgwarp.scene",
    "TrainingScene": "sgwarp.distill.data",
    "View": "sgwarp.scene",
    "distill": "sgwarp.distill.train",
    "evidence": "sgwarp.query",
    "fit": "sgwarp.fit",
    "gaussians_from_depth": "sgwarp.from_depth",
    "lift": "sgwarp.lift",
    "load_gaussians": "sgwarp.io.scenes",
    "load_network": "sgwarp.network",
    "load_openscene": "sgwarp.io.openscene",
    "load_points": "sgwarp.io.points",
    "load_semantics": "sgwarp.io.store",
    "load_views": "sgwarp.io.views",
    "localize": "sgwarp.segment",
    "make_encoder": "sgwarp.encoders.registry",
    "orbit_views": "sgwarp.orbit",
    "predict": "sgwarp.predict",
    "plan": "sgwarp.render",
    "query": "sgwarp.query",
    "rasterize": "sgwarp.ops.differentiable",
    "relevancy": "sgwarp.query",
    "render": "sgwarp.render",
    "save_gaussians": "sgwarp.io.scenes",
    "save_network": "sgwarp.network",
    "save_semantics": "sgwarp.io.store",
    "scenes_in": "sgwarp.distill.data",
    "segment": "sgwarp.segment",
    "select": "sgwarp.query",
    "standardise": "sgwarp.query",
    "text_encoder_for": "sgwarp.encoders.registry",
    "top_contributors": "sgwarp.ops.contributors",
}
__all__ = [*_HOME, "__version__"]


class _Package(ModuleType):
    """`sgwarp.lift` is the function, whether or not something has imported the module of the same name.

    The import system binds a submodule to its name in the package once it is loaded; here a public name wins.
    """

    def __setattr__(self, name: str, value: Any) -> None:
        if isinstance(value, ModuleType) and name in _HOME:
            value = getattr(value, name)
        super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package


def __getattr__(name: str) -> Any:
    if name == "compat":  # a package of facades, not a name of its own
        return import_module("sgwarp.compat")
    if name not in _HOME:
        raise AttributeError(f"module 'sgwarp' has no attribute '{name}'")
    value = getattr(import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
