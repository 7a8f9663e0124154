"""Collectors: the same rollouts whoever makes them, however they are cut up, interrupted, or killed."""

from __future__ import annotations

import copy
import os
import signal
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from pathlib import Path
from unittest import mock

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.collectors import BaseCollector
from torchrl.envs import TransformedEnv

from dpa.models import Contexts, Decoding, MotionActor
from dpa.models.motionlm import MotionLM, featurize
from dpa.ranking.transform import RankRollouts
from dpa.rollout import RolloutCollector, Workers, make_collector
from dpa.rollout.collector import agents_of
from dpa.rollout.crew import _as_sent
from dpa.rollout.plan import GIB, collected_bytes
from dpa.rollout.ray_crew import RayCrew
from dpa.tokens import TokenAction
from envs import keys
from envs.episode import EpisodeOptions
from envs.scene import Scene
from envs.sources.synthetic import straight_road
from envs.traffic import TrafficEnv

SIZES = (2, 1, 3, 2)
PROCESSES = Workers(2, "process")


def budget(model: MotionLM, rows: int) -> float:
    """GiB for so many agents times rollouts."""
    return (rows + 0.5) * (model.bytes_per_row() + collected_bytes(model.config.horizon, model.tokenizer.steps)) / GIB


def tokens_of(batches: Iterable[TensorDictBase], num_rollouts: int) -> dict[int, Tensor]:
    """Tokens of every scene: index -> ``[K, T, A]`` without padding."""
    found = {}
    for batch in batches:
        assert (batch[keys.STEP][..., 0] == torch.arange(batch.shape[1])).all(), "whole episodes"
        assert batch["next", "done"][:, -1].all() and not batch["next", "done"][:, :-1].any()
        for row, scene in enumerate(batch[keys.SCENE][::num_rollouts, 0].tolist()):
            assert scene not in found
            group = batch[row * num_rollouts : (row + 1) * num_rollouts]
            assert (group[keys.SCENE] == scene).all() and (group["next", keys.SCENE] == scene).all()
            found[scene] = group[keys.TOKEN][..., : SIZES[scene]]
    return found


def assert_same(first: dict[int, Tensor], second: dict[int, Tensor]) -> None:
    assert first.keys() == second.keys()
    for scene in first:
        assert torch.equal(first[scene], second[scene]), scene


@pytest.fixture
def collect(model: MotionLM, scenes: list[Scene]) -> Callable[..., dict[int, Tensor]]:
    """Collects two rollouts of each scene and gives their tokens."""

    def collect(rows: int = 1000, **options: object) -> dict[int, Tensor]:
        return tokens_of(make_collector(scenes, model, num_rollouts=2, memory=budget(model, rows), **options), 2)

    return collect


def test_every_scene_is_rolled_out_once(collect: Callable) -> None:
    assert sorted(collect()) == [0, 1, 2, 3]
    assert sorted(collect(indices=[3, 0])) == [0, 3]
    assert collect(done=range(4)) == {}


@pytest.mark.parametrize("rows", [1, 3, 4, 8])
def test_rollouts_are_the_same_however_they_are_cut_up(collect: Callable, rows: int) -> None:
    assert_same(collect(rows), collect())


def test_rollouts_are_those_of_a_bare_loop(collect: Callable, model: MotionLM, scenes: list[Scene]) -> None:
    for index, tokens in collect().items():
        env = TransformedEnv(TrafficEnv([scenes[index]], num_rollouts=2), TokenAction(model.tokenizer))
        actor = MotionActor(model.eval(), Contexts([scenes[index]], featurize), num_rollouts=2, decoding=Decoding())
        assert torch.equal(env.rollout(16, actor)[keys.TOKEN], tokens)


def test_the_model_of_the_caller_stays_as_it_is(model: MotionLM, scenes: list[Scene]) -> None:
    mine = copy.deepcopy(model).train()
    collector = make_collector(scenes, mine, num_rollouts=2)
    collector.update_policy_weights_({name: value + 1 for name, value in mine.state_dict().items()})
    next(iter(collector))
    assert mine.training and all(torch.equal(v, model.state_dict()[name]) for name, v in mine.state_dict().items())


def test_arrivals_count_in_the_budget() -> None:
    scene = straight_road(9)
    scene.agents.valid[1:, :30] = False
    with_them, without = (agents_of([scene], None, EpisodeOptions(arrivals=arrivals)) for arrivals in (True, False))
    assert (with_them, without) == ({0: 9}, {0: 1})


