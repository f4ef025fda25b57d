"""The encoders of a host: from cameras, or from the BEV evidence raster, to BEV features.

A new encoder is a module, and a subclass of the configuration that has the same input, whose `build` returns it.
"""

from __future__ import annotations

from functools import partial
from typing import Any

from tflane_jax.errors import UserError
from tflane_jax.models.bev_encoder import BevFormerConfig, BevMemory
from tflane_jax.models.camera_encoder import CameraEncoderConfig, EncoderOutput
from tflane_jax.models.evidence_encoder import EvidenceEncoderConfig
from tflane_jax.models.prior import BevHook
from tflane_jax.scene import Example

EncoderConfig = EvidenceEncoderConfig | CameraEncoderConfig


def encode_example(
    encoder: Any,
    config: EncoderConfig,
    example: Example,
    memory: BevMemory | None,
    *,
    train: bool,
    fuse: BevHook | None = None,
) -> EncoderOutput:
    """Return the encoder's output for one example.

    Args:
        encoder: the host's encoder, as `config.build` made it.
        config: says what the encoder reads, images or evidence.
        example: one frame.
        memory: BEV features of the previous frame, or None.
        train: dropout is on, and batch norms use batch statistics.
        fuse: how priors change the BEV features of every layer.

    Raises:
        UserError: the example lacks the encoder's input, or the encoder is initialised and leaves `fuse` out.
    """
    layers: list[int] = []
    noted = None if fuse is None else partial(_noted, fuse, layers)
    output = _encoded(encoder, config, example, memory, train, noted)
    if fuse is not None and encoder.is_initializing() and 0 not in layers:
        raise UserError(
            f"a prior enters the BEV features, and {type(encoder).__name__} never calls `fuse_priors` for layer 0, "
            "which does that: call it (docs/architecture.md, An encoder), or choose priors that enter the queries "
            "alone (task.model.priors)"
        )
    return output


def _noted(fuse: BevHook, layers: list[int], layer: int, *cells: Any) -> Any:
    """Call the hook, and note the layer."""
    layers.append(layer)
    return fuse(layer, *cells)


def _encoded(
    encoder: Any,
    config: EncoderConfig,
    example: Example,
    memory: BevMemory | None,
    train: bool,
    fuse: BevHook | None,
) -> EncoderOutput:
    if isinstance(config, CameraEncoderConfig):
        return encoder(example, memory, train=train, fuse=fuse)
    if example.bev is None:
        raise UserError(
            "the model reads BEV evidence, and these data have none (bev is None): choose data with evidence, or a "
            "model with cameras"
        )
    return EncoderOutput(encoder(example.bev, fuse))


def start_bev_memory(config: EncoderConfig) -> BevMemory | None:
    """Return the BEV memory before the first frame of a sequence; None for an encoder without memory."""
    if isinstance(config, CameraEncoderConfig) and isinstance(config.bev, BevFormerConfig):
        return BevMemory.empty(config.bev) if config.bev.memory == "previous" else None
    return None
