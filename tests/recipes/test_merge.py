"""An experiment that ran in parts is the one that ran as a whole."""

from __future__ import annotations

import json
import shutil
import sys
import zipfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pytest

from dpa.report.archive import write_archive
from recipes import merge as recipe
from recipes.merge import merge
from recipes.report import report

ARCHIVES = Path(__file__).resolve().parents[2] / "docs" / "studies"
OF_THE_MACHINE = ("compute", "stages", "worker_seconds", "versions", "command", "config", "date", "revision", "machine")
"""What differs between two runs of the same options."""
SMALL = [
    "decoding.grid=[[0.95,1.0],[0.95,0.5]]",
    "decoding.num_rollouts=2",
    "drift_rollouts=2",
    "alignment.watch_interval=4",
    "alignment.snapshots=[]",
    "experiment.checkpoints=last",
    "pictures.scenes=0",
]


def path_of(folder: Path) -> Path:
    return next((folder / "experiments").glob("*.json"))


def content(folder: Path) -> dict[str, Any]:
    return json.loads(path_of(folder).read_text())


def unpacked(name: str, folder: Path) -> Path:
    with zipfile.ZipFile(ARCHIVES / f"{name}.zip") as archive:
        archive.extractall(folder)
    return folder


def edit(folder: Path, file: str | Path, change: Callable[[dict[str, Any]], object]) -> Path:
    """Change one of the JSON files of a folder."""
    read = json.loads((folder / file).read_text())
    change(read)
    (folder / file).write_text(json.dumps(read))
    return folder


