"""ImageNet weights: torchvision's names and layouts, what a run may start from, what is refused."""

import pickle
from dataclasses import replace
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from tests.models.cases import BASELINE, CAMERA_TOPONET
from tflane_jax.cli import main
from tflane_jax.config import RunConfig, load_config
from tflane_jax.convert.backbone import PART, is_backbone, load_backbone
from tflane_jax.errors import UserError
from tflane_jax.layers.batch_norm import STATISTICS
from tflane_jax.layers.resnet import ResNetConfig
from tflane_jax.runs import open_run, train_run, write_weights
from tflane_jax.tasks.fit import frozen_modules
from tflane_jax.training.fine_tuning import starting_params

TINY = ResNetConfig((1, 2), (2, 3), (1, 2), stem_channels=4, block="bottleneck", frozen_norms=True)


def host(backbone=TINY, **images):
    encoder = CAMERA_TOPONET.encoder
    return replace(
        CAMERA_TOPONET, encoder=replace(encoder, images=replace(encoder.images, backbone=backbone, **images))
    )


def torchvision_state():
    """Return a state dict of `TINY` by torchvision's names: a stem of 4 channels, a stage of one block, one of two."""
    rng, state = np.random.default_rng(0), {}

    def conv(name, out, into, size):
        state[f"{name}.weight"] = rng.normal(size=(out, into, size, size)).astype(np.float32)

    def norm(name, channels):
        for what in ("weight", "bias", "running_mean", "running_var"):
            state[f"{name}.{what}"] = rng.uniform(0.5, 1.5, channels).astype(np.float32)
        state[f"{name}.num_batches_tracked"] = np.array(7)

    conv("conv1", 4, 3, 7)
    norm("bn1", 4)
    for block, into, channels in (("layer1.0", 4, 2), ("layer2.0", 8, 3), ("layer2.1", 12, 3)):
        sizes = ((into, channels, 1), (channels, channels, 3), (channels, 4 * channels, 1))
        for i, (a, b, size) in enumerate(sizes, 1):
            conv(f"{block}.conv{i}", b, a, size)
            norm(f"{block}.bn{i}", b)
        if block != "layer2.1":
            conv(f"{block}.downsample.0", 4 * channels, into, 1)
            norm(f"{block}.downsample.1", 4 * channels)
    state["fc.weight"], state["fc.bias"] = np.zeros((5, 12), np.float32), np.zeros(5, np.float32)
    return state


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("imagenet") / "resnet.npz"
    np.savez(path, **torchvision_state())
    return path


def at(tree, path):
    for name in path.split("/"):
        tree = tree[name]
    return tree


@pytest.mark.parametrize("frozen", [True, False])
def test_tensors_are_renamed_and_transposed(file, frozen):
    params, table = load_backbone(file, host(replace(TINY, frozen_norms=frozen)))
    state = torchvision_state()
    learned, statistics = at(params, PART), at(params[STATISTICS], PART)
    np.testing.assert_array_equal(learned["conv1"]["kernel"], state["conv1.weight"].transpose(2, 3, 1, 0))
    np.testing.assert_array_equal(
        learned["layer2_0"]["downsample_conv"]["kernel"], state["layer2.0.downsample.0.weight"].transpose(2, 3, 1, 0)
    )
    np.testing.assert_array_equal(statistics["layer2_1"]["bn2"]["mean"], state["layer2.1.bn2.running_mean"])
    scales = statistics if frozen else learned
    np.testing.assert_array_equal(scales["bn1"]["scale"], state["bn1.weight"])
    becomes = {row["tensor"]: row["becomes"] for row in table}
    assert becomes.keys() == state.keys()
    assert becomes["fc.weight"] == "ImageNet's classifier, not needed"
    assert becomes["bn1.num_batches_tracked"] == "a counter, not needed"


@pytest.mark.parametrize(
    ("change", "model", "said"),
    [
        ({}, host(replace(TINY, channels=(2, 4))), r"does not fit the model: batch_stats/.*layer2_0"),
        ({}, host(replace(TINY, blocks=(1, 1))), "layer2_1.* in the model"),
        ({}, BASELINE, "models with cameras"),
        ({"head.weight": np.zeros(3)}, host(), "not those of a torchvision ResNet"),
        ({"layer2.0.conv1.weight": np.full((3, 8, 1, 1), np.nan, np.float32)}, host(), "layer2.0.conv1.weight"),
    ],
)
def test_what_does_not_fit_is_named(tmp_path, change, model, said):
    np.savez(tmp_path / "weights.npz", **torchvision_state() | change)
    with pytest.raises(UserError, match=said):
        load_backbone(tmp_path / "weights.npz", model)


