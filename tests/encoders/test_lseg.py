"""LSeg on a small checkpoint with the names of the published one; its parts against plain formulas."""

import math

import pytest
import torch
from torch.nn.functional import normalize

from sgwarp.encoders.pixels import lseg
from sgwarp.encoders.pixels.lseg import LSeg, clip_text_tower
from sgwarp.encoders.pixels.lseg_network import Fusion, LSegNetwork, LSegShape
from sgwarp.errors import InputError

WIDTH, DEPTH, PATCH, GRID, LEVELS, FEATURES, CHANNELS = 128, 8, 16, 4, (8, 12, 16, 20), 8, 24
TEXT_WIDTH, WORDS, LENGTH = 64, 1100, 16


def published_names() -> dict[str, tuple[int, ...]]:
    """Names and shapes as in demo_e200.ckpt (without `net.`), for the small sizes above."""
    names = {
        "pretrained.model.cls_token": (1, 1, WIDTH),
        "pretrained.model.pos_embed": (1, 1 + GRID**2, WIDTH),
        "pretrained.model.patch_embed.proj.weight": (WIDTH, 3, PATCH, PATCH),
        "pretrained.model.patch_embed.proj.bias": (WIDTH,),
        "pretrained.model.norm.weight": (WIDTH,),
        "pretrained.model.norm.bias": (WIDTH,),
        "pretrained.model.head.weight": (10, WIDTH),
        "pretrained.model.head.bias": (10,),
        "scratch.head1.weight": (CHANNELS, FEATURES, 1, 1),
        "scratch.head1.bias": (CHANNELS,),
    }
    for k in range(DEPTH):
        block = f"pretrained.model.blocks.{k}."
        sizes = {"attn.qkv": (3 * WIDTH, WIDTH), "attn.proj": (WIDTH, WIDTH)}
        sizes |= {"mlp.fc1": (4 * WIDTH, WIDTH), "mlp.fc2": (WIDTH, 4 * WIDTH)}
        for name, size in sizes.items():
            names |= {f"{block}{name}.weight": size, f"{block}{name}.bias": size[:1]}
        for name in ("norm1", "norm2"):
            names |= {f"{block}{name}.weight": (WIDTH,), f"{block}{name}.bias": (WIDTH,)}
    resize = {1: (4, 4), 2: (2, 2), 4: (3, 3)}  # kernels of the fourth step
    for k, level in enumerate(LEVELS, start=1):
        step = f"pretrained.act_postprocess{k}."
        names |= {f"{step}0.project.0.weight": (WIDTH, 2 * WIDTH), f"{step}0.project.0.bias": (WIDTH,)}
        names |= {f"{step}3.weight": (level, WIDTH, 1, 1), f"{step}3.bias": (level,)}
        if k in resize:
            names |= {f"{step}4.weight": (level, level, *resize[k]), f"{step}4.bias": (level,)}
        names[f"scratch.layer{k}_rn.weight"] = (FEATURES, level, 3, 3)
        fuse = f"scratch.refinenet{k}."
        names |= {f"{fuse}out_conv.weight": (FEATURES, FEATURES, 1, 1), f"{fuse}out_conv.bias": (FEATURES,)}
        for unit in ("resConfUnit1", "resConfUnit2"):
            for n in (1, 2):
                names[f"{fuse}{unit}.conv{n}.weight"] = (FEATURES, FEATURES, 3, 3)
                for kind in ("weight", "bias", "running_mean", "running_var"):
                    names[f"{fuse}{unit}.bn{n}.{kind}"] = (FEATURES,)
                names[f"{fuse}{unit}.bn{n}.num_batches_tracked"] = ()
    clip = {
        "token_embedding.weight": (WORDS, TEXT_WIDTH),
        "positional_embedding": (LENGTH, TEXT_WIDTH),
        "ln_final.weight": (TEXT_WIDTH,),
        "ln_final.bias": (TEXT_WIDTH,),
        "text_projection": (TEXT_WIDTH, CHANNELS),
        "logit_scale": (),
        "visual.conv1.weight": (16, 3, 8, 8),
    }
    for k in range(2):
        block = f"transformer.resblocks.{k}."
        clip |= {
            f"{block}attn.in_proj_weight": (3 * TEXT_WIDTH, TEXT_WIDTH),
            f"{block}attn.in_proj_bias": (3 * TEXT_WIDTH,),
        }
        sizes = {
            "attn.out_proj": (TEXT_WIDTH, TEXT_WIDTH),
            "mlp.c_fc": (96, TEXT_WIDTH),
            "mlp.c_proj": (TEXT_WIDTH, 96),
        }
        for name, size in sizes.items():
            clip |= {f"{block}{name}.weight": size, f"{block}{name}.bias": size[:1]}
        for name in ("ln_1", "ln_2"):
            clip |= {f"{block}{name}.weight": (TEXT_WIDTH,), f"{block}{name}.bias": (TEXT_WIDTH,)}
    return names | {f"clip_pretrained.{name}": size for name, size in clip.items()}


