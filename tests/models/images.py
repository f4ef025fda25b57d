"""Small networks of the LSTR family and images that they can read."""

import jax
import numpy as np

from tflane_jax.layers.resnet import ResNetConfig
from tflane_jax.layers.transformer import TransformerConfig
from tflane_jax.models.lstr import LstrConfig, TransformerEncoderConfig
from tflane_jax.scene import LaneLines, RoadImage
from tflane_jax.tasks.lane_shape import LaneShapeTask

HEIGHT, WIDTH = 40, 64
ROWS = np.linspace(160, 710, 12) / 720
TINY_LAYER = TransformerConfig(heads=2, hidden=16, dropout=0.1)
TINY_BACKBONE = ResNetConfig((1, 1), (4, 8), (1, 2), stem_channels=4)


def tiny_model(encoder=None, **changes):
    encoder = TransformerEncoderConfig(1, TINY_LAYER) if encoder is None else encoder
    return LstrConfig(TINY_BACKBONE, 8, encoder, 2, TINY_LAYER, **({"queries": 5} | changes))


def tiny_task(encoder=None):
    return LaneShapeTask(tiny_model(encoder))


def road_image(seed, lines=3, capacity=4):
    """Return an image of noise with straight lines, some points of which are missing."""
    rng = np.random.default_rng(seed)
    columns = 0.5 + rng.normal(0, 0.3, (capacity, 1)) * (ROWS - 0.2)
    points = np.stack([columns, np.broadcast_to(ROWS, columns.shape)], -1).astype(np.float32)
    point_valid = np.arange(len(ROWS)) >= rng.integers(0, 5, (capacity, 1))
    image = rng.integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
    return RoadImage(image, np.ones((HEIGHT, WIDTH), bool), LaneLines(points, point_valid, np.arange(capacity) < lines))


def road_images(count, **options):
    return jax.tree.map(lambda *leaves: np.stack(leaves), *(road_image(seed, **options) for seed in range(count)))
