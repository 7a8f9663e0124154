"""What can be known to be wrong with an experiment is told before hours of work."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from itertools import product
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from dpa.models import Decoding
from dpa.models.closest import check_following
from dpa.ranking import PreferenceDistance
from dpa.realism.config import RealismConfig
from dpa.realism.tracks import HORIZON
from dpa.report.experiment import REPORTED, read_experiment
from dpa.report.table import REFERENCE
from dpa.rollout.collector import rows_within
from envs.episode import EpisodeOptions
from envs.options import differences
from recipes.alignment.data import ROLLED, check_data
from recipes.alignment.inputs import OBSERVING
from recipes.alignment.losses import check_fit, make_loss
from recipes.alignment.on_policy import check_workers
from recipes.collect import check_collection
from recipes.common.cli import check_steps, plain, told_of
from recipes.common.limits import GROUPS, check_limits, is_number
from recipes.common.models import build_policy
from recipes.common.rankings import build_distance, ranking_options
from recipes.experiment.jobs import (
    check_made_alike,
    chosen_by,
    compared_policy,
    reference_of,
    references_of,
    trained_in,
)
from recipes.experiment.methods import checkpoints_of, policies_of, read_setups
from recipes.experiment.summary import chosen_in, labels
from recipes.pretrain import Origin, auxiliary_of

CHECKPOINTS = ("last", "select", "all")
"""What becomes of the snapshots of an alignment: there are none, one of them may be chosen, or each is shown."""
OWN = ("run/default.yaml", "comparison.yaml", "experiment/base.yaml")
"""Where the options stand that an experiment has beside its :data:`SECTIONS`."""
SECTIONS = ("logger", "pretraining", "collection", "alignment", "evaluation")
AXIS = ("name", "values", "log")


def check_experiment(cfg: DictConfig) -> None:
    """Refuse options that do not fit.

    Args:
        cfg: of ``recipes.compare``.

    Raises:
        ValueError: naming the option.
    """
    _check_keys(cfg)
    check_limits(cfg)
    check_steps(cfg.pretraining, "pretraining")
    RealismConfig.load(str(cfg.evaluation.metric))
    if not cfg.seeds or len(set(cfg.seeds)) < len(cfg.seeds):
        raise ValueError(f"seeds must be one or more, each once, got {list(cfg.seeds)}.")
    _check_number(cfg)
    if cfg.trained is None:
        _check_references(cfg)
    else:
        _check_trained(cfg)
    policy = compared_policy(cfg)
    _check_decodings(cfg)
    check_collection(cfg.collection)
    _check_rankings(cfg)
    _check_methods(cfg, policy)
    _check_report(cfg)


def _check_keys(cfg: DictConfig) -> None:
    """Refuse what a YAML of one's own adds where nobody reads it; Hydra refuses it on the command line alone."""
    known = OmegaConf.merge(*(OmegaConf.load(GROUPS / name) for name in OWN))
    for section in SECTIONS:
        own = OmegaConf.load(GROUPS / section / "default.yaml")
        known[section] = OmegaConf.merge(own, {"ranking": {}}) if section == "collection" else own
    for section in ("", "decoding", "pictures", "experiment", *SECTIONS):
        given, taken = (set(OmegaConf.select(each, section) if section else each) for each in (cfg, known))
        taken = taken - {"defaults", "hydra"} | ({"scenes", "model", "methods"} if not section else set())
        if unknown := sorted(given - taken):
            where = section or "the experiment"
            raise ValueError(f"{where} has no option {unknown[0]!r}; it takes {', '.join(sorted(taken))}.")


def _check_references(cfg: DictConfig) -> None:
    """Before any work: each is there and fits."""
    each = cfg.reference if OmegaConf.is_list(cfg.reference) else [cfg.reference]
    if cfg.reference is not None and not all(isinstance(name, str) for name in each):
        raise ValueError(f"reference must be a file or zoo:NAME, a list of them, or null, got {cfg.reference!r}.")
    if cfg.reference is not None:
        for seed in cfg.seeds:
            reference_of(cfg, seed)


def _check_number(cfg: DictConfig) -> None:
    if OmegaConf.is_list(cfg.reference) and len(cfg.reference) != len(cfg.seeds):
        raise ValueError(
            f"reference has {len(cfg.reference)} policies for the {len(cfg.seeds)} seeds {list(cfg.seeds)}; name one "
            "for each, or one for all of them."
        )


