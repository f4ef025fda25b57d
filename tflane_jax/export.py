"""Export of a trained monocular model as one StableHLO file with its weights, for any batch size.

The file runs with jax alone, without this package:

from jax import export
program = export.deserialize(open("lstr.stablehlo", "rb").read())
answer = program.call(images)    # (b, 360, 640, 3) uint8 RGB -> {"logits": (b, q, 2), "curves": (b, q, 8)}
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import export
from jaxtyping import Array, Float, UInt8

from tflane_jax.errors import UserError
from tflane_jax.models.parameters import Params
from tflane_jax.scene import LaneLines, RoadImage
from tflane_jax.tasks.lane_shape import LaneShapeTask

PLATFORMS = ("cpu", "cuda")
Answer = dict[str, Float[Array, "b q c"]]


def image_program(task: LaneShapeTask, params: Params) -> Callable[[UInt8[Array, "b h w 3"]], Answer]:
    """Return the model as a function of RGB images alone, with its weights inside."""

    def predict(images: UInt8[Array, "b h w 3"]) -> Answer:
        no_lines = LaneLines(jnp.zeros((0, 1, 2)), jnp.zeros((0, 1), bool), jnp.zeros(0, bool))

        def one(image):
            prediction = task.predict(params, RoadImage(image, jnp.ones(image.shape[:2], bool), no_lines))
            assert prediction.curves is not None, "tasks of lane shapes predict curves"
            return prediction.curves

        answer = jax.vmap(one)(images)
        return {"logits": answer.logits, "curves": answer.curves}

    return predict


def serialized_model(
    task: LaneShapeTask, params: Params, *, height: int, width: int, platforms: Sequence[str] = PLATFORMS
) -> bytearray:
    """Return the content of the file of a model, for images of one size and batches of any size."""
    (batch,) = export.symbolic_shape("b")
    images = jax.ShapeDtypeStruct((batch, height, width, 3), jnp.uint8)
    return export.export(jax.jit(image_program(task, params)), platforms=platforms)(images).serialize()


def load_program(path: Path) -> export.Exported:
    """Return an exported program; raises UserError where there is none or it is damaged."""
    try:
        return export.deserialize(bytearray(path.read_bytes()))
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror or error}") from error
    except Exception as error:  # a damaged flatbuffer raises many types
        raise UserError(f"{path} is no exported program, or damaged: write it again with tflane export") from error


def latencies(
    program: export.Exported, *, height: int, width: int, batches: Sequence[int] = (1, 4, 16), runs: int = 20
) -> list[dict[str, Any]]:
    """Return a row for each batch size: seconds to compile, median milliseconds a call, images a second."""
    rows = []
    for batch in batches:
        images = jnp.asarray(np.random.default_rng(0).integers(0, 256, (batch, height, width, 3), np.uint8))
        began = time.perf_counter()
        call = jax.jit(program.call).lower(images).compile()
        compiled = time.perf_counter() - began
        seconds = []
        for _ in range(runs):
            began = time.perf_counter()
            jax.block_until_ready(call(images))
            seconds.append(time.perf_counter() - began)
        median = float(np.median(seconds[1:]))
        rows.append({"batch": batch, "ms": 1e3 * median, "images/s": batch / median, "compile s": compiled})
    return rows
