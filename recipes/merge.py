"""Parts of an experiment that ran apart, put together: other seeds on other machines, or methods that came later.

    python -m recipes.merge OUT PART PART ...

PART is the folder that recipes.compare fills (its output), or an archive of one (recipes.report RUNS part.zip). OUT is
a new folder as an archive unpacks to: results of every scene, options and curves, without weights, scenes and rollouts.
Every method must be there for every seed. Nothing is run: differences and intervals are computed again from the values
of all scenes. Where parts differ in what may differ (title, grid of decodings, the decoding that stands for a method)
the first one that has it decides, so that no decoding is chosen by what came later.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
import zipfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import combinations, product
from pathlib import Path
from typing import Any, NamedTuple

from omegaconf import DictConfig, OmegaConf

from dpa.report.archive import files_of
from dpa.report.cards import KEPT, read_preference_cards
from dpa.report.experiment import Experiment, decoding_of, read_experiment, read_json
from dpa.report.table import REFERENCE
from envs.files import write_json
from envs.options import differences
from recipes.alignment.inputs import OBSERVING
from recipes.common.cli import refused
from recipes.common.provenance import provenance
from recipes.compare import adopt_policies, made_by, measure, train_policies
from recipes.experiment.jobs import evaluate_job, references_of, runs_of
from recipes.experiment.logged import log_experiment
from recipes.experiment.pool import Job
from recipes.experiment.runs import Run, RunFolder
from recipes.experiment.stages import Stages, origins_beside, read_account
from recipes.experiment.summary import Chosen, chosen_in, decoding_at, policy_of, summarise_experiment

METHODS = ("methods", "rankings", "experiment.setup", "experiment.labels", "experiment.published")
"""Options by method or by ranking: parts agree in those that they share."""
APART = (
    "seeds", "reference", "trained", "output", "only", "scenes", "threads", "workers", "device", "logger", "pictures",
    "decoding.grid", "decoding.chosen", *(f"alignment.{name}" for name in OBSERVING),
    "collection.workers", "collection.memory", "collection.compile", "collection.chunk_scenes",
    "collection.ranking.threads", "evaluation.memory",
    "experiment.name", "experiment.title", "experiment.question", "experiment.paper", "experiment.headline",
    "experiment.versus", "experiment.axis",
)  # fmt: skip
"""Options that parts may differ in; what their scenes are is told by the cards of them."""


class Part(NamedTuple):
    """What ran apart.

    Attributes:
        name: as it was given.
        runs: its folder.
        found: by its experiment.
    """

    name: Path
    runs: RunFolder
    found: Experiment


class Recorded:
    """Stands for workers where all work is done: every job must be in the account.

    Args:
        account: ``{stage: {job: seconds}}``.
    """

    def __init__(self, account: Mapping[str, Mapping[str, float]]) -> None:
        self.account = account

    def run(self, jobs: Sequence[Job], name: str) -> Iterator[tuple[str, float, dict[str, float]]]:
        """Name of each job, and the other stages that it spent time on."""
        for job in jobs:
            stages = [stage for stage, done in self.account.items() if job.name in done]
            if name not in stages:
                raise ValueError(f"no part has done {job.name!r} ({name}); each needs every method for all its seeds.")
            yield job.name, 0.0, {stage: 0.0 for stage in stages if stage != name}


def merge(out: Path, parts: Sequence[Path], name: str | None = None, trained: Path | None = None) -> Path:
    """Put an experiment together.

    Args:
        out: new folder.
        parts: folders or archives; which comes first is told above.
        name: of the experiment in each part; by default the only one that is there.
        trained: where the same parts of the trainings were put together, for parts whose policies were trained
            elsewhere.

    Returns:
        ``experiments/<name>.json`` of ``out``.

    Raises:
        ValueError: parts of other scenes, options or policies; a seed or a method that a part lacks; ``out`` holds
            something. Nothing is left then.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ValueError(f"{out} is there already; name a new folder, or remove it.")
    with _opened(parts, name) as opened, _made_whole(out):
        _check_alike(opened)
        cfg = merged_config(opened, out, trained)
        runs = runs_of(cfg)
        _gather(opened, runs)
        made = provenance("merge", "cpu")
        stages = Stages(Recorded(read_account(runs.stages)), runs.stages, made)
        chosen, tuning = chosen_first(opened), _tuning(opened)
        _check_whole(cfg, chosen)
        (train_policies if cfg.trained is None else adopt_policies)(cfg, stages)
        tried = [(row["seed"], policy_of(row), "tune", *decoding_of(row)) for row in tuning]
        stages.run("tune", evaluate_job, cfg, tried)
        measure(cfg, stages, chosen)
        found = summarise_experiment(cfg, opened[0].found.scenes, chosen, stages) | made_by(cfg, stages)
        command = "\n".join([*dict.fromkeys(part.found.command for part in opened), made["command"]])
        write_json(runs.experiment(cfg.experiment.name), found | {"tuning": tuning, "command": command})
        log_experiment(cfg, read_experiment(runs.experiment(cfg.experiment.name)), {})
    return runs.experiment(cfg.experiment.name)


