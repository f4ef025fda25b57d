"""A comparison never shows the numbers of another run: folders, configurations, checkpoints, test data."""

import json
import os
import shutil
from dataclasses import replace

import pytest

from tests.datasets.test_geojson_lanes import crossroads_features, write
from tests.tiny_run import fakes  # noqa: F401 (a fixture that is used by itself)
from tflane_jax.ablations import workers
from tflane_jax.ablations.jobs import Job, file_names
from tflane_jax.ablations.scores import code_digest, measure, with_test_set
from tflane_jax.cli import main
from tflane_jax.config import RunConfig, load_config
from tflane_jax.config_overrides import apply_overrides
from tflane_jax.datasets.real_maps import RealMapData
from tflane_jax.datasets.sources import source_of
from tflane_jax.errors import UserError
from tflane_jax.own_modules import import_file
from tflane_jax.training.records import read_records

QUICK = ["--training.eval-every", "4"]
OWN_LOSS = """from dataclasses import dataclass
from tflane_jax.losses.toponet import TopoNetLossConfig


@dataclass(frozen=True)
class OwnLoss(TopoNetLossConfig):
    own_weight: float = {}
"""


pytestmark = pytest.mark.usefixtures("cheap")


@pytest.fixture(scope="module")
def compared(tiny, cheap, tmp_path_factory):
    """A finished comparison of one run; tests work on copies."""
    out = tmp_path_factory.mktemp("compared") / "out"
    assert main(["compare", f"base={tiny}:baseline", "--seeds", "0", "--out", str(out), *QUICK]) == 0
    return out


@pytest.fixture
def out(compared, tmp_path):
    return shutil.copytree(compared, tmp_path / "out")


def again(config, out, *arguments):
    return main(["compare", f"base={config}:baseline", "--seeds", "0", "--out", str(out), *QUICK, *arguments])


def losses(folder):
    return [record["loss"] for record in read_records(folder / "metrics.jsonl") if record["split"] == "train"]


@pytest.mark.parametrize(
    ("arguments", "difference"),
    [
        (["--optim.lr", "0.1"], "optim.lr: 0.01 there, 0.1 here"),
        (["--training.steps", "8"], "training.steps: 4 there, 8 here"),
        (["--training.steps", "2"], "training.steps: 4 there, 2 here"),
        (["--data.test", "7"], "data.test: 200 there, 7 here"),
    ],
)
def test_a_run_of_another_configuration_is_named_and_refused(tiny, out, capsys, arguments, difference):
    before = losses(out / "base" / "seed_0")
    assert again(tiny, out, *arguments) == 2
    told = capsys.readouterr().err
    assert f"{out / 'base' / 'seed_0'} holds a run of another configuration ({difference})" in told
    assert "--out" in told
    assert "--retrain" in told
    assert losses(out / "base" / "seed_0") == before


def test_a_run_of_another_configuration_is_trained_anew_on_request(tiny, out):
    run, before = out / "base" / "seed_0", json.loads((out / "scores.json").read_text())
    assert again(tiny, out, "--optim.lr", "0.1", "--retrain") == 0
    assert json.loads((run / "config.json").read_text())["optim"]["lr"] == 0.1
    assert json.loads((out / "scores.json").read_text()) != before
    records = run / "metrics.jsonl"
    trained = records.stat().st_mtime_ns
    assert again(tiny, out, "--optim.lr", "0.1", "--retrain") == 0  # the same run is not trained twice
    assert records.stat().st_mtime_ns == trained


def test_a_run_with_another_thread_setting_is_refused(tiny, out, capsys, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "77")
    assert again(tiny, out) == 2
    assert "OMP_NUM_THREADS: None there, 77 here" in capsys.readouterr().err


def test_runs_from_before_thread_settings_were_recorded_are_used(tiny, out):
    path = out / "base" / "seed_0" / "provenance.json"
    starts = json.loads(path.read_text())
    assert [start.pop("threads") for start in starts]
    path.write_text(json.dumps(starts))
    before = losses(out / "base" / "seed_0")
    assert again(tiny, out) == 0
    assert losses(out / "base" / "seed_0") == before


