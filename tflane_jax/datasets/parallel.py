"""Filling .npy files with the examples of a dataset, in parallel worker processes.

Every example has its own slot in files of known layout. The bytes therefore do not depend on the number of workers or
on the order in which they finish, and no array is sent between processes. Slots are written with plain `write`, not
through memory maps: on a full disk a write raises OSError, a memory map kills the process.
"""

from __future__ import annotations

import contextlib
import itertools
import multiprocessing
import warnings
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tflane_jax.child_processes import (
    SAFE_PATH,
    end_with_parent,
    end_workers,
    environment_of_children,
    spared_interrupts,
)
from tflane_jax.datasets.base import IndexedExamples, made
from tflane_jax.datasets.leaves import check_form, example_leaves
from tflane_jax.errors import UserError
from tflane_jax.progress import progress_bar

# Examples per task of a worker. A multiple of 1, 2, 3, 4, 6, 8 and 12, so that scenes of that many frames are simulated
# once.
BLOCK = 24

# Environment of a worker: one core each, and never the accelerator of the training process.
_WORKER_ENVIRONMENT = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "JAX_PLATFORMS": "cpu",
} | SAFE_PATH


def frame_leaves(dataset: IndexedExamples, index: int) -> tuple[dict[str, np.ndarray], str]:
    """Return the arrays of one example, those of its `FrameInfo` under "info.", and the name of its scene."""
    info = dataset.info(index)
    leaves = example_leaves(made(dataset, index))
    leaves["info.timestamp_ns"] = np.asarray(info.timestamp_ns, np.int64)
    leaves["info.global_from_ego"] = np.asarray(info.global_from_ego, np.float64)
    return leaves, info.scene


def leaf_path(folder: Path, name: str) -> Path:
    """Return the file that holds the leaf of that name for every example."""
    return folder / f"{name}.npy"


@dataclass(frozen=True)
class Slot:
    """Layout of the file of one leaf.

    Attributes:
        start: bytes before the first example's value.
        shape, dtype: of one example's value.
    """

    start: int
    shape: tuple[int, ...]
    dtype: np.dtype


@dataclass(frozen=True)
class _Job:
    """Arguments of every worker."""

    folder: Path
    dataset: IndexedExamples
    slots: dict[str, Slot]


def fill(
    folder: Path, dataset: IndexedExamples, template: dict[str, np.ndarray], *, workers: int, progress: bool
) -> list[str]:
    """Write every example of `dataset` below `folder`, one .npy file per leaf, and return their scene names.

    Args:
        folder: empty.
        dataset: can be pickled for the workers.
        template: `frame_leaves` of any example, for names, shapes and types.
        workers: processes; with one, or with at most `BLOCK` examples, this process does the work itself.
        progress: show a bar with rate and time left.

    Raises:
        OSError: disk full, or no permission.
        UserError: examples differ in shape or type, or a worker died.
        Exception: what the dataset raises.
    """
    count = len(dataset)
    slots = {name: _lay_out(folder, name, leaf, count) for name, leaf in template.items()}
    job = _Job(folder, dataset, slots)
    blocks = [range(start, min(start + BLOCK, count)) for start in range(0, count, BLOCK)]
    scenes: dict[int, str] = {}
    title = f"building {dataset.name}"
    with progress_bar(total=count, desc=title, unit="example", disable=not progress) as bar:
        for indices, names in _run(job, blocks, min(workers, len(blocks))):
            scenes.update(zip(indices, names, strict=True))
            bar.update(len(indices))
    return [scenes[index] for index in range(count)]


def _lay_out(folder: Path, name: str, leaf: np.ndarray, count: int) -> Slot:
    """Create the leaf's file at its full size (sparse, all zero) and return where its slots are."""
    header = {
        "descr": np.lib.format.dtype_to_descr(leaf.dtype),
        "fortran_order": False,
        "shape": (count, *leaf.shape),
    }
    with open(leaf_path(folder, name), "wb") as file:
        np.lib.format.write_array_header_2_0(file, header)
        start = file.tell()
        file.truncate(start + count * leaf.nbytes)
    return Slot(start, leaf.shape, leaf.dtype)


def _run(job: _Job, blocks: list[range], workers: int) -> Iterator[tuple[range, list[str]]]:
    """Yield indices and the scene names of their examples as blocks finish."""
    if workers <= 1:
        for index in itertools.chain.from_iterable(blocks):
            one = range(index, index + 1)
            yield one, _write_examples(job, one)
        return
    # Not fork: jax runs threads, and a fork of a process with threads may deadlock.
    context = multiprocessing.get_context("spawn")
    with environment_of_children(_WORKER_ENVIRONMENT):
        pool = ProcessPoolExecutor(workers, context, _start_worker, (job,))
        try:
            with spared_interrupts():  # submitting starts the processes
                futures = {pool.submit(_write_block, block): block for block in blocks}
            for future in as_completed(futures):
                names, warned = future.result()
                for warning in warned:  # those of all workers, so that a text is shown once
                    warnings.warn(warning, stacklevel=2)
                yield futures[future], names
        except BrokenProcessPool as error:
            raise UserError(
                "a worker process that builds the dataset died: either memory ran out (use fewer workers), or a "
                'script started the build outside `if __name__ == "__main__":` (workers import the script)'
            ) from error
        except BaseException:
            end_workers(pool)  # a block may run for half a minute
            raise
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def _write_examples(job: _Job, indices: range) -> list[str]:
    """Write these examples into their slots and return the names of their scenes."""
    scenes = []
    with contextlib.ExitStack() as stack:
        files = {name: stack.enter_context(open(leaf_path(job.folder, name), "r+b")) for name in job.slots}
        for index in indices:
            leaves, scene = frame_leaves(job.dataset, index)
            check_form(
                job.dataset.name, index, leaves, {name: (slot.shape, slot.dtype) for name, slot in job.slots.items()}
            )
            for name, leaf in leaves.items():
                files[name].seek(job.slots[name].start + index * leaf.nbytes)
                files[name].write(leaf.tobytes())
            scenes.append(scene)
    return scenes


_worker_job: _Job


def _start_worker(job: _Job) -> None:
    global _worker_job
    _worker_job = job
    end_with_parent()


def _write_block(indices: range) -> tuple[list[str], list[Warning]]:
    """Return the names of the scenes, and the warnings that this process would have shown."""
    with warnings.catch_warnings(record=True) as caught:
        names = _write_examples(_worker_job, indices)
    return names, [warning.message for warning in caught if isinstance(warning.message, Warning)]
