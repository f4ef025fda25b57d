"""Tasks: model, loss, data and metrics in one typed object. `lane_graph` and `lane_shape` define the two."""

from tflane_jax.tasks.base import Model, Task

__all__ = ["Model", "Task"]