def test_other_checkpoints_are_no_backbone():
    names = list(torchvision_state())
    assert is_backbone(names)
    assert is_backbone(f"module.{name}" for name in names)
    assert not is_backbone(f"img_backbone.{name}" for name in names)
    assert not is_backbone([*names, "transformer.decoder.weight"])
    assert not is_backbone([])
    assert is_backbone(names, ["epoch"])


def test_what_is_no_tensor_is_named_where_one_should_be(tmp_path):
    path = tmp_path / "resnet.pkl"
    path.write_bytes(pickle.dumps(torchvision_state() | {"conv1.weight": "lost", "epoch": 7}))
    with pytest.raises(UserError, match=r"resnet.pkl: conv1.weight holds text, expected floating-point numbers"):
        load_backbone(path, host())


@pytest.mark.slow
def test_a_run_starts_from_the_backbone_alone(file, tmp_path):
    """Every seed keeps its own fresh parameters elsewhere; such a folder cannot be evaluated."""
    model, folder = host(stages=(0, 1)), tmp_path / "imagenet"
    params, _ = load_backbone(file, model)
    write_weights(RunConfig(task=replace(RunConfig().task, model=model)), params, folder, part=PART)
    with pytest.raises(UserError, match=rf"holds the weights of {PART} alone"):
        open_run(folder)
    states = []
    for seed in (0.0, 1.0):
        fresh = jax.tree.map(lambda leaf, seed=seed: np.full_like(leaf, seed), params)
        states.append(SimpleNamespace(params=fresh | {"decoder": {"kernel": np.full((2, 2), seed, np.float32)}}))
    frozen = frozen_modules(host(frozen_stages=2))
    assert frozen == (f"{PART}/conv1", f"{PART}/layer1_0")
    for seed, found in enumerate(starting_params(str(folder), states, (0, 1), partly=True, frozen=frozen)):
        np.testing.assert_array_equal(found["decoder"]["kernel"], seed)
        np.testing.assert_array_equal(at(found, PART)["conv1"]["kernel"], at(params, PART)["conv1"]["kernel"])
        found_bn, bn = (at(tree[STATISTICS], PART)["bn1"]["mean"] for tree in (found, params))
        np.testing.assert_array_equal(found_bn, bn)
    wider = states[0].params | {"encoder": {"images": {"backbone": {"stem": {"kernel": np.zeros(3, np.float32)}}}}}
    with pytest.raises(UserError, match=rf"has no {PART}/stem, which this configuration freezes"):
        starting_params(str(folder), [SimpleNamespace(params=wider)] * 2, (0, 1), partly=True, frozen=(f"{PART}/stem",))


def test_frozen_random_weights_are_refused_before_data_are_read(tmp_path):
    config = load_config("camera/toponet_r50")
    assert frozen_modules(config.task.model) == config.task.frozen == (f"{PART}/conv1", f"{PART}/layer1_0")
    config = replace(config, data=replace(config.data, root=tmp_path))
    with pytest.raises(UserError, match=r"conv1, .*layer1_0 would stay random: .*tflane convert"):
        train_run(config, tmp_path / "run", progress=False)
    assert not (tmp_path / "run").exists()
    assert frozen_modules(host()) == frozen_modules(BASELINE) == ()


def test_the_command_says_how_to_train_from_it(file, tmp_path, capsys, monkeypatch):
    written = []
    monkeypatch.setattr(
        "tflane_jax.commands.convert.load_config", lambda name: RunConfig(replace(task(), model=host()))
    )
    monkeypatch.setattr("tflane_jax.commands.convert.write_weights", lambda *a, **more: written.append(more))
    assert main(["convert", "--config", "x", "--weights", str(file), "--out", str(tmp_path / "out")]) == 0
    said = capsys.readouterr().out
    assert f"it holds {PART} alone; train from it: --training.init-from {tmp_path / 'out'}" in said
    assert written == [{"part": PART}]
    with_edges = ["--edge-weight", "0.9", "--out", str(tmp_path / "other")]
    assert main(["convert", "--config", "x", "--weights", str(file), *with_edges]) == 2
    assert "--edge-weight is of GTN encoders" in capsys.readouterr().err


def task():
    return RunConfig().task
