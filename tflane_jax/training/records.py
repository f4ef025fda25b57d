"""Records of a run: metrics as JSON lines and for TensorBoard, both cut back to the step of a resume."""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, TypeGuard

import numpy as np

from tflane_jax.errors import UserError
from tflane_jax.files.atomic import write_text
from tflane_jax.files.fields import read_text

Record = dict[str, Any]


def read_records(path: Path) -> list[Record]:
    """Return the records of a metrics.jsonl in order, without the last line if that is none (it may be cut short).

    Raises UserError if the file cannot be read as text, or names an earlier line that is no record, or a line with
    values of another number of seeds than an earlier one.
    """
    if not path.exists():
        return []
    try:
        lines = read_text(path, "file of records").splitlines()
    except UserError as error:
        raise UserError(f"{error}: move it away, the run goes on without its earlier records") from error
    records: list[Record] = []
    counts: dict[tuple[str, str], int] = {}
    for number, line in enumerate(lines, start=1):
        try:
            record = json.loads(line)
        except (ValueError, RecursionError):
            record = None
        if _is_record(record):
            records.append(record)
            for name, value in record.items():
                count = len(value) if isinstance(value, list) else 1
                if counts.setdefault((record["split"], name), count) != count:
                    raise UserError(
                        f"{path}, line {number} has another number of values of {name} than a line before it: correct "
                        "or delete one of them; the others are kept"
                    )
        elif number < len(lines):
            raise UserError(f"{path}, line {number} is no record: correct or delete that line; the others are kept")
    return records


def _is_record(record: Any) -> TypeGuard[Record]:
    if not isinstance(record, dict) or type(record.get("step")) is not int or not isinstance(record.get("split"), str):
        return False
    values = [value for name, value in record.items() if name not in ("step", "split")]
    numbers = [number for value in values for number in (value if isinstance(value, list) else [value])]
    return record["step"] >= 0 and all(_is_number(number) for number in numbers)


def _is_number(value: Any) -> bool:
    return type(value) is float or (type(value) is int and abs(value) < 2**63)


class RecordWriter:
    """Appends records to `<folder>/metrics.jsonl` and `<folder>/tensorboard/`.

    A record is one flat dict: `step` (updates made), `split` ("train", "val") and values by name: a number, or a list
    of one per seed where several train together.

    Args:
        folder: the run's folder.
        step: step from which the run starts or resumes; later records of an earlier process are dropped.
        due: whether the run begins with the evaluation of this step, whose records are dropped, too.
    """

    def __init__(self, folder: Path, step: int, due: bool = False):
        self._path = path = folder / "metrics.jsonl"
        earlier = [record for record in read_records(path) if record["step"] <= step]
        self.records = [r for r in earlier if not due or r["step"] < step or r["split"] == "train"]
        write_text(path, "".join(_line(record) for record in self.records))
        with self._write_errors():
            self._board = _Board(folder / "tensorboard", step + 1 if self.records else None)
            self._file = open(path, "a", encoding="utf-8")  # noqa: SIM115 (closed by __exit__)

    def write(self, record: Record) -> None:
        """Append one record and flush the files; raises UserError where that fails."""
        self.records.append(record)
        with self._write_errors():
            self._file.write(_line(record))
            self._file.flush()
            self._board.write(record)

    def __enter__(self) -> RecordWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for file in (self._file, self._board):
            with contextlib.suppress(OSError):  # `write` has raised already
                file.close()

    @contextlib.contextmanager
    def _write_errors(self) -> Iterator[None]:
        """Raise UserError for an OSError inside the block."""
        try:
            yield
        except OSError as error:
            raise UserError(
                f"cannot write the records in {self._path.parent}: {error.strerror or error}; make room or give the "
                "right to write there, and go on with --resume"
            ) from error


class _Board:
    """Scalars for TensorBoard.

    tensorboardX's own `SummaryWriter` writes in a thread, which dies on a full disk and leaves the program waiting.

    Args:
        folder: of the event files.
        purge: TensorBoard hides events of earlier files from this step on; None hides none.
    """

    def __init__(self, folder: Path, purge: int | None):
        from tensorboardX.event_file_writer import EventsWriter
        from tensorboardX.proto.event_pb2 import Event, SessionLog  # pyright: ignore[reportAttributeAccessIssue]

        folder.mkdir(parents=True, exist_ok=True)
        self._events = EventsWriter(str(folder / "events"))
        if purge is not None:
            self._events.write_event(Event(step=purge, file_version="brain.Event:2"))
            self._events.write_event(Event(step=purge, session_log=SessionLog(status=SessionLog.START)))

    def write(self, record: Record) -> None:
        """Append the values of a record and flush the file."""
        from tensorboardX.proto.event_pb2 import Event  # pyright: ignore[reportAttributeAccessIssue]
        from tensorboardX.summary import scalar

        for name, value in record.items():
            if name in ("step", "split"):
                continue
            tag = f"{record['split']}/{name}"
            tags = {f"{tag}/{i}": v for i, v in enumerate(value)} if isinstance(value, list) else {tag: value}
            for one, number in tags.items():
                event = Event(step=record["step"], wall_time=time.time(), summary=scalar(one, number))
                self._events.write_event(event)
        self._events.flush()

    def close(self) -> None:
        """Close the file."""
        self._events.close()


class Unwritten:
    """The records of a process that writes none."""

    def __init__(self) -> None:
        self.records: list[Record] = []

    def write(self, record: Record) -> None:
        """Keep one record."""
        self.records.append(record)

    def __enter__(self) -> Unwritten:
        return self

    def __exit__(self, *_: object) -> None:
        pass


def _line(record: Record) -> str:
    return json.dumps(record) + "\n"


@dataclass
class Window:
    """Sums of metrics since the last record; checkpoints hold them, so that a resumed run writes the same records."""

    steps: int = 0
    sums: dict[str, list[float]] = field(default_factory=dict)

    def add(self, metrics: dict[str, np.ndarray]) -> None:
        for name, value in metrics.items():
            self.sums[name] = list(np.add(self.sums.get(name, 0.0), np.atleast_1d(value).astype(float)))
        self.steps += 1

    def record(self, step: int) -> Record:
        means = {name: np.divide(values, self.steps).tolist() for name, values in self.sums.items()}
        return seed_record(step, "train", means)


def by_name(every: Sequence[Mapping[str, float]]) -> dict[str, list[float]]:
    """Return the values that all seeds have, a list of one per seed by name."""
    return {name: [float(one[name]) for one in every] for name in every[0] if all(name in one for one in every)}


def seed_record(step: int, split: str, values: dict[str, list[float]]) -> Record:
    """Return the record of values with one entry per seed."""
    return {"step": step, "split": split} | {name: v[0] if len(v) == 1 else v for name, v in values.items()}
