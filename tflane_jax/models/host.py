"""Base classes of host detectors: encoder, priors, decoder.

A new host derives a configuration from `HostConfig` and a module from `Host`, in its own file.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import flax.linen as nn
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from tflane_jax.geometry import PerceptionRange
from tflane_jax.limits import Rules
from tflane_jax.models.auxiliary import AuxiliaryName
from tflane_jax.models.bev_encoder import BevMemory
from tflane_jax.models.element_decoder import ElementDecoder, ElementDecoderConfig, ElementOutput
from tflane_jax.models.encoders import EncoderConfig, encode_example, start_bev_memory
from tflane_jax.models.evidence_encoder import EvidenceEncoderConfig
from tflane_jax.models.parameters import with_torch_biases, with_torch_heads, with_xavier_layers
from tflane_jax.models.prior import HostSpec, Prior
from tflane_jax.models.priors import ByPrior, PriorsConfig, bev_hook, encode, observe, start_memories
from tflane_jax.scene import Example, Prediction


@struct.dataclass
class HostMemory:
    """Memory that a host carries from frame to frame.

    Attributes:
        bev: BEV features of the previous frame; None for an encoder without memory.
        priors: memories by name, of the priors that have one.
    """

    bev: BevMemory | None = None
    priors: ByPrior = struct.field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class HostConfig:
    """Settings common to all hosts; each host adds its decoder.

    Attributes:
        encoder: BEV features from BEV evidence or from cameras.
        range: R_p, the box in which lanes are perceived, metres.
        priors: traffic flow, SD map, markers; none of them gives the vision-only baseline.
        elements: decoder of traffic elements, which needs cameras; None: no traffic elements.
        initial: initial values of the parameters. "lecun": kernels are normal, biases 0. "xavier", as in the published
            code: kernels of the decoders' transformer layers are Xavier-uniform, feed-forward biases and heads have
            PyTorch's default, and heads are equal in all layers. Only `init` of the host itself applies it, see
            `Host.init`.
    """

    encoder: EncoderConfig = EvidenceEncoderConfig()
    range: PerceptionRange = PerceptionRange()
    priors: PriorsConfig = PriorsConfig()
    elements: ElementDecoderConfig | None = None
    initial: Literal["lecun", "xavier"] = "lecun"

    abstract_base: ClassVar[bool] = True
    open_base: ClassVar[bool] = True
    """Settings of this type accept any subclass, see `config_io.subclasses`."""
    truth: ClassVar[tuple[str, ...]] = ("lanes",)
    """Fields of `Example` that hold the ground truth of this host's loss and metrics."""
    predicts: ClassVar[tuple[str, ...]] = ("centerlines",)
    """Fields of `Prediction` with lanes that this host fills; traffic elements are a part of their own."""
    elements_of: ClassVar[Literal["centerlines", "segments"]] = "centerlines"
    """What traffic elements govern in this host, see `ExampleConfig.elements_of`."""
    query_type: ClassVar[Literal["instance", "point"]] = "instance"
    """What a query represents, see `HostSpec.query_type`."""

    def limits(self) -> Rules:
        """What the priors demand of their host; that it has a loss for what its encoder is to learn."""
        for name, setting in getattr(self.encoder, "learned", {}).items():
            yield f"encoder.{setting}", name in self.auxiliary, "False: only MapTRv2 has a loss for it"
        for name, prior in self.priors.configured.items():
            for setting, fits, wanted in getattr(prior, "host_limits", lambda host: ())(self.spec):
                yield f"priors.{name}.{setting}", fits, wanted

    @property
    def query_dim(self) -> int:
        """Channels of a query."""
        raise NotImplementedError

    @property
    def wanted_truth(self) -> tuple[str, ...]:
        """Fields of `truth` that count for `LaneGraphTask.empty_frames`: a frame without any of them is empty."""
        return self.truth

    @property
    def line_classes(self) -> int | None:
        """Number of classes of map lines that it learns; None for a host of lanes or segments."""
        return None

    @property
    def auxiliary(self) -> tuple[AuxiliaryName, ...]:
        """Auxiliary outputs of the host in training; each has a loss term."""
        return ("lane_cells",) if self.encoder.cells else ()

    @property
    def example_points(self) -> dict[str, tuple[int, str]]:
        """Required numbers of points: from the dotted name of a setting of `ExampleConfig` to (number, reason)."""
        return {}

    @property
    def example_forms(self) -> dict[str, tuple[str, str]]:
        """Required forms of the truth: from the dotted name of a setting of `ExampleConfig` to (value, reason)."""
        return {}

    @property
    def bev_range(self) -> PerceptionRange:
        """The box that the BEV features cover, in the frame of the example, metres."""
        return self.encoder.bev_range

    @property
    def bev_dim(self) -> int:
        """Channels of the BEV features."""
        return self.encoder.dim if isinstance(self.encoder, EvidenceEncoderConfig) else self.encoder.bev.dim

    @property
    def spec(self) -> HostSpec:
        """The properties of the host that priors depend on."""
        return HostSpec(self.query_dim, self.range, self.encoder.bev_range, self.query_type, bev_dim=self.bev_dim)

    def in_host_frame(self, example: Example) -> Example:
        """Return the example in the host's own frame, for the encoder."""
        return example

    def build(self) -> Host:
        """Return the Linen module; raises UserError where its parts do not fit together."""
        raise NotImplementedError

    def build_priors(self) -> dict[str, Prior]:
        """Return the priors of this host, by name."""
        return self.priors.build(self.spec)

    def start(self) -> HostMemory:
        """Return the memory before the first frame of a sequence."""
        return HostMemory(start_bev_memory(self.encoder), start_memories(self.build_priors()))


