"""Whether a model and its data fit together."""

from dataclasses import replace

import pytest

from tests.models.cases import CAMERA_TOPONET, ELEMENTS, SEGMENTS, make_bucket_example, make_camera_example
from tflane_jax.errors import UserError
from tflane_jax.tasks.fit import check_fit


@pytest.mark.parametrize(
    ("model", "fits", "other", "wanted"),
    [
        (CAMERA_TOPONET, make_camera_example(), make_bucket_example(), "centerlines"),
        (replace(SEGMENTS, elements=ELEMENTS), make_bucket_example(), make_camera_example(), "segments"),
    ],
)
def test_elements_must_govern_what_the_host_predicts(model, fits, other, wanted):
    """The remedy is a value that the setting takes. There are as many lanes as segments in both examples."""
    check_fit(model, fits)
    with pytest.raises(UserError, match=rf"do not govern {wanted}, .*: set data\.example\.elements_of={wanted} "):
        check_fit(model, other)
    check_fit(replace(model, elements=None), other)
