"""Published weights are found by name, and only those."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.convert.lstr_state import LAYER, TINY, lstr_state
from tests.convert.torch_files import of, write_zip
from tests.shared import shared_path
from tflane_jax.commands.convert import convert
from tflane_jax.config import load_config
from tflane_jax.convert.lstr import load_lstr
from tflane_jax.convert.published import load_weights
from tflane_jax.convert.torch_file import read_state_dict
from tflane_jax.convert.weights_files import PUBLISHED, digest_of, find_weights
from tflane_jax.errors import UserError
from tflane_jax.models.lstr import TransformerEncoderConfig

LSTR = PUBLISHED["lstr"]


@pytest.fixture
def folders(tmp_path, monkeypatch):
    """Return two folders of $TFLANE_WEIGHTS and that of the cache."""
    found = [tmp_path / name for name in ("a", "b")]
    monkeypatch.setenv("TFLANE_WEIGHTS", os.pathsep.join(map(str, found)))
    monkeypatch.setenv("TFLANE_CACHE", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)
    found.append(tmp_path / "cache" / "weights")
    for folder in found:
        folder.mkdir(parents=True)
    return found


def test_a_missing_file_is_named_with_its_source_and_checksum(folders):
    with pytest.raises(UserError) as error:
        find_weights(Path("lstr"))
    said = str(error.value)
    for word in (*map(str, folders), LSTR.url, LSTR.licence, LSTR.digest, "TFLANE_WEIGHTS", *LSTR.files):
        assert word in said, word
    assert f" into {folders[-1]}, or name" in said


@pytest.mark.parametrize("file", LSTR.files)
@pytest.mark.parametrize("place", range(3))
def test_the_file_is_found_in_any_folder(folders, place, file):
    (folders[place] / file).touch()
    assert find_weights(Path("lstr")) == (folders[place] / file, LSTR)


def test_the_variable_may_name_the_file(folders, monkeypatch):
    file = folders[0] / LSTR.files[0]
    file.touch()
    monkeypatch.setenv("TFLANE_WEIGHTS", str(file))
    assert find_weights(Path("lstr")) == (file, LSTR)


def test_an_average_beside_the_weights_is_named_and_can_be_taken(tmp_path):
    kinds = {"state_dict": lstr_state(0), "state_dict_ema": lstr_state(1)}
    of_file = {name: {key: of(tensor) for key, tensor in state.items()} for name, state in kinds.items()}
    path = write_zip(tmp_path / "w.pth", of_file | {"optimizer": {"state": {"exp_avg": of(np.ones(3, np.float32))}}})
    params, table = load_lstr(path, TINY)
    told = "not read: state_dict_ema has tensors of the same names (--entry state_dict_ema)"
    assert [row["becomes"] for row in table if row["becomes"].startswith("not read")] == [told]
    averaged, table = load_lstr(path, TINY, entry="state_dict_ema")
    assert not [row for row in table if row["becomes"].startswith("not read")]
    for entry, found in zip(kinds, (params, averaged), strict=True):
        np.testing.assert_array_equal(found["queries"], kinds[entry]["query_embed.weight"])


@pytest.mark.parametrize(
    ("part", "change"),
    [
        ("decoder.heads", {"decoder": replace(LAYER, heads=4)}),
        ("decoder.norm_first", {"decoder": replace(LAYER, norm_first=True)}),
        ("encoder.layer.heads", {"encoder": TransformerEncoderConfig(1, replace(LAYER, heads=1))}),
        ("encoder.layer.activation", {"encoder": TransformerEncoderConfig(1, replace(LAYER, activation="gelu"))}),
    ],
)
def test_of_the_published_tensors_the_layers_are_known(tmp_path, monkeypatch, part, change):
    model, state = replace(TINY, **change), lstr_state()
    path = write_zip(tmp_path / "w.pth", {"state_dict": {key: of(tensor) for key, tensor in state.items()}})
    load_lstr(path, model)  # a training of one's own may have had any
    monkeypatch.setitem(PUBLISHED, "lstr", replace(LSTR, digest=digest_of(state)))
    load_lstr(path, TINY)
    with pytest.raises(UserError, match=rf"w.pth: .*mean something else where task.model.{part} is"):
        load_lstr(path, model)


def test_paths_are_paths(folders):
    assert find_weights(Path("any.pth")) == (Path("any.pth"), None)
    Path("lstr").touch()
    assert find_weights(Path("lstr")) == (Path("lstr"), None)


def test_a_folder_of_the_name_is_no_file(folders):
    Path("lstr").mkdir()
    (folders[0] / LSTR.files[0]).touch()
    assert find_weights(Path("lstr")) == (folders[0] / LSTR.files[0], LSTR)


def test_other_tensors_under_the_name_are_refused(folders):
    np.savez(folders[2] / "LSTR_500000.npz", **lstr_state())
    with pytest.raises(UserError, match=r"LSTR_500000.npz is not the published file: the sha256 of its tensors is"):
        load_lstr(Path("lstr"), TINY)
    load_lstr(folders[2] / "LSTR_500000.npz", TINY)


def test_the_digest_is_that_of_the_weights():
    state = lstr_state()
    digest = digest_of(state)
    counted = {f"module.{name}": tensor for name, tensor in reversed(state.items())}
    counted |= {"module.total_ops": np.zeros(1), "module.layer1.0.bn1.num_batches_tracked": np.array(9)}
    assert digest_of(counted) == digest
    state["bn1.weight"] = state["bn1.weight"] + np.float32(1e-3)
    assert digest_of(state) != digest


@pytest.mark.golden
def test_the_published_file_has_its_digest():
    assert digest_of(read_state_dict(shared_path("data/lstr/LSTR_500000.npz"))) == LSTR.digest


def test_names_of_published_weights_are_listed(folders):
    with pytest.raises(UserError, match=r"^lstrr is neither a file of weights nor a name of published ones, .* lstr$"):
        find_weights(Path("lstrr"))


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("lstr", r"the published weights lstr are of gtn_lane models \(--config gtn_lane/lstr\)"),
        ("toponet", "toponet is neither a file of weights nor a name of published ones, which are lstr"),
    ],
)
def test_models_of_lane_graphs_have_no_published_weights_by_name(name, message, folders, tmp_path):
    (folders[0] / LSTR.files[0]).touch()
    with pytest.raises(UserError, match=message):
        convert("tf_lane/toponet", tmp_path / "run", Path(name))
    with pytest.raises(UserError, match=message):
        load_weights(Path(name), load_config("tf_lane/toponet").task)


def test_a_folder_of_nobody_is_named(monkeypatch):
    """Regression: a traceback."""
    monkeypatch.setenv("TFLANE_WEIGHTS", "~nobody-of-this-name/weights")
    with pytest.raises(UserError, match=r"^TFLANE_WEIGHTS is ~nobody-of-this-name/weights: .* Set it to folders"):
        find_weights(Path("lstr"))
