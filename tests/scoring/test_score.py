"""Bootstrap intervals over scenes."""

from tflane_jax.scoring.score import Scored


class Errors:
    """An accumulator whose error exists only where something was matched."""

    def __init__(self, values=()):
        self.values = list(values)

    def merge(self, *others):
        return Errors(sum((other.values for other in others), self.values))

    def compute(self):
        return {"frames": 3.0} | ({"error": sum(self.values) / len(self.values)} if self.values else {})


def test_a_number_that_a_sample_lacks_has_no_interval():
    """The remaining samples would be those that drew a scene with a match."""
    some, every = Scored({"a": Errors([1.0]), "b": Errors()}), Scored({"a": Errors([1.0]), "b": Errors([3.0])})
    assert some.intervals(50, progress=False) == {"frames": (3.0, 3.0)}
    found = every.intervals(50, progress=False)
    assert found["error"] == (1.0, 3.0)
