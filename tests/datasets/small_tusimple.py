"""TuSimple in small: two label files and their images."""

import json

import cv2
import numpy as np

from tflane_jax.datasets.tusimple import TuSimpleConfig, TuSimpleDataset
from tflane_jax.files.tusimple import ROWS

ROWS_48 = ROWS[8:]


def write_tusimple(folder):
    """Write two label files of two frames each, 48 and 56 heights, and their images; return the folder."""
    files = {"label_data_0313.json": ROWS_48, "label_data_0531.json": ROWS}
    for f, (name, rows) in enumerate(files.items()):
        records = []
        for i in range(2):
            raw = f"clips/{f}/{i}/20.jpg"
            (folder / raw).parent.mkdir(parents=True)
            image = np.full((720, 1280, 3), 40 * (2 * f + i), np.uint8)
            assert cv2.imwrite(str(folder / raw), image)
            present = [-2] * 5 + list(range(100, 100 + len(rows) - 5))
            lanes = [[x + 500 if x > 0 else x for x in present], present, [-2] * len(rows)]
            records.append({"raw_file": raw, "lanes": lanes, "h_samples": rows.tolist()})
        (folder / name).write_text("".join(json.dumps(record) + "\n" for record in records))
    return folder


def dataset_of(root, **changes):
    return TuSimpleDataset(TuSimpleConfig(str(root), **changes))