@pytest.fixture(scope="module")
def weights() -> dict[str, torch.Tensor]:
    noise = torch.Generator().manual_seed(0)
    made = {}
    for name, shape in published_names().items():
        values = torch.randn(shape, generator=noise) * 0.1
        if name.endswith("running_var"):
            values = values.abs() + 0.5
        if name.endswith("num_batches_tracked"):
            values = torch.tensor(3)
        made[name] = values
    return made


class Hyperparameters(dict):
    """Stands for the objects of its own that Lightning keeps in a checkpoint."""


@pytest.fixture(scope="module")
def checkpoint(weights, tmp_path_factory):
    path = tmp_path_factory.mktemp("lseg") / "demo_e200.ckpt"
    state = {f"net.{name}": value for name, value in weights.items()} | {"other.weight": torch.zeros(3)}
    torch.save({"epoch": 200, "state_dict": state, "hyper_parameters": Hyperparameters(lr=0.1)}, path)
    return path


@pytest.fixture(scope="module")
def tokenizer(tools, tmp_path_factory):
    folder = tmp_path_factory.mktemp("tokenizer")
    tools.write_tokenizer(folder)
    return str(folder)


def layer_norm(x, weight, bias, eps):
    x = x - x.mean(dim=-1, keepdim=True)
    return x / (x.square().mean(dim=-1, keepdim=True) + eps).sqrt() * weight + bias


def attention(x, qkv, bias, out, out_bias, heads, mask=None):
    """Head by head, with explicit softmax."""
    width = x.shape[1]
    q, k, v = (x @ qkv[i * width : (i + 1) * width].T + bias[i * width : (i + 1) * width] for i in range(3))
    size = width // heads
    parts = []
    for h in range(heads):
        part = slice(h * size, (h + 1) * size)
        logits = q[:, part] @ k[:, part].T / math.sqrt(size)
        parts.append((logits if mask is None else logits + mask).softmax(dim=-1) @ v[:, part])
    return torch.cat(parts, dim=1) @ out.T + out_bias


@pytest.mark.parametrize("patch", [8, 16])
def test_a_patch_gives_eight_cells_a_side(patch):
    network = LSegNetwork(LSegShape(64, 4, 1, patch, 2, (4, 4, 4, 4), 4, 3)).eval()
    assert network(torch.rand(1, 3, 4 * patch, 2 * patch)).shape == (1, 3, 8 * 4, 8 * 2)


