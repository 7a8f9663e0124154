"""The stages of the experiment on tiny scenes: what each writes, and that it goes on where it stopped."""

from __future__ import annotations

import dataclasses
import json
import re
import shutil
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDict

from dpa.losses import ContrastivePreferenceLoss, token_network
from dpa.models import Contexts, make_context
from dpa.models.motionlm import MotionLM, featurize
from dpa.preferences import PreferenceStore, PreferenceWriter, nearest_farthest
from dpa.realism import CLASS_RATES
from dpa.realism.config import FOLDER
from dpa.realism.score import score
from dpa.realism.submission import validate
from dpa.tokens import VerletTokenizer
from dpa.training.checkpoint import load_policy
from dpa.training.distributed import Ranks
from dpa.training.loggers import read_curve
from dpa.training.optim import accumulate_gradients, clip_and_step
from envs import keys
from envs.convert import convert
from envs.scene import CURRENT_STEP
from envs.seeding import derive_seed
from envs.sources.synthetic import straight_road
from envs.store import SceneStore
from recipes import evaluate as evaluation
from recipes.alignment.candidates import Candidates, Group, make_candidates
from recipes.alignment.data import READ
from recipes.alignment.draws import draw_rows, make_batch, parts_of
from recipes.alignment.inputs import Inputs
from recipes.alignment.likelihoods import SIDED
from recipes.alignment.losses import check_fit, make_loss
from recipes.alignment.watch import Look, Watch
from recipes.common.cli import CONFIG, plain
from recipes.common.kinds import taken_by
from recipes.common.models import episode_options, open_policy
from recipes.common.partial import PartialResult
from recipes.common.rolled import Rolled, final_spread
from recipes.common.scenes import open_splits
from recipes.evaluate import FIGURES, standing_moved
from recipes.experiment.jobs import align_job
from recipes.experiment.pool import Job, Workers
from recipes.ladder import SIMULATOR
from recipes.pretrain import tuning_items

METHODS = ("dpa_omf", "dpa_adef", "sft_best_oa", "sft_best_ade", "adversarial_afd")


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory, run: Callable, options: Callable) -> Path:
    """A folder with a trained ``reference`` and its ``preferences``."""
    folder = tmp_path_factory.mktemp("stages")
    outcome = run("pretrain", *options("pretrain", f"output={folder / 'reference'}"))
    assert outcome.status == 0, outcome.err
    outcome = run("collect", *collect_into(folder / "preferences", folder, options))
    assert outcome.status == 0, outcome.err
    return folder


def collect_into(folder: Path, runs: Path, options: Callable) -> list[str]:
    return options("collect", f"policy={runs / 'reference/policy.pt'}", f"output={folder}")


def weights(path: Path) -> torch.Tensor:
    return torch.cat([value.flatten().double() for value in load_policy(path)[0].values()])


# --- pretrain -------------------------------------------------------------------------------------------------------
def test_pretraining_writes_a_policy_and_its_curves(runs: Path) -> None:
    model, episode, config = open_policy(runs / "reference/policy.pt")
    assert model.config.width == 48 and episode.horizon == 16
    assert config["tokenizer"]["name"] == "verlet"
    losses = read_curve(runs / "reference", "train/loss_next_token")
    assert [step for step, _ in losses] == [1, 2, 3, 4, 5, 6]
    assert losses[-1][1] < losses[0][1]
    assert [step for step, _ in read_curve(runs / "reference", "tune/nll")] == [3, 6]


def test_tuning_scenes_without_a_token_to_predict_are_refused() -> None:
    scene = straight_road(2)
    scene.agents.predict[:] = False
    with initialize_config_dir(CONFIG["config_path"], version_base="1.3"):
        cfg = compose("pretrain", ["model=nano", "model.episode.control=predict"])
    with pytest.raises(ValueError, match="none of the 1 tuning scenes has a token to predict: .*control=predict"):
        tuning_items(cfg, [scene], MotionLM("nano", VerletTokenizer()), episode_options(cfg.model))


def test_the_weights_that_are_best_on_the_tuning_scenes_are_kept(runs: Path) -> None:
    *_, metadata = load_policy(runs / "reference/policy.pt")
    assert metadata["tune_nll"] == pytest.approx(min(value for _, value in read_curve(runs / "reference", "tune/nll")))


def test_a_seed_decides_the_policy(run: Callable, options: Callable, runs: Path, tmp_path: Path) -> None:
    for name, seed in (("same", 0), ("other", 1)):
        assert run("pretrain", *options("pretrain", f"output={tmp_path / name}", f"seed={seed}")).status == 0
    reference = weights(runs / "reference/policy.pt")
    assert torch.equal(weights(tmp_path / "same/policy.pt"), reference)
    assert not torch.equal(weights(tmp_path / "other/policy.pt"), reference)


def test_a_finished_training_is_read_back_at_once(run: Callable, options: Callable, runs: Path) -> None:
    before = (runs / "reference/policy.pt").stat().st_mtime_ns
    outcome = run("pretrain", *options("pretrain", f"output={runs / 'reference'}"))
    assert outcome.status == 0 and "policy.pt" in outcome.out
    assert "step/s" not in outcome.err, "nothing is trained"
    assert (runs / "reference/policy.pt").stat().st_mtime_ns == before


# --- collect --------------------------------------------------------------------------------------------------------
def contents(folder: Path) -> dict[int, list]:
    """Scene -> everything that the store keeps of it."""
    store = PreferenceStore(folder)
    return {
        int(scene): [value.tolist() for _, value in sorted(store[row].items())]
        for row, scene in enumerate(store.scenes)
    }


def test_every_training_scene_gets_a_ranked_group(runs: Path) -> None:
    store = PreferenceStore(runs / "preferences")
    assert sorted(store.scenes.tolist()) == list(range(6)), "8 scenes, two of them for tuning"
    group = store[0]
    assert group[keys.TOKENS].shape[1] == 4 and group[keys.TOKENS].shape[-1] == 16
    assert sorted(group[keys.RANK][0].tolist()) == [0, 1, 2, 3]
    assert (group[keys.DISTANCE][0].argsort(stable=True) == group[keys.RANK][0].argsort()).all()


class Stopped(Exception):
    """Stands for a kill."""


def test_collecting_goes_on_where_it_stopped_even_inside_a_group(
    run: Callable, options: Callable, runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    command = collect_into(tmp_path / "preferences", runs, options)
    import recipes.collect as collecting

    whole = collecting.make_collector

    def stop_after_two(*args: object, **kwargs: object) -> Iterator:
        for number, batch in enumerate(whole(*args, **kwargs)):
            if number == 2:
                raise Stopped
            yield batch

    with monkeypatch.context() as patch:
        patch.setattr(collecting, "make_collector", stop_after_two)
        patch.setattr(collecting.PreferenceWriter, "__exit__", lambda *_: None)  # as a kill does
        assert run("collect", *command).status == 1
    kept = PreferenceStore(tmp_path / "preferences").scenes.tolist()
    assert 0 < len(kept) < 6
    assert run("collect", *command).status == 0
    assert contents(tmp_path / "preferences") == contents(runs / "preferences")


def test_two_commands_share_the_scenes_of_one_folder(
    run: Callable, options: Callable, runs: Path, tmp_path: Path
) -> None:
    command = collect_into(tmp_path / "preferences", runs, options)
    first = run("collect", *command, "part=1", "parts=2")
    assert first.status == 0 and "preferences of 3 scenes" in first.out
    second = run("collect", *command, "part=0", "parts=2")
    assert second.status == 0 and "preferences of 6 scenes" in second.out and "3/3" in second.err
    assert contents(tmp_path / "preferences") == contents(runs / "preferences")
    outcome = run("collect", *command, "part=2", "parts=2")
    assert outcome.status == 2 and "part must be from 0 to parts - 1, got part=2 of parts=2" in outcome.err


def test_the_data_card_is_written_on_request(run: Callable, options: Callable, runs: Path, tmp_path: Path) -> None:
    command = collect_into(runs / "preferences", runs, options)
    assert run("collect", *command, f"json={tmp_path / 'card.json'}").status == 0
    card = json.loads((tmp_path / "card.json").read_text())
    assert card["scenes"] == 6 and card["classes"]["vehicle"]["agents"] == card["agents"]


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["process", "ray"])
def test_workers_fill_the_same_store_byte_for_byte(
    run: Callable, options: Callable, runs: Path, tmp_path: Path, backend: str
) -> None:
    if backend == "ray":
        ray = pytest.importorskip("ray")
    workers = ["collection.workers.count=2", f"collection.workers.backend={backend}", "collection.workers.threads=1"]
    try:
        assert run("collect", *collect_into(tmp_path / "preferences", runs, options), *workers).status == 0
    finally:
        if backend == "ray":
            ray.shutdown()
    assert contents(tmp_path / "preferences") == contents(runs / "preferences")


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ("collection.workers.count=2", "2 workers need backend=process or backend=ray"),
        ("collection.memory=0", "collection.memory must be above 0, got 0"),
        ("collection.precision=float16", "precision must be one of float32, bfloat16, got 'float16'"),
        ("collection.num_rollouts=-1", "collection.num_rollouts must be 1 or more, got -1"),
        ("collection.ranking.kind=taste", "collection.ranking.kind must be one of .*, got 'taste'"),
        ("collection.decoding.top_k=-1", "collection.decoding.top_k must be 0 or more, got -1"),
    ],
)
def test_a_wrong_option_is_told_before_a_store_is_begun(
    run: Callable, options: Callable, runs: Path, tmp_path: Path, option: str, message: str
) -> None:
    outcome = run("collect", *collect_into(tmp_path / "preferences", runs, options), option)
    assert outcome.status == 2 and re.search(message, outcome.err)
    assert not (tmp_path / "preferences").exists()


