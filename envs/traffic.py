"""The vectorised multi-agent traffic environment."""

from __future__ import annotations

from typing import Literal

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from envs import keys
from envs.geometry.frames import to_world
from envs.scene import CURRENT_STEP, LOG_STEPS, AgentKind, Scene, SceneSource, collate, select_agents

MAX_CONTROLLED = 128
"""Agents of one scene that a policy moves at most (WOSAC; SPEC section 1.2)."""


class TrafficEnv(EnvBase):
    """S traffic scenes, K times each, as one environment of batch size ``[B] = [S * K]``.

    An episode starts at the current step of a log, with one second of history, and takes ``horizon`` decisions of
    ``decision_steps`` poses. The agents of a scene are those valid at its current step, in the order of the scene,
    padded to ``num_agents``. Up to ``max_controlled`` of them follow their actions to the end: evaluated agents first,
    then those nearest to the SDC. The rest follow their log, and ``("agents", "controlled")`` says which.

    The K rollouts of a scene are contiguous rows. A scene gives way to the next one when all its rows are reset; a row
    that is reset alone starts its scene again. The map stays out of the observations: ``scene`` is its index in
    ``scenes``.

    Specs (shapes in :mod:`envs.keys`): observations ``scene``, ``step`` and, under ``agents``, ``recent``, ``valid``,
    ``controlled``, ``kind``; action ``("agents", "action")``: the next F poses in the agent's own frame; reward
    ``("agents", "reward")``: minus the mean displacement from the log over the decision [m]; ``done`` at the horizon.

    Args:
        scenes: where scenes come from.

    Keyword Args:
        num_scenes: S.
        num_rollouts: K.
        num_agents: A; by default the largest number of agents of any scene in ``scenes``.
        max_controlled: agents of a scene that are controlled at most.
        decision_steps: F.
        horizon: T, decisions in an episode.
        order: ``"sequential"`` takes the scenes in turn, ``"random"`` draws them with the environment's seed.
        device: where states live.

    Raises:
        ValueError: no scenes, a horizon beyond the log, or a scene with more than ``num_agents`` agents.

    Examples:
        >>> from envs.sources.synthetic import straight_road
        >>> env = TrafficEnv([straight_road(2), straight_road(3)], num_scenes=2, num_rollouts=4)
        >>> rollout = env.rollout(16)
        >>> rollout["next", "agents", "recent"].shape
        torch.Size([8, 16, 3, 6, 3])
    """

    batch_locked = True

    def __init__(
        self,
        scenes: SceneSource,
        *,
        num_scenes: int = 1,
        num_rollouts: int = 1,
        num_agents: int | None = None,
        max_controlled: int = MAX_CONTROLLED,
        decision_steps: int = 5,
        horizon: int = 16,
        order: Literal["sequential", "random"] = "sequential",
        device: torch.device | str = "cpu",
    ) -> None:
        if len(scenes) == 0:
            raise ValueError("TrafficEnv needs at least one scene, got an empty source.")
        if CURRENT_STEP + decision_steps * horizon >= LOG_STEPS:
            raise ValueError(
                f"horizon * decision_steps must be at most {LOG_STEPS - 1 - CURRENT_STEP} steps of 0.1 s, got "
                f"{horizon} * {decision_steps}."
            )
        super().__init__(device=device, batch_size=[num_scenes * num_rollouts])
        self.scenes = scenes
        self.num_scenes, self.num_rollouts = num_scenes, num_rollouts
        self.num_agents = num_agents if num_agents is not None else largest_scene(scenes)
        self.max_controlled = max_controlled
        self.decision_steps, self.horizon = decision_steps, horizon
        self.order = order
        self._cursor = 0
        self._generator = torch.Generator()
        self._scene = torch.full((num_scenes,), -1)
        self._make_specs()

    def _make_specs(self) -> None:
        batch, agents, steps = self.batch_size, (*self.batch_size, self.num_agents), self.decision_steps
        flag = {"n": 2, "dtype": torch.bool, "device": self.device}
        self.observation_spec = Composite(
            {
                keys.SCENE: Bounded(0, len(self.scenes) - 1, shape=batch, dtype=torch.int64, device=self.device),
                keys.STEP: Bounded(0, self.horizon, shape=(*batch, 1), dtype=torch.int64, device=self.device),
                keys.AGENTS: Composite(
                    recent=Unbounded(shape=(*agents, steps + 1, 3), device=self.device),
                    valid=Categorical(shape=agents, **flag),
                    controlled=Categorical(shape=agents, **flag),
                    kind=Categorical(len(AgentKind), shape=agents, dtype=torch.int64, device=self.device),
                    shape=agents,
                ),
            },
            shape=batch,
        )
        self.full_action_spec = Composite(
            {keys.AGENTS: Composite(action=Unbounded(shape=(*agents, steps, 3), device=self.device), shape=agents)},
            shape=batch,
        )
        self.full_reward_spec = Composite(
            {keys.AGENTS: Composite(reward=Unbounded(shape=(*agents, 1), device=self.device), shape=agents)},
            shape=batch,
        )
        self.full_done_spec = Composite(
            {k: Categorical(shape=(*batch, 1), **flag) for k in (keys.DONE, keys.TERMINATED, keys.TRUNCATED)},
            shape=batch,
        )

    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            self._generator.manual_seed(seed)
        self._cursor = 0

    # --- reset ------------------------------------------------------------------------------------------------------
    def _reset(self, tensordict: TensorDictBase | None = None, **_: object) -> TensorDictBase:
        rows = torch.ones(self.batch_size, dtype=torch.bool, device=self.device)
        if tensordict is not None and "_reset" in tensordict.keys():
            rows = tensordict["_reset"].reshape(self.batch_size)
        finished = rows.view(self.num_scenes, self.num_rollouts).all(-1).cpu()
        if finished.any():
            self._load(finished | (self._scene < 0))
        self._recent = torch.where(rows[:, None, None, None], self._start, self._recent)
        self._step_count = torch.where(rows[:, None], 0, self._step_count)
        return self._observe()

    def _load(self, groups: Tensor) -> None:
        """Give the next scenes to some of the S groups (``[S]`` bool) and lay out the logs of all."""
        if self.order == "sequential":
            drawn = (self._cursor + torch.arange(int(groups.sum()))) % len(self.scenes)
            self._cursor = int((self._cursor + len(drawn)) % len(self.scenes))
        else:
            drawn = torch.randint(len(self.scenes), (int(groups.sum()),), generator=self._generator)
        self._scene[groups] = drawn
        scenes = [self._padded(index) for index in self._scene.tolist()]
        batch = collate(scenes).to(self.device)
        each = self._repeat
        agents = batch.agents
        end = CURRENT_STEP + self.decision_steps * self.horizon + 1
        fresh = not hasattr(self, "_start")
        self._start = each(agents.recent(self.decision_steps))
        self._log = each(agents.poses[..., CURRENT_STEP + 1 : end, :].unflatten(-2, (-1, self.decision_steps)))
        self._log_valid = each(agents.valid[..., CURRENT_STEP + 1 : end].unflatten(-1, (-1, self.decision_steps)))
        self._present = each(agents.present)
        self._kind = each(agents.kind)
        self._controlled = each(choose_controlled(batch, self.max_controlled))
        if fresh:
            self._recent = self._start.clone()
            self._step_count = torch.zeros(*self.batch_size, 1, dtype=torch.int64, device=self.device)

    def _padded(self, index: int) -> Scene:
        """One scene with the agents of the simulation only, padded to A."""
        scene = present_agents(self.scenes[index])
        missing = self.num_agents - scene.agents.kind.shape[0]
        if missing < 0:
            raise ValueError(
                f"scene {scene.scene_id} has {self.num_agents - missing} agents at the current step and the "
                f"environment holds {self.num_agents}; raise num_agents."
            )
        return pad_agents(scene, missing)

    def _repeat(self, value: Tensor) -> Tensor:
        """``[S, ...]`` to ``[B, ...]``: the K rollouts of a scene are contiguous."""
        return value.repeat_interleave(self.num_rollouts, 0)

    # --- step -------------------------------------------------------------------------------------------------------
    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        current = self._recent[..., -1:, :]
        index = self._step_count[:, 0].clamp(max=self.horizon - 1)
        rows = torch.arange(len(index), device=self.device)
        log, log_valid = self._log[rows, :, index], self._log_valid[rows, :, index]
        moved = to_world(tensordict[keys.ACTION], current)
        poses = torch.where(self._controlled[..., None, None], moved, log)
        self._recent = torch.cat((current, poses), -2)
        self._step_count = self._step_count + 1
        done = self._step_count >= self.horizon
        error = (poses[..., :2] - log[..., :2]).norm(dim=-1) * log_valid
        reward = -error.sum(-1) / log_valid.sum(-1).clamp(min=1)
        out = self._observe()
        out[keys.REWARD] = reward[..., None]
        out[keys.DONE], out[keys.TRUNCATED], out[keys.TERMINATED] = done, done.clone(), torch.zeros_like(done)
        return out

    def _observe(self) -> TensorDict:
        rows = torch.arange(len(self._recent), device=self.device)
        last = (self._step_count[:, 0] - 1).clamp(min=0)
        logged = torch.where(self._step_count > 0, self._log_valid[rows, :, last, -1], self._present)
        return TensorDict(
            {
                keys.SCENE: self._repeat(self._scene.to(self.device)),
                keys.STEP: self._step_count,
                keys.AGENTS: TensorDict(
                    {
                        "recent": self._recent,
                        "valid": torch.where(self._controlled, self._present, logged),
                        "controlled": self._controlled,
                        "kind": self._kind,
                    },
                    batch_size=(*self.batch_size, self.num_agents),
                ),
            },
            batch_size=self.batch_size,
            device=self.device,
        )


