"""A host detector: encoder, priors, decoder. What all hosts share, and what each of them declares.

A new host derives a configuration from `HostConfig` and a module from `Host`, in a file of its own.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import flax.linen as nn
from flax import struct
from jaxtyping import Array, Float

from tflane_jax.geometry import PerceptionRange
from tflane_jax.models.auxiliary import AuxiliaryName
from tflane_jax.models.bev_encoder import BevMemory
from tflane_jax.models.camera_encoder import CameraEncoderConfig
from tflane_jax.models.element_decoder import ElementDecoder, ElementDecoderConfig, ElementOutput
from tflane_jax.models.encoders import encode_example, make_encoder, start_bev_memory
from tflane_jax.models.evidence_encoder import EvidenceEncoderConfig
from tflane_jax.models.prior import HostSpec, Prior
from tflane_jax.models.priors import ByPrior, PriorsConfig, bev_hook, encode, observe, start_memories
from tflane_jax.scene import Example, Prediction


@struct.dataclass
class HostMemory:
    """What a host carries from frame to frame.

    Attributes:
        bev: BEV features of the frame before; None for an encoder without memory.
        priors: memories of the priors that have one, by name.
    """

    bev: BevMemory | None = None
    priors: ByPrior = struct.field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class HostConfig:
    """What every host has; hosts add their decoders.

    Attributes:
        encoder: BEV features from BEV evidence or from cameras.
        range: R_p, the box in which lanes are perceived, metres.
        priors: traffic flow, SD map, markers; without any, the vision-only baseline.
        elements: traffic elements in the front view, or None. They need cameras.
    """

    encoder: EvidenceEncoderConfig | CameraEncoderConfig = EvidenceEncoderConfig()
    range: PerceptionRange = PerceptionRange()
    priors: PriorsConfig = PriorsConfig()
    elements: ElementDecoderConfig | None = None

    open_base: ClassVar[bool] = True
    """Settings of this type accept any subclass, see `config_io.subclasses`."""
    query_type: ClassVar[Literal["instance", "point"]] = "instance"
    """What a query represents, see `HostSpec.query_type`."""

    @property
    def query_dim(self) -> int:
        """Channels of a query."""
        raise NotImplementedError

    @property
    def auxiliary(self) -> tuple[AuxiliaryName, ...]:
        """Auxiliary outputs that the host has in training; each has a term in its loss."""
        return ("lane_cells",) if self.encoder.cells else ()

    @property
    def spec(self) -> HostSpec:
        """What priors are told of the host."""
        return HostSpec(self.query_dim, self.range, self.encoder.bev_range, self.query_type)

    def build(self) -> Host:
        """Return the Linen module; raises UserError where parts do not fit each other."""
        raise NotImplementedError

    def build_priors(self) -> dict[str, Prior]:
        """Return the priors of this host, by name."""
        return self.priors.build(self.spec)

    def start(self) -> HostMemory:
        """Return the memory before the first frame of a sequence."""
        return HostMemory(start_bev_memory(self.encoder), start_memories(self.build_priors()))


class Host(nn.Module):
    """From an example to the predictions of every decoder layer; subclasses say how queries are decoded.

    Attributes:
        config: of the host.
    """

    config: Any

    def setup(self):
        config: HostConfig = self.config
        self.encoder = make_encoder(config.encoder)
        if config.elements is not None:
            self.elements = ElementDecoder(config.elements)
        self.priors = _Built(config.build_priors())
        for prior in self.priors.by_name.values():
            for name, module in prior.modules().items():
                setattr(self, name, module)

    def __call__(self, example: Example, memory: HostMemory | None = None, *, train: bool = False) -> Prediction:
        """Return predictions with a leading axis over decoder layers; the last one is the answer."""
        return self.step(example, memory, train=train)[0]

    def step(
        self, example: Example, memory: HostMemory | None = None, *, train: bool = False
    ) -> tuple[Prediction, HostMemory]:
        """Return what `__call__` does, and the memory for the next frame.

        Args:
            example: one frame.
            memory: of the frame before it; None is a frame on its own. No gradient flows through its BEV features.
            train: dropout, which needs the key `dropout`, and the batch's own statistics.

        Raises:
            UserError: the example lacks what the model reads.
        """
        memory = memory or HostMemory()
        observations, memories = observe(self.priors.by_name, example, memory.priors)
        answer, bev = self.answer(example, memory.bev, observations, train=train)
        return answer, HostMemory(bev, memories)

    def answer(
        self, example: Example, memory: BevMemory | None, observations: ByPrior, *, train: bool = False
    ) -> tuple[Prediction, BevMemory | None]:
        """Return predictions, and BEV features for the next frame: the part of `step` that is learned.

        Args:
            example: one frame.
            memory: BEV features of the frame before; None without.
            observations: of every prior, see `models.priors.observe`.
            train: see `step`.
        """
        tokens = encode(self.priors.by_name, observations, deterministic=not train)
        hook = bev_hook(self.priors.by_name, tokens, self.config.spec)
        encoded = encode_example(self.encoder, example, memory, train=train, hook=hook)
        elements = None
        if self.config.elements is not None and encoded.front is not None:
            elements = self.elements(*encoded.front, deterministic=not train)
        prediction = self.decode_example(example, encoded.bev, elements, tokens, deterministic=not train)
        return prediction, encoded.memory

    def decode_example(
        self,
        example: Example,
        bev: Float[Array, "h w e"],
        elements: ElementOutput | None,
        tokens: ByPrior,
        *,
        deterministic: bool,
    ) -> Prediction:
        """Return the predictions of every decoder layer.

        Args:
            example: truth to denoise in training; nothing else of it may be looked at.
            bev: BEV features.
            elements: traffic elements of the front view, None without.
            tokens: of every prior, by name.
            deterministic: no dropout.
        """
        raise NotImplementedError


class _Built:
    """The priors of a module, out of sight of Linen, which would turn a plain dict of them into submodules."""

    def __init__(self, by_name: dict[str, Prior]):
        self.by_name = by_name