def test_rollouts_can_be_ranked_by_displacement(run: Callable, options: Callable, runs: Path, tmp_path: Path) -> None:
    command = [o for o in collect_into(tmp_path / "preferences", runs, options) if "ranking.stride" not in o]
    outcome = run("collect", *command, "ranking@collection.ranking=displacement")
    assert outcome.status == 0, outcome.err
    store, other = (PreferenceStore(folder) for folder in (tmp_path / "preferences", runs / "preferences"))
    assert store.provenance.ranking["kind"] == "displacement"
    torch.testing.assert_close(store[:][keys.DISTANCE], store[:][keys.ADE])
    torch.testing.assert_close(store[:][keys.ADE], other[:][keys.ADE])


def test_collecting_again_adds_nothing(run: Callable, options: Callable, runs: Path) -> None:
    before = contents(runs / "preferences")
    outcome = run("collect", *collect_into(runs / "preferences", runs, options))
    assert outcome.status == 0 and "preferences of 6 scenes" in outcome.out
    assert contents(runs / "preferences") == before


# --- candidates -----------------------------------------------------------------------------------------------------
def compose_recipe(recipe: str, options: Callable, runs: Path) -> DictConfig:
    """Options of a recipe on the results of ``runs``."""
    with initialize_config_dir(CONFIG["config_path"], version_base="1.3"):
        return compose(recipe, options(recipe, f"policy={runs}", f"preferences={runs}"))


def pairs_of(runs: Path, options: Callable, expert: PreferenceStore | None = None, **data: object) -> Candidates:
    """Candidates from the preferences, with ``data`` over those of DPA-OMF."""
    cfg = compose_recipe("align", options, runs)
    scenes = open_splits(cfg.scenes).train
    store = PreferenceStore(runs / "preferences")
    model, episode, _ = open_policy(runs / "reference/policy.pt")
    section = OmegaConf.merge(OmegaConf.create(plain(cfg.method.data)), {"num": 2}, data)
    section = OmegaConf.masked_copy(section, ["kind", *READ.get(section.kind, ())])
    return make_candidates(
        section, store, Contexts(scenes, model.featurize, episode), model.tokenizer, seed=0, expert=expert
    )


@pytest.mark.parametrize("rank_by", ["distance", "ade"])
def test_the_nearest_rollouts_are_imitated(runs: Path, options: Callable, rank_by: str) -> None:
    store = PreferenceStore(runs / "preferences")
    for row, group in enumerate(pairs_of(runs, options, kind="best", num=2, rank_by=rank_by)):
        stored = store.read([row], num_agents=group.preferred.shape[1])[0]
        nearest = stored[rank_by].argsort(dim=-1, stable=True)[:2]
        assert torch.equal(group.preferred, stored[keys.TOKENS][nearest])
    by_distance, by_ade = (getattr(store, name).argsort(dim=-1, stable=True)[:, :2] for name in ("distance", "ade"))
    assert not torch.equal(by_distance, by_ade), "so the two cannot be mistaken for each other"


@pytest.mark.parametrize(
    ("data", "counts"),
    [
        ({}, [2] * 6),
        ({"pairs": "random"}, [2] * 6),
        ({"pairs": "all", "num": None}, [6] * 6),
        ({"pairs": "all", "num": None, "rankings_per_scene": 4}, [4] * 6),
        ({"rankings_per_scene": 0.5}, [1] * 3),
        ({"rankings_per_scene": 1.5}, [1, 1, 1, 2, 2, 2]),
    ],
)
def test_the_options_of_a_method_decide_its_pairs(
    runs: Path, options: Callable, data: dict[str, object], counts: list[int]
) -> None:
    groups = pairs_of(runs, options, **data)
    assert sorted(len(group.preferred) for group in groups) == counts
    assert all(group.preferred.shape == group.unpreferred.shape for group in groups)
    again = pairs_of(runs, options, **data)
    assert all(torch.equal(a.preferred, b.preferred) for a, b in zip(groups, again, strict=True))


def test_candidates_are_read_when_they_are_asked_for(runs: Path, options: Callable) -> None:
    groups = pairs_of(runs, options)
    with mock.patch.object(PreferenceStore, "read", side_effect=groups.store.read) as read:
        first, again = groups[4], groups[4]
    assert read.call_count == 2, "nothing of the rollouts is kept"
    assert torch.equal(first.preferred, again.preferred) and first.context is again.context


def test_a_margin_leaves_the_clear_pairs(runs: Path, options: Callable) -> None:
    store, margin = PreferenceStore(runs / "preferences"), 0.3
    preferred, unpreferred = nearest_farthest(store.distance, 2)
    gap = store.distance.gather(1, unpreferred) - store.distance.gather(1, preferred)
    clear = (gap >= margin * store.distance.mean(1, keepdim=True)).sum(1)
    assert 0 < int(clear.sum()) < 12, "some pairs on either side"
    kept = [len(group.preferred) for group in pairs_of(runs, options, margin=margin)]
    assert kept == [number for number in clear.tolist() if number]


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"pairs": "some"}, "method.data.pairs must be one of nearest_farthest, random, all, got 'some'"),
        ({"pairs": "all"}, "method.data.num=2 asks for some; say method.data.num=null"),
        ({"pairs": "all", "num": 0.25}, "method.data.num=0.25 (1) asks for some"),
        ({"num": 0.75}, "method.data.num=0.75 (3) needs 6 rollouts of a scene and there are 4"),
        ({"num": None}, "method.data.num must be a whole number, or a share between 0 and 1, got None"),
        ({"margin": 50.0}, "method.data.margin=50.0 leaves no pair"),
        ({"margin": -1.0}, "method.data.margin must be 0 or more, got -1.0"),
        ({"rankings_per_scene": 0}, "method.data.rankings_per_scene must be positive, got 0"),
        ({"kind": "best", "num": 0}, "method.data.num must be 1 or more, got 0"),
        ({"kind": "best", "num": 5}, "method.data.num=5 needs 5 rollouts of a scene and there are 4"),
        (
            {"kind": "sets", "num_unpreferred": 3},
            "method.data.num=2 and method.data.num_unpreferred=3 needs 5 rollouts",
        ),
        (
            {"kind": "sets", "num_unpreferred": None},
            "num_unpreferred must be a whole number, or a share between 0 and 1, got None",
        ),
        ({"num": 1.5}, "method.data.num must be a whole number, or a share between 0 and 1, got 1.5"),
        ({"kind": "ranking", "num": 1}, "a ranking needs two rollouts, got method.data.num=1"),
        ({"kind": "expert"}, "needs rollouts of an expert, and there are none"),
        (
            {"kind": "worst"},
            "expert, closed_loop, own_pairs, own_groups, got 'worst'",
        ),
    ],
)
def test_options_that_give_no_pairs_are_told(
    runs: Path, options: Callable, data: dict[str, object], message: str
) -> None:
    with pytest.raises(ValueError, match=re.escape(message)):
        pairs_of(runs, options, **data)