def test_a_run_that_started_from_another_one_depends_on_it(tiny, compared, tmp_path, capsys):
    shutil.copytree(compared / "base", tmp_path / "hosts")
    start = ["--training.init-from", str(tmp_path / "hosts" / "seed_{seed}")]
    assert again(tiny, tmp_path / "out", *start) == 0
    before = losses(tmp_path / "out" / "base" / "seed_0")
    assert again(tiny, tmp_path / "out", *start) == 0
    assert again(tiny, tmp_path / "other", "--optim.lr", "0.5") == 0
    shutil.rmtree(tmp_path / "hosts")
    assert again(tiny, tmp_path / "out", *start) == 0  # nothing is known to have changed
    shutil.copytree(tmp_path / "other" / "base", tmp_path / "hosts")
    capsys.readouterr()
    assert again(tiny, tmp_path / "out", *start) == 2
    assert f"training.init_from: {tmp_path / 'hosts' / 'seed_0'} was trained anew since" in capsys.readouterr().err
    assert losses(tmp_path / "out" / "base" / "seed_0") == before


def test_a_run_depends_on_the_files_that_it_was_trained_on(tiny, out, capsys, monkeypatch):
    """As many scenes, but other ones: the configuration tells nothing."""
    job, (manifest,) = (
        job_of(tiny, out / "base" / "seed_0"),
        (out / "base" / "seed_0").glob("checkpoints/*4/manifest.json"),
    )
    assert job.is_complete()
    manifest.write_text(json.dumps(json.loads(manifest.read_text()) | {"progress": {"content": "scenes a, b"}}))

    def read(content):
        given = replace(source_of(job.config.data.source("train")), content=content)
        monkeypatch.setattr("tflane_jax.ablations.jobs.source_of", lambda source: given)

    read(lambda split: {"train": "scenes a, b"}[split.split])
    assert job.is_complete()
    read(lambda split: "scenes a, c")
    assert not job.is_complete()
    assert again(tiny, out) == 2
    assert "the files of its training data have changed since" in capsys.readouterr().err

    def gone(split):
        raise UserError("no such folder")

    read(gone)
    assert job.is_complete()


def test_names_that_would_share_a_folder_get_one_each(tiny, tmp_path):
    command = ["compare", f"+TFM={tiny}", f"TFM={tiny}:baseline", "--seeds", "0", "--out", str(tmp_path)]
    assert main([*command, *QUICK]) == 0
    runs = {path.parent for path in tmp_path.glob("*/seed_0/config.json")}
    assert len(runs) == 2
    models = {
        json.loads((run / "config.json").read_text())["task"]["model"]["priors"]["traffic_flow"] is None for run in runs
    }
    assert models == {True, False}


def test_file_names_are_plain_where_they_can_be():
    assert file_names(["baseline", "+TFM", "2 x"]) == {"baseline": "baseline", "+TFM": "tfm", "2 x": "2_x"}
    both = file_names(["+TFM", "TFM", "++", "-"])
    assert len(set(both.values())) == 4
    assert both["TFM"] == file_names(["TFM", "tfm"])["TFM"]  # independent of the other names
    assert all(both.values())


def job_of(config, folder, *arguments):
    return Job(
        apply_overrides(load_config(f"{config}:baseline"), [*QUICK, "--training.seeds", "0", *arguments]), folder
    )


def test_scores_belong_to_a_checkpoints_content(tiny, out, tmp_path):
    """A modification time would not do: a copy or a coarse clock can repeat it."""
    job = job_of(tiny, out / "base" / "seed_0")
    first = measure(job, job.config, "last")
    other = tmp_path / "other"
    assert again(tiny, other, "--optim.lr", "0.5") == 0
    kept = (job.folder / "config.json").stat()
    shutil.rmtree(job.folder / "checkpoints")
    shutil.copytree(other / "base" / "seed_0" / "checkpoints", job.folder / "checkpoints")
    os.utime(job.folder / "config.json", ns=(kept.st_atime_ns, kept.st_mtime_ns))
    swapped = job_of(tiny, other / "base" / "seed_0", "--optim.lr", "0.5")
    assert measure(job, job.config, "last") == measure(swapped, swapped.config, "last") != first


