"""The command line: what a split holds, as numbers and as pictures."""

import functools
import json
from pathlib import Path

import numpy as np
import pytest

from tests.datasets.test_geojson_lanes import crossroads_features, write
from tests.datasets.test_nuscenes_scenes import content
from tests.fakes import FakeConfig, FakeDataset
from tests.shared import assert_same
from tflane_jax.cli import build_parser, main
from tflane_jax.commands.sources import check_used, chosen_source
from tflane_jax.config import load_config
from tflane_jax.config_overrides import apply_overrides
from tflane_jax.datasets.recorded_logs import RecordedConfig, RecordedDataset
from tflane_jax.errors import UserError


def test_data_stats_counts_lanes_and_traffic(capsys):
    assert main(["data", "stats", "--data", "street", "--split", "val", "--count", "2"]) == 0
    printed = capsys.readouterr().out
    assert "street-val: 2 examples" in printed
    rows = {line.split("|")[1].strip(): line.split("|")[3:-1] for line in printed.splitlines() if "|" in line}
    mean, low, _, high = map(float, rows["lanes"])
    assert 1.0 <= low <= mean <= high
    for quantity in (
        "lanes hidden+traffic",
        "metres of lanes hidden+traffic",
        "- standing vehicles",
        "examples with more than 30",
    ):
        assert quantity in rows
    driven = [float(cell) for cell in rows["fraction of lane length driven on"]]
    assert 0.0 < min(driven) <= max(driven) < 1.0


def test_data_stats_counts_map_lines(capsys):
    assert main(["data", "stats", "--config", "tf_lane/maptr:street", "--split", "val", "--count", "2"]) == 0
    printed = capsys.readouterr().out
    rows = {line.split("|")[1].strip(): line.split("|")[3:-1] for line in printed.splitlines() if "|" in line}
    assert float(rows["lines, boundary"][0]) >= 1.0
    assert float(rows["metres of boundary"][0]) > 30.0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--count", "0"], "nothing to count"),
        (["--count", "-1"], "-1 asked for"),
        (["--data", "front-views"], "are no lane graphs"),
    ],
)
def test_data_stats_needs_lane_graphs(arguments, message, capsys):
    assert main(["data", "stats", *arguments]) == 2
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("out", "message"),
    [
        ("sheet.txt", "cannot write sheet.txt: no picture ends in .txt; choose .png, .pdf, .svg or .jpg"),
        (".", "cannot write .: it names no file, only a folder; add a name"),
    ],
)
def test_what_is_no_picture_is_told(out, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["data", "show", "--data", "street", "--count", "1", "--out", out]) == 2
    assert capsys.readouterr().err == f"tflane: {message}\n"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("data", "what"), [("street", "examples"), ("front-views", "images")])
