"""What a table of a paper is: rows, claims, the measure that decides, and the paper's own numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from tflane_jax.ablations.declaration import Claim, Declaration, Reported
from tflane_jax.config import RunConfig, load_config, loaded_once, with_step_counts
from tflane_jax.config_io import with_setting
from tflane_jax.config_overrides import apply_overrides


@dataclass(frozen=True)
class TableRow:
    """A model of a table.

    Attributes:
        name: in the table.
        config: reference of its configuration, "system/name:ablation".
        settings: further settings, as on the command line.
        start: name of the table's host whose run of the same seed this row starts from; "" for a fresh start.
    """

    name: str
    config: str
    settings: tuple[str, ...] = ()
    start: str = ""


@dataclass(frozen=True)
class Quoted:
    """Numbers that a paper prints.

    Attributes:
        source: dataset, split and version of the metric.
        rows: cells by column, in the order of the paper.
    """

    source: str
    rows: tuple[Mapping[str, Any], ...]


@dataclass(frozen=True)
class RateSearch:
    """A search for learning rates that precedes a table, see `ablations.rate_search`.

    Attributes:
        rows: names of the rows that are searched.
        rates: that are tried for each of them.
        score: on validation data, at the last step; the highest mean over seeds wins.
        seeds: of the trainings of each rate, none of the table's.
    """

    rows: tuple[str, ...]
    rates: tuple[float, ...]
    score: str
    seeds: tuple[int, ...] = (1000,)


@dataclass(frozen=True)
class Conversion:
    """Published weights that rows start from, as a run; `tflane tables` makes it, as `tflane convert` does.

    Attributes:
        config: reference of the run's configuration.
        weights: their name, such as "lstr".
        out: folder of the run.
        edge_weight: of GTN encoders, see `convert.lstr_graphs`; None for others.
    """

    config: str
    weights: str
    out: str
    edge_weight: float | None = None


@dataclass(frozen=True)
class PaperTable:
    """A table of a paper.

    Attributes:
        name: "system.number".
        title: what the paper's table shows.
        rows: models; the first one is the control of the paired tests.
        claims: what is tested, fixed before the runs.
        primary: the score that decides.
        columns: scores of the table.
        quoted: the paper's own numbers.
        secondary: score that is tested as well, corrected apart from the primary one; None for none.
        negative_control: score on which no treatment should change anything; None for none.
        alpha: significance level of the corrected tests.
        seeds: number of seeds.
        steps: updates of every run; None for those of the configurations.
        hosts: models that rows start from. They are trained first and are no rows.
        conversions: of published weights that rows start from.
        minutes: of a run's updates on one core, for estimates; the mean over rows in docs/results where it is recorded.
        host_minutes: the same for one of `hosts`.
        note: a sentence of the table's text, such as why a column of the paper is missing.
        steps_factor: how many times as long every run is, see `lengthened`.
        search: by which the learning rates of the rows are to be chosen; None where they were not searched for.
    """

    name: str
    title: str
    rows: tuple[TableRow, ...]
    claims: tuple[Claim, ...]
    primary: str
    columns: tuple[str, ...]
    quoted: Quoted
    secondary: str | None = None
    negative_control: str | None = None
    alpha: float = 0.05
    seeds: int = 8
    steps: int | None = None
    hosts: tuple[TableRow, ...] = ()
    conversions: tuple[Conversion, ...] = ()
    minutes: float = 6.0
    host_minutes: float = 6.0
    note: str = ""
    steps_factor: int = 1
    search: RateSearch | None = None

    def lengthened(self, factor: int) -> PaperTable:
        """Return the table with `factor` times the steps, under another name and with a title that says so."""
        if factor == 1:
            return self
        return replace(
            self,
            name=f"{self.name}.steps_x{factor}",
            title=f"{self.title}, {factor} times the steps",
            minutes=self.minutes * factor,
            host_minutes=self.host_minutes * factor,
            steps_factor=factor,
        )

    @property
    def declaration(self) -> Declaration:
        """What is tested."""
        return Declaration(self.primary, self.claims, self.negative_control, self.alpha, self.secondary)

    def configs(self, rows: Sequence[TableRow], *, quick: bool = False) -> dict[str, RunConfig]:
        """Return the configuration of each of `rows` or `hosts` by name.

        Args:
            rows: of this table.
            quick: with few updates on few data.
        """
        found = {}
        with loaded_once():
            for row in rows:
                config = load_config(row.config)
                if self.steps is not None:
                    config = replace(config, training=replace(config.training, steps=self.steps))
                if row.settings:
                    config = apply_overrides(config, row.settings)
                config = longer(config, self.steps_factor)
                found[row.name] = shortened(config) if quick else config
        return found


def claim(treatment: str, control: str, text: str, *reported: Reported) -> Claim:
    """Return a claim whose words quote what the paper reports, in the place of "{}"."""
    return Claim(treatment, control, text.format(", ".join(map(str, reported))), reported)


def longer(config: RunConfig, factor: int) -> RunConfig:
    """Return a configuration with `factor` times the steps.

    Its learning rate falls as much more slowly; the warm-up and the number of evaluations stay.
    """
    kept = "training.checkpoint_every"
    return with_step_counts(config, lambda name, number: number if name == kept else factor * number)


def shortened(config: RunConfig) -> RunConfig:
    """Return a smoke test of the configuration: few updates on few data, and one decoder layer, to compile sooner."""
    steps = 8
    often = {"eval_every": steps, "checkpoint_every": steps, "log_every": steps // 2}
    training = replace(config.training, steps=steps, **often)
    optim = replace(config.optim, warmup_steps=min(config.optim.warmup_steps, steps // 4))
    data: Any = config.data  # every source of the tables counts its scenes or images by split
    model: Any = getattr(config.task, "model", None)
    if hasattr(getattr(model, "decoder", None), "layers"):
        config = with_setting(config, "task.model.decoder.layers", 1)
    return replace(config, data=replace(data, train=24, val=4, test=6), optim=optim, training=training)