def present_agents(scene: Scene) -> Scene:
    """The scene with the agents that are valid at its current step only: those of a simulation, in their order."""
    return select_agents(scene, scene.agents.present)


def largest_scene(scenes: SceneSource) -> int:
    """The largest number of present agents of any scene; a store knows it without loading scenes."""
    counts = getattr(scenes, "num_agents", None)
    if counts is None:
        counts = [int(scenes[i].agents.present.sum()) for i in range(len(scenes))]
    return int(max(counts))


def pad_agents(scene: Scene, missing: int) -> Scene:
    """Append invalid agents to an uncollated scene."""
    scene = scene.clone(recurse=False)
    agents = scene.agents.clone(recurse=False)
    for field in agents.__dataclass_fields__:
        value = getattr(agents, field)
        fill = -1 if field == "track_id" else 0
        setattr(agents, field, torch.cat((value, value.new_full((missing, *value.shape[1:]), fill))))
    scene.agents = agents
    return scene


def choose_controlled(batch: Scene, limit: int) -> Tensor:
    """Which present agents a policy moves: evaluated agents first, then those nearest to the SDC.

    Args:
        batch: collated scenes.
        limit: agents of one scene at most.

    Returns:
        ``[S, A]`` bool.

    Examples:
        >>> from envs.sources.synthetic import straight_road
        >>> choose_controlled(collate([straight_road(3)]), limit=1)
        tensor([[ True, False, False]])
    """
    agents = batch.agents
    xy = agents.position[:, :, CURRENT_STEP, :2]
    sdc = (xy * agents.sdc[..., None]).sum(1, keepdim=True)
    distance = (xy - sdc).norm(dim=-1) - agents.sdc * 2e6 - agents.predict * 1e6
    rank = distance.masked_fill(~agents.present, torch.inf).argsort(stable=True, dim=-1).argsort(-1)
    return agents.present & (rank < limit)
