"""What checks annotations at run time, see `tests.shape_checks`."""

from beartype import BeartypeConf, beartype

# An int is a number, as in every annotation of Python.
_CHECK = beartype(conf=BeartypeConf(is_pep484_tower=True))


def check(function):
    """Add the checks, but not to containers, whose fields have more axes under `vmap`."""
    return function if function.__name__ == "__init__" else _CHECK(function)
