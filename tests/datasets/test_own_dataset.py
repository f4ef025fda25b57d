"""The dataset of docs/architecture.md, which users copy: it runs as it stands there."""

import re

import numpy as np
import pytest

from tests.shared import ROOT
from tflane_jax.config import load_config
from tflane_jax.datasets import sources
from tflane_jax.errors import UserError
from tflane_jax.evaluation.lane_groups import lane_groups
from tflane_jax.own_modules import import_file
from tflane_jax.scene import row_of


@pytest.mark.usefixtures("own_sources")
def test_the_dataset_of_the_page_reads_its_files(tmp_path):
    page = (ROOT / "docs" / "architecture.md").read_text("utf-8")
    (code,) = [block for block in re.findall(r"^```python\n(.*?)^```", page, re.S | re.M) if "def my_example" in block]
    (tmp_path / "mydata.py").write_text(code)
    module = import_file(tmp_path / "mydata.py")
    data = module.MyData(tmp_path / "drives", load_config("tf_lane/toponet").data.example)
    config, file = data.source("train"), tmp_path / "drives" / "train" / "0.npz"
    with pytest.raises(UserError, match="has no npz file"):
        sources.source_of(config).dataset(config)
    grid = data.example.sensor.grid
    line = np.stack([np.linspace(-20.0, 40.0, 10), np.full(10, 8.0), np.zeros(10)], -1)
    bev = np.zeros((grid.rows, grid.columns, 4), np.uint8)
    for y in (9.75, 6.25):  # the boundaries of a lane 3.5 m wide
        bev[np.floor(grid.pixel(np.array([[0.0, y]]))[0, 1]).astype(int)] = 255
    file.parent.mkdir(parents=True)
    np.savez(file, lines=line[None], bev=bev)
    one = row_of(sources.load(config, progress=False), 0)
    assert one.lanes.valid.tolist() == [True] + [False] * (data.example.lanes - 1)
    groups = lane_groups(one.lanes, one.bev, one.traffic_flow, grid.range)
    assert [name for name, members in groups.items() if members.any()] == ["visible-traffic"]
    before = sources.source_of(config).content(config)
    np.savez(file, lines=0.5 * line[None], bev=bev)
    assert sources.source_of(config).content(config) != before