def test_transformer_against_plain_formulas(checkpoint, weights):
    """Tokens after the layers that are read out, at a size for which the positions have to be resized."""
    network = LSeg(str(checkpoint), tokenizer="nowhere").network.double()
    images = torch.rand(1, 3, 32, 96, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    w = {name.removeprefix("pretrained.model."): value.double() for name, value in weights.items()}
    patches = [images[0, :, y : y + 16, x : x + 16] for y in range(0, 32, 16) for x in range(0, 96, 16)]
    kernel = w["patch_embed.proj.weight"].flatten(1)
    tokens = torch.stack([kernel @ patch.flatten() + w["patch_embed.proj.bias"] for patch in patches])
    grid = w["pos_embed"][0, 1:].reshape(4, 4, WIDTH).permute(2, 0, 1)[None]
    places = torch.nn.functional.interpolate(grid, (2, 6), mode="bilinear")[0].flatten(1).T
    x = torch.cat([w["cls_token"][0] + w["pos_embed"][0, :1], tokens + places])
    read = []
    for k in range(DEPTH):
        b = {name.removeprefix(f"blocks.{k}."): value for name, value in w.items() if name.startswith(f"blocks.{k}.")}
        h = layer_norm(x, b["norm1.weight"], b["norm1.bias"], 1e-6)
        x = x + attention(h, b["attn.qkv.weight"], b["attn.qkv.bias"], b["attn.proj.weight"], b["attn.proj.bias"], 2)
        h = layer_norm(x, b["norm2.weight"], b["norm2.bias"], 1e-6) @ b["mlp.fc1.weight"].T + b["mlp.fc1.bias"]
        h = h * 0.5 * (1 + torch.erf(h / math.sqrt(2)))
        x = x + h @ b["mlp.fc2.weight"].T + b["mlp.fc2.bias"]
        if k in (1, 3, 5, 7):
            read.append(x)
    with torch.no_grad():
        found = network.pretrained.model(images)
        maps = network.pretrained(images)
    for one, other in zip(found, read, strict=True):
        torch.testing.assert_close(one[0], other, rtol=1e-9, atol=1e-9)
    assert [list(one.shape[1:]) for one in maps] == [[8, 8, 24], [12, 4, 12], [16, 2, 6], [20, 1, 3]]
    # The third map has no resizing: the class token projected in, and a 1 x 1 convolution.
    c = {
        k.removeprefix("act_postprocess3."): v.double()
        for k, v in weights.items()
        for k in [k.removeprefix("pretrained.")]
    }
    joint = torch.cat([read[2][1:], read[2][:1].expand(12, -1)], dim=1)
    h = joint @ c["0.project.0.weight"].T + c["0.project.0.bias"]
    h = h * 0.5 * (1 + torch.erf(h / math.sqrt(2)))
    wanted = (h @ c["3.weight"][:, :, 0, 0].T + c["3.bias"]).T.reshape(16, 2, 6)
    torch.testing.assert_close(maps[2][0], wanted, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    "shape",
    [LSegShape(), LSegShape(64, 4, 1, 8, 2, (4, 5, 6, 7), 3, 9), LSegShape(32, 8, 1, 4, 5, (1, 2, 3, 4), 6, 5)],
)
def test_sizes_are_read_off_the_parameters(shape):
    with torch.device("meta"):
        network = LSegNetwork(shape)
    assert LSegShape.of(network.state_dict()) == shape


def test_fusion_against_plain_formulas():
    torch.manual_seed(0)
    fusion = Fusion(3).double().eval()
    coarse, fine = torch.randn(2, 1, 3, 4, 5, dtype=torch.float64)

    def unit(x, module):
        y = x
        for n in (1, 2):
            norm = getattr(module, f"bn{n}")
            y = torch.nn.functional.conv2d(y.clamp(min=0), getattr(module, f"conv{n}").weight, padding=1)
            scale = norm.weight / (norm.running_var + norm.eps).sqrt()
            y = (y - norm.running_mean[:, None, None]) * scale[:, None, None] + norm.bias[:, None, None]
        return x + y

    with torch.no_grad():
        summed = unit(coarse + unit(fine, fusion.resConfUnit1), fusion.resConfUnit2)[0]
        large = torch.zeros(3, 8, 10, dtype=torch.float64)
        for y in range(8):  # corners on corners
            for x in range(10):
                v, u = y * 3 / 7, x * 4 / 9
                j, i = min(int(v), 2), min(int(u), 3)
                a, b = v - j, u - i
                top = summed[:, j, i] * (1 - b) + summed[:, j, i + 1] * b
                low = summed[:, j + 1, i] * (1 - b) + summed[:, j + 1, i + 1] * b
                large[:, y, x] = top * (1 - a) + low * a
        wanted = torch.einsum("oc,cyx->oyx", fusion.out_conv.weight[:, :, 0, 0], large)
        wanted += fusion.out_conv.bias[:, None, None]
        torch.testing.assert_close(fusion(coarse, fine)[0], wanted, rtol=1e-9, atol=1e-9)


def test_pixels(checkpoint, image):
    encoder = LSeg(str(checkpoint), tokenizer="nowhere", longest=128)
    found = encoder.encode_pixels(image)
    assert found.shape == (48, 64, CHANNELS)  # half of 96 x 128
    torch.testing.assert_close(found.norm(dim=2), torch.ones(48, 64))
    large = torch.nn.functional.interpolate(
        image.permute(2, 0, 1)[None], (96, 128), mode="bicubic", antialias=True, align_corners=False
    ).clamp(0, 1)
    with torch.no_grad():
        wanted = encoder.network((large - 0.5) / 0.5)[0]
    torch.testing.assert_close(found, normalize(wanted, dim=0).permute(1, 2, 0), rtol=1e-4, atol=1e-5)


def test_the_network_sees_two_patches_at_least(checkpoint):
    assert LSeg(str(checkpoint), tokenizer="nowhere", longest=2 * PATCH).longest == 2 * PATCH
    with pytest.raises(InputError, match=r"longest side 31 is less than 32 pixels"):
        LSeg(str(checkpoint), tokenizer="nowhere", longest=2 * PATCH - 1)


def test_its_text_side_is_loaded_once_and_cuts_long_phrases(checkpoint, tokenizer, monkeypatch):
    loads = []
    load = lseg.load_tokenizer
    monkeypatch.setattr(lseg, "load_tokenizer", lambda *given: loads.append(given) or load(*given))
    encoder = LSeg(str(checkpoint), tokenizer=tokenizer)
    assert not loads
    long, cut = (encoder.encode_text(["couch " * count]) for count in (40, LENGTH - 2))
    torch.testing.assert_close(long, cut)
    torch.testing.assert_close(long.norm(dim=1), torch.ones(1))
    assert [given[0] for given in loads] == [tokenizer]


def test_phrases_by_the_checkpoints_own_text_tower(checkpoint, weights, tokenizer):
    """Against CLIP's text transformer written out from the published parameters."""
    encoder = LSeg(str(checkpoint), tokenizer=tokenizer)
    found = encoder.encode_text(["couch", "teddy bear"])
    w = {name.removeprefix("clip_pretrained."): value for name, value in weights.items()}
    for vector, row in zip(found, ([101, 200, 102], [101, 210, 211, 102]), strict=True):
        x = w["token_embedding.weight"][row] + w["positional_embedding"][: len(row)]
        mask = torch.full((len(row), len(row)), float("-inf")).triu(1)
        for k in range(2):
            b = {n.removeprefix(f"transformer.resblocks.{k}."): v for n, v in w.items()}
            h = layer_norm(x, b["ln_1.weight"], b["ln_1.bias"], 1e-5)
            x = x + attention(
                h,
                b["attn.in_proj_weight"],
                b["attn.in_proj_bias"],
                b["attn.out_proj.weight"],
                b["attn.out_proj.bias"],
                1,
                mask,
            )
            h = layer_norm(x, b["ln_2.weight"], b["ln_2.bias"], 1e-5) @ b["mlp.c_fc.weight"].T + b["mlp.c_fc.bias"]
            x = x + (h * torch.sigmoid(1.702 * h)) @ b["mlp.c_proj.weight"].T + b["mlp.c_proj.bias"]
        # OpenAI's code reads the phrase off where its token has the largest number.
        last = layer_norm(x, w["ln_final.weight"], w["ln_final.bias"], 1e-5)[max(range(len(row)), key=row.__getitem__)]
        torch.testing.assert_close(vector, normalize(last @ w["text_projection"], dim=0), rtol=1e-3, atol=1e-5)


def test_published_sizes():
    """The network at the size of the published checkpoint, without its memory, has its parameters and no others."""
    with torch.device("meta"):
        network = LSegNetwork(LSegShape())
    sizes = {name: list(value.shape) for name, value in network.state_dict().items()}
    assert sizes["pretrained.model.pos_embed"] == [1, 577, 1024]
    assert sizes["pretrained.model.blocks.23.attn.qkv.weight"] == [3072, 1024]
    assert sizes["pretrained.act_postprocess1.4.weight"] == [256, 256, 4, 4]
    assert sizes["pretrained.act_postprocess4.4.weight"] == [1024, 1024, 3, 3]
    assert sizes["scratch.layer4_rn.weight"] == [256, 1024, 3, 3]
    assert sizes["scratch.refinenet1.resConfUnit2.bn2.running_var"] == [256]
    assert sizes["scratch.head1.weight"] == [512, 256, 1, 1]
    assert LSegShape().read_out == (5, 11, 17, 23)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda w: w.pop("scratch.refinenet2.out_conv.bias"), r"1 missing: scratch\.refinenet2\.out_conv\.bias"),
        (lambda w: w.update({"scratch.extra": torch.zeros(1)}), r"1 left over: scratch\.extra"),
        (
            lambda w: w.update({"scratch.layer1_rn.weight": torch.zeros(8, 9, 3, 3)}),
            r"1 of another shape: scratch\.layer1_rn\.weight is \[8, 9, 3, 3\], not \[8, 8, 3, 3\]",
        ),
        (lambda w: w.pop("scratch.head1.weight"), r"is no LSeg .* lacks net\.scratch\.head1\.weight"),
    ],
)
def test_a_checkpoint_of_something_else(weights, tmp_path, change, message):
    changed = dict(weights)
    change(changed)
    path = tmp_path / "x.ckpt"
    torch.save({"state_dict": {f"net.{name}": value for name, value in changed.items()}}, path)
    with pytest.raises(InputError, match=message):
        LSeg(str(path))


