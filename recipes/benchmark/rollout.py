"""Agent-steps of 0.1 s per second with the policy in the loop, against a naive decoder and the limit of the machine.

Each case has a process, and so a peak of memory, of its own. Scenes are made on the spot; weights are random, which
costs as much as trained ones.
"""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import statistics
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any

import torch
from rich.console import Console
from rich.table import Table
from tensordict import TensorDictBase
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode
from torchrl.envs import TransformedEnv

from dpa.losses import NextTokenLoss, token_network
from dpa.models import Contexts, Decision, Decoding, MotionActor, MotionModel, collate_contexts, make_context
from dpa.models.actor import Chooser
from dpa.models.context import pad_context
from dpa.ranking.transform import RankRollouts
from dpa.rollout import RolloutTask, RolloutWorker
from dpa.rollout.job import RolloutJob
from dpa.tokens import TokenAction
from dpa.training.batches import collate_items
from dpa.training.logs import log_item
from envs import keys
from envs.allocator import keep_freed_memory
from envs.episode import EpisodeOptions
from envs.progress import progress
from envs.scene import Scene
from envs.traffic import TrafficEnv
from recipes.benchmark.realism import crowded_scene
from recipes.common.models import named_model, named_models

KIB_PER_GIB = 1 << 20
SEGMENTS = 5000
"""Of the road edges of a scene: more than the policy's map pieces, as in WOMD."""
TRAINED_SCENES = 4
"""Of a step of pre-training."""
MATRIX = 1024
"""Rows and columns of the product that the limit is measured with."""


@dataclass(frozen=True)
class Case:
    """What one measurement is of.

    Attributes:
        how: ``incremental`` is the bare loop with a cache, ``compiled`` the same compiled; ``naive`` the one in which
            each row encodes its scene and its past anew for each decision, ``uncached`` the same with the scene encoded
            once for its rollouts; ``collector`` the collector that recipes use, ``ranked`` the same with the ranking
            behind it, ``trained`` a step of pre-training on the scenes' logs.
        agents: of each scene, all controlled.
        rollouts: of each scene.
        scenes: side by side.
        model: name of its YAML.
        threads: of torch.
        repeats: episodes; the median counts.
        device: where model and environment are.
    """

    how: str
    agents: int
    rollouts: int
    scenes: int
    model: str
    threads: int
    repeats: int
    device: str

    @property
    def agent_steps(self) -> int:
        """Of one episode: 80 steps of 0.1 s of every agent of every rollout, or of every log that is trained on."""
        return self.agents * (1 if self.how == "trained" else self.rollouts) * self.scenes * 80


class UncachedActor(MotionActor):
    """Encodes the scene, once for its rollouts, and all decisions so far anew for each decision."""

    @property
    def sharing(self) -> int:
        """Rows that share an encoded scene."""
        return self.num_rollouts

    def decide(self, tensordict: TensorDictBase) -> tuple[Decision, Chooser]:
        """Take the decision at hand, all agents at once."""
        logits = self._logits(tensordict).float()
        chooser = self.chooser(tensordict)
        decision = Decision(chooser(logits), logits)
        self._last = decision.token
        return decision, chooser

    def _logits(self, tensordict: TensorDictBase) -> Tensor:
        """``[B, A, P]``; all rows stand at the same decision."""
        step, scene = int(tensordict[keys.STEP][0, 0]), tensordict[keys.SCENE]
        if step == 0:
            self._start(tensordict, [0] * len(scene))
            tokenizer, shape = self.model.tokenizer, (*tensordict[keys.VALID].shape, self.model.config.horizon)
            self._taken = torch.zeros(*shape, *tokenizer.shape, dtype=tokenizer.dtype, device=scene.device)
        else:
            self._taken[:, :, step - 1] = self._last
        rows = scene[:: self.sharing].tolist()
        context = pad_context(collate_contexts([self.contexts[i] for i in rows]), self._taken.shape[1]).to(scene.device)
        steps = self.model.tokenizer.steps * (step + 1)
        context, episode = context.clone(recurse=False), context.episode.clone(recurse=False)
        episode.logged, episode.logged_valid = episode.logged[:, :, :steps], episode.logged_valid[:, :, :steps]
        context.episode = episode
        tokens = self._taken[:, :, : step + 1].unflatten(0, (len(rows), -1))
        valid = episode.controlled[:, None, :, None].expand(-1, 1, -1, step + 1)
        return self.model(context, tokens, valid)[..., -1, :].flatten(0, 1)


