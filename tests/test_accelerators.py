"""Which GPUs a process takes: of a cluster's job, and as one of several workers."""

import os
from types import SimpleNamespace

import jax
import pytest

from tflane_jax import accelerators, processes
from tflane_jax.ablations import workers
from tflane_jax.ablations.jobs import Job
from tflane_jax.ablations.workers import worker_threads
from tflane_jax.accelerators import devices_of_task, disable_triton_gemm, gpus, of_worker
from tflane_jax.config import RunConfig
from tflane_jax.cores import own_cores
from tflane_jax.errors import UserError
from tflane_jax.training import provenance

EIGHT = "0,1,2,3,4,5,6,7"


def slurm(visible: str | None = EIGHT, tasks="1(x4)", place=0, host=0, **further):
    variables = {"SLURM_LOCALID": str(place), "SLURM_NODEID": str(host), "SLURM_STEP_TASKS_PER_NODE": tasks}
    return variables | ({} if visible is None else {"CUDA_VISIBLE_DEVICES": visible}) | further


@pytest.mark.parametrize(
    ("environment", "expected"),
    [
        (slurm(), list(range(8))),  # srun --ntasks 4 --gpus-per-task 8, a task on each host
        (slurm(tasks="2(x2)", place=1, visible="0,1,2,3", SLURM_GPUS_PER_TASK="4"), [0, 1, 2, 3]),
        (slurm(tasks="2(x2)", place=1, visible="0,1", SLURM_TRES_PER_TASK="cpu:4,gres/gpu:2"), [0, 1]),
        (slurm(tasks="2(x2)", place=1, host=1), [4, 5, 6, 7]),  # both see all
        (slurm(tasks="8", place=3), [3]),
        (slurm(tasks="8(x2),1", place=0, host=2), list(range(8))),
        (slurm(tasks="8", place=3, visible="5"), [0]),  # bound in another way
        (slurm(tasks="3", place=1), None),
        (
            slurm(place=0, OMPI_MCA_orte_hnp_uri="x", OMPI_COMM_WORLD_LOCAL_RANK="3", OMPI_COMM_WORLD_LOCAL_SIZE="8"),
            [3],
        ),
        (slurm(visible=None), None),
        (slurm(visible=""), None),
        ({"CUDA_VISIBLE_DEVICES": "GPU-a,GPU-b", "OMPI_COMM_WORLD_LOCAL_RANK": "1"}, [0, 1]),
        (
            {"CUDA_VISIBLE_DEVICES": "0,1", "OMPI_COMM_WORLD_LOCAL_RANK": "1", "OMPI_COMM_WORLD_LOCAL_SIZE": "2"},
            [1],
        ),
    ],
)
def test_a_task_of_a_cluster_takes_the_gpus_that_are_its_own(environment, expected):
    assert devices_of_task(environment) == expected


@pytest.mark.parametrize(
    ("usable", "environment", "expected"),
    [
        (12, {}, 12),
        (3, {}, 3),  # pinned
        (12, slurm(tasks="4"), 3),
        (12, slurm(tasks="16"), 1),
        (2, slurm(tasks="4"), 2),  # bound to its own
        (8, slurm(tasks="4", SLURM_CPUS_ON_NODE="8"), 2),  # the job has a part of the host, its tasks share it
        (2, slurm(tasks="4", SLURM_CPUS_ON_NODE="8"), 2),
        (12, {"OMPI_COMM_WORLD_LOCAL_RANK": "1", "OMPI_COMM_WORLD_LOCAL_SIZE": "2"}, 6),
    ],
)
def test_cores_that_a_job_shares_are_divided_and_others_are_not(usable, environment, expected, monkeypatch):
    monkeypatch.setattr(os, "cpu_count", lambda: 12)
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: set(range(usable)), raising=False)
    assert own_cores(environment) == expected


@pytest.fixture
def joined(monkeypatch):
    """Stand in for JAX's joining inside a Slurm job of which every task sees eight GPUs; return what it is told."""
    for name, value in slurm().items():
        monkeypatch.setenv(name, value)
    asked = {}

    def initialize(coordinator, processes, process, local_device_ids, **settings):
        asked.update(settings, place=(coordinator, processes, process), devices=local_device_ids)

    monkeypatch.setattr(jax.distributed, "initialize", initialize)
    kept = jax.config.jax_enable_compilation_cache  # pyright: ignore[reportAttributeAccessIssue]
    yield asked
    jax.config.update("jax_enable_compilation_cache", kept)


def test_a_process_that_asks_the_cluster_names_its_gpus(joined, monkeypatch):
    processes.join(None, None, None)
    assert joined["devices"] == list(range(8))
    assert joined["cluster_detection_method"] is None
    monkeypatch.setenv("JAX_LOCAL_DEVICE_IDS", "5")
    processes.join(None, None, None)
    assert joined["devices"] is None  # JAX reads the variable


def test_a_process_that_is_given_its_place_ignores_the_cluster(joined):
    processes.join("host:1", 2, 1)
    assert joined["place"] == ("host:1", 2, 1)
    assert (joined["devices"], joined["cluster_detection_method"]) == (None, "deactivate")


SHARED = {"XLA_CLIENT_MEM_FRACTION": "0.450"}


