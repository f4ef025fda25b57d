"""The command line: what a split holds, as numbers and as pictures."""

import pytest

from tflane_jax.cli import main


def test_data_stats_counts_lanes_and_traffic(capsys):
    assert main(["data", "stats", "--data", "street", "--split", "val", "--count", "2"]) == 0
    printed = capsys.readouterr().out
    assert "procedural-val: 2 examples" in printed
    rows = {line.split("|")[1].strip(): line.split("|")[2:-1] for line in printed.splitlines() if "|" in line}
    mean, low, _, high = map(float, rows["lanes"])
    assert 1.0 <= low <= mean <= high
    for quantity in ("lanes hidden+traffic", "- standing vehicles", "examples with more than 30"):
        assert quantity in rows
    driven = [float(cell) for cell in rows["fraction of lane length driven on"]]
    assert 0.0 < min(driven) <= max(driven) < 1.0


def test_data_stats_counts_map_lines(capsys):
    assert main(["data", "stats", "--config", "tf_lane/maptr:street", "--split", "val", "--count", "2"]) == 0
    printed = capsys.readouterr().out
    rows = {line.split("|")[1].strip(): line.split("|")[2:-1] for line in printed.splitlines() if "|" in line}
    assert float(rows["lines, boundary"][0]) >= 1.0
    assert float(rows["metres of boundary"][0]) > 30.0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [(["--count", "0"], "nothing to count"), (["--data", "front-views"], "are no lane graphs")],
)
def test_data_stats_needs_lane_graphs(arguments, message, capsys):
    assert main(["data", "stats", *arguments]) == 2
    assert message in capsys.readouterr().err


def test_data_show_draws_world_cameras(tmp_path, capsys):
    assert main(["data", "show", "--data", "world-cameras", "--count", "1", "--out", str(tmp_path / "world.png")]) == 0
    assert {path.name for path in tmp_path.iterdir()} == {"world.png", "world-cameras.png"}
    assert "traffic lights and signs" in capsys.readouterr().out
