"""The network of LSeg (Li et al., Language-driven Semantic Segmentation, 2022), with the parameter names it was
published under.

A vision transformer of timm (`pretrained.model`), of which four layers are read out, each with its class token
projected in (`pretrained.act_postprocess1` to 4); a dense prediction transformer that fuses them from coarse to fine
(`scratch`, after Ranftl et al., Vision Transformers for Dense Prediction, 2021); and a 1 x 1 convolution into the space
of CLIP's phrases (`scratch.head1`). The features come at half the resolution of the input.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate, scaled_dot_product_attention

EPSILON = 1e-6  # of timm's layer norms


@dataclass(frozen=True)
class LSegShape:
    """Sizes of the network; `of` reads them off a checkpoint.

    Attributes:
        width: Of the transformer's tokens.
        depth: Layers of the transformer.
        heads: Of its attention, 64 channels each.
        patch: Side of a patch [pixels].
        grid: Patches along the side of the image it was trained on.
        levels: Channels of the four layers that are read out.
        features: Channels of the fusion.
        channels: Of the output.
    """

    width: int = 1024
    depth: int = 24
    heads: int = 16
    patch: int = 16
    grid: int = 24
    levels: tuple[int, int, int, int] = (256, 512, 1024, 1024)
    features: int = 256
    channels: int = 512

    @classmethod
    def of(cls, weights: Mapping[str, Tensor]) -> LSegShape:
        """Sizes of the network that wrote these weights.

        Raises:
            KeyError: A parameter that tells is missing; its name is the argument.
        """
        patches = weights["pretrained.model.patch_embed.proj.weight"].shape
        layers = {name.split(".")[3] for name in weights if name.startswith("pretrained.model.blocks.")}
        head = weights["scratch.head1.weight"].shape
        return cls(
            width=patches[0],
            depth=len(layers),
            heads=max(1, patches[0] // 64),
            patch=patches[2],
            grid=round((weights["pretrained.model.pos_embed"].shape[1] - 1) ** 0.5),
            levels=tuple(weights[f"pretrained.act_postprocess{k}.3.weight"].shape[0] for k in range(1, 5)),  # type: ignore[arg-type]
            features=head[1],
            channels=head[0],
        )

    @property
    def read_out(self) -> tuple[int, ...]:
        """Layers whose output is read: 5, 11, 17 and 23 of 24."""
        return tuple(self.depth * k // 4 - 1 for k in range(1, 5))


class Attention(nn.Module):
    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.qkv = nn.Linear(width, 3 * width)
        self.proj = nn.Linear(width, width)

    def forward(self, tokens: Tensor) -> Tensor:
        q, k, v = self.qkv(tokens).unflatten(2, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)
        return self.proj(scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(2))


class Mlp(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.fc1 = nn.Linear(width, 4 * width)
        self.fc2 = nn.Linear(4 * width, width)

    def forward(self, tokens: Tensor) -> Tensor:
        return self.fc2(nn.functional.gelu(self.fc1(tokens)))


class Block(nn.Module):
    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(width, EPSILON)
        self.attn = Attention(width, heads)
        self.norm2 = nn.LayerNorm(width, EPSILON)
        self.mlp = Mlp(width)

    def forward(self, tokens: Tensor) -> Tensor:
        tokens = tokens + self.attn(self.norm1(tokens))
        return tokens + self.mlp(self.norm2(tokens))


class PatchEmbedding(nn.Module):
    def __init__(self, width: int, patch: int) -> None:
        super().__init__()
        self.proj = nn.Conv2d(3, width, patch, patch)


class VisionTransformer(nn.Module):
    """timm's vision transformer for images of any size; its last norm and classifier are not needed and not here."""

    def __init__(self, shape: LSegShape) -> None:
        super().__init__()
        self.shape = shape
        self.cls_token = nn.Parameter(torch.zeros(1, 1, shape.width))
        self.pos_embed = nn.Parameter(torch.zeros(1, 1 + shape.grid**2, shape.width))
        self.patch_embed = PatchEmbedding(shape.width, shape.patch)
        self.blocks = nn.ModuleList(Block(shape.width, shape.heads) for _ in range(shape.depth))

    def forward(self, images: Tensor) -> list[Tensor]:
        """Tokens after the layers that are read out, each [B, 1 + h * w, width], the class token first."""
        grid = self.patch_embed.proj(images)
        places = self._places(grid.shape[2], grid.shape[3])
        tokens = torch.cat([self.cls_token.expand(len(images), -1, -1), grid.flatten(2).transpose(1, 2)], dim=1)
        tokens = tokens + places
        read = []
        for number, block in enumerate(self.blocks):
            tokens = block(tokens)
            if number in self.shape.read_out:
                read.append(tokens)
        return read

    def _places(self, height: int, width: int) -> Tensor:
        """Position embeddings for a grid of any size."""
        first, rest = self.pos_embed[:, :1], self.pos_embed[:, 1:]
        grid = rest.unflatten(1, (self.shape.grid, self.shape.grid)).permute(0, 3, 1, 2)
        resized = interpolate(grid, (height, width), mode="bilinear", align_corners=False)
        return torch.cat([first, resized.flatten(2).transpose(1, 2)], dim=1)


