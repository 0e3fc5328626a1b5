"""Numbers that results rest on: defaults of settings, and constants. To change one is a decision, made here as well.

Chunk sizes and other numbers that only cost time or memory are not listed.
"""

import ast
import math
from dataclasses import MISSING, fields
from importlib import import_module
from pathlib import Path

import pytest

import sgwarp

PACKAGE = Path(sgwarp.__file__).parent
MADE = "made by a function"

# Every class of settings with all its defaults.
SETTINGS = {
    "sgwarp.apps.instances.settings:InstanceSettings": {
        **{"grouping": "association", "levels": ("default",), "least_iou": 0.3, "least_shared": 0.1},
        **{"least_cosine": None, "samples_per_mask": 512, "pixel_weight": 1.0, "least_confidence": 0.55},
        **{"least_gaussians": 10, "neighbors": 8, "candidates": 3, "raster": MADE},
    },
    "sgwarp.apps.tracking.fusion:FusionSettings": {"forgetting": 0.9, "patience": 3, "change": None},
    "sgwarp.apps.tracking.tracker:TrackSettings": {
        **{"fusion": MADE, "incremental": True, "foreground": False, "raster": MADE, "device": "cpu"},
    },
    "sgwarp.encoders.images.conse.encoder:ConseSettings": {
        **{"map_sides": (480,), "side": 480, "crop_smallest": 100, "crop_largest": 0.4, "crop_side": 160},
        **{"crop_margin": 1.2, "crops": 96, "dense_cell": 16},
    },
    "sgwarp.encoders.instances.detections:DetectorSettings": {"least_score": 0.25, "overlap": 0.7},
    "sgwarp.encoders.masks.sam:SamSettings": {  # those of Segment Anything's generator, but for the first and longest
        **{"points": 32, "together": 64, "least_score": 0.88, "least_stability": 0.95, "offset": 1.0, "overlap": 0.7},
        **{"smallest": 1e-4, "longest": 1024, "by_rank": False},
    },
    "sgwarp.evaluation.networks:NetworkSettings": {"epochs": 30, "arch": "14A", "voxel": 0.05, "train": None},
    "sgwarp.evaluation.settings:Settings": {
        **{"encoder": "conse", "levels": (), "method": "weighted", "gaussians": "", "semantics": "", "predicted": ""},
        **{"ensemble": "max", "scoring": None, "classes": (), "threshold": 0.5, "views": "strict", "hold_out": 8},
        **{"every": 1, "share_of_views": 1.0, "share_of_gaussians": 1.0, "count": 100_000, "forgetting": 0.9},
        **{"sheets": 3, "seed": 0, "device": "cpu", "cache": None},
    },
    "sgwarp.lifting.settings:LiftSettings": {
        **{"tau": 0.05, "border": 10, "passes": 4, "smoothing": 1e-3, "ridge": 0.0, "iterations": 4},
        **{"reliability": False, "fill": 0},
    },
    "sgwarp.network.training.settings:DistillSettings": {
        **{"arch": "34A", "inputs": "full", "voxel": 0.02, "epochs": 100, "learning_rate": 1e-3, "weight_decay": 0.01},
        **{"scenes_per_step": 1, "by_reliability": False, "augment": MADE, "half": False, "loss": "cosine"},
        **{"views_per_step": 2, "contributors": 16, "temperature": 0.07, "validate_every": 1, "seed": 0},
    },
    "sgwarp.ops.planar.projection:ProjectionSettings": {  # gsplat's, but for what it has no name for
        **{"camera_model": "pinhole", "near": 0.01, "far": 1e10, "dilation": 0.3, "radius_clip": 0.0},
        **{"compensated": False, "min_area_ratio": 1e-12, "alpha_min": 1 / 255},
    },
    "sgwarp.ops.reference.rasterizer:ReferenceSettings": {
        **{"alpha_min": 1 / 255, "alpha_max": 0.999, "transmittance_min": 1e-4, "eps2d": 0.3},
        **{"surface_opacity": 0.5, "antialiased": False},
    },
    "sgwarp.ops.splatting.settings:RasterSettings": {
        **{"alpha_min": 1 / 255, "alpha_max": 0.999, "transmittance_min": 1e-4, "dilation": 0.3},
        **{"surface_opacity": 0.5, "sh_degree": None, "antialiased": False},
    },
}
# Classes that are settings under another name.
SETTINGS |= {
    "sgwarp.apps.editing.selection:Selection": {
        **{"keep": (), "negatives": (), "threshold": 0.5, "grow": 0.0, "clean": True},
    },
    "sgwarp.apps.tracking.answers:Questions": {
        **{"classes": None, "texts": (), "encoder": None, "scoring": None, "temperature": None, "unknown_below": 0.0},
    },
    "sgwarp.apps.tracking.run:Output": {
        **{"masks": None, "features": False, "pictures": True, "every": 10, "settings": MADE},
    },
    "sgwarp.encoders.compose:Crops": {"margin": 1.2, "background": True, "batch": 32},
    "sgwarp.encoders.masks.proposals:Proposals": {"method": "graph", "scales": (), "side": 480, "smallest": 60},
    "sgwarp.encoders.pixels.lseg_network:LSegShape": {  # ViT-L/16 at 384 pixels, and LSeg's head
        **{"width": 1024, "depth": 24, "heads": 16, "patch": 16, "grid": 24, "levels": (256, 512, 1024, 1024)},
        **{"features": 256, "channels": 512},
    },
    "sgwarp.encoders.weights:Preparation": {
        **{"mean": (0.5, 0.5, 0.5), "deviation": (0.5, 0.5, 0.5), "size": (), "way": "bicubic"},
    },
    "sgwarp.network.augmentation:Augmentation": {  # those of Mink's and OpenScene's training
        **{"up": 2, "tilt": math.pi / 64, "turn": math.pi, "scale": (0.9, 1.1), "mirror": True},
        **{"elastic": ((0.2, 0.4), (0.8, 1.6)), "shift": 100.0},
    },
    # What a step of an edit does if it is not told otherwise.
    "sgwarp.apps.editing.operations:Isolate": {"fade": 0.1},
    "sgwarp.apps.editing.operations:Fade": {"factor": 0.0},
    "sgwarp.apps.editing.operations:Move": {"by": (0.0, 0.0, 0.0)},
    "sgwarp.apps.editing.operations:Rotate": {"axis": (0.0, 0.0, 1.0), "degrees": 0.0},
    "sgwarp.apps.editing.operations:Scale": {"factor": 1.0},
    "sgwarp.apps.editing.operations:Recolor": {"color": (0.5, 0.5, 0.5)},
    "sgwarp.apps.editing.operations:Duplicate": {"by": (0.0, 0.0, 0.0)},
}

