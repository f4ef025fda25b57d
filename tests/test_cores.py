"""How many workers start: by the cores of a process, and by the limit of its container."""

import os

import pytest

from tflane_jax import cores


@pytest.fixture
def system(tmp_path):
    """Return a function that writes files of a system, by their names."""

    def write(files):
        for name, text in files.items():
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / name).write_text(text)
        return tmp_path

    return write


V1 = {"proc/self/cgroup": "4:memory:/docker/a\n3:cpu,cpuacct:/docker/a\n", "sys/fs/cgroup/memory/cpu.max": "1 100000\n"}


@pytest.mark.parametrize(
    ("files", "expected"),
    [
        ({}, None),
        ({"proc/self/cgroup": "0::/\n"}, None),
        ({"proc/self/cgroup": "0::/\n", "sys/fs/cgroup/cpu.max": "max 100000\n"}, None),
        ({"proc/self/cgroup": "0::/\n", "sys/fs/cgroup/cpu.max": "250000 100000\n"}, 2.5),
        (
            {
                "proc/self/cgroup": "0::/user/job\n",
                "sys/fs/cgroup/user/cpu.max": "200000 100000\n",
                "sys/fs/cgroup/user/job/cpu.max": "800000 100000\n",
            },
            2.0,
        ),
        ({"proc/self/cgroup": "0::/../of/the/host\n", "sys/fs/cgroup/cpu.max": "50000 100000\n"}, 0.5),
        (V1 | {"sys/fs/cgroup/cpu/cpu.cfs_quota_us": "-1\n", "sys/fs/cgroup/cpu/cpu.cfs_period_us": "100000\n"}, None),
        (
            V1 | {"sys/fs/cgroup/cpu/cpu.cfs_quota_us": "300000\n", "sys/fs/cgroup/cpu/cpu.cfs_period_us": "100000\n"},
            3.0,
        ),
    ],
)
def test_the_limit_of_a_container_is_read(files, expected, system):
    assert cores.cpu_quota(system(files)) == expected


@pytest.mark.parametrize(("quota", "workers"), [(None, 16), (0.5, 1), (2.5, 3), (64.0, 16)])
def test_no_more_workers_start_than_are_kept_busy(quota, workers, monkeypatch):
    monkeypatch.setattr(os, "cpu_count", lambda: 64)
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: set(range(16)), raising=False)
    monkeypatch.setattr(cores, "cpu_quota", lambda: quota)
    assert cores.working_cores() == workers
    assert cores.own_cores({}) == workers
    assert cores.usable_cores() == 16  # the threads of XLA, by which runs are identified