def merged_config(parts: Sequence[Part], output: Path, trained: Path | None) -> DictConfig:
    """Options of the whole: those of the first part, with all seeds, references and methods.

    Raises:
        ValueError: parts whose policies were trained elsewhere without ``trained``, or the other way round.
    """
    elsewhere = {part.found.config["trained"] for part in parts} - {None}
    if elsewhere and trained is None:
        raise ValueError(
            f"the policies were trained in {', '.join(sorted(elsewhere))}; put those together first and say --trained."
        )
    if trained is not None and not elsewhere:
        raise ValueError(f"--trained {trained}: these parts have trained their policies themselves; leave it out.")
    cfg = OmegaConf.create(dict(parts[0].found.config))
    for each in METHODS:
        OmegaConf.update(cfg, each, _first(_select(part.found.config, each) for part in parts), merge=False)
    cfg.experiment.axis = _axis([part.found.config["experiment"]["axis"] for part in parts])
    cfg.logger.backend, cfg.logger.mode = "csv", "offline"  # what a part logged to need not be on this machine
    starts = _first(references_of(part.found.config) for part in parts)
    cfg.seeds = sorted(starts)
    cfg.reference = None if None in starts.values() else [starts[seed] for seed in cfg.seeds]
    if "only" in cfg:  # which archives of earlier versions do not have
        cfg.only = None
    cfg.output, cfg.trained = str(output), None if trained is None else str(trained)
    return cfg


def chosen_first(parts: Sequence[Part]) -> Chosen:
    """What stands for each method in the first part that has it."""
    each = [chosen_in(part.found) for part in parts]
    common, best = _first(chosen.common for chosen in each), _first(chosen.best for chosen in each)
    return Chosen(common=common, best=best, tuned=frozenset())


def _first(each: Iterable[Mapping[Any, Any]]) -> dict[Any, Any]:
    """All entries in the order of the parts; of those with one name that of the first part."""
    union: dict[Any, Any] = {}
    for entries in each:
        union |= {name: entry for name, entry in entries.items() if name not in union}
    return union


def _tuning(parts: Sequence[Part]) -> list[Mapping[str, Any]]:
    """Rows of the tuning scenes, each once, in the order of tables."""
    rows = _first({row["file"]: row for row in part.found.tuning} for part in parts).values()
    methods = list(dict.fromkeys(method for part in parts for method in part.found.methods))
    tried = list(dict.fromkeys(decoding_of(row) for part in parts for row in part.found.tuning))
    return sorted(rows, key=lambda row: (methods.index(row["method"]), tried.index(decoding_of(row)), row["seed"]))


@contextmanager
def _opened(given: Sequence[Path], name: str | None) -> Iterator[list[Part]]:
    """The parts, archives unpacked for as long as the block runs."""
    with tempfile.TemporaryDirectory() as unpacked:
        parts = []
        for place, path in enumerate(given):
            folder = path
            if path.is_file():
                folder = Path(unpacked, str(place))
                if not zipfile.is_zipfile(path):
                    raise ValueError(f"{path} is no archive; name a folder of results, or a .zip of recipes.report.")
                with zipfile.ZipFile(path) as archive:
                    archive.extractall(folder)
            parts.append(Part(path, RunFolder(folder), _experiment(path, folder, name)))
        yield parts


def _experiment(path: Path, folder: Path, name: str | None) -> Experiment:
    there = sorted(each.stem for each in (folder / "experiments").glob("*.json"))
    if not there:
        raise ValueError(f"{path} holds no experiments/*.json; name the output of a recipes.compare that has finished.")
    if (name is None and len(there) > 1) or name not in (None, *there):
        raise ValueError(f"{path} has the experiments {', '.join(there)}; say --experiment with one of them.")
    return read_experiment(RunFolder(folder).experiment(name or there[0]))


@contextmanager
def _made_whole(out: Path) -> Iterator[None]:
    """A new folder, which goes again if the block fails."""
    out.mkdir(parents=True, exist_ok=True)
    try:
        yield
    except BaseException:
        shutil.rmtree(out)
        raise


def _check_alike(parts: Sequence[Part]) -> None:
    """Same scenes, same options beside :data:`APART`, and same options of what the parts share by name."""
    first = parts[0]
    for part in parts[1:]:
        both = f"{part.name} and {first.name} cannot be put together"
        theirs, ours = (read_json(each.runs.scenes)["options"] for each in (first, part))
        if differ := differences(theirs, ours):
            raise ValueError(f"{both}: they are of other scenes ({differ}).")
        if (first.found.metric, first.found.split) != (part.found.metric, part.found.split):
            raise ValueError(f"{both}: they report another metric or split.")
        if differ := differences(_shared(first.found.config), _shared(part.found.config)):
            raise ValueError(f"{both}: they ran with other options ({differ}).")
    for (earlier, part), each in product(combinations(parts, 2), METHODS):
        theirs, ours = (_select(side.found.config, each) for side in (earlier, part))
        both = theirs.keys() & ours.keys()
        if differ := differences(*({name: side[name] for name in both} for side in (theirs, ours))):
            raise ValueError(f"{each} differs between {earlier.name} and {part.name}: {differ}.")