class ReadOut(nn.Module):
    """Projects the class token into every other token."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.project = nn.Sequential(nn.Linear(2 * width, width), nn.GELU())

    def forward(self, tokens: Tensor) -> Tensor:
        rest = tokens[:, 1:]
        return self.project(torch.cat([rest, tokens[:, :1].expand_as(rest)], dim=2))


class Backbone(nn.Module):
    """The transformer, and its four layers as maps at 1/4, 1/8, 1/16 and 1/32 of the image."""

    def __init__(self, shape: LSegShape) -> None:
        super().__init__()
        self.shape = shape
        self.model = VisionTransformer(shape)
        one, two, three, four = shape.levels
        changes: tuple[list[nn.Module], ...] = (
            [nn.Conv2d(shape.width, one, 1), nn.ConvTranspose2d(one, one, 4, 4)],
            [nn.Conv2d(shape.width, two, 1), nn.ConvTranspose2d(two, two, 2, 2)],
            [nn.Conv2d(shape.width, three, 1)],
            [nn.Conv2d(shape.width, four, 1), nn.Conv2d(four, four, 3, 2, 1)],
        )
        for number, change in enumerate(changes, start=1):
            # Places 1 and 2 transposed and unflattened the tokens; they hold no parameters.
            steps = nn.Sequential(ReadOut(shape.width), nn.Identity(), nn.Identity(), *change)
            self.add_module(f"act_postprocess{number}", steps)

    def forward(self, images: Tensor) -> list[Tensor]:
        rows, columns = (side // self.shape.patch for side in images.shape[2:])
        maps = []
        for number, tokens in enumerate(self.model(images), start=1):
            read_out, _, _, *steps = self.get_submodule(f"act_postprocess{number}").children()
            grid = read_out(tokens).transpose(1, 2).unflatten(2, (rows, columns))
            for step in steps:
                grid = step(grid)
            maps.append(grid)
        return maps


class ResidualUnit(nn.Module):
    def __init__(self, features: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(features, features, 3, padding=1, bias=False)
        self.conv2 = nn.Conv2d(features, features, 3, padding=1, bias=False)
        self.bn1 = nn.BatchNorm2d(features)
        self.bn2 = nn.BatchNorm2d(features)

    def forward(self, maps: Tensor) -> Tensor:
        first = self.bn1(self.conv1(torch.relu(maps)))
        return maps + self.bn2(self.conv2(torch.relu(first)))


class Fusion(nn.Module):
    """Adds a finer map to the coarser ones fused so far, and doubles the resolution."""

    def __init__(self, features: int) -> None:
        super().__init__()
        self.out_conv = nn.Conv2d(features, features, 1)
        self.resConfUnit1 = ResidualUnit(features)
        self.resConfUnit2 = ResidualUnit(features)

    def forward(self, coarse: Tensor, fine: Tensor | None = None) -> Tensor:
        if fine is not None:
            coarse = coarse + self.resConfUnit1(fine)
        fused = interpolate(self.resConfUnit2(coarse), scale_factor=2, mode="bilinear", align_corners=True)
        return self.out_conv(fused)


class LSegNetwork(nn.Module):
    """Images, [B, 3, H, W] with sides a multiple of twice the patch, to features, [B, channels, H / 2, W / 2]."""

    def __init__(self, shape: LSegShape) -> None:
        super().__init__()
        self.pretrained = Backbone(shape)
        self.scratch = nn.Module()
        for number, channels in enumerate(shape.levels, start=1):
            convolution = nn.Conv2d(channels, shape.features, 3, padding=1, bias=False)
            self.scratch.add_module(f"layer{number}_rn", convolution)
            self.scratch.add_module(f"refinenet{number}", Fusion(shape.features))
        self.scratch.add_module("head1", nn.Conv2d(shape.features, shape.channels, 1))

    def forward(self, images: Tensor) -> Tensor:
        fused = None
        maps = self.pretrained(images)
        for number in (4, 3, 2, 1):
            fine = self.scratch.get_submodule(f"layer{number}_rn")(maps[number - 1])
            fuse = self.scratch.get_submodule(f"refinenet{number}")
            fused = fuse(fine) if fused is None else fuse(fused, fine)
        return self.scratch.get_submodule("head1")(fused)
