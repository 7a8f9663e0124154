"""Families of policies by name: a configuration becomes a policy here, and nowhere else."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, fields, is_dataclass
from typing import Any, NamedTuple

from dpa.models import behaviorgpt, motionlm, smart, trajeglish
from dpa.models.base import MotionModel
from dpa.models.factorised import NeighbourhoodOptions
from dpa.models.scene import ContextOptions
from dpa.tokens.base import MotionTokenizer


class Family(NamedTuple):
    """What makes a policy of a family.

    Attributes:
        model: called with the size, the tokenizer and the options of what the policy sees.
        sizes: configurations by name, dataclasses with ``horizon`` and ``dropout``.
        context: makes the options of what the policy sees of a scene, a dataclass.
    """

    model: Callable[[Any, MotionTokenizer, Any], MotionModel]
    sizes: Mapping[str, Any]
    context: Callable[..., Any]


FAMILIES: dict[str, Family] = {
    "motionlm": Family(motionlm.MotionLM, motionlm.SIZES, ContextOptions),
    "smart": Family(smart.SMART, smart.SIZES, NeighbourhoodOptions),
    "trajeglish": Family(trajeglish.Trajeglish, trajeglish.SIZES, ContextOptions),
    "behaviorgpt": Family(behaviorgpt.BehaviorGPT, behaviorgpt.SIZES, NeighbourhoodOptions),
}
"""Families that a YAML can name; add one of your own here (docs/how-to.md)."""


def family_of(name: str) -> Family:
    """The family of a name.

    Raises:
        ValueError: there is none, or its sizes are no configurations.
    """
    if name not in FAMILIES:
        raise ValueError(
            f"model.family must be one of {sorted(FAMILIES)}, got {name!r}; one of your own is a line in FAMILIES of "
            f"{__name__}."
        )
    family = FAMILIES[name]
    for size, config in family.sizes.items():
        held = [field.name for field in fields(config)] if is_dataclass(config) else []
        if missing := [field for field in ("horizon", "dropout") if field not in held]:
            raise ValueError(f"size {size!r} of {name} must be a dataclass with horizon and dropout, lacks {missing}.")
    return family


def size_of(family: str, size: str) -> dict[str, Any]:
    """The configuration of a named size, as a checkpoint holds it.

    Raises:
        ValueError: there is no such family, or it has no such size.

    Examples:
        >>> size_of("motionlm", "nano")["width"]
        48
    """
    sizes = family_of(family).sizes
    if size not in sizes:
        raise ValueError(f"model.size must be one of {sorted(sizes)}, got {size!r}.")
    return asdict(sizes[size])


def build_model(config: Mapping[str, Any], tokenizer: MotionTokenizer) -> MotionModel:
    """A fresh policy.

    Args:
        config: with ``family``, and its ``model`` and ``context`` as keyword arguments.
        tokenizer: what an action is.

    Examples:
        >>> from dpa.tokens import VerletTokenizer
        >>> config = {"family": "motionlm", "model": size_of("motionlm", "nano"), "context": {"max_pieces": 256}}
        >>> build_model(config, VerletTokenizer()).context.max_pieces
        256
    """
    family = family_of(config["family"])
    size = type(next(iter(family.sizes.values())))(**config["model"])
    return family.model(size, tokenizer, family.context(**config["context"]))
