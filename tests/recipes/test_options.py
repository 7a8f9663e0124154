"""The command line of every recipe: help, and one clear line for what a user can mend."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig, OmegaConf

from dpa.ranking import PreferenceDistance
from dpa.tokens import VerletTokenizer
from dpa.training.checkpoint import CheckpointError, load_policy, save_policy
from envs.files import write_json
from envs.sources.synthetic import straight_road
from envs.store import SceneStore
from recipes.common.cli import CONFIG, build, finished, recipe
from recipes.common.limits import LIMITS, check_limits
from recipes.common.models import (
    TOKENIZERS,
    build_policy,
    build_tokenizer,
    given_policy,
    open_policy,
    policy_config,
    policy_file,
)
from recipes.common.partial import PartialResult
from recipes.common.scenes import fingerprint, open_splits
from recipes.studies.motions import MotionShelf

RECIPES = (
    "pretrain", "collect", "align", "evaluate", "play", "ladder", "gap", "encounters", "references", "tokens",
    "compare", "validity", "sensitivity",
)  # fmt: skip
NANO = "zoo:motionlm-nano-sumo"
SEVERAL = ("gap", "encounters", "ladder", "references", "validity", "sensitivity", "discriminator", "play")
"""Recipes that are given several policies."""
WITHOUT_POLICY = tuple(recipe for recipe in RECIPES if recipe not in ("collect", "align", "evaluate"))
pytestmark = pytest.mark.usefixtures("stores")


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory, run: Callable, options: Callable) -> Path:
    """A folder with a trained ``reference``, its ``preferences``, and a policy of ``other`` weights."""
    folder = tmp_path_factory.mktemp("runs")
    for name, seed in (("reference", 0), ("other", 1)):
        command = options("pretrain", f"output={folder / name}", f"seed={seed}", "pretraining.steps=2")
        assert run("pretrain", *command).status == 0
    command = options("collect", f"policy={folder / 'reference/policy.pt'}", f"output={folder / 'preferences'}")
    assert run("collect", *command).status == 0
    return folder


def assert_refused(outcome: tuple, *words: str) -> None:
    """Exit status 2 and one line that says what is wrong; no traceback."""
    status, _, err = outcome
    errors = [line for line in err.splitlines() if line.startswith("error:")]
    assert status == 2, err
    assert len(errors) == 1, err
    assert "Traceback" not in err
    for word in words:
        assert word in errors[0]


@pytest.mark.parametrize("recipe", RECIPES)
def test_help_says_what_the_recipe_does_and_takes(run: Callable, recipe: str) -> None:
    outcome = run(recipe, "--help")
    assert outcome.status == 0
    assert outcome.out.startswith(f"python -m recipes.{recipe}")
    assert "scenes:" in outcome.out and "seed" in outcome.out


def test_the_demo_has_a_configuration(run: Callable) -> None:
    outcome = run("compare", "--config-name", "demo", "--cfg", "job")
    assert outcome.status == 0
    cfg = OmegaConf.create(outcome.out)
    assert cfg.reference == "zoo:motionlm-nano-sumo" and "model" not in cfg, "policies are made as their reference"


@pytest.mark.parametrize(("size", "rate"), [("nano", 6e-3), ("paper", 4e-3)])
def test_a_size_is_trained_at_the_rate_that_it_bears(run: Callable, size: str, rate: float) -> None:
    outcome = run("pretrain", "--config-name", "reference", f"model={size}", "--cfg", "job")
    assert outcome.status == 0, outcome.err
    cfg = OmegaConf.create(outcome.out)
    assert (cfg.model.size, cfg.pretraining.lr) == (size, rate)


@pytest.mark.parametrize("recipe", RECIPES)
def test_an_unknown_key_is_told_by_name(run: Callable, recipe: str) -> None:
    outcome = run(recipe, "scenes.trains=somewhere")
    assert outcome.status == 1
    assert "Key 'trains' is not in struct" in outcome.err and "Traceback" not in outcome.err


@pytest.mark.parametrize("recipe", ["collect", "align", "evaluate"])
def test_an_option_that_is_missing_is_told_by_name(run: Callable, options: Callable, recipe: str) -> None:
    assert_refused(run(recipe, *options(recipe)), "policy is not given; say policy=VALUE")


@pytest.mark.parametrize("recipe", RECIPES)
def test_scenes_that_do_not_exist_are_told_by_path(
    run: Callable, options: Callable, recipe: str, tmp_path: Path
) -> None:
    more = [] if recipe in WITHOUT_POLICY else [f"policy={NANO}"]
    more += [f"policies={NANO}"] if recipe in SEVERAL else []
    more += ["alignment.snapshots=[2]"] if recipe == "compare" else []
    name = "out.html" if recipe == "play" else "out"
    command = options(recipe, *more, "scenes.train=nowhere", f"{output_of(recipe)}={tmp_path / name}")
    assert_refused(run(recipe, *command), "nowhere")


def output_of(recipe: str) -> str:
    return "json" if recipe in ("evaluate", "tokens") else "output"


@pytest.mark.parametrize("recipe", ["collect", "align", "evaluate"])
def test_a_policy_that_does_not_exist_is_told_by_path(
    run: Callable, options: Callable, recipe: str, tmp_path: Path, runs: Path
) -> None:
    more = [f"preferences={runs / 'preferences'}"] if recipe == "align" else []
    command = options(recipe, "policy=none.pt", *more, f"{output_of(recipe)}={tmp_path / 'out'}")
    assert_refused(run(recipe, *command), "none.pt does not exist")


def test_a_file_that_is_no_policy_is_told_by_path(run: Callable, options: Callable, tmp_path: Path) -> None:
    (tmp_path / "policy.pt").write_text("no policy")
    command = options("evaluate", f"policy={tmp_path / 'policy.pt'}", f"json={tmp_path / 'out.json'}")
    assert_refused(run("evaluate", *command), str(tmp_path / "policy.pt"), "no whole checkpoint")


def test_a_split_that_does_not_exist_is_told(run: Callable, options: Callable, tmp_path: Path) -> None:
    command = options("tokens", "split=test", f"json={tmp_path / 'out.json'}")
    assert_refused(run("tokens", *command), "split must be one of train, tune, eval, got 'test'")


def test_a_run_does_not_go_on_with_a_policy_of_another_size(
    run: Callable, options: Callable, runs: Path, tmp_path: Path
) -> None:
    shutil.copytree(runs / "reference", tmp_path / "reference")
    command = options("pretrain", f"output={tmp_path / 'reference'}", "pretraining.steps=2", "model=small")
    assert_refused(
        run("pretrain", *command),
        "result.json was written with other options",
        "'policy.model.width': 48 there, 64 here",
    )
    (tmp_path / "reference/result.json").unlink()  # as if the run had not finished
    assert_refused(
        run("pretrain", *command), "holds a run with other options", "'policy.model.width': 48 there, 64 here"
    )


def test_preferences_of_other_scenes_are_refused(
    run: Callable, options: Callable, runs: Path, stores: Path, tmp_path: Path
) -> None:
    command = options(
        "align",
        f"policy={runs / 'reference/policy.pt'}",
        f"preferences={runs / 'preferences'}",
        f"output={tmp_path / 'out'}",
        f"scenes.train={stores / 'other'}",
    )
    assert_refused(run("align", *command), "preferences ranks rollouts of other scenes; give the scenes and the split")


def test_preferences_of_another_policy_are_refused(
    run: Callable, options: Callable, runs: Path, tmp_path: Path
) -> None:
    command = options(
        "align",
        f"policy={runs / 'other/policy.pt'}",
        f"preferences={runs / 'preferences'}",
        f"output={tmp_path / 'out'}",
    )
    assert_refused(run("align", *command), "ranks rollouts of another policy", "other/policy.pt")


def test_rollouts_of_two_policies_do_not_go_into_one_store(run: Callable, options: Callable, runs: Path) -> None:
    command = options("collect", f"policy={runs / 'other/policy.pt'}", f"output={runs / 'preferences'}")
    assert_refused(run("collect", *command), "groups of another origin", "policy")


@pytest.mark.parametrize(
    ("option", "words"),
    [
        ("method.loss.kind=dpo", ("method.loss.kind must be one of", "dpo")),
        ("method.data.kind=worst", ("method.data.kind must be one of", "worst")),
        ("method.data.rank_by=taste", ("method.data.rank_by must be distance or ade", "taste")),
        ("+method.loss.beta=1", ("method.loss (contrastive) has no option 'beta'", "alpha")),
        ("method.loss.alpha=-1", ("alpha must be positive, got -1",)),
        ("alignment.warmup=9", ("alignment.warmup must be less than alignment.steps, got 9 and 4",)),
        ("method.data.num=3", ("3",)),
    ],
)
def test_options_that_make_no_sense_are_refused(
    run: Callable, options: Callable, runs: Path, tmp_path: Path, option: str, words: tuple[str, ...]
) -> None:
    command = options(
        "align",
        f"policy={runs / 'reference/policy.pt'}",
        f"preferences={runs / 'preferences'}",
        f"output={tmp_path / 'out'}",
        "method.data.num=2",
        option,
    )
    assert_refused(run("align", *command), *words)


@pytest.mark.parametrize(
    ("option", "words"),
    [
        (
            "scenes.tune=8",
            (
                "scenes.tune, taken from the 8 scenes of scenes.train, must leave some",
                "got 8",
            ),
        ),
        ("scenes.source=wmod", ("wmod",)),
        ("scenes.select.min_agents=99", ("'min_agents': 99", "leaves none of the 8 scenes of scenes.train")),
        ("+scenes.select.lights=true", ("scenes.select has no option 'lights'", "has_lights")),
        ("pretraining.mirror=2", ("pretraining.mirror must be from 0 to 1, got 2",)),
        ("+pretraining.step=9", ("pretraining has no option 'step'; it takes start, steps, batch_size",)),
        ("+colour=red", ("the recipe has no option 'colour'; it takes ", "seed")),
        ("++logger.entity=me", ("logger has no option 'entity'; it takes backend, mode",)),
        ("model.size=huge", ("model.size must be one of", "huge")),
        ("model.tokenizer.name=syllables", ("model.tokenizer.name must be one of", "syllables")),
        ("+model.context.depth=3", ("model.context has no option 'depth'",)),
        ("model.episode.horizon=17", ("horizon * decision_steps must be at most 80 steps", "17 * 5")),
        ("model.context.max_pieces=0", ("model.context: max_pieces must be positive, got 0",)),
        ("model.tokenizer.steps=0", ("steps must be 1 or more poses of 0.1 s, got 0",)),
        ("model.tokenizer.steps=11", ("decision_steps must be at most the 10 steps of 0.1 s", "got 11")),
        ("+model.episode.decision_steps=5", ("model.episode has no option 'decision_steps'", "as long as a token")),
        ("~model.tokenizer", ("there is no model.tokenizer: the YAML that", "begins with `defaults: [base]`")),
        ("logger.backend=paper", ("logger.backend must be csv, wandb or tensorboard, got 'paper'",)),
        ("seed=-1", ("seed must lie in", "-1")),
    ],
)
def test_options_of_training_that_make_no_sense_are_refused(
    run: Callable, options: Callable, tmp_path: Path, option: str, words: tuple[str, ...]
) -> None:
    assert_refused(run("pretrain", *options("pretrain", f"output={tmp_path / 'out'}", option)), *words)


def test_scenes_that_are_trained_and_evaluated_on_are_refused(
    run: Callable, options: Callable, stores: Path, tmp_path: Path
) -> None:
    command = options("pretrain", f"output={tmp_path}", f"scenes.eval={stores / 'train'}")
    assert_refused(run("pretrain", *command), "scenes.train and scenes.eval share 6 scenes")  # two of the 8 are to tune


def test_tuning_scenes_may_be_a_source_of_their_own(stores: Path) -> None:
    def scenes(train: str, tune: str, held_out: str) -> DictConfig:
        named = {"train": train, "tune": tune, "eval": held_out}
        with initialize_config_dir(CONFIG["config_path"], version_base="1.3"):
            return compose(
                "pretrain", ["scenes=store", *(f"scenes.{split}={stores / name}" for split, name in named.items())]
            ).scenes

    assert open_splits(scenes("train", "other", "eval")).sizes() == {"train": 8, "tune": 8, "eval": 3}
    for names, told in {
        ("train", "eval", "eval"): r"scenes\.tune and scenes\.eval share 3 scenes",
        ("train", "train", "eval"): r"scenes\.train and scenes\.tune share 8 scenes",
    }.items():
        with pytest.raises(ValueError, match=told):
            open_splits(scenes(*names))


def test_scenes_of_equal_ids_and_other_content_are_other_scenes(tmp_path: Path, write_store: Callable) -> None:
    scenes = [straight_road(2), straight_road(3)]
    first = SceneStore(write_store(tmp_path / "first", scenes))
    shards = SceneStore(write_store(tmp_path / "shards", scenes[:1], scenes[1:]))
    scenes[1].agents.predict[0] ^= True
    other = SceneStore(write_store(tmp_path / "other", scenes))
    assert first.scene_ids == shards.scene_ids == other.scene_ids
    assert fingerprint(first) == fingerprint(shards) != fingerprint(other)
    assert fingerprint(first.subset([0])) == fingerprint(other.subset([0]))


@pytest.mark.parametrize(
    ("recipe", "option", "told"),
    [
        ("pretrain", "pretraining.max_norm=-1", "pretraining.max_norm must be above 0, got -1"),
        ("pretrain", "pretraining.tune_interval=0", "pretraining.tune_interval must be 1 or more, got 0"),
        ("pretrain", "pretraining.noise=1.5", "pretraining.noise must be from 0 to 1, got 1.5"),
        ("pretrain", "pretraining.recovery=0", "pretraining.recovery must be above 0, got 0"),
        ("pretrain", "pretraining.recovery=2", "pretraining.recovery must be from 0 to 1, got 2"),
        ("pretrain", "pretraining.precision=fp8", "pretraining.precision must be one of float32, bfloat16, got 'fp8'"),
        ("pretrain", "pretraining.schedule=step", "pretraining.schedule must be one of linear, cosine, got 'step'"),
        ("pretrain", "pretraining.max_agents=0", "pretraining.max_agents must be 1 or more, got 0"),
        ("pretrain", "model.episode.arrivals=no", "model.episode.arrivals must be true or false, got 'no'"),
        ("pretrain", "scenes.limit=-1", "scenes.limit must be 1 or more, got -1"),
        ("pretrain", "scenes.limit=abc", "scenes.limit must be a whole number or null, got 'abc'"),
        ("pretrain", "threads=0", "threads must be 1 or more, got 0"),
        ("pretrain", "device=gpu", "device must be cpu, cuda or cuda:N, got 'gpu'"),
        ("align", "alignment.pairs_per_scene=0", "alignment.pairs_per_scene must be 1 or more, got 0"),
        ("align", "alignment.lr=nan", "alignment.lr must be a number, got nan"),
        ("align", "alignment.snapshots=[0]", "alignment.snapshots must be 1 or more, got 0"),
        ("align", "alignment.snapshots=5", "alignment.snapshots must be a list of whole numbers, got 5"),
        ("align", "method.loss.alpha=abc", "method.loss.alpha must be a number, got 'abc'"),
        ("pretrain", "output=3", "output must be text, got 3"),
        ("pretrain", "model.tokenizer=abc", "model.tokenizer must be a section, got 'abc'"),
        (
            "pretrain",
            "model.tokenizer.bins.vehicle=[0.1,abc]",
            "bins.vehicle must be a list of 2 numbers, got [0.1, 'abc']",
        ),
        ("collect", "collection.decoding.top_k=1.5", "collection.decoding.top_k must be a whole number, got 1.5"),
        ("collect", "collection.compile=abc", "collection.compile must be true or false, got 'abc'"),
        ("collect", "seed=null", "seed must be a whole number, got None"),
        ("evaluate", "evaluation.memory=2GB", "evaluation.memory must be a number, got '2GB'"),
        ("evaluate", "decoding.temperature=inf", "decoding.temperature must be a number, got inf"),
        ("evaluate", "json=FOLDER", "is a folder; name a file"),
        ("evaluate", "json=null", "json=null: the result needs a file"),
        (
            "pretrain",
            "scenes.tune=0.2",
            "scenes.tune must be a number of training scenes, a path or a list of paths, got 0.2",
        ),
        ("pretrain", "scenes.eval=null", "scenes.eval must be a path or a list of paths, got None"),
        ("pretrain", "+scenes.min_agents=4", "scenes has no option 'min_agents'; it takes source, train"),
        ("align", "+method.data.margn=0.1", "method.data.margn says nothing to method.data.kind=pairs"),
    ],
)
def test_a_value_that_an_option_cannot_have_is_told_before_any_work(
    run: Callable, options: Callable, runs: Path, tmp_path: Path, recipe: str, option: str, told: str
) -> None:
    given = {"policy": runs / "reference/policy.pt", "preferences": runs / "preferences", "output": tmp_path / "out"}
    if recipe == "evaluate":
        given |= {"json": tmp_path / "out.json"}
    taken = {"pretrain": ("output",), "align": ("policy", "preferences", "output"), "collect": ("policy", "output")}
    named = [f"{name}={given[name]}" for name in taken.get(recipe, ("policy", "json"))]
    (tmp_path / "folder").mkdir()
    wrong = option.replace("FOLDER", str(tmp_path / "folder"))
    assert_refused(run(recipe, *options(recipe, *named, wrong)), told)
    assert not list(tmp_path.glob("out*")), "the folder is not begun with it"


def test_every_limit_is_that_of_an_option_and_holds_for_its_defaults() -> None:
    seen, folder = set(), Path(CONFIG["config_path"])
    experiments = [("compare", [f"experiment={path.stem}"]) for path in (folder / "experiment").glob("*.yaml")]
    methods = [("align", [f"method={path.stem}"]) for path in (folder / "method").glob("*.yaml")]
    for name, chosen in [*((path.stem, []) for path in folder.glob("*.yaml")), *experiments, *methods]:
        if chosen == ["experiment=base"]:
            continue
        with initialize_config_dir(CONFIG["config_path"], version_base="1.3"):
            cfg = compose(name, chosen)
        check_limits(cfg)
        seen |= set(names_of(OmegaConf.to_container(cfg)))
    assert not {name for name in LIMITS if not any(f".{option}".endswith(f".{name}") for option in seen)}


def names_of(section: dict, prefix: str = "") -> Iterator[str]:
    for key, value in section.items():
        yield f"{prefix}{key}"
        if isinstance(value, dict):
            yield from names_of(value, f"{prefix}{key}.")


def test_a_finished_policy_that_was_damaged_is_told(run: Callable, options: Callable, tmp_path: Path) -> None:
    command = options("pretrain", f"output={tmp_path / 'reference'}", "pretraining.steps=2")
    assert run("pretrain", *command).status == 0
    (tmp_path / "reference/policy.pt").write_bytes(b"")
    assert_refused(run("pretrain", *command), "policy.pt", f"To train it again, remove {tmp_path / 'reference'}")


def test_damaged_options_of_a_run_are_told(run: Callable, options: Callable, tmp_path: Path) -> None:
    (tmp_path / "reference").mkdir()
    (tmp_path / "reference/config.json").write_text("null")
    command = options("pretrain", f"output={tmp_path / 'reference'}", "pretraining.steps=2")
    assert_refused(run("pretrain", *command), "config.json is damaged", "and run again")


def test_damaged_partial_results_are_told(tmp_path: Path) -> None:
    partial = PartialResult(tmp_path / "result.json", {})
    partial.add({0: {"value": 1}})
    with partial.path.open("a") as file:
        file.write("[0, 1]\n")
    with pytest.raises(ValueError, match=r"\.result\.json\.scored is damaged"):
        partial.read()


def test_damaged_motions_are_told(tmp_path: Path) -> None:
    shelf = MotionShelf(tmp_path / "motions", {})
    (tmp_path / "motions/3.npz").write_bytes(b"PK")
    with pytest.raises(ValueError, match=r"3\.npz is damaged"):
        shelf.get(3)


def test_a_tokenizer_of_ones_own_has_the_options_of_its_class(monkeypatch: pytest.MonkeyPatch) -> None:
    class Coarse(VerletTokenizer):
        def __init__(self, table: str) -> None:
            super().__init__(steps=len(table))

    monkeypatch.setitem(TOKENIZERS, "coarse", Coarse)
    with initialize_config_dir(CONFIG["config_path"], version_base="1.3"):
        cfg = OmegaConf.to_container(compose("pretrain", ["model=nano"]).model)
    cfg["tokenizer"] = {"name": "coarse", "table": "five."}
    assert build_policy(policy_config(OmegaConf.create(cfg))).tokenizer.steps == 5
    cfg["tokenizer"]["table"] = "four"
    config = policy_config(OmegaConf.create(cfg))
    assert (config["episode"]["decision_steps"], config["model"]["horizon"]) == (4, 20), "8 s of decisions"


def test_options_of_ones_own_classes_are_judged_by_their_annotations_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """``bins``, ``noise`` and ``horizon`` are options elsewhere, with limits of their own."""

    class Coarse(VerletTokenizer):
        def __init__(self, bins: int = 15, noise: float = 2.0, horizon: tuple[int, ...] = ()) -> None:
            super().__init__()

    monkeypatch.setitem(TOKENIZERS, "coarse", Coarse)
    with initialize_config_dir(CONFIG["config_path"], version_base="1.3"):
        cfg = OmegaConf.to_container(compose("pretrain", ["model=nano"]))
    cfg["model"]["tokenizer"] = {"name": "coarse", "bins": 21, "noise": 3.5, "horizon": [1, 2]}
    check_limits(OmegaConf.create(cfg))
    assert policy_config(OmegaConf.create(cfg).model)["tokenizer"]["bins"] == 21
    wrong = {"bins": (1.5, "a whole number"), "noise": ("loud", "a number"), "horizon": ([1, 2.5], "a list of whole")}
    for option, (value, words) in wrong.items():
        section = {"name": "coarse", option: value}
        with pytest.raises(
            ValueError, match=rf"model\.tokenizer\.{option} must be {words}.*, got {re.escape(repr(value))}"
        ):
            build_tokenizer(section)


@pytest.mark.parametrize(
    ("recipe", "option", "told"),
    [
        ("pretrain", "scenes.eval=num_scene=3", "num_scene"),
        ("pretrain", "model.size=huge", "model.size must be one of"),
        ("pretrain", "pretraining.start=none.pt", "none.pt does not exist"),
        ("evaluate", "policy=none.pt", "none.pt does not exist"),
        ("collect", "policy=none.pt", "none.pt does not exist"),
        ("align", "policy=none.pt", "none.pt does not exist"),
        ("rerank", "policy=none.pt", "none.pt does not exist"),
        *((recipe, f"policies=[{NANO},none.pt]", "none.pt does not exist") for recipe in SEVERAL),
    ],
)
def test_what_is_not_there_is_told_before_any_scene_is_converted(
    run: Callable, options: Callable, tmp_path: Path, recipe: str, option: str, told: str
) -> None:
    made = "num_scenes=1,max_agents=4"
    scenes = [
        "scenes=sumo",
        f'scenes.train="{made}"',
        f'scenes.eval="{made},split=test"',
        f"scenes.cache={tmp_path / 'c'}",
    ]
    name = "out.html" if recipe == "play" else "out"
    more = [f"{output_of(recipe)}={tmp_path / name}", *(["preferences=none"] if recipe in ("align", "rerank") else [])]
    given = [each for each in options(recipe) if not each.startswith("scenes.")]
    assert_refused(run(recipe, *given, *scenes, *more, option.replace("=num_scene=3", '="num_scene=3"')), told)
    assert not (tmp_path / "c").exists()


def test_a_folder_is_no_policy_and_the_file_in_it_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"is a folder; give the file of a saved policy\.$"):
        given_policy(tmp_path)
    (tmp_path / "policy.pt").touch()
    with pytest.raises(FileNotFoundError, match=r"is a folder; give .* policy \(.*policy\.pt\?\)"):
        given_policy(tmp_path)


def test_a_policy_of_a_family_that_is_not_here_is_told_by_both_names(tmp_path: Path) -> None:
    weights, config, made = load_policy(policy_file(NANO))
    save_policy(tmp_path / "policy.pt", weights, config | {"family": "herd"}, made)
    with pytest.raises(CheckpointError, match=r"policy\.pt has a configuration .*model\.family .*, got 'herd'"):
        open_policy(tmp_path / "policy.pt")


# --- what they are made of ------------------------------------------------------------------------------------------
def test_a_section_that_lacks_an_option_is_told() -> None:
    def target(alpha: float) -> float:
        return alpha

    with pytest.raises(ValueError, match="method.loss missing a required argument: 'alpha'"):
        build(target, OmegaConf.create({}), "method.loss")


@pytest.mark.parametrize("hidden", [False, True])
def test_an_interrupt_says_how_to_go_on(hidden: bool, capsys: pytest.CaptureFixture[str]) -> None:
    @recipe
    def main(cfg: DictConfig) -> None:
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt:
            if hidden:  # as tensordict does while it has swapped a module's parameters
                raise RuntimeError("parameters")  # noqa: B904
            raise

    with pytest.raises(SystemExit) as stop:
        main(OmegaConf.create({"threads": 1, "device": "cpu"}))
    assert stop.value.code == 130
    assert capsys.readouterr().err == "interrupted; run the same command again to go on\n"


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_a_device_that_is_not_there_is_told_before_any_work(run: Callable, options: Callable, tmp_path: Path) -> None:
    command = options("pretrain", "device=cuda", f"output={tmp_path / 'out'}")
    assert_refused(run("pretrain", *command), "device=cuda", "say device=cpu")
    assert not (tmp_path / "out").exists()


def test_more_pairs_than_rollouts_are_refused(run: Callable, options: Callable, runs: Path, tmp_path: Path) -> None:
    policy, store = runs / "reference/policy.pt", runs / "preferences"
    command = options("align", f"policy={policy}", f"preferences={store}", f"output={tmp_path / 'out'}")
    command.append("method.data.num=8")
    assert_refused(run("align", *command), "method.data.num=8 needs 16 rollouts of a scene and there are 4")


@pytest.mark.parametrize("kept", ["policy.pt", "checkpoints"])
def test_a_study_keeps_out_of_the_folder_of_a_training(kept: str, run: Callable, tmp_path: Path) -> None:
    (tmp_path / kept).mkdir()
    outcome = run("gains", f"runs={tmp_path}", f"output={tmp_path}")
    assert_refused(outcome, f"output={tmp_path} holds a training, whose curves would be lost")
    assert "holds a training" not in run("gains", f"runs={tmp_path}", f"output={tmp_path / 'study'}").err


def test_a_section_becomes_the_arguments_of_a_class() -> None:
    distance = build(PreferenceDistance, OmegaConf.create({"stride": 5, "aggregate": "mean"}), "collection.ranking")
    assert distance.describe()["stride"] == 5


def test_a_result_of_the_same_options_is_read_back_and_others_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "result.json"
    assert finished(path, {"seed": 0}) is None
    write_json(path, {"options": {"seed": 0, "grid": [1, 2]}, "value": 3.0})
    assert finished(path, {"seed": 0, "grid": (1, 2)})["value"] == 3.0
    with pytest.raises(ValueError, match=r"other options \('seed': 0 there, 1 here\); name another file"):
        finished(path, {"seed": 1, "grid": (1, 2)})


@pytest.mark.parametrize("text", ["", "{", "[]", "{}"])
def test_a_file_that_is_no_result_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "result.json"
    path.write_text(text)
    with pytest.raises(ValueError, match=r"result.json is no result of this recipe .* remove it"):
        finished(path, {"seed": 0})


def test_a_number_that_json_does_not_have_is_not_written(tmp_path: Path) -> None:
    write_json(tmp_path / "result.json", {"value": 1.0})
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(tmp_path / "result.json", {"value": float("nan")})
    assert json.loads((tmp_path / "result.json").read_text()) == {"value": 1.0}


if __name__ == "__main__":
    pytest.main([__file__])