def test_no_example_is_nothing_to_show(data, what, tmp_path, capsys):
    assert main(["data", "show", "--data", data, "--count", "0", "--out", str(tmp_path / "sheet.png")]) == 2
    assert f"{what}, 0 asked for" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "arguments", ["eval RUN --out OUT", "summary --no-compile --out OUT", "data overlap RUN RUN --out OUT"]
)
@pytest.mark.parametrize("out", ["/", "taken"])
def test_where_a_table_cannot_be_written_is_told_before_the_work(arguments, out, tmp_path, monkeypatch, capsys):
    """There is no run here: a message about the table means that nothing was read before."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "taken.md").mkdir()
    assert main(arguments.replace("OUT", out).split()) == 2
    assert capsys.readouterr().err.startswith("tflane: cannot write ")


@pytest.mark.parametrize(
    "arguments",
    [
        "export RUN --out FOLDER",
        "data show --data street --out FOLDER",
        "data maps RUN --out FOLDER",
        "sweep RUN --setting data.world.severity --values 0 --out FILE",
        "tables tf_lane.1 --out FILE",
        "tables tf_lane.1 --record FILE/below",
        "data export --config camera/toponet --out FILE/below",
        "tables gtn_lane.1 --search --out FILE/below",
        "carry-over RUN --out FILE",
        "demo --out FILE",
        "markers curves --out FILE",
        "compare tf_lane/toponet tf_lane/toponet_tfm --out FILE",
        "train --config tf_lane/toponet --out FILE",
        "train --config tf_lane/toponet --out \udcff",
    ],
)
def test_an_output_that_cannot_be_written_is_told_before_the_work(arguments, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("tflane_jax.datasets.sources.make_dataset", None)
    (tmp_path / "FOLDER").mkdir()
    (tmp_path / "FILE").touch()
    assert main(arguments.split()) == 2
    said = capsys.readouterr().err
    assert said.startswith("tflane: cannot write ")
    assert said.endswith("; choose another path\n")
    assert {path.name for path in tmp_path.iterdir()} == {"FOLDER", "FILE"}


@pytest.mark.parametrize("command", ["eval RUN", "summary", "data overlap A B", "data stats", "score maptr A B"])
@pytest.mark.parametrize("out", ["x.json", "x.md", "x.JSON", "x"])
def test_a_table_may_be_named_with_its_suffix(command, out):
    """It would become x.json.md and x.json.json."""
    assert build_parser().parse_known_args([*command.split(), "--out", out])[0].out == Path("x")
    assert build_parser().parse_known_args([*command.split(), "--out", "run-step2.5"])[0].out == Path("run-step2.5")


def test_data_show_draws_what_a_setting_of_the_world_does(tmp_path, capsys):
    show = ["data", "show", "--count", "1", "--split", "test", "--data.world.mirrored"]
    pictures = [tmp_path / f"{fraction}.png" for fraction in "01"]
    for path in pictures:
        assert main([*show, path.stem, "--config", "tf_lane/toponet_tfm", "--out", str(path)]) == 0
    assert pictures[0].read_bytes() != pictures[1].read_bytes()


@pytest.mark.parametrize(
    ("data", "given", "unused"),
    [
        ("street", "--data.world.mirrored 1", True),
        ("street", "--data.example.markers default --data.test 3", True),
        ("street", "--data.example.lanes=30", True),  # the preset has its own
        ("street", "--data.example.markers default --training.steps 3000", False),
        ("procedural", "--data.test 3", False),
        (None, "--data.train 3", False),
    ],
)
def test_a_setting_without_effect_on_the_chosen_data_is_told(data, given, unused):
    before, overrides = load_config("tf_lane/toponet_tfm"), given.split()
    options, _ = build_parser().parse_known_args(["data", "stats", *(["--data", data] if data else [])])
    choose = functools.partial(chosen_source, options=options)
    if not unused:
        check_used(overrides, before, apply_overrides(before, overrides), choose, data)
        return
    wrong = overrides[-1 if "=" in given else -2].partition("=")[0]
    with pytest.raises(UserError, match=f"{wrong} changes the configuration's data, not --data street: leave one"):
        check_used(overrides, before, apply_overrides(before, overrides), choose, data)


@pytest.mark.parametrize("command", ["show", "stats", "export --config tf_lane/toponet --out x", "stats --beside city"])
def test_commands_refuse_settings_that_have_no_effect(command, capsys):
    """`stats` and `export` took them in silence, so that the answer was about other data than asked for."""
    assert main(["data", *command.split(), "--data", "street", "--data.world.severity", "1"]) == 2
    assert "--data.world.severity changes the configuration's data, not --data street" in capsys.readouterr().err


@pytest.mark.slow
def test_data_show_draws_world_cameras(tmp_path, capsys):
    assert main(["data", "show", "--data", "world-cameras", "--count", "1", "--out", str(tmp_path / "world.png")]) == 0
    assert {path.name for path in tmp_path.iterdir()} == {"world.png", "world-cameras.png"}
    assert "traffic lights and signs" in capsys.readouterr().out


def test_a_split_of_the_world_stands_beside_all_recorded_logs(tmp_path, capsys):
    """The command of docs/real_roads.md: recordings have no splits, so that --split is the world's."""
    command = ["data", "stats", "--data", "street", "--split", "val", "--count", "1"]
    assert main([*command, "--beside", f"recorded={tmp_path / 'absent'}"]) == 2
    assert "there is no" in capsys.readouterr().err


