"""Settings of every test session, made before JAX starts."""

import atexit
import contextlib
import functools
import gc
import os
import shutil
import signal
import sys
import tempfile
from pathlib import Path

from tests.fast_compile import compile_fast, share_contexts

compile_fast()

# Workers and the commands that tests start read the modules as compiled before, whatever the environment says.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

import jax  # noqa: E402
import pytest  # noqa: E402
from hypothesis import settings  # noqa: E402

from tflane_jax.training import provenance  # noqa: E402
from tflane_jax.training.runtime import configure_jax  # noqa: E402

configure_jax(keep_programs=False)
share_contexts()
# Programs that several tests make anew, from a model's initialisation to a single operation, are compiled once, in a
# folder that the workers of a session and the commands that tests start share. JAX writes its files without a lock, and
# compiles anew where it finds half of one.
if "PYTEST_XDIST_WORKER" in os.environ:
    _programs = os.environ["JAX_COMPILATION_CACHE_DIR"]
else:
    _programs = tempfile.mkdtemp(prefix="tflane_tests_")
    atexit.register(shutil.rmtree, _programs, ignore_errors=True)
    os.environ["JAX_COMPILATION_CACHE_DIR"] = _programs
jax.config.update("jax_compilation_cache_dir", _programs)
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
# XLA reads its flags when JAX first asks for devices, which must not be inside a test that changes them.
jax.devices()
# No test survives a power failure: waiting for the device at every file costs a tenth of the tests that write.
os.fsync = lambda handle: None
# The code stays as it is while its tests run: git is asked once, not whenever a run starts.
provenance._git = functools.cache(provenance._git)
# Tracing makes millions of objects and hardly any garbage: collecting at the default rate costs a tenth of the time.
gc.set_threshold(100_000, 50, 100)
# Every run draws the same examples, on machines of any speed; files say how many.
settings.register_profile("repeatable", derandomize=True, deadline=None)
settings.load_profile("repeatable")


@pytest.fixture(autouse=True)
def _search_path():
    """Forget the folders of configuration files that a test loaded, in which later tests would find modules."""
    before = list(sys.path)
    yield
    sys.path[:] = before


@pytest.fixture(scope="module", autouse=True)
def _programs_in_memory():
    """Drop compiled programs after a file once a worker holds 3 GiB: the whole session's would be 6."""
    yield
    with contextlib.suppress(FileNotFoundError):  # Linux alone says how much it holds
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        if pages * os.sysconf("SC_PAGE_SIZE") > 3 * 2**30:
            jax.clear_caches()
            gc.collect()


@pytest.fixture
def interruptible():
    """Python's own Ctrl-C, also where the tests were started in the background, which ignores it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def pytest_collection_modifyitems(items):
    """Run whole commands and notebooks first: few tests, but long ones, with which no worker should end alone."""
    items.sort(key=lambda item: len(item.path.parts))


@pytest.fixture
def own_sources():
    """Forget the data sources that a test adds."""
    from tflane_jax.datasets import sources

    before = list(sources.SOURCES)
    yield
    sources.SOURCES[:] = before
    for tell in sources._told:
        tell()
