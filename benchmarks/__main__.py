"""Nine benchmarks, one after the other: `python -m benchmarks --out DIR` (what `tflane bench` runs).

Alone run those of single findings (`lstr_layers`, `loop_convolutions`, `clip_scan`, `collectives`), of markers in
images (`marker_*`), at the papers' sizes (`paper_sizes`) and on a GPU (`gpu.steps`, `gpu.matching`,
`gpu.side_by_side`).
"""

from __future__ import annotations

import sys

from benchmarks import (
    attention_masks,
    camera_world,
    deformable,
    host,
    loading,
    lstr,
    markers,
    masking_variants,
    metrics,
)
from benchmarks.timing import command_line
from tflane_jax.cli import exit_code

ALL = (host, attention_masks, masking_variants, metrics, lstr, deformable, markers, camera_world, loading)


def main() -> int:
    """Run them all."""
    options = command_line(__doc__).parse_args()
    for benchmark in ALL:
        print(f"\n== {benchmark.__name__}\n", flush=True)
        benchmark.run(options.out)
    return 0


if __name__ == "__main__":
    sys.exit(exit_code(main))