def test_rollouts_depend_on_the_seed_and_on_nothing_global(collect: Callable) -> None:
    first = collect(seed=0)
    torch.manual_seed(99)
    assert_same(collect(seed=0), first)
    other = collect(seed=1)
    assert not all(torch.equal(first[scene], other[scene]) for scene in first)


@pytest.mark.parametrize("done", [[1], [0, 1], [0, 1, 2], [2]])
def test_what_is_left_of_an_interrupted_collection_comes_out_as_it_would_have(
    collect: Callable, done: list[int]
) -> None:
    whole, rest = collect(rows=8), collect(rows=8, done=done)
    assert set(rest) >= set(range(4)) - set(done)
    assert_same(rest, {scene: whole[scene] for scene in rest})


def test_options_reach_environment_and_policy(model: MotionLM, scenes: list[Scene]) -> None:
    options = EpisodeOptions(max_controlled=1, horizon=4)
    greedy = Decoding(top_p=1e-6)
    (batch,) = make_collector(scenes, model, num_rollouts=2, indices=[2], options=options, decoding=greedy)
    assert batch.batch_size == (2, 4)
    assert (batch[keys.CONTROLLED].sum(-1) == 1).all()
    assert torch.equal(batch[keys.TOKEN][0], batch[keys.TOKEN][1])


def test_post_processing_sees_whole_groups_although_they_were_rolled_out_in_pieces(
    model: MotionLM, scenes: list[Scene]
) -> None:
    ranked = make_collector(
        scenes,
        model,
        num_rollouts=4,
        memory=budget(model, 3),
        make_postproc=partial(RankRollouts, num_rollouts=4),
    )
    batches = list(ranked)
    assert [batch[keys.SCENE].tolist() for batch in batches] == [[1], [0], [3], [2]]
    for batch in batches:
        assert sorted(batch[keys.RANK][0].tolist()) == [0, 1, 2, 3]


# --- workers --------------------------------------------------------------------------------------------------------
def kill_first_worker(flag: Path, scenes: object) -> Callable[[TensorDictBase], TensorDictBase]:
    """Post-processing that kills its process, the first time that any worker comes to it."""

    def process(batch: TensorDictBase) -> TensorDictBase:
        if not flag.exists():
            flag.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return batch

    return process


def kill_every_worker(scenes: object) -> Callable[[TensorDictBase], TensorDictBase]:
    return lambda batch: os.kill(os.getpid(), signal.SIGKILL)


def fail(scenes: object) -> Callable[[TensorDictBase], TensorDictBase]:
    def process(batch: TensorDictBase) -> TensorDictBase:
        raise ValueError("no such feature")

    return process


def leave(scenes: object) -> Callable[[TensorDictBase], TensorDictBase]:
    return lambda batch: os._exit(3)


class Homeless(Exception):
    def __init__(self, where: str, why: str) -> None:
        super().__init__(f"{where}: {why}")


def test_an_error_that_cannot_be_read_back_is_told_in_words() -> None:
    sent = _as_sent(Homeless("scene 3", "no road"))
    assert type(sent) is RuntimeError and str(sent) == "Homeless: scene 3: no road"
    error = ValueError("as it is")
    assert _as_sent(error) is error


@pytest.mark.slow
def test_a_worker_that_ends_by_itself_is_no_want_of_memory(collect: Callable) -> None:
    with pytest.raises(ChildProcessError, match="ended with exit status 3 before it could answer; what it wrote says"):
        collect(workers=Workers(1, "process"), make_postproc=leave)


@pytest.mark.slow
def test_a_worker_that_cannot_begin_says_why(collect: Callable) -> None:
    with pytest.raises(RuntimeError, match="device string: nonsense"):
        collect(workers=Workers(1, "process"), device="nonsense")


@pytest.mark.slow
def test_processes_give_the_same_rollouts_in_the_same_order_although_one_is_killed(
    model: MotionLM, scenes: list[Scene], tmp_path: Path
) -> None:
    def collected(**options: object) -> list[TensorDictBase]:
        return list(make_collector(scenes, model, num_rollouts=2, memory=budget(model, 4), **options))

    batches = collected(workers=PROCESSES, make_postproc=partial(kill_first_worker, tmp_path / "killed"))
    expected = collected()
    assert (tmp_path / "killed").exists()
    assert [batch[keys.SCENE].tolist() for batch in batches] == [batch[keys.SCENE].tolist() for batch in expected]
    assert_same(tokens_of(batches, 2), tokens_of(expected, 2))


