"""What the documents say is so: their code runs, their commands exist, their links lead somewhere."""

from __future__ import annotations

import fnmatch
import functools
import importlib.util
import json
import re
import shlex
import zipfile
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from dpa.models.registry import FAMILIES
from dpa.ranking import AGGREGATES, FEATURES, SOLVERS
from dpa.report.likelihoods import who_learns
from dpa.report.statistics import paired_bootstrap, summary
from dpa.report.study import Evaluations, Study, read_study
from dpa.report.table import difference, number
from dpa.report.text import (
    account_table,
    comparison_table,
    learnt_table,
    likelihood_table,
    minute_table,
    safety_table,
    sharpness_table,
)
from envs import keys
from envs.convert.__main__ import make_parser as convert_parser
from envs.sources import SOURCES
from envs.sources.sumo import parse, units
from recipes import validity
from recipes.alignment.losses import LOSSES
from recipes.benchmark.__main__ import make_parser as benchmark_parser
from recipes.common.models import TOKENIZERS
from recipes.difference import make_parser as difference_parser
from recipes.experiment.methods import kept
from recipes.merge import make_parser as merge_parser
from recipes.plan import make_parser as plan_parser
from recipes.report import make_parser as report_parser
from recipes.studies import spurious
from recipes.studies.study import as_json
from recipes.zoo import make_parser as zoo_parser

REPOSITORY = Path(__file__).resolve().parents[1]
CONFIG = REPOSITORY / "recipes" / "config"
PAGES = [REPOSITORY / "README.md", REPOSITORY / "CONTRIBUTING.md", *sorted((REPOSITORY / "docs").rglob("*.md"))]
COMMANDED = [*PAGES, *sorted(CONFIG.rglob("*.yaml")), *sorted((REPOSITORY / "recipes").glob("*.py"))]
"""Files that tell users what to run."""
NOT_RUN = "<!-- not run by tests/test_docs.py"
REGISTRIES = (AGGREGATES, FAMILIES, FEATURES, LOSSES, SOLVERS, SOURCES, TOKENIZERS)
"""What examples add to."""


class Block(NamedTuple):
    """A fenced block of a page."""

    language: str
    code: str
    runs: bool