def _shared(config: Mapping[str, Any]) -> dict[str, Any]:
    """Options that all parts must have alike; those of pre-training where an experiment has trained its references."""
    kept = OmegaConf.create(dict(config))
    unused = () if config["reference"] is None else ("pretraining",)
    for name in (*APART, *METHODS, *unused):
        section, _, key = name.rpartition(".")
        (OmegaConf.select(kept, section) if section else kept).pop(key, None)
    return OmegaConf.to_container(kept)


def _select(config: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    for key in name.split("."):
        config = config[key]
    return config


def _axis(each: Sequence[Mapping[str, Any] | None]) -> Mapping[str, Any] | None:
    """The axis of the first part, with the places that parts of the same axis have on it."""
    first = each[0]
    if first is None:
        return None
    same = [axis for axis in each if axis and all(axis[key] == first[key] for key in ("name", "log"))]
    return {**first, "values": _first(axis["values"] for axis in same)}


def _gather(parts: Sequence[Part], runs: RunFolder) -> None:
    """Results of all parts in one folder, with one account of what they took and one of what made them.

    Raises:
        ValueError: two parts have a result of the same name by another policy, other scenes or other options.
    """
    account: dict[str, dict[str, float]] = {}
    origins: dict[str, Any] = {"made": [], "jobs": {}}
    for part in parts:
        for file in files_of(part.runs.root):
            relative = file.relative_to(part.runs.root)
            if relative.parts[0].startswith("seed_"):
                _take(file, runs.root / relative, part)
        theirs = read_json(origins_beside(part.runs.stages))
        origins["made"] += [each for each in theirs["made"] if each not in origins["made"]]
        for stage, jobs in read_account(part.runs.stages).items():
            kept, signed = account.setdefault(stage, {}), origins["jobs"].setdefault(stage, {})
            for job in jobs.keys() - kept.keys():
                kept[job] = jobs[job]
                if (place := theirs["jobs"].get(stage, {}).get(job)) is not None:
                    signed[job] = origins["made"].index(theirs["made"][place])
    shutil.copyfile(parts[0].runs.scenes, runs.scenes)
    write_json(runs.stages, account)
    write_json(origins_beside(runs.stages), origins)
    cards = _first(read_preference_cards(part.runs.root) for part in parts)
    write_json(runs.root / KEPT, {name: card.to_json() for name, card in cards.items()})


def _take(file: Path, place: Path, part: Part) -> None:
    """Copy a result, or find it there alike: made with the same options from the same weights and scenes."""
    if not place.is_file():
        place.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(file, place)
        return
    if file.suffix != ".json":
        return
    theirs, ours = (content.get("options", {}) for content in map(read_json, (place, file)))
    if differ := differences(theirs, ours):
        raise ValueError(
            f"{part.name}: {file.relative_to(part.runs.root)} is in an earlier part with other options ({differ}); "
            "leave this seed or this method out of one of the two."
        )


def _check_whole(cfg: DictConfig, chosen: Chosen) -> None:
    """Every result that the tables are made of is there, of scenes that are called alike."""
    runs, split, called = runs_of(cfg), cfg.experiment.split, {}
    grid = {Run(REFERENCE, decoding_at(each)) for each in cfg.decoding.grid}
    for seed in cfg.seeds:
        needed = [runs.evaluation(seed, run, split) for run in {*chosen.common.values(), *chosen.best.values(), *grid}]
        needed += [runs.likelihood(seed, run.policy, split) for run in chosen.best.values()]
        for path in sorted(needed):
            if not path.is_file():
                raise ValueError(
                    f"no part has {runs.relative(path)}; each method must be there for each seed, with the snapshot "
                    "and at the decoding that the first part that has it chose (decoding.chosen)."
                )
            called.setdefault(tuple(read_json(path)["scenes"]), path)
    if len(called) > 1:
        one, other = (runs.relative(path) for path in list(called.values())[:2])
        raise ValueError(f"{one} and {other} call their scenes by other names; number scenes in all parts or in none.")


def make_parser() -> argparse.ArgumentParser:
    """Arguments of the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m recipes.merge", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", metavar="OUT", type=Path, help="new folder")
    parser.add_argument("parts", metavar="PART", type=Path, nargs="+", help="folder of results, or an archive of one")
    parser.add_argument("--experiment", metavar="NAME", help="in parts that have several")
    parser.add_argument(
        "--trained", metavar="RUNS", type=Path, help="where the trainings of these parts were put together"
    )
    return parser


def main() -> None:
    """Entry point of ``python -m recipes.merge``."""
    given = make_parser().parse_args()
    try:
        print(merge(given.out, given.parts, given.experiment, given.trained))
    except (ValueError, OSError) as error:
        sys.exit(refused(error))


if __name__ == "__main__":
    main()
