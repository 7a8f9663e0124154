"""How methods of an experiment hang together, what is told where they do not, and the account of their stages."""

from __future__ import annotations

import json
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig

from dpa.models import Decoding
from dpa.report.statistics import SEEDS_AND_SCENES
from envs.files import write_json
from envs.locks import alone_in
from recipes.common.cli import CONFIG
from recipes.compare import choose, train_policies
from recipes.experiment import jobs
from recipes.experiment.check import check_experiment
from recipes.experiment.jobs import runs_of
from recipes.experiment.methods import drawing_seed, kept, read_setups, setup_of, snapshots_of
from recipes.experiment.pool import Workers
from recipes.experiment.runs import Run
from recipes.experiment.stages import Stages, read_account
from recipes.experiment.summary import Results, budget, compute

EXPERIMENTS = sorted(path.stem for path in (Path(CONFIG["config_path"]) / "experiment").glob("*.yaml"))
FURTHER = "+experiment.setup.dpa_omf={start:dpa_adef}"


def configuration(*options: str) -> DictConfig:
    with initialize_config_dir(CONFIG["config_path"], version_base="1.3"):
        return compose("compare", list(options))


def test_families_takes_over_the_trainings_of_competent() -> None:
    """A name means one training in all experiments of a folder."""
    some, all_of_them = configuration("experiment=families"), configuration("experiment=competent")
    assert set(some.methods) < set(all_of_them.methods)
    for name, method in some.methods.items():
        assert method == all_of_them.methods[name]
        assert some.experiment.setup.get(name) == all_of_them.experiment.setup.get(name)
        assert some.experiment.labels[name] == all_of_them.experiment.labels.get(name, some.experiment.labels[name])


@pytest.mark.parametrize(
    ("name", "method", "policy", "preferences", "expert", "changed"),
    [
        ("features", "dpa_omf", "reference", "preferences_train", None, {}),
        ("features", "collision", "reference", "preferences_train_by_collision", None, {}),
        ("rounds", "omf_round_2", "dpa_omf", "preferences_train_of_dpa_omf", None, {}),
        ("rounds", "spin_round_2", "adversarial_afd", "preferences_train_of_adversarial_afd", None,
         {"lr": 1e-5}),
        ("rounds", "omf_thrice", "reference", "preferences_train", None, {"steps": 450}),
        ("losses", "afd_expert", "reference", "preferences_train", "preferences_train_of_sft_best_oa", {}),
        ("competent", "omf_normalised", "reference", "preferences_train_by_normalised", None,
         {"lr": 1e-4, "steps": 300}),
        ("competent", "cat_k", "reference", None, None, {"lr": 6e-4}),
    ],
)  # fmt: skip
def test_a_method_is_aligned_with_what_its_experiment_says(
    monkeypatch: pytest.MonkeyPatch,
    name: str,
    method: str,
    policy: str,
    preferences: str | None,
    expert: str | None,
    changed: dict[str, float],
) -> None:
    cfg, given = configuration(f"experiment={name}"), {}
    monkeypatch.setattr(jobs, "open_splits", lambda _: SimpleNamespace(train=range(4), tune=range(2)))
    monkeypatch.setattr(jobs, "seconds_trained", lambda _: 0.0)
    monkeypatch.setattr(jobs, "align", lambda *args, **options: given.update(args=args, **options))
    jobs.align_job(cfg, 3, method)
    options, data_and_loss, _, start, store, _, folder = given["args"]
    seed = runs_of(cfg).root / "seed_3"
    assert (start, folder) == (seed / policy / "policy.pt", seed / method)
    assert store == (None if preferences is None else seed / preferences)
    assert given["expert"] == (None if expert is None else seed / expert)
    assert data_and_loss == cfg.methods[method]
    own = {key: value for key, value in options.alignment.items() if value != cfg.alignment[key]}
    assert changed.items() <= own.items() and (changed or not own)
    assert given["watch"].reference == seed / "reference/policy.pt", "drift is measured from the first one"