def _check_trained(cfg: DictConfig) -> None:
    """The folder whose policies are taken over is another one, which has finished this experiment by these options."""
    runs, name = trained_in(cfg), cfg.experiment.name
    if runs.root.resolve() == Path(cfg.output).resolve():
        raise ValueError(f"trained={cfg.trained} is the output as well; name another output.")
    if not runs.experiment(name).is_file():
        raise ValueError(
            f"trained={cfg.trained} has no finished experiment {name!r}; run it there first, or say trained=null."
        )
    theirs, mine = read_experiment(runs.experiment(name)).config, plain(cfg)
    if origin := theirs.get("trained"):
        raise ValueError(f"trained={cfg.trained} has its policies from {origin}; say trained={origin}.")
    aligned = references_of(theirs)
    for seed, named in references_of(cfg).items():
        if seed in aligned and named != aligned[seed]:
            raise ValueError(
                f"trained={cfg.trained} has aligned reference={aligned[seed]} of seed {seed}, and here it is {named}; "
                "give the same seeds and references here."
            )
    if differ := differences(_of_training(theirs, mine["methods"]), _of_training(mine, mine["methods"])):
        raise ValueError(f"trained={cfg.trained} was trained with other options than are told here: {differ}.")
    needed = (runs.policy(seed, policy) for seed in cfg.seeds for policy in policies_of(cfg))
    if missing := next((path for path in needed if not path.is_file()), None):
        raise ValueError(f"{missing} does not exist; finish the experiment there, or leave its seed or method out.")
    check_made_alike(cfg, runs.policy(cfg.seeds[0], REFERENCE), f"trained={cfg.trained}")


def _of_training(config: Mapping[str, Any], methods: Iterable[str]) -> dict[str, Any]:
    """What decides the aligned policies of some methods, beside their references and scenes."""
    given = {name: config[name] for name in ("rankings", "aligned_scenes")}
    given["alignment"] = {key: value for key, value in config["alignment"].items() if key not in OBSERVING}
    given["collection"] = {key: config["collection"][key] for key in ("num_rollouts", "decoding")}
    given["collection"]["ranking"] = {
        key: value for key, value in config["collection"]["ranking"].items() if key != "threads"
    }
    given["methods"] = {name: config["methods"].get(name) for name in methods}
    given["setup"] = {name: config["experiment"]["setup"].get(name) for name in methods}
    return given


def _check_decodings(cfg: DictConfig) -> None:
    for name, each in [("common", cfg.decoding.common), *(("grid", each) for each in cfg.decoding.grid)]:
        if not OmegaConf.is_list(each) or len(each) != 2:
            raise ValueError(
                f"decoding.{name} takes pairs [top-p, temperature], got {each!r}; say for example [0.95,1.0]."
            )
        Decoding(*each)
    told = [f"[{top_p:g}, {temperature:g}]" for top_p, temperature in cfg.decoding.grid]  # as files are named by them
    if twice := sorted({each for each in told if told.count(each) > 1}):
        raise ValueError(f"decoding.grid has {twice[0]} more than once, got {told}; name each decoding once.")
    if list(cfg.decoding.common) not in [list(each) for each in cfg.decoding.grid]:
        raise ValueError(f"decoding.common={list(cfg.decoding.common)} must be one of decoding.grid.")
    if cfg.decoding.chosen is not None:
        _check_chosen(cfg)


def _check_chosen(cfg: DictConfig) -> None:
    """The folder that chose has finished this experiment, with these methods, snapshots and common decoding."""
    told, name = f"decoding.chosen={cfg.decoding.chosen}", cfg.experiment.name
    path = chosen_by(cfg)
    if not path.is_file():
        raise ValueError(
            f"{told} has no finished experiment {name!r}; run it there first, or say decoding.chosen=null."
        )
    found = read_experiment(path)
    if list(found.common) != list(cfg.decoding.common):
        raise ValueError(
            f"{told} compares at {list(found.common)}; say decoding.common={list(found.common)} here, or choose anew."
        )
    theirs = chosen_in(found)
    for method, among in checkpoints_of(cfg).items():
        if method not in theirs.best:
            raise ValueError(f"{told} has chosen nothing for {method}; it has {', '.join(theirs.best)} (only).")
        for run in (theirs.common[method], theirs.best[method]):
            if run.policy not in among:
                raise ValueError(
                    f"{told} has chosen {run.policy}, which is none of {', '.join(among)}; have the same "
                    "alignment.snapshots and experiment.checkpoints."
                )


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


