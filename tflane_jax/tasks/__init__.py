"""What is trained and evaluated, in one typed object each: `lane_graph` and `lane_shape`."""

from tflane_jax.tasks.base import Model, Task, spread

__all__ = ["Model", "Task", "spread"]