class Host(nn.Module):
    """From an example to the predictions of every decoder layer; subclasses implement `decode_example`.

    Attributes:
        config: the host's `HostConfig`.
    """

    config: Any

    @nn.nowrap
    def init(self, rngs: Any, *args: Any, **kwargs: Any) -> Any:
        """Return initial variables, as Linen does, with the values that `HostConfig.initial` names.

        Only `init` of the host itself does this. In another module, apply `with_xavier_layers`, `with_torch_biases` and
        `with_torch_heads` (and `with_equal_heads`) to the host's part of the variables.
        """
        variables = super().init(rngs, *args, **kwargs)
        if self.config.initial == "lecun":
            return variables
        key = rngs["params"] if isinstance(rngs, dict) else rngs
        return with_torch_heads(with_torch_biases(with_xavier_layers(variables, key), key), key)

    def setup(self):
        config: HostConfig = self.config
        self.encoder: Any = config.encoder.build()
        if config.elements is not None:
            self.elements = ElementDecoder(config.elements)
        self.priors = _Built(config.build_priors())
        for prior in self.priors.by_name.values():
            for name, module in prior.modules().items():
                setattr(self, name, module)

    def __call__(self, example: Example, memory: HostMemory | None = None, *, train: bool = False) -> Prediction:
        """Return predictions with a leading axis over decoder layers; the last layer is the result."""
        return self.step(example, memory, train=train)[0]

    def step(
        self, example: Example, memory: HostMemory | None = None, *, train: bool = False
    ) -> tuple[Prediction, HostMemory]:
        """Return the predictions, as `__call__` does, and the memory for the next frame.

        Args:
            example: one frame.
            memory: of the previous frame, of `HostConfig.start` for the first frame of a sequence; None: the frame
                stands alone, and priors remember nothing of it. No gradient flows through its BEV features.
            train: dropout is on, which needs the random key `dropout`; norms use batch statistics.

        Raises:
            ValueError: this is a batch, not one example.
            UserError: the example lacks an input of the model.
        """
        if (shape := np.shape(example.previous_from_ego)) != (4, 4):
            wanted = f"expected one example (previous_from_ego of shape (4, 4)), but it is of shape {shape}"
            raise ValueError(f"{wanted}; jax.vmap adds batches")
        memory = memory or HostMemory()
        observations, memories = observe(self.priors.by_name, example, memory.priors)
        answer, bev = self.answer(example, memory.bev, observations, train=train)
        return answer, HostMemory(bev, memories)

    def answer(
        self, example: Example, memory: BevMemory | None, observations: ByPrior, *, train: bool = False
    ) -> tuple[Prediction, BevMemory | None]:
        """Return predictions and the BEV memory for the next frame: the learned part of `step`.

        Args:
            example: one frame.
            memory: BEV features of the previous frame, or None.
            observations: of every prior, by name, see `models.priors.observe`.
            train: see `step`.
        """
        tokens = encode(self.priors.by_name, observations, deterministic=not train)
        fuse = bev_hook(self.priors.by_name, tokens, self.config.spec)
        seen, encoder = self.config.in_host_frame(example), self.config.encoder
        encoded = encode_example(self.encoder, encoder, seen, memory, train=train, fuse=fuse)
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
            example: source of the ground truth for denoising in training; no other field may be read.
            bev: BEV features, row 0 at the smallest y, column 0 at the smallest x.
            elements: outputs of the traffic-element decoder, or None.
            tokens: prior tokens by name.
            deterministic: no dropout.
        """
        raise NotImplementedError


class _Built:
    """Wraps the priors of a module, because Linen would turn a plain dict of them into submodules."""

    def __init__(self, by_name: dict[str, Prior]):
        self.by_name = by_name
