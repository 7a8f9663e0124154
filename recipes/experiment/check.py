"""What can be known to be wrong with an experiment is told before hours of work."""

from __future__ import annotations

import re

from omegaconf import DictConfig, OmegaConf

from dpa.policy import Decoding, MotionLM
from dpa.ranking import PreferenceDistance
from dpa.realism.config import RealismConfig
from dpa.report.experiment import REPORTED
from dpa.report.table import REFERENCE
from dpa.tokens import VerletTokenizer
from recipes.alignment.candidates import check_data
from recipes.alignment.losses import check_fit, make_loss
from recipes.common.cli import check_steps, told_of
from recipes.common.limits import check_limits
from recipes.common.models import policy_config
from recipes.common.rankings import build_distance, ranking_options
from recipes.experiment.methods import read_setups
from recipes.experiment.summary import labels

CHECKPOINTS = ("last", "select", "all")
"""What becomes of the snapshots of an alignment: there are none, one of them may be chosen, or each is shown."""


def check_experiment(cfg: DictConfig) -> None:
    """Refuse options that do not fit.

    Args:
        cfg: of ``recipes.compare``.

    Raises:
        ValueError: naming the option.
    """
    check_limits(cfg)
    check_steps(cfg.pretraining, "pretraining")
    policy_config(cfg.model)
    RealismConfig.load(str(cfg.evaluation.metric))
    if not cfg.seeds or len(set(cfg.seeds)) < len(cfg.seeds):
        raise ValueError(f"seeds must be one or more, each once, got {list(cfg.seeds)}.")
    _check_decodings(cfg)
    _check_rankings(cfg)
    _check_methods(cfg)
    _check_report(cfg)


def _check_decodings(cfg: DictConfig) -> None:
    for name, each in [("common", cfg.decoding.common), *(("grid", each) for each in cfg.decoding.grid)]:
        if not OmegaConf.is_list(each) or len(each) != 2:
            raise ValueError(
                f"decoding.{name} takes pairs [top-p, temperature], got {each!r}; say for example [0.95,1.0]."
            )
        Decoding(*each)
    if list(cfg.decoding.common) not in [list(each) for each in cfg.decoding.grid]:
        raise ValueError(f"decoding.common={list(cfg.decoding.common)} must be one of decoding.grid.")


def _check_rankings(cfg: DictConfig) -> None:
    if cfg.collection.num_rollouts < 2:
        raise ValueError(
            f"collection.num_rollouts={cfg.collection.num_rollouts} of a scene make no pair, whose accuracy is told of "
            "every method; say 2 or more."
        )
    own = build_distance(cfg.collection.ranking, "collection.ranking")
    for name, options in cfg.rankings.items():
        build_distance(ranking_options(cfg.collection.ranking, options), f"rankings.{name}")
    if cfg.pictures.scenes and not isinstance(own, PreferenceDistance):
        raise ValueError(
            f"the player shows couplings, and collection.ranking.kind={cfg.collection.ranking.kind} couples nothing; "
            "say pictures.scenes=0."
        )


def _check_methods(cfg: DictConfig) -> None:
    model = MotionLM("nano", VerletTokenizer())  # any will do: a loss is made to see its options refused
    for name, setup in read_setups(cfg).items():
        with told_of(f"methods.{name}"):
            check_fit(cfg.methods[name])
            check_data(cfg.methods[name].data, cfg.collection.num_rollouts)
            make_loss(cfg.methods[name].loss, model)
        unknown = sorted(set(setup.alignment) - set(cfg.alignment))
        if unknown:
            raise ValueError(f"experiment.setup.{name}.alignment has no option {unknown[0]!r}.")
        with told_of(f"methods.{name}"):
            check_steps(setup.merged(cfg.alignment), "alignment")


def _check_labels(cfg: DictConfig) -> None:
    """Pictures and players know methods by their labels."""
    called: dict[str, str] = {}
    for method, label in labels(cfg, [REFERENCE, *cfg.methods]).items():
        if label in called:
            raise ValueError(
                f"{called[label]} and {method} are both called {label!r}; say experiment.labels.{method}=NAME."
            )
        called[label] = method


def _check_report(cfg: DictConfig) -> None:
    experiment = cfg.experiment
    if not re.fullmatch(r"\w[\w.-]*", str(experiment.name)):
        raise ValueError(
            f"experiment.name={experiment.name!r} names a file and a place on the page; say it in letters, digits, _, "
            "- and dots."
        )
    _check_labels(cfg)
    if experiment.headline not in cfg.methods:
        raise ValueError(
            f"experiment.headline={experiment.headline} is no method of the experiment; name one of "
            f"{', '.join(cfg.methods)}."
        )
    if experiment.versus not in (None, *cfg.methods):
        raise ValueError(
            f"experiment.versus={experiment.versus} is no method of the experiment; name one of "
            f"{', '.join(cfg.methods)}, or null for the headline's."
        )
    if experiment.split not in REPORTED:
        raise ValueError(f"experiment.split must be one of {', '.join(REPORTED)}, got {experiment.split!r}.")
    if experiment.checkpoints not in CHECKPOINTS:
        raise ValueError(
            f"experiment.checkpoints must be one of {', '.join(CHECKPOINTS)}, got {experiment.checkpoints!r}."
        )
    if experiment.split == "tune" and experiment.checkpoints == "select":
        raise ValueError(
            "experiment.checkpoints=select chooses checkpoints on the tuning scenes, and experiment.split=tune reports "
            "on them: methods would have an advantage over the reference; say experiment.checkpoints=last or all."
        )
    snapshots, steps = list(cfg.alignment.snapshots), cfg.alignment.steps
    if experiment.checkpoints != "last" and not any(step < steps for step in snapshots):
        raise ValueError(
            f"experiment.checkpoints={experiment.checkpoints} needs a snapshot before step {steps} and "
            f"alignment.snapshots is {snapshots}; say for example alignment.snapshots=[{steps // 2}], or "
            "experiment.checkpoints=last."
        )
