"""The PyTorch baseline is the reference's network: its weights, outputs, gradients and losses."""

import subprocess
import sys

import numpy as np
import pytest

from benchmarks import lstr, torch_fitting, torch_lstr
from tests.golden import case_id, golden_modules, load_module_case
from tests.golden_compare import assert_gradients_close, assert_outputs_close
from tests.shared import shared_path
from tflane_jax.errors import UserError
from tflane_jax.layers.resnet import ResNetConfig
from tflane_jax.layers.transformer import TransformerConfig
from tflane_jax.models.graph_encoders import GcnEncoderConfig
from tflane_jax.models.lstr import LstrConfig, TransformerEncoderConfig


def torch_or_skip():
    return pytest.importorskip("torch", reason="needs PyTorch, which the project does without")


@pytest.fixture(autouse=True)
def one_thread(monkeypatch):
    """Keep PyTorch's threads from spinning against those of other tests."""
    monkeypatch.setattr(torch_fitting, "cores", lambda: 1)


def of_kind(kind):
    return [path for path in golden_modules("lstr_*") if path.stem.startswith(f"lstr_{kind}")]


def tiny(config):
    layer = TransformerConfig(config["heads"], config["ff"], dropout=0.0)
    dims = tuple(config["dims"])
    backbone = ResNetConfig(tuple(config["layers"]), dims, stem_channels=dims[0], frozen_stem_norm=True)
    encoder = TransformerEncoderConfig(config["enc"], layer)
    return LstrConfig(backbone, config["attn"], encoder, config["dec"], layer, config["q"])


@pytest.fixture
def plain_convolutions(monkeypatch):
    """Leave out oneDNN: in this tiny network it gave wrong gradients and damaged the heap (PyTorch 2.13)."""
    monkeypatch.setattr(torch_or_skip().backends.mkldnn, "enabled", False)


@pytest.mark.golden
@pytest.mark.parametrize("path", of_kind("tiny"), ids=case_id)
def test_network_is_the_reference(path, plain_convolutions):
    torch, case = torch_or_skip(), load_module_case(path)
    network = torch_lstr.load(torch_lstr.build(tiny(case.meta["config"])), case.params)
    network.train(case.meta["mode"] == "train")
    images = torch.from_numpy(case.inputs["images"]).requires_grad_()
    logits, curves, attention = network(images, torch.from_numpy(case.inputs["masks"]))
    outs = {"pred_logits": logits[1], "pred_curves": curves[1], "enc_attn": attention}
    outs |= {"aux0.pred_logits": logits[0], "aux0.pred_curves": curves[0]}
    scalar = sum((torch.from_numpy(case.weights[name]) * out).sum() for name, out in outs.items())
    scalar.backward()
    outs = {name: out.detach().numpy() for name, out in (outs | {"grad_scalar": scalar}).items()}
    outs |= {f"bn_after/{name}": value.numpy() for name, value in network.state_dict().items()}
    assert_outputs_close(outs, case.outputs)
    gradients = {f"p/{name}": p.grad.numpy() for name, p in network.named_parameters() if p.grad is not None}
    assert_gradients_close(gradients | {"in/images": images.grad.numpy()}, case.gradients)


@pytest.mark.golden
def test_published_weights_load_by_name_and_give_the_reference_outputs():
    torch_or_skip()
    with np.load(shared_path("data/lstr/LSTR_500000.npz")) as file:
        weights = {name: file[name] for name in file.files}
    network = torch_lstr.build()
    assert set(network.state_dict()) == set(weights)
    assert sum(parameter.numel() for parameter in network.parameters()) == 765_754
    with np.load(shared_path("data/lstr/reference_outputs_train.npz")) as reference:
        logits, curves = torch_lstr.inference(weights)(reference["input_first_image"][None])
        np.testing.assert_allclose(logits, reference["pred_logits"][:1], rtol=2e-5, atol=2e-5)
        np.testing.assert_allclose(curves, reference["pred_curves"][:1], rtol=2e-5, atol=2e-5)


@pytest.mark.golden
@pytest.mark.parametrize("path", of_kind("pretrained_random"), ids=case_id)
def test_padded_images(path):
    torch, case = torch_or_skip(), load_module_case(path)
    weights = load_module_case(shared_path("golden/modules/lstr_pretrained_weights.npz")).params
    network = torch_lstr.load(torch_lstr.build(), weights).eval()
    images = torch.from_numpy(case.inputs["images_x4_i8"].astype(np.float32) / 4)
    masks = torch.from_numpy(case.inputs["masks_u8"].astype(np.float32))
    assert masks.any()
    with torch.no_grad():
        logits, curves, attention = network(images, masks)
    outs = {"pred_logits": logits[1], "pred_curves": curves[1], "enc_attn_last": attention[:, ::8]}
    outs |= {"aux0.pred_logits": logits[0], "aux0.pred_curves": curves[0]}
    assert_outputs_close({name: out.numpy() for name, out in outs.items()}, {k: case.outputs[k] for k in outs})


