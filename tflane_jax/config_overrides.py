"""Settings of a configuration changed by arguments, `--a.b.c value`."""

from __future__ import annotations

import ast
import contextlib
import dataclasses
import difflib
import io
import itertools
import operator
import re
import typing
from collections.abc import Iterable, Sequence
from typing import Any

from tflane_jax.config import RunConfig, with_reference_batch, with_same_examples
from tflane_jax.config_io import choices, settings, with_setting
from tflane_jax.errors import UserError
from tflane_jax.limits import allowed_for, check_settings
from tflane_jax.own_modules import is_own
from tflane_jax.tasks.fit import unread_priors
from tflane_jax.tasks.lane_graph import LaneGraphTask

# Settings by their names in other programs.
_SYNONYMS = {
    "batch": "training.batch_size",
    "epochs": "training.steps",
    "iterations": "training.steps",
    "learning_rate": "optim.lr",
}
# Python's messages about text that is no number, as tyro shows them.
_NO_NUMBER = re.compile(
    r"Error parsing (--\S+): (?:(invalid literal for int\(\) with base 10)|could not convert string to float): ('.*')"
)
# tyro's messages about several values of which one is wrong, and about arguments that no option takes.
_NO_PARSE = re.compile(r"Error parsing (--\S+): Could not find valid parse for arguments: (\[.*\])")
_LEFT_OVER = "Unrecognized options: "
_IN_WORDS = {"sd_map": "an SD map", "markers": "markers"}


def apply_overrides(config: RunConfig, arguments: Sequence[str]) -> RunConfig:
    """Return the configuration with settings changed by `--a.b.c value` arguments, typed by tyro.

    A learning rate that is scaled without `optim.reference_batch` was chosen for the batch of `config`, and so were
    the numbers of updates that `training.same_examples` divides where the arguments do not set them.

    An argument that chooses an optional part, or the class of a part, is applied first, wherever it appears:
    `--a.b None`, `--a.b default` or `--a.b NameOfItsClass`; the part then has its defaults. A class of the user
    that is derived from the present one keeps what is set there and is not the default.

    Raises:
        UserError: an unknown setting (with the names closest to it), a value of the wrong type, or one that breaks a
            limit.
    """
    if not arguments:
        return config
    import tyro

    before, names = config, {_setting(argument) for argument in arguments} - {""}
    config, arguments = _choose_parts(before, arguments)
    kind, default = _with_only(config, _checked_names(config, arguments))
    output = io.StringIO()
    try:
        with contextlib.redirect_stderr(output), contextlib.redirect_stdout(output):
            parsed = tyro.cli(kind, default=default, args=list(arguments), config=(tyro.conf.AvoidSubcommands,))
    except SystemExit as error:
        raise UserError(_without_boxes(output.getvalue(), config)) from error
    changed = with_reference_batch(_merged(config, parsed), before)
    changed = with_same_examples(changed, before, names)
    check_settings(changed, "--")
    return changed


def _with_only(config: Any, names: Iterable[str]) -> tuple[type, Any]:
    """Return a class with some settings of a configuration alone, and its instance with their values.

    tyro makes an argument of every setting of a class: of the whole configuration, several hundred in a third of a
    second.
    """
    inner: dict[str, set[str]] = {}
    for name in names:
        first, _, rest = name.partition(".")
        inner.setdefault(first, set()).add(rest)
    hints, fields = typing.get_type_hints(type(config), include_extras=True), []
    for name in sorted(inner):
        kind, value = hints[name], getattr(config, name)
        if dataclasses.is_dataclass(value):
            kind, value = _with_only(value, inner[name])
        fields.append((name, kind, dataclasses.field(default=value)))
    made = dataclasses.make_dataclass(type(config).__name__, fields, frozen=True)
    return made, made()


def _merged(config: Any, some: Any) -> Any:
    """Return the configuration with the values of what `_with_only` made."""
    changes = {field.name: getattr(some, field.name) for field in dataclasses.fields(some)}
    for name, value in changes.items():
        if dataclasses.is_dataclass(value):
            changes[name] = _merged(getattr(config, name), value)
    return dataclasses.replace(config, **changes)


def batch_notices(config: RunConfig, changed: RunConfig) -> list[str]:
    """Return what to say of overrides that change the batch and leave the number of updates: what is trained then."""
    before, after, steps = config.training.batch_size, changed.training.batch_size, changed.training.steps
    if before == after or steps != config.training.steps or changed.training.same_examples:
        return []
    epochs = ""
    if (epoch := config.optim.epoch_steps) > 0:
        epochs = f", {steps * after / (epoch * before):.4g} epochs in place of {steps / epoch:.4g}"
    return [
        f"training.batch_size is {after} in place of {before}, and training.steps is {steps} as before: the run sees "
        f"{after / before:.4g} times as many examples{epochs}. --training.same-examples keeps their number: it divides "
        "the settings that count updates (docs/scale.md)"
    ]


def unread_notices(config: RunConfig, changed: RunConfig) -> list[str]:
    """Return what to say of overrides that give examples an SD map or markers and the model no prior that reads them.

    Configurations that have them unread are left alone: they are controls on the same examples.
    """
    before = _unread(config)
    return [
        f"examples have {_IN_WORDS[name]} (data.example.{name}), which no prior of this model reads: "
        f"--task.model.priors.{name.replace('_', '-')} default adds one"
        for name in _unread(changed)
        if name not in before
    ]


def _unread(config: RunConfig) -> list[str]:
    if not isinstance(config.task, LaneGraphTask):
        return []
    return unread_priors(config.task.model, config.data.source("train").example)