@pytest.mark.parametrize(("share", "number"), [(0.25, 1), (0.5, 2), (0.1, 1)])
def test_a_share_of_the_rollouts_is_as_many_of_them(runs: Path, options: Callable, share: float, number: int) -> None:
    mine, other = (pairs_of(runs, options, num=num) for num in (share, number))
    for one, two in zip(mine, other, strict=True):
        assert torch.equal(one.preferred, two.preferred) and torch.equal(one.unpreferred, two.unpreferred)


def ranks_of(runs: Path, row: int, tokens: torch.Tensor) -> list[int]:
    """Rank of each rollout ``[M, A, T]`` within its scene's group."""
    group = PreferenceStore(runs / "preferences").read([row], num_agents=tokens.shape[1])[0]
    found = [(group[keys.TOKENS] == one).all(-1).all(-1).nonzero()[0, 0] for one in tokens]
    return [int(group[keys.RANK][i]) for i in found]


def test_sets_are_the_nearest_and_the_farthest_rollouts(runs: Path, options: Callable) -> None:
    for row, group in enumerate(pairs_of(runs, options, kind="sets", num=1, num_unpreferred=2)):
        assert group.sides == "sets"
        assert ranks_of(runs, row, group.preferred) == [0] and ranks_of(runs, row, group.unpreferred) == [3, 2]


@pytest.mark.parametrize(("num", "nearer", "farther"), [(None, [0, 1], [2, 3]), (3, [0, 2], [3]), (2, [0], [3])])
def test_a_ranking_is_spread_over_the_ranks_nearest_first(
    runs: Path, options: Callable, num: int | None, nearer: list[int], farther: list[int]
) -> None:
    for row, group in enumerate(pairs_of(runs, options, kind="ranking", num=num)):
        assert group.sides == "ranking"
        assert ranks_of(runs, row, group.preferred) == nearer and ranks_of(runs, row, group.unpreferred) == farther


def test_pairs_ranked_by_distance_say_what_each_agent_prefers(runs: Path, options: Callable) -> None:
    store = PreferenceStore(runs / "preferences")
    for row, group in enumerate(pairs_of(runs, options)):
        distance = store.read([row], num_agents=group.preferred.shape[1])[keys.AGENT_DISTANCE][0]
        near, far = nearest_farthest(store.distance[row][None], 2)
        assert torch.equal(group.agent_preference, (distance[far[0]] - distance[near[0]]).sign().long())
    assert all(group.agent_preference is None for group in pairs_of(runs, options, rank_by="ade"))


class ExpertStore(PreferenceStore):
    """Rollouts of a policy that takes the next token of the vocabulary wherever the reference takes one."""

    def read(self, *arguments: Any, **options: Any) -> TensorDict:
        group = super().read(*arguments, **options)
        return group.set(keys.TOKENS, group[keys.TOKENS] + 1)


def test_rollouts_of_an_expert_are_preferred_to_those_of_the_reference(runs: Path, options: Callable) -> None:
    store = PreferenceStore(runs / "preferences")
    groups = pairs_of(runs, options, ExpertStore(store.folder), kind="expert", num=4)
    assert len(groups) == 6
    for row, group in enumerate(groups):
        every = store.read([row], num_agents=group.preferred.shape[1])[keys.TOKENS][0]
        for side, drawn_from in ((group.preferred, every + 1), (group.unpreferred, every)):
            drawn, rollouts = (sorted(each.flatten(1).tolist()) for each in (side, drawn_from))
            assert drawn == rollouts, "all four of each, drawn without repetition"


def test_the_log_stands_against_rollouts_that_nothing_ranked(runs: Path, options: Callable) -> None:
    store = PreferenceStore(runs / "preferences")
    tokenizer, drawn = open_policy(runs / "reference/policy.pt")[0].tokenizer, []
    for row, group in enumerate(pairs_of(runs, options, kind="adversarial", num=3)):
        context = group.context
        log = tokenizer.encode_tracks(
            context.episode.logged, context.episode.logged_valid, context.episode.recent, context.episode.kind
        )
        assert all(torch.equal(each, log.tokens) for each in group.preferred) and len(group.preferred) == 3
        held = store.read([row], num_agents=len(context.episode.kind))[0]
        assert torch.equal(group.token_valid, held[keys.TOKEN_VALID] & log.valid & context.episode.controlled[:, None])
        ranks = ranks_of(runs, row, group.unpreferred)
        assert len(set(ranks)) == 3, "rollouts of the scene, each once"
        drawn.append(tuple(sorted(ranks)))
        moved = (log.poses - context.episode.logged)[..., :2].norm(dim=-1)[
            log.valid.repeat_interleave(tokenizer.steps, -1)
        ]
        assert moved.mean() < 0.5, "tokens of the log drive the log"
    assert len(set(drawn)) > 1, "not always the same ranks"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"scenes": "elsewhere"}, "has scenes elsewhere and"),
        ({"tokenizer": {"name": "verlet", "turn": 2.0}}, "has tokenizer {'name': 'verlet', 'turn': 2.0} and"),
        ({"num_rollouts": 1}, "needs as many rollouts of the expert and"),
        ({}, "lacks 6 scenes of"),
    ],
)
def test_an_expert_that_does_not_fit_is_told(
    runs: Path, options: Callable, tmp_path: Path, change: dict, message: str
) -> None:
    origin = PreferenceStore(runs / "preferences").provenance
    with PreferenceWriter(tmp_path / "expert", dataclasses.replace(origin, **change)):
        pass
    with pytest.raises(ValueError, match=message):
        pairs_of(runs, options, PreferenceStore(tmp_path / "expert"), kind="expert")


# --- draws ----------------------------------------------------------------------------------------------------------
def numbered(num: int, num_unpreferred: int, sides: str, agents: int = 2) -> Group:
    """Rollouts whose tokens are their row, the unpreferred ones from 100 on; agents' preferences are the row too."""
    rows = torch.arange(num)[:, None, None].expand(-1, agents, 16)
    others = 100 + torch.arange(num_unpreferred)[:, None, None].expand(-1, agents, 16)
    valid = torch.ones(agents, 16, dtype=torch.bool)
    say = rows[:, :, 0] if sides == "pairs" else None
    return Group(make_context(straight_road(agents), featurize), rows, others, valid, say, sides)


def test_pairs_stay_pairs_and_agents_keep_their_say() -> None:
    draw = torch.Generator().manual_seed(0)
    groups = [numbered(6, 6, "pairs", agents) for agents in (2, 3)]
    batch = make_batch([draw_rows(group, 3, draw) for group in groups])
    first, second = batch[keys.PREFERRED][:, :, 0, 0], batch[keys.UNPREFERRED][:, :, 0, 0]
    assert first.shape == (2, 3) and torch.equal(second, first + 100)
    assert torch.equal(batch[keys.AGENT_PREFERENCE][1], first[1][:, None].expand(-1, 3))
    assert torch.equal(batch[keys.AGENT_PREFERENCE][0, :, 2], torch.zeros(3, dtype=torch.int64)), "padding says nothing"


