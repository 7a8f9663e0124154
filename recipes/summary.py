"""From the results of all runs to what an experiment found."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from omegaconf import DictConfig

from dpa.policy import Decoding
from dpa.report.experiment import read_json
from dpa.report.statistics import compare_methods
from dpa.report.table import REFERENCE
from recipes.candidates import SIDES
from recipes.cli import plain
from recipes.evaluate import SCENE_FIGURES
from recipes.jobs import runs_of
from recipes.likelihoods import PROBED
from recipes.methods import setup_of
from recipes.runs import SNAPSHOT, method_of
from recipes.scenes import Splits

TOLD = ("name", "title", "paper", "question", "headline", "axis", "split", "published")
"""What an experiment says of itself."""
Run = tuple[str, Decoding]
"""A method at a decoding."""


class Results:
    """Reads the results of an experiment's runs.

    Args:
        cfg: of the experiment.
        policies: method -> the policy that stands for it.
    """

    def __init__(self, cfg: DictConfig, policies: Mapping[str, str]) -> None:
        self.runs, self.policies, self.seeds = runs_of(cfg), policies, list(cfg.seeds)
        self.split = cfg.experiment.split

    def row(self, method: str, decoding: Decoding, seed: int, split: str) -> dict[str, Any]:
        """Means of one run, and the file with the values of every scene."""
        path = self.runs.evaluation(seed, self.policies[method], split, decoding)
        found = read_json(path)
        return {
            "method": method,
            "seed": seed,
            "top_p": decoding.top_p,
            "temperature": decoding.temperature,
            "file": self.runs.relative(path),
            "n_scenes": len(found["scenes"]),
            **{name: found["mean"][name] for name in SCENE_FIGURES},
        }

    def rows(self, chosen: list[Run], split: str) -> list[dict[str, Any]]:
        """Of several runs, each for all seeds."""
        return [self.row(method, decoding, seed, split) for method, decoding in chosen for seed in self.seeds]

    def likelihood(self, method: str, seed: int) -> dict[str, Any]:
        """What a policy thinks of logs and rollouts of the reported scenes."""
        path = self.runs.likelihood(seed, self.policies[method], self.split)
        mean = read_json(path)["mean"]
        return {
            "method": method,
            "seed": seed,
            "file": self.runs.relative(path),
            **{name: mean[name] for name in (*PROBED, "kl")},
        }

    def paired(self, chosen: list[Run], reference: Run) -> list[dict[str, Any]]:
        """Realism of each run minus that of a reference, by scene and seed, with intervals."""
        if not chosen:
            return []
        scores = {
            str(number): {str(seed): self._realism(*run, seed) for seed in self.seeds}
            for number, run in enumerate([reference, *chosen])
        }
        return [
            entry
            | {
                "method": method,
                "top_p": decoding.top_p,
                "temperature": decoding.temperature,
                "against": reference[0],
                "against_top_p": reference[1].top_p,
                "against_temperature": reference[1].temperature,
            }
            for (method, decoding), entry in zip(chosen, compare_methods(scores, "0"), strict=True)
        ]

    def leave_out(self, chosen: list[Run]) -> int:
        """Leave the scenes out for which some run has no realism, here and from now on; gives their number."""
        runs = [self._scores(*run, seed) for run in chosen for seed in self.seeds]
        self.known = [all(score is not None for score in scene) for scene in zip(*runs, strict=True)]
        return self.known.count(False)

    def _realism(self, method: str, decoding: Decoding, seed: int) -> list[float]:
        scores = self._scores(method, decoding, seed)
        return [score for score, known in zip(scores, self.known, strict=True) if known]

    def _scores(self, method: str, decoding: Decoding, seed: int) -> list[float | None]:
        return read_json(self.runs.evaluation(seed, self.policies[method], self.split, decoding))["per_scene"][
            "realism"
        ]


def summarise_experiment(
    cfg: DictConfig,
    splits: Splits,
    policies: Mapping[str, str],
    own: Mapping[str, Decoding],
    stages: Mapping[str, float],
) -> dict[str, Any]:
    """The content of ``experiments/<name>.json``.

    ``rows`` and ``paired`` compare at the common decoding, and show the reference at the others of the grid beside
    them: sharper sampling alone can pass for alignment. ``own_best`` compares every method at its own best decoding
    with the reference at its own. ``tuning`` holds every method at every decoding, on the tuning scenes.

    Args:
        cfg: of the experiment.
        splits: scenes.
        policies: method -> the policy that stands for it, the reference first.
        own: method -> its own best decoding.
        stages: worker-seconds of each stage.
    """
    results, experiment = Results(cfg, policies), plain(cfg.experiment)
    common, grid = Decoding(*cfg.decoding.common), [Decoding(*each) for each in cfg.decoding.grid]
    at_common = [(method, common) for method in policies]
    others = [(REFERENCE, each) for each in grid if each != common]
    at_best = [(method, own[method]) for method in policies]
    headline = (experiment["headline"], own[experiment["headline"]])
    rivals = [run for run in at_best if run[0] not in (REFERENCE, headline[0])]
    likelihood = [results.likelihood(method, seed) for method in policies for seed in cfg.seeds]
    accuracy = {(entry["method"], entry["seed"]): entry["pair_accuracy"] for entry in likelihood}
    left_out = results.leave_out(list(dict.fromkeys([*at_common, *others, *at_best])))

    def rows(chosen: list[Run]) -> list[dict[str, Any]]:
        found = results.rows(chosen, experiment["split"])
        return [row | {"pair_accuracy": accuracy[row["method"], row["seed"]]} for row in found]

    return {name: experiment[name] for name in TOLD} | {
        "metric": str(cfg.evaluation.metric),
        "scenes": {**splits.sizes(), "source": cfg.scenes.source},
        "seeds": list(cfg.seeds),
        "methods": list(policies),
        "labels": labels(cfg, policies),
        "policies": dict(policies),
        "common": [common.top_p, common.temperature],
        "chosen": {method: [decoding.top_p, decoding.temperature] for method, decoding in own.items()},
        "left_out": left_out,
        "rows": rows(at_common + others),
        "paired": results.paired(at_common[1:] + others, at_common[0]),
        "own_best": {
            "rows": rows(at_best),
            "paired": results.paired(at_best[1:], at_best[0]),
            "versus": results.paired(rivals, headline),
        },
        "tuning": results.rows([(method, each) for method in policies for each in grid], "tune"),
        "likelihood": likelihood,
        "curves": {
            method: {str(seed): results.runs.relative(results.runs.training(seed, method)) for seed in cfg.seeds}
            for method in cfg.methods
        },
        "budget": {method: budget(cfg, method) for method in cfg.methods},
        "stages": dict(stages),
        "worker_seconds": sum(stages.values()),
        "config": plain(cfg),
    }


def budget(cfg: DictConfig, method: str) -> dict[str, Any]:
    """What one training run of a method takes in, with the runs that it goes on from.

    Args:
        cfg: of the experiment.
        method: its name.

    Returns:
        ``steps``, ``rollouts`` (read in these steps) and ``start``.
    """
    setup, data = setup_of(cfg, method), cfg.methods[method].data
    options = setup.merged(cfg.alignment)
    sides = 1 if SIDES[data.kind] == "targets" else 2
    before = {"steps": 0, "rollouts": 0} if setup.start == REFERENCE else budget(cfg, setup.start)
    return {
        "steps": before["steps"] + options.steps,
        "rollouts": before["rollouts"] + options.steps * options.scenes_per_step * options.pairs_per_scene * sides,
        "start": setup.start,
    }


def labels(cfg: DictConfig, policies: Mapping[str, str]) -> dict[str, str]:
    """How tables call methods; a snapshot is called by its step."""
    given = plain(cfg.experiment.labels)
    named = {policy: given.get(method_of(policy), method_of(policy)) for policy in policies}
    return {
        policy: name + policy.removeprefix(method_of(policy)).replace(SNAPSHOT, " @ ") for policy, name in named.items()
    }
