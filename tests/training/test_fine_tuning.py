"""Trainings that start from the parameters of another run."""

import dataclasses
import shutil

import jax
import numpy as np
import pytest

from tests.training.stub import LineTask
from tests.training.stub_run import CONFIG, OPTIM, RESOLVED, run
from tflane_jax.errors import UserError
from tflane_jax.training.checkpoint import Checkpoints
from tflane_jax.training.fine_tuning import check_origins, origins

STILL = dataclasses.replace(OPTIM, lr=0.0, warmup_steps=0)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole") / "run"
    run(folder)
    return folder


def test_fine_tuning_starts_from_the_best_average(whole, tmp_path):
    config = dataclasses.replace(CONFIG, steps=1, init_from=str(whole))
    run(tmp_path / "run", config=config, optim=STILL)
    best = Checkpoints(whole / "checkpoints", best_metric="score")
    start = Checkpoints(tmp_path / "run" / "checkpoints").params(1)["line"]["kernel"]
    np.testing.assert_allclose(start, best.params(best.find("best"))["line"]["kernel"], rtol=1e-6)
    with pytest.raises(UserError, match="holds another model"):
        run(tmp_path / "other", config=dataclasses.replace(config, steps=9), task=LineTask(features=2))


@pytest.mark.parametrize("content", ["{}", '{"training": {}}', '{"training": {"best_metric": "score", "seeds": 3}}'])
def test_a_run_to_start_from_without_its_settings_is_damaged(whole, tmp_path, content):
    shutil.copytree(whole, tmp_path / "origin")
    (tmp_path / "origin" / "config.json").write_text(content)
    with pytest.raises(UserError, match=r"config\.json is damaged: it lacks training\.best_metric or training\.seeds"):
        check_origins(str(tmp_path / "origin"), (0,))


def test_no_run_is_written_with_a_capital():
    with pytest.raises(UserError, match=r"training\.init_from is none: .*; write None to start from no run"):
        check_origins("none", (0,))


def test_every_seed_may_start_from_a_run_of_its_own(whole, tmp_path):
    short = dataclasses.replace(CONFIG, steps=4)
    for seed in (0, 1):
        run(tmp_path / f"host_{seed}", config=dataclasses.replace(short, seeds=(seed,)))
    config = dataclasses.replace(CONFIG, steps=1, seeds=(0, 1), init_from=str(tmp_path / "host_{seed}"))
    run(tmp_path / "run", config=config, optim=STILL)
    tuned = Checkpoints(tmp_path / "run" / "checkpoints").params(1)["line"]["kernel"]
    for i in (0, 1):
        host = Checkpoints(tmp_path / f"host_{i}" / "checkpoints").params(4)["line"]["kernel"]
        np.testing.assert_allclose(tuned[i], host, rtol=1e-6)
    assert not np.array_equal(tuned[0], tuned[1])


def test_seeds_that_start_from_one_run_keep_random_keys_of_their_own(whole, tmp_path):
    """Else they would draw the same dropout, and several seeds would be one."""
    seeds = (0, 5)
    run(tmp_path / "run", config=dataclasses.replace(CONFIG, steps=1, seeds=seeds, init_from=str(whole)), optim=STILL)
    keys = Checkpoints(tmp_path / "run" / "checkpoints").arrays(1)["key"]
    expected = [np.asarray(jax.random.key_data(jax.random.key(seed))) for seed in seeds]
    np.testing.assert_array_equal(keys, expected)


def test_a_seed_starts_from_itself_where_a_run_has_several(tmp_path):
    resolved = RESOLVED | {"training": RESOLVED["training"] | {"seeds": [7, 8]}}
    run(tmp_path / "host", config=dataclasses.replace(CONFIG, steps=4, seeds=(7, 8)), resolved=resolved)
    config = dataclasses.replace(CONFIG, steps=1, seeds=(8, 9), init_from=str(tmp_path / "host"))
    run(tmp_path / "run", config=config, optim=STILL)
    host = Checkpoints(tmp_path / "host" / "checkpoints").params(4)["line"]["kernel"]
    tuned = Checkpoints(tmp_path / "run" / "checkpoints").params(1)["line"]["kernel"]
    np.testing.assert_allclose(tuned, [host[1], host[0]], rtol=1e-6)  # a seed that is not there: from the first
    assert [one["seed"] for one in origins(str(tmp_path / "host"), (8, 9))] == [8, 7]


def test_parts_of_another_model_can_be_initialised_afresh(whole, tmp_path, capsys):
    config = dataclasses.replace(CONFIG, steps=1, init_from=str(whole))
    more = LineTask(second_layer=True)
    with pytest.raises(
        UserError, match=r"second/.* is only here.*init_partly takes over the 16 of 19 parameters \(84 %\)"
    ):
        run(tmp_path / "run", config=config, task=more, optim=STILL)
    assert not (tmp_path / "run" / "config.json").exists()
    partly = dataclasses.replace(config, init_partly=True)
    run(tmp_path / "run", config=partly, task=more, optim=STILL)
    assert "second start afresh" in capsys.readouterr().err
    best = Checkpoints(whole / "checkpoints", best_metric="score")
    start = Checkpoints(tmp_path / "run" / "checkpoints").params(1)
    np.testing.assert_allclose(start["line"]["kernel"], best.params(best.find("best"))["line"]["kernel"], rtol=1e-6)
    # The other direction: parameters that only the other run has are left out.
    run(tmp_path / "back", config=dataclasses.replace(partly, init_from=str(tmp_path / "run")), optim=STILL)
    assert "second are left out" in capsys.readouterr().err
    with pytest.raises(UserError, match=r"another model \(line/"):
        run(tmp_path / "other", config=partly, task=LineTask(features=2), optim=STILL)
