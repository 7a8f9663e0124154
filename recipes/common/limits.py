"""What an option may be, by its name: told before any work, where a wrong one would end hours later or mean another."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from omegaconf import DictConfig, OmegaConf


class Limit(NamedTuple):
    """Values that an option may have.

    Attributes:
        kind: ``int`` (a whole number), ``float`` (any finite number) or ``bool``.
        least: smallest value.
        most: largest value.
        above: the smallest value itself is not among them.
        empty: null is.
    """

    kind: type
    least: float = -math.inf
    most: float = math.inf
    above: bool = False
    empty: bool = False


COUNT, NUMBER = Limit(int, least=1), Limit(int, least=0)
POSITIVE, SHARE, FLAG = Limit(float, least=0, above=True), Limit(float, least=0, most=1), Limit(bool)
COUNTS = (
    *("threads", "count", "parts", "shard_size", "chunk_scenes", "num_rollouts", "drift_rollouts", "kept", "each"),
    *("steps", "batch_size", "batch_scenes", "scenes_per_step", "pairs_per_scene", "max_rows", "stride", "width"),
    *("checkpoint_interval", "tune_interval", "watch_interval", "look_interval", "watch_scenes", "watch_pairs"),
    *("decision_steps", "horizon", "max_controlled", "max_pieces", "patience", "pretraining.max_agents"),
)
LIMITS: dict[str, Limit] = {
    **dict.fromkeys(COUNTS, COUNT),
    **dict.fromkeys(("workers", "warmup", "part", "top_k", "min_agents", "pictures.scenes"), NUMBER),
    **dict.fromkeys(("aligned_scenes", "scenes.limit", "select.max_agents"), COUNT._replace(empty=True)),
    **dict.fromkeys(("seed", "split_seed"), Limit(int)),
    **dict.fromkeys(("memory", "max_norm", "lr", "piece_length", "temperature", "top_p"), POSITIVE),
    **dict.fromkeys(("noise", "dropout", "mirror", "agent_drop", "label_smoothing"), SHARE),
    **dict.fromkeys(("weight_decay", "rotation"), Limit(float, least=0)),
    **dict.fromkeys(("compile", "arrivals", "tokenized"), FLAG),
    "has_lights": FLAG._replace(empty=True),
}
"""Limit of an option by its last name, or by its last two where one name has several meanings."""
WORDS = {int: "a whole number", float: "a number", bool: "true or false"}


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
    """
    for name, value in _leaves(OmegaConf.to_container(cfg, resolve=False)):
        parts = name.split(".")
        limit = LIMITS.get(".".join(parts[-2:])) or LIMITS.get(parts[-1])
        reference = isinstance(value, str) and value.startswith(("${", "???"))
        if limit is not None and not reference and (wanted := _misfit(value, limit)) is not None:
            raise ValueError(f"{name} must be {wanted}, got {value!r}.")


def _leaves(section: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in section.items():
        if isinstance(value, dict):
            yield from _leaves(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _misfit(value: Any, limit: Limit) -> str | None:
    """What the value should be, if it is not."""
    if value is None and limit.empty:
        return None
    number = type(value) is int or (type(value) is float and math.isfinite(value))
    if not (number if limit.kind is float else type(value) is limit.kind):
        return WORDS[limit.kind] + (" or null" if limit.empty else "")
    if limit.kind is bool:
        return None
    if limit.above and value <= limit.least:
        return f"above {limit.least:g}"
    if limit.least <= value <= limit.most:
        return None
    return f"{limit.least:g} or more" if limit.most == math.inf else f"from {limit.least:g} to {limit.most:g}"