@pytest.mark.parametrize(("num", "sizes"), [(1, (1, 2)), (2, (2, 4)), (3, (3, 6)), (9, (4, 8))])
def test_sides_that_are_not_paired_are_drawn_apart_in_proportion(num: int, sizes: tuple[int, int]) -> None:
    draw, seen = torch.Generator().manual_seed(0), set()
    for _ in range(20):
        drawn = draw_rows(numbered(4, 8, "sets"), num, draw)
        assert (len(drawn.preferred), len(drawn.unpreferred)) == sizes
        seen.add((tuple(drawn.preferred.tolist()), tuple(drawn.unpreferred.tolist())))
    assert len(seen) > 4 or num == 9


def test_what_is_drawn_of_a_ranking_is_a_ranking() -> None:
    draw = torch.Generator().manual_seed(0)
    for _ in range(20):
        batch = make_batch([draw_rows(numbered(8, 8, "ranking"), 4, draw)])
        order = torch.cat((batch[keys.PREFERRED], batch[keys.UNPREFERRED]), 1)[0, :, 0, 0]
        assert len(order) == 8 and (order.diff() > 0).all()


def test_a_step_asks_for_no_more_pairs_than_every_scene_has(
    run: Callable, options: Callable, runs: Path, tmp_path: Path
) -> None:
    given = (f"policy={runs / 'reference/policy.pt'}", f"preferences={runs / 'preferences'}", "method.data.num=2")
    ragged = ("method.data.rankings_per_scene=1.5", "alignment.pairs_per_scene=2")
    outcome = run("align", *options("align", *given, *ragged, f"output={tmp_path / 'out'}"))
    assert outcome.status == 2
    assert "scenes have 1 to 2 pairs after method.data.margin" in outcome.err
    assert "say alignment.pairs_per_scene=1" in outcome.err


# --- align ----------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("method", METHODS)
def test_every_method_aligns_the_reference(
    run: Callable, options: Callable, runs: Path, tmp_path: Path, method: str
) -> None:
    outcome = run(
        "align",
        *options(
            "align",
            f"method={method}",
            "method.data.num=2",
            f"policy={runs / 'reference/policy.pt'}",
            f"preferences={runs / 'preferences'}",
            f"output={tmp_path / method}",
        ),
    )
    assert outcome.status == 0, outcome.err
    aligned, reference = weights(tmp_path / method / "policy.pt"), weights(runs / "reference/policy.pt")
    assert aligned.isfinite().all() and not torch.equal(aligned, reference)
    *_, metadata = load_policy(tmp_path / method / "policy.pt")
    assert metadata["method"] == method
    if method.startswith("sft"):
        assert len(read_curve(tmp_path / method, "train/loss_next_token")) == 4
    else:
        start = read_curve(tmp_path / method, "train/loss_preference")[0][1]
        assert start == pytest.approx(0.693147, abs=1e-5), "log 2: the policy starts as its own reference"


@pytest.mark.parametrize(
    ("method", "start"), [("kto", 0.5), ("listwise", 1.059351), ("ipo", 0.25), ("per_agent", 0.693147), ("simpo", None)]
)
def test_other_losses_align_the_reference(
    run: Callable, options: Callable, runs: Path, tmp_path: Path, method: str, start: float | None
) -> None:
    given = [f"method={method}", "method.data.num=2", f"output={tmp_path / method}"]
    given += ["method.data.num_unpreferred=2"] if method == "kto" else []
    given += ["alignment.pairs_per_scene=2", "method.data.num=4"] if method == "listwise" else []
    given += [f"policy={runs / 'reference/policy.pt'}", f"preferences={runs / 'preferences'}"]
    outcome = run("align", *options("align", *given))
    assert outcome.status == 0, outcome.err
    losses = [value for _, value in read_curve(tmp_path / method, "train/loss_preference")]
    assert len(losses) == 4
    assert start is None or losses[0] == pytest.approx(start, abs=1e-5), "the policy starts as its own reference"
    assert not torch.equal(weights(tmp_path / method / "policy.pt"), weights(runs / "reference/policy.pt"))


CONFIGURED = sorted(path.stem for path in Path(CONFIG["config_path"], "method").glob("*.yaml"))


@pytest.mark.parametrize("method", CONFIGURED)
def test_the_loss_of_every_method_can_be_built_and_reads_its_data(method: str) -> None:
    with initialize_config_dir(CONFIG["config_path"], version_base="1.3"):
        cfg = compose("align", [f"method={method}", "alignment.pairs_per_scene=2"])
    section = cfg.method
    assert section.name == method
    check_fit(section, cfg.alignment, held=32)
    loss = make_loss(section.loss, MotionLM("nano", VerletTokenizer()))
    given = {key for key in section.loss if key != "kind"}
    assert given == set(taken_by(type(loss)).parameters) - {"actor_network"}, "the YAML shows every option"


