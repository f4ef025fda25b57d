"""Records of a run: metrics as JSON lines and for TensorBoard, both cut back to the step of a resume."""

from __future__ import annotations

import json
from pathlib import Path
from types import TracebackType
from typing import Any

from tflane_jax.files.atomic import write_text

Record = dict[str, Any]


def read_records(path: Path) -> list[Record]:
    """Return the records of a metrics.jsonl in order, without a last line that was cut short."""
    if not path.exists():
        return []
    records = []
    for line in path.read_text(encoding="utf-8").splitlines():
        try:
            records.append(json.loads(line))
        except ValueError:
            break
    return records


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
        self._file = open(path, "a", encoding="utf-8")  # noqa: SIM115 (closed by __exit__)
        purge = step + 1 if self.records else None
        self._board = SummaryWriter(str(folder / "tensorboard"), purge_step=purge, write_to_disk=True)

    def write(self, record: Record) -> None:
        """Append one record and flush the file."""
        self.records.append(record)
        self._file.write(_line(record))
        self._file.flush()
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
