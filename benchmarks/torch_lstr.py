"""LSTR in PyTorch with the layers of the original, as the baseline of our LSTR's times.

Source: Liu et al. 2021, docs/reference/lstr.md; the published weights load by their own names. PyTorch is imported when
a network is built, and is no dependency of the project.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from benchmarks.torch_fitting import fitting_loss, import_torch
from tflane_jax.errors import UserError
from tflane_jax.layers.resnet import ResNetConfig
from tflane_jax.layers.transformer import TransformerConfig
from tflane_jax.models.lstr import LstrConfig, TransformerEncoderConfig

PUBLISHED = LstrConfig(backbone=ResNetConfig(frozen_stem_norm=True))
LEARNING_RATE = 1e-4


class Batch(NamedTuple):
    """What a training step reads.

    Attributes:
        images: (B, 3, H, W) float32 normalised BGR.
        masks: (B, 1, H, W) float32, 1 where there is no image.
        targets: per image (n, 3 + 2 P) float32 [1, lower, upper, xs, ys] as fractions of the image; -1e5 for no point.
    """

    images: np.ndarray
    masks: np.ndarray
    targets: Sequence[np.ndarray]


def inference(
    weights: Mapping[str, np.ndarray], model: LstrConfig = PUBLISHED
) -> Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """Return a program from images (B, 3, H, W) to logits (B, Q, 2) and curves (B, Q, 8) of the last layer.

    Args:
        weights: by the published names.
        model: sizes; the encoder must be the transformer.

    Raises:
        UserError: PyTorch is not installed.
    """
    torch = import_torch()
    network = load(build(model), weights).eval()

    def run(images: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        with torch.no_grad():
            masks = torch.zeros(len(images), 1, *images.shape[2:])
            logits, curves, _ = network(torch.from_numpy(images), masks)
        return logits[-1].numpy(), curves[-1].numpy()

    return run


def training_step(
    batch: Batch, weights: Mapping[str, np.ndarray] | None = None, model: LstrConfig = PUBLISHED
) -> Callable[[], float]:
    """Return a program that makes one step of Adam on the batch and returns the loss before it.

    Args:
        batch: the same at every call.
        weights: by the published names; None for random ones.
        model: as for `inference`.

    Raises:
        UserError: PyTorch is not installed.
    """
    torch = import_torch()
    torch.manual_seed(0)
    network = build(model)
    if weights is not None:
        load(network, weights)
    network.train()
    optimizer = torch.optim.Adam(network.parameters(), LEARNING_RATE)
    images, masks = torch.from_numpy(batch.images), torch.from_numpy(batch.masks)
    targets = [torch.from_numpy(rows) for rows in batch.targets]

    def step() -> float:
        logits, curves, _ = network(images, masks)
        loss, _ = fitting_loss(logits, curves, targets)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        return loss.item()

    return step


def load(network: Any, weights: Mapping[str, np.ndarray]) -> Any:
    """Put weights into a network by name; every name must match, but for PyTorch's counters of batches."""
    torch = import_torch()
    state = {name: value for name, value in network.state_dict().items() if name.endswith(".num_batches_tracked")}
    state |= {name: torch.from_numpy(np.array(value)) for name, value in weights.items()}
    network.load_state_dict(state, strict=True)
    return network


