"""Records of a run: metrics as JSON lines and for TensorBoard, both cut back to the step of a resume."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path
from types import TracebackType
from typing import Any

from tflane_jax.errors import UserError
from tflane_jax.files.atomic import write_text
from tflane_jax.files.fields import read_text

Record = dict[str, Any]


def read_records(path: Path) -> list[Record]:
    """Return the records of a metrics.jsonl in order, up to the first line that is none (a last one may be cut short).

    Raises UserError if the file cannot be read as text.
    """
    if not path.exists():
        return []
    try:
        lines = read_text(path, "file of records").splitlines()
    except UserError as error:
        raise UserError(f"{error}: move it away, the run goes on without its earlier records") from error
    records = []
    for line in lines:
        try:
            record = json.loads(line)
        except (ValueError, RecursionError):
            break
        if not _is_record(record):
            break
        records.append(record)
    return records


def _is_record(record: Any) -> bool:
    if not isinstance(record, dict) or type(record.get("step")) is not int or not isinstance(record.get("split"), str):
        return False
    values = [value for name, value in record.items() if name not in ("step", "split")]
    numbers = [number for value in values for number in (value if isinstance(value, list) else [value])]
    return all(type(number) in (int, float) for number in numbers)


class RecordWriter:
    """Appends records to `<folder>/metrics.jsonl` and `<folder>/tensorboard/`.

    A record is one flat dict: `step` (updates made), `split` ("train", "val") and values by name: a number, or a list
    of one per seed where several train together.

    Args:
        folder: the run's folder.
        step: step from which the run starts or resumes; later records of an earlier process are dropped.
    """

    def __init__(self, folder: Path, step: int):
        from tensorboardX import SummaryWriter

        path = folder / "metrics.jsonl"
        self.records = [record for record in read_records(path) if record["step"] <= step]
        write_text(path, "".join(_line(record) for record in self.records))
        self._path = path
        self._file = open(path, "a", encoding="utf-8")  # noqa: SIM115 (closed by __exit__)
        purge = step + 1 if self.records else None
        self._board = SummaryWriter(str(folder / "tensorboard"), purge_step=purge, write_to_disk=True)

    def write(self, record: Record) -> None:
        """Append one record and flush the file."""
        self.records.append(record)
        try:
            self._file.write(_line(record))
            self._file.flush()
        except OSError as error:
            raise UserError(
                f"cannot write {self._path}: {error.strerror or error}; make room there and go on with --resume"
            ) from error
        for name, value in record.items():
            if name in ("step", "split"):
                continue
            tag = f"{record['split']}/{name}"
            tags = {f"{tag}/{i}": v for i, v in enumerate(value)} if isinstance(value, list) else {tag: value}
            for one, number in tags.items():
                self._board.add_scalar(one, number, record["step"])

    def __enter__(self) -> RecordWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with contextlib.suppress(OSError):  # what could not be written has been told by `write`
            self._file.close()
        self._board.close()


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
