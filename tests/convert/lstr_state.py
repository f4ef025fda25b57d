"""The tensors of a tiny LSTR by PyTorch's names, and the configuration that they fit."""

import numpy as np

from tflane_jax.layers.resnet import ResNetConfig
from tflane_jax.layers.transformer import TransformerConfig
from tflane_jax.models.graph_encoders import GtnEncoderConfig
from tflane_jax.models.lstr import LstrConfig, TransformerEncoderConfig

DIM, HIDDEN, QUERIES = 8, 12, 3
LAYER = TransformerConfig(heads=2, hidden=HIDDEN, dropout=0.0)
TINY = LstrConfig(
    ResNetConfig((1, 1), (4, 6), (1, 2), stem_channels=4, frozen_stem_norm=True),
    DIM,
    TransformerEncoderConfig(1, LAYER),
    decoder_layers=1,
    decoder=LAYER,
    queries=QUERIES,
)
GTN = GtnEncoderConfig(layers=1, heads=2, head_dim=DIM // 2, hidden=HIDDEN, dropout=0.0)


def lstr_state(seed: int = 0) -> dict[str, np.ndarray]:
    """Return random tensors; variances are positive."""
    rng = np.random.default_rng(seed)
    state: dict[str, np.ndarray] = {}

    def add(name: str, *shape: int) -> None:
        state[name] = rng.normal(size=shape).astype(np.float32) * 0.3

    def norm(name: str, size: int, *, running: bool = True) -> None:
        add(f"{name}.weight", size)
        add(f"{name}.bias", size)
        if running:
            add(f"{name}.running_mean", size)
            state[f"{name}.running_var"] = rng.uniform(0.5, 2.0, size).astype(np.float32)

    def linear(name: str, outputs: int, inputs: int) -> None:
        add(f"{name}.weight", outputs, inputs)
        add(f"{name}.bias", outputs)

    def attention(name: str) -> None:
        add(f"{name}.in_proj_weight", 3 * DIM, DIM)
        add(f"{name}.in_proj_bias", 3 * DIM)
        linear(f"{name}.out_proj", DIM, DIM)

    add("conv1.weight", 4, 3, 7, 7)
    norm("bn1", 4)
    for stage, inputs, outputs in ((1, 4, 4), (2, 4, 6)):
        block = f"layer{stage}.0"
        add(f"{block}.conv1.weight", outputs, inputs, 3, 3)
        add(f"{block}.conv2.weight", outputs, outputs, 3, 3)
        for i in (1, 2):
            norm(f"{block}.bn{i}", outputs)
            state[f"{block}.bn{i}.num_batches_tracked"] = np.array(7)
        if inputs != outputs:
            add(f"{block}.downsample.0.weight", outputs, inputs, 1, 1)
            norm(f"{block}.downsample.1", outputs)
    add("input_proj.weight", DIM, 6, 1, 1)
    add("input_proj.bias", DIM)
    add("query_embed.weight", QUERIES, DIM)
    for part, attentions in (("encoder", ("self_attn",)), ("decoder", ("self_attn", "multihead_attn"))):
        layer = f"transformer.{part}.layers.0"
        for name in attentions:
            attention(f"{layer}.{name}")
        linear(f"{layer}.linear1", HIDDEN, DIM)
        linear(f"{layer}.linear2", DIM, HIDDEN)
        for i in range(len(attentions) + 1):
            norm(f"{layer}.norm{i + 1}", DIM, running=False)
    norm("transformer.decoder.norm", DIM, running=False)
    linear("class_embed", 2, DIM)
    for head in ("specific_embed", "shared_embed"):
        for i, outputs in enumerate((DIM, DIM, 4)):
            linear(f"{head}.layers.{i}", outputs, DIM)
    return state