def _check_methods(cfg: DictConfig, policy: dict[str, Any]) -> None:
    for name, method in cfg.methods.items():
        if not OmegaConf.is_dict(method):
            raise ValueError(
                f"methods.{name} must be a section with data and loss, got {method!r}; to leave a method out name the "
                "others in only=[...]."
            )
    for name, part in product(cfg.methods, ("data", "loss")):
        if not OmegaConf.is_dict(cfg.methods[name].get(part)):
            raise ValueError(
                f"methods.{name}.{part} must be a section with kind and its options, got "
                f"{cfg.methods[name].get(part)!r}; see the files of recipes/config/method."
            )
    model = build_policy(policy)  # a loss is made to see its options refused
    steps = EpisodeOptions(**policy["episode"]).steps
    if steps != HORIZON:
        raise ValueError(
            f"the metric is of {HORIZON} steps of 0.1 s, and these policies roll {steps} out; say model.episode."
            f"horizon={HORIZON // policy['episode']['decision_steps']}, or take other references."
        )
    model.distribution.check_smoothing(cfg.pretraining.label_smoothing)
    for section in ("collection", "evaluation"):
        with told_of(section):
            rows_within(cfg[section].memory, model)
    if cfg.collection.compile and not model.compiles:
        raise ValueError(f"{type(model).__name__} compiles nothing; say collection.compile=false.")
    if cfg.reference is None and cfg.trained is None:
        auxiliary_of(model, cfg.pretraining.auxiliary)
        if cfg.pretraining.start is not None:
            Origin.open(cfg.pretraining.start).load_into(model, policy)
    for name, setup in read_setups(cfg).items():
        if unknown := sorted(set(cfg.methods[name]) - {"name", "data", "loss"}):
            raise ValueError(
                f"methods.{name} has no option {unknown[0]!r}; it takes name, data and loss; what else sets it apart "
                f"stands in experiment.setup.{name}."
            )
        if unknown := sorted(set(setup.alignment) - set(cfg.alignment)):
            raise ValueError(f"experiment.setup.{name}.alignment has no option {unknown[0]!r}.")
        alignment = setup.merged(cfg.alignment)
        with told_of(f"methods.{name}"):
            check_fit(cfg.methods[name], alignment, cfg.collection.num_rollouts)
            data = check_data(cfg.methods[name].data, cfg.collection.num_rollouts)
            make_loss(cfg.methods[name].loss, model)
            if data.kind == "closed_loop":
                check_following(model, data.candidates, data.recovery)
            if data.kind in ROLLED:
                check_workers(alignment, model)
            check_steps(alignment, "alignment")


def _check_texts(experiment: DictConfig) -> None:
    """Titles and labels are text, which YAML takes for numbers where they look like them."""
    texts = {name: experiment[name] for name in ("name", "title", "question")}
    texts |= {} if experiment.paper is None else {"paper": experiment.paper}
    texts |= {f"labels.{name}": label for name, label in experiment.labels.items()}
    for name, text in texts.items():
        if not isinstance(text, str):
            raise ValueError(f"experiment.{name} must be text, got {text!r}; put it in quotes.")


def _check_axis(cfg: DictConfig) -> None:
    axis = cfg.experiment.axis
    if axis is None:
        return
    if not OmegaConf.is_dict(axis) or set(axis) != set(AXIS) or not OmegaConf.is_dict(axis["values"]):
        raise ValueError(f"experiment.axis must have {', '.join(AXIS)}, got {axis}; or say null.")
    for method, value in axis["values"].items():
        if method not in cfg.methods:
            raise ValueError(f"experiment.axis.values.{method} is no method; name one of {', '.join(cfg.methods)}.")
        if not is_number(value):
            raise ValueError(f"experiment.axis.values.{method} must be a number, got {value!r}.")
        if axis["log"] is True and value <= 0:
            raise ValueError(
                f"experiment.axis.values.{method}={value} has no place on a logarithmic axis; say experiment.axis.log="
                "false, or a positive number."
            )
    if not isinstance(axis["name"], str) or not isinstance(axis["log"], bool):
        raise ValueError(f"experiment.axis: name must be text and log true or false, got {axis}.")


def _check_published(experiment: DictConfig) -> None:
    """The paper's figures are numbers by method and name."""
    for method, figures in experiment.published.items():
        if not OmegaConf.is_dict(figures):
            raise ValueError(
                f"experiment.published.{method} must hold figures by name, got {figures!r}; say for example "
                "{realism: 0.739}."
            )
        for name, value in figures.items():
            if not is_number(value):
                raise ValueError(f"experiment.published.{method}.{name} must be a number, got {value!r}.")


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
    _check_texts(experiment)
    _check_axis(cfg)
    _check_published(experiment)
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
