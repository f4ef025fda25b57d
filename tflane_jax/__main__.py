"""`python -m tflane_jax`, the same as `tflane`: for environments whose scripts are not on the path."""

import sys

from tflane_jax.cli import main

if __name__ == "__main__":  # not in worker processes, which import it too
    sys.exit(main())
