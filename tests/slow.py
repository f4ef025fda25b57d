"""Parameters of tests of which only some run by default."""

import pytest


def with_slow(names, quick):
    """Return parameters: those not in `quick` belong to `make test-slow`. Paths are named by their stems."""
    return [
        name if getattr(name, "stem", name) in quick else pytest.param(name, marks=pytest.mark.slow) for name in names
    ]