CONSTANTS = {
    "sgwarp.apps.editing.measurement": {"VISIBLE": 0.04},
    "sgwarp.apps.editing.operations": {
        "SH_C0": 1 / (2 * math.sqrt(math.pi)),
        "LUMA": (0.2126, 0.7152, 0.0722),  # Rec. 709
    },
    "sgwarp.apps.editing.picker": {
        **{"NEIGHBORS": 8, "LINK": 4.0, "LEAST_PIECE": 0.1, "GUESSED": ("text", "id", "box", "click"), "HALF": 0.5},
        **{"SAME": 0.8, "CLICK_DEPTH": 8, "LOOKS_ALIKE": 0.9},
    },
    "sgwarp.apps.editing.selection": {"KINDS": ("text", "id", "box", "click", "copy", "rows")},
    "sgwarp.apps.instances.association": {"FAINT": 0.01},
    "sgwarp.apps.instances.counts": {"SURE": 0.8},
    "sgwarp.apps.instances.description": {"TRIMMED": 0.02, "INSIDE": 0.5, "ALIKE": 0.9},
    "sgwarp.apps.instances.evidence": {"MAX_SETS": 2**15 - 1},
    "sgwarp.apps.tracking.answers": {"BEST_SHARE": 0.01, "INNER": (0.02, 0.98)},
    "sgwarp.apps.tracking.association": {
        **{"CLEAR": 0.5, "LIKELY": 0.25, "PART": 0.2, "LEAST_PIXELS": 16, "MEMORY": 0.7, "KNOWN": 0.5},
    },
    "sgwarp.apps.tracking.facts": {"SAMPLES": 8},
    "sgwarp.apps.tracking.fusion": {"LABEL_CHANGE": 0.5, "LEAST_CHANGE": 0.05, "TIMES_MEDIAN": 4.0},
    "sgwarp.apps.tracking.pictures": {"SHEET": 9, "SIDE_BY_SIDE": 4, "FRAMES_PER_SECOND": 10, "LEGEND": 20},
    "sgwarp.apps.tracking.points": {"MIN_NORM2": 1e-6},
    "sgwarp.apps.tracking.state": {"STORED_CHANGE": 0.01},
    "sgwarp.encoders.base": {"LEVELS": ("default", "s", "m", "l"), "UNRANKED": -1},
    "sgwarp.encoders.cache": {"DEFAULT_LIMIT": 10.0, "GIGABYTE": 1e9},
    "sgwarp.encoders.compose": {"REST_CELLS": 16},
    "sgwarp.encoders.images.clip": {"SIGLIP_LENGTH": 64},  # as SigLIP was trained
    "sgwarp.encoders.images.conse.class_space": {"TEMPERATURE": 0.05, "TOP_CLASSES": 10},  # ten, as in ConSE
    "sgwarp.encoders.images.conse.classifier": {"MEAN": 127.0, "DEVIATION": 128.0, "STRIDE": 32},
    "sgwarp.encoders.images.conse.text": {"LEAST_LIKENESS": 0.56},
    "sgwarp.encoders.instances.grounding_dino": {"LEAST_SCORE": 0.25, "STRIDE": 32, "END": "."},
    "sgwarp.encoders.instances.owlv2": {"LEAST_SCORE": 0.1, "GREY": 0.5},
    "sgwarp.encoders.maps.closed_set": {"STRIDE": 32, "TASK": "the task is semantic"},
    "sgwarp.encoders.masks.proposals": {
        **{"SMOOTHING": 0.5, "DEFAULT_SCALES": {"graph": 300.0, "slic": 24.0, "seeds": 24.0, "selective": 24.0}},
    },
    "sgwarp.encoders.pixels.lseg_network": {"EPSILON": 1e-6},  # of timm's layer norms
    "sgwarp.encoders.prompts": {
        "CANONICAL": ("object", "things", "stuff", "texture"),  # LERF's
        "PLAIN": ("{}",),
        "PHOTO": ("a photo of a {}",),
    },
    "sgwarp.encoders.regions": {"GREY": 127},
    "sgwarp.encoders.weights": {"WAYS": {0: "nearest-exact", 2: "bilinear", 3: "bicubic"}},  # Pillow's numbers
    "sgwarp.evaluation.ablation": {"SHARES": (1.0, 0.5, 0.2, 0.1), "INPUTS": ("full", "xyz-rgb")},
    "sgwarp.evaluation.profiles.instances": {
        **{"SMALLEST_IN_VIEW": 50, "SMALLEST_IN_MESH": 100, "SURFACES": (1, 2)},  # 100 vertices: ScanNet's own
    },
    "sgwarp.evaluation.profiles.lerf_ovs": {
        "GRAY_ABOVE": 10 / 255,  # OpenGaussian's
        "GRAY": (0.299, 0.587, 0.114),  # ITU-R 601
        "SCENES": ("figurines", "ramen", "teatime", "waldo_kitchen"),
    },
    "sgwarp.evaluation.profiles.masks": {"RELEVANT": 0.5},
    "sgwarp.evaluation.profiles.panoptic": {"UNKNOWN": 255},
    "sgwarp.evaluation.profiles.parts": {"AGREES": 0.05, "STEP": 2},
    "sgwarp.evaluation.profiles.room": {"SMALLEST": 50},
    "sgwarp.evaluation.profiles.scannet": {"FAINT": 0.1},  # OpenGaussian's
    "sgwarp.evaluation.report.extremes": {"COUNT": 200, "FAR": 1e5, "ON_ONE_TILE": 100_000, "NEAR": 0.01},
    "sgwarp.evaluation.report.oracle": {"SIDE": 16, "THRESHOLD_BAND": 1e-4, "ORDER_BAND": 2e-6},
    "sgwarp.evaluation.report.plot": {"NEAR": 0.02, "CROWDED": 5},
    "sgwarp.evaluation.report.sweep": {
        "ALPHA_MIN": (1 / 1024, 1 / 128, 1 / 64, 1 / 32),
        "TRANSMITTANCE_MIN": (1e-5, 1e-3, 1e-2, 1e-1),
        "SHARES_OF_GAUSSIANS": (0.75, 0.5, 0.25, 0.1),
        "SHARES_OF_VIEWS": (0.75, 0.5, 0.25, 0.1),
        "DOWNSCALES": (2, 4, 8),
    },
    "sgwarp.evaluation.rivals.nearest_points": {"TOLERANCE": 0.25, "OPAQUE": 0.5},  # OpenScene's tolerance
    "sgwarp.evaluation.rivals.optimization": {"RATE": 0.05, "DECODER_RATE": 0.01},
    "sgwarp.lifting.holes": {"TRUST": 1e-3},
    "sgwarp.lifting.reliability": {"POWER": 2.0, "LEAST": 0.01},
    "sgwarp.lifting.residuals": {"PIXELS": 20_000},
    "sgwarp.lifting.ridge": {"RIDGES": (1.0, 10.0, 100.0), "HOLD_OUT": 6, "CHANNELS_TO_CHOOSE": 32},
    "sgwarp.metrics.detection": {"THRESHOLDS": (0.5, 0.55, 0.6, 0.65, 0.7, 0.75, 0.8, 0.85, 0.9)},  # ScanNet's
    "sgwarp.metrics.overlap": {"DILATION": 0.02},  # Cheng et al. 2021
    "sgwarp.metrics.relevancy_maps": {"SIDE": 30, "LEVEL": 0.4, "MAJORITY": 3},  # LangSplat's
    "sgwarp.metrics.tracking": {
        **{"THRESHOLDS": (1.0, 2.0, 4.0, 8.0, 16.0), "LOST_BEYOND": 50.0, "MATCH_ABOVE": 0.5},  # TAP-Vid's
    },
    "sgwarp.network.augmentation": {"LATTICE": 64},
    "sgwarp.network.inputs": {
        "INPUT_CHANNELS": {"full": 10, "xyz-rgb": 3, "raw56": 56, "ones": 3, "signed-rgb": 3},
        "SH_C0": 1 / (2 * math.sqrt(math.pi)),
        **{"BRIGHTEST": 10.0, "ORIGIN_STEP": 16, "SMALLEST": 1e-10},
    },
    "sgwarp.network.quality": {"TWO_VIEWS": 1.5},
    "sgwarp.network.training.contrastive": {"SAME": 0.999, "LEAST_SHARE": 0.5},
    "sgwarp.ops.adam": {"BETAS": (0.9, 0.999)},
    "sgwarp.ops.planar.projection": {
        "CAMERA_MODELS": ("pinhole", "ortho", "fisheye"),
        **{"MIN_QUAT_NORM2": 1e-6, "ALPHA_MAX": 0.999, "FULL_REACH": 3.33},  # gsplat's
        "FACTOR_UNIT": math.sqrt(1 / (2 * math.log(2))),
    },
    "sgwarp.ops.reference.fitting": {"WINDOW": 11, "DEVIATION": 1.5, "STABILISERS": (1e-4, 9e-4)},  # of SSIM
    "sgwarp.ops.splatting.incremental": {"REBUILD_ABOVE": 0.5},
    "sgwarp.querying.segmentation": {"UNKNOWN": 255, "BOX": 9, "KNOWN_OPACITY": 0.5},
    "kernels.fitting.adam": {
        **{"BETA_1": 0.9, "BETA_2": 0.999, "EPSILON": 1e-15},  # the trainer's of 3DGS
        **{"FAINTNESS": 0.995, "STEEPNESS": 100.0, "OPAQUE": 0.17},  # 3DGS-MCMC's noise
    },
    "kernels.fitting.photometric_lanes": {"RADIUS": 5, "DEVIATION": 1.5, "C1": 1e-4, "C2": 9e-4},
    "kernels.gaussian": {
        "LOG2_E": 1 / math.log(2),
        "UNIT": math.sqrt(1 / (2 * math.log(2))),
        "MIN_QUAT_NORM2": 1e-6,
        "LEVEL_SLACK": 1e-4,
    },
    "kernels.projection.backward": {"LN_2": math.log(2), "POSE_COLUMNS": 12},
    "kernels.projection.forward": {
        "STATUS_NAMES": ("visible", "non_finite", "transparent", "outside_depth", "off_screen", "degenerate"),
        **{"VISIBLE": 0, "NON_FINITE": 1, "TRANSPARENT": 2, "OUTSIDE_DEPTH": 3, "OFF_SCREEN": 4, "DEGENERATE": 5},
    },
    "kernels.projection.table": {"FULL_REACH": 3.33, "TABLE_COLUMNS": 13, "AT_DEPTH": 6},
    "kernels.sparse.voxels": {"AXIS_BITS": 17, "BATCH_BITS": 12, "BIAS": 2**16, "LIMIT": 2**16 - 256},
}