@pytest.mark.slow
def test_distributions_of_several_data_are_laid_side_by_side(tmp_path, capsys):
    maps = tmp_path / "maps"
    maps.mkdir()
    write(maps / "town.geojson", crossroads_features())
    chosen = ["data", "stats", "--data", "street", "--split", "val", "--count", "1", "--out", str(tmp_path / "of.1")]
    assert main([*chosen, "--beside", f"real-maps={maps}", "--beside", "street"]) == 0
    printed = capsys.readouterr().out
    for column in ("street (1 frames)", "real-maps (1 frames)", "street #2 (1 frames)"):
        assert column in printed
    rows = {line.split("|")[1].strip(): line.split("|")[2:-1] for line in printed.splitlines() if "|" in line}
    for quantity in ("lanes", "connectors", "length, m", "curvature, 1/100 m", "visible fraction"):
        first, other, again = (cell.strip() for cell in rows[quantity])
        assert first == again
        assert float(other.split(" ")[0]) >= 0.0
    written = json.loads((tmp_path / "of.1.json").read_text())
    assert written["meta"]["values"]["street"]["lanes"]["values"] == 1
    assert {path.name for path in tmp_path.glob("of*")} == {"of.1.md", "of.1.json", "of.1.png"}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--beside", "front-views"], "are no lane graphs"),
        (["--beside", "nothing"], "there is no data source nothing"),
        (["--beside", "recorded"], "--beside recorded needs its folder: --beside recorded=PATH"),
        (["--out", "x"], "--out is the file of --beside"),
    ],
)
def test_data_that_cannot_be_laid_beside_are_refused(arguments, message, capsys):
    assert main(["data", "stats", "--data", "street", "--count", "1", *arguments]) == 2
    assert message in capsys.readouterr().err


def test_recorded_frames_are_drawn_beside_simulated_ones(tmp_path, monkeypatch, capsys):
    np.savez(tmp_path / "scene-0061.npz", **content())
    shown = []

    def draw(path, examples, titles, **_):
        assert titles == ["scene-0061, recorded", "scene-0061, simulated"]
        shown.extend(examples)
        return path

    def simulated(config):
        assert config.world.mirrored == 0.0  # on the same side of the road as the recording
        return FakeDataset(FakeConfig(2))

    # The map of this scene is too small to drive on, and drawing takes time.
    monkeypatch.setattr("tflane_jax.commands.data_maps.save_contact_sheet", draw)
    monkeypatch.setattr("tflane_jax.commands.data_maps.RealMapDataset", simulated)
    assert main(["data", "maps", str(tmp_path), "--out", str(tmp_path / "maps.png")]) == 0
    recorded = RecordedDataset(RecordedConfig(tmp_path, ("scene-0061",)))
    assert_same(shown[0], recorded.example(int(0.7 * len(recorded))))
    assert_same(shown[1], FakeDataset(FakeConfig(2)).example(1))
    assert "maps.png" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        main(["data", "maps", str(tmp_path), "--moment", "1.0"])
    write(tmp_path / "town.geojson", crossroads_features())
    assert main(["data", "maps", str(tmp_path), "--logs", "town"]) == 2
    assert "maps without recordings" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("data check ABSENT", "or one log; name other data with --format (openlane-v2,"),
        ("data check --format real-maps ABSENT", "there is no ABSENT: name a folder of logs"),
        ("data check --format nuscenes-scenes ABSENT", "there is no ABSENT: name a scene file"),
        ("data check --format nuscenes ABSENT", "there is no folder ABSENT"),
        ("data show --data recorded --root ABSENT", "there is no ABSENT"),
        ("data check .", "holds no Argoverse 2 log"),
        ("data check .", "name other data with --format"),
        (f"data check {'n' * 300}", "File name too long"),
        (f"data show --data street --count 1 --out {'n' * 300}.png", "File name too long"),
    ],
)
def test_a_folder_that_is_not_there_is_told(arguments, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(arguments.split()) == 2
    said = capsys.readouterr().err
    assert message in said
    assert said.count("\n") == 1
    assert list(tmp_path.iterdir()) == []
