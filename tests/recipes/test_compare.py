"""The main job, whole and killed: experiments on tiny scenes, all in one folder, and the page of what they found."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from recipes.report import known_experiments

METHODS = ["dpa_omf", "sft_best_oa", "adversarial_afd"]
"""A loss of pairs, one of single rollouts, and one that ranks by a network."""
OTHERS = ["~methods.dpa_adef", "~methods.sft_best_ade"]
SMALL = [
    "seeds=[0]",
    "decoding.grid=[[0.95,1.0],[0.95,0.5]]",
    "decoding.num_rollouts=2",
    "drift_rollouts=2",
    "alignment.watch_interval=2",
    "alignment.snapshots=[2]",
]
OF_THE_MACHINE = ("compute", "stages", "worker_seconds", "versions", "command", "config", "date", "revision", "machine")
"""What differs between two runs of the same options."""


def command(options: Callable, output: Path, *more: str, workers: int = 1) -> list[str]:
    return options("compare", *SMALL, f"workers={workers}", f"output={output}", *more)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory, run: Callable, options: Callable) -> Path:
    """The folder of the comparison of methods that nothing interrupted."""
    folder = tmp_path_factory.mktemp("compare")
    outcome = run("compare", *command(options, folder, *OTHERS, "pictures={scenes:1,num_rollouts:4,kept:2}"))
    assert outcome.status == 0, outcome.err
    assert "index.html" in outcome.out
    return folder


def experiment(folder: Path, name: str = "methods") -> dict[str, Any]:
    return json.loads((folder / "experiments" / f"{name}.json").read_text())


def test_every_method_is_compared_with_the_reference(finished: Path) -> None:
    found = experiment(finished)
    assert found["scenes"] == {"train": 6, "tune": 2, "eval": 3, "source": "store"}
    at_common = [row["method"] for row in found["rows"] if row["temperature"] == 1.0]
    assert at_common == ["reference", *METHODS] == found["methods"]
    assert [entry["method"] for entry in found["paired"]] == [*METHODS, "reference"]
    assert {row["method"] for row in found["own_best"]["rows"]} == {"reference", *METHODS}
    assert len(found["tuning"]) == 4 * 2 and found["left_out"] == 0
    assert {entry["against"] for entry in found["own_best"]["versus"]} == {"dpa_omf"}
    assert [entry["method"] for entry in found["own_best"]["versus"]] == METHODS[1:]
    assert found["steps"]["own_best"].keys() == {"reference", *METHODS}
    for method, steps in found["steps"]["own_best"].items():
        assert steps in ((2, 4) if method in METHODS else (0,)), "the snapshot or the last one"
        files = [row["file"] for row in found["own_best"]["rows"] if row["method"] == method]
        assert all(("/step_2/" in file) == (steps == 2) for file in files)
    whole = {"steps": 4, "rollouts": 4 * 4, "start": "reference"}
    assert found["budget"]["dpa_omf"] == whole, "of the whole run, whichever checkpoint is chosen"
    for row in found["rows"]:
        assert 0 < row["realism"] <= 1 and 0 <= row["pair_accuracy"] <= 1 and row["n_scenes"] == 3
    drift = {entry["method"]: entry["kl"] for entry in found["likelihood"]}
    assert drift.pop("reference") == pytest.approx(0, abs=1e-6) and all(kl > 1e-6 for kl in drift.values())
    likely = {entry["method"]: entry["nll_demonstration"] for entry in found["likelihood"]}
    assert len(set(likely.values())) == len(likely), "each policy's own likelihoods"


def test_a_reader_finds_the_values_of_every_scene_behind_a_number(finished: Path) -> None:
    for row in experiment(finished)["rows"]:
        behind = json.loads((finished / row["file"]).read_text())
        values = behind["per_scene"]["realism"]
        assert len(values) == len(behind["scenes"]) == 3
        assert sum(values) / 3 == pytest.approx(row["realism"])
        assert behind["options"]["seed"] == row["seed"] and behind["options"]["decoding"]["top_p"] == row["top_p"]


def test_tables_and_picture_are_in_the_logs_of_the_experiment(finished: Path) -> None:
    folder = finished / "experiments/methods"
    rows = (folder / "tables/own_best/methods/0.csv").read_text().splitlines()
    assert rows[0].startswith("method,") and [row.split(",")[0] for row in rows[1:]] == ["reference", *METHODS]
    assert (folder / "pictures/own_best/differences/0.png").read_bytes().startswith(b"\x89PNG")
    assert (folder / "pictures/scenes/likely/0.png").read_bytes() == (finished / "likely.png").read_bytes()
    logged = float((folder / "scalars/common/realism/dpa_omf.csv").read_text().split(",")[1])
    (row,) = [row for row in experiment(finished)["rows"] if row["method"] == "dpa_omf"]
    assert logged == pytest.approx(row["realism"])


def test_likelihoods_are_followed_along_the_alignment_of_every_method(finished: Path) -> None:
    for method, folders in experiment(finished)["curves"].items():
        rows = (finished / folders["0"] / "scalars/tune/nll_preferred.csv").read_text().splitlines()
        assert [row.split(",")[0] for row in rows] == ["0", "2", "4"], method


def test_the_page_shows_methods_and_scenes(finished: Path) -> None:
    page = (finished / "index.html").read_text()
    assert "DPA-OMF" in page and "plotly" in page.lower() and "player" in page
    players = json.loads((finished / "players.json").read_text())
    assert set(players["scenes"][0]["rollouts"]) == set(experiment(finished)["labels"].values())
    assert (finished / "likely.png").stat().st_size > 10_000


def test_the_page_has_a_data_card_of_every_split(finished: Path) -> None:
    cards = json.loads((finished / "scenes.json").read_text())["splits"]
    sizes = {name: card["counts"]["scenes"]["all"] for name, card in cards.items()}
    assert sizes | {"source": "store"} == experiment(finished)["scenes"]
    assert "what the scenes were converted from" in (finished / "index.html").read_text()


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in known_experiments() if name != "methods"])
def test_every_experiment_runs_in_the_folder_of_the_first(
    run: Callable, options: Callable, finished: Path, name: str
) -> None:
    reference = (finished / "seed_0/reference/policy.pt").stat().st_mtime_ns
    more = [f"experiment={name}"]
    if name == "scaling":  # four rollouts of a scene make two pairs of its halves
        more += [f"methods.omf_r{r}.data.num=2" for r in ("0_25", "0_5", 1, 2, 4, 8)]
        more += [f"methods.omf_r{r}.data.rankings_per_scene=2" for r in (4, 8)]
    if name == "losses":  # half of four rollouts would be a pair, not a ranking
        more += ["methods.listwise.data.num=null"]
    if name == "budgets":  # of the decodings of these tests
        more += ["decoding.common=[0.95,1.0]"]
    outcome = run("compare", *command(options, finished, *more))
    assert outcome.status == 0, outcome.err
    found = experiment(finished, name)
    assert {row["method"] for row in found["own_best"]["rows"]} == set(found["methods"])
    assert (finished / "seed_0/reference/policy.pt").stat().st_mtime_ns == reference, "made once for all experiments"
    assert found["title"] in (finished / "index.html").read_text()
    if found["split"] == "tune":
        assert all(Path(row["file"]).name.startswith("tune_") for row in found["rows"])


@pytest.mark.slow
def test_policies_that_are_taken_over_are_judged_as_where_they_were_trained(
    run: Callable, options: Callable, finished: Path, tmp_path: Path
) -> None:
    outcome = run("compare", *command(options, tmp_path, *OTHERS, f"trained={finished}"))
    assert outcome.status == 0, outcome.err
    mine, theirs = experiment(tmp_path), experiment(finished)
    assert not {"pretrain", "align"} & set(mine["stages"]), "nothing is trained"
    for name in ("rows", "own_best", "tuning", "likelihood", "chosen", "compute", "budget"):
        assert mine[name] == theirs[name], name


@pytest.mark.slow
def test_what_another_folder_has_chosen_stands_and_nothing_is_tuned(
    run: Callable, options: Callable, finished: Path, tmp_path: Path
) -> None:
    shutil.copytree(finished / "experiments", tmp_path / "chosen/experiments")
    theirs = experiment(finished)
    for row in theirs["own_best"]["rows"]:  # the other decoding, of the snapshot
        if row["method"] == "dpa_omf":
            temperature = 1.5 - row["temperature"]
            file = f"seed_0/dpa_omf/step_2/eval_top_p_0.95_t_{temperature:g}.json"
            row |= {"temperature": temperature, "file": file}
    (tmp_path / "chosen/experiments/methods.json").write_text(json.dumps(theirs))
    told = [*OTHERS, f"trained={finished}", f"decoding.chosen={tmp_path / 'chosen'}"]
    outcome = run("compare", *command(options, tmp_path / "out", *told))
    assert outcome.status == 0, outcome.err
    mine = experiment(tmp_path / "out")
    assert mine["tuning"] == [] and "tune" not in mine["stages"]
    assert mine["chosen"] == theirs["chosen"] | {"dpa_omf": [0.95, temperature]}
    assert mine["steps"]["own_best"] == theirs["steps"]["own_best"] | {"dpa_omf": 2}
    assert mine["rows"] == theirs["rows"]


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ([*OTHERS, "experiment.name=other"], "has no finished experiment 'other'; run it there first"),
        ([*OTHERS, "decoding.common=[0.95,0.5]"], "compares at [0.95, 1.0]; say decoding.common=[0.95, 1.0] here"),
        (OTHERS[:1], "has chosen nothing for sft_best_ade; it has reference, dpa_omf"),
        (
            [*OTHERS, "alignment.snapshots=[3]"],
            "which is none of dpa_omf@3, dpa_omf; have the same alignment.snapshots",
        ),
    ],
)
def test_a_choice_that_does_not_fit_is_refused(
    run: Callable, options: Callable, finished: Path, tmp_path: Path, more: list[str], message: str
) -> None:
    shutil.copytree(finished / "experiments", tmp_path / "chosen/experiments")
    theirs = experiment(finished)
    for row in theirs["rows"]:
        if row["method"] == "dpa_omf":
            row["file"] = "seed_0/dpa_omf/step_2/eval_top_p_0.95_t_1.json"
    (tmp_path / "chosen/experiments/methods.json").write_text(json.dumps(theirs))
    told = run("compare", *command(options, tmp_path / "out", *more, f"decoding.chosen={tmp_path / 'chosen'}"))
    assert told.status == 2 and message in told.err, told.err
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_a_folder_is_taken_over_whole_once_and_not_trained_on(
    run: Callable, options: Callable, finished: Path, tmp_path: Path
) -> None:
    taken, more = tmp_path / "taken", [*OTHERS, "~methods.sft_best_oa"]
    assert run("compare", *command(options, taken, *more, f"trained={finished}")).status == 0
    told = run("compare", *command(options, tmp_path / "again", *more, f"trained={taken}"))
    assert told.status == 2 and f"has its policies from {finished}; say trained={finished}" in told.err
    told = run("compare", *command(options, taken, *more))
    assert told.status == 2 and "was not trained there; name another output folder" in told.err
    told = run("compare", *command(options, finished, *OTHERS, f"trained={finished}"))
    assert told.status == 2 and "is the output as well" in told.err
    folder = tmp_path / "thinned"
    shutil.copytree(finished, folder)
    (folder / "seed_0/dpa_omf/step_2/policy.pt").unlink()
    told = run("compare", *command(options, tmp_path / "again", *OTHERS, f"trained={folder}"))
    assert told.status == 2 and "step_2/policy.pt does not exist" in told.err
    assert not (tmp_path / "again").exists()


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        (["experiment=features"], "has no finished experiment 'features'; run it there first"),
        (["seeds=[0,7]"], "seed_7/reference/policy.pt does not exist; finish the experiment there"),
        (["alignment.lr=0.5"], "was trained with other options than are told here: 'alignment.lr'"),
        (["collection.num_rollouts=6"], "'collection.num_rollouts': 4 there, 6 here"),
        (["alignment.snapshots=[3]"], "step_3/policy.pt does not exist; finish the experiment there"),
        (
            ["alignment.watch_interval=3", "collection.ranking.threads=2", "alignment.lr=0.5"],
            r"here: 'alignment.lr': 3e-05 there, 0.5 here\.$",
        ),
        (
            ["reference=zoo:motionlm-nano-sumo"],
            "has aligned reference=None of seed 0, and here it is zoo:motionlm-nano",
        ),
        (["+experiment.setup.dpa_omf={length:2}"], "'setup.dpa_omf': None there"),
    ],
)
def test_a_folder_that_has_not_trained_what_is_asked_for_is_refused(
    run: Callable, options: Callable, finished: Path, tmp_path: Path, changed: list[str], told: str
) -> None:
    others = [] if changed == ["experiment=features"] else OTHERS
    outcome = run("compare", *command(options, tmp_path, *others, f"trained={finished}", *changed))
    assert outcome.status == 2 and re.search(told, outcome.err), outcome.err
    assert not (tmp_path / "seed_0").exists()


@pytest.mark.slow
def test_a_finished_comparison_does_nothing_again(run: Callable, options: Callable, finished: Path) -> None:
    policies = sorted(finished.rglob("*.pt"))
    before, account = experiment(finished), json.loads((finished / "stages.json").read_text())
    assert run("compare", *command(options, finished, *OTHERS, "pictures={scenes:1,num_rollouts:4,kept:2}")).status == 0
    after = experiment(finished)
    assert {k: v for k, v in after.items() if k not in OF_THE_MACHINE} == {
        k: v for k, v in before.items() if k not in OF_THE_MACHINE
    }
    assert sorted(finished.rglob("*.pt")) == policies
    assert json.loads((finished / "stages.json").read_text()) == account


@pytest.mark.slow
@pytest.mark.parametrize(
    ("workers", "sign"),
    [
        (1, "seed_0/preferences_train/metadata.json"),
        (2, "seed_0/dpa_omf/checkpoints/step_0000000002.pt"),
        (1, "seed_0/sft_best_oa/tune_top_p_0.95_t_1.json"),
    ],
)
def test_a_killed_comparison_ends_like_one_that_nothing_interrupted(
    run: Callable, options: Callable, kill_when: Callable, finished: Path, tmp_path: Path, workers: int, sign: str
) -> None:
    output = tmp_path / "compare"
    options_of = partial(command, options, output, *OTHERS, "pictures.scenes=0")
    kill_when((output / sign).exists, "compare", *options_of(workers=workers))
    assert not (output / "experiments").exists()
    outcome = run("compare", *options_of())
    assert outcome.status == 0, outcome.err
    mine, whole = experiment(output), experiment(finished)
    for name in OF_THE_MACHINE:
        mine.pop(name), whole.pop(name)
    assert mine == whole


if __name__ == "__main__":
    pytest.main([__file__, "-m", "slow"])
