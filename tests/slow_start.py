"""The command line with fake examples: `python -m tests.slow_start WHERE ARGUMENTS`.

WHERE is what takes a minute or longer: "tracing" or "compiling" the update step, or "nothing".
"""

from __future__ import annotations

import signal
import sys
import time

import jax
import jax.numpy as jnp
import pytest

from tests.tiny_run import use_fakes
from tflane_jax.cli import main
from tflane_jax.tasks.lane_graph import LaneGraphTask


def start(where: str) -> int:
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a process that was started in the background ignores it
    with pytest.MonkeyPatch.context() as patch:
        use_fakes(patch)
        quick = LaneGraphTask.loss

        def loss(task, params, batch, key):
            total, terms = quick(task, params, batch, key)
            x = jnp.ones((7, 5)) * total
            for _ in range(400 if where == "compiling" else 0):
                x = jax.lax.sort(jnp.tanh(x @ x.T @ x), dimension=1)
            for _ in range(6000 if where == "tracing" else 0):
                time.sleep(0.01)
            return total + 0.0 * x.sum(), terms

        patch.setattr(LaneGraphTask, "loss", loss)
        sys.argv = ["tflane", *sys.argv[2:]]
        return main()


if __name__ == "__main__":
    sys.exit(start(sys.argv[1]))
