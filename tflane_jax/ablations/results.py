"""What a comparison measured: scores of every row by test set, checkpoint and seed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from tflane_jax.ablations.comparison import Scores
from tflane_jax.ablations.declaration import model_of_row
from tflane_jax.ablations.jobs import Tests
from tflane_jax.ablations.recorded import Measured, Which
from tflane_jax.ablations.scores import OWN_TEST
from tflane_jax.errors import UserError
from tflane_jax.evaluation.results import SceneRatio, SceneSamples

OWN_SPLIT = "test"
"""Name of the configurations' own test split among the scores of a comparison."""
Ratios = Mapping[str, SceneRatio]
Samples = Mapping[str, SceneSamples]


@dataclass
class Results:
    """Scores of a comparison.

    Attributes:
        models: names, the control first.
        seeds: that were asked for.
        tests: further test sets, see `compare`.
        scores: by (test set, checkpoint), by row of the table, by seed. Rows are models, or "model, intervention".
        ratios: parts of the scores that are ratios of sums over scenes, in the same order.
        samples: other scores in samples of the scenes, in the same order.
        owners: model of each row.
        protocols: of each test set and model.
        failed: why the first run of a model that failed did, by model.
    """

    models: tuple[str, ...]
    seeds: tuple[int, ...]
    tests: Tests
    scores: dict[tuple[str, Which], dict[str, dict[int, Scores]]] = field(default_factory=dict)
    ratios: dict[tuple[str, Which], dict[str, dict[int, Ratios]]] = field(default_factory=dict)
    samples: dict[tuple[str, Which], dict[str, dict[int, Samples]]] = field(default_factory=dict)
    owners: dict[str, str] = field(default_factory=dict)
    protocols: dict[tuple[str, str], str] = field(default_factory=dict)
    failed: dict[str, str] = field(default_factory=dict)

    def add(self, test: str, which: Which, model: str, seed: int, measured: Measured) -> None:
        """Add what was measured of a run; raises UserError if it is not measured as the other runs of its row."""
        first = self.protocols.setdefault((test, model), measured.protocol)
        if measured.protocol != first:
            raise UserError(f"seed {seed} of {model} is measured by {measured.protocol}, earlier ones by {first}")
        for way, scores in measured.ways.items():
            row = f"{model}, {way}" if way else model
            if self.owners.setdefault(row, model) != model:
                raise UserError(
                    f"two rows are called {row!r}, one of {self.owners[row]}: name a configuration otherwise"
                )
            self.scores.setdefault((test, which), {}).setdefault(row, {})[seed] = dict(scores)
            self.ratios.setdefault((test, which), {}).setdefault(row, {})[seed] = measured.ratios[way]
            self.samples.setdefault((test, which), {}).setdefault(row, {})[seed] = measured.samples.get(way, {})

    def protocol(self, test: str = OWN_TEST) -> str:
        """Return name and version of the metrics of a test set, joined by " / " if its models have several."""
        return " / ".join(dict.fromkeys(protocol for (own, _), protocol in self.protocols.items() if own == test))

    def mixed_protocols(self, test: str) -> str:
        """Return a sentence for models that are measured by several protocols; "" if by one."""
        return mixed_protocols({model: protocol for (own, model), protocol in self.protocols.items() if own == test})

    def has(self, model: str) -> bool:
        """Return whether any run of a model was measured."""
        return model in self.owners.values()

    def model_of(self, row: str) -> str:
        """Return the model of a row, measured or not; "" if it is of none."""
        return self.owners.get(row) or model_of_row(row, self.models)

    def rows(self, test: str, which: Which) -> dict[str, dict[int, Scores]]:
        """Return the rows of a table and their scores by seed, in the order of models and seeds."""
        rows = self.scores.get((test, which), {})
        ordered = sorted(rows, key=lambda row: self.models.index(self.owners[row]))
        return {row: {seed: rows[row][seed] for seed in self.seeds if seed in rows[row]} for row in ordered}

    def by_seed(self) -> dict[str, Any]:
        """Return everything as JSON: by test set, checkpoint, row and seed."""
        content: dict[str, Any] = {}
        for (test, which), rows in self.scores.items():
            content.setdefault(test or OWN_SPLIT, {})[which] = rows
        return content

    def title(self, test: str) -> str:
        """Return the name of a test set, with its settings."""
        return f"test set {test} ({' '.join(self.tests[test])})" if test else "test split"


def mixed_protocols(protocols: Mapping[str, str]) -> str:
    """Return a sentence for models, by name, that are measured by several protocols; "" if by one."""
    of: dict[str, list[str]] = {}
    for model, protocol in protocols.items():
        of.setdefault(protocol, []).append(model)
    if len(of) < 2:
        return ""
    listed = "; ".join(f"{', '.join(models)} by {protocol}" for protocol, models in of.items())
    return f"**Different protocols** ({listed}): where these differ, scores of one name are not comparable."
