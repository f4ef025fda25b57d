"""What a training tells its user."""

from tflane_jax.training.adaptive import AdaptiveConfig
from tflane_jax.training.notices import missing_scores
from tflane_jax.training.restarts import RestartsConfig


def test_scores_that_an_evaluation_lacks_are_named_with_their_setting():
    rule = RestartsConfig(adaptive=AdaptiveConfig(metric="hidden+traffic/AP_l", mode="max"))
    assert missing_scores(9, {"all/DET_l", "hidden+traffic/AP_l"}, "all/DET_l", rule) == []
    assert missing_scores(9, {"all/DET_l"}, "all/DET_l", RestartsConfig()) == missing_scores(
        9, {"all/DET_l"}, "all/DET_l", None
    )
    first, second = missing_scores(9, set(), "all/DET_l", rule)
    assert first.startswith("step 9: the evaluation has no all/DET_l (training.best_metric), so no checkpoint is the")
    assert "no hidden+traffic/AP_l (optim.restarts.adaptive.metric), so the rule takes it for no improvement" in second
