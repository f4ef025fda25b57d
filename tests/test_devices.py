"""Several devices: the numbers of one, evenly shared batches, bit-identical resumes. A CPU plays them all."""

import json
import os
import subprocess
import sys

import jax
import numpy as np
import pytest

from tests.shared import ROOT
from tests.training.divided_losses import CASES, losses
from tests.training.many_devices import BATCH, EVENLY, assignments, host_terms, in_parts, normalised, predicted
from tests.training.stub_run import run
from tests.training.test_loop import arrays, timeless
from tflane_jax.devices import made_on_host
from tflane_jax.training.checkpoint import Checkpoints
from tflane_jax.training.vectors import ROW


@pytest.fixture(scope="module", params=[2, pytest.param(8, marks=pytest.mark.slow)])
def forced(request, tmp_path_factory):
    """Return the folder of a process with so many devices, and what it says."""
    folder = tmp_path_factory.mktemp("devices")
    return folder, said_on(request.param, "tests.training.many_devices", str(folder))


def said_on(devices, module, argument):
    """Return what a module says in a process with so many devices."""
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={devices}"
    ended = subprocess.run(
        [sys.executable, "-m", module, argument],
        cwd=ROOT,
        env=os.environ | {"XLA_FLAGS": flags},
        capture_output=True,
        text=True,
        timeout=200,
    )
    assert ended.returncode == 0, ended.stderr
    facts = json.loads(ended.stdout.splitlines()[-1])
    assert facts["devices"] == devices
    return facts


def test_training_gives_the_numbers_of_one_device(forced, tmp_path):
    run(tmp_path / "run", config=EVENLY)
    one, many = timeless(tmp_path / "run"), timeless(forced[0] / "whole")
    assert len(one) == len(many)
    for expected, found in zip(one, many, strict=True):
        assert found.keys() == expected.keys()
        for name, value in expected.items():
            if name != "split":
                np.testing.assert_allclose(found[name], value, rtol=1e-6, err_msg=name)


def test_a_resume_is_bit_identical(forced):
    folder, _ = forced
    assert arrays(folder / "resumed") == arrays(folder / "whole")
    assert timeless(folder / "resumed") == timeless(folder / "whole")


def test_a_shared_state_gives_the_same_numbers_and_resumes_as_a_whole_one(forced):
    whole, shared = (timeless(forced[0] / name) for name in ("whole", "shared"))
    assert len(whole) == len(shared)
    for expected, found in zip(whole, shared, strict=True):
        for name, value in expected.items():
            if name != "split":
                np.testing.assert_allclose(found[name], value, rtol=1e-6, err_msg=name)
    expected, found = (Checkpoints(forced[0] / name / "checkpoints").arrays(30) for name in ("whole", "shared"))
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        np.testing.assert_allclose(found[name], value, rtol=1e-5, atol=1e-7, err_msg=name)


def test_initial_parameters_are_made_on_the_host_and_put_on_the_accelerator(forced):
    assert forced[1]["beginning"] == {"computed": 0, "lies": [1], "equal": True}


def test_without_a_cpu_the_accelerator_makes_them(monkeypatch):
    def unknown(backend):
        raise RuntimeError(f"Unknown backend {backend}")

    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(jax, "local_devices", unknown)
    made = object()
    assert made_on_host(lambda: made) is made


def test_each_device_holds_its_part_of_a_shared_state(forced):
    devices, held = forced[1]["devices"], forced[1]["held"]
    assert {len(parts) for _, parts in held.values()} == {devices}
    assert all(parts == [size // devices] * devices for size, parts in held.values())
    assert all(size % (devices * ROW) == 0 for size, _ in held.values())  # no leaf's row is cut
    assert len(held) == 2 * 4  # kernels and biases: parameters, average, two moments


@pytest.mark.slow
def test_muon_has_whole_matrices_of_a_shared_state(forced):
    if not (found := forced[1]["muon"]):
        pytest.skip("compiled for two devices only")
    np.testing.assert_allclose(*found, rtol=1e-5)


def test_each_device_matches_its_own_examples(forced):
    assert forced[1]["assignments"] == assignments("jax") == assignments("scipy")


def test_a_matcher_whose_callbacks_would_wait_for_each_other_is_refused(forced):
    """Regression: several devices of one CPU hung for ever, at the costs of a middle-sized model."""
    assert forced[1]["refused"]["matcher"].endswith("several devices of one CPU: choose 'jax', or one device")


def test_devices_share_predictions_or_one_makes_them(forced):
    for found in (forced[1]["predicted"], forced[1]["predicted by one"]):
        np.testing.assert_allclose(found, predicted(BATCH), rtol=1e-6, atol=1e-6)


def test_parts_of_a_batch_are_spread_over_the_devices(forced):
    kernel, moved = forced[1]["in parts"]
    np.testing.assert_allclose(kernel, in_parts(1)[0], rtol=1e-6)
    assert moved == 0


def test_batch_norms_take_the_statistics_of_all_devices(forced):
    for kind, frozen in (("learned", False), ("frozen", True)):
        expected, found = normalised(frozen=frozen), forced[1]["norms"][kind]
        np.testing.assert_allclose(found["output"], expected["output"], rtol=1e-6, atol=1e-6)
        for name, value in expected["statistics"].items():
            np.testing.assert_allclose(found["statistics"][name], value, rtol=1e-6, err_msg=name)
        assert (found["exchanges"] == 0) == frozen


@pytest.mark.slow
def test_a_host_has_the_loss_and_the_gradient_of_one_device(forced):
    if not (found := forced[1]["host"]):
        pytest.skip("compiled for two devices only")
    for name, value in host_terms().items():
        np.testing.assert_allclose(found[name], value, rtol=1e-6, err_msg=name)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_models_with_batch_norms_and_dropout_have_the_losses_of_one_device(name):
    expected, found = losses(name), said_on(2, "tests.training.divided_losses", name)["losses"]
    assert found.keys() == expected.keys()
    assert any("batch_stats" in term for term in expected)
    for term, value in expected.items():
        near_zero = 1e-6 if "batch_stats" in term else 0.0  # means of a channel, whose parts cancel
        np.testing.assert_allclose(found[term], value, rtol=1e-6, atol=near_zero, err_msg=term)


def test_a_batch_that_cannot_be_shared_evenly_is_refused(forced):
    devices = forced[1]["devices"]
    assert forced[1]["refused"]["batch"] == (
        f"training.batch_size is 9, which {devices} devices cannot share evenly: choose a multiple of {devices} "
        "(--training.same-examples divides the steps as the batch grows)"
    )
