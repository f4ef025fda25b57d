"""The array type of the containers: numpy on the host, JAX on the device."""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax
import numpy as np

# A union would make pyright reject operations that only one of the two types allows.
if TYPE_CHECKING:
    from typing import Any as Array
else:
    Array = np.ndarray | jax.Array
