"""`tflane bench`. The benchmarks are part of a source checkout, beside the package, and are not installed."""

from __future__ import annotations

import argparse
import signal
import subprocess
import sys
from pathlib import Path

import tflane_jax
from tflane_jax.errors import UserError
from tflane_jax.files.atomic import check_writable


def run(options: argparse.Namespace) -> int:
    """Run `python -m benchmarks` from the checkout."""
    root = Path(tflane_jax.__file__).parent.parent
    if not (root / "benchmarks" / "__main__.py").is_file():
        raise UserError(f"no benchmarks beside the package ({root}): run tflane bench from a source checkout")
    check_writable(options.out / "host.json")  # the first file, before minutes of measuring
    command = [sys.executable, "-m", "benchmarks", "--out", str(options.out.absolute())]
    with subprocess.Popen(command, cwd=root) as process:
        before = signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the benchmarks too, which say so
        try:
            code = process.wait()
        except BaseException:
            process.terminate()
            raise
        finally:
            signal.signal(signal.SIGINT, before)
    return code if code >= 0 else 128 - code
