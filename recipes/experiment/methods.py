"""How the methods of an experiment hang together: who starts from whom, and whose rollouts each learns from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from omegaconf import DictConfig, OmegaConf

from dpa.report.table import REFERENCE
from recipes.common.cli import build
from recipes.experiment.runs import SNAPSHOT


@dataclass(frozen=True)
class Setup:
    """What sets a method of an experiment apart beside its data and its loss.

    Attributes:
        start: the policy that it starts from and whose rollouts it learns from: the reference, or another method of
            the experiment (a further round).
        expert: method whose rollouts are the preferred ones (``data.kind: expert``).
        ranking: name of the distance, in ``rankings``, that ranks the rollouts again; None keeps the collection's.
        alignment: options of the section ``alignment`` that differ.
        length: of the alignment, in lengths of that section: a control for rounds.
    """

    start: str = REFERENCE
    expert: str | None = None
    ranking: str | None = None
    alignment: Mapping[str, Any] = field(default_factory=dict)
    length: float = 1.0

    def merged(self, section: DictConfig) -> DictConfig:
        """The section ``alignment`` of this method."""
        options = OmegaConf.merge(section, self.alignment)
        return OmegaConf.merge(options, {"steps": round(self.length * options.steps)})


def setup_of(cfg: DictConfig, method: str) -> Setup:
    """The setup of one method."""
    given = cfg.experiment.setup.get(method)
    return build(Setup, OmegaConf.create({}) if given is None else given, f"experiment.setup.{method}")


def read_setups(cfg: DictConfig) -> dict[str, Setup]:
    """The setup of every method, in an order in which each comes after those that it needs.

    Args:
        cfg: with ``methods``, ``rankings`` and ``experiment.setup``.

    Raises:
        ValueError: a setup of no method, a policy or ranking that does not exist, an expert too many or too few, or
            methods that need each other.
    """
    given = cfg.experiment.setup
    for name in given:
        if name not in cfg.methods:
            raise ValueError(f"experiment.setup.{name}: there is no such method; there are {', '.join(cfg.methods)}.")
    for name in (REFERENCE, *(name for name in cfg.methods if SNAPSHOT in name)):
        if name in cfg.methods:
            raise ValueError(f"methods.{name}: {REFERENCE!r} and names with {SNAPSHOT!r} are taken; call it otherwise.")
    setups = {name: setup_of(cfg, name) for name in cfg.methods}
    for name, setup in setups.items():
        for policy in (setup.start, setup.expert or REFERENCE):
            if policy not in (REFERENCE, *cfg.methods):
                raise ValueError(f"experiment.setup.{name} names {policy!r}, which is no method of the experiment.")
        if setup.expert is not None and cfg.methods[name].data.kind != "expert":
            raise ValueError(
                f"experiment.setup.{name}.expert={setup.expert} is for methods.{name}.data.kind=expert, which is "
                f"{cfg.methods[name].data.kind}."
            )
        if setup.expert is None and cfg.methods[name].data.kind == "expert":
            raise ValueError(
                f"methods.{name}.data.kind=expert learns from another method's rollouts; say whose: "
                f"experiment.setup.{name}.expert=METHOD."
            )
        if setup.ranking is not None and setup.ranking not in cfg.rankings:
            raise ValueError(
                f"experiment.setup.{name}.ranking={setup.ranking!r} is not among rankings: {', '.join(cfg.rankings)}."
            )
    return {name: setups[name] for level in levels(setups) for name in level}


def levels(setups: Mapping[str, Setup]) -> list[list[str]]:
    """Methods in groups: those of one group need only the reference and methods of the groups before.

    Raises:
        ValueError: methods that need each other.

    Examples:
        >>> levels({"omf_2": Setup(start="omf"), "omf": Setup(), "sft": Setup()})
        [['omf', 'sft'], ['omf_2']]
    """
    done, left, found = {REFERENCE}, dict(setups), []
    while left:
        ready = [name for name, setup in left.items() if {setup.start, setup.expert or REFERENCE} <= done]
        if not ready:
            raise ValueError(f"experiment.setup: {', '.join(left)} need each other; one must start from the reference.")
        found.append(ready)
        done |= set(ready)
        left = {name: setup for name, setup in left.items() if name not in ready}
    return found