@pytest.mark.slow
def test_a_task_that_kills_every_worker_is_given_up(collect: Callable) -> None:
    with pytest.raises(ChildProcessError, match=r"3 workers were killed over the scenes \[.*\]"):
        collect(workers=Workers(1, "process"), make_postproc=kill_every_worker)


@pytest.mark.parametrize("workers", [None, pytest.param(Workers(1, "process"), marks=pytest.mark.slow)])
def test_an_error_in_a_worker_is_raised_where_the_batch_is_asked_for(
    collect: Callable, workers: Workers | None
) -> None:
    with pytest.raises(ValueError, match="no such feature"):
        collect(workers=workers, make_postproc=fail)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"count": 0, "backend": "process"},
            "count and threads of workers must be 1 or more, got count=0 and threads=1",
        ),
        ({"count": 2}, "2 workers need backend=process or backend=ray, got backend=local"),
        ({"backend": "threads"}, "backend must be local, process or ray, got 'threads'"),
    ],
)
def test_workers_that_make_no_sense_are_refused(options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Workers(**options)


def test_a_budget_that_holds_no_agent_is_refused(collect: Callable) -> None:
    with pytest.raises(ValueError, match="memory must hold at least one agent, got .* GiB"):
        collect(rows=-1)


# --- as a collector of TorchRL --------------------------------------------------------------------------------------
@pytest.fixture
def stepwise(model: MotionLM, scenes: list[Scene]) -> Callable[..., RolloutCollector]:
    """A collector of one scene at a time."""

    def make(workers: Workers | None = None) -> RolloutCollector:
        return make_collector(scenes, model, num_rollouts=2, memory=budget(model, 1), workers=workers)

    return make


def other_weights(model: MotionLM) -> dict[str, Tensor]:
    return {name: value + 0.1 for name, value in model.state_dict().items()}


@pytest.mark.parametrize("workers", [None, Workers(1, "process")])
def test_new_weights_drive_from_the_next_batch_on(
    stepwise: Callable, collect: Callable, model: MotionLM, workers: Workers | None
) -> None:
    before, weights = collect(), other_weights(model)
    collector = stepwise(workers)
    batches = []
    for batch in collector:
        batches.append(batch)
        if len(batches) == 2:
            collector.update_policy_weights_(TensorDict(weights).unflatten_keys("."))
    found = tokens_of(batches, 2)
    model.load_state_dict(weights)
    after = collect()
    assert_same(found, {scene: (before if place < 2 else after)[scene] for place, scene in enumerate(found)})
    assert not torch.equal(before[2], after[2])


@pytest.mark.parametrize("workers", [None, pytest.param(PROCESSES, marks=pytest.mark.slow)])
def test_a_new_seed_holds_from_the_next_batch_on(
    stepwise: Callable, collect: Callable, workers: Workers | None
) -> None:
    collector, batches = stepwise(workers), []
    for batch in collector:
        batches.append(batch)
        collector.set_seed(len(batches))
    found = tokens_of(batches, 2)
    assert_same(found, {scene: collect(seed=place)[scene] for place, scene in enumerate(found)})


def test_a_collector_goes_on_where_its_state_was_saved(stepwise: Callable) -> None:
    whole = list(stepwise())
    collector = stepwise()
    for _ in zip(range(2), collector, strict=False):
        state = collector.state_dict()
    resumed = stepwise()
    resumed.load_state_dict(state)
    rest = list(resumed)
    assert len(rest) == 2
    for batch, expected in zip(rest, whole[2:], strict=True):
        assert torch.equal(batch[keys.TOKEN], expected[keys.TOKEN])


@pytest.mark.parametrize("workers", [None, pytest.param(PROCESSES, marks=pytest.mark.slow)])
def test_tasks_may_come_one_by_one(
    stepwise: Callable, collect: Callable, model: MotionLM, workers: Workers | None
) -> None:
    whole = stepwise(workers)
    tasks = list(whole._tasks.values())
    collector = RolloutCollector(whole.job, tasks[:1], workers)
    batches, iterator = [], iter(collector)
    for task in tasks[1:]:
        batches.append(next(iterator))
        assert not collector._running and not collector._made, "no worker has anything to do"
        collector.add([task])
    batches += iterator
    assert len(collector) == 4
    assert_same(tokens_of(batches, 2), collect())


@pytest.mark.slow
@pytest.mark.parametrize("bound", [0, 1])
def test_batches_that_workers_made_ahead_are_kept_within_the_bound_on_staleness(
    stepwise: Callable, collect: Callable, model: MotionLM, bound: int
) -> None:
    before, weights = collect(), other_weights(model)
    whole = stepwise()
    collector = RolloutCollector(whole.job, list(whole._tasks.values()), PROCESSES, max_staleness=bound)
    batches, ages = [], []
    for batch in collector:
        if not batches:
            while collector._running:  # they go on with what is known, so all else is made ahead
                collector._feed()
                collector._take(*collector._crew.wait())
            collector.update_policy_weights_(weights)
        batches.append(batch)
        ages.append(collector.staleness)
    model.load_state_dict(weights)
    after = collect()
    found = tokens_of(batches, 2)
    kept = after if bound == 0 else before
    assert_same(found, {scene: (before if place == 0 else kept)[scene] for place, scene in enumerate(found)})
    assert ages == [0] + [bound] * 3


def test_a_bound_below_0_is_refused(stepwise: Callable) -> None:
    with pytest.raises(ValueError, match="staleness must be 0 or more, got -1"):
        RolloutCollector(stepwise().job, max_staleness=-1)
    with pytest.raises(ValueError, match="staleness=1 needs workers that roll out while the caller goes on"):
        RolloutCollector(stepwise().job, max_staleness=1)


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 2])
def test_with_a_bound_on_staleness_workers_go_on_while_the_caller_does(stepwise: Callable, count: int) -> None:
    whole = stepwise()
    tasks = list(whole._tasks.values())
    collector = RolloutCollector(whole.job, (), Workers(count, "process"), max_staleness=1)
    batches, ages = iter(collector), []
    collector.add(tasks[:count])
    for step in range(3):
        collector.update_policy_weights_()
        collector.add(tasks[:count])  # of the next step
        for _ in range(count):
            next(batches)
            ages.append(collector.staleness)
        assert not (collector._idle and collector._waiting), f"step {step}: nobody waits for the caller"
    collector.shutdown()
    assert ages == [0] * count + [1] * 2 * count


