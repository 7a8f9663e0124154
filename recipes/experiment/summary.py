"""From the results of all runs to what an experiment found."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import compress
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from omegaconf import DictConfig

from dpa.models import Decoding
from dpa.report.experiment import Experiment, decoding_of, read_json
from dpa.report.statistics import paired_bootstrap
from dpa.report.table import REFERENCE
from recipes.alignment.data import ON_POLICY, RANKED, ROLLED, num_candidates
from recipes.alignment.draws import num_drawn
from recipes.alignment.likelihoods import PROBED
from recipes.common.cli import mean_known, plain
from recipes.evaluate import SCENE_FIGURES
from recipes.experiment.jobs import runs_of, trained_in
from recipes.experiment.methods import behind, setup_of
from recipes.experiment.runs import SNAPSHOT, Run, method_of
from recipes.experiment.stages import Stages, read_account

TOLD = ("name", "title", "paper", "question", "headline", "axis", "split", "published")
"""What an experiment says of itself."""


class Chosen(NamedTuple):
    """What the tuning scenes decided.

    Attributes:
        common: method -> its last policy or a snapshot, the best one at the common decoding.
        best: method -> the best policy and decoding.
        tuned: all that was rolled out on the tuning scenes for it.
    """

    common: dict[str, Run]
    best: dict[str, Run]
    tuned: frozenset[Run]


def decoding_at(given: Sequence[float]) -> Decoding:
    """A decoding as options have it, ``[top-p, temperature]``; written as 1 or 1.0 it is the same one.

    Examples:
        >>> decoding_at([1, 1.0])
        Decoding(top_p=1.0, temperature=1.0, top_k=0)
    """
    return Decoding(*map(float, given))


def chosen_in(found: Experiment) -> Chosen:
    """What a finished experiment has chosen; here nothing is rolled out for it."""
    at_common = [row for row in found.at_common.rows if decoding_of(row) == found.common]
    common, best = (
        {row["method"]: Run(policy_of(row), Decoding(*decoding_of(row))) for row in rows}
        for rows in (at_common, found.own_best.rows)
    )
    return Chosen(common=common, best=best, tuned=frozenset())


def policy_of(row: Mapping[str, Any]) -> str:
    """The policy of a row: its method, or the snapshot that its file is of.

    Examples:
        >>> policy_of({"file": "seed_0/dpa_omf/step_60/eval_top_p_1_t_1.json"})
        'dpa_omf@60'
    """
    _, method, *steps, _ = Path(row["file"]).parts
    return SNAPSHOT.join([method, *(step.removeprefix("step_") for step in steps)])


Shown = tuple[str, Run]
"""A row: a method and what stands for it."""


class Results:
    """Reads the results of an experiment's runs.

    Args:
        cfg: of the experiment.
        shown: all rows of the reported scenes. Those scenes are left out of every row for which one has no realism.

    Raises:
        ValueError: no reported scene has realism in all rows.
    """

    def __init__(self, cfg: DictConfig, shown: Sequence[Shown]) -> None:
        self.runs, self.seeds, self.split = runs_of(cfg), list(cfg.seeds), cfg.experiment.split
        scores = [self._scores(run, seed) for _, run in shown for seed in self.seeds]
        self.known = [all(score is not None for score in scene) for scene in zip(*scores, strict=True)]
        if not any(self.known):
            raise ValueError(
                f"no scene of scenes.{self.split} has realism under every policy, so that nothing can be compared; "
                "name other scenes, of whose agents all features of the metric are scored."
            )

    def rows(self, shown: Sequence[Shown]) -> list[dict[str, Any]]:
        """Means of several runs over the reported scenes, each for all seeds, with the file behind each."""
        return [
            self._row(method, run, seed, self.split)
            | {"pair_accuracy": self.likelihood(method, run.policy, seed)["pair_accuracy"]}
            for method, run in shown
            for seed in self.seeds
        ]

    def tuning(self, shown: Sequence[Shown]) -> list[dict[str, Any]]:
        """Means over the tuning scenes, likewise."""
        return [self._row(method, run, seed, "tune") for method, run in shown for seed in self.seeds]

    def likelihood(self, method: str, policy: str, seed: int) -> dict[str, Any]:
        """What a policy thinks of logs and rollouts of the reported scenes."""
        path = self.runs.likelihood(seed, policy, self.split)
        mean = read_json(path)["mean"]
        named = {"method": method, "seed": seed, "file": self.runs.relative(path)}
        return named | {name: mean[name] for name in (*PROBED, "kl")}

    def paired(self, shown: Sequence[Shown], reference: Shown) -> list[dict[str, Any]]:
        """Realism of each run minus that of a reference, by scene and seed, with intervals."""
        against = reference[1].decoding
        base = self._known_scores(reference[1])
        entries = []
        for method, run in shown:
            found = paired_bootstrap(self._known_scores(run), base)
            entries.append(
                {
                    "method": method,
                    "realism_difference": found.mean,
                    "ci95": [found.low, found.high],
                    "over": found.over,
                    "n_seeds": found.num_seeds,
                    "top_p": run.decoding.top_p,
                    "temperature": run.decoding.temperature,
                    "against": reference[0],
                    "against_top_p": against.top_p,
                    "against_temperature": against.temperature,
                }
            )
        return entries

    def _row(self, method: str, run: Run, seed: int, split: str) -> dict[str, Any]:
        path = self.runs.evaluation(seed, run, split)
        found = read_json(path)["per_scene"]
        values = {name: found[name] for name in SCENE_FIGURES}
        if split == self.split:  # other figures are known of scenes that have no realism, and are told of all of them
            values["realism"] = self._known(values["realism"])
        return {
            "method": method,
            "seed": seed,
            "top_p": run.decoding.top_p,
            "temperature": run.decoding.temperature,
            "file": self.runs.relative(path),
            "n_scenes": len(values["realism"]),
            **{name: mean_known(of_scenes) for name, of_scenes in values.items()},
        }

    def _known(self, values: Sequence[float | None]) -> list[float | None]:
        return list(compress(values, self.known))

    def _known_scores(self, run: Run) -> NDArray[np.float64]:
        """``[seeds, scenes]``, of scenes where every run has realism."""
        return np.array([self._known(self._scores(run, seed)) for seed in self.seeds], dtype=np.float64)

    def _scores(self, run: Run, seed: int) -> list[float | None]:
        return read_json(self.runs.evaluation(seed, run, self.split))["per_scene"]["realism"]


def summarise_experiment(cfg: DictConfig, scenes: Mapping[str, Any], chosen: Chosen, stages: Stages) -> dict[str, Any]:
    """The content of ``experiments/<name>.json``.

    ``rows`` and ``paired`` compare at the common decoding, and show the reference at the others of the grid beside
    them: sharper sampling alone can pass for alignment. ``own_best`` compares every method at its own best decoding
    with the reference at its own. ``tuning`` holds every method at every decoding, on the tuning scenes; nothing of a
    method that had one checkpoint and one decoding.

    Args:
        cfg: of the experiment.
        scenes: number of each split, and ``source``.
        chosen: what stands for each method, the reference first.
        stages: that were run, with their account.
    """
    experiment, methods = plain(cfg.experiment), list(chosen.best)
    common, grid = decoding_at(cfg.decoding.common), [decoding_at(each) for each in cfg.decoding.grid]
    at_common, at_best = list(chosen.common.items()), list(chosen.best.items())
    others = [(REFERENCE, Run(REFERENCE, each)) for each in grid if each != common]
    results = Results(cfg, [*at_common, *others, *at_best])
    standard = experiment["versus"] or experiment["headline"]
    tried = [(method, run._replace(decoding=each)) for method, run in at_best for each in grid]
    rivals = [run for run in at_best if run[0] not in (REFERENCE, standard)]
    account = read_account(trained_in(cfg).stages)
    return {name: experiment[name] for name in TOLD} | {
        "versus": standard,
        "metric": str(cfg.evaluation.metric),
        "scenes": dict(scenes),
        "seeds": list(cfg.seeds),
        "methods": methods,
        "labels": labels(cfg, methods),
        "steps": {
            "common": {method: steps_of(cfg, run.policy) for method, run in at_common},
            "own_best": {method: steps_of(cfg, run.policy) for method, run in at_best},
        },
        "common": [common.top_p, common.temperature],
        "chosen": {method: [run.decoding.top_p, run.decoding.temperature] for method, run in at_best},
        "left_out": results.known.count(False),
        "rows": results.rows(at_common + others),
        "paired": results.paired(at_common[1:] + others, at_common[0]),
        "own_best": {
            "rows": results.rows(at_best),
            "paired": results.paired(at_best[1:], at_best[0]),
            "versus": results.paired(rivals, (standard, chosen.best[standard])),
        },
        "tuning": results.tuning([shown for shown in tried if shown[1] in chosen.tuned]),
        "likelihood": [results.likelihood(method, run.policy, seed) for method, run in at_best for seed in cfg.seeds],
        "curves": {
            method: {str(seed): results.runs.relative(results.runs.training(seed, method)) for seed in cfg.seeds}
            for method in cfg.methods
        },
        "budget": {method: budget(cfg, method) for method in cfg.methods},
        "compute": {method: compute(cfg, method, account) for method in cfg.methods},
        "stages": stages.seconds,
        "worker_seconds": sum(stages.seconds.values()),
        "config": plain(cfg),
    }


def budget(cfg: DictConfig, method: str) -> dict[str, Any]:
    """What one method takes in, with the runs that it goes on from and the expert that it learns from.

    Returns:
        ``steps``, ``rollouts`` (read in these steps) and ``start``.
    """
    runs = behind(cfg, method)
    return {
        "steps": sum(steps_of(cfg, run) for run in runs),
        "rollouts": sum(steps_of(cfg, run) * _read_in_step(cfg, run) for run in runs),
        "start": setup_of(cfg, method).start,
    }


def compute(cfg: DictConfig, method: str, account: Mapping[str, Mapping[str, float]]) -> dict[str, float]:
    """Seconds of one method after the reference, one job at a time, means over seeds: rolling out, ranking, training.

    Runs that it goes on from and the expert that it learns from count; what methods share counts for each of them.

    Args:
        cfg: of the experiment.
        method: of it.
        account: of the stages, see :class:`~recipes.experiment.stages.Stages`.

    Returns:
        ``before`` the training can begin, for all that was rolled out and ranked for it or trained to start from, and
        ``training``, which of a method that rolls out by itself holds its rollouts and their ranking; ``steps`` of it.
    """
    earlier = set()
    for run in behind(cfg, method):
        setup = setup_of(cfg, run)
        if cfg.methods[run].data.kind not in ON_POLICY:
            rolled = {f"collect {{seed}} train {source}" for source in {setup.start, setup.expert} - {None}}
            ranked = cfg.methods[run].data.kind in RANKED and setup.ranking is None
            stages = ("collect", "rank") if ranked else ("collect",)
            earlier |= {(stage, job) for stage in stages for job in rolled}
        if setup.ranking is not None:
            earlier.add(("rank", f"rank {{seed}} {setup.start} {setup.ranking}"))
        if run != method:
            earlier.add(("align", f"align {{seed}} {run}"))

    def mean(stage: str, job: str) -> float:
        done, names = account.get(stage, {}), [job.format(seed=seed) for seed in cfg.seeds]
        if stage == "rank":  # where other processes rank while they collect, it is in the time of the collection
            return fmean(done.get(name, 0.0) for name in names)
        return fmean(done[name] for name in names)

    before = sum(mean(*each) for each in sorted(earlier))
    training = mean("align", f"align {{seed}} {method}")
    return {"before": before, "training": training, "steps": steps_of(cfg, method)}


def _read_in_step(cfg: DictConfig, method: str) -> int:
    """Rollouts that a step of a method reads."""
    options, data = setup_of(cfg, method).merged(cfg.alignment), cfg.methods[method].data
    held = num_candidates(data, cfg.collection.num_rollouts)
    # A step reads all that it has rolled out, or all of its pairs; the preferred side of AFD is logs.
    drawn = held if data.kind in ROLLED else num_drawn(*held, options.pairs_per_scene)
    return options.scenes_per_step * sum(drawn[1:] if data.kind == "adversarial" else drawn)


def steps_of(cfg: DictConfig, policy: str) -> int:
    """Steps of alignment behind a policy; those of what it started from are not counted."""
    method, _, step = policy.partition(SNAPSHOT)
    if method == REFERENCE:
        return 0
    return int(step) if step else setup_of(cfg, method).merged(cfg.alignment).steps


def labels(cfg: DictConfig, policies: Iterable[str]) -> dict[str, str]:
    """How tables call methods; a snapshot is called by its step."""
    given = plain(cfg.experiment.labels)
    named = {policy: given.get(method_of(policy), method_of(policy)) for policy in policies}
    return {
        policy: name + policy.removeprefix(method_of(policy)).replace(SNAPSHOT, " @ ") for policy, name in named.items()
    }