@pytest.mark.slow
def test_damaged_checkpoints(checkpoint, weights, tmp_path):
    path = tmp_path / "x.ckpt"
    path.write_bytes(checkpoint.read_bytes()[:1000])
    with pytest.raises(InputError, match="is no archive, or is damaged"):
        LSeg(str(path))
    torch.save({"state_dict": {"model.weight": torch.zeros(2)}}, path)
    with pytest.raises(InputError, match=r"holds no parameters named net\.\*"):
        LSeg(str(path))
    with pytest.raises(InputError, match="no such file"):
        LSeg(str(tmp_path / "none.ckpt"))
    text = {name.removeprefix("clip_pretrained."): value for name, value in weights.items()}
    text.pop("ln_final.weight")
    with pytest.raises(InputError, match="holds no text tower of CLIP"):
        clip_text_tower("x", text)


class Bomb:
    """A checkpoint that would create a file when it is read."""

    def __init__(self, path):
        self.path = str(path)

    def __reduce__(self):
        return (open, (self.path, "w"))


def test_code_in_a_checkpoint_does_not_run(weights, tmp_path):
    path, harm = tmp_path / "x.ckpt", tmp_path / "harm"
    state = {f"net.{name}": value for name, value in weights.items()}
    torch.save({"state_dict": state, "hyper_parameters": Bomb(harm)}, path)
    LSeg(str(path))
    assert not harm.exists()