def test_a_collector_goes_forward_alone(stepwise: Callable) -> None:
    collector = stepwise()
    before = collector.state_dict()
    next(iter(collector))
    for state in (before, {"next": 9, "seed": 0}):
        with pytest.raises(ValueError, match=f"is at task 1 of 4 and cannot go to {state['next']}"):
            collector.load_state_dict(state)


def test_unknown_weights_are_refused(stepwise: Callable, model: MotionLM) -> None:
    with pytest.raises(ValueError, match=r"weights \['wings'\] are none of the model's"):
        stepwise().update_policy_weights_({"wings": torch.zeros(1)})
    larger = MotionLM(replace(model.config, width=32), model.tokenizer)
    with pytest.raises(ValueError, match=r"are \[.*\], and the model's are \[.*\]; give those of a model of the same"):
        stepwise().update_policy_weights_(larger)
    with pytest.raises(ValueError, match="say one of policy_or_weights, weights and policy"):
        stepwise().update_policy_weights_(larger, policy=larger)
    with pytest.raises(TypeError, match="weights_dict"):
        stepwise().update_policy_weights_(weights_dict={"policy": larger})


@pytest.mark.parametrize("told", ["policy_or_weights", "weights", "policy"])
def test_weights_are_taken_by_any_name_that_collectors_have_for_them(
    stepwise: Callable, collect: Callable, model: MotionLM, told: str
) -> None:
    collector, weights, before = stepwise(), other_weights(model), collect()
    other = copy.deepcopy(model)
    other.load_state_dict(weights)
    given = {"policy": other, "weights": TensorDict(weights).unflatten_keys("."), "policy_or_weights": weights}[told]
    collector.update_policy_weights_(**{told: given})
    driven = tokens_of(collector, 2)
    model.load_state_dict(weights)
    assert_same(driven, collect())
    assert any(not torch.equal(driven[scene], before[scene]) for scene in before)


