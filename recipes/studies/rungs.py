"""Rollouts that need no policy: the log, through tokens or with noise, constant velocity, random tokens, and SUMO."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator

import torch
from torch import Tensor

from dpa.rollout import lifted
from dpa.tokens import MotionTokenizer
from envs.scene import CURRENT_STEP, STEP_SECONDS, Scene, SceneSource
from envs.seeding import make_generator
from envs.sources.sumo.futures import Keeps, futures
from envs.store import SceneStore
from recipes.common.rolled import Rolled, waiting

Rung = Callable[[Scene, int, torch.Generator], Tensor]
"""Scene, number of rollouts and generator -> ``[R, A, 80, 4]``."""
NOISE_XY, NOISE_HEADING = 0.1, 0.01
"""Standard deviation of a noisy log's drift in one step [m], [rad]; it adds up to 0.9 m and 5 degrees at the end."""


def crude(
    scenes: SceneSource, rung: Rung, num_rollouts: int, seed: int, done: Collection[int] = ()
) -> Iterator[Rolled]:
    """Rollouts of every scene that is not done, by a rung."""
    for index, scene in waiting(scenes, done):
        yield Rolled.of(index, scene, rung(scene, num_rollouts, make_generator(seed, "ladder", index)))


def logged(scene: Scene, num_rollouts: int, generator: torch.Generator) -> Tensor:
    """The log in every rollout; where it has no step, the agent stays where it was last."""
    return _log(scene).expand(num_rollouts, -1, -1, -1)


def noisy_log(scene: Scene, num_rollouts: int, generator: torch.Generator) -> Tensor:
    """The log with a drift of its own in every rollout."""
    log = _log(scene)
    noise = torch.randn(num_rollouts, *log.shape, generator=generator).cumsum(2)
    return log + noise * torch.tensor([NOISE_XY, NOISE_XY, 0.0, NOISE_HEADING])


def constant_velocity(scene: Scene, num_rollouts: int, generator: torch.Generator) -> Tensor:
    """Every agent goes straight on at its speed of the current step, in every rollout."""
    agents, log = scene.agents, _log(scene)
    time = STEP_SECONDS * torch.arange(1, log.shape[1] + 1)
    now = agents.present
    xy = agents.position[now, CURRENT_STEP, None, :2] + agents.velocity[now, CURRENT_STEP, None] * time[:, None]
    heading = agents.heading[now, CURRENT_STEP, None, None].expand(-1, log.shape[1], 1)
    poses = torch.cat((xy, heading), -1)
    return lifted(scene, poses[None]).expand(num_rollouts, -1, -1, -1)


def random_tokens(tokenizer: MotionTokenizer) -> Rung:
    """Every token as likely as any other, at every decision."""

    def roll(scene: Scene, num_rollouts: int, generator: torch.Generator) -> Tensor:
        recent, kind = _seen(scene, tokenizer.steps)
        steps = _log(scene).shape[1] // tokenizer.steps
        tokens = torch.randint(tokenizer.vocab_size, (num_rollouts, len(kind), steps), generator=generator)
        return lifted(scene, tokenizer.decode_tracks(tokens, recent.expand(num_rollouts, -1, -1, -1), kind))

    return roll


def tokenized_log(tokenizer: MotionTokenizer) -> Rung:
    """The log through tokens and back, in every rollout: the best that any model of these tokens could do alike."""

    def roll(scene: Scene, num_rollouts: int, generator: torch.Generator) -> Tensor:
        poses = through(tokenizer, scene, _log(scene)[None, ..., [0, 1, 3]])
        return lifted(scene, poses).expand(num_rollouts, -1, -1, -1)

    return roll


def through(tokenizer: MotionTokenizer, scene: Scene, poses: Tensor) -> Tensor:
    """Tracks ``[R, A, 80, 3]`` of the present agents, through tokens and back."""
    recent, kind = _seen(scene, tokenizer.steps)
    valid = torch.ones(poses.shape[:-1], dtype=torch.bool)
    recent = recent.expand(len(poses), -1, -1, -1)
    return tokenizer.encode_tracks(poses, valid, recent, kind.expand(len(poses), -1)).poses


class Simulator:
    """SUMO going on from every scene's current step: what its logs were drawn from (:mod:`envs.sources.sumo.futures`).

    Args:
        scenes: of SUMO.
        num_rollouts: R, futures of each scene.
        seed: of all that is drawn.

    Raises:
        ValueError: scenes of another source, or of traffic with routes of the user's own.
    """

    def __init__(self, scenes: SceneStore, num_rollouts: int, seed: int) -> None:
        if sources := sorted({each["source"] for each in scenes.origins()} - {"sumo"}):
            raise ValueError(f"simulator=true needs scenes that SUMO has simulated, got some of {', '.join(sources)}.")
        if own := [named for each in scenes.origins() for named in each["named"] if "routes=" in named]:
            raise ValueError(f"simulator=true draws ways anew, which only random traffic has; {own[0]!r} has routes.")
        self.scenes, self.num_rollouts, self.seed = scenes, num_rollouts, seed
        self._made: dict[tuple[int, Keeps], Tensor] = {}

    def goes_on(self, keeps: Keeps, tokenizer: MotionTokenizer | None, done: Collection[int] = ()) -> Iterator[Rolled]:
        """Its futures of the scenes that are not done, through tokens and back where some are given."""
        for index, scene in waiting(self.scenes, done):
            poses = self._futures(index, keeps)
            poses = poses if tokenizer is None else through(tokenizer, scene, poses)
            yield Rolled.of(index, scene, lifted(scene, poses).expand(self.num_rollouts, -1, -1, -1))

    def _futures(self, index: int, keeps: Keeps) -> Tensor:
        """Simulated once for the two rungs that ask, and then let go; one alone where nothing is drawn."""
        if (made := self._made.pop((index, keeps), None)) is not None:
            return made
        scene, count = self.scenes[index], 1 if keeps == "all" else self.num_rollouts
        draw = make_generator(self.seed, "simulator", scene.scene_id)
        seeds = torch.randint(2**31 - 1, (count,), generator=draw).tolist()
        self._made[index, keeps] = futures(self.scenes.provenance(index)[0], scene, seeds, keeps=keeps)
        return self._made[index, keeps]


def _seen(scene: Scene, steps: int) -> tuple[Tensor, Tensor]:
    """What a policy sees of the present agents: ``[A, F + 1, 3]`` before the first decision, and their kinds."""
    present = scene.agents.present
    return scene.agents.recent(steps)[present], scene.agents.kind[present]


def _log(scene: Scene) -> Tensor:
    """``[A, 80, 4]`` of the present agents; a step that the log lacks has the pose of the last one that it has."""
    agents = scene.agents
    poses = agents.trajectory[agents.present, CURRENT_STEP:]
    steps = torch.arange(poses.shape[1])
    last = torch.where(agents.valid[agents.present, CURRENT_STEP:], steps, 0).cummax(1).values
    return poses.gather(1, last[..., None].expand_as(poses))[:, 1:]