def _choose_parts(config: RunConfig, arguments: Sequence[str]) -> tuple[RunConfig, list[str]]:
    """Return the configuration with the chosen parts, and the remaining arguments."""
    left = list(arguments)
    while chosen := [i for i, argument in enumerate(left) if choices(config, _setting(argument))]:
        # Outer parts before inner ones.
        at = min(chosen, key=lambda i: _setting(left[i]).count("."))
        name, kinds = _setting(left[at]), choices(config, _setting(left[at]))
        _, equals, value = left.pop(at).partition("=")
        if not equals:
            value = left.pop(at) if at < len(left) else ""
        if value not in kinds:
            own = "; import the module of a class of yours, --import MODULE" if value[:1].isupper() else ""
            raise UserError(
                f"setting --{name} takes {', '.join(kinds)}, not {value!r}; its own settings are --{name}...{own}"
            )
        try:
            config = with_setting(config, name, _chosen(kinds[value], config, name, keep=value != "default"))
        except TypeError:
            raise UserError(f"{value} has no defaults for all of its settings: choose it in a config file") from None
    return config, left


def _chosen(kind: type, config: RunConfig, name: str, *, keep: bool) -> Any:
    """Return a part with its defaults.

    With `keep`, a class of the user that is derived from the present one takes the settings of the present part that
    are not its class's defaults, so that an own loss by argument is compared with the tuned one.
    """
    present = operator.attrgetter(name)(config)
    if not keep or present is None or kind is type(present) or not is_own(kind) or not issubclass(kind, type(present)):
        return kind()
    usual, names = type(present)(), [field.name for field in dataclasses.fields(present) if field.init]
    changed = {name: getattr(present, name) for name in names if getattr(present, name) != getattr(usual, name)}
    return kind(**changed)


def _setting(argument: str) -> str:
    """Return the name of the setting that an argument changes; "" for a value."""
    return argument.partition("=")[0].removeprefix("--").replace("-", "_") if argument.startswith("--") else ""


def _checked_names(config: RunConfig, arguments: Sequence[str]) -> set[str]:
    """Return the settings that arguments change; raise UserError for one that there is not."""
    every = dict(settings(config))
    values = {name: value for name, value in every.items() if not dataclasses.is_dataclass(value)}
    known, found = list(values), set()
    for argument, following in itertools.zip_longest(arguments, arguments[1:], fillvalue="--"):
        if not (name := _setting(argument)):
            continue
        setting = name if name in known else name.replace(".no_", ".")  # of a flag: --a.no-b
        if setting not in known:
            turned = re.sub(r"^no_(.*\.|)", r"\1no_", name).replace("_", "-")  # --no-a.b for --a.no-b
            if not following.startswith("--") and following[:1].isupper() and name in every:
                raise UserError(
                    f"--{name} {following}: there is no such class of settings here; import the module of a class of "
                    "yours, --import MODULE"
                )
            close = [turned] if name.removeprefix("no_") in known else _closest(name, known)
            hint = f"did you mean {' or '.join(f'--{c}' for c in close)}?" if close else "see --help for all settings"
            raise UserError(f"unknown setting --{name}: {hint}")
        if isinstance(values[setting], bool) and ("=" in argument or not following.startswith("--")):
            part, dot, last = setting.replace("_", "-").rpartition(".")
            flag, off = f"--{part}{dot}{last}", f"--{part}{dot}no-{last}"
            raise UserError(f"{flag} is a flag without a value: write it alone, or {off} for False")
        found.add(setting)
    return found


def _closest(name: str, known: list[str]) -> list[str]:
    """Return up to three similar names: of the same last part or meaning, as a whole, else by their last parts."""
    last = name.rpartition(".")[2]
    by_last: dict[str, list[str]] = {}
    for k in known:
        by_last.setdefault(k.rpartition(".")[2], []).append(k)
    same = sorted(by_last.get(last, []), key=lambda k: -difflib.SequenceMatcher(None, name, k).ratio())
    meant = [_SYNONYMS[last]] if _SYNONYMS.get(last) in known else []
    if whole := [*meant, *same, *difflib.get_close_matches(name, known, 3, 0.75)]:
        return list(dict.fromkeys(whole))[:3]
    parts = difflib.get_close_matches(last, sorted(by_last), 3, 0.75)
    return [k for part in parts for k in by_last[part]][:3]


def _without_boxes(text: str, config: RunConfig) -> str:
    """Return tyro's error message as one line: no frame, title or hints, but what a setting of `config` may be."""
    # tyro prints a title, a rule (unless framed), the message, a rule, hints.
    lines = [re.sub(r"[│─╭╮╰╯]|-{3,}", " ", line).strip() for line in text.splitlines()[1:]]
    paragraphs = re.split(r"\n{2,}", "\n".join(lines).strip())
    message = paragraphs[0].replace("\n", " ")
    if message.startswith(_LEFT_OVER):
        first = message.removeprefix(_LEFT_OVER).split()[0].rstrip(",")
        return f"{first} is neither a setting nor the value of one: settings are given as, say, --optim.lr 1e-3"
    if (wrong := _NO_PARSE.search(message)) is not None:
        name, values = wrong[1], ast.literal_eval(wrong[2])
        return f"{name} cannot be {' '.join(values)}: it must be {allowed_for(config, _setting(name))}"
    if (wrong := _NO_NUMBER.search(message)) is None:
        return message
    name, whole, value = wrong.groups()
    return f"{name} is {value}: it must be a {'whole ' if whole else ''}number"