@pytest.mark.golden
@pytest.mark.parametrize("path", of_kind("matcher"), ids=case_id)
def test_costs_assignments_and_losses_are_the_reference(path):
    torch, case = torch_or_skip(), load_module_case(path)
    counts = case.meta["counts"]
    targets = [torch.from_numpy(case.inputs[f"targets.{b}"]) for b in range(len(counts))]
    layers = ("aux0", "main")
    logits, curves = (
        torch.stack([torch.from_numpy(case.inputs[f"{layer}.pred_{part}"]) for layer in layers])
        for part in ("logits", "curves")
    )
    for i, layer in enumerate(layers):
        cost = torch_fitting.matching_cost(logits[i], curves[i], targets)
        pairs = torch_fitting.assignment(cost, targets)
        for b, part in enumerate(cost.split(counts, -1)):
            np.testing.assert_allclose(part[b], case.outputs[f"{layer}.cost.{b}"], rtol=1e-4, atol=1e-4)
            for ours, name in zip(pairs[b], ("src", "tgt"), strict=True):
                np.testing.assert_array_equal(ours, case.outputs[f"{layer}.match_{name}.{b}"])
    total, terms = torch_fitting.fitting_loss(logits, curves, targets)
    named = {f"loss_{name}_0": value for name, value in terms[0].items()}
    named |= {f"loss_{name}": value for name, value in terms[1].items()} | {"total": total}
    assert_outputs_close(named, {name: case.outputs[name] for name in named})


def batch(lanes):
    rng = np.random.default_rng(0)
    rows = np.linspace(0.3, 0.9, 56)

    def target(n):
        extent = np.tile([1, rows[0], rows[-1]], (n, 1))
        points = rng.random((n, 1)) + 0.3 * rows + np.zeros((n, 56))
        return np.concatenate([extent, points, np.tile(rows, (n, 1))], 1).astype(np.float32)

    images = rng.standard_normal((len(lanes), 3, 64, 96), dtype=np.float32)
    return torch_lstr.Batch(images, np.zeros((len(lanes), 1, 64, 96), np.float32), [target(n) for n in lanes])


def test_training_steps_are_seeded_and_reduce_the_loss():
    torch_or_skip()
    losses = [[step() for _ in range(4)] for step in (torch_lstr.training_step(batch([3, 0])) for _ in range(2))]
    assert losses[0] == losses[1]
    assert min(losses[0]) < losses[0][0]
    assert np.isfinite(torch_lstr.training_step(batch([0, 0]))())


def test_layout_of_images_changes_nothing():
    """Weights have their channels last in memory; images may have them last or first."""
    torch = torch_or_skip()
    weights = {name: value.numpy() for name, value in torch_lstr.build().state_dict().items()}
    network = torch_lstr.inference(weights)
    first = np.random.default_rng(0).standard_normal((2, 3, 64, 96), dtype=np.float32)
    last = np.ascontiguousarray(first.transpose(0, 2, 3, 1)).transpose(0, 3, 1, 2)
    assert torch.from_numpy(last).is_contiguous(memory_format=torch.channels_last)
    for a, b in zip(network(first), network(last), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5)


def test_both_sides_of_the_benchmark_must_agree():
    outputs = np.ones((1, 7, 2)), np.linspace(-1.0, 1.0, 56).reshape(1, 7, 8)
    lstr.check_equal(outputs, outputs)
    with pytest.raises(AssertionError):
        lstr.check_equal((outputs[0], outputs[1] + 1e-3), outputs)


def test_other_encoders_are_refused():
    torch_or_skip()
    with pytest.raises(UserError, match="LSTR's own encoder only"):
        torch_lstr.build(LstrConfig(encoder=GcnEncoderConfig()))


def test_the_module_needs_no_torch():
    """Where there is none, the module is imported all the same, and building names what is missing."""
    code = (
        "import sys; sys.modules['torch'] = None; from benchmarks import torch_lstr\n"
        "try: torch_lstr.build()\nexcept torch_lstr.UserError as error: print(error)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=120)
    assert "the baseline needs PyTorch: pip install torch" in done.stdout
