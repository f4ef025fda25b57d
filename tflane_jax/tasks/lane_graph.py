"""The task "predict the lane graph": a host model, its loss and its answer, as the training program wants them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeVar

import jax
from flax.traverse_util import flatten_dict
from jax import lax
from jaxtyping import Array, Float

from tflane_jax.errors import UserError
from tflane_jax.layers.batch_norm import BATCH_AXIS
from tflane_jax.losses.lane_cells import lane_cell_loss
from tflane_jax.losses.lane_graph import LaneGraphLossConfig, lane_denoising_losses, lane_graph_loss
from tflane_jax.models.auxiliary import AUXILIARY
from tflane_jax.models.bevformer_detr import BevFormerDetrConfig
from tflane_jax.models.host import HostMemory, start_memory
from tflane_jax.models.marker_fusion import guide_frame
from tflane_jax.models.toponet import TopoNetConfig, TrafficFlowConfig
from tflane_jax.priors.marker_memory import MarkerGuidance
from tflane_jax.scene import Example, Prediction
from tflane_jax.training.task import STATISTICS, Params, split_statistics

T = TypeVar("T")


@dataclass(frozen=True)
class LaneGraphTask:
    """A host with the lane-graph loss; hashable, so that jit takes it as a static argument.

    Attributes:
        model: the host, with or without priors.
        losses: weights of costs and losses.
        clip: frames of a scene that training runs through with memory, one after the other; an example is then a clip,
            a leading axis on every leaf, and evaluation streams through the scenes. 1: frames stand alone.
    """

    model: TopoNetConfig | BevFormerDetrConfig = TopoNetConfig()
    losses: LaneGraphLossConfig = LaneGraphLossConfig()
    clip: int = 1

    @property
    def traffic_flow(self) -> TrafficFlowConfig | None:
        """How the host uses traffic flow; None for a host without."""
        return self.model.traffic_flow if isinstance(self.model, TopoNetConfig) else None

    def init(self, key: jax.Array, example: Example) -> Params:
        """Return fresh parameters; `example`, or a clip, gives shapes only."""
        if self.clip > 1:
            example = jax.tree.map(lambda leaf: leaf[0], example)
        variables = self.model.build().init(key, example)
        return dict(variables["params"]) | {name: variables[name] for name in (STATISTICS,) if name in variables}

    def loss(self, params: Params, batch: Example, key: jax.Array) -> tuple[Float[Array, ""], dict[str, Any]]:
        """Return the loss of a batch (leading axis on every leaf) and its terms; `key` is for dropout."""
        learned, statistics = split_statistics(params)
        module, start = self.model.build(), self.start()
        guides = jax.vmap(self._guides)(batch)

        def frame(bev, statistics, example, guide, key):
            variables, streams = {"params": learned} | statistics, {"dropout": key}
            kept, method = [STATISTICS, AUXILIARY], type(module).answer
            (outputs, bev), state = module.apply(
                variables, example, bev, guide, train=True, method=method, mutable=kept, rngs=streams
            )
            updated = {name: value for name, value in state.items() if name == STATISTICS}
            # Flax keeps what is sown in a tuple.
            flat: Any = flatten_dict(state.get(AUXILIARY, {}))
            said = {path[-1]: values[0] for path, values in flat.items()}
            return bev, updated, (outputs, said)

        def alone(example, guide, key):
            _, updated, told = frame(None, statistics, example, guide, key)
            return told, updated

        def clip(examples, guides, key):
            def body(carry, now):
                bev, updated, told = frame(*carry, *now)
                return (bev, updated), told

            frames = examples, guides, jax.random.split(key, self.clip)
            # Unrolled: inside of a loop XLA compiles the gradient of a convolution to code 25 times slower on a CPU.
            (_, updated), told = lax.scan(body, (start.bev, statistics), frames, unroll=self.clip)
            return told, updated

        if self.clip > 1 and start.bev is None:
            # No frame needs what another one has learned.
            batch, guides = _frames((batch, guides))
        through_clips = self.clip > 1 and start.bev is not None
        keys = jax.random.split(key, len(jax.tree.leaves(batch)[0]))
        train: Any = jax.vmap(clip if through_clips else alone, axis_name=BATCH_AXIS, out_axes=(0, None))
        (outputs, said), updated = train(batch, guides, keys)
        if through_clips:
            outputs, said, batch = _frames((outputs, said, batch))
        if outputs.elements is None:
            loss, terms = lane_graph_loss(outputs, batch.lanes, self.losses)
        elif batch.traffic_elements is None or batch.cameras is None:
            raise UserError(
                "the model predicts traffic elements, and these data label none: choose data with front images and "
                "traffic elements, or set task.model.elements to None"
            )
        else:
            sizes = batch.cameras.size[:, 0]
            loss, terms = lane_graph_loss(outputs, batch.lanes, self.losses, batch.traffic_elements, sizes)
        if "denoised" in said:
            every = lane_denoising_losses(said["denoised"], batch.lanes, self.losses)
            terms |= {f"denoised_{name}": term[-1] for name, term in every.items()}
            loss += sum(term.sum() for term in every.values())
        if "lane_cells" in said:
            each = jax.vmap(lane_cell_loss, in_axes=(0, 0, None))
            losses = each(said["lane_cells"], batch.lanes, self.model.decoder.range)
            terms["cells"] = self.losses.cell_weight * losses.mean()
            loss += terms["cells"]
        return loss, terms | updated

    def _guides(self, example: Example) -> MarkerGuidance | None:
        """Return what markers tell of a frame, or of each frame of a clip; there is nothing to learn in it."""
        markers = self.model.markers
        if markers is None:
            return None
        if self.clip == 1:
            return guide_frame(example, None, markers)[0]

        def body(memory, example):
            guide, memory = guide_frame(example, memory, markers)
            return memory, guide

        return lax.scan(body, self.start().markers, example)[1]

    def predict(self, params: Params, example: Example) -> Prediction:
        """Return the last decoder layer's answer for one example, a frame on its own."""
        return self.step(params, None, example)[1]

    def start(self) -> HostMemory:
        """Return the memory before the first frame of a sequence."""
        return start_memory(self.model.encoder, self.model.markers)

    def step(self, params: Params, memory: HostMemory | None, example: Example) -> tuple[HostMemory, Prediction]:
        """Return the memory for the next frame, and the answer for this one.

        The same for streams, `memory, answer = step(params, memory, example)`, and for sequences of examples with a
        leading axis, `lax.scan(partial(task.step, params), task.start(), examples)`.
        """
        # What depends on parameters alone must stay inside a scan: taken out, it is rounded otherwise than in a stream.
        params, example = lax.optimization_barrier((params, example))
        learned, statistics = split_statistics(params)
        module = self.model.build()
        variables = {"params": learned} | statistics
        result: Any = module.apply(variables, example, memory, method=type(module).step)
        outputs, following = result
        return following, jax.tree.map(lambda layers: layers[-1], outputs)


def _frames(clips: T) -> T:
    """Return the frames of a batch of clips, one after the other."""
    return jax.tree.map(lambda leaf: leaf.reshape(leaf.shape[0] * leaf.shape[1], *leaf.shape[2:]), clips)
