"""Tiny networks of the real classes, written as the hub's folders are, to be loaded by the adapters' own code."""

import json
import os
from pathlib import Path

import pytest
import torch

from sgwarp.scene import Camera, View

os.environ["HF_HUB_OFFLINE"] = "1"  # before transformers is imported for the first time

WORDS = ("couch", "lamp", "cup", "the", "task", "is", "semantic", "a", "photo", "of", "teddy", "bear")
MEAN, DEVIATION = (0.48, 0.45, 0.40), (0.26, 0.25, 0.27)
TEXT = {
    "vocab_size": 1100,
    "hidden_size": 32,
    "intermediate_size": 48,
    "num_hidden_layers": 2,
    "num_attention_heads": 2,
    "max_position_embeddings": 16,
    "eos_token_id": 102,
    "bos_token_id": 101,
    "pad_token_id": 0,
}
VISION = {
    "hidden_size": 32,
    "intermediate_size": 48,
    "num_hidden_layers": 2,
    "num_attention_heads": 2,
    "image_size": 32,
    "patch_size": 8,
}


def make_view(height: int = 48, width: int = 64, stem: str = "a") -> View:
    K = torch.tensor([[50.0, 0, width / 2], [0, 50.0, height / 2], [0, 0, 1]])
    return View(stem, Camera(K, torch.eye(4), width, height))


def write_tokenizer(folder: Path, length: int = 16) -> None:
    """Words apart by spaces, with BERT's numbers for the marks, which GroundingDINO knows by heart."""
    transformers = pytest.importorskip("transformers")
    tokenizers = pytest.importorskip("tokenizers")

    numbers = {"[PAD]": 0, "[UNK]": 100, "[CLS]": 101, "[SEP]": 102, ".": 1012}
    numbers |= {word: 200 + place for place, word in enumerate(WORDS)}
    numbers |= {f"[unused{k}]": k for k in range(1100) if k not in numbers.values()}
    words = tokenizers.Tokenizer(tokenizers.models.WordLevel(numbers, unk_token="[UNK]"))
    words.pre_tokenizer = tokenizers.pre_tokenizers.BertPreTokenizer()
    marks = [("[CLS]", 101), ("[SEP]", 102)]
    words.post_processor = tokenizers.processors.TemplateProcessing(single="[CLS] $A [SEP]", special_tokens=marks)
    names = {"unk": "[UNK]", "pad": "[PAD]", "cls": "[CLS]", "sep": "[SEP]"}
    transformers.PreTrainedTokenizerFast(
        tokenizer_object=words, model_max_length=length, **{f"{kind}_token": name for kind, name in names.items()}
    ).save_pretrained(folder)


def write_preparation(folder: Path, size: dict[str, int], resample: int = 3) -> None:
    content = {"image_mean": MEAN, "image_std": DEVIATION, "size": size, "resample": resample}
    (folder / "preprocessor_config.json").write_text(json.dumps(content))


def write_model(folder: Path, model) -> None:
    """Weights in which nothing is zero or one by construction, so that nothing cancels by chance."""
    noise = torch.Generator().manual_seed(7)
    with torch.no_grad():
        for value in model.parameters():
            value += 0.02 * torch.randn(value.shape, generator=noise)
    model.save_pretrained(folder)


def write_joint(folder: Path, kind: str) -> None:
    transformers = pytest.importorskip("transformers")

    torch.manual_seed(0)
    if kind == "clip":
        config = transformers.CLIPConfig(text_config=TEXT, vision_config=VISION, projection_dim=24)
        write_model(folder, transformers.CLIPModel(config))
    elif kind == "siglip":
        write_model(folder, transformers.SiglipModel(transformers.SiglipConfig(text_config=TEXT, vision_config=VISION)))
    else:
        vision = {key: value for key, value in VISION.items() if key != "image_size"} | {"num_patches": 16}
        config = transformers.Siglip2Config(text_config=TEXT, vision_config=vision)
        write_model(folder, transformers.Siglip2Model(config))
    write_tokenizer(folder)
    write_preparation(folder, {"height": 32, "width": 32})


@pytest.fixture(scope="session")
def joint_models(tmp_path_factory) -> dict[str, Path]:
    """Folders of a tiny CLIP, SigLIP and SigLIP 2."""
    folders = {kind: tmp_path_factory.mktemp(kind) for kind in ("clip", "siglip", "siglip2")}
    for kind, folder in folders.items():
        write_joint(folder, kind)
    return folders