@pytest.mark.parametrize(
    ("visible", "parallel", "expected"),
    [
        ("", 2, [{}, {}]),
        ("0,1", 2, [{"CUDA_VISIBLE_DEVICES": "0"}, {"CUDA_VISIBLE_DEVICES": "1"}]),
        ("GPU-a", 1, [{"CUDA_VISIBLE_DEVICES": "GPU-a"}]),
        ("3", 2, [{"CUDA_VISIBLE_DEVICES": "3"} | SHARED] * 2),
        ("6,7", 3, [{"CUDA_VISIBLE_DEVICES": name} | SHARED for name in ("6", "7", "6")]),
    ],
)
def test_workers_take_gpus_in_turn_and_share_their_memory(visible, parallel, expected, monkeypatch):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
    for name in accelerators._FRACTIONS:
        monkeypatch.delenv(name, raising=False)
    assert [of_worker(slot, parallel) for slot in range(parallel)] == expected


def test_gpus_are_found_without_a_variable_and_a_chosen_fraction_stays(tmp_path, monkeypatch):
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    monkeypatch.setattr(accelerators, "Path", lambda path: tmp_path)
    assert gpus() == []
    for name in ("nvidia4", "nvidia6", "nvidiactl"):
        (tmp_path / name).touch()
    assert gpus() == ["0", "1"]  # CUDA numbers those that it sees
    for name in accelerators._FRACTIONS:  # where both are set, JAX computes on the CPU
        monkeypatch.setenv(name, "0.2")
        assert of_worker(2, 3) == {"CUDA_VISIBLE_DEVICES": "0"}
        monkeypatch.delenv(name)


@pytest.mark.parametrize("visible", ["-1", "NoDevFiles,0", "", " "])
def test_names_from_which_cuda_sees_no_gpu(visible, monkeypatch):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
    assert gpus() == []
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", f"3,{visible}")
    assert gpus() == ["3"] or visible == "NoDevFiles,0"


def test_the_subsystem_for_linux_has_one_gpu(tmp_path, monkeypatch):
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    monkeypatch.setattr(accelerators, "Path", lambda path: tmp_path)
    (tmp_path / "dxg").touch()
    assert gpus() == ["0"]


def test_flags_of_gpus_are_not_in_the_setting_of_a_cpu(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "--xla_gpu_enable_triton_gemm=false")
    assert "XLA_FLAGS" not in provenance.thread_setting()
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_one=1 --xla_gpu_enable_triton_gemm=false")
    assert provenance.thread_setting()["XLA_FLAGS"] == "--xla_cpu_one=1"
    monkeypatch.setattr(provenance.jax, "devices", lambda: [SimpleNamespace(platform="gpu", device_kind="H100")])
    assert provenance.thread_setting()["XLA_FLAGS"].endswith("--xla_gpu_enable_triton_gemm=false")


def test_a_process_with_workers_reserves_no_memory(monkeypatch):
    """Regression: a search for learning rates did, before its workers could: 14 of 15 found no memory on an H200."""
    asked = []

    def devices():
        asked.append(os.environ.get("XLA_PYTHON_CLIENT_PREALLOCATE"))
        return [SimpleNamespace(platform="gpu", device_kind="H200")]

    monkeypatch.setattr(provenance.jax, "devices", devices)
    monkeypatch.setenv("XLA_PYTHON_CLIENT_PREALLOCATE", "")
    monkeypatch.delenv("XLA_PYTHON_CLIENT_PREALLOCATE")
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {0, 1}, raising=False)
    worker_threads(1)
    worker_threads(1, cores=1)
    assert asked == [None, "false"]


def test_triton_kernels_are_disabled_on_gpus(monkeypatch):
    """Regression: XLA's own kernels ended every process that compiled the update of a lane shape model on an H200."""
    monkeypatch.setenv("XLA_FLAGS", "--xla_some=1")
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "0")
    monkeypatch.delenv("JAX_PLATFORMS", raising=False)
    disable_triton_gemm()
    assert os.environ["XLA_FLAGS"] == "--xla_some=1"  # JAX cannot use the GPU
    monkeypatch.setattr(accelerators.importlib.util, "find_spec", lambda name: name == "jax_cuda13_plugin")
    disable_triton_gemm()
    disable_triton_gemm()
    assert os.environ["XLA_FLAGS"] == "--xla_some=1 --xla_gpu_enable_triton_gemm=false"
    monkeypatch.setenv("XLA_FLAGS", "--xla_gpu_enable_triton_gemm=true")
    disable_triton_gemm()
    assert os.environ["XLA_FLAGS"] == "--xla_gpu_enable_triton_gemm=true"
    monkeypatch.delenv("XLA_FLAGS")
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    disable_triton_gemm()
    assert "XLA_FLAGS" not in os.environ


def test_the_setting_of_a_worker_has_one_gpu(monkeypatch):
    monkeypatch.setattr(provenance.jax, "devices", lambda: [SimpleNamespace(platform="gpu", device_kind="H100")] * 8)
    monkeypatch.setattr(provenance.jax, "device_count", lambda: 8)
    assert [worker_threads(parallel)["device"] for parallel in (1, 2)] == ["gpu: H100 x 8", "gpu: H100 x 1"]


def test_a_worker_refuses_a_run_that_was_planned_for_another_device(tmp_path):
    """Regression: a worker whose GPU JAX did not find trained on the CPU, recorded as planned."""
    here = provenance.thread_setting()
    workers._check_setting(Job(RunConfig(), tmp_path, threads=here))
    with pytest.raises(UserError, match=r"another setting than was planned: .*H100"):
        workers._check_setting(Job(RunConfig(), tmp_path, threads=here | {"device": "gpu: H100 x 1"}))