def blocks(page: Path) -> list[Block]:
    text = page.read_text(encoding="utf-8")
    found = re.finditer(r"(?:(<!--[^\n]*-->)\n)?^```(\w*)\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)
    return [Block(m[2], m[3], not (m[1] or "").startswith(NOT_RUN)) for m in found]


def name(path: Path) -> str:
    return str(path.relative_to(REPOSITORY))


def commands() -> list[str]:
    """Command lines from the module on: ``recipes.align method=dpa_omf ...``."""
    found = set()
    for path in COMMANDED:
        for line in path.read_text(encoding="utf-8").splitlines():
            for match in re.finditer(r"(?:python|torchrun\b[^`]*?) -m ((?:recipes|envs|dpa)\.?[\w.]*[^`#)]*)", line):
                # Prose goes on after a comma or a colon; a comment stands two spaces away.
                ends = r"\s{2,}|[:;,]\s|[:,.]$|\.\.\." + ('|"' if path.suffix == ".py" else "")
                command = re.split(ends, match[1])[0].strip()
                found.add(command)
    return sorted(found)


COMMANDS = commands()


@pytest.fixture
def registries():
    """Examples register things; other tests must not find them."""
    before = [dict(registry) for registry in REGISTRIES]
    yield
    for registry, content in zip(REGISTRIES, before, strict=True):
        registry.clear()
        registry.update(content)


@pytest.mark.usefixtures("registries")
@pytest.mark.parametrize("page", [p for p in PAGES if any(b.language == "python" for b in blocks(p))], ids=name)
def test_the_python_of_a_page_runs(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    namespace = {"__name__": "documentation"}
    for place, block in enumerate(blocks(page)):
        if block.language == "python":
            code = compile(block.code, f"{page.name}[{place}]", "exec", dont_inherit=True)
            if block.runs:
                exec(code, namespace)


def test_commands_are_found() -> None:
    modules = {command.split()[0] for command in COMMANDS}
    assert {"recipes.pretrain", "recipes.compare", "envs.convert", "envs.render", "dpa.preferences"} <= modules


@pytest.mark.parametrize("module", sorted({command.split()[0] for command in COMMANDS}))
def test_a_command_names_a_module_that_can_be_run(module: str) -> None:
    spec = importlib.util.find_spec(module)
    assert spec is not None
    main = Path(spec.origin).with_name("__main__.py") if spec.submodule_search_locations else Path(spec.origin)
    assert 'if __name__ == "__main__":' in main.read_text(encoding="utf-8")


@functools.cache
def page_configurations() -> dict[str, str]:
    """YAML files that the pages tell to write, by name below ``recipes/config``."""
    found = {}
    for page in PAGES:
        for block in blocks(page):
            header = re.match(r"# recipes/config/(\S+)\n", block.code)
            if block.language == "yaml" and header:
                found[header[1]] = block.code
    return found


@pytest.fixture(scope="module")
def extra_configurations(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the YAML files of the pages, as if they had been written."""
    folder = tmp_path_factory.mktemp("config")
    for path, text in page_configurations().items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_text(text, encoding="utf-8")
    return folder


PLAIN = ("recipes.benchmark", "recipes.difference", "recipes.merge", "recipes.plan", "recipes.report", "recipes.zoo")
"""Recipes whose arguments are no options of a configuration."""
BENCHMARKS = [command for command in COMMANDS if command.startswith("recipes.benchmark ")]


@pytest.mark.parametrize("command", [command for command in COMMANDS if command.startswith("recipes.zoo")])
def test_the_zoo_takes_the_options_that_a_command_gives(command: str) -> None:
    zoo_parser().parse_args(shlex.split(command)[1:])


@pytest.mark.parametrize("command", BENCHMARKS)
def test_a_benchmark_takes_the_options_that_a_command_gives(command: str) -> None:
    assert benchmark_parser().parse_args(shlex.split(command)[1:]).part in command


@pytest.mark.parametrize("command", [command for command in COMMANDS if command.startswith("recipes.plan ")])
def test_a_plan_takes_the_options_that_a_command_gives(command: str) -> None:
    assert plan_parser().parse_args(shlex.split(command)[1:]).rollout.suffix == ".json"


@pytest.mark.parametrize("command", [command for command in COMMANDS if command.startswith("recipes.difference ")])
def test_a_difference_takes_the_arguments_that_a_command_gives(command: str) -> None:
    assert difference_parser().parse_args(shlex.split(command)[1:]).experiment


@pytest.mark.parametrize("command", [command for command in COMMANDS if command.startswith("recipes.merge ")])
def test_a_merge_takes_the_arguments_that_a_command_gives(command: str) -> None:
    assert len(merge_parser().parse_args(shlex.split(command)[1:]).parts) > 1


@pytest.mark.parametrize("command", [command for command in COMMANDS if command.startswith("recipes.report ")])
def test_a_report_takes_the_arguments_that_a_command_gives(command: str) -> None:
    assert report_parser().parse_args(shlex.split(command)[1:]).out


VALUE = re.compile(r"^(\+*(?:\w+\.[\w.]+|policy|policies|preferences|output|json|features))=.*")
"""An option that takes any value, unlike a group, of which Hydra looks for the file."""


def told(command: str) -> frozenset[str]:
    """The words of a command that decide whether Hydra composes it."""
    return frozenset(VALUE.sub(r"\1", word) for word in shlex.split(command))


def covering(commands: list[str]) -> list[str]:
    """Those that hold the words of all others; to compose one takes Hydra a quarter of a second."""
    kept: list[str] = []
    for command in sorted(commands, key=lambda each: (-len(told(each)), each)):
        if not any(told(command) <= told(other) for other in kept):
            kept.append(command)
    return kept


COMPOSED = covering([c for c in COMMANDS if c.startswith("recipes.") and not c.startswith(PLAIN)])


@pytest.mark.parametrize("command", COMPOSED)
def test_a_recipe_takes_the_options_that_a_command_gives(command: str, extra_configurations: Path) -> None:
    module, *arguments = shlex.split(command)
    overrides, config = [], module.partition(".")[2]
    while arguments:
        word = arguments.pop(0)
        if word in ("--config-name", "--cfg"):
            value = arguments.pop(0)
            config = value if word == "--config-name" else config
        elif not word.startswith("--"):
            overrides.append(word)
    with initialize_config_dir(str(CONFIG), version_base="1.3"):
        cfg = compose(config, [f"hydra.searchpath=[file://{extra_configurations}]", *overrides])
    OmegaConf.resolve(cfg)
    if "scenes" in cfg and cfg.scenes.source == "sumo":
        assert all(units(**parse(request)) for request in (cfg.scenes.train, cfg.scenes.eval))


@pytest.mark.parametrize("command", [c for c in COMMANDS if re.match(r"envs\.convert \S+ \S", c) and " npz " not in c])
def test_a_conversion_takes_the_options_that_a_command_gives(command: str) -> None:
    options = vars(convert_parser().parse_args(shlex.split(command)[1:]))
    if options["command"] == "sumo":
        assert all(units(**parse(request)) for request in options["paths"])


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_every_make_target_exists(page: Path) -> None:
    makefile = (REPOSITORY / "Makefile").read_text(encoding="utf-8")
    targets = set(re.findall(r"^([\w-]+):", makefile, re.MULTILINE))
    named = re.findall(r"(?:^    |`)make ([a-z][\w-]*)", page.read_text(encoding="utf-8"), re.MULTILINE)
    assert set(named) <= targets


def anchors(page: Path) -> set[str]:
    """Names of a page's headings as links use them."""
    headings = re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", [*PAGES, REPOSITORY / "CHANGELOG.md"], ids=name)
def test_every_relative_link_leads_somewhere(page: Path) -> None:
    text = re.sub(r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    broken = []
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        path, _, anchor = target.partition("#")
        if re.match(r"[a-z]+:", target):
            continue
        file = (page.parent / path).resolve() if path else page
        if not file.exists() or (anchor and anchor not in anchors(file)):
            broken.append(target)
    assert not broken


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_every_file_that_is_named_exists(page: Path) -> None:
    text = re.sub(r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    named = re.findall(r"`((?:envs|dpa|recipes|tests|docs)/[\w./-]+)`", text)
    assert not [path for path in named if not (REPOSITORY / path).exists()]


@pytest.mark.parametrize("page", ["method.md", "realism.md"])
def test_every_section_that_code_cites_exists(page: str) -> None:
    text = (REPOSITORY / "docs" / page).read_text(encoding="utf-8")
    known = set(re.findall(r"^(?:## |- \*\*)(\d(?:\.\d)?)", text, re.MULTILINE))
    cited = re.compile(rf"{re.escape(page)} (?:sections? )?(\d(?:\.\d)?)(?: (?:and|to) (\d(?:\.\d)?))?")
    found = 0
    for package in ("dpa", "envs", "recipes", "tests"):
        for path in (path for kind in ("*.py", "*.yaml") for path in (REPOSITORY / package).rglob(kind)):
            for match in cited.finditer(path.read_text(encoding="utf-8")):
                found += 1
                assert known.issuperset(filter(None, match.groups())), f"{path}: {match.group()}"
    assert found > 5


def test_the_page_of_keys_lists_every_key() -> None:
    text = (REPOSITORY / "docs" / "keys.md").read_text(encoding="utf-8")
    constants = [constant for constant in vars(keys) if constant.isupper()]
    assert constants
    assert not [constant for constant in constants if f"`{constant}`" not in text]


def test_readme_and_architecture_show_the_same_flow() -> None:
    first, second = (
        next(block.code for block in blocks(REPOSITORY / page) if block.language == "text")
        for page in ("README.md", "docs/architecture.md")
    )
    assert first == second


def test_pictures_of_the_documents_are_small() -> None:
    pictures = sorted((REPOSITORY / "docs" / "images").iterdir())
    assert pictures
    largest = {".gif": 250_000}  # of a film; of a picture:
    assert not [each.name for each in pictures if each.stat().st_size > largest.get(each.suffix, 150_000)]


SPLITS = ("train", "tune", "eval")
SHOWN = {"realism": 3, "collision_rate": 3, "offroad_rate": 3, "min_ade": 2, "spread": 1}
"""Measures in README's table, and their digits."""
STUDIES = sorted((REPOSITORY / "docs" / "studies").glob("*.zip"))


def results() -> str:
    """The page of results, and those of the studies that it concludes from."""
    pages = [REPOSITORY / "docs/results.md", *sorted((REPOSITORY / "docs/studies").glob("*.md"))]
    return "\n".join(page.read_text(encoding="utf-8") for page in pages)


def holds(archive: Path, beginning: str) -> bool:
    """Whether an archive has files whose path begins so."""
    return any(each.startswith(beginning) for each in zipfile.ZipFile(archive).namelist())


COMPARED = [path for path in STUDIES if holds(path, "experiments/")]
"""Those of comparisons of methods; the others are of rankings alone."""


@pytest.fixture(scope="module", params=COMPARED, ids=lambda path: path.stem)
def study(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Study:
    folder = tmp_path_factory.mktemp(request.param.stem)
    zipfile.ZipFile(request.param).extractall(folder)
    return read_study(folder)


@pytest.mark.slow
def test_the_tables_of_the_results_are_those_of_the_studies_beside_them(study: Study) -> None:
    told = results()
    evaluations = Evaluations(study.folder)
    for experiment in study.experiments.values():
        one = set(experiment.chosen.values()) == {experiment.common}  # decoding: both tables would say the same
        learnt = who_learns(experiment, evaluations)
        tables = [
            comparison_table(experiment, experiment.own_best),
            None if one else comparison_table(experiment, experiment.at_common),
            safety_table(experiment, experiment.own_best, evaluations),
            None if one else safety_table(experiment, experiment.at_common, evaluations),
            sharpness_table(experiment, evaluations),
            minute_table(experiment),
            likelihood_table(experiment, evaluations) if experiment.likelihood else None,
            None if learnt is None else learnt_table(learnt),
        ]
        assert not [table for table in tables if table is not None and table.rstrip() not in told], experiment.name
    assert (account_table(study) or "").rstrip() in told


@pytest.mark.parametrize("study", [path for path in COMPARED if path.stem == "driving"], indirect=True)
def test_the_table_of_the_readme_is_that_of_the_study_beside_the_results(study: Study) -> None:
    text = (REPOSITORY / "README.md").read_text(encoding="utf-8")
    rows = [[cell.strip(" *") for cell in line.strip("|").split("|")] for line in text.splitlines() if "|" in line]
    told = {cells[0]: cells[1:7] for cells in rows if len(cells) == 8}
    experiment = study.experiments["competent"]
    shown = [record for record in experiment.own_best.records() if experiment.labels[record["method"]] in told]
    assert len(shown) > 10
    for record in shown:
        entry = experiment.own_best.entry(record["method"])
        change = "–" if entry is None else difference(entry["realism_difference"], entry["ci95"])
        label = experiment.labels[record["method"]]
        assert told[label] == [*(number(record[key], digits) for key, digits in SHOWN.items()), change], label


def options_told(made: dict[str, Any]) -> dict[str, Any]:
    """The configuration of the command by which the pages of results run an experiment from its references."""
    commands = re.findall(r"^ +python -m recipes.compare --config-name driving (.*)$", results(), re.MULTILINE)
    with initialize_config_dir(str(CONFIG), version_base="1.3"):
        composed = [kept(compose("driving", shlex.split(options))) for options in commands]
    composed = [OmegaConf.to_container(each, resolve=True) for each in composed]
    (found,) = [each for each in composed if experiment_of(each) == experiment_of(made)]
    return found


def experiment_of(config: dict[str, Any]) -> tuple[Any, ...]:
    return config["scenes"]["source"], config["experiment"]["name"], config["reference"]


def model_of(references: list[str]) -> dict[str, Any]:
    """The section ``model`` by which references of the zoo were made, the smaller MotionLM all of them."""
    assert {name.partition("-sumo")[0] for name in references} == {"zoo:motionlm-nano"}
    with initialize_config_dir(str(CONFIG), version_base="1.3"):
        return OmegaConf.to_container(compose("reference").model)


SINCE = re.compile(
    r"/(chosen|family|episode/\w+|tokenizer/(changes|reach)|auxiliary|context/(arrivals|control|decision_steps|horizon|max_controlled)"
    r"|augmentation/(rotation|agent_drop))"
)
"""Options that came or went, or moved from the context to the episode, after studies beside the results were made."""


@pytest.mark.slow
def test_the_study_beside_the_results_has_the_options_that_its_command_gives(study: Study) -> None:
    """Of all that decides a result; where scenes are kept, and what was shown, may differ."""

    def told(value: Any) -> dict[str, Any]:
        since = {place: leaf for place, leaf in leaves(value).items() if not SINCE.fullmatch(place)}
        return {place.replace("/augmentation/mirror", "/mirror"): leaf for place, leaf in since.items()}

    for experiment in study.experiments.values():
        made = json.loads((study.folder / "experiments" / f"{experiment.name}.json").read_text())["config"]
        given = options_told(made)
        for config in (made, given):
            del config["alignment"]["checkpoint_interval"]  # decides what a kill costs, and nothing else
        if made.get("model") is None:  # all policies are made as the references are
            assert given.get("model") is None, "model"
        else:
            assert told(made["model"]) == told(given.get("model") or model_of(made["reference"])), "model"
        for name in ("seeds", "pretraining", "collection", "alignment", "evaluation", "decoding", "rankings"):
            assert told(made[name]) == told(given[name]), name
        for name in ("methods", "experiment", "aligned_scenes", "drift_rollouts", "device", "threads"):
            assert made[name] == given[name], name
        assert [made["scenes"][split] for split in SPLITS] == [given["scenes"][split] for split in SPLITS]


def in_a_cell(value: dict[str, Any], digits: int) -> str:
    """Mean and interval of a summary as the page of results writes them."""
    mean, low, high = (f"{number:+.{digits}f}".replace("-", "−") for number in (value["mean"], *value["ci95"]))
    return f"{mean} [{low}, {high}]"


def leaves(value: Any, path: str = "") -> dict[str, Any]:
    """The numbers of nested JSON by where they stand: another processor may round their last digit otherwise."""
    if not isinstance(value, (dict, list)):
        return {path: value}
    inside = value.items() if isinstance(value, dict) else enumerate(value)
    return {place: leaf for key, each in inside for place, leaf in leaves(each, f"{path}/{key}").items()}


RANKINGS = [
    pytest.param(path, name, id=f"{path.stem}-{name}")
    for path in STUDIES
    for name in ("validity", "discriminator")
    if holds(path, f"{name}/summary.json")
]


@pytest.mark.slow
@pytest.mark.parametrize(("study", "name"), RANKINGS, indirect=["study"])
def test_the_tables_of_a_study_of_rankings_are_those_of_the_values_of_its_scenes(study: Study, name: str) -> None:
    told = results()
    summary, folder = study.summaries[name], study.folder / name
    policies = {policy: folder / f"{policy.replace('/', '_')}.json" for policy in summary["made"]["policies"]}
    measured = {policy: json.loads(path.read_text())["per_scene"] for policy, path in policies.items()}
    assert len(measured) == 3
    if name == "validity":
        assert leaves(as_json(validity.summarise(measured))) == pytest.approx(leaves(summary["rankings"]))
        for ranking in summary["rankings"].values():
            digits = {"correlation": 2, "near_half": 2, "nearest": 3, "farthest": 3}
            assert " | ".join(in_a_cell(ranking[key], number) for key, number in digits.items()) in told
    else:
        again = as_json(spurious.summarise(measured))
        assert leaves({key: summary[key] for key in again}) == pytest.approx(leaves(again))
        for ranking in spurious.RANKINGS:
            ends = (summary["realism"][ranking][end]["realism"] for end in ("best", "worst"))
            assert " | ".join(in_a_cell(end, 3) for end in ends) in told
    made = summary["made"]["config"]
    (options,) = re.findall(rf"^ +python -m recipes\.{name} (.* output={made['output']})$", told, re.MULTILINE)
    with initialize_config_dir(str(CONFIG), version_base="1.3"):
        given = OmegaConf.to_container(compose(name, shlex.split(options)), resolve=True)
    patterns = [each.removeprefix("zoo:") for each in given.pop("policies")]
    asked = {each for each in measured if any(fnmatch.fnmatch(each, pattern) for pattern in patterns)}
    assert asked == set(measured) and made.pop("policies")
    differing = {key for key in made if made[key] != given[key]}
    assert differing <= {"scenes"}, "where scenes are kept"
    assert [made["scenes"][split] for split in SPLITS] == [given["scenes"][split] for split in SPLITS]


@pytest.mark.slow
def test_a_reader_gets_the_intervals_of_a_study_from_the_values_of_its_scenes(study: Study) -> None:
    for experiment in study.experiments.values():
        content = json.loads((study.folder / "experiments" / f"{experiment.name}.json").read_text())["own_best"]
        scores: dict[str, list[list[float]]] = {}
        for row in content["rows"]:
            values = json.loads((study.folder / row["file"]).read_text())["per_scene"]["realism"]
            scores.setdefault(row["method"], []).append(values)
        for entry in content["paired"]:
            again = paired_bootstrap(scores[entry["method"]], scores["reference"])
            assert again.mean == pytest.approx(entry["realism_difference"], abs=1e-9)
            assert [again.low, again.high] == pytest.approx(entry["ci95"], abs=1e-9)


RUNGS = {
    "log": "log",
    "SUMO again": "SUMO again",
    "SUMO, ways drawn anew": "SUMO, ways drawn anew",
    "the same through the policies' tokens": "SUMO, ways drawn anew, through tokens",
    "log through tokens": "log through tokens",
    "constant velocity": "constant velocity",
}
"""Rows of the table of the simulator, and the rungs that they are of."""


def test_the_table_of_the_simulator_is_of_the_ladder_beside_it() -> None:
    with zipfile.ZipFile(REPOSITORY / "docs/studies/ladder.zip") as archive:
        files = {rung: archive.read(f"ladder/{rung.replace(' ', '_')}.json") for rung in RUNGS.values()}
    page = (REPOSITORY / "docs/studies/metric.md").read_text(encoding="utf-8")
    section = page.partition("## What the simulator itself gets")[2].partition("\n## ")[0]
    measures = ("kinematic", "interactive", "map_based", "min_ade", "collision_rate", "offroad_rate", "spread")
    for row, rung in RUNGS.items():
        (told,) = re.findall(rf"^\| {re.escape(row)} \| (.*) \|$", section, re.MULTILINE)
        realism, *others = told.split(" | ")
        values = [scene["2024"] for scene in json.loads(files[rung])["per_scene"]]
        found = summary([[scene["realism"] for scene in values]])
        assert realism == f"{found.mean:.3f} [{found.low:.3f}, {found.high:.3f}]", row
        for measure, cell in zip(measures, others, strict=True):
            known = [scene[measure] for scene in values if scene[measure] is not None]
            digits = len(cell.partition(".")[2])
            assert cell == f"{sum(known) / len(known):.{digits}f}", (row, measure)


if __name__ == "__main__":
    pytest.main([__file__])
