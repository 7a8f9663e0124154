"""What alignment gains against how good its reference is: finished comparisons side by side.

    python -m recipes.gains 'name=[competent,families]' 'runs=[runs/driving,runs/smart]' 'methods=[dpa_omf]'

Of each comparison its reference, with family, tokens and size of its policy where that is there, and the gain of some
methods, best decoding against best, with the intervals of the comparison itself; and these gains minus those of the
first of the runs, where the scenes are the same. Nothing is run. ``gains.md`` beside the figure has the tables for a
document.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import hydra
from numpy.typing import NDArray
from omegaconf import DictConfig, ListConfig

from dpa.report.experiment import Comparison, Experiment, decoding_of, read_experiment, read_json
from dpa.report.paired import paired_values, scene_values
from dpa.report.statistics import Interval, summary, unpaired_bootstrap
from dpa.report.studies import plot_gains
from dpa.report.study import Evaluations
from dpa.report.table import to_markdown
from recipes.common.cli import CONFIG, study_recipe
from recipes.common.models import num_parameters, open_policy
from recipes.studies.tables import Cell, StudyTable, tell


def read(runs: Path, name: str, methods: list[str]) -> Experiment:
    """Read a comparison.

    Raises:
        ValueError: there is none of this name, or it lacks a method.
    """
    path = runs / "experiments" / f"{name}.json"
    if not path.is_file():
        raise ValueError(f"{runs} has no experiment {name!r}: finish it with recipes.compare, or name another one.")
    experiment = read_experiment(path)
    for method in methods:
        if experiment.own_best.entry(method) is None:
            compared = ", ".join(entry["method"] for entry in experiment.own_best.paired)
            raise ValueError(f"{path} does not compare {method!r} with its reference; it has {compared}.")
    return experiment


def realism_of_reference(comparison: Comparison, folder: Path) -> Interval:
    """Of all seeds and scenes, at the decoding that the others are compared with.

    Raises:
        ValueError: the values of its scenes are not there.
    """
    rows = comparison.base()
    values = scene_values([rows], ["realism"], Evaluations(folder))
    if values is None:
        files = ", ".join(row["file"] for row in rows)
        raise ValueError(f"{folder} lacks values of its reference's scenes; the realism of all is in {files}.")
    return summary(values[0, 0])


def gain_of(comparison: Comparison, method: str) -> Interval:
    """Realism of a method minus that of its reference, as the comparison has it."""
    entry = comparison.entry(method)
    rows = comparison.of(method, decoding_of(entry))
    scenes = rows[0]["n_scenes"]
    return Interval(entry["realism_difference"], *entry["ci95"], entry["over"], entry["n_seeds"], scenes)


def less(found: Sequence[tuple[Path, Experiment]], methods: Sequence[str]) -> dict[str, list[Interval | None]]:
    """Gains of all comparisons but the first minus those of the first, a row for each.

    Args:
        found: comparisons with their folders.
        methods: whose gains, in order.

    Returns:
        By the name of the folder; None where a gain is not known in every scene, or is of other scenes (whatever they
        are called), another number of rollouts or another metric.
    """

    def gains(folder: Path, comparison: Comparison) -> tuple[dict[str, Any], list[NDArray | None]]:
        """Scenes, rollouts and metric, and of each method its gain ``[seeds, scenes]``."""
        evaluations, base = Evaluations(folder), comparison.base()
        rows = [comparison.of(method, decoding_of(comparison.entry(method))) for method in methods]
        both = [paired_values(mine, base, "realism", evaluations) for mine in rows]
        result = read_json(folder / base[0]["file"])
        known = [values is not None and values.shape[-1] == len(result["scenes"]) for values in both]
        measured = {name: result["options"][name] for name in ("scenes", "evaluation")}
        return measured, [each[0] - each[1] if told else None for each, told in zip(both, known, strict=True)]

    (alike, first), *others = (gains(folder, experiment.own_best) for folder, experiment in found)
    return {
        folder.name: [
            None if measured != alike or mine is None or base is None else unpaired_bootstrap(mine, base)
            for mine, base in zip(other, first, strict=True)
        ]
        for (folder, _), (measured, other) in zip(found[1:], others, strict=True)
    }


def about(experiment: Experiment, folder: Path) -> list[Cell]:
    """Family, tokens with the size of their vocabulary, and millions of parameters of the policies that were compared.

    None each where their files are elsewhere.
    """
    policy = folder / f"seed_{experiment.seeds[0]}" / "reference" / "policy.pt"
    if not policy.is_file():  # an archive has no weights, but may name a policy of the zoo
        named = experiment.config.get("reference")
        policy = named[0] if isinstance(named, list) else named
        if not str(policy).startswith("zoo:"):
            return [None, None, None]
    model, _, config = open_policy(policy, "cpu")
    size = model.tokenizer.vocab_size
    tokens = f"{config['tokenizer']['name']}, {size}" if size else config["tokenizer"]["name"]
    return [config["family"], tokens, num_parameters(model) / 1e6]


def names_of(name: str | ListConfig, runs: Sequence[str]) -> list[str]:
    """The experiment of each of the runs: one for all, or one for each.

    Raises:
        ValueError: another number of names.
    """
    names = [name] * len(runs) if isinstance(name, str) else list(name)
    if len(names) != len(runs):
        raise ValueError(f"name={names} must be one name for all, or one for each of runs={list(runs)}.")
    return names


@hydra.main(**CONFIG, config_name="gains")
@study_recipe
def main(cfg: DictConfig) -> None:
    """Entry point of ``python -m recipes.gains``."""
    methods, output = list(cfg.methods), Path(cfg.output)
    if not cfg.runs or not methods:
        raise ValueError(f"runs={list(cfg.runs)} and methods={methods} must name one or more each.")
    names = names_of(cfg.name, cfg.runs)
    found = [(Path(runs), read(Path(runs), name, methods)) for runs, name in zip(cfg.runs, names, strict=True)]
    if len(metrics := {experiment.metric: folder for folder, experiment in found}) > 1:
        told = ", ".join(f"{folder} of {metric}" for metric, folder in metrics.items())
        raise ValueError(
            f"gains are told by one metric, and here realism is {told}; leave the runs of one of them out."
        )
    labels = {method: found[0][1].labels[method] for method in methods}
    rows: dict[str, list[Cell]] = {}
    competence, gains = {}, {label: {} for label in labels.values()}
    for folder, experiment in found:
        best, name = experiment.own_best, folder.name
        if name in rows:
            raise ValueError(f"two of the runs are called {name!r}; rename a folder: they are told by their names.")
        competence[name] = realism_of_reference(best, folder)
        for method, label in labels.items():
            gains[label][name] = gain_of(best, method)
        told = [gains[label][name] for label in labels.values()]
        rows[name] = [*about(experiment, folder), str(len(experiment.seeds)), competence[name], *told]
    output.mkdir(parents=True, exist_ok=True)
    plot_gains(competence, gains, output / "gains.png")
    reported = ", ".join(dict.fromkeys(f"{each.reported} of {each.scenes['source']}" for _, each in found))
    columns = [f"gain of {label}" for label in labels.values()]
    known = ["runs", "family", "tokens", "parameters [M]", "seeds", "realism of the reference"]
    tables = [StudyTable("gains", f"{reported}; best decoding against best", [*known, *columns], rows, signed=False)]
    if minus := less(found, methods):
        tables.append(StudyTable("gains_minus_first", f"minus those of {found[0][0].name}", ["runs", *columns], minus))
    tell(cfg, tables, {"gains": output / "gains.png"})
    told = "\n\n".join(to_markdown(table.columns, table.printed()) for table in tables)
    (output / "gains.md").write_text(told + "\n", encoding="utf-8")
    print(f"figure: {output / 'gains.png'}\ntables for a document: {output / 'gains.md'}")


if __name__ == "__main__":
    sys.exit(main())
