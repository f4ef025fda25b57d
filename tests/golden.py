"""Golden numbers of the reference programs: which test checks which file, and reading the module cases.

Cases are found by listing `$TFLANE_SHARED/golden`, so a further case of a claimed kind is checked too, whatever its
sizes and options: a test takes options from the file (`options`), the rest from the shapes of its arrays, and compares
with `tests.golden_compare`. `tests/test_golden_coverage.py` fails for a file that nothing claims. A file of
golden/modules holds arrays named `meta/json`, `p/`, `in/`, `out/`, `gw/`, `grad/`, `gradsum_last/` and
`gradsum_rest/`, see `ModuleCase`.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.shared import shared_root

# Glob under golden/ (a folder of metrics, or the name of a module case) -> the test file that checks it.
CLAIMS = {
    "metrics/maptr": "tests/metrics/test_vector_map.py",
    "metrics/openlanev2_centerline": "tests/metrics/test_openlane_v2.py",
    "metrics/openlanev2_lanesegment": "tests/metrics/test_lane_segment.py",
    "metrics/resample": "tests/geometry/test_polylines.py",
    "metrics/tusimple": "tests/metrics/test_tusimple.py",
    "modules/bev_constructer_*": "tests/models/test_bevformer_golden.py",
    "modules/bevformer_encoder*": "tests/models/test_bevformer_golden.py",
    "modules/bevformer_point_sampling*": "tests/geometry/test_pillars.py",
    "modules/custom_msda_decoder*": "tests/layers/test_deformable.py",
    "modules/fpn_*": "tests/layers/test_fpn.py",
    "modules/gtn_*": "tests/layers/test_graph_transformer.py",
    "modules/laneseg_assigner*": "tests/losses/test_lanesegnet.py",
    "modules/laneseg_head_*": "tests/models/test_lanesegnet_golden.py",
    "modules/laneseg_lane_attention*": "tests/layers/test_deformable.py",
    "modules/laneseg_lane_attention_init*": "tests/layers/test_deformable.py",
    "modules/laneseg_relationship_head*": "tests/losses/test_lanesegnet.py",
    "modules/lr_schedules*": "tests/training/test_schedule.py",
    "modules/lstr_*": "tests/models/test_lstr.py",
    "modules/lstr_preprocess*": "tests/files/test_images.py",
    "modules/maptr_assigner*": "tests/losses/test_maptr.py",
    "modules/maptr_gkt_cross_attention*": "tests/layers/test_geometry_kernel.py",
    "modules/maptr_gt_permutations*": "tests/geometry/test_line_orders.py",
    "modules/maptr_head_*": "tests/models/test_maptr_golden.py",
    "modules/maptr_losses*": "tests/losses/test_maptr.py",
    "modules/maptrv2_gt_permutations*": "tests/geometry/test_line_orders.py",
    "modules/maptrv2_head_*": "tests/models/test_maptrv2_golden.py",
    "modules/maptrv2_lss_transform*": "tests/models/test_lift.py",
    "modules/mha_*": "tests/layers/test_attention_golden.py",
    "modules/mmdet_losses*": "tests/losses/test_costs.py",
    "modules/mmdet_match_costs*": "tests/losses/test_costs.py",
    "modules/msda_func*": "tests/layers/test_sampling.py",
    "modules/msda_module*": "tests/layers/test_deformable.py",
    "modules/olv2_lc_head*": "tests/models/test_bevformer_detr.py",
    "modules/pe_sine2d*": "tests/layers/test_positions.py",
    "modules/resnet*": "tests/layers/test_resnet.py",
    "modules/rotate_nearest*": "tests/layers/test_bev_alignment.py",
    "modules/sca_*": "tests/layers/test_bev_attention.py",
    "modules/smerf_bev_constructer*": "tests/models/test_sd_map_golden.py",
    "modules/smerf_map_graph_transformer*": "tests/models/test_sd_map_golden.py",
    "modules/smerf_masked_cross_attention*": "tests/models/test_sd_map_golden.py",
    "modules/smerf_sdmap_parametrize*": "tests/priors/test_sd_map.py",
    "modules/smerf_sine_continuous_pe*": "tests/models/test_sd_map_golden.py",
    "modules/torch_encoder_layer*": "tests/layers/test_transformer.py",
    "modules/torch_decoder_layer*": "tests/layers/test_transformer.py",
    "modules/toponet_ffn_sgnn*": "tests/layers/test_graph.py",
    "modules/toponet_head*": "tests/models/test_toponet_golden.py",
    "modules/tsa_*": "tests/layers/test_bev_attention.py",
    "modules/toponet_lane_assigner*": "tests/losses/test_costs.py",
    "modules/toponet_lclc_gcn*": "tests/layers/test_graph.py",
    "modules/toponet_lcte_gcn*": "tests/layers/test_graph.py",
    "modules/toponet_relationship_head*": "tests/layers/test_graph.py",
    "modules/toponet_te_head*": "tests/models/test_element_decoder.py",
}

Arrays = dict[str, np.ndarray]

# The fixtures' names of one option, by ours.
ALIASES = {
    "C": "dim",
    "embed": "dim",
    "embed_dims": "dim",
    "d": "dim",
    "d_model": "dim",
    "dmodel": "dim",
    "num_heads": "heads",
    "nhead": "heads",
    "nheads": "heads",
    "num_layers": "layers",
    "nlayers": "layers",
    "ff": "hidden",
    "ffn": "hidden",
    "hidden_dim": "hidden",
    "dim_feedforward": "hidden",
    "num_points": "points",
    "num_pts": "points",
    "num_levels": "levels",
    "num_cams": "cams",
    "num_query": "queries",
    "act": "activation",
    "D": "anchors",
    "npts": "lane_points",
    "n_points": "lane_points",
    "num_te_classes": "classes",
    "te_classes": "classes",
}
# Entries of `meta/json` that describe the file, not the module.
_PROVENANCE = {
    "config",
    "cv2",
    "grad_sensitivity",
    "grad_unused",
    "input_nudges",
    "max_abs_diff_vs_float64",
    "name",
    "nonfinite_ok",
    "note",
    "seed",
    "set",
    "source",
    "torch",
}


@dataclass
class ModuleCase:
    """One reference module with its weights, inputs, outputs and gradients, names as in PyTorch.

    Attributes:
        meta: `source`, `config`, `seed`, `note`, ... of the file.
        params: parameters and buffers by state_dict name, PyTorch's layout.
        inputs: by name; `name.b` per batch element.
        outputs: by name.
        weights: by output name; the differentiated scalar is the sum of weight * output over all outputs.
        gradients: of that scalar, by `in/<name>` and `p/<name>`; of one with more than 24,000 elements only
            `last/p/<name>`, its sum over the last axis, and `rest/p/<name>`, its sum over all other axes. A file may
            hold some of them or none.
        read: names of the options that a test has asked for.
    """

    meta: dict[str, Any]
    params: Arrays
    inputs: Arrays
    outputs: Arrays
    weights: Arrays
    gradients: Arrays
    read: set[str] = field(default_factory=set)

    @property
    def config(self) -> dict[str, Any]:
        """The options of the module: `meta["config"]` and what stands beside it, by our names."""
        every = {k: v for k, v in self.meta.items() if k not in _PROVENANCE} | (self.meta.get("config") or {})
        return {ALIASES.get(name, name): value for name, value in every.items()}

    @property
    def source(self) -> str:
        """The program that the file was made with."""
        return str(self.meta.get("source", ""))


def options(case: ModuleCase, *required: str, **defaults: Any) -> SimpleNamespace:
    """Return options of a case by our names (`ALIASES`); fail, naming it, where a required one is absent.

    Args:
        case: the fixture.
        required: options that the fixture must have.
        defaults: options that it may have, with the reference's default.
    """
    config = case.config
    case.read |= {*required, *defaults}
    if absent := [name for name in required if name not in config]:
        pytest.fail(f"{case.meta.get('name')}: the fixture has no option {', '.join(absent)}")
    return SimpleNamespace(**{name: config.get(name, defaults.get(name)) for name in (*required, *defaults)})


def implemented(case: ModuleCase, **allowed: Iterable[Any]) -> None:
    """Fail, naming option and value, where the case has one that our code does not implement.

    Args:
        case: the fixture.
        allowed: for each option the values that are implemented, the reference's default first.
    """
    for name, values in allowed.items():
        values = tuple(values)
        value = getattr(options(case, **{name: values[0]}), name)
        if value not in values:
            known = ", ".join(map(str, values))
            pytest.fail(f"{case.meta.get('name')}: option {name} = {value!r} is not implemented (only {known})")


def numbered(arrays: Arrays, pattern: str) -> list[str]:
    """Return the names that match a regular expression with one group, a number, in the order of that number.

    `numbered(case.inputs, r"feat(\\d+)")` lists the levels of a feature pyramid.
    """
    found = {int(match[1]): name for name in arrays if (match := re.fullmatch(pattern, name))}
    return [found[i] for i in sorted(found)]


def batch_leading(case: ModuleCase, array: Any, *, default: bool = False) -> Any:
    """Return a sequence array with its batch axis first, whichever way round the case has it (`batch_first`).

    Swaps the first two axes, so it also brings a result back. `default`: the reference's `batch_first`.
    """
    return array if options(case, batch_first=default).batch_first else array.swapaxes(0, 1)


def golden_entries() -> dict[str, Path]:
    """Return what lies under golden/: each folder of metrics and each module case by its name for `CLAIMS`."""
    root = shared_root() / "golden"
    folders = {f"metrics/{path.name}": path for path in (root / "metrics").glob("*") if path.is_dir()}
    files = {f"modules/{path.stem}": path for path in (root / "modules").glob("*.npz")}
    return dict(sorted((folders | files).items()))


def golden_modules(pattern: str) -> list[Path]:
    """Return the module cases that match a claimed pattern such as "toponet_lclc_gcn*"; none where they are absent.

    For `pytest.mark.parametrize("path", golden_modules(...), ids=case_id)`, which skips where the list is empty.
    """
    claim = f"modules/{pattern}"
    if claim not in CLAIMS:
        raise KeyError(f"add {claim!r} to tests.golden.CLAIMS with the test file that checks it")
    return [path for name, path in golden_entries().items() if fnmatchcase(name, claim)]


def case_id(path: Path) -> str:
    """Return the name of a module case for pytest's listing."""
    return path.stem


def load_module_case(path: Path) -> ModuleCase:
    """Read one file of golden/modules."""
    groups: dict[str, Arrays] = {key: {} for key in ("p", "in", "out", "gw", "grad")}
    with np.load(path, allow_pickle=False) as file:
        meta = {"name": path.stem} | json.loads(str(file["meta/json"]))
        for key in file.files:
            group, name = key.split("/", 1)
            if group in groups:
                groups[group][name] = file[key]
            elif group.startswith("gradsum_"):
                groups["grad"][f"{group.removeprefix('gradsum_')}/{name}"] = file[key]
    return ModuleCase(meta, *groups.values())
