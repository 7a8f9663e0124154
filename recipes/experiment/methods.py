"""How the methods of an experiment hang together: who starts from whom, and whose rollouts each learns from."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from omegaconf import DictConfig, OmegaConf, open_dict

from dpa.report.table import REFERENCE
from envs.seeding import derive_seed
from recipes.alignment.data import ON_POLICY, RANKED
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
        length: of the alignment and between its snapshots, in lengths of that section: a control for rounds.
    """

    start: str = REFERENCE
    expert: str | None = None
    ranking: str | None = None
    alignment: Mapping[str, Any] = field(default_factory=dict)
    length: float = 1.0

    def scaled(self, steps: int) -> int:
        """So many steps by the method's length, one at least.

        Examples:
            >>> Setup(length=0.5).scaled(150), Setup(length=0.5).scaled(1)
            (75, 1)
        """
        return max(1, round(self.length * steps))

    def merged(self, section: DictConfig) -> DictConfig:
        """The section ``alignment`` of this method."""
        options = OmegaConf.merge(section, self.alignment)
        times = {
            "steps": self.scaled(options.steps),
            "snapshots": list(dict.fromkeys(self.scaled(step) for step in options.snapshots)),
        }
        return OmegaConf.merge(options, times)


def setup_of(cfg: DictConfig, method: str) -> Setup:
    """The setup of one method."""
    given = cfg.experiment.setup.get(method)
    return build(Setup, OmegaConf.create({}) if given is None else given, f"experiment.setup.{method}")


def kept(cfg: DictConfig) -> DictConfig:
    """The configuration with the methods that ``only`` names and those that they need; all of it without ``only``.

    What is said of the others goes as well. Where the headline does, the first that is named is it.

    Raises:
        ValueError: ``only`` is no list of methods of the experiment, or methods need each other.

    Examples:
        >>> told = {"setup": {}, "labels": {"omf": "OMF"}}
        >>> given = {"only": ["sft"], "methods": {"omf": {}, "sft": {}}, "experiment": told}
        >>> dict(kept(OmegaConf.create(given)).methods)
        {'sft': {}}
    """
    if cfg.only is None:
        return cfg
    if not OmegaConf.is_list(cfg.only) or not cfg.only or not set(cfg.only) <= set(cfg.methods):
        raise ValueError(
            f"only must be methods of the experiment as in only=[{next(iter(cfg.methods))}], got {cfg.only!r}; there "
            f"are {', '.join(cfg.methods)}."
        )
    named, cfg = list(cfg.only), copy.deepcopy(cfg)
    others = set(cfg.methods) - {each for name in named for each in behind(cfg, name)}
    told = (OmegaConf.select(cfg, f"experiment.{name}") for name in ("setup", "labels", "published", "axis.values"))
    with open_dict(cfg):
        for section in (cfg.methods, *(each for each in told if each is not None)):
            for name in others & set(section):
                del section[name]
    if cfg.experiment.get("headline") in others:
        cfg.experiment.headline = named[0]
    if cfg.experiment.get("versus") in others:
        cfg.experiment.versus = None
    return cfg


def behind(cfg: DictConfig, policy: str, waiting: tuple[str, ...] = ()) -> list[str]:
    """Methods that must run before a policy is there, its own last and each once; none for the reference.

    Args:
        cfg: with ``experiment.setup``.
        policy: a method, or the reference.
        waiting: methods that wait for it.

    Raises:
        ValueError: it waits for itself.
    """
    if policy == REFERENCE:
        return []
    if policy in waiting:
        circle = ", ".join(waiting[waiting.index(policy) :])
        raise ValueError(f"experiment.setup: {circle} need each other; one must start from the reference.")
    setup = setup_of(cfg, policy)
    before = [
        each for source in (setup.start, setup.expert or REFERENCE) for each in behind(cfg, source, (*waiting, policy))
    ]
    return [*dict.fromkeys(before), policy]


def drawing_seed(cfg: DictConfig, seed: int, policy: str) -> int:
    """Seed of a policy's rollouts to learn from, and of the order in which they are learnt from.

    Each round has its own. What a rollout draws is decided by seed, scene and k: with one seed for all rounds an
    aligned policy would largely repeat the rollouts that it was aligned on.

    Args:
        cfg: of the study.
        seed: of the study; that of the reference's rollouts.
        policy: the reference or a method.

    Returns:
        An integer in ``[0, 2**32)``.
    """
    rounds = 0
    while policy != REFERENCE:
        policy, rounds = setup_of(cfg, policy).start, rounds + 1
    return seed if rounds == 0 else derive_seed(seed, "round", rounds) % 2**32


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
        if setup.ranking is not None and cfg.methods[name].data.kind not in RANKED:
            raise ValueError(
                f"experiment.setup.{name}.ranking={setup.ranking} says nothing to methods.{name}.data.kind="
                f"{cfg.methods[name].data.kind}, which reads no ranks; leave it out."
            )
        if setup.ranking is not None and cfg.methods[name].data.kind in ON_POLICY:
            raise ValueError(
                f"experiment.setup.{name}.ranking={setup.ranking} is for rollouts of a store, and {name} ranks those "
                f"that it makes; say methods.{name}.data.ranking."
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


def checkpoints_of(cfg: DictConfig) -> dict[str, list[str]]:
    """Policies of which one stands for each row."""
    policies = {method: [method] for method in shown_policies(cfg)}
    if cfg.experiment.checkpoints == "select":
        policies |= {method: [*snapshots_of(cfg, method), method] for method in cfg.methods}
    return policies


def shown_policies(cfg: DictConfig) -> list[str]:
    """What has a row of its own: the reference, every method, and its snapshots where all are shown."""
    shown = [REFERENCE]
    for method in cfg.methods:
        shown += [*(snapshots_of(cfg, method) if cfg.experiment.checkpoints == "all" else []), method]
    return shown


def snapshots_of(cfg: DictConfig, method: str) -> list[str]:
    """Names of the snapshots of a method."""
    options = setup_of(cfg, method).merged(cfg.alignment)
    return [f"{method}{SNAPSHOT}{step}" for step in options.snapshots if step < options.steps]


def policies_of(cfg: DictConfig) -> list[str]:
    """All that a comparison may roll out, the reference first."""
    return list(dict.fromkeys(policy for among in checkpoints_of(cfg).values() for policy in among))
