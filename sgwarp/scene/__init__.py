"""The scene types that every stage shares: Gaussians, Camera, View, FeatureMap, Semantics.

All are frozen and validated once, at construction. World coordinates are in meters where known, cameras follow OpenCV
(x right, y down, z forward), quaternions are (w, x, y, z), pixel centers lie at .5.
"""

from sgwarp.scene.camera import Camera as Camera
from sgwarp.scene.features import FeatureMap as FeatureMap
from sgwarp.scene.gaussians import SH_COUNTS as SH_COUNTS
from sgwarp.scene.gaussians import Gaussians as Gaussians
from sgwarp.scene.gaussians import join_gaussians as join_gaussians
from sgwarp.scene.instances import NOTHING as NOTHING
from sgwarp.scene.instances import UNDECIDED as UNDECIDED
from sgwarp.scene.instances import Instance as Instance
from sgwarp.scene.instances import InstanceMap as InstanceMap
from sgwarp.scene.semantics import Semantics as Semantics
from sgwarp.scene.view import View as View