@pytest.mark.parametrize(
    ("loss", "data", "message"),
    [
        ("plackett_luce", "pairs", "plackett_luce learns from ranking, and method.data.kind=pairs gives pairs; say "
         "method.data.kind=ranking, or another loss"),
        ("contrastive", "sets", "gives sets; say method.data.kind=pairs or adversarial or expert"),
        ("kahneman_tversky", "best", "gives targets; say method.data.kind=pairs or sets or adversarial or expert"),
        ("next_token", "pairs", "next_token learns from targets"),
        ("kahneman_tversky", "own_pairs", "gives pairs in parts; say method.data.kind=pairs or sets"),
    ],
)  # fmt: skip
def test_a_loss_that_would_misread_the_data_is_refused(loss: str, data: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        check_fit(
            OmegaConf.create({"loss": {"kind": loss}, "data": {"kind": data}}),
            OmegaConf.create({"pairs_per_scene": 2}),
            held=32,
        )


@pytest.mark.parametrize(
    ("given", "told"),
    [
        (["method.data.num=null", "alignment.pairs_per_scene=1"], "method.data.num=None of 4 rollouts and"),
        (["method.data.num=2", "alignment.pairs_per_scene=4"], "alignment.pairs_per_scene=4 leave 2; say"),
        (["method.data.num=0.5", "alignment.pairs_per_scene=4"], "method.data.num=0.5 of 4 rollouts and"),
    ],
)
def test_a_ranking_of_two_is_refused_before_a_step(
    run: Callable, options: Callable, runs: Path, tmp_path: Path, given: list[str], told: str
) -> None:
    given = [*given, f"policy={runs / 'reference/policy.pt'}", f"preferences={runs / 'preferences'}"]
    outcome = run("align", *options("align", "method=listwise", *given, f"output={tmp_path / 'run'}"))
    assert outcome.status == 2 and told in outcome.err
    assert not (tmp_path / "run").exists()


def test_rollouts_of_an_expert_that_a_method_does_not_read_are_refused(
    run: Callable, options: Callable, runs: Path, tmp_path: Path
) -> None:
    command = watched(runs, options, tmp_path / "run", f"expert={runs / 'preferences'}")
    outcome = run("align", *command)
    assert outcome.status == 2
    assert "preferences holds rollouts of an expert, and method.data.kind=pairs reads none; leave expert" in outcome.err


def test_watched_rollouts_in_other_tokens_are_refused(
    run: Callable, options: Callable, runs: Path, tmp_path: Path
) -> None:
    tuned = tmp_path / "tuned"
    assert run("collect", *collect_into(tuned, runs, options), "split=tune").status == 0
    origin = tuned / "metadata.json"
    content = json.loads(origin.read_text())
    content["tokenizer"]["bins"] = "other"
    origin.write_text(json.dumps(content))
    for piece in tuned.glob("*.groups"):  # of the store as it was
        piece.unlink()
    policy, output = f"policy={runs / 'reference/policy.pt'}", f"output={tmp_path / 'rloo'}"
    rolled = options("align", "method=rloo", policy, output, f"watch={tuned}")
    for command in (watched(runs, options, tmp_path / "run", f"watch={tuned}"), rolled):
        outcome = run("align", *command)
        assert outcome.status == 2
        assert f"{tuned} has tokenizer" in outcome.err and "let a policy of the same tokens roll" in outcome.err


def watched(runs: Path, options: Callable, folder: Path, *more: str) -> list[str]:
    given = [f"policy={runs / 'reference/policy.pt'}", f"preferences={runs / 'preferences'}", f"output={folder}"]
    return options("align", *given, "method.data.num=2", "alignment.watch_interval=2", *more)


@pytest.mark.parametrize("seed", [0, 1])
def test_pairs_of_a_step_are_drawn_by_its_number_and_the_seed(
    run: Callable, options: Callable, runs: Path, tmp_path: Path, seed: int
) -> None:
    with mock.patch("recipes.alignment.step.parts_of", wraps=parts_of) as drawing:
        outcome = run("align", *watched(runs, options, tmp_path / "omf", f"seed={seed}"))
    assert outcome.status == 0, outcome.err
    drawn = [call.args[2].initial_seed() for call in drawing.call_args_list]
    assert drawn == [derive_seed(seed, "pairs", step) for step in range(4)]


def test_scenes_that_no_loss_sees_are_looked_at_along_the_way(
    run: Callable, options: Callable, runs: Path, tmp_path: Path
) -> None:
    tuned = [*collect_into(tmp_path / "tuned", runs, options), "split=tune"]
    assert run("collect", *tuned).status == 0
    command = watched(runs, options, tmp_path / "omf", f"watch={tmp_path / 'tuned'}", "alignment.snapshots=[2,4]")
    with mock.patch("recipes.align.SaturationWatch", _interrupting(3)):
        assert run("align", *command).status == 130
    outcome = run("align", *command)
    assert outcome.status == 0, outcome.err
    for name in (
        "nll_preferred",
        "nll_unpreferred",
        "nll_demonstration",
        "pair_accuracy",
        "reward_accuracy",
        "entropy",
        "kl",
    ):
        curve = read_curve(tmp_path / "omf", f"tune/{name}")
        assert [step for step, _ in curve] == [0, 2, 4], "each step once, also after a kill"
    drift = [value for _, value in read_curve(tmp_path / "omf", "tune/kl")]
    assert drift[0] == pytest.approx(0, abs=1e-7) and drift[-1] > 0
    plain_run = watched(runs, options, tmp_path / "plain")
    assert run("align", *plain_run).status == 0
    last = weights(tmp_path / "omf/policy.pt")
    assert torch.equal(last, weights(tmp_path / "plain/policy.pt")), "looking changes nothing"
    assert torch.equal(last, weights(tmp_path / "omf/step_4/policy.pt"))
    assert not torch.equal(last, weights(tmp_path / "omf/step_2/policy.pt"))


@pytest.mark.parametrize(
    ("method", "rank_by"),
    [("sft_best_oa", "distance"), pytest.param("sft_best_ade", "ade", marks=pytest.mark.slow)],
)
def test_imitation_logs_how_likely_near_and_far_rollouts_of_its_own_scenes_are(
    run: Callable, options: Callable, runs: Path, tmp_path: Path, method: str, rank_by: str
) -> None:
    looks = [f"method={method}", "alignment.watch_scenes=3", "alignment.watch_pairs=1"]
    assert run("align", *watched(runs, options, tmp_path / "sft", *looks)).status == 0
    curves = {name: read_curve(tmp_path / "sft", f"train/{name}") for name in SIDED}
    assert all([step for step, _ in curve] == [0, 2, 4] for curve in curves.values())

    cfg = compose_recipe("align", options, runs)
    store, scenes = PreferenceStore(runs / "preferences"), open_splits(cfg.scenes).train
    for policy, place in (("reference", 0), ("sft", -1)):
        model, episode, _ = open_policy((tmp_path if place else runs) / policy / "policy.pt")
        loss, found = ContrastivePreferenceLoss(token_network(model.eval())), []
        for row in range(3):
            seen = make_context(scenes[int(store.scenes[row])], model.featurize, episode)
            stored = store.read([row], num_agents=len(seen.episode.kind))[0]
            order = stored[rank_by].argsort()
            near, far = (stored[keys.TOKENS][order[[rank]]] for rank in (0, -1))
            pair = draw_rows(Group(seen, near, far, stored[keys.TOKEN_VALID]), 1, torch.Generator())
            found.append(loss(make_batch([pair])))
        for name, curve in curves.items():
            wanted = sum(each[name].item() for each in found) / 3
            assert curve[place][1] == pytest.approx(wanted, abs=1e-5), (policy, name)

    seldom = [*watched(runs, options, tmp_path / "seldom", *looks), "alignment.watch_interval=4"]
    assert run("align", *seldom).status == 0
    sft, other = (weights(tmp_path / name / "policy.pt") for name in ("sft", "seldom"))
    assert torch.equal(sft, other), "looking changes nothing"


def test_imitation_of_single_rollouts_has_no_far_side_to_look_at(
    run: Callable, options: Callable, runs: Path, tmp_path: Path
) -> None:
    single = [*collect_into(tmp_path / "single", runs, options), "collection.num_rollouts=1"]
    assert run("collect", *single).status == 0
    given = ["method=sft_best_oa", f"preferences={tmp_path / 'single'}", f"output={tmp_path / 'sft'}"]
    outcome = run("align", *options("align", *given, f"policy={runs / 'reference/policy.pt'}"))
    assert outcome.status == 0, outcome.err
    assert not (tmp_path / "sft/scalars/train/pair_accuracy.csv").exists()


def _interrupting(step: int) -> type:
    """A watch for saturation during which somebody presses Ctrl-C."""

    class Interrupting:
        found = None

        def __init__(self, *options: object) -> None: ...

        def __call__(self, now: int, figures: object) -> None:
            if now == step:
                raise KeyboardInterrupt

    return Interrupting


def test_drift_is_measured_from_the_reference_also_in_a_second_round(
    run: Callable, options: Callable, runs: Path, tmp_path: Path
) -> None:
    assert run("collect", *collect_into(tmp_path / "tuned", runs, options), "split=tune").status == 0
    assert run("align", *watched(runs, options, tmp_path / "first")).status == 0
    cfg = compose_recipe("align", options, runs)
    watch = Watch(open_splits(cfg.scenes).tune, tmp_path / "tuned", runs / "reference/policy.pt")
    drift = {}
    for name in ("reference", "first"):
        model, episode, config = open_policy((tmp_path if name == "first" else runs) / name / "policy.pt")
        drift[name] = Look(watch, episode, model, cfg.alignment, config["tokenizer"])("cpu")["tune/kl"]
    assert drift["reference"] == pytest.approx(0, abs=1e-7) and drift["first"] > 1e-5


def test_an_alignment_is_not_taken_for_that_of_other_rollouts_of_the_same_policy(
    run: Callable, options: Callable, runs: Path, tmp_path: Path
) -> None:
    other = collect_into(tmp_path / "other", runs, options)
    assert run("collect", *other, "seed=7").status == 0
    assert run("align", *watched(runs, options, tmp_path / "omf")).status == 0
    given = [option for option in watched(runs, options, tmp_path / "omf") if "preferences=" not in option]
    outcome = run("align", *given, f"preferences={tmp_path / 'other'}")
    assert outcome.status == 2 and "preferences" in outcome.err


def test_rollouts_of_other_scenes_are_not_watched(run: Callable, options: Callable, runs: Path, tmp_path: Path) -> None:
    outcome = run("align", *watched(runs, options, tmp_path / "omf", f"watch={runs / 'preferences'}"))
    assert outcome.status == 2 and "ranks rollouts of other scenes" in outcome.err


def test_alignment_learns_from_the_scenes_that_it_is_given(runs: Path, options: Callable) -> None:
    cfg = compose_recipe("align", options, runs)
    store, scenes = PreferenceStore(runs / "preferences"), open_splits(cfg.scenes).train
    model, episode, _ = open_policy(runs / "reference/policy.pt")
    data = OmegaConf.merge(cfg.method.data, {"num": 2})
    every = make_candidates(data, store, Contexts(scenes, model.featurize, episode), model.tokenizer, 0)
    some = make_candidates(data, store, Contexts(scenes, model.featurize, episode), model.tokenizer, 0, among=[1, 4])
    assert len(every) == 6 and len(some) == 2
    for group, whole in zip(some, (every[1], every[4]), strict=True):
        assert torch.equal(group.preferred, whole.preferred)


def test_rollouts_that_lack_scenes_to_learn_from_are_refused(runs: Path, options: Callable) -> None:
    cfg = compose_recipe("align", options, runs)
    scenes, policy = open_splits(cfg.scenes).train, runs / "reference/policy.pt"
    assert Inputs.open(policy, runs / "preferences", None, scenes, [1, 4], "cpu").learnt == [1, 4]
    with pytest.raises(ValueError, match=r"preferences lacks 1 of the 2 scenes to learn from; run what fills it"):
        Inputs.open(policy, runs / "preferences", None, scenes, [1, 99], "cpu")


def test_rankings_are_thinned_among_the_scenes_that_are_learnt_from(runs: Path, options: Callable) -> None:
    cfg = compose_recipe("align", options, runs)
    store, scenes = PreferenceStore(runs / "preferences"), open_splits(cfg.scenes).train
    model, episode, _ = open_policy(runs / "reference/policy.pt")
    data = OmegaConf.merge(cfg.method.data, {"num": 1, "rankings_per_scene": 0.5})
    for seed in range(6):
        groups = make_candidates(
            data, store, Contexts(scenes, model.featurize, episode), model.tokenizer, seed, among=[0, 1, 2, 4]
        )
        assert len(groups) == 2, "half a pair of each of the four, whatever the other two would keep"


def saturating(runs: Path, options: Callable, folder: Path) -> list[str]:
    given = ["method=cpl", "method.data.num=2", "method.loss.alpha=1000", f"output={folder}"]
    return options("align", *given, f"policy={runs / 'reference/policy.pt'}", f"preferences={runs / 'preferences'}")


def warnings_in(err: str) -> list[str]:
    return [line for line in err.splitlines() if "of the pairs are saturated" in line]


def test_a_loss_that_saturates_is_told_once_and_kept_with_the_result(
    run: Callable, options: Callable, runs: Path, tmp_path: Path
) -> None:
    command = saturating(runs, options, tmp_path / "cpl")
    outcome = run("align", *command)
    assert outcome.status == 0, outcome.err
    (told,) = warnings_in(outcome.err)
    assert re.match(r"cpl: \d+ % of the pairs are saturated since step 1: .* method\.loss\.reference=true", told)
    kept = json.loads((tmp_path / "cpl/result.json").read_text())["saturated"]
    assert told == f"cpl: {kept}"
    assert warnings_in(run("align", *command).err) == [told], "a finished run tells it again"


def test_a_run_that_goes_on_tells_again_what_saturated_before_it_was_interrupted(
    run: Callable, options: Callable, runs: Path, tmp_path: Path
) -> None:
    command = saturating(runs, options, tmp_path / "cpl")
    with mock.patch("recipes.alignment.step.clip_and_step", _interrupted_after(3)):
        first = run("align", *command)
    assert first.status == 130
    (told,) = warnings_in(first.err)
    outcome = run("align", *command)
    assert outcome.status == 0 and warnings_in(outcome.err) == [told]
    assert told.endswith(json.loads((tmp_path / "cpl/result.json").read_text())["saturated"])


def _interrupted_after(steps: int) -> Callable:
    """Steps of the optimiser during which somebody presses Ctrl-C."""
    left = iter(range(steps))

    def step(*arguments: object) -> float:
        if next(left, None) is None:
            raise KeyboardInterrupt
        return clip_and_step(*arguments)

    return step


def test_a_loss_that_does_not_saturate_leaves_no_mark(
    run: Callable, options: Callable, runs: Path, tmp_path: Path
) -> None:
    outcome = run("align", *watched(runs, options, tmp_path / "omf"))
    assert outcome.status == 0 and not warnings_in(outcome.err)
    assert "saturated" not in json.loads((tmp_path / "omf/result.json").read_text())


def test_a_comparison_names_the_run_that_saturates_and_its_options(
    run: Callable, options: Callable, runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    folder = tmp_path / "study"
    shutil.copytree(runs / "reference", folder / "seed_0/reference")
    shutil.copytree(runs / "preferences", folder / "seed_0/preferences_train")
    tuned = [*collect_into(folder / "seed_0/preferences_tune", runs, options), "split=tune"]
    assert run("collect", *tuned).status == 0
    with initialize_config_dir(CONFIG["config_path"], version_base="1.3"):
        given = [f"output={folder}", "experiment=losses", "methods.smoothed.data.num=2"]
        given += ["methods.smoothed.loss.reference=false", "methods.smoothed.loss.alpha=1000.0"]
        cfg = compose("compare", options("compare", *given))
    with Workers(1, 1) as workers:
        list(workers.run([Job(align_job, (cfg, 0, "smoothed"), "align 0 smoothed")], "align"))
    (told,) = warnings_in(capsys.readouterr().err)
    assert told.startswith("align 0 smoothed > dpo: ")
    assert " Say methods.smoothed.loss.reference=true. Without it, " in told
    assert re.search(r" or lower methods\.smoothed\.loss\.alpha=1000\.0 to \S+ saturates fewer, ", told)


def test_a_step_is_the_same_however_it_is_split_into_parts() -> None:
    tokenizer, parts = VerletTokenizer(), []
    for max_rows in (1, 4, 1000):
        torch.manual_seed(0)
        model = MotionLM("nano", tokenizer)
        loss = ContrastivePreferenceLoss(token_network(model))
        shake(model)  # away from the reference, where every pair has a gradient of its own
        groups = [group_of(size) for size in (1, 3, 2)]
        options = OmegaConf.create({"pairs_per_scene": 2, "max_rows": max_rows})
        draw = torch.Generator().manual_seed(0)
        figures = accumulate_gradients(loss, parts_of(groups, options, draw, "cpu"))
        gradient = torch.cat([p.grad.flatten() for p in model.parameters() if p.grad is not None])
        parts.append((figures["loss_preference"], figures["logit_mean"], figures["logit_std"], gradient))
    for split in parts[:2]:
        for mine, whole in zip(split, parts[2], strict=True):
            torch.testing.assert_close(mine, whole, atol=1e-5, rtol=1e-3)
    assert parts[2][2] > 1e-3 and parts[2][3].norm() > 1e-3


def test_a_rank_without_a_scene_passes_one_that_does_not_count() -> None:
    groups, options = [group_of(2)], OmegaConf.create({"pairs_per_scene": 2, "max_rows": 4})
    shares = []
    for rank in range(2):
        draw = torch.Generator().manual_seed(0)
        parts = list(parts_of(groups, options, draw, "cpu", Ranks(rank=rank, world_size=2)))
        shares.append([share for _, share in parts])
        assert parts[0][0]["preferred"].shape == (1, 2, 2, 16)
    assert shares == [[1.0], [0.0]]


def group_of(num_agents: int) -> Group:
    """Three pairs of random rollouts of a road."""
    draw = torch.Generator().manual_seed(num_agents)
    tokens = torch.randint(60, 110, (2, 3, num_agents, 16), generator=draw)
    valid = torch.ones(num_agents, 16, dtype=torch.bool)
    return Group(make_context(straight_road(num_agents), featurize), tokens[0], tokens[1], valid)


def shake(model: torch.nn.Module) -> None:
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.05 * torch.randn(parameter.shape))


# --- rank again -----------------------------------------------------------------------------------------------------
def rerank_into(folder: Path, runs: Path, options: Callable) -> list[str]:
    given = (f"policy={runs / 'reference/policy.pt'}", f"preferences={runs / 'preferences'}", f"output={folder}")
    return options("rerank", *given, "ranking.features=progress", "ranking.stride=5")


def test_rollouts_ranked_again_are_ranked_as_if_collected_with_that_distance(
    run: Callable, options: Callable, runs: Path, tmp_path: Path
) -> None:
    outcome = run("rerank", *rerank_into(tmp_path / "again", runs, options))
    assert outcome.status == 0, outcome.err
    fresh = collect_into(tmp_path / "fresh", runs, options)
    assert run("collect", *fresh, "collection.ranking.features=progress").status == 0
    mine, other = (PreferenceStore(tmp_path / name) for name in ("again", "fresh"))
    assert mine.provenance == other.provenance
    assert mine.provenance.ranking != PreferenceStore(runs / "preferences").provenance.ranking
    for row in range(len(other)):
        for key, value in other[row].items():
            torch.testing.assert_close(mine[row][key], value, atol=1e-4, rtol=1e-4)
    assert not torch.allclose(mine.distance, PreferenceStore(runs / "preferences").distance)


def test_ranking_again_goes_on_after_a_kill(run: Callable, options: Callable, runs: Path, tmp_path: Path) -> None:
    folder = tmp_path / "again"
    assert run("rerank", *rerank_into(folder, runs, options)).status == 0
    whole = contents(folder)
    shutil.rmtree(folder)
    with (
        mock.patch("recipes.rerank.rank_of", side_effect=[torch.arange(4)[None]] * 3 + [KeyboardInterrupt]),
        mock.patch("recipes.rerank.PreferenceWriter", partial(PreferenceWriter, chunk_scenes=1)),
    ):
        assert run("rerank", *rerank_into(folder, runs, options)).status == 130
    assert len(PreferenceStore(folder)) == 3
    assert run("rerank", *rerank_into(folder, runs, options)).status == 0
    assert contents(folder) == whole


def test_rollouts_of_another_policy_are_not_ranked_again(
    run: Callable, options: Callable, runs: Path, tmp_path: Path
) -> None:
    other = options("pretrain", f"output={tmp_path / 'other'}", "seed=7")
    assert run("pretrain", *other).status == 0
    command = [
        f"policy={tmp_path / 'other/policy.pt'}" if option.startswith("policy=") else option
        for option in rerank_into(tmp_path / "again", runs, options)
    ]
    outcome = run("rerank", *command)
    assert outcome.status == 2 and "ranks rollouts of another policy" in outcome.err
    assert not (tmp_path / "again").exists()


# --- evaluate -------------------------------------------------------------------------------------------------------
def score_into(path: Path, runs: Path, options: Callable) -> list[str]:
    return options("evaluate", f"policy={runs / 'reference/policy.pt'}", f"json={path}")


@pytest.fixture(scope="module")
def scored(run: Callable, options: Callable, runs: Path) -> dict:
    """The result of an evaluation that nothing interrupted."""
    outcome = run("evaluate", *score_into(runs / "evaluation.json", runs, options))
    assert outcome.status == 0, outcome.err
    assert all(name in outcome.out for name in FIGURES)
    return json.loads((runs / "evaluation.json").read_text())


def test_an_evaluation_has_every_figure_of_every_scene_and_their_means(scored: dict, stores: Path) -> None:
    assert scored["scenes"] == SceneStore(stores / "eval").scene_ids
    assert set(scored["per_scene"]) == set(scored["mean"]) == set(FIGURES)
    for name, values in scored["per_scene"].items():
        known = [value for value in values if value is not None]
        assert len(values) == 3
        if known:
            assert scored["mean"][name] == pytest.approx(sum(known) / len(known))
    assert 0 < scored["mean"]["realism"] <= 1 and scored["mean"]["min_ade"] > 0


def test_a_finished_evaluation_is_read_back(
    run: Callable, options: Callable, runs: Path, scored: dict, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(evaluation, "score_scene", None)
    assert run("evaluate", *score_into(runs / "evaluation.json", runs, options)).status == 0
    assert not list(runs.glob(".evaluation*"))


def test_rollouts_are_drawn_as_the_decoding_says(run: Callable, options: Callable, runs: Path, tmp_path: Path) -> None:
    likeliest, path = "top_p=0.000001", tmp_path / "sharp.json"
    assert run("evaluate", *score_into(path, runs, options), f"decoding.{likeliest}").status == 0
    assert json.loads(path.read_text())["per_scene"]["spread"] == pytest.approx([0.0] * 3, abs=1e-4)
    outcome = run("collect", *collect_into(tmp_path / "sharp", runs, options), f"collection.decoding.{likeliest}")
    assert outcome.status == 0, outcome.err
    tokens = PreferenceStore(tmp_path / "sharp")[:][keys.TOKENS]
    assert (tokens == tokens[:, :1]).all()


def test_an_evaluation_of_fewer_figures_is_made_anew(
    run: Callable, options: Callable, runs: Path, scored: dict, tmp_path: Path
) -> None:
    path, older = tmp_path / "evaluation.json", json.loads(json.dumps(scored))
    del older["per_scene"]["close_pass"], older["mean"]["close_pass"]
    path.write_text(json.dumps(older))
    outcome = run("evaluate", *score_into(path, runs, options))
    assert outcome.status == 0 and json.loads(path.read_text()) == scored, outcome.err


def test_an_evaluation_goes_on_where_it_stopped(
    run: Callable, options: Callable, runs: Path, scored: dict, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    command, seen = score_into(tmp_path / "evaluation.json", runs, options), []
    whole = evaluation.score_scene

    def counted(each: Rolled, *args: object) -> dict:
        if len(seen) == 1 and not list(tmp_path.glob("go")):
            raise Stopped
        seen.append(each.index)
        return whole(each, *args)

    monkeypatch.setattr(evaluation, "score_scene", counted)
    assert run("evaluate", *command).status == 1
    partial = tmp_path / ".evaluation.json.scored"
    assert partial.is_file() and not (tmp_path / "evaluation.json").exists()
    with partial.open("a") as file:
        file.write("[2, {")  # a line that a kill cut short
    (tmp_path / "go").touch()
    assert run("evaluate", *command).status == 0
    assert json.loads((tmp_path / "evaluation.json").read_text()) == scored
    assert sorted(seen) == [0, 1, 2], "no scene is scored twice"
    assert not partial.exists()


def test_a_metric_that_was_edited_is_another_one(run: Callable, options: Callable, runs: Path, tmp_path: Path) -> None:
    ours, mine = FOLDER / "2024.yaml", tmp_path / "mine.yaml"
    mine.write_text(ours.read_text())
    command = [*score_into(tmp_path / "evaluation.json", runs, options), f"evaluation.metric={mine}"]
    assert run("evaluate", *command).status == 0
    assert run("evaluate", *command).status == 0, "read back"
    mine.write_text(ours.read_text().replace("corner_rounding: 0.7", "corner_rounding: 0.5"))
    assert mine.read_text() != ours.read_text()
    outcome = run("evaluate", *command)
    assert outcome.status == 2 and "evaluation.json" in outcome.err


def test_what_was_scored_with_other_options_is_told_and_kept(tmp_path: Path) -> None:
    path = tmp_path / "result.json"
    PartialResult(path, {"seed": 0}).add({1: {"value": 0.5}})
    assert PartialResult(path, {"seed": 0}).read() == {1: {"value": 0.5}}
    with pytest.raises(ValueError, match="scored with other options .'seed': 0 there, 1 here"):
        PartialResult(path, {"seed": 1}).read()
    assert PartialResult(path, {"seed": 0}).read() == {1: {"value": 0.5}}


def test_standing_agents_that_rollouts_move_are_counted() -> None:
    standing, driving = straight_road(2, speed=0.0), straight_road(2, speed=10.0)
    scene = standing.clone()
    scene.agents.position[1] = driving.agents.position[1]
    future = scene.agents.trajectory[:, CURRENT_STEP + 1 :]
    trajectories = future.repeat(4, 1, 1, 1)
    assert standing_moved(scene, trajectories) == 0
    trajectories[:, 1, :, 0] += 50.0  # it drives in the log: no sign of anything
    assert standing_moved(scene, trajectories) == 0
    trajectories[0, 0, -1, 0] += 3.0
    assert standing_moved(scene, trajectories) == pytest.approx(0.25)
    assert standing_moved(driving, trajectories) != standing_moved(driving, trajectories), "nobody stands: not a number"


def test_the_spread_is_the_distance_of_last_positions_from_their_mean() -> None:
    scene = straight_road(3)
    scene.agents.predict[:] = torch.tensor([True, True, False])
    rollouts = torch.zeros(4, 3, 80, 4)
    rollouts[:, 0, -1, :2] = torch.tensor([[3.0, 4.0], [-3.0, -4.0], [3.0, -4.0], [-3.0, 4.0]])
    rollouts[:, 2, -1, 0] = torch.tensor([0.0, 0.0, 100.0, 100.0])
    everybody = torch.ones(3, dtype=torch.bool)
    assert final_spread(scene, rollouts, everybody) == pytest.approx(5 / 2), "the third agent is not evaluated"
    assert final_spread(scene, rollouts, everybody & (torch.arange(3) == 0)) == pytest.approx(5)
    nobody = final_spread(scene, rollouts, ~everybody)
    assert nobody != nobody, "not a number"


# --- tokens ---------------------------------------------------------------------------------------------------------
def test_the_loss_of_tokenization_is_measured(run: Callable, options: Callable, tmp_path: Path) -> None:
    outcome = run("tokens", *options("tokens", f"json={tmp_path / 'tokens.json'}"))
    assert outcome.status == 0, outcome.err
    assert "[m]" in outcome.out and "[deg]" in outcome.out
    written = json.loads((tmp_path / "tokens.json").read_text())
    assert written["errors"]["vehicle all"]["position_mean"] < 0.2
    assert written["errors"]["pedestrian all"] == {"poses": 0}
    log, through = (written["realism"][name] for name in ("log", "tokens"))
    assert 0.5 < through["realism"] < log["realism"] < 1 and "log through tokens" in outcome.out


# --- submission -----------------------------------------------------------------------------------------------------
def test_an_evaluation_writes_a_submission_that_is_valid_and_scores_the_same(
    run: Callable, options: Callable, runs: Path, stores: Path, tmp_path: Path
) -> None:
    (tmp_path / "me.yaml").write_text(
        "{account_name: a@b.org, unique_method_name: nano, num_model_parameters: 153K, uses_lidar_data: false, "
        "uses_camera_data: false, uses_public_model_pretraining: false, "
        "acknowledge_complies_with_closed_loop_requirement: true}"
    )
    archive, result = tmp_path / "mine.tar.gz", tmp_path / "result.json"
    command = options(
        "evaluate", f"policy={runs / 'reference/policy.pt'}", f"json={result}", "evaluation.num_rollouts=32",
        "evaluation.memory=0.005", f"submission={archive}", f"submission_metadata={tmp_path / 'me.yaml'}",
    )  # fmt: skip
    outcome = run("evaluate", *command)
    assert outcome.status == 0, outcome.err
    scenes = SceneStore(stores / "eval")
    assert validate(archive, scenes) == []
    scored, own = score(stores / "eval", archive), json.loads(result.read_text())
    assert [scored[name].realism for name in scenes.scene_ids] == pytest.approx(own["per_scene"]["realism"], abs=1e-6)


# --- ladder ---------------------------------------------------------------------------------------------------------
def test_the_ladder_has_its_rungs_in_order_and_reads_them_back(
    run: Callable, options: Callable, runs: Path, tmp_path: Path
) -> None:
    out = tmp_path / "ladder.json"
    policies = f"policies=[{runs / 'reference/policy.pt'}]"
    command = options("ladder", policies, f"output={tmp_path / 'ladder'}", f"json={out}", "num_rollouts=8")
    outcome = run("ladder", *command)
    assert outcome.status == 0, outcome.err
    rungs = json.loads(out.read_text())["rungs"]
    mean = {name: sum(years["2024"]["realism"]) / 3 for name, years in rungs.items()}
    assert list(mean) == [
        "log", "log through tokens", "noisy log", "constant velocity", "random tokens", "untrained model", "reference"
    ]  # fmt: skip
    assert mean["log"] > mean["log through tokens"] > mean["random tokens"]
    assert rungs["log"]["2024"]["min_ade"] == [0.0] * 3
    rates = [rate for name in CLASS_RATES for rate in rungs["log"]["2024"][name]]
    assert all(rate is None or 0 <= rate <= 1 for rate in rates) and set(rates) != {None}
    content = out.read_text()
    assert "log" in run("ladder", *command).out and out.read_text() == content


def test_the_ladder_of_simulated_scenes_has_rungs_of_the_simulator(
    run: Callable, options: Callable, tmp_path: Path
) -> None:
    pytest.importorskip("sumolib", reason="needs the extra `sumo`")
    convert("sumo", ["num_scenes=1,windows=1,warmup=15,density=1.5,scenes_per_unit=1"], tmp_path / "traffic")
    out, rungs_of_sumo = tmp_path / "ladder.json", [*SIMULATOR, *(f"{name}, through tokens" for name in SIMULATOR)]
    command = options("ladder", "simulator=true", "num_rollouts=4", "years=['2024']", f"json={out}")
    outcome = run("ladder", *command, f"scenes.eval={tmp_path / 'traffic'}", f"output={tmp_path / 'ladder'}")
    assert outcome.status == 0, outcome.err
    found = {name: years["2024"] for name, years in json.loads(out.read_text())["rungs"].items()}
    (spread,) = zip(*(found[name]["spread"] for name in SIMULATOR), strict=True)
    assert spread[0] == 0 < spread[1], "what is known of the log narrows its futures"
    assert set(rungs_of_sumo) < set(found) and found["SUMO again"]["min_ade"][0] < 0.5
    refused = run("ladder", *command, f"output={tmp_path / 'roads'}")
    assert refused.status == 2 and "simulator=true needs scenes that SUMO has simulated" in refused.err


# --- play -----------------------------------------------------------------------------------------------------------
def test_rollouts_of_some_policies_make_a_page_that_plays(
    run: Callable, options: Callable, runs: Path, tmp_path: Path
) -> None:
    shutil.copytree(runs / "reference", tmp_path / "other")
    policies = f"[{runs / 'reference/policy.pt'},{tmp_path / 'other/policy.pt'}]"
    page = tmp_path / "play.html"
    outcome = run("play", *options("play", f"policies={policies}", "show=[1,0]", "num_rollouts=2", f"output={page}"))
    assert outcome.status == 0, outcome.err
    text = page.read_text(encoding="utf-8")
    assert '"reference"' in text and '"other"' in text and "top-p 0.95" in text


@pytest.mark.parametrize(("ending", "told"), [("png", "picture"), ("gif", "film")])
def test_the_most_likely_rollouts_make_a_picture_or_a_film(
    run: Callable, options: Callable, runs: Path, tmp_path: Path, ending: str, told: str
) -> None:
    command = options("play", f"policies={runs / 'reference/policy.pt'}", "show=[1]", "num_rollouts=2")
    outcome = run("play", *command, f"output={tmp_path / 'likely'}.{ending}")
    assert outcome.status == 0, outcome.err
    assert f"{told}: " in outcome.out and (tmp_path / f"likely.{ending}").stat().st_size > 10_000


def test_a_film_that_could_not_be_written_is_refused_before_any_rollout(
    run: Callable, options: Callable, runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    monkeypatch.setattr("recipes.play.roll_out", None)
    outcome = run("play", *options("play", f"policies={runs / 'reference/policy.pt'}", f"output={tmp_path / 'a.mp4'}"))
    assert outcome.status == 2 and "an MP4 needs the extra `video`" in outcome.err


def test_a_page_to_play_needs_the_name_of_one(run: Callable, options: Callable, runs: Path, tmp_path: Path) -> None:
    outcome = run("play", *options("play", f"policies={runs / 'reference/policy.pt'}", f"output={tmp_path / 'a.svg'}"))
    assert outcome.status == 2 and "name a file that ends in one of .html, .png, .gif, .mp4" in outcome.err


def test_a_scene_to_play_that_is_not_there_is_told(
    run: Callable, options: Callable, runs: Path, tmp_path: Path
) -> None:
    policy, page = runs / "reference/policy.pt", tmp_path / "play.html"
    outcome = run("play", *options("play", f"policies={policy}", "show=[nowhere]", f"output={page}"))
    assert outcome.status == 2 and "no scene 'nowhere'" in outcome.err
    assert not page.exists()


if __name__ == "__main__":
    pytest.main([__file__])