def test_rollouts_are_ranked_again_by_the_distance_of_that_name(monkeypatch: pytest.MonkeyPatch) -> None:
    cfg, given = configuration("experiment=features"), []
    monkeypatch.setattr(jobs, "open_splits", lambda _: SimpleNamespace(train="scenes"))
    monkeypatch.setattr(jobs, "rerank", lambda *args: given.extend(args))
    jobs.rerank_job(cfg, 3, "reference", "collision")
    section, scenes, policy, store, made, device = given
    seed = runs_of(cfg).root / "seed_3"
    assert section.features == "collision" and section.stride == cfg.collection.ranking.stride and scenes == "scenes"
    assert policy == seed / "reference/policy.pt" and device == cfg.device
    assert (store, made) == (seed / "preferences_train", seed / "preferences_train_by_collision")


@pytest.mark.parametrize("name", [name for name in EXPERIMENTS if name != "base"])
def test_every_experiment_fits_together(name: str) -> None:
    cfg = configuration(f"experiment={name}")
    check_experiment(cfg)
    assert cfg.experiment.name == name and cfg.experiment.headline in cfg.methods
    assert set(cfg.experiment.published) <= {"reference", *cfg.methods}
    assert set((cfg.experiment.axis or {}).get("values", {})) <= set(cfg.methods)
    assert set(cfg.methods) <= set(cfg.experiment.labels)
    assert all(isinstance(label, str) for label in cfg.experiment.labels.values()), "a number needs quotes"


def test_only_the_named_methods_are_run_and_told_of() -> None:
    given = configuration(
        "experiment=competent",
        "only=[rloo,dpa_omf]",
        "experiment.axis={name: rate, log: false, values: {rloo: 1, grpo: 2}}",
    )
    cfg = kept(given)
    check_experiment(cfg)
    assert list(cfg.methods) == ["dpa_omf", "rloo"] and list(cfg.experiment.setup) == ["rloo"]
    assert set(cfg.experiment.labels) == {"reference", "dpa_omf", "rloo"}
    assert set(cfg.experiment.published) == {"reference", "dpa_omf"}
    assert dict(cfg.experiment.axis["values"]) == {"rloo": 1}
    assert cfg.methods.rloo == given.methods.rloo and cfg.experiment.setup.rloo == given.experiment.setup.rloo
    assert kept(cfg) == cfg and "grpo" in given.methods
    assert kept(configuration()) == configuration()


def test_only_brings_what_its_methods_need_and_tells_the_first_of_them() -> None:
    cfg = kept(configuration("experiment=rounds", "only=[omf_round_2]"))
    check_experiment(cfg)
    assert list(cfg.methods) == ["dpa_omf", "omf_round_2"]
    cfg = kept(configuration("experiment=competent", "only=[rloo_realism,cat_k]", "experiment.versus=grpo"))
    check_experiment(cfg)
    assert cfg.experiment.headline == "rloo_realism" and cfg.experiment.versus is None


@pytest.mark.parametrize(("only", "rolled"), [("[rloo,cat_k]", []), ("[rloo,dpa_omf]", ["reference"])])
def test_training_scenes_are_rolled_out_for_methods_that_read_them(only: str, rolled: list[str]) -> None:
    jobs: list[tuple[str, list[tuple]]] = []
    stages = SimpleNamespace(run=lambda stage, _, __, each: jobs.append((stage, each)))
    train_policies(kept(configuration("experiment=competent", f"only={only}", "seeds=[0]")), stages)
    collected = [each for stage, some in jobs if stage == "collect" for each in some]
    assert [source for _, split, source in collected if split == "train"] == rolled
    aligned = [method for stage, some in jobs if stage == "align" for _, method in some]
    assert aligned == only.strip("[]").split(",")[::-1]


def test_episodes_that_the_metric_cannot_score_are_refused_before_any_work() -> None:
    with pytest.raises(ValueError, match=r"these policies roll 40 out; say model.episode.horizon=16"):
        check_experiment(configuration("model.episode.horizon=8"))


@pytest.mark.parametrize("only", ["[dpa_omf,ppo]", "[]", "dpa_omf"])
def test_only_is_refused_where_it_names_no_methods(only: str) -> None:
    with pytest.raises(
        ValueError,
        match=r"only must be methods of the experiment as in only=\[dpa_omf\], got .*; there are dpa_omf, dpa_adef",
    ):
        kept(configuration(f"only={only}"))


