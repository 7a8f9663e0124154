"""What an option may be, by its name: told before any work, where a wrong one would end hours later or mean another."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from omegaconf import DictConfig, OmegaConf

from dpa.models.precision import PRECISIONS
from dpa.training.optim import OPTIMIZERS, SCHEDULES


class Limit(NamedTuple):
    """Values that an option may have.

    Attributes:
        kind: ``int`` (a whole number), ``float`` (any finite number), ``bool``, ``str``, ``list``, or ``dict`` (a
            section).
        least: smallest value.
        most: largest value.
        above: the smallest value itself is not among them.
        empty: null is.
        many: it is a list, and these hold for each of its members.
        among: names that it is one of; none given leaves them to whoever reads it.
    """

    kind: type
    least: float = -math.inf
    most: float = math.inf
    above: bool = False
    empty: bool = False
    many: bool = False
    among: tuple[str, ...] = ()


COUNT, NUMBER = Limit(int, least=1), Limit(int, least=0)
POSITIVE, SHARE, FLAG = Limit(float, least=0, above=True), Limit(float, least=0, most=1), Limit(bool)
COUNTS = (
    *("threads", "count", "parts", "shard_size", "chunk_scenes", "num_rollouts", "drift_rollouts", "kept", "each"),
    *("steps", "batch_size", "batch_scenes", "scenes_per_step", "pairs_per_scene", "max_rows", "stride", "width"),
    *("checkpoint_interval", "tune_interval", "watch_interval", "look_interval", "watch_scenes", "watch_pairs"),
    *("max_controlled", "patience", "pretraining.max_agents", "window"),
    *("passes",),
)
LIMITS: dict[str, Limit] = {
    **dict.fromkeys(COUNTS, COUNT),
    **dict.fromkeys(("workers", "warmup", "staleness", "part", "top_k", "min_agents", "pictures.scenes"), NUMBER),
    **dict.fromkeys(
        ("aligned_scenes", "horizon", "scenes.limit", "select.max_agents", "submission_shards"),
        COUNT._replace(empty=True),
    ),
    **dict.fromkeys(("seed", "split_seed"), Limit(int)),
    **dict.fromkeys(("memory", "max_norm", "lr", "rms", "length", "temperature", "top_p"), POSITIVE),
    **dict.fromkeys(("noise", "dropout", "mirror", "label_smoothing"), SHARE),
    "pretraining.recovery": SHARE._replace(above=True),
    **dict.fromkeys(("weight_decay", "keep_gib"), Limit(float, least=0)),
    **dict.fromkeys(("loss.alpha", "loss.cloning", "loss.conservative", "margin"), Limit(float)),
    **dict.fromkeys(("loss.kl", "loss.entropy"), Limit(float, least=0)),
    "loss.clip": POSITIVE._replace(empty=True),
    "vocabulary.size": COUNT,
    "vocabulary.steps": COUNT._replace(most=10),
    "vocabulary.radius": POSITIVE._replace(empty=True),
    **dict.fromkeys(("held_out", "solver.window"), Limit(float)),
    **dict.fromkeys(("compile", "arrivals", "tokenized", "loss.reference"), FLAG),
    **dict.fromkeys(("output", "policy", "preferences"), Limit(str)),
    **dict.fromkeys(("show", "years"), Limit(list)),
    **dict.fromkeys(("rankings", "rewards", "context", "tokenizer", "setup", "labels", "published"), Limit(dict)),
    "grid": Limit(float, many=True),
    **dict.fromkeys(("start", "trained", "decoding.chosen", "expert", "watch"), Limit(str, empty=True)),
    "optimizer": Limit(str, among=OPTIMIZERS),
    "schedule": Limit(str, among=SCHEDULES),
    "precision": Limit(str, among=PRECISIONS),
    "has_lights": FLAG._replace(empty=True),
    "rankings_per_scene": Limit(float, empty=True),
    **dict.fromkeys(("collection.workers", "alignment.workers"), Limit(dict)),
    "seeds": Limit(int, least=0, most=2**32 - 1, many=True),
    "snapshots": COUNT._replace(many=True),
}
"""Limit of an option by its last name, or by its last two where one name has several meanings."""
OWN = ("model.context", "model.tokenizer")
"""Sections whose options are those of a class, of the user's own perhaps: :mod:`recipes.common.kinds` judges them."""
CLOSED = (
    *("", "pretraining", "collection", "alignment", "evaluation", "decoding", "pictures", "experiment", "logger"),
    *("training", "method", "model", "scenes", "vocabulary"),
)
"""Sections whose options all stand in their YAML; ``""`` is the recipe itself."""
GROUPS = Path(__file__).parents[1] / "config"
WORDS = {
    int: "a whole number",
    float: "a number",
    bool: "true or false",
    str: "text",
    list: "a list",
    dict: "a section",
}
LISTS = {int: "a list of whole numbers", float: "a list of numbers"}