def write_sam(folder: Path, kind: str) -> None:
    transformers = pytest.importorskip("transformers")

    torch.manual_seed(1)
    decoder = {
        "hidden_size": 16,
        "mlp_dim": 16,
        "num_attention_heads": 2,
        "num_hidden_layers": 2,
        "iou_head_depth": 2,
        "iou_head_hidden_dim": 16,
    }
    prompts = {"hidden_size": 16, "image_size": 64, "patch_size": 16, "mask_input_channels": 4}
    if kind == "sam":
        vision = {
            "hidden_size": 16,
            "output_channels": 16,
            "num_hidden_layers": 2,
            "num_attention_heads": 2,
            "image_size": 64,
            "patch_size": 16,
            "window_size": 2,
            "num_pos_feats": 8,
            "global_attn_indexes": [1],
            "mlp_dim": 32,
        }
        config = transformers.SamConfig(
            vision_config=vision,
            prompt_encoder_config={**prompts, "image_embedding_size": 4},
            mask_decoder_config=decoder,
        )
        write_model(folder, transformers.SamModel(config))
        write_preparation(folder, {"longest_edge": 64})
        return
    if kind == "sam2":
        backbone = {
            "model_type": "sam2_hiera_det_model",
            "hidden_size": 8,
            "num_attention_heads": 1,
            "image_size": [64, 64],
            "blocks_per_stage": [1, 1, 2, 1],
            "embed_dim_per_stage": [8, 16, 32, 64],
            "num_attention_heads_per_stage": [1, 1, 2, 2],
            "window_size_per_stage": [8, 4, 4, 4],
            "global_attention_blocks": [3],
            "window_positional_embedding_background_size": [4, 4],
        }
        vision = transformers.Sam2VisionConfig(
            backbone_config=backbone,
            backbone_channel_list=[64, 32, 16, 8],
            backbone_feature_sizes=[[16, 16], [8, 8], [4, 4]],
            fpn_hidden_size=16,
        )
        config = transformers.Sam2Config(
            vision_config=vision, prompt_encoder_config=prompts, mask_decoder_config=decoder
        )
        write_model(folder, transformers.Sam2Model(config))
    else:
        vision = transformers.Sam3VisionConfig(
            backbone_config={
                "model_type": "sam3_vit_model",
                "hidden_size": 16,
                "intermediate_size": 24,
                "num_hidden_layers": 2,
                "num_attention_heads": 2,
                "image_size": 64,
                "pretrain_image_size": 32,
                "patch_size": 16,
                "window_size": 2,
                "global_attn_indexes": [1],
            },
            fpn_hidden_size=16,
            backbone_feature_sizes=[[16, 16], [8, 8], [4, 4]],
        )
        config = transformers.Sam3TrackerConfig(
            vision_config=vision, prompt_encoder_config=prompts, mask_decoder_config=decoder
        )
        write_model(folder, transformers.Sam3TrackerModel(config))
    write_preparation(folder, {"height": 64, "width": 64}, resample=2)


@pytest.fixture(scope="session")
def sam_models(tmp_path_factory) -> dict[str, Path]:
    """Folders of a tiny SAM, SAM 2 and SAM 3."""
    folders = {kind: tmp_path_factory.mktemp(kind) for kind in ("sam", "sam2", "sam3")}
    for kind, folder in folders.items():
        write_sam(folder, kind)
    return folders


@pytest.fixture
def image() -> torch.Tensor:
    """Noise of 48 x 64 with some structure."""
    noise = torch.Generator().manual_seed(3)
    coarse = torch.rand(1, 3, 6, 8, generator=noise)
    fine = torch.rand(1, 3, 48, 64, generator=noise)
    large = torch.nn.functional.interpolate(coarse, (48, 64), mode="nearest")
    return (0.7 * large + 0.3 * fine)[0].permute(1, 2, 0)


@pytest.fixture
def view() -> View:
    return make_view()


class Tools:
    """What the tests of several adapters write their models with."""

    write_tokenizer = staticmethod(write_tokenizer)
    write_preparation = staticmethod(write_preparation)
    write_model = staticmethod(write_model)
    make_view = staticmethod(make_view)
    text, vision = TEXT, VISION
    mean, deviation = torch.tensor(MEAN), torch.tensor(DEVIATION)


@pytest.fixture(scope="session")
def tools() -> type[Tools]:
    return Tools
