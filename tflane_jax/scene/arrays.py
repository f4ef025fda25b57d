"""The array type of the containers: numpy on the host, JAX on the device."""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax
import numpy as np

# Leaves are numpy on the host and jax on the device, and either may be indexed, reduced and passed on.
if TYPE_CHECKING:
    from typing import Any as Array
else:
    Array = np.ndarray | jax.Array
