"""Golden numbers of the reference programs: which test checks which file, and reading the module cases.

Cases are found by listing `$TFLANE_SHARED/golden`, so that a further case of a kind that is claimed here is checked
too; `tests/test_golden_coverage.py` names what nothing claims. Schema: shared specs/modules.md section 1.
"""

from __future__ import annotations

import json
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tests.shared import shared_root

# Glob under golden/ (a folder of metrics, or the name of a module case) -> the test file that checks it.
CLAIMS = {
    "metrics/maptr": "tests/metrics/test_vector_map.py",
    "metrics/openlanev2_centerline": "tests/metrics/test_openlane_v2.py",
    "metrics/openlanev2_lanesegment": "tests/metrics/test_lane_segment.py",
    "metrics/resample": "tests/geometry/test_polylines.py",
    "metrics/tusimple": "tests/metrics/test_tusimple.py",
    "modules/bev_constructer_*": "tests/models/test_bevformer.py",
    "modules/bevformer_encoder*": "tests/models/test_bevformer.py",
    "modules/bevformer_point_sampling*": "tests/geometry/test_pillars.py",
    "modules/custom_msda_decoder*": "tests/layers/test_deformable.py",
    "modules/fpn_*": "tests/layers/test_fpn.py",
    "modules/gtn_*": "tests/layers/test_graph_transformer.py",
    "modules/lr_schedules*": "tests/training/test_schedule.py",
    "modules/lstr_*": "tests/models/test_lstr.py",
    "modules/lstr_preprocess*": "tests/test_images.py",
    "modules/mha_*": "tests/layers/test_attention.py",
    "modules/mmdet_losses*": "tests/losses/test_costs.py",
    "modules/mmdet_match_costs*": "tests/losses/test_costs.py",
    "modules/msda_func*": "tests/layers/test_sampling.py",
    "modules/msda_module*": "tests/layers/test_deformable.py",
    "modules/olv2_lc_head*": "tests/models/test_bevformer_detr.py",
    "modules/pe_sine2d*": "tests/layers/test_positions.py",
    "modules/resnet*": "tests/layers/test_resnet.py",
    "modules/rotate_nearest*": "tests/layers/test_bev_alignment.py",
    "modules/sca_*": "tests/layers/test_bev_attention.py",
    "modules/smerf_bev_constructer*": "tests/models/test_sd_map_encoder.py",
    "modules/smerf_map_graph_transformer*": "tests/models/test_sd_map_encoder.py",
    "modules/smerf_masked_cross_attention*": "tests/models/test_sd_map_encoder.py",
    "modules/smerf_sdmap_parametrize*": "tests/priors/test_sd_map.py",
    "modules/smerf_sine_continuous_pe*": "tests/models/test_sd_map_encoder.py",
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


class ModuleCase(NamedTuple):
    """One reference module with its weights, inputs, outputs and gradients, names as in PyTorch.

    Attributes:
        meta: `source`, `config`, `seed`, `note`, ... of the file.
        params: parameters and buffers by state_dict name, PyTorch's layout.
        inputs: by name; `name.b` per batch element.
        outputs: by name.
        weights: by output name; the differentiated scalar is the sum of weight * output over all outputs.
        gradients: of that scalar, by `in/<name>` and `p/<name>`; of one with more than 24,000 elements only
            `last/p/<name>`, its sum over the last axis, and `rest/p/<name>`, its sum over all other axes.
    """

    meta: dict[str, Any]
    params: Arrays
    inputs: Arrays
    outputs: Arrays
    weights: Arrays
    gradients: Arrays


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
        meta = json.loads(str(file["meta/json"]))
        for key in file.files:
            group, name = key.split("/", 1)
            if group in groups:
                groups[group][name] = file[key]
            elif group.startswith("gradsum_"):
                groups["grad"][f"{group.removeprefix('gradsum_')}/{name}"] = file[key]
    return ModuleCase(meta, *groups.values())


def named_gradients(by_param: Arrays, by_input: Arrays) -> Arrays:
    """Return gradients under the names of `ModuleCase.gradients`."""
    return {f"p/{k}": v for k, v in by_param.items()} | {f"in/{k}": v for k, v in by_input.items()}


def assert_outputs_close(actual: Arrays, expected: Arrays, tolerance: float = 2e-5) -> None:
    """Compare every expected output by name: |a - b| <= tolerance (1 + |b|), the rule of the specification."""
    for name, value in expected.items():
        np.testing.assert_allclose(actual[name], value, rtol=tolerance, atol=tolerance, err_msg=name)


def assert_gradients_close(actual: Arrays, expected: Arrays, tolerance: float = 2e-4) -> None:
    """Compare every expected gradient by name: max|a - b| <= tolerance (1 + max|b|), also where only sums are given.

    `actual` holds full gradients by `in/<name>` and `p/<name>` in PyTorch's layout.
    """
    for name, value in expected.items():
        if name.startswith("last/"):
            got = np.asarray(actual[name.removeprefix("last/")]).sum(-1)
        elif name.startswith("rest/"):
            full = np.asarray(actual[name.removeprefix("rest/")])
            got = full.sum(tuple(range(full.ndim - 1)))
        else:
            got = np.asarray(actual[name])
        scale = 1.0 + np.abs(value).max(initial=0.0)
        np.testing.assert_allclose(got, value, rtol=0.0, atol=tolerance * scale, err_msg=name)
