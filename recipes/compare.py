"""Experiments: from scenes to a comparison of methods, for several seeds (method.md section 6, docs/experiments.md).

    python -m recipes.compare scenes=gpudrive scenes.train=DIR scenes.eval=DIR output=runs/real
    python -m recipes.compare experiment=features output=runs/real ...   # another question to the same references
    python -m recipes.compare scenes=gpudrive ... trained=runs/sumo output=runs/zero_shot       # its policies elsewhere
    make demo                                                            # the first one on SUMO scenes, in minutes

For every seed: pre-train a reference, collect and rank its rollouts, align it with each method, choose each one's
checkpoint and decoding on the tuning scenes, and evaluate once. Experiments with the same output folder share what they
can. Run the same command again to go on after a kill.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from itertools import product
from typing import Any

import hydra
from omegaconf import DictConfig

from dpa.models import Decoding
from dpa.report.experiment import read_experiment, read_json
from dpa.report.table import REFERENCE, print_table
from envs.files import write_json
from envs.locks import alone_in
from recipes.alignment.data import ON_POLICY
from recipes.common.cli import CONFIG, recipe
from recipes.common.provenance import merged, provenance
from recipes.common.scenes import open_splits
from recipes.experiment.cards import write_scene_cards
from recipes.experiment.check import check_experiment
from recipes.experiment.jobs import (
    adopt_job,
    align_job,
    chosen_by,
    collect_job,
    evaluate_job,
    likelihood_job,
    pretrain_job,
    rerank_job,
    runs_of,
    trained_in,
)
from recipes.experiment.logged import log_experiment
from recipes.experiment.methods import checkpoints_of, kept, levels, policies_of, read_setups
from recipes.experiment.pictures import write_players
from recipes.experiment.pool import Workers
from recipes.experiment.runs import Run
from recipes.experiment.stages import Stages
from recipes.experiment.summary import Chosen, chosen_in, decoding_at, summarise_experiment
from recipes.report import report


def compare(cfg: DictConfig) -> dict[str, Any]:
    """Run every stage of an experiment that is not done yet; write what it found and the scenes to play.

    Raises:
        ValueError: options that do not fit, or other scenes than those of the folder, before any work.
    """
    cfg = kept(cfg)
    check_experiment(cfg)
    splits, runs, made = open_splits(cfg.scenes), runs_of(cfg), provenance("compare", cfg.device)
    with alone_in(runs.root):
        write_scene_cards(runs.scenes, splits)
        with Workers(cfg.workers, cfg.threads, spread=cfg.device == "cuda") as workers:
            stages = Stages(workers, runs.stages, made)
            if cfg.trained is None:
                train_policies(cfg, stages)
            else:
                adopt_policies(cfg, stages)
            chosen = choose(cfg, stages)
            measure(cfg, stages, chosen)
        counted = splits.sizes() | {"source": cfg.scenes.source}
        found = summarise_experiment(cfg, counted, chosen, stages) | made_by(cfg, stages) | {"command": made["command"]}
        path, pictures = runs.experiment(cfg.experiment.name), {}
        write_json(path, found)
        if cfg.pictures.scenes:
            pictures["scenes/likely"] = write_players(cfg, splits[cfg.experiment.split], chosen.best)
        log_experiment(cfg, read_experiment(path), pictures)
    return found


def made_by(cfg: DictConfig, stages: Stages) -> dict[str, Any]:
    """Code, machine and date of all that the result rests on, trainings elsewhere too."""
    if cfg.trained is None:
        return stages.made
    theirs = read_json(trained_in(cfg).experiment(cfg.experiment.name))
    return merged([{name: each[name] for name in stages.made} for each in (theirs, stages.made)])


def adopt_policies(cfg: DictConfig, stages: Stages) -> None:
    """References and aligned policies of another folder, and ranked rollouts of the reported scenes."""
    stages.run("adopt", adopt_job, cfg, [(seed, policy) for policy in policies_of(cfg) for seed in cfg.seeds])
    stages.run("collect", collect_job, cfg, [(seed, cfg.experiment.split, REFERENCE) for seed in cfg.seeds])


def train_policies(cfg: DictConfig, stages: Stages) -> None:
    """References, ranked rollouts and aligned policies."""
    seeds, setups = list(cfg.seeds), read_setups(cfg)
    stages.run("pretrain", pretrain_job, cfg, [(seed,) for seed in seeds])
    splits = sorted({"tune", cfg.experiment.split})
    stages.run("collect", collect_job, cfg, [(seed, split, REFERENCE) for seed in seeds for split in splits])
    for level in levels(setups):
        needed = [setups[method] for method in level if cfg.methods[method].data.kind not in ON_POLICY]
        sources = sorted({setup.start for setup in needed} | {setup.expert for setup in needed if setup.expert})
        stages.run("collect", collect_job, cfg, [(seed, "train", source) for seed in seeds for source in sources])
        again = sorted({(setup.start, setup.ranking) for setup in needed if setup.ranking is not None})
        stages.run("rank", rerank_job, cfg, [(seed, *each) for seed in seeds for each in again])
        stages.run("align", align_job, cfg, [(seed, method) for seed in seeds for method in level])


def choose(cfg: DictConfig, stages: Stages) -> Chosen:
    """Checkpoint and decoding of each method, both at once, by mean realism over seeds on the tuning scenes.

    What has one checkpoint and one decoding needs no choice, and is not rolled out for it; nothing is where another
    folder has chosen.
    """
    policies = checkpoints_of(cfg)
    if cfg.decoding.chosen is not None:
        theirs = chosen_in(read_experiment(chosen_by(cfg)))
        common, best = ({method: runs[method] for method in policies} for runs in (theirs.common, theirs.best))
        return Chosen(common=common, best=best, tuned=frozenset())
    runs = {method: [Run(*each) for each in product(among, decodings(cfg))] for method, among in policies.items()}
    tuned = {run for among in runs.values() if len(among) > 1 for run in among}
    stages.run("tune", evaluate_job, cfg, jobs_of(cfg, tuned, "tune"))
    common = decoding_at(cfg.decoding.common)

    def best(among: Sequence[Run]) -> Run:
        return max(among, key=lambda run: tuning_realism(cfg, run)) if len(among) > 1 else among[0]

    return Chosen(
        common={method: best([run for run in among if run.decoding == common]) for method, among in runs.items()},
        best={method: best(among) for method, among in runs.items()},
        tuned=frozenset(tuned),
    )


def measure(cfg: DictConfig, stages: Stages, chosen: Chosen) -> None:
    """Every method at the common and at its own best decoding, on the split that the experiment reports.

    The evaluation scenes are looked at once for each result. An experiment that looks for settings reports the tuning
    scenes, which have been rolled out for the choice of decodings.
    """
    split, wanted = cfg.experiment.split, {*chosen.common.values(), *chosen.best.values()}
    stages.run(
        "evaluate", evaluate_job, cfg, jobs_of(cfg, wanted | {Run(REFERENCE, each) for each in decodings(cfg)}, split)
    )
    policies = dict.fromkeys(run.policy for run in [*chosen.best.values(), *chosen.common.values()])
    stages.run("likelihood", likelihood_job, cfg, [(seed, policy, split) for policy in policies for seed in cfg.seeds])


def decodings(cfg: DictConfig) -> list[Decoding]:
    """The grid that decodings are chosen from."""
    return [decoding_at(each) for each in cfg.decoding.grid]


def jobs_of(cfg: DictConfig, runs: Iterable[Run], split: str) -> list[tuple[int, str, str, float, float]]:
    """Arguments of :func:`~recipes.experiment.jobs.evaluate_job` for some runs and all seeds."""
    each = ((run.policy, split, run.decoding.top_p, run.decoding.temperature) for run in runs)
    return sorted((seed, *run) for run, seed in product(each, cfg.seeds))


def tuning_realism(cfg: DictConfig, run: Run) -> float:
    """Sum over seeds of the mean realism on the tuning scenes.

    Raises:
        ValueError: there is none.
    """
    paths = [runs_of(cfg).evaluation(seed, run, "tune") for seed in cfg.seeds]
    found = [read_json(path)["mean"]["realism"] for path in paths]
    if None in found:
        raise ValueError(
            f"{paths[found.index(None)]}: no tuning scene has realism, so that no decoding can be chosen; name other "
            "scenes.tune, of whose agents all features of the metric are scored."
        )
    return sum(found)


@hydra.main(**CONFIG, config_name="compare")
@recipe
def main(cfg: DictConfig) -> None:
    """Entry point of ``python -m recipes.compare``."""
    found = compare(cfg)
    print_table(found["rows"], found["paired"], title=f"{found['title']}: all at the same decoding")
    if (own := found["own_best"])["rows"] != found["rows"]:
        print_table(own["rows"], own["paired"], title="Each at its own best decoding, chosen on the tuning scenes")
    print(f"numbers: {runs_of(cfg).experiment(cfg.experiment.name)}")
    print(f"report: {report(runs_of(cfg).root, runs_of(cfg).root / 'index.html')}")


if __name__ == "__main__":
    sys.exit(main())
