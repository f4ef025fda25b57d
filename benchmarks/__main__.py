"""Nine benchmarks, one after the other: `python -m benchmarks --out DIR` (what `tflane bench` runs).

Alone run those of single findings (`lstr_layers`, `loop_convolutions`, `clip_scan`, `collectives`), of markers in
images (`marker_*`), at the papers' sizes (`paper_sizes`) and on a GPU (`gpu.steps`, `gpu.matching`,
`gpu.side_by_side`).
"""

from __future__ import annotations

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

parser = command_line(__doc__)
options = parser.parse_args()
for benchmark in (host, attention_masks, masking_variants, metrics, lstr, deformable, markers, camera_world, loading):
    print(f"\n== {benchmark.__name__}\n", flush=True)
    benchmark.run(options.out)