class NaiveActor(UncachedActor):
    """The same for each row by itself: what decoding is where rollouts are a batch like any other."""

    sharing = 1


def add_options(part: argparse.ArgumentParser) -> None:
    """Options of ``python -m recipes.benchmark rollout``."""
    part.add_argument("--model", choices=named_models(), default="paper", help="the policy (default: %(default)s)")
    part.add_argument("--agents", type=int, default=32, help="of a scene (default: %(default)s)")
    part.add_argument("--rollouts", type=int, default=32, help="of a scene (default: %(default)s)")
    part.add_argument("--scenes", type=int, default=1, help="side by side (default: %(default)s)")
    part.add_argument("--threads", type=int, default=torch.get_num_threads(), help="of torch (default: %(default)s)")
    part.add_argument("--repeats", type=int, default=5, metavar="N", help="the median counts (default: %(default)s)")
    part.add_argument("--device", default="cpu", help="cpu or cuda (default: %(default)s)")
    part.add_argument("--compile", action="store_true", help="also with the decoder compiled")
    part.add_argument("--sweep", action="store_true", help="also vary agents, rollouts and scenes, one at a time")


def measure(options: dict[str, Any]) -> list[dict[str, Any]]:
    """Run the part and print its tables.

    Raises:
        ValueError: a number below 1, or a model whose decoding is not compiled, and is to be.
    """
    for name in ("agents", "rollouts", "scenes", "threads", "repeats"):
        if options[name] < 1:
            raise ValueError(f"--{name} must be 1 or more, got {options[name]}.")
    if options["compile"] and not named_model(options["model"]).compiles:
        raise ValueError(f"--compile: decoding of {options['model']} is not compiled; leave it out.")
    main = Case("incremental", **{key: value for key, value in options.items() if key not in ("sweep", "compile")})
    kinds = ("incremental", "collector", "naive", "uncached", "ranked", *(("compiled",) if options["compile"] else ()))
    cases = [replace(main, how=how) for how in kinds]
    cases += [replace(main, how="trained", scenes=TRAINED_SCENES)]
    grown = sweep(main) if options["sweep"] else []
    rows = [asdict(case) | _apart(case) for case in progress([*cases, *grown], "rollout", unit="case")]
    _print(rows[: len(cases)], f"rollouts, {main.model} model, {main.device}, {main.threads} threads")
    if grown:
        _print(rows[len(cases) :], "growth")
    limit = _limit(main, rows[0])
    Console(markup=False, width=110).print(_facts(rows, limit))
    return [*rows, limit]


def sweep(main: Case) -> list[Case]:
    """Half and double, and further, of one number at a time."""
    grown = {"agents": (8, 16, 64, 128), "rollouts": (8, 16, 64), "scenes": (2, 4)}
    return [replace(main, **{name: value}) for name, values in grown.items() for value in values]


def _apart(case: Case) -> dict[str, float]:
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(run, (case,))


def run(case: Case) -> dict[str, float]:
    """Measure one case in this process: seconds of an episode, agent-steps per second, GiB beyond the start."""
    torch.set_num_threads(case.threads)
    keep_freed_memory()
    torch.manual_seed(0)
    model = named_model(case.model).to(case.device).eval()
    scenes = [crowded_scene(case.agents, SEGMENTS, seed=index) for index in range(case.scenes)]
    make = {"collector": _collected, "ranked": _collected, "trained": _trained}.get(case.how, _bare)
    episode = make(case, model, scenes)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    seconds = statistics.median([_timed(episode, case.device) for _ in range(case.repeats + 1)][1:])
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    gib = torch.cuda.max_memory_allocated() / (1 << 30) if case.device != "cpu" else peak / KIB_PER_GIB
    return {"seconds": seconds, "agent_steps_per_second": case.agent_steps / seconds, "gib": gib}


def episode_of(model: MotionModel) -> EpisodeOptions:
    """Episodes whose decisions last as long as the policy's tokens."""
    return EpisodeOptions(decision_steps=model.tokenizer.steps, horizon=model.config.horizon)


def _bare(case: Case, model: MotionModel, scenes: list[Scene]) -> Callable[[], object]:
    """Environment and policy called in turn, and nothing kept."""
    env = TrafficEnv(scenes, episode_of(model), num_scenes=case.scenes, num_rollouts=case.rollouts, device=case.device)
    driven = TransformedEnv(env, TokenAction(model.tokenizer))
    kind = {"naive": NaiveActor, "uncached": UncachedActor}.get(case.how, MotionActor)
    options = {"num_rollouts": case.rollouts, "decoding": Decoding(), "compile": case.how == "compiled"}
    actor = kind(model, Contexts(scenes, model.featurize, episode_of(model)), **options)

    def episode() -> None:
        state = driven.reset()
        for _ in range(model.config.horizon):
            state = driven.step(actor(state))["next"].exclude(keys.REWARD)

    return torch.no_grad()(episode)