def test_hooks_of_a_collector_see_each_batch(stepwise: Callable) -> None:
    collector, seen = stepwise(), []
    collector.pre_collect_hook = lambda: seen.append("before")
    collector.post_collect_hook = lambda batch: seen.append(batch)
    for batch in collector:
        before, after = seen
        assert before == "before" and after is batch
        seen.clear()


def test_episodes_longer_than_the_policy_knows_are_refused(model: MotionLM, scenes: list[Scene]) -> None:
    short = MotionLM(replace(model.config, horizon=8), model.tokenizer)
    with pytest.raises(
        ValueError, match="episodes of 16 decisions need a policy .* has horizon=8; give EpisodeOptions"
    ):
        make_collector(scenes, short, num_rollouts=2)
    batch = next(iter(make_collector(scenes, short, num_rollouts=2, options=EpisodeOptions(horizon=8))))
    assert batch.batch_size[1] == 8


def test_it_is_a_collector_of_torchrl(stepwise: Callable) -> None:
    collector = stepwise()
    assert isinstance(collector, BaseCollector)
    assert collector.next().batch_size == (2, 16)
    collector.shutdown()


@pytest.mark.slow
@pytest.mark.timeout(1800)  # seven actors import torch: half a minute, and ten times that beside other work
def test_a_ray_cluster_gives_the_same_rollouts_and_survives_a_killed_worker(
    collect: Callable, stepwise: Callable, model: MotionLM, tmp_path: Path
) -> None:
    ray = pytest.importorskip("ray")
    workers = Workers(2, "ray")
    try:
        killing = partial(kill_first_worker, tmp_path / "killed")
        assert_same(collect(rows=4, workers=workers, make_postproc=killing), collect(rows=4))
        assert (tmp_path / "killed").exists()
        with pytest.raises(ValueError, match="no such feature"):
            collect(workers=workers, make_postproc=fail)
        test_new_weights_drive_from_the_next_batch_on(stepwise, collect, model, workers)
        wanting = mock.Mock(side_effect=InterruptedError)
        impatient = mock.patch.multiple("dpa.rollout.ray_crew", PATIENCE=0.1, message=wanting)
        with impatient, pytest.raises(InterruptedError):
            collect(workers=Workers(1, "ray", threads=4096))
        assert "CPUs free" in wanting.call_args[0][0] and "needs 4096 CPUs" in wanting.call_args[0][0]
    finally:
        ray.shutdown()


def test_workers_on_ray_are_refused_where_it_is_not_installed() -> None:
    with mock.patch("dpa.rollout.crew.find_spec", return_value=None):
        Workers(2, "process")
        with pytest.raises(ImportError, match=r"pip install 'dpa-omf\[ray\]'"):
            Workers(2, "ray")


class _Errors:
    """What :mod:`ray.exceptions` has, with what the crew asks of it."""

    class RayTaskError(Exception):
        cause = ValueError("of the task")

    class OutOfMemoryError(Exception):
        pass

    class RayActorError(Exception):
        def __init__(self, actor_init_failed: bool) -> None:
            super().__init__("The actor died.\nValueError: no such GPU")
            self.actor_init_failed = actor_init_failed


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (_Errors.RayTaskError(), "of the task"),
        (_Errors.RayActorError(actor_init_failed=True), "a Ray worker could not start: ValueError: no such GPU"),
        (_Errors.RayActorError(actor_init_failed=False), None),
        (_Errors.OutOfMemoryError(), None),
    ],
)
def test_a_ray_worker_that_is_lost_is_replaced_and_one_that_cannot_start_says_why(error: Exception, told: str) -> None:
    crew = object.__new__(RayCrew)
    crew._ray = mock.Mock(exceptions=_Errors, wait=lambda running, **_: (running, []), get=mock.Mock(side_effect=error))
    crew._running, crew._hands, crew._start = {"task": 0}, ["lost"], lambda: "new"
    crew._told, crew._tell = ["of the lost"], lambda hand: f"of the {hand}"
    worker, outcome = crew.wait()
    assert (worker, outcome.batch, crew._hands) == (0, None, ["lost" if told else "new"])
    assert crew._told == ["of the lost" if told else "of the new"], "the new one hears of the weights"
    assert str(outcome.error) == str(told)
