"""The vectorised multi-agent traffic environment."""

from __future__ import annotations

from collections.abc import Sequence
from numbers import Integral
from os import PathLike
from typing import Any, Literal

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from envs import keys
from envs.episode import EpisodeOptions
from envs.geometry.frames import to_world
from envs.participants import largest_scene, pad_agents, simulated_agents
from envs.scene import CURRENT_STEP, AgentKind, Scene, SceneSource, collate
from envs.signals import Signals


class TrafficEnv(EnvBase):
    """S traffic scenes, K times each, as one environment of batch size ``[B] = [S * K]``.

    An episode starts at the current step of a log, with one second of history, and takes ``horizon`` decisions of
    ``decision_steps`` poses. The agents of a scene are those valid at its current step, in the order of the scene,
    padded to ``num_agents``. Of those that ``control`` allows, up to ``max_controlled`` follow their actions to the
    end: evaluated agents first, then those nearest to the SDC. The rest follow and leave with their log, and
    ``("agents", "controlled")`` says which. With ``arrivals``, agents that the log brings in later come after the
    present ones; they always follow their log, and are not ``valid`` before it begins.

    The K rollouts of a scene are contiguous rows. A scene gives way to the next one when all its rows are reset; a row
    that is reset alone starts its scene again. The map stays out of the observations: ``scene`` is its index in
    ``scenes``.

    Specs (shapes in :mod:`envs.keys`): observations ``scene``, ``step`` and, under ``agents``, ``recent``, ``valid``,
    ``controlled``, ``kind`` and the ``signals`` asked for; action ``("agents", "action")``: the next F poses in the
    agent's own frame; reward ``("agents", "reward")``: minus the mean displacement from the log over the decision [m]
    (:class:`~envs.rewards.SignalReward` makes another one); ``done`` at the horizon.

    Args:
        scenes: where scenes come from.
        episode: who takes part, whom a policy moves, and for how long.

    Keyword Args:
        num_scenes: S.
        num_rollouts: K.
        num_agents: A; by default the largest number of agents of any scene in ``scenes``, for which ``arrivals`` reads
            them all.
        signals: names of :data:`~envs.signals.SIGNALS` to compute in every decision: ``"collision"``, ``"offroad"``,
            ``"progress"``, ``"red_light"``; one that is not named costs nothing.
        order: ``"sequential"`` takes the scenes in turn, ``"random"`` draws them with the environment's seed.
        device: where states live.

    Raises:
        ValueError: no scenes, an option that makes no sense, or a scene with more than ``num_agents`` agents.

    Examples:
        >>> from envs.sources.synthetic import straight_road
        >>> env = TrafficEnv([straight_road(2), straight_road(3)], num_scenes=2, num_rollouts=4)
        >>> rollout = env.rollout(16)
        >>> rollout["next", "agents", "recent"].shape
        torch.Size([8, 16, 3, 6, 3])
        >>> env = TrafficEnv([straight_road(3)], EpisodeOptions(control="sdc", horizon=4), signals=["collision"])
        >>> env.rollout(4)["next", "agents", "collision"].shape
        torch.Size([1, 4, 3])
    """

    batch_locked = True

    def __init__(
        self,
        scenes: SceneSource,
        episode: EpisodeOptions | None = None,
        *,
        num_scenes: int = 1,
        num_rollouts: int = 1,
        num_agents: int | None = None,
        signals: Sequence[str] = (),
        order: Literal["sequential", "random"] = "sequential",
        device: torch.device | str = "cpu",
    ) -> None:
        if isinstance(scenes, str | PathLike):
            raise TypeError(f"TrafficEnv takes scenes, got {scenes!r}; open a folder with SceneStore({str(scenes)!r}).")
        if len(scenes) == 0:
            raise ValueError("TrafficEnv needs at least one scene, got an empty source.")
        if order not in ("sequential", "random"):
            raise ValueError(f"order must be 'sequential' or 'random', got {order!r}.")
        sizes = {} if num_agents is None else {"num_agents": num_agents}
        _check_positive(num_scenes=num_scenes, num_rollouts=num_rollouts, **sizes)
        super().__init__(device=device, batch_size=[num_scenes * num_rollouts])
        self.scenes, self.episode = scenes, episode or EpisodeOptions()
        self.num_scenes, self.num_rollouts, self.order = num_scenes, num_rollouts, order
        self.num_agents = largest_scene(scenes, **self.episode.cast) if num_agents is None else num_agents
        self._named = (signals,) if isinstance(signals, str) else tuple(signals)
        self._cursor = 0
        self._generator = torch.Generator()
        self._begin()
        self._make_specs()

    def _begin(self) -> None:
        """As before the first reset, on the device at hand."""
        self._signals = Signals(self._named, self.num_rollouts, self.device) if self._named else None
        self._scene = torch.full((self.num_scenes,), -1)  # stays on the host, which loads the scenes
        self._loaded = False

    def to(self, *args: Any, **kwargs: Any) -> TrafficEnv:
        """Move the environment; an episode under way is over, and the next reset begins another."""
        there = self.device
        moved = super().to(*args, **kwargs)
        if self.device != there:
            self._begin()
        return moved

    def _make_specs(self) -> None:
        batch, agents, steps = self.batch_size, (*self.batch_size, self.num_agents), self.episode.decision_steps
        flag = {"n": 2, "dtype": torch.bool, "device": self.device}
        self.observation_spec = Composite(
            {
                keys.SCENE: Bounded(0, len(self.scenes) - 1, shape=batch, dtype=torch.int64, device=self.device),
                keys.STEP: Bounded(0, self.episode.horizon, shape=(*batch, 1), dtype=torch.int64, device=self.device),
                keys.AGENTS: Composite(
                    recent=Unbounded(shape=(*agents, steps + 1, 3), device=self.device),
                    valid=Categorical(shape=agents, **flag),
                    controlled=Categorical(shape=agents, **flag),
                    kind=Categorical(len(AgentKind), shape=agents, dtype=torch.int64, device=self.device),
                    shape=agents,
                    **({} if self._signals is None else self._signals.specs(agents)),
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
        unknown = self._scene < 0  # which have not begun, or not on this device
        if unknown.any():
            rows = rows | self._repeat(unknown.to(self.device))
        finished = rows.view(self.num_scenes, self.num_rollouts).all(-1).cpu()
        if finished.any():
            self._load(finished)
        self._recent = torch.where(rows[:, None, None, None], self._start, self._recent)
        self._step_count = torch.where(rows[:, None], 0, self._step_count)
        out = self._observe()
        if self._signals is not None:
            self._signals.reset(rows)
            out[keys.AGENTS].update(self._signals.nothing(out[keys.AGENTS].shape))
        return out

    def _load(self, groups: Tensor) -> None:
        """Give the next scenes to some of the S groups (``[S]`` bool) and lay out the logs of all."""
        if self.order == "sequential":
            drawn = (self._cursor + torch.arange(int(groups.sum()))) % len(self.scenes)
            self._cursor = int((self._cursor + len(drawn)) % len(self.scenes))
        else:
            drawn = torch.randint(len(self.scenes), (int(groups.sum()),), generator=self._generator)
        self._scene[groups] = drawn
        self._scene_there = self._repeat(self._scene.to(self.device))
        scenes = [self._padded(index) for index in self._scene.tolist()]
        batch = collate(scenes).to(self.device)
        each = self._repeat
        agents = batch.agents
        end = CURRENT_STEP + self.episode.steps + 1
        fresh, self._loaded = not self._loaded, True
        self._start = each(agents.recent(self.episode.decision_steps))
        self._log = each(agents.poses[..., CURRENT_STEP + 1 : end, :].unflatten(-2, (-1, self.episode.decision_steps)))
        self._log_valid = each(
            agents.valid[..., CURRENT_STEP + 1 : end].unflatten(-1, (-1, self.episode.decision_steps))
        )
        self._present = each(agents.present)
        self._kind = each(agents.kind)
        controlled = torch.stack([self.episode.choose(scene) for scene in scenes])
        self._controlled = each(controlled.to(self.device))
        if self._signals is not None:
            self._signals.load(self._scene.tolist(), scenes, batch, controlled)
        if fresh:
            self._recent = self._start.clone()
            self._step_count = torch.zeros(*self.batch_size, 1, dtype=torch.int64, device=self.device)

    def _padded(self, index: int) -> Scene:
        """One scene with the agents of the simulation only, padded to A."""
        scene = simulated_agents(self.scenes[index], **self.episode.cast)
        missing = self.num_agents - scene.agents.kind.shape[0]
        if missing < 0:
            when = "in the episode" if self.episode.arrivals else "at the current step"
            raise ValueError(
                f"scene {scene.scene_id} has {self.num_agents - missing} agents {when} and the environment holds "
                f"{self.num_agents}; raise num_agents."
            )
        return pad_agents(scene, missing)

    def _repeat(self, value: Tensor) -> Tensor:
        """``[S, ...]`` to ``[B, ...]``: the K rollouts of a scene are contiguous."""
        return value.repeat_interleave(self.num_rollouts, 0)

    # --- step -------------------------------------------------------------------------------------------------------
    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        current = self._recent[..., -1:, :]
        index = self._step_count[:, 0].clamp(max=self.episode.horizon - 1)
        rows = torch.arange(len(index), device=self.device)
        log, log_valid = self._log[rows, :, index], self._log_valid[rows, :, index]
        before = None if self._signals is None else self._valid_now()
        moved = to_world(tensordict[keys.ACTION], current)
        poses = torch.where(self._controlled[..., None, None], moved, log)
        self._recent = torch.cat((current, poses), -2)
        self._step_count = self._step_count + 1
        done = self._step_count >= self.episode.horizon
        error = (poses[..., :2] - log[..., :2]).norm(dim=-1) * log_valid
        reward = -error.sum(-1) / log_valid.sum(-1).clamp(min=1)
        out = self._observe()
        if before is not None:
            later = torch.where(self._controlled[..., None], self._present[..., None], log_valid)
            valid, first = torch.cat((before[..., None], later), -1), CURRENT_STEP + index * self.episode.decision_steps
            out[keys.AGENTS].update(self._signals.measure(self._recent, valid, first))
        out[keys.REWARD] = reward[..., None]
        out[keys.DONE], out[keys.TRUNCATED], out[keys.TERMINATED] = done, done.clone(), torch.zeros_like(done)
        return out

    def _valid_now(self) -> Tensor:
        """``[B, A]`` bool: the agent is there; a controlled one to the end, a replayed one while it is logged."""
        rows = torch.arange(len(self._recent), device=self.device)
        last = (self._step_count[:, 0] - 1).clamp(0, self.episode.horizon - 1)
        logged = torch.where(self._step_count > 0, self._log_valid[rows, :, last, -1], self._present)
        return torch.where(self._controlled, self._present, logged)

    def _observe(self) -> TensorDict:
        return TensorDict(
            {
                keys.SCENE: self._scene_there,
                keys.STEP: self._step_count,
                keys.AGENTS: TensorDict(
                    {
                        "recent": self._recent,
                        "valid": self._valid_now(),
                        "controlled": self._controlled,
                        "kind": self._kind,
                    },
                    batch_size=(*self.batch_size, self.num_agents),
                    device=self.device,  # without it, TensorDict moves what is there already and waits for the device
                ),
            },
            batch_size=self.batch_size,
            device=self.device,
        )


def _check_positive(**sizes: int) -> None:
    for name, value in sizes.items():
        if not isinstance(value, Integral) or isinstance(value, bool) or value < 1:
            raise ValueError(f"{name} must be a whole number of 1 or more, got {value!r}.")
