"""Open-vocabulary understanding of 3D Gaussian Splatting scenes.

Nothing heavy is imported until a name is used: neither torch nor warp comes with `import sgwarp`.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from sgwarp.version import __version__ as __version__

if TYPE_CHECKING:
    from sgwarp.apps.editing.picker import EditContext as EditContext
    from sgwarp.apps.editing.script import EditStep as EditStep
    from sgwarp.apps.editing.selection import Selection as Selection
    from sgwarp.apps.editing.session import EditSession as EditSession
    from sgwarp.apps.editing.session import edit as edit
    from sgwarp.apps.instances.finder import instances as instances
    from sgwarp.apps.instances.settings import InstanceSettings as InstanceSettings
    from sgwarp.apps.tracking.fusion import FusionSettings as FusionSettings
    from sgwarp.apps.tracking.points import carry_points as carry_points
    from sgwarp.apps.tracking.tracker import TrackSettings as TrackSettings
    from sgwarp.apps.tracking.tracker import track as track
    from sgwarp.encoders.registry import make_encoder as make_encoder
    from sgwarp.encoders.registry import text_encoder_for as text_encoder_for
    from sgwarp.errors import InputError as InputError
    from sgwarp.io.instances import load_instances as load_instances
    from sgwarp.io.instances import save_instances as save_instances
    from sgwarp.io.moving_views import load_moving_views as load_moving_views
    from sgwarp.io.openscene import load_openscene as load_openscene
    from sgwarp.io.points import load_points as load_points
    from sgwarp.io.scenes import load_gaussians as load_gaussians
    from sgwarp.io.scenes import save_gaussians as save_gaussians
    from sgwarp.io.sequences import load_sequence as load_sequence
    from sgwarp.io.store import load_semantics as load_semantics
    from sgwarp.io.store import save_semantics as save_semantics
    from sgwarp.io.views import load_views as load_views
    from sgwarp.lifting.lifter import lift as lift
    from sgwarp.lifting.settings import LiftSettings as LiftSettings
    from sgwarp.network.prediction import predict as predict
    from sgwarp.network.semantic_network import SemanticNetwork as SemanticNetwork
    from sgwarp.network.semantic_network import load_network as load_network
    from sgwarp.network.semantic_network import save_network as save_network
    from sgwarp.network.training.data import TrainingScene as TrainingScene
    from sgwarp.network.training.data import scenes_in as scenes_in
    from sgwarp.network.training.settings import DistillSettings as DistillSettings
    from sgwarp.network.training.trainer import distill as distill
    from sgwarp.ops.splatting.autograd import rasterize as rasterize
    from sgwarp.ops.splatting.contributors import top_contributors as top_contributors
    from sgwarp.ops.splatting.plan import RenderPlan as RenderPlan
    from sgwarp.ops.splatting.room import ListRoom as ListRoom
    from sgwarp.ops.splatting.settings import RasterSettings as RasterSettings
    from sgwarp.querying.scores import evidence as evidence
    from sgwarp.querying.scores import query as query
    from sgwarp.querying.scores import relevancy as relevancy
    from sgwarp.querying.scores import select as select
    from sgwarp.querying.scores import standardise as standardise
    from sgwarp.querying.scoring import TextScores as TextScores
    from sgwarp.querying.scoring import best_texts as best_texts
    from sgwarp.querying.scoring import score_texts as score_texts
    from sgwarp.querying.segmentation import localize as localize
    from sgwarp.querying.segmentation import segment as segment
    from sgwarp.reconstruction.depth import gaussians_from_depth as gaussians_from_depth
    from sgwarp.reconstruction.fitting.settings import FitSettings as FitSettings
    from sgwarp.reconstruction.fitting.trainer import fit as fit
    from sgwarp.rendering.orbits import orbit_views as orbit_views
    from sgwarp.rendering.renderer import plan as plan
    from sgwarp.rendering.renderer import render as render
    from sgwarp.runs.log import RunLog as RunLog
    from sgwarp.scene import Camera as Camera
    from sgwarp.scene import FeatureMap as FeatureMap
    from sgwarp.scene import Gaussians as Gaussians
    from sgwarp.scene import Instance as Instance
    from sgwarp.scene import InstanceMap as InstanceMap
    from sgwarp.scene import Semantics as Semantics
    from sgwarp.scene import View as View

_HOME = {
    "Camera": "sgwarp.scene",
    "DistillSettings": "sgwarp.network.training.settings",
    "EditContext": "sgwarp.apps.editing.picker",
    "EditSession": "sgwarp.apps.editing.session",
    "EditStep": "sgwarp.apps.editing.script",
    "FeatureMap": "sgwarp.scene",
    "FitSettings": "sgwarp.reconstruction.fitting.settings",
    "FusionSettings": "sgwarp.apps.tracking.fusion",
    "Gaussians": "sgwarp.scene",
    "InputError": "sgwarp.errors",
    "Instance": "sgwarp.scene",
    "InstanceMap": "sgwarp.scene",
    "InstanceSettings": "sgwarp.apps.instances.settings",
    "LiftSettings": "sgwarp.lifting.settings",
    "ListRoom": "sgwarp.ops.splatting.room",
    "RasterSettings": "sgwarp.ops.splatting.settings",
    "RenderPlan": "sgwarp.ops.splatting.plan",
    "RunLog": "sgwarp.runs.log",
    "Selection": "sgwarp.apps.editing.selection",
    "SemanticNetwork": "sgwarp.network.semantic_network",
    "Semantics": "sgwarp.scene",
    "TextScores": "sgwarp.querying.scoring",
    "TrackSettings": "sgwarp.apps.tracking.tracker",
    "TrainingScene": "sgwarp.network.training.data",
    "View": "sgwarp.scene",
    "best_texts": "sgwarp.querying.scoring",
    "carry_points": "sgwarp.apps.tracking.points",
    "distill": "sgwarp.network.training.trainer",
    "edit": "sgwarp.apps.editing.session",
    "evidence": "sgwarp.querying.scores",
    "fit": "sgwarp.reconstruction.fitting.trainer",
    "gaussians_from_depth": "sgwarp.reconstruction.depth",
    "instances": "sgwarp.apps.instances.finder",
    "lift": "sgwarp.lifting.lifter",
    "load_gaussians": "sgwarp.io.scenes",
    "load_moving_views": "sgwarp.io.moving_views",
    "load_instances": "sgwarp.io.instances",
    "load_network": "sgwarp.network.semantic_network",
    "load_openscene": "sgwarp.io.openscene",
    "load_points": "sgwarp.io.points",
    "load_semantics": "sgwarp.io.store",
    "load_sequence": "sgwarp.io.sequences",
    "load_views": "sgwarp.io.views",
    "localize": "sgwarp.querying.segmentation",
    "make_encoder": "sgwarp.encoders.registry",
    "orbit_views": "sgwarp.rendering.orbits",
    "plan": "sgwarp.rendering.renderer",
    "predict": "sgwarp.network.prediction",
    "query": "sgwarp.querying.scores",
    "rasterize": "sgwarp.ops.splatting.autograd",
    "relevancy": "sgwarp.querying.scores",
    "render": "sgwarp.rendering.renderer",
    "save_gaussians": "sgwarp.io.scenes",
    "save_instances": "sgwarp.io.instances",
    "save_network": "sgwarp.network.semantic_network",
    "save_semantics": "sgwarp.io.store",
    "scenes_in": "sgwarp.network.training.data",
    "score_texts": "sgwarp.querying.scoring",
    "segment": "sgwarp.querying.segmentation",
    "select": "sgwarp.querying.scores",
    "standardise": "sgwarp.querying.scores",
    "text_encoder_for": "sgwarp.encoders.registry",
    "top_contributors": "sgwarp.ops.splatting.contributors",
    "track": "sgwarp.apps.tracking.tracker",
}
__all__ = [*_HOME, "__version__"]


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