def build(model: LstrConfig = PUBLISHED) -> Any:
    """Return the network as a `torch.nn.Module`: images, masks -> logits, curves of every layer, encoder attention."""
    torch = import_torch()
    nn, functional = torch.nn, torch.nn.functional
    encoder_config = model.encoder
    if not isinstance(encoder_config, TransformerEncoderConfig):
        raise UserError("the PyTorch baseline has LSTR's own encoder only: take a model with TransformerEncoderConfig")

    class FrozenNorm(nn.Module):
        def __init__(self, channels: int):
            super().__init__()
            for name, value in {"weight": 1.0, "bias": 0.0, "running_mean": 0.0, "running_var": 1.0}.items():
                self.register_buffer(name, torch.full((channels,), value))

        def forward(self, x):
            scale = self.weight * (self.running_var + 1e-5).rsqrt()
            shift = self.bias - self.running_mean * scale
            return x * scale[:, None, None] + shift[:, None, None]

    class Block(nn.Module):
        def __init__(self, inputs: int, channels: int, stride: int):
            super().__init__()
            self.conv1 = nn.Conv2d(inputs, channels, 3, stride, 1, bias=False)
            self.bn1 = nn.BatchNorm2d(channels)
            self.conv2 = nn.Conv2d(channels, channels, 3, 1, 1, bias=False)
            self.bn2 = nn.BatchNorm2d(channels)
            self.relu = nn.ReLU(inplace=True)
            self.downsample = None
            if stride != 1 or inputs != channels:
                shortcut = nn.Conv2d(inputs, channels, 1, stride, bias=False)
                self.downsample = nn.Sequential(shortcut, nn.BatchNorm2d(channels))

        def forward(self, x):
            out = self.bn2(self.conv2(self.relu(self.bn1(self.conv1(x)))))
            return self.relu(out + (x if self.downsample is None else self.downsample(x)))

    class Layer(nn.Module):
        """Parts common to encoder and decoder layers: one attention, the feed-forward part and two norms."""

        def __init__(self, config: TransformerConfig):
            super().__init__()
            dim = model.dim
            self.self_attn = nn.MultiheadAttention(dim, config.heads, config.dropout)
            self.linear1, self.linear2 = nn.Linear(dim, config.hidden), nn.Linear(config.hidden, dim)
            self.norm1, self.norm2 = nn.LayerNorm(dim), nn.LayerNorm(dim)
            self.dropout = nn.Dropout(config.dropout)

        def feed_forward(self, x):
            return self.dropout(self.linear2(self.dropout(functional.relu(self.linear1(x)))))

    class EncoderLayer(Layer):
        def forward(self, x, position, padded):
            query = x + position
            out, attention = self.self_attn(query, query, x, key_padding_mask=padded)
            x = self.norm1(x + self.dropout(out))
            return self.norm2(x + self.feed_forward(x)), attention

    class DecoderLayer(Layer):
        def __init__(self, config: TransformerConfig):
            super().__init__(config)
            self.multihead_attn = nn.MultiheadAttention(model.dim, config.heads, config.dropout)
            self.norm3 = nn.LayerNorm(model.dim)

        def forward(self, x, memory, query_position, position, padded):
            query = x + query_position
            x = self.norm1(x + self.dropout(self.self_attn(query, query, x)[0]))
            out, _ = self.multihead_attn(x + query_position, memory + position, memory, key_padding_mask=padded)
            x = self.norm2(x + self.dropout(out))
            return self.norm3(x + self.feed_forward(x))

    class Transformer(nn.Module):
        def __init__(self):
            super().__init__()
            self.encoder, self.decoder = nn.Module(), nn.Module()
            self.encoder.layers = nn.ModuleList(
                EncoderLayer(encoder_config.layer) for _ in range(encoder_config.layers)
            )
            self.decoder.layers = nn.ModuleList(DecoderLayer(model.decoder) for _ in range(model.decoder_layers))
            self.decoder.norm = nn.LayerNorm(model.dim)
            for parameter in self.parameters():
                if parameter.dim() > 1:
                    nn.init.xavier_uniform_(parameter)

        def forward(self, x, padded, queries, position):
            x, position = (value.flatten(2).permute(2, 0, 1) for value in (x, position))
            padded, queries = padded.flatten(1), queries[:, None].repeat(1, x.shape[1], 1)
            attention = None
            for layer in self.encoder.layers:
                x, attention = layer(x, position, padded)
            out, outs = torch.zeros_like(queries), []
            for layer in self.decoder.layers:
                out = layer(out, x, queries, position, padded)
                outs.append(self.decoder.norm(out))
            return torch.stack(outs).transpose(1, 2), attention

    class Mlp(nn.Module):
        def __init__(self):
            super().__init__()
            self.layers = nn.ModuleList(nn.Linear(model.dim, size) for size in (model.dim, model.dim, 4))

        def forward(self, x):
            for layer in self.layers[:-1]:
                x = functional.relu(layer(x))
            return self.layers[-1](x)

    class Lstr(nn.Module):
        def __init__(self):
            super().__init__()
            backbone = model.backbone
            channels = backbone.stem_channels
            self.conv1 = nn.Conv2d(3, channels, 7, 2, 3, bias=False)
            self.bn1 = FrozenNorm(channels) if backbone.frozen_stem_norm else nn.BatchNorm2d(channels)
            self.relu, self.maxpool = nn.ReLU(inplace=True), nn.MaxPool2d(3, 2, 1)
            stages = zip(backbone.blocks, backbone.channels, backbone.strides, strict=True)
            self.stages = [f"layer{i + 1}" for i in range(len(backbone.blocks))]
            for name, (blocks, width, stride) in zip(self.stages, stages, strict=True):
                inputs = [channels, *[width] * (blocks - 1)]
                setattr(self, name, nn.Sequential(*(Block(n, width, 1 if i else stride) for i, n in enumerate(inputs))))
                channels = width
            self.input_proj = nn.Conv2d(channels, model.dim, 1)
            self.query_embed = nn.Embedding(model.queries, model.dim)
            self.transformer = Transformer()
            self.class_embed = nn.Linear(model.dim, 2)
            self.specific_embed, self.shared_embed = Mlp(), Mlp()

        def forward(self, images, masks):
            x = self.maxpool(self.relu(self.bn1(self.conv1(images))))
            for name in self.stages:
                x = getattr(self, name)(x)
            padded = functional.interpolate(masks[:, 0][None], size=x.shape[-2:])[0].bool()
            position = sine_positions(torch, padded, model.dim // 2)
            hidden, attention = self.transformer(self.input_proj(x), padded, self.query_embed.weight, position)
            specific = self.specific_embed(hidden)
            shared = self.shared_embed(hidden).mean(-2, keepdim=True).expand(specific.shape)
            curves = torch.cat([specific[..., :2], shared, specific[..., 2:]], -1)
            return self.class_embed(hidden), curves, attention

    # The order of channels that PyTorch's convolutions are fastest in on CPUs; images in another order are converted.
    return Lstr().to(memory_format=torch.channels_last)


def sine_positions(torch: Any, padded: Any, channels: int) -> Any:
    """Return DETR's positions (B, 2 * channels, h, w) of cells, rows first (section 2.3)."""
    present = ~padded
    frequency = 10000 ** (2 * (torch.arange(channels) // 2) / channels)
    parts = []
    for axis in (1, 2):
        place = present.cumsum(axis, dtype=torch.float32)
        last = place.narrow(axis, place.shape[axis] - 1, 1)
        angle = (place / (last + 1e-6) * 2 * math.pi)[..., None] / frequency
        parts.append(torch.stack([angle[..., 0::2].sin(), angle[..., 1::2].cos()], 4).flatten(3))
    return torch.cat(parts, 3).permute(0, 3, 1, 2)
