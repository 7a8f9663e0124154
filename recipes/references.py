"""Pre-trainings side by side: what more steps, scenes and parameters give.

    python -m recipes.references 'policies=[runs/nano_*/policy.pt,zoo:motionlm-paper-sumo]'

Of each training its options, its hours, the likelihood that it came to and how its policy drives; and a figure of all
curves, with realism against likelihood. The cards of the zoo have no curves, only where they end. Run the same command
again to go on after a kill: policies that are scored are read back.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import hydra
from omegaconf import DictConfig

from dpa import zoo
from dpa.models import Decoding
from dpa.report.experiment import read_json
from dpa.report.statistics import summary
from dpa.report.studies import plot_references
from dpa.training.loggers import read_curve
from dpa.training.run import seconds_trained
from recipes.common.cli import CONFIG, build, study_recipe
from recipes.common.models import given_policies, num_parameters, open_policy
from recipes.common.scenes import open_splits
from recipes.evaluate import evaluate
from recipes.studies.tables import Cell, StudyTable, tell

NLL = "tune/nll"
FIGURES = {
    "collision_rate": "collision",
    "offroad_rate": "off-road",
    "min_ade": "minADE [m]",
    "wrong_way": "wrong way",
}
"""Figures of the table beside realism, means over scenes, and their titles."""
COLUMNS = ["parameters [M]", "1,000 scenes", "1,000 steps", "rate", "hours", "tuning NLL", "realism", *FIGURES.values()]


@dataclass(frozen=True)
class Training:
    """What is told of a pre-training, by its folder or by its card in the zoo.

    Attributes:
        options: of the section ``pretraining``.
        scenes: that it learnt from; None where an earlier training did not say.
        hours: of its steps.
        curve: ``(step, NLL of the tuning scenes)``, of a card the end alone.
    """

    options: dict[str, Any]
    scenes: int | None
    hours: float
    curve: list[tuple[int, float]]

    @classmethod
    def of(cls, policy: Path) -> Training:
        """Read what made a policy.

        Raises:
            OSError: its folder has no result or no curves of a pre-training.
        """
        folder = policy.parent
        if folder.parent == zoo.FOLDER:
            card = zoo.card(folder.name)
            options = card["options"]["pretraining"]
            return cls(options, card["num_scenes"], card["hours"], [(options["steps"], card["tune_nll"])])
        curve, told = read_curve(folder, NLL), read_json(folder / "result.json")
        return cls(told["options"]["pretraining"], told.get("num_scenes"), seconds_trained(folder) / 3600, curve)


def measured(training: Training, result: dict[str, Any], parameters: int) -> list[Cell]:
    """The row of one training: what it was, how far it came, and how its policy drives.

    Args:
        training: of the policy.
        result: what :func:`~recipes.evaluate.evaluate` gives for it.
        parameters: of the model.
    """
    realism = [value for value in result["per_scene"]["realism"] if value is not None]
    return [
        parameters / 1e6,
        None if training.scenes is None else training.scenes / 1e3,
        training.options["steps"] / 1e3,
        training.options["lr"],
        training.hours,
        min(value for _, value in training.curve),
        summary([realism]) if realism else None,
        *(result["mean"][figure] for figure in FIGURES),
    ]


@hydra.main(**CONFIG, config_name="references")
@study_recipe
def main(cfg: DictConfig) -> None:
    """Entry point of ``python -m recipes.references``."""
    policies = given_policies(cfg)
    trainings = {name: Training.of(path) for name, path in policies.items()}
    scenes = open_splits(cfg.scenes)[cfg.split]
    rows, output, decoding = {}, Path(cfg.output), build(Decoding, cfg.decoding, "decoding")
    for name, path in policies.items():
        result = evaluate(cfg, scenes, path, decoding, cfg.seed, output / f"{name.replace('/', '_')}.json")
        parameters = num_parameters(open_policy(path, cfg.device)[0])
        rows[name] = measured(trainings[name], result, parameters)
    realism = {name: row[COLUMNS.index("realism")] for name, row in rows.items()}
    curves = {name: training.curve for name, training in trainings.items()}
    plot_references(curves, realism, output / "references.png")
    table = StudyTable("references", f"{len(scenes)} scenes", ["training", *COLUMNS], rows, signed=False)
    tell(cfg, [table], {"references": output / "references.png"})
    print(f"figure: {output / 'references.png'}")


if __name__ == "__main__":
    sys.exit(main())
