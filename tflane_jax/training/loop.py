"""The training program, top to bottom: set up, state, compile, steps, evaluation, checkpoints, stop.

It knows no dataset, metric or picture: the caller passes arrays, a function that evaluates and one that draws. The run
folder (`training.run_folder`) holds all that is needed to resume.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from tflane_jax import processes
from tflane_jax.datasets.batches import Prepare, batches, first_example
from tflane_jax.datasets.batches import count as example_count
from tflane_jax.devices import divided, of_one_process, share, training_mesh
from tflane_jax.errors import UserError
from tflane_jax.limits import DIFFERENT, NOT_EMPTY, Count, Rules, Seed, check_settings, splits
from tflane_jax.models.parameters import Params
from tflane_jax.processes import AgreedError, agreed, apart, arrays_from_first, from_first, is_first, stop_signal
from tflane_jax.progress import progress_bar
from tflane_jax.startup import ready, showing, stage
from tflane_jax.training.adaptive import Memory
from tflane_jax.training.checkpoint import Checkpoints
from tflane_jax.training.fine_tuning import origins, starting_params
from tflane_jax.training.interrupt import StopRequest
from tflane_jax.training.manifest import Manifest
from tflane_jax.training.notices import missing_scores, not_finite, only_told, print_notices, term_notices
from tflane_jax.training.records import Record, RecordWriter, Unwritten, Window, by_name, read_records, seed_record
from tflane_jax.training.restarts import adapt
from tflane_jax.training.resumption import Carried, carried, latest
from tflane_jax.training.run_folder import (
    CurrentForm,
    Start,
    agree_on_data,
    begin,
    check_same_data,
    check_unchanged,
    claimed,
)
from tflane_jax.training.schedule import OptimConfig, make_optimizer, scaled_to_batch, schedule_notices
from tflane_jax.training.sharding import placed
from tflane_jax.training.state import init_states, of_all_seeds, per_seed, state_of
from tflane_jax.training.step import UpdateForm, compiled_update, update_all
from tflane_jax.training.task import Trainable

Evaluate = Callable[[Params], dict[str, float]]
"""Averaged parameters of one seed -> numbers by name."""
Draw = Callable[[Path, int, Params, list[Record]], None]
"""(run folder, step, averaged parameters of the first seed, all records) -> pictures in the run folder."""


@dataclass(frozen=True)
class TrainingConfig:
    """The program's settings.

    Attributes:
        steps: updates.
        batch_size: examples of an update (of each seed), on all devices together.
        same_examples: whether an override of `batch_size` divides what counts updates by the ratio of the batches, see
            `config.with_same_examples`; the resolved configuration has the numbers that result.
        accumulate: parts in which a batch passes through the model, one after the other, to save memory; see
            docs/scale.md for what is equal to one pass. `batch_size` must be a multiple of it times the devices.
        shard_state: whether several devices share parameters, their average and moments, each with a part of them, in
            place of holding all; docs/scale.md has what it saves and costs. A run resumes with and without it.
        seeds: roots of all random numbers in training. Several seeds train side by side, each as it would alone; n
            seeds take n times as long.
        log_every: steps between records; a record holds means over the steps since the last one.
        eval_every: steps between evaluations, each with a checkpoint and pictures; the last step always has one.
        checkpoint_every: steps between further checkpoints.
        keep_checkpoints: how many of the latest to keep, beside the best.
        best_metric: score of the evaluation that chooses the best checkpoint; higher is better.
        init_from: folder of a run whose best averaged parameters to start from (fine-tuning), each seed from itself if
            the run has it; `{seed}` in it is replaced by the seed. None starts from random parameters.
        init_partly: whether the model of `init_from` may have other modules; what it lacks starts at random.
    """

    steps: Count = 10_000
    batch_size: Count = 8
    same_examples: bool = False
    accumulate: Count = 1
    shard_state: bool = False
    seeds: Annotated[tuple[Seed, ...], NOT_EMPTY, DIFFERENT] = (0,)
    log_every: Count = 50
    eval_every: Count = 1000
    checkpoint_every: Count = 500
    keep_checkpoints: Count = 2
    best_metric: str = "all/DET_l"
    init_from: str | None = None
    init_partly: bool = False

    def limits(self) -> Rules:
        """Parts of a batch are equal."""
        yield splits("accumulate", self.accumulate, "batch_size", self.batch_size)


@dataclass(frozen=True)
class TrainingResult:
    """How a run ended.

    Attributes:
        step: updates made.
        metrics: of the last evaluation, mean over seeds.
        compile_seconds: tracing and compiling the update step.
        steps_per_second: of this process, evaluations and checkpoints not counted.
        asked_by: number of the signal that asked it to stop, also where that came with the last step; None for none.
        stopped_by: the same, but None if the run is complete.
    """

    step: int
    metrics: dict[str, float]
    compile_seconds: float
    steps_per_second: float
    asked_by: int | None
    stopped_by: int | None


def train(
    task: Trainable,
    arrays: Any,
    folder: Path,
    *,
    config: TrainingConfig,
    optim: OptimConfig,
    resolved: dict[str, Any],
    resolved_text: str = "",
    current_form: CurrentForm | None = None,
    start: Start = "new",
    prepare: Prepare | None = None,
    evaluate: Evaluate | None = None,
    draw: Draw | None = None,
    frozen: Sequence[str] = (),
    content: str = "",
    own_code: str = "",
    progress: bool = True,
) -> TrainingResult:
    """Train a task and leave everything about the run in `folder`.

    Args:
        task: what to train.
        arrays: training examples, see `datasets.batches`. The step determines which of them are used, so that the step
            of a checkpoint is also the position in the data.
        folder: of the run.
        config, optim: settings.
        resolved: the run's whole configuration as plain JSON; it is saved, and a resumed run must have the same one.
        resolved_text: the same as text, for the run folder.
        current_form: brings the saved configuration of a resumed run to the form of `resolved`; None leaves it.
        start: see `run_folder.claimed`.
        prepare: augments every example, see `datasets.batches`.
        evaluate, draw: called at every evaluation.
        frozen: paths of modules that `init_from` must have, see `starting_params`.
        content: hash of the files of the examples, which a resumed run must find unchanged; "" for none.
        own_code: hash of the user's own code in the run, recorded with its start; "" for none.
        progress: show a bar with rate and time left.

    Raises:
        UserError: see `run_folder.claimed` and `Checkpoints`; settings out of range; a loss that is not finite, after
            the last good state was written.
        Interrupted: a signal came before the first step. With several processes it is kept until they agree.
    """
    check_settings(config, "training.")
    progress = progress and is_first()
    mesh = training_mesh(config.batch_size, config.accumulate)
    optim = scaled_to_batch(optim, config.batch_size)
    adaptive_restarts = None if optim.restarts is None or optim.restarts.adaptive is None else optim.restarts
    if adaptive_restarts is not None and evaluate is None:
        raise UserError("optim.restarts.adaptive needs evaluations: pass `evaluate`, or set it to None")
    optimizer = make_optimizer(optim, config.steps)
    with contextlib.ExitStack() as stack, showing(progress), StopRequest() as stop:
        # =============================================================================================================
        # Run folder
        # =============================================================================================================
        def claim() -> None:
            stack.enter_context(claimed(folder, start))
            if start == "resume":
                print_notices(check_unchanged(folder, resolved, current_form))
                read_records(folder / "metrics.jsonl")  # if it is damaged, say so before compiling

        from_first(claim)
        if processes.process_count() == 1:
            stop.at_once()
        checkpoints = Checkpoints(folder / "checkpoints", keep=config.keep_checkpoints, best_metric=config.best_metric)

        # =============================================================================================================
        # State: fresh, of another run, or resumed
        # =============================================================================================================
        with agreed(), stage("making the initial parameters"):
            example = first_example(arrays)
            # Augmentation may change the size of images, and the model takes what it returns.
            example = example if prepare is None else prepare(example, (config.seeds[0], 0, 0))
            states = init_states(task, optimizer, config.seeds, example)
        carry = Carried([] if adaptive_restarts is None else [Memory() for _ in config.seeds])
        started_from: dict[str, Any] = {"own_modules": own_code}
        data = {"examples": example_count(arrays), "content": content}
        agree_on_data(data)
        if start == "resume" and (saved := from_first(lambda: latest(checkpoints))) is not None:
            whole = of_all_seeds(states)
            with stage(f"restoring step {saved['step']}"):
                restored = arrays_from_first(lambda: checkpoints.restore(saved["step"], whole), whole)
            states, carry = per_seed(restored, config.seeds), carried(checkpoints, saved, carry.memories)
            check_same_data(folder, data | saved["progress"], data)
        elif (origin := config.init_from) is not None:
            fresh = states
            with stage(f"reading {origin}"):
                given = arrays_from_first(
                    lambda: starting_params(origin, fresh, config.seeds, partly=config.init_partly, frozen=frozen),
                    [state.params for state in fresh],
                )
            states = [state_of(params, optimizer, s.key) for params, s in zip(given, states, strict=True)]
            started_from["init_from"] = from_first(lambda: origins(origin, config.seeds, hash_parameters=True))
        place = partial(placed, mesh=mesh, shard=config.shard_state)
        states = [place(state) for state in states]
        first = step = int(states[0].step)

        drawn = from_first(lambda: draw is not None)  # the first process draws, from what all gather
        from_first(lambda: print_notices(begin(folder, start, resolved, resolved_text, **started_from)))
        if is_first():
            print_notices(schedule_notices(optim, config.steps))

        # =============================================================================================================
        # Compile
        # =============================================================================================================
        began = time.perf_counter()
        order, divide = range(first, config.steps), partial(divided, mesh=mesh)
        feed = batches(arrays, config.seeds, order, config.batch_size, prepare, share=share(mesh), place=divide)
        stack.enter_context(contextlib.closing(feed))
        with agreed(), stage("reading the first batch"):
            batch = next(feed, None)
        update: Any = None
        if batch is not None:  # a run that is complete has no next batch
            form = UpdateForm(
                donate=len(states) == 1, mesh=mesh, accumulate=config.accumulate, shard_state=config.shard_state
            )
            update = compiled_update(task, optim, config.steps, states[0], batch[0], form)
        compile_seconds = time.perf_counter() - began
        ready()
        stop.after_the_step()

        # =============================================================================================================
        # Steps
        # =============================================================================================================
        def save(evaluated: dict[str, float]) -> None:
            manifest = Manifest(step=step, config=resolved, metrics=evaluated, progress=carry.to_json() | data)
            kept = of_all_seeds([of_one_process(state) for state in states])
            from_first(lambda: str(checkpoints.save(kept, manifest)))

        unread: Exception | None = None
        saved_step, stopped = first, stop_signal(stop.signal, 0)
        due, carry.due = carry.due, False
        untold = dict(getattr(task, "notices", {}))
        with (
            RecordWriter(folder, first, due) if is_first() else Unwritten() as writer,
            progress_bar(total=config.steps, initial=first, desc=folder.name, unit="step", disable=not progress) as bar,
        ):

            def evaluate_and_save(evaluate: Evaluate) -> None:
                """Evaluate, let the schedule adapt, write the checkpoint, and draw."""
                nonlocal states
                try:
                    measured = [evaluate(state.ema_params) for state in states]  # several processes predict together
                except Exception:
                    if processes.process_count() == 1:  # several would wait for one another
                        carry.due = True  # a resumed run begins with this evaluation
                        save({})
                    raise
                evaluations = from_first(lambda: measured)
                writer.write(seed_record(step, "val", scores := by_name(evaluations)))
                if not carry.metrics and is_first():
                    print_notices(missing_scores(step, scores, config.best_metric, adaptive_restarts))
                carry.metrics = {name: float(np.mean(values)) for name, values in scores.items()}
                if adaptive_restarts is not None:
                    together = of_all_seeds([state.opt_state for state in states])
                    adapted = adapt(adaptive_restarts, together, carry.memories, evaluations, config.steps)
                    together, carry.memories, cycles = adapted
                    changed = per_seed(together, config.seeds)
                    states = [replace(s, opt_state=place(o)) for s, o in zip(states, changed, strict=True)]
                    writer.write(seed_record(step, "cycle", cycles))
                save(carry.metrics)
                if drawn:
                    shown = states[0].ema_params  # several processes gather them together
                    if draw is not None and is_first():
                        with apart(), only_told(f"no pictures of step {step}"):
                            draw(folder, step, shown, writer.records)

            if due and evaluate is not None:
                evaluate_and_save(evaluate)
            while batch is not None and stopped is None:
                began = time.perf_counter()
                states, values = update_all(update, states, batch)
                if not values["finite"].all():
                    save({})
                    searched = batch if processes.process_count() == 1 else ()
                    raise AgreedError(not_finite(values, step, config.seeds, checkpoints.path(step), searched))
                step += 1
                carry.window.add({name: value for name, value in values.items() if name != "finite"})
                asked = time.perf_counter()
                batch, unread = _next_batches(feed)  # an error is raised when this step is recorded and saved
                ended = time.perf_counter()
                carry.times.add(ended - began, waited=ended - asked)
                bar.update()

                is_last = step == config.steps
                if step % config.log_every == 0 or is_last:
                    record = carry.window.record(step)
                    writer.write(record | carry.times.record())
                    print_notices(carry.times.notices(step, arrays))  # every process waits for examples of its own
                    if is_first():
                        print_notices(term_notices(untold, record))
                    bar.set_postfix_str(f"loss={np.mean(record['loss']):.4g}{carry.times.shown()}", refresh=False)
                    carry.window = Window()
                if evaluate is not None and (step % config.eval_every == 0 or is_last):
                    evaluate_and_save(evaluate)
                    saved_step = step
                elif step % config.checkpoint_every == 0 or is_last:
                    save({})
                    saved_step = step
                stopped = stop_signal(stop.signal, step)

            # =========================================================================================================
            # Stop
            # =========================================================================================================
            if step > saved_step:
                save({})
            if unread is not None:
                print_notices([f"step {step} is saved: go on with --resume when the next examples can be read"])
                raise unread
        rate = (step - first) / carry.times.own if carry.times.own else 0.0
        unfinished = stopped if step < config.steps else None
        return TrainingResult(step, carry.metrics, compile_seconds, rate, asked_by=stopped, stopped_by=unfinished)


def _next_batches(feed: Iterator[Any]) -> tuple[Any, Exception | None]:
    """Return the batches of the next step, None after the last one; or None and the error of reading them.

    Several processes raise the error at once: the others would wait for this one.
    """
    try:
        return next(feed, None), None
    except Exception as error:
        if processes.process_count() > 1:
            raise
        return None, error