@pytest.mark.parametrize("place", SETTINGS)
def test_defaults_of_settings(place):
    module, _, name = place.partition(":")
    found = {}
    for field in fields(getattr(import_module(module), name)):
        if field.default_factory is not MISSING or type(field.default).__name__.endswith("Settings"):
            found[field.name] = MADE
        elif field.default is not MISSING:
            found[field.name] = field.default
    assert found == SETTINGS[place]


def test_every_class_of_settings_is_listed():
    found = set()
    for folder in ("apps", "encoders", "evaluation", "lifting", "network", "ops"):
        for path in (PACKAGE / folder).rglob("*.py"):
            module = ".".join(("sgwarp", *path.relative_to(PACKAGE).with_suffix("").parts))
            found |= {
                f"{module}:{node.name}"
                for node in ast.parse(path.read_text()).body
                if isinstance(node, ast.ClassDef) and node.name.endswith("Settings")
            }
    assert found
    assert found <= set(SETTINGS)


@pytest.mark.parametrize("module", CONSTANTS)
def test_constants(module):
    loaded = import_module(module if module.startswith("sgwarp") else f"sgwarp.{module}")
    for name, expected in CONSTANTS[module].items():
        found = getattr(loaded, name)
        if isinstance(expected, float):
            assert float(found) == pytest.approx(expected, rel=1e-7), name
        else:
            assert found == expected, name