def _collected(case: Case, model: MotionModel, scenes: list[Scene]) -> Callable[[], object]:
    """What recipes do: environment, policy and collector made anew for each task."""
    rank = partial(RankRollouts, num_rollouts=case.rollouts) if case.how == "ranked" else None
    options = {"options": episode_of(model), "device": case.device, "make_postproc": rank}
    worker = RolloutWorker(RolloutJob(scenes, model, case.rollouts, **options))
    task = RolloutTask(tuple(range(case.scenes)), (range(case.rollouts),))
    return lambda: worker.run(task)


def _trained(case: Case, model: MotionModel, scenes: list[Scene]) -> Callable[[], object]:
    """Loss and gradients of the logs of all scenes."""
    loss = NextTokenLoss(token_network(model.train()))
    tokenizer = model.tokenizer.on_cpu()
    contexts = [make_context(scene, model.featurize, episode_of(model)) for scene in scenes]
    batch = collate_items([log_item(context, tokenizer) for context in contexts]).to(case.device)
    return lambda: sum(value for key, value in loss(batch).items() if key.startswith("loss_")).backward()


def _timed(work: Callable[[], object], device: str) -> float:
    start = time.perf_counter()
    work()
    if device != "cpu":
        torch.cuda.synchronize()
    return time.perf_counter() - start


def _limit(case: Case, row: dict[str, Any]) -> dict[str, float]:
    """The measured rate of matrix products over the model's operations: what no decoder can exceed on this machine."""
    torch.set_num_threads(case.threads)
    operations = operations_per_agent_step(case)
    rate = matmul_rate(case.device)
    most = rate / operations
    return {
        "operations_per_agent_step": operations,
        "matmul_per_second": rate,
        "agent_steps_per_second_at_most": most,
        "fraction_reached": row["agent_steps_per_second"] / most,
    }


def operations_per_agent_step(case: Case) -> float:
    """Floating-point operations of matrix products and attention in one incremental episode, over its agent-steps."""
    model = named_model(case.model).eval()
    few = replace(case, how="incremental", rollouts=min(case.rollouts, 4), scenes=1, device="cpu")
    episode = _bare(few, model, [crowded_scene(case.agents, SEGMENTS)])
    with torch.nn.attention.sdpa_kernel(torch.nn.attention.SDPBackend.MATH), FlopCounterMode(display=False) as counter:
        episode()
    return counter.get_total_flops() / few.agent_steps


def matmul_rate(device: str) -> float:
    """Operations per second of a large matrix product in float32, the best of some."""
    left, right = (torch.randn(MATRIX, MATRIX, device=device) for _ in range(2))
    fastest = min(_timed(lambda: left @ right, device) for _ in range(20))
    return 2 * MATRIX**3 / fastest


def _print(rows: list[dict[str, Any]], title: str) -> None:
    table = Table("", "scenes", "rollouts", "agents", "s per episode", "agent-steps/s", "GiB", title=title)
    for row in rows:
        sizes = (str(row[name]) for name in ("scenes", "rollouts", "agents"))
        table.add_row(
            row["how"], *sizes, f"{row['seconds']:.2f}", f"{row['agent_steps_per_second']:,.0f}", f"{row['gib']:.2f}"
        )
    Console(markup=False, width=110).print(table)


def _facts(rows: list[dict[str, Any]], limit: dict[str, float]) -> str:
    bare, collector, naive, uncached = (row["agent_steps_per_second"] for row in rows[:4])
    reached = f"{limit['agent_steps_per_second_at_most']:,.0f} agent-steps/s, {limit['fraction_reached']:.0%} reached"
    return (
        f"incremental over naive: {bare / naive:.1f} times, over uncached with a shared scene: {bare / uncached:.1f}; "
        f"collector over bare loop: {collector / bare:.2f}\n"
        f"{limit['operations_per_agent_step'] / 1e6:.2f} MFLOP per agent-step at "
        f"{limit['matmul_per_second'] / 1e9:.0f} GFLOP/s (float32 {MATRIX} x {MATRIX}): at most {reached}"
    )
