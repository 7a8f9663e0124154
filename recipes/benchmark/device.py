"""Operators and synchronisations of a decision and of a ranking on a device: what a GPU is given, and waited for.

A decision that starts many small kernels is bound by the time that starting takes, and each synchronisation empties the
queue. Both are counted by operator as PyTorch dispatches them, part by part; neither depends on the machine. Without a
GPU a device is pretended that computes on the CPU (:mod:`recipes.benchmark.pretended`); on one, the same is counted.
"""

from __future__ import annotations

import argparse
import multiprocessing
from collections.abc import Callable
from typing import Any

import torch
from rich.console import Console
from rich.table import Table
from tensordict import TensorDictBase
from torchrl.envs import TransformedEnv

from dpa.models import Contexts, Decoding, MotionActor
from dpa.ranking import PreferenceDistance
from dpa.ranking.transform import RankRollouts
from dpa.tokens import TokenAction
from envs import keys
from envs.signals import SIGNALS
from envs.traffic import TrafficEnv
from recipes.benchmark.counting import DeviceCount
from recipes.benchmark.pretended import DEVICE, Pretended
from recipes.benchmark.realism import crowded_scene
from recipes.benchmark.rollout import episode_of
from recipes.common.models import named_model, named_models

SEGMENTS = 500
"""Of the road edges of a scene; the operators do not depend on them."""
SETTLED = 2
"""Decisions before those that are told as any other: the first looks at the scenes, the second counts the episode."""
METHODS = ("exact", "sinkhorn")


def add_options(part: argparse.ArgumentParser) -> None:
    """Options of ``python -m recipes.benchmark device``."""
    part.add_argument("--model", choices=named_models(), default="paper", help="the policy (default: %(default)s)")
    part.add_argument("--agents", type=int, default=8, help="of a scene (default: %(default)s)")
    part.add_argument("--rollouts", type=int, default=8, help="of a scene (default: %(default)s)")
    part.add_argument("--scenes", type=int, default=2, help="side by side (default: %(default)s)")
    part.add_argument(
        "--signals",
        nargs="*",
        choices=sorted(SIGNALS),
        default=[],
        help="that the environment computes (default: none)",
    )
    part.add_argument(
        "--device",
        choices=("cuda", DEVICE),
        default="cuda" if torch.cuda.is_available() else DEVICE,
        help=f"{DEVICE} is pretended, on the CPU (default: %(default)s)",
    )


def measure(options: dict[str, Any]) -> list[dict[str, Any]]:
    """Run the part, in a process of its own, and print its table.

    Raises:
        ValueError: a number below 1.
    """
    for name in ("agents", "rollouts", "scenes"):
        if options[name] < 1:
            raise ValueError(f"--{name} must be 1 or more, got {options[name]}.")
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        rows = pool.apply(run, (options,))
    _print(rows, options)
    return rows


def run(options: dict[str, Any]) -> list[dict[str, Any]]:
    """Count in this process, which is no good for anything else where a device is pretended."""
    torch.set_num_threads(1)
    torch.manual_seed(0)
    with torch.no_grad(), Pretended() if options["device"] == DEVICE else DeviceCount(options["device"]) as count:
        return counted(count, **{name: value for name, value in options.items() if name != "device"})


def counted(
    count: DeviceCount, model: str, agents: int, rollouts: int, scenes: int, signals: list[str]
) -> list[dict[str, Any]]:
    """A row for each part: ``part``, ``kernels``, ``synchronisations``, ``uploads`` and ``waits`` by operator.

    Args:
        count: that is entered.
        model: name of the policy's YAML.
        agents: of a scene.
        rollouts: of a scene.
        scenes: side by side.
        signals: that the environment computes.
    """
    policy = named_model(model).to(count.device).eval()
    source = [crowded_scene(agents, SEGMENTS, index) for index in range(scenes)]
    episode, sizes = episode_of(policy), {"num_scenes": scenes, "num_rollouts": rollouts}
    env = TrafficEnv(source, episode, **sizes, signals=signals, device=count.device)
    env = TransformedEnv(env, TokenAction(policy.tokenizer))
    contexts = Contexts(source, policy.featurize, episode)
    actor = MotionActor(policy, contexts, num_rollouts=rollouts, decoding=Decoding())
    rows: list[dict[str, Any]] = []

    def tell(part: str, work: Callable[[], TensorDictBase], share: int = 1) -> TensorDictBase:
        count.reset()
        made = work()
        rows.append(row_of(part, count, share))
        return made

    state, taken, decisions = tell("reset", env.reset), [], {"policy": [], "env step": []}
    for decision in range(policy.config.horizon):
        state = tell("policy", lambda state=state: actor(state))
        whole = tell("env step", lambda state=state: env.step(state))
        taken.append(whole.clone(False))
        state = whole["next"].exclude(keys.REWARD)
        if decision >= SETTLED:
            decisions["policy"].append(rows[-2])
            decisions["env step"].append(rows[-1])
    first, batch = [rows[0], rows[1] | {"part": "policy, first decision"}], torch.stack(taken, 1)
    rows = first + [mean_row(part, each) for part, each in decisions.items()]
    for method in METHODS:
        rank = RankRollouts(source, rollouts, PreferenceDistance(method=method))
        tell(f"ranking of a scene, {method}", lambda rank=rank: rank(batch), scenes)
    return rows


def row_of(part: str, count: DeviceCount, share: int = 1) -> dict[str, Any]:
    """What has been counted, over the number of those that share it."""
    waits = {name: number / share for name, number in sorted(count.read_backs.items())}
    return {
        "part": part,
        "kernels": sum(count.kernels.values()) / share,
        "synchronisations": sum(waits.values()),
        "uploads": count.uploads / share,
        "waits": waits,
    }


def mean_row(part: str, rows: list[dict[str, Any]]) -> dict[str, Any]:
    """The mean of rows of one part."""
    names = sorted({name for row in rows for name in row["waits"]})
    means = {key: sum(row[key] for row in rows) / len(rows) for key in ("kernels", "synchronisations", "uploads")}
    waits = {name: sum(row["waits"].get(name, 0) for row in rows) / len(rows) for name in names}
    return {"part": part, **means, "waits": waits}


def _print(rows: list[dict[str, Any]], options: dict[str, Any]) -> None:
    sizes = f"{options['scenes']} scenes of {options['agents']} agents, {options['rollouts']} rollouts"
    table = Table(title=f"{options['model']} model, {sizes}, {options['device']}", title_justify="left")
    table.add_column("")
    for title in ("kernels", "synchronisations", "uploads"):
        table.add_column(title, justify="right")
    table.add_column("what is waited for")
    for row in rows:
        numbers = [f"{row[key]:,.4g}" for key in ("kernels", "synchronisations", "uploads")]
        table.add_row(row["part"], *numbers, ", ".join(f"{n:.3g} {name}" for name, n in row["waits"].items()))
    Console(markup=False, width=110).print(table)
    print(
        "kernels are operators that compute, of which some start several; policy and env step are those of a decision"
    )