def part_of(whole: Path, folder: Path, seeds: Iterable[int], methods: Iterable[str]) -> Path:
    """What a folder would hold if some seeds and methods of it had run by themselves."""
    seeds, methods = list(seeds), ["reference", *methods]
    shutil.copytree(whole, folder, ignore=shutil.ignore_patterns("families"))
    for each in folder.glob("seed_*"):
        for run in each.iterdir():
            if int(each.name.removeprefix("seed_")) not in seeds or run.name not in methods:
                shutil.rmtree(run)

    def left(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
        return [row for row in rows if row["method"] in methods and row.get("seed", seeds[0]) in seeds]

    def cut(found: dict[str, Any]) -> None:
        start, every = found["config"]["reference"], found["seeds"]
        found["config"] |= {"seeds": seeds, "reference": [start[every.index(seed)] for seed in seeds]}
        found["config"]["methods"] = {name: found["config"]["methods"][name] for name in methods[1:]}
        found |= {"seeds": seeds, "methods": methods, "headline": methods[1], "versus": methods[1]}
        for name in ("rows", "tuning", "likelihood", "paired"):
            found[name] = left(found[name])
        found["own_best"] = {name: left(rows) for name, rows in found["own_best"].items() if name != "versus"}
        found["own_best"]["versus"] = []
        found["command"] = f"python -m recipes.compare {seeds}"

    def ran(stage: str, seed: str, *names: str) -> bool:
        return int(seed) in seeds and (stage == "pretrain" or not {*names}.isdisjoint(methods))

    def booked(account: dict[str, dict[str, float]]) -> None:
        for stage, jobs in account.items():
            account[stage] = {job: value for job, value in jobs.items() if ran(*job.split())}

    edit(folder, path_of(folder).relative_to(folder), cut)
    edit(folder, "stages.json", booked)
    edit(folder, "origins.json", lambda origins: booked(origins["jobs"]))
    return folder


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three methods from three references, as they came with a page of the documents."""
    return unpacked("driving_paper", tmp_path_factory.mktemp("whole") / "paper")


@pytest.fixture(scope="module")
def parts(whole: Path, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two methods of seeds 0 and 1, the third of these, and all of seed 2 as an archive."""
    folder = tmp_path_factory.mktemp("parts")
    last = part_of(whole, folder / "last", [2], ["dpa_omf", "omf_normalised", "rloo_realism"])
    return [
        part_of(whole, folder / "first", [0, 1], ["dpa_omf", "omf_normalised"]),
        part_of(whole, folder / "later", [0, 1], ["rloo_realism"]),
        write_archive(folder / "last.zip", last),
    ]


@pytest.fixture(scope="module")
def merged(parts: list[Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("merged") / "all"
    merge(folder, parts)
    return folder


def test_parts_are_the_whole_again(whole: Path, merged: Path) -> None:
    theirs, ours = content(whole), content(merged)
    assert ours.keys() == theirs.keys()
    assert {name for name in ours if ours[name] != theirs[name]} <= {"command", "config"}
    assert {name for name, value in ours["config"].items() if value != theirs["config"][name]} == {"output"}
    for file in ("stages.json", "origins.json", "preferences.json"):
        assert json.loads((merged / file).read_text()) == json.loads((whole / file).read_text()), file


def test_the_report_tells_the_commands_of_all_parts(merged: Path, tmp_path: Path) -> None:
    text = report(merged, tmp_path / "all.md").read_text()
    assert (
        "\n    python -m recipes.compare [0, 1]\n    python -m recipes.compare [2]\n    python -m recipes.merge" in text
    )
    assert "Not here yet" not in report(merged, tmp_path / "all.html").read_text()


def test_options_of_a_pre_training_that_was_not_done_may_differ(parts: list[Path], tmp_path: Path) -> None:
    def other_training(found: dict[str, Any]) -> None:
        found["config"]["pretraining"]["steps"] += 1

    shutil.copytree(parts[1], tmp_path / "later")
    later = edit(tmp_path / "later", "experiments/families.json", other_training)
    assert merge(tmp_path / "all", [parts[0], later, parts[2]]).is_file()


def test_machines_may_have_worked_and_logged_otherwise(parts: list[Path], tmp_path: Path) -> None:
    def elsewhere(found: dict[str, Any]) -> None:
        found["config"]["collection"]["workers"] |= {"count": 8, "backend": "process"}
        found["config"]["logger"] |= {"backend": "wandb", "mode": "online"}
        found["config"]["alignment"] |= {"watch_interval": 7}
        found["config"]["collection"]["ranking"] |= {"threads": 4}

    def ranked_while_collecting(account: dict[str, dict[str, float]]) -> None:
        account["rank"] = {job: value for job, value in account["rank"].items() if not job.startswith("collect")}

    shutil.copytree(parts[0], tmp_path / "first")
    first = edit(tmp_path / "first", "experiments/families.json", elsewhere)
    edit(first, "stages.json", ranked_while_collecting)
    edit(first, "origins.json", lambda origins: ranked_while_collecting(origins["jobs"]))
    edit(first, "origins.json", lambda origins: origins["jobs"]["align"].popitem())  # nobody knows what made it
    merge(tmp_path / "all", [first, *parts[1:]])
    found = content(tmp_path / "all")
    assert found["config"]["logger"] == {"backend": "csv", "mode": "offline"}
    assert found["compute"]["dpa_omf"]["before"] > 0


def test_methods_on_an_axis_stay_on_it(parts: list[Path], tmp_path: Path) -> None:
    def placed(**values: float) -> Callable[[dict[str, Any]], None]:
        axis = {"name": "x", "values": values, "log": False}
        return lambda found: found["config"]["experiment"].update(axis=axis)

    each = []
    for part, values in ((parts[0], {"dpa_omf": 1.0, "omf_normalised": 2.0}), (parts[1], {"rloo_realism": 3.0})):
        shutil.copytree(part, tmp_path / part.name)
        each.append(edit(tmp_path / part.name, "experiments/families.json", placed(**values)))
    merge(tmp_path / "all", each)
    told = content(tmp_path / "all")["axis"]["values"]
    assert told == {"dpa_omf": 1.0, "omf_normalised": 2.0, "rloo_realism": 3.0}


def test_the_first_part_that_has_a_method_decides_how_it_is_decoded(
    parts: list[Path], whole: Path, tmp_path: Path
) -> None:
    def sharper(found: dict[str, Any]) -> None:
        for row in found["own_best"]["rows"]:
            if row["method"] == "omf_normalised":
                row |= {"top_p": 1.0, "file": row["file"].replace("0.95", "1")}

    shutil.copytree(parts[0], tmp_path / "first")
    first = edit(tmp_path / "first", "experiments/families.json", sharper)
    merge(tmp_path / "all", [first, *parts[1:]])
    found = content(tmp_path / "all")
    assert found["chosen"] == content(whole)["chosen"] | {"omf_normalised": [1.0, 1.0]}


def other_scenes(cards: dict[str, Any]) -> None:
    cards["options"]["scenes"]["eval"] = "others"


def another_policy(evaluation: dict[str, Any]) -> None:
    evaluation["options"]["policy"] = "another"


def other_names(evaluation: dict[str, Any]) -> None:
    evaluation["scenes"] = [f"scene {place}" for place, _ in enumerate(evaluation["scenes"])]


@pytest.mark.parametrize(
    ("file", "change", "message"),
    [
        ("scenes.json", other_scenes, r"they are of other scenes \('scenes.eval'.*'others' here"),
        (
            "experiments/families.json",
            lambda found: found["config"]["alignment"].update(steps=7),
            r"they ran with other options \('alignment.steps': 150 there, 7 here",
        ),
        (
            "experiments/families.json",
            lambda found: found["config"]["experiment"]["setup"]["rloo_realism"]["alignment"].update(lr=1.0),
            r"experiment.setup differs between .*'rloo_realism.alignment.lr': 0.0003 there, 1.0 here",
        ),
        ("experiments/families.json", lambda found: found.update(metric="2023"), "another metric or split"),
        (
            "seed_0/reference/eval_top_p_1_t_1.json",
            another_policy,
            r"reference/eval_top_p_1_t_1.json is in an earlier part with other options \('policy'.*leave this seed",
        ),
        ("seed_0/rloo_realism/eval_top_p_1_t_1.json", other_names, "call their scenes by other names; number scenes"),
        (
            "stages.json",
            lambda account: account["align"].pop("align 1 rloo_realism"),
            r"no part has done 'align 1 rloo_realism' \(align\)",
        ),
    ],
)
def test_what_does_not_belong_together_is_told_and_nothing_is_left(
    parts: list[Path], tmp_path: Path, file: str, change: Callable, message: str
) -> None:
    shutil.copytree(parts[1], tmp_path / "later")
    later = edit(tmp_path / "later", file, change)
    with pytest.raises(ValueError, match=message):
        merge(tmp_path / "all", [parts[0], later, parts[2]])
    assert not (tmp_path / "all").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["{first}", "{archive}"], "no part has seed_0/rloo_realism/"),
        (["{first}", "{later}", "{text}"], "text.zip is no archive; name a folder of results, or a .zip"),
        (["{first}", "{empty}"], "empty holds no experiments/*.json; name the output of a recipes.compare"),
        (["{first}", "{later}", "--experiment", "methods"], "has the experiments families; say --experiment with one"),
        (["{first}", "{later}", "--trained", "elsewhere"], "have trained their policies themselves; leave it out"),
    ],
)
def test_what_is_missing_is_one_clear_sentence(
    parts: list[Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture,
    arguments: list[str],
    message: str,
) -> None:
    (tmp_path / "text.zip").write_text("no archive")
    (tmp_path / "empty").mkdir()
    places = dict(zip(("first", "later", "archive"), parts, strict=True))
    places |= {"text": tmp_path / "text.zip", "empty": tmp_path / "empty"}
    told = [argument.format(**places) for argument in arguments]
    monkeypatch.setattr(sys, "argv", ["merge", str(tmp_path / "all"), *told])
    with pytest.raises(SystemExit) as stopped:
        recipe.main()
    assert stopped.value.code == 2 and message in capsys.readouterr().err
    assert not (tmp_path / "all").exists()


def test_a_folder_that_holds_something_is_left_as_it_is(parts: list[Path], tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(ValueError, match="is there already; name a new folder"):
        merge(tmp_path, parts)
    assert (tmp_path / "mine.txt").read_text() == "mine"


def test_policies_that_were_trained_elsewhere_need_the_account_of_their_training(whole: Path, tmp_path: Path) -> None:
    away = unpacked("driving_paper_womd", tmp_path / "womd")
    methods = ["dpa_omf", "omf_normalised", "rloo_realism"]
    parts = [part_of(away, tmp_path / f"{seed}", [seed], methods) for seed in (0, 1, 2)]
    with pytest.raises(ValueError, match=r"trained in runs/paper; put those together first and say --trained"):
        merge(tmp_path / "all", parts)
    merge(tmp_path / "all", parts, trained=whole)
    theirs, ours = content(away), content(tmp_path / "all")
    assert {name for name in ours if ours[name] != theirs[name]} <= {"command", "config"}


@pytest.mark.slow
def test_what_ran_in_parts_is_what_ran_as_a_whole(run: Callable, options: Callable, tmp_path: Path) -> None:
    def compare(folder: Path, seeds: str, *more: str) -> Path:
        told = [*SMALL, f"output={folder}", f"seeds=[{seeds}]", "only=[dpa_omf,sft_best_oa]", *more]
        outcome = run("compare", *options("compare", *told))
        assert outcome.status == 0, outcome.err
        return folder

    one = compare(tmp_path / "one", "0")
    other = compare(tmp_path / "other", "1", f"decoding.chosen={one}")
    merge(tmp_path / "merged", [one, other])
    together = compare(tmp_path / "together", "0,1", f"decoding.chosen={one}")
    theirs, ours = content(together), content(tmp_path / "merged")
    kept = [name for name in ours if name not in (*OF_THE_MACHINE, "tuning")]
    assert {name: ours[name] for name in kept} == {name: theirs[name] for name in kept}
    assert ours["tuning"] == content(one)["tuning"], "nothing was tuned for the other seed"