def test_a_method_comes_after_those_that_it_starts_from_or_learns_from() -> None:
    order = list(read_setups(configuration("experiment=rounds")))
    assert order.index("dpa_omf") < order.index("omf_round_2") < order.index("omf_round_3")
    order = list(read_setups(configuration("experiment=losses")))
    assert order.index("sft_best_oa") < order.index("afd_expert")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ((FURTHER, "+experiment.setup.dpa_adef={start:dpa_omf}"), "dpa_omf, dpa_adef need each other"),
        (("+experiment.setup.nobody={start:reference}",), "experiment.setup.nobody: there is no such method"),
        (("+experiment.setup.dpa_omf={start:nobody}",), "experiment.setup.dpa_omf names 'nobody'"),
        (("+experiment.setup.dpa_omf={ranking:nothing}",), "ranking='nothing' is not among rankings"),
        (("+experiment.setup.dpa_omf={begin:dpa_adef}",), "experiment.setup.dpa_omf has no option 'begin'"),
        (("+methods.reference=${methods.dpa_omf}",), "methods.reference: .* are taken"),
        (("experiment.split=train",), "experiment.split must be one of eval, tune, got 'train'"),
        (("experiment.checkpoints=best",), "experiment.checkpoints must be one of last, select, all, got 'best'"),
        (("experiment.split=tune",), "experiment.split=tune reports on them: methods would have an advantage"),
        (
            ("experiment.checkpoints=all", "alignment.snapshots=[]"),
            r"needs a snapshot before step 150 and alignment.snapshots is \[\]; say .*snapshots=\[75\]",
        ),
        (("alignment.steps=60",), r"needs a snapshot before step 60 and alignment.snapshots is \[75\]"),
        (("decoding.common=[0.5,1.0]",), r"decoding.common=\[0.5, 1.0\] must be one of decoding.grid"),
        (
            ("decoding.grid=[[0.95,1.0],[0.9,1.0],[0.9000001,1.0]]",),
            r"decoding.grid has \[0.9, 1\] more than once, got .*; name each decoding once",
        ),
        (
            ("experiment.published.dpa_omf.realism=abc",),
            "experiment.published.dpa_omf.realism must be a number, got 'abc'",
        ),
        (
            ("experiment.published={dpa_omf:3}",),
            "experiment.published.dpa_omf must hold figures by name, got 3; say for example {realism: 0.739}",
        ),
        (("methods.dpa_omf.loss=null",), "methods.dpa_omf.loss must be a section with kind and its options, got None"),
        (("methods.sft_best_oa.data.num=true",), "method.data.num must be a whole number, or a share .* got True"),
        (
            ("experiment=scaling", "experiment.axis.values.omf_r1=0"),
            "experiment.axis.values.omf_r1=0 has no place on a logarithmic axis",
        ),
        (
            ("experiment=losses", "methods.listwise.data.num=2"),
            "methods.listwise: .*plackett_luce ranks several rollouts.*method.data.num=2 of 32 rollouts and .* leave 2",
        ),
        (("decoding.grid=[0.95,0.85]",), r"decoding.grid takes pairs \[top-p, temperature\], got 0.95"),
        (("decoding.grid=[[0.95,1.0],[1.5,1.0]]",), r"top_p must lie in \(0, 1\], got 1.5"),
        (("seeds=[0,0]",), r"seeds must be one or more, each once, got \[0, 0\]"),
        (("aligned_scenes=0",), "aligned_scenes must be 1 or more, got 0"),
        (("evaluation.metric=2031",), "2031"),
        (("experiment.headline=nobody",), "experiment.headline=nobody is no method of the experiment"),
        (("+methods.dpa_omf.loss.alphas=1",), "methods.dpa_omf: .*no option 'alphas'"),
        (("methods.dpa_omf.data.kind=sets",), "methods.dpa_omf: .* learns from pairs"),
        (
            ("+experiment.setup.dpa_omf={alignment:{step:3}}",),
            "experiment.setup.dpa_omf.alignment has no option 'step'",
        ),
        (("+experiment.setup.dpa_omf={alignment:{steps:5}}",), "methods.dpa_omf: alignment.warmup must be less than"),
        (("collection.num_rollouts=1",), "collection.num_rollouts=1 of a scene make no pair"),
        (("+experiment.setup.dpa_omf={length:0}",), "experiment.setup.dpa_omf.length must be above 0, got 0"),
        (("+experiment.setup.dpa_omf={expert:dpa_adef}",), "is for methods.dpa_omf.data.kind=expert, which is pairs"),
        (("ranking@collection.ranking=displacement",), "couples nothing; say pictures.scenes=0"),
        (("experiment.versus=cpl",), "experiment.versus=cpl is no method of the experiment; name one of dpa_omf"),
        (
            ("experiment=scaling", "collection.num_rollouts=8"),
            r"methods\.omf_r0_25: method\.data\.num=8 needs 16 rollouts of a scene and there are 8",
        ),
        (
            ("experiment=scaling", "methods.omf_r8.data.rankings_per_scene=9"),
            r"methods\.omf_r8: method\.data\.rankings_per_scene=9 and a scene has 8 pairs",
        ),
        (("methods.dpa_omf.data.rankings_per_scene=0",), "rankings_per_scene must be positive, got 0"),
        (("methods.dpa_omf.data.margin=-0.1",), "methods.dpa_omf: method.data.margin must be 0 or more, got -0.1"),
        (
            ("methods.dpa_adef.loss.credit=agent",),
            "methods.dpa_adef: method.loss.credit=agent needs pairs .* got pairs and ade",
        ),
        (
            ("experiment=losses", "~experiment.setup.afd_expert"),
            "methods.afd_expert.data.kind=expert .* say whose: experiment.setup.afd_expert.expert=METHOD",
        ),
        (
            (
                "+method@methods.own=dpa_omf_on_policy",
                "+rankings.far={stride:5}",
                "+experiment.setup.own={ranking:far}",
            ),
            "own ranks those that it makes; say methods.own.data.ranking",
        ),
        (("collection.ranking.stride=0",), "collection.ranking.stride must be 1 or more, got 0"),
        (("evaluation.num_rollouts=0",), "evaluation.num_rollouts must be 1 or more, got 0"),
        (("experiment.name=a/b",), "experiment.name='a/b' names a file and a place on the page"),
        (
            ("experiment.labels.dpa_adef=DPA-OMF",),
            "dpa_omf and dpa_adef are both called 'DPA-OMF'; say experiment.labels.dpa_adef=NAME",
        ),
        (("drift_rollouts=0",), "drift_rollouts must be 1 or more, got 0"),
        (("alignment.watch_interval=0",), "alignment.watch_interval must be 1 or more, got 0"),
        (
            ("+methods.sft_best_oa.data.margin=0.1",),
            r"methods\.sft_best_oa: method\.data\.margin says nothing to .*kind=best",
        ),
        (("+methods.dpa_omf.data.margn=0.1",), r"method\.data\.margn says nothing .* which takes rank_by, pairs, num"),
        (("+methods.dpa_omf.lr=1e-4",), "methods.dpa_omf has no option 'lr'; it takes name, data and loss"),
        (("+alignment.step=300",), "alignment has no option 'step'; it takes checkpoint_interval"),
        (("+experiment.checkpoint=all",), "experiment has no option 'checkpoint'"),
        (("+aligned_scene=300",), "the experiment has no option 'aligned_scene'"),
        (("collection.workers=4",), "collection.workers must be a section, got 4"),
        (("collection.workers.count=4",), "backend"),
        (("collection.decoding.top_p=1.5",), r"top_p must be|top_p must lie"),
        (("collection.precision=bf16",), "precision must be one of float32, bfloat16, got 'bf16'"),
        (("experiment.labels.dpa_adef=0.5",), "experiment.labels.dpa_adef must be text, got 0.5; put it in quotes"),
        (("experiment.title=2026",), "experiment.title must be text, got 2026"),
        (("+experiment.axis={name:x,values:{dpa_omf:1}}",), "experiment.axis must have name, values, log"),
        (("+experiment.axis={name:x,values:{dpa:1},log:true}",), "experiment.axis.values.dpa is no method"),
        (("+experiment.axis={name:x,values:{dpa_omf:a},log:true}",), "values.dpa_omf must be a number, got 'a'"),
        (
            ("+rankings.other.stride=5", "+experiment.setup.adversarial_afd={ranking:other}"),
            "adversarial_afd.ranking=other says nothing to .*kind=adversarial, which reads no ranks",
        ),
        (("methods.dpa_omf.data.kind=pair",), r"methods\.dpa_omf: method\.data\.kind must be one of"),
        (("methods.dpa_adef=null",), r"methods\.dpa_adef must be a section .* got None; to leave a method out"),
        (("experiment=competent", "alignment.staleness=1"), "methods.omf_on_policy: staleness=1 needs workers that"),
        (("experiment=competent", "only=[rloo]", "alignment.workers.count=2"), "2 workers need backend=process"),
        (("collection.ranking=displacement",), r"say collection\.ranking={kind: displacement}, .* ranking@collection"),
        (
            ("+rankings.mine=displacement",),
            r"rankings\.mine must be a section of options, got 'displacement'",
        ),
        (("model=smart_nano", "collection.compile=true"), r"SMART compiles nothing; say collection\.compile=false"),
        (("evaluation.memory=1e-9",), r"evaluation: memory must hold at least one agent, got 1e-09 GiB"),
        (
            ("pretraining.auxiliary=1.0",),
            r"MotionLM has no auxiliary loss, and pretraining\.auxiliary=1\.0 asks for one",
        ),
        (("seeds=[-1]",), "seeds must be from 0 to 4294967295, got -1"),
    ],
)
def test_an_experiment_that_cannot_work_is_refused_before_any_work(options: tuple[str, ...], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        check_experiment(configuration(*options))


def test_a_start_that_is_not_there_is_told_before_any_work() -> None:
    with pytest.raises(FileNotFoundError, match=r"nowhere\.pt does not exist; give the path of a saved policy"):
        check_experiment(configuration("pretraining.start=nowhere.pt"))


@pytest.mark.parametrize("config", ["demo", pytest.param("driving", marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", [name for name in EXPERIMENTS if name != "base"])
def test_what_the_page_of_the_demo_or_of_a_study_offers_fits_it(name: str, config: str) -> None:
    with initialize_config_dir(CONFIG["config_path"], version_base="1.3"):
        check_experiment(compose(config, [f"experiment={name}"]))


def test_another_kind_of_distance_may_rank_the_rollouts_again() -> None:
    other = "+rankings.final={kind:displacement,measure:final}"
    check_experiment(configuration(other, "+experiment.setup.dpa_omf={ranking:final}"))


def test_one_name_is_one_training_in_all_experiments() -> None:
    """They share a folder: a name that meant two things would be refused there."""
    meaning: dict[str, tuple[str, str]] = {}
    for name in (name for name in EXPERIMENTS if name != "base"):
        cfg = configuration(f"experiment={name}")
        for method, setup in read_setups(cfg).items():
            alignment = setup.merged(cfg.alignment)
            data, loss = cfg.methods[method].data, cfg.methods[method].loss
            training = str((data, loss, alignment, setup.start, setup.expert, cfg.rankings.get(setup.ranking or "")))
            assert meaning.setdefault(method, (name, training))[1] == training, (method, name, meaning[method][0])


def test_one_command_at_a_time_works_in_a_folder(tmp_path: Path) -> None:
    study, refused = tmp_path / "study", pytest.raises(ValueError, match="another command is at work in .*study")
    with alone_in(study), refused, alone_in(study):
        pass
    with alone_in(study):
        pass


def test_methods_that_need_each_other_are_told_with_only_too() -> None:
    circle = ("+experiment.setup.dpa_omf={start:dpa_adef}", "+experiment.setup.dpa_adef={start:dpa_omf}")
    with pytest.raises(ValueError, match="dpa_omf, dpa_adef need each other"):
        kept(configuration("only=[dpa_omf]", *circle))


def test_snapshots_end_before_the_last_step_of_their_method() -> None:
    cfg = configuration("alignment.snapshots=[40,150]", "+experiment.setup.dpa_omf={alignment:{steps:300}}")
    assert snapshots_of(cfg, "dpa_omf") == ["dpa_omf@40", "dpa_omf@150"]
    assert snapshots_of(cfg, "dpa_adef") == ["dpa_adef@40"]


def test_checkpoint_and_decoding_are_chosen_together_by_the_mean_over_seeds(tmp_path: Path) -> None:
    grid = "decoding.grid=[[1.0,1.0],[0.95,1.0]]"
    cfg = configuration(f"output={tmp_path}", "seeds=[0,1]", grid, "alignment.snapshots=[40]")
    # The snapshot is ahead at the common decoding and for seed 0; the last policy, at top-p 1, in the mean.
    scores = {("dpa_omf@40", 0.95): (0.7, 0.3), ("dpa_omf", 1.0): (0.5, 0.6), ("reference", 0.95): (0.4, 0.4)}
    asked = []

    def evaluate(name: str, job: Any, config: Any, arguments: list[tuple]) -> None:
        asked.extend(arguments)
        for seed, policy, split, *decoding in arguments:
            path = runs_of(config).evaluation(seed, Run(policy, Decoding(*decoding)), split)
            write_json(path, {"mean": {"realism": scores.get((policy, decoding[0]), (0.1, 0.1))[seed]}})

    chosen = choose(cfg, SimpleNamespace(run=evaluate))
    assert chosen.best["dpa_omf"] == Run("dpa_omf", Decoding(1.0, 1.0))
    assert chosen.common["dpa_omf"] == Run("dpa_omf@40", Decoding(0.95, 1.0)), "the best one where all are compared"
    assert chosen.best["reference"] == chosen.common["reference"] == Run("reference", Decoding(0.95, 1.0))
    assert len(asked) == len(set(asked)) == 2 * 2 * (1 + 2 * 5), "each policy of each seed once at each decoding"


def test_where_there_is_nothing_to_choose_no_tuning_scene_is_rolled_out(tmp_path: Path) -> None:
    options = "decoding.grid=[[0.95,1.0]]", "experiment.checkpoints=last", "alignment.snapshots=[40]"
    asked: list[tuple] = []
    chosen = choose(
        configuration(f"output={tmp_path}", *options), SimpleNamespace(run=lambda *given: asked.extend(given[-1]))
    )
    assert not asked and not chosen.tuned
    assert chosen.best == chosen.common
    assert chosen.best["dpa_omf"] == Run("dpa_omf", Decoding(0.95, 1.0))


def test_each_round_draws_by_a_seed_of_its_own() -> None:
    rounds = configuration("experiment=rounds")
    seeds = [
        drawing_seed(rounds, seed, policy) for seed in (0, 1) for policy in ("reference", "dpa_omf", "omf_round_2")
    ]
    assert seeds[0] == 0 and seeds[3] == 1, "the reference's rollouts are those of the seed itself"
    assert len(set(seeds)) == 6 and all(0 <= seed < 2**32 for seed in seeds)
    assert drawing_seed(rounds, 0, "omf_twice") == seeds[1], "two policies of one round draw the same"


def test_snapshots_of_a_longer_alignment_lie_as_far_along() -> None:
    cfg = configuration("experiment=rounds")
    longer = setup_of(cfg, "omf_twice").merged(cfg.alignment)
    assert (longer.steps, list(longer.snapshots)) == (300, [150])


def test_compute_counts_what_came_before_a_method_and_its_own_training() -> None:
    rounds = configuration("experiment=rounds", "seeds=[0,1]")
    account = {
        "collect": {"collect 0 train reference": 10.0, "collect 1 train reference": 30.0,
                    "collect 0 tune reference": 99.0, "collect 0 train dpa_omf": 7.0, "collect 1 train dpa_omf": 7.0},
        "rank": {"collect 0 train reference": 1.0, "collect 1 train reference": 3.0},
        "align": {"align 0 dpa_omf": 100.0, "align 1 dpa_omf": 200.0, "align 0 omf_round_2": 50.0,
                  "align 1 omf_round_2": 60.0},
    }  # fmt: skip
    assert compute(rounds, "dpa_omf", account) == {"before": 20 + 2, "training": 150, "steps": 150}
    assert compute(rounds, "omf_round_2", account) == {"before": 20 + 2 + 7 + 150, "training": 55, "steps": 150}
    other = configuration("experiment=baselines", "seeds=[0]", "+rankings.mine.stride=5",
                          "+experiment.setup.dpa_omf.ranking=mine")  # fmt: skip
    account["rank"]["rank 0 reference mine"] = 4.0
    account["align"] |= {"align 0 cat_k": 5.0}
    assert compute(other, "dpa_omf", account) == {"before": 10 + 4, "training": 100, "steps": 150}, (
        "its own ranking in place of the other"
    )
    assert compute(other, "cat_k", account) == {"before": 0, "training": 5, "steps": 150}, "it rolls out by itself"
    for seed, told in (("1", 20 + 0.5), ("0", 20.0)):  # other processes ranked while they collected for this seed
        del account["rank"][f"collect {seed} train reference"]
        assert compute(rounds, "dpa_omf", account)["before"] == told


def test_a_budget_counts_what_a_method_starts_from_and_whom_it_learns_from() -> None:
    own = {"steps": 150, "rollouts": 150 * 6 * 2, "start": "reference"}
    rounds = configuration("experiment=rounds")
    assert budget(rounds, "dpa_omf") == own
    assert budget(rounds, "omf_round_3") == {"steps": 450, "rollouts": 450 * 6 * 2, "start": "omf_round_2"}
    expert = budget(configuration("experiment=losses"), "afd_expert")
    losses = configuration("experiment=losses", "methods.kto.data.num_unpreferred=0.5")
    assert budget(losses, "kto")["rollouts"] == 150 * 6 * (1 + 2), "of twice as many unpreferred ones twice as many"
    few = configuration("alignment.pairs_per_scene=4", "methods.dpa_omf.data.num=2")
    assert budget(few, "dpa_omf")["rollouts"] == 150 * 6 * 2 * 2, "of two pairs a step cannot take four"
    far = configuration("experiment=losses", "+experiment.setup.afd_expert.start=sft_best_oa")
    assert budget(far, "afd_expert")["steps"] == 300, "SFT is both its start and its expert, and runs once"
    thinned = configuration("experiment=scaling", "alignment.pairs_per_scene=4")
    assert budget(thinned, "omf_r2")["rollouts"] == 150 * 6 * 2 * 2, "of the two pairs that a scene keeps"
    assert budget(thinned, "omf_r0_25")["rollouts"] == 150 * 6 * 2, "a scene that keeps one has one pair"
    afd = budget(configuration(), "adversarial_afd")
    assert afd == own | {"rollouts": 150 * 6}, "one side of it is logs"
    assert expert == own | {"steps": 300, "rollouts": 150 * 6 * 2 + 150 * 6}, (
        "SFT reads one rollout where AfD reads two"
    )


def test_scenes_without_realism_end_a_comparison_with_the_option_that_names_them(tmp_path: Path) -> None:
    cfg, run = configuration("seeds=[0]", f"output={tmp_path}"), Run("reference", Decoding(0.95, 1.0))
    path = runs_of(cfg).evaluation(0, run, "eval")
    path.parent.mkdir(parents=True)
    path.write_text(json.dumps({"per_scene": {"realism": [None, None]}}))
    with pytest.raises(ValueError, match=r"no scene of scenes\.eval has realism under every policy.*name other scenes"):
        Results(cfg, [("reference", run)])


def test_methods_are_paired_with_the_reference_of_the_same_seed(tmp_path: Path) -> None:
    cfg = configuration("seeds=[0,1]", f"output={tmp_path}")
    scores = {"reference": {0: [0.0, 0.0], 1: [1.0, 1.0]}, "dpa_omf": {0: [0.5, 0.5], 1: [1.5, 1.5]}}
    runs = {method: Run(method, Decoding(0.95, 1.0)) for method in scores}
    for method, by_seed in scores.items():
        for seed, realism in by_seed.items():
            write_json(runs_of(cfg).evaluation(seed, runs[method], "eval"), {"per_scene": {"realism": realism}})
    (entry,) = Results(cfg, list(runs.items())).paired([("dpa_omf", runs["dpa_omf"])], ("reference", runs["reference"]))
    told = {"realism_difference": 0.5, "ci95": [0.5, 0.5], "over": SEEDS_AND_SCENES, "n_seeds": 2}
    assert entry.items() >= (told | {"method": "dpa_omf", "against": "reference", "against_top_p": 0.95}).items()


# --- the account ----------------------------------------------------------------------------------------------------
MADE = {"revision": "a1", "machine": "here", "date": "2026-11-23", "versions": {"torch": "2.13.0"}}


def test_the_account_keeps_what_each_job_took_the_first_time(tmp_path: Path) -> None:
    path = tmp_path / "stages.json"
    with Workers(1, threads=1) as workers:
        Stages(workers, path, MADE).run("sleep", _sleep, 1.0, [(0.01, "a"), (0.03, "b")])
        first = read_account(path)
        assert first == json.loads(path.read_text()) and set(first["sleep"]) == {"sleep 0.01 a", "sleep 0.03 b"}
        assert first["sleep"]["sleep 0.03 b"] >= 0.03
        again = Stages(workers, path, MADE | {"revision": "b2", "date": "2026-11-24"})
        again.run("sleep", _sleep, 0.0, [(0.01, "a"), (0.03, "b"), (0.02, "c")])  # done before: takes no time
    kept = read_account(path)["sleep"]
    assert {name: kept[name] for name in first["sleep"]} == first["sleep"] and "sleep 0.02 c" in kept
    assert again.seconds["sleep"] == pytest.approx(sum(kept.values()))
    told = again.made
    assert (told["revision"], told["date"]) == ("a1, b2", "2026-11-23 to 2026-11-24"), "a and b keep what made them"


def test_what_is_read_back_alone_keeps_the_code_that_made_it(tmp_path: Path) -> None:
    path = tmp_path / "stages.json"
    with Workers(1, threads=1) as workers:
        Stages(workers, path, MADE).run("sleep", _sleep, 1.0, [(0.01, "a")])
        later = Stages(workers, path, MADE | {"revision": "b2", "date": "2026-11-24"})
        later.run("sleep", _sleep, 0.0, [(0.01, "a")])
        assert (later.made["revision"], later.made["date"]) == ("a1", "2026-11-23")
        path.with_name("origins.json").unlink()
        unsigned = Stages(workers, path, MADE)
        unsigned.run("sleep", _sleep, 0.0, [(0.01, "a")])
    assert unsigned.made["revision"] == "unknown", "of an account that nobody signed nothing is claimed"


def test_seconds_that_a_job_spent_for_another_stage_are_booked_there(tmp_path: Path) -> None:
    with Workers(1, threads=1) as workers:
        stages = Stages(workers, tmp_path / "stages.json", MADE)
        stages.run("collect", _sleep_and_rank, 1.0, [(0.6,)])
    assert stages.seconds["rank"] == 0.59 and 0.01 <= stages.seconds["collect"] < 0.6


def test_a_job_that_knows_what_it_took_is_believed(tmp_path: Path) -> None:
    with Workers(1, threads=1) as workers:
        stages = Stages(workers, tmp_path / "stages.json", MADE)
        stages.run("align", _trained_before, 7.0, [()])
    assert stages.seconds == {"align": 7.0}


def _trained_before(seconds: float) -> dict[str, float]:
    return {"align": seconds}


def _sleep_and_rank(factor: float, seconds: float) -> dict[str, float]:
    time.sleep(factor * seconds)
    return {"rank": seconds - 0.01}


def _sleep(factor: float, seconds: float, name: str) -> None:
    time.sleep(factor * seconds)


if __name__ == "__main__":
    pytest.main([__file__])
