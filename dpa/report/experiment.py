"""What one experiment found: its JSON, read and checked, so that a page is written from numbers that fit together."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dpa.report.table import REFERENCE, summarise

Decoding = tuple[float, float]
"""Top-p and temperature."""
NUMBER, NONE = (int, float), type(None)
ROW = {"method": str, "seed": int, "top_p": NUMBER, "temperature": NUMBER, "file": str, "n_scenes": int}
"""What identifies a row; every other entry is a figure: a number, or None where it was not measured."""
PAIRED = {
    "method": str, "top_p": NUMBER, "temperature": NUMBER, "against": str, "against_top_p": NUMBER,
    "against_temperature": NUMBER, "realism_difference": NUMBER, "ci95": list, "over": str, "n_seeds": int,
}  # fmt: skip
LIKELIHOOD = {"method": str, "seed": int, "file": str}
BUDGET = {"steps": int, "rollouts": int, "start": str}
AXIS = {"name": str, "values": dict, "log": bool}
SPLITS = {"train": "training", "tune": "tuning", "eval": "evaluation"}
"""What the scenes of a split are called."""
SAMPLED = {"own best": "each at its own best decoding", "common": "all at the common decoding"}
"""In what decodings an experiment compares its methods."""
REPORTED = ("eval", "tune")
"""Splits that an experiment may report."""


@dataclass(frozen=True)
class Comparison:
    """Methods beside the reference, each at one decoding.

    Attributes:
        rows: one for each method, decoding and seed; see :data:`ROW`.
        paired: realism of a method minus that of the reference, scene by scene; see :data:`PAIRED`.
        versus: realism of a method minus that of the experiment's ``versus``, likewise.
        steps: of alignment behind the policy that stands for each method, 0 for the reference.
    """

    rows: Sequence[Mapping[str, Any]]
    paired: Sequence[Mapping[str, Any]]
    versus: Sequence[Mapping[str, Any]] = ()
    steps: Mapping[str, int] = field(default_factory=dict)

    def records(self) -> list[dict[str, Any]]:
        """One record for each method and decoding: means over seeds; see :func:`~dpa.report.table.summarise`."""
        return summarise(self.rows, self.paired)

    def entry(self, method: str) -> Mapping[str, Any] | None:
        """The paired difference of a method, or None."""
        return next((entry for entry in self.paired if entry["method"] == method), None)

    def of(self, method: str, decoding: Decoding) -> list[Mapping[str, Any]]:
        """Rows of a method at a decoding, in order of seeds."""
        found = [row for row in self.rows if row["method"] == method and decoding_of(row) == decoding]
        return sorted(found, key=lambda row: row["seed"])

    def base(self) -> list[Mapping[str, Any]]:
        """Rows of the reference that the others are compared with; none where nothing is compared."""
        return [row for entry in self.paired[:1] for row in self.of(REFERENCE, decoding_against(entry))]


@dataclass(frozen=True)
class Axis:
    """What the methods of a scaling experiment differ in.

    Attributes:
        name: what stands on the axis.
        values: place of each method on it.
        log: the axis is logarithmic.
    """

    name: str
    values: Mapping[str, float]
    log: bool


@dataclass(frozen=True)
class Experiment:
    """The content of ``experiments/<name>.json``.

    Attributes:
        path: the file.
        name: of the experiment; that of its configuration.
        title: for people.
        paper: what it repeats of the paper; None where it repeats nothing.
        question: that it answers.
        metric: configuration of the realism metric.
        scenes: number of scenes of each split, and ``source``.
        split: that the numbers are of, ``eval`` or ``tune``.
        left_out: scenes of it that some run has no realism for; differences are over the others.
        seeds: of the training runs.
        methods: in the order of tables.
        labels: what the methods are called.
        published: the paper's figures of a method, where it has some.
        headline: method whose difference is the result; fixed before the numbers are known.
        versus: method that the others are compared with as well as with the reference.
        common: decoding of ``at_common``.
        chosen: each method's best decoding on the tuning scenes.
        at_common: all methods at the common decoding, the reference also at the others of the grid.
        own_best: each method at its chosen decoding, against the reference and ``versus`` at their own.
        tuning: rows of every method at every decoding of the grid, on the tuning scenes.
        likelihood: rows ``{"method", "seed", "file"}`` and figures of likelihood, on the reported scenes.
        axis: of a scaling experiment.
        curves: run folders by method and seed, relative to the folder of the study.
        budget: for each method that is trained the ``steps`` of one run (GRPO updates several times in one), the
            ``rollouts`` read in them, and the policy it ``start``s from; a further round counts those before it.
        compute: seconds of one run of a method, ``before`` its training and in the ``steps`` of ``training``; empty of
            older results.
        stages: worker-seconds of its own jobs, by stage.
        worker_seconds: of all of them.
        config: of the run.
        revision: commit of the code; None outside a repository.
        versions: of packages.
        machine: it ran on.
        date: it was finished.
        command: that makes it; of one that was put together those of its parts as well, each in a line.
    """

    path: Path
    name: str
    title: str
    paper: str | None
    question: str
    metric: str
    scenes: Mapping[str, Any]
    split: str
    left_out: int
    seeds: Sequence[int]
    methods: Sequence[str]
    labels: Mapping[str, str]
    published: Mapping[str, Mapping[str, float]]
    headline: str
    versus: str
    common: Decoding
    chosen: Mapping[str, Decoding]
    at_common: Comparison
    own_best: Comparison
    tuning: Sequence[Mapping[str, Any]]
    likelihood: Sequence[Mapping[str, Any]]
    axis: Axis | None
    curves: Mapping[str, Mapping[str, str]]
    budget: Mapping[str, Mapping[str, Any]]
    compute: Mapping[str, Mapping[str, float]]
    stages: Mapping[str, float]
    worker_seconds: float
    config: Mapping[str, Any]
    revision: str | None
    versions: Mapping[str, str]
    machine: str
    date: str
    command: str

    @property
    def put_together(self) -> bool:
        """Its parts ran apart, so that its policies are elsewhere."""
        return len(self.command.splitlines()) > 1

    @property
    def reported(self) -> str:
        """The scenes that the numbers are of, such as ``54 evaluation scenes``."""
        return f"{self.scenes[self.split]} {SPLITS[self.split]} scenes"

    @property
    def num_rollouts(self) -> int:
        """Rollouts of each scene behind the numbers: of the tuning scenes those by which decodings are chosen."""
        return self.config["decoding" if self.split == "tune" else "evaluation"]["num_rollouts"]

    def comparisons(self) -> dict[str, Comparison]:
        """What to show, by how methods were sampled; one comparison where all had one decoding: both are that one."""
        rows = (*self.at_common.rows, *self.own_best.rows)
        if len({decoding_of(row) for row in rows}) == 1:
            return {in_words(self.common): self.own_best}
        return {"own best": self.own_best, "common": self.at_common}

    @property
    def sampled(self) -> str:
        """In words, how methods were sampled in the comparison that tells the result."""
        kind = next(iter(self.comparisons()))
        return SAMPLED.get(kind, f"sampled alike at {kind}")

    def grid(self) -> list[Decoding]:
        """Every decoding that was tried on the tuning scenes; where others chose, of the reference on those told of."""
        reference = [row for row in self.at_common.rows if row["method"] == REFERENCE]
        return sorted({decoding_of(row) for row in self.tuning or reference})


def decoding_of(row: Mapping[str, Any]) -> Decoding:
    """Decoding of a row."""
    return (float(row["top_p"]), float(row["temperature"]))


def decoding_against(entry: Mapping[str, Any]) -> Decoding:
    """Decoding of what a paired difference is taken from."""
    return (float(entry["against_top_p"]), float(entry["against_temperature"]))


def in_words(decoding: Decoding) -> str:
    """A decoding for people.

    Examples:
        >>> in_words((0.95, 1.0)), in_words((0.9, 0.8))
        ('top-p 0.95', 'top-p 0.9, temperature 0.8')
    """
    top_p, temperature = decoding
    return f"top-p {top_p:g}" + ("" if temperature == 1 else f", temperature {temperature:g}")


def read_json(path: str | Path) -> Any:
    """Read JSON that holds no NaN.

    Raises:
        ValueError: the file is no such JSON; the message names it.

    Examples:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp(), "a.json")
        >>> _ = path.write_text('{"realism": NaN}')
        >>> read_json(path)
        Traceback (most recent call last):
        ...
        ValueError: .../a.json is no JSON that this page can read (NaN is no number); remove it and make it again.
    """

    def refuse(name: str) -> None:
        raise ValueError(f"{name} is no number")

    try:
        return json.loads(Path(path).read_text(encoding="utf-8"), parse_constant=refuse)
    except ValueError as error:
        raise ValueError(f"{path} is no JSON that this page can read ({error}); remove it and make it again.") from None


def read_experiment(path: str | Path) -> Experiment:
    """Read what an experiment found.

    Args:
        path: ``experiments/<name>.json`` of a study.

    Raises:
        ValueError: no JSON, an entry that is missing or of another type, or entries that contradict each other; the
            message names file and entry.
    """
    path = Path(path)
    content = read_json(path)
    if not isinstance(content, dict):
        raise ValueError(f"{path} holds {type(content).__name__}, not the result of an experiment.")
    kinds: dict[str, Any] = {
        "name": str, "title": str, "paper": (str, NONE), "question": str, "metric": str, "scenes": dict, "split": str,
        "left_out": int, "seeds": list, "methods": list, "labels": dict, "published": dict, "headline": str,
        "versus": str, "steps": dict,
        "common": list, "chosen": dict, "rows": list, "paired": list, "own_best": dict, "tuning": list,
        "likelihood": list, "axis": (dict, NONE), "curves": dict, "budget": dict, "stages": dict,
        "worker_seconds": NUMBER, "config": dict, "revision": (str, NONE), "versions": dict, "machine": str,
        "date": str, "command": str,
    }  # fmt: skip
    _check(content, kinds, str(path))
    _check(content["own_best"], {"rows": list, "paired": list, "versus": list}, f"{path}: own_best")
    _check(content["steps"], {"common": dict, "own_best": dict}, f"{path}: steps")
    _check(content["scenes"], {**dict.fromkeys(SPLITS, int), "source": str}, f"{path}: scenes")
    for part in ("decoding", "evaluation"):
        _check(content["config"].get(part), {"num_rollouts": int}, f"{path}: config.{part}")
    for method, budget in content["budget"].items():
        _check(budget, BUDGET, f"{path}: budget.{method}")
    for method, spent in content.get("compute", {}).items():
        _check(spent, {"before": NUMBER, "training": NUMBER, "steps": int}, f"{path}: compute.{method}")
    _check_names(content, path)
    _check_lists(content, path)
    axis = content["axis"]
    if axis is not None:
        _check(axis, AXIS, f"{path}: axis")
    _check(content["chosen"], dict.fromkeys(content["methods"], list), f"{path}: chosen")
    for method, decoding in [("common", content["common"]), *content["chosen"].items()]:
        if len(decoding) != 2 or not all(isinstance(part, NUMBER) for part in decoding):
            raise ValueError(f"{path}: the decoding of {method} must be [top_p, temperature], got {decoding!r}.")
    read_below = {"rows", "paired", "common", "chosen", "own_best", "axis", "steps"}
    made = {key: content[key] for key in kinds.keys() - read_below}
    own = content["own_best"]
    return Experiment(
        path=path,
        common=_decoding(content["common"]),
        chosen={method: _decoding(decoding) for method, decoding in content["chosen"].items()},
        at_common=Comparison(content["rows"], content["paired"], steps=content["steps"]["common"]),
        own_best=Comparison(own["rows"], own["paired"], own["versus"], content["steps"]["own_best"]),
        compute=content.get("compute", {}),
        axis=None if axis is None else Axis(**{name: axis[name] for name in AXIS}),
        **made,
    )


def _check_names(content: Mapping[str, Any], path: Path) -> None:
    """What is named exists."""
    methods, headline, versus = (content[name] for name in ("methods", "headline", "versus"))
    if content["split"] not in REPORTED:
        raise ValueError(f"{path}: split must be one of {', '.join(REPORTED)}, got {content['split']!r}.")
    if not {REFERENCE, headline, versus} <= set(methods):
        raise ValueError(
            f"{path}: methods must hold {REFERENCE!r}, the headline {headline!r} and versus {versus!r}, got "
            f"{', '.join(methods)}."
        )
    for at, steps in content["steps"].items():
        _check(steps, dict.fromkeys(methods, int), f"{path}: steps.{at}")
    for method, label in content["labels"].items():
        if not isinstance(label, str):
            raise ValueError(f"{path}: labels.{method} must be str, got {label!r}; put it in quotes.")
    for method, figures in content["published"].items():
        _check(figures, {}, f"{path}: published.{method}")
        for name, value in figures.items():
            if not (isinstance(value, NUMBER) and math.isfinite(value)):
                raise ValueError(f"{path}: published.{method}.{name} must be a number, got {value!r}.")
    trained = {*content["curves"], *content["budget"], *(budget["start"] for budget in content["budget"].values())}
    for method in dict.fromkeys([*methods, *(method.partition("@")[0] for method in methods), *sorted(trained)]):
        if method not in content["labels"]:
            raise ValueError(f"{path}: labels has no entry for {method!r}; it has {', '.join(content['labels'])}.")


def _check_lists(content: Mapping[str, Any], path: Path) -> None:
    """Every entry of the lists is what it must be, and of a method that the experiment has."""
    own = content["own_best"]
    lists = (
        ("rows", content["rows"], ROW), ("tuning", content["tuning"], ROW), ("own_best.rows", own["rows"], ROW),
        ("paired", content["paired"], PAIRED), ("own_best.paired", own["paired"], PAIRED),
        ("own_best.versus", own["versus"], PAIRED), ("likelihood", content["likelihood"], LIKELIHOOD),
    )  # fmt: skip
    against = {"paired": REFERENCE, "own_best.paired": REFERENCE, "own_best.versus": content["versus"]}
    for name, entries, kinds in lists:
        for place, entry in enumerate(entries):
            where = f"{path}: {name}[{place}]"
            _check(entry, kinds, where)
            if entry["method"] not in content["methods"]:
                raise ValueError(f"{where} is of {entry['method']!r}, which is none of methods.")
            if name in against and entry["against"] != against[name]:
                raise ValueError(f"{where} must be against {against[name]!r}, got {entry['against']!r}.")
            for key, value in entry.items():
                if key in kinds:
                    continue
                if value is not None and not (isinstance(value, NUMBER) and math.isfinite(value)):
                    raise ValueError(f"{where}: {key} must be a number or null, got {value!r}.")
            if "ci95" in kinds and not (len(entry["ci95"]) == 2 and entry["ci95"][0] <= entry["ci95"][1]):
                raise ValueError(f"{where}: ci95 must be [low, high], got {entry['ci95']!r}.")


def _check(content: Any, kinds: Mapping[str, Any], where: str) -> None:
    if not isinstance(content, dict):
        raise ValueError(f"{where} must be a table of named values, got {content!r}.")
    missing = [key for key in kinds if key not in content]
    if missing:
        raise ValueError(f"{where} has no {', '.join(missing)}; make it again with this version of recipes.compare.")
    for key, kind in kinds.items():
        if not isinstance(content[key], kind):
            names = " or ".join(each.__name__ for each in (kind if isinstance(kind, tuple) else (kind,)))
            raise ValueError(f"{where}: {key} must be {names}, got {content[key]!r:.80}.")


def _decoding(parts: Sequence[float]) -> Decoding:
    return (float(parts[0]), float(parts[1]))