def check_limits(cfg: DictConfig) -> None:
    """Refuse values that an option cannot have; options that are not listed are left to whoever reads them.

    Args:
        cfg: of any recipe.

    Raises:
        ValueError: naming the option and its value.

    Examples:
        >>> check_limits(OmegaConf.create({"alignment": {"max_norm": -1.0}}))
        Traceback (most recent call last):
        ...
        ValueError: alignment.max_norm must be above 0, got -1.0.
        >>> check_limits(OmegaConf.create({"evaluation": {"memory": "2GB"}}))
        Traceback (most recent call last):
        ...
        ValueError: evaluation.memory must be a number, got '2GB'.
        >>> check_limits(OmegaConf.create({"alignment": {"snapshots": [40, 0]}}))
        Traceback (most recent call last):
        ...
        ValueError: alignment.snapshots must be 1 or more, got 0.
    """
    for name, value in _leaves(OmegaConf.to_container(cfg, resolve=False)):
        parts = name.split(".")
        limit = LIMITS.get(".".join(parts[-2:])) or LIMITS.get(parts[-1])
        if limit is None:
            continue
        if limit.many and not isinstance(value, list):
            raise ValueError(f"{name} must be {LISTS[limit.kind]}, got {value!r}.")
        for each in _members(value) if limit.many else [value]:
            reference = isinstance(each, str) and each.startswith(("${", "???"))
            if not reference and (wanted := _misfit(each, limit)) is not None:
                raise ValueError(f"{name} must be {wanted}, got {each!r}.")


def check_added(overrides: Iterable[str], cfg: DictConfig) -> None:
    """Refuse options that a command adds (``+alignment.step=9``) to a section where nobody would read them.

    Sections that hold what a user names (methods, rankings, setups), or whose reader knows what it takes, are left out.

    Args:
        overrides: of the command line.
        cfg: that they have made.

    Raises:
        ValueError: naming the section and what it has.

    Examples:
        >>> check_added(["+alignment.step=9"], OmegaConf.create({"alignment": {"steps": 150, "lr": 3e-5, "step": 9}}))
        Traceback (most recent call last):
        ...
        ValueError: alignment has no option 'step'; it takes steps, lr.
        >>> check_added(["+vocabulary.radious=1"], OmegaConf.create({"vocabulary": {"radius": 2, "radious": 1}}))
        Traceback (most recent call last):
        ...
        ValueError: vocabulary has no option 'radious'; it takes radius.
    """
    added = {override.lstrip("+").partition("=")[0] for override in overrides if override.startswith("+")}
    for key in sorted(added):
        section, _, option = key.rpartition(".")
        if section not in CLOSED or (not section and (GROUPS / option.partition("@")[0]).is_dir()):
            continue
        known = (str(name) for name in (OmegaConf.select(cfg, section) if section else cfg))
        taken = [name for name in known if f"{section}.{name}".lstrip(".") not in added]
        where = section or "the recipe"
        raise ValueError(f"{where} has no option {option!r}; it takes {', '.join(taken)}.")


def _leaves(section: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in section.items():
        if not isinstance(value, dict):
            yield f"{prefix}{key}", value
        # Entries of labels and values are named after methods, not options.
        elif key not in ("labels", "values") and f"{prefix}{key}" not in OWN:
            yield from _leaves(value, f"{prefix}{key}.")


def _members(values: list) -> Iterator[Any]:
    for value in values:
        yield from _members(value) if isinstance(value, list) else [value]


def is_number(value: Any) -> bool:
    """Whether an option is a finite number; true and false are none.

    Examples:
        >>> [is_number(value) for value in (1, 0.5, float("nan"), True, "1")]
        [True, True, False, False, False]
    """
    return type(value) is int or (type(value) is float and math.isfinite(value))


def _misfit(value: Any, limit: Limit) -> str | None:
    """What the value should be, if it is not."""
    if value is None and limit.empty:
        return None
    if not (is_number(value) if limit.kind is float else type(value) is limit.kind):
        return WORDS[limit.kind] + (" or null" if limit.empty else "")
    if limit.among and value not in limit.among:
        return f"one of {', '.join(limit.among)}"
    if limit.kind not in (int, float):
        return None
    if limit.above and value <= limit.least:
        return f"above {limit.least:g}"
    if limit.least <= value <= limit.most:
        return None
    return f"{limit.least:g} or more" if limit.most == math.inf else f"from {limit.least:g} to {limit.most:.10g}"
