"""`tflane predict` on real layouts: pictures, and overlays where images exist."""

import numpy as np
import pytest

from tests.datasets.nuscenes_small import write_nuscenes
from tests.datasets.small_argoverse2 import write_images as write_ring_images
from tests.datasets.small_argoverse2 import write_log
from tests.datasets.test_nuscenes import write_images
from tests.tiny_run import CONFIG, FEW_PICTURES, use_fakes
from tflane_jax import plots
from tflane_jax.cli import main
from tflane_jax.commands import predict_lanes
from tflane_jax.datasets import sources
from tflane_jax.datasets.argoverse2_cameras import RING

pytest.importorskip("shapely")
pytest.importorskip("pyarrow")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Return a run of a model of BEV evidence that predicts the same lanes for every example."""
    folder = tmp_path_factory.mktemp("run")
    (folder / "tiny.py").write_text(CONFIG)
    opened = sources.open_dataset
    with pytest.MonkeyPatch.context() as patch:
        use_fakes(patch)
        arguments = ["train", "--config", f"{folder / 'tiny.py'}:baseline", "--training.steps", "2", *FEW_PICTURES]
        assert main([*arguments, "--out", str(folder / "run")]) == 0
        patch.setattr("tflane_jax.datasets.sources.open_dataset", opened)
        yield str(folder / "run")


@pytest.fixture
def drawn(monkeypatch):
    """Return what was drawn into camera images: (examples, lanes)."""
    calls = []

    def record(path, examples, lanes, elements, **options):
        calls.append((examples, lanes))
        return plots.save_camera_views(path, examples, lanes, elements, **options)

    monkeypatch.setattr(predict_lanes, "save_camera_views", record)
    return calls


def predict(run, out, data, root, *more):
    assert main(["predict", run, "--data", data, "--root", str(root), "--out", str(out), *more]) == 0
    return {path.name for path in out.iterdir()}


def test_nuscenes_is_drawn_from_above_and_in_the_images_that_are_there(run, drawn, tmp_path):
    """The model reads no images; of two key frames, the first has lost its own."""
    root = write_nuscenes(tmp_path / "nuscenes")
    write_images(root)
    (root / "samples" / "CAM_FRONT" / "a0.jpg").unlink()
    files = {"predictions.npz", "predictions.json", "truth.npz", "pictures.png"}
    arguments = "nuscenes", root, "--split", "train", "--count", "2"
    assert predict(run, tmp_path / "out", *arguments) == files | {"cameras.png"}
    ((examples, lanes),) = drawn
    assert examples.cameras.valid.tolist() == [[True] + [False] * 5]
    assert examples.has_previous.tolist() == [True]  # the last key frame
    assert len(lanes.points) == 1
    assert len(np.load(tmp_path / "out" / "predictions.npz")["points"]) == 2


@pytest.mark.slow
def test_argoverse_2_is_drawn_in_the_images_of_the_logs_that_have_some(run, drawn, tmp_path):
    """The model reads no images; one of two logs has some, at its first key frame."""
    ring = "ring_front_center", "ring_side_left"
    write_ring_images(write_log(tmp_path / "logs" / "log-a"), [(ring[0], 990), (ring[1], 1010)], (16.5, 2.0, 1.0))
    write_log(tmp_path / "logs" / "log-b")
    assert "cameras.png" in predict(run, tmp_path / "out", "argoverse2", tmp_path / "logs", "--count", "4")
    ((examples, lanes),) = drawn
    assert examples.cameras.valid.tolist() == [[name in ring for name in RING]]
    assert len(lanes.points) == 1
    assert len(np.load(tmp_path / "out" / "predictions.npz")["points"]) == 4


def test_a_log_of_argoverse_2_without_images_is_drawn_from_above_only(run, drawn, tmp_path):
    write_log(tmp_path / "logs" / "log-a")
    files = predict(run, tmp_path / "out", "argoverse2", tmp_path / "logs", "--count", "2")
    assert files == {"predictions.npz", "predictions.json", "truth.npz", "pictures.png"}
    assert not drawn
    assert np.load(tmp_path / "out" / "truth.npz")["valid"].any()