def test_scores_belong_to_data_and_are_measured_once(tiny, out, monkeypatch):
    from tflane_jax.ablations import scores

    job = job_of(tiny, out / "base" / "seed_0")
    first = measure(job, job.config, "last")
    loaded = []
    load = scores.load_test_data
    monkeypatch.setattr(scores, "load_test_data", lambda config: loaded.append(config.data.test) or load(config))
    assert measure(job, job.config, "last") == first
    assert loaded == []
    measure(job, with_test_set(job.config, ["--data.test", "3"]), "last")
    measure(job, with_test_set(job.config, ["--data.test", "3"]), "last")
    assert loaded == [3]
    monkeypatch.setattr(scores, "code_digest", lambda: "another program")
    measure(job, job.config, "last")
    assert loaded == [3, 200]


def test_scores_belong_to_the_files_of_maps_and_of_own_classes(tiny, out, tmp_path, monkeypatch):
    from tflane_jax.ablations import scores

    job, loaded = job_of(tiny, out / "base" / "seed_0"), []
    data = scores.load_test_data(job.config)
    monkeypatch.setattr(scores, "load_test_data", lambda config: loaded.append(config) or data)
    maps, own = tmp_path / "town.geojson", tmp_path / "own.py"
    for features in (crossroads_features(), crossroads_features()[:-1]):
        write(maps, features)
        for _ in range(2):
            measure(job, replace(job.config, data=RealMapData(tmp_path)), "last")
    assert len(loaded) == 2
    for weight in (0.1, 0.2):
        own.write_text(OWN_LOSS.format(weight))
        task = replace(job.config.task, losses=import_file(own).OwnLoss())
        for _ in range(2):
            measure(job, replace(job.config, task=task), "last")
    assert len(loaded) == 4


def test_own_classes_that_were_edited_since_are_told(tiny, tmp_path, capsys):
    """Regression: scores of the code before an edit were shown without a word."""
    config, out = tmp_path / "edited.py", tmp_path / "out"
    text = tiny.read_text().replace(
        "LaneGraphTask(TopoNetConfig(", "LaneGraphTask(losses=EditedLoss(), model=TopoNetConfig("
    )
    text = text.replace("replace(get_config(), task=LaneGraphTask())", "get_config()")
    config.write_text(text + "\n\n" + OWN_LOSS.format(0.1).replace("OwnLoss", "EditedLoss"))
    assert again(config, out) == again(config, out) == 0
    assert "were edited" not in capsys.readouterr().err
    before = losses(out / "base" / "seed_0")
    config.write_text(config.read_text() + "# edited\n")
    assert again(config, out) == 0
    told = f"own modules were edited since they trained {out / 'base' / 'seed_0'}: delete these folders"
    assert told in capsys.readouterr().err
    assert losses(out / "base" / "seed_0") == before


def test_a_run_that_ended_before_its_last_checkpoint_is_not_complete(tiny, out):
    """Its records already reach the last step, because they are written before the last evaluation."""
    run = out / "base" / "seed_0"
    (last,) = (run / "checkpoints").glob("step_00000004")
    shutil.rmtree(last)
    assert not job_of(tiny, run).is_complete()
    assert again(tiny, out) == 0
    assert last.is_dir()
    assert job_of(tiny, run).is_complete()


def test_only_settings_of_the_data_make_a_test_set(tiny):
    job = job_of(tiny, None)
    with pytest.raises(UserError, match=r"--optim\.lr is none"):
        with_test_set(job.config, ["--optim.lr", "1"])
    training, optim = replace(job.config.training, steps=100_000), replace(job.config.optim, warmup_steps=12_000)
    assert with_test_set(replace(job.config, training=training, optim=optim), ["--data.test", "3"]).data.test == 3


def test_scores_are_those_of_the_code_that_runs_though_its_files_change(tmp_path, monkeypatch):
    """A package that is edited while it trains: what the old code measures must not count as the new code's."""
    module = tmp_path / "package" / "__init__.py"
    module.parent.mkdir()
    module.write_text("old = True")

    def train(config, folder, **options):
        module.write_text("old = False")
        raise UserError("enough")

    with monkeypatch.context() as patch:
        patch.setattr("tflane_jax.__file__", str(module))
        patch.setattr(workers, "train_run", train)
        code_digest.cache_clear()
        old = code_digest()
        code_digest.cache_clear()
        assert len(workers.train_all([Job(RunConfig(), tmp_path / "run")], 1)) == 1
        assert code_digest() == old
    code_digest.cache_clear()
