"""One traffic scene at a time as a :class:`gymnasium.Env`, driven by motion tokens."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Tensor

from dpa.gymnasium_adapter.observation import Observer, Sight
from dpa.tokens import MotionTokenizer, VerletTokenizer
from envs import keys
from envs.episode import EpisodeOptions
from envs.participants import MAX_CONTROLLED
from envs.render import render_frame
from envs.rewards import weighted_reward
from envs.scene import CURRENT_STEP, STEP_SECONDS, SceneSource
from envs.signals import SIGNALS
from envs.store import SceneStore
from envs.traffic import TrafficEnv

WEIGHTS: Mapping[str, float] = MappingProxyType(
    {"progress": 0.1, "collision": -1.0, "offroad": -1.0, "red_light": -1.0}
)
"""Reward for a metre of progress, and for a decision with a collision, off the road, or past a red light."""
PIXELS = 480
"""Side of a picture."""

Observation = dict[str, NDArray[np.float32]]


class TrafficGym(gymnasium.Env[Observation, Any]):
    """A scene of traffic, ``horizon`` decisions long; the rest of the agents follow their log.

    With ``control="sdc"`` an action is the motion token of the self-driving car, ``Discrete(V)``. With ``"all"`` it is
    one token for each controlled agent in the order of the scene, ``MultiDiscrete([V] * A)``, where A fits the largest
    scene: entries beyond a scene's own agents are ignored, and their observations are 0. Observations are those of
    :meth:`~dpa.gymnasium_adapter.observation.Sight.space`.

    The reward is the weighted sum of signals, averaged over the controlled agents. An episode terminates when the SDC
    does something that ``terminate_on`` names, and is truncated at the horizon. ``info`` has ``scene_id``,
    ``log_displacement`` (mean over controlled agents and decisions so far [m],
    0 where nothing is logged) and, for each event among the signals,
    ``<name>_rate``: the share of controlled agents that it has happened to.

    Args:
        scenes: the folder of a store, several of them, or any :class:`~envs.scene.SceneSource`.

    Keyword Args:
        control: whom the action moves.
        tokenizer: what a token means; :class:`~dpa.tokens.VerletTokenizer` by default.
        horizon: decisions in an episode.
        weights: reward of each signal; :data:`WEIGHTS` by default.
        terminate_on: events, names of signals.
        sight: how much an agent sees.
        max_controlled: agents at most, with ``control="all"``.
        render_mode: None or ``"rgb_array"``.

    Raises:
        ValueError: an option that makes no sense, or a scene source without scenes.

    Examples:
        >>> import dpa.gymnasium_adapter
        >>> from envs.sources.synthetic import straight_road
        >>> env = gymnasium.make("dpa/Traffic-v0", scenes=[straight_road(3)])
        >>> observation, info = env.reset(seed=0)
        >>> env.action_space, observation["agents"].shape, info["scene_id"]
        (Discrete(169), (8, 9), 'straight_road_3_None')
        >>> _, reward, terminated, truncated, _ = env.step(84)  # nearly the same speed as before: 5 m on
        >>> round(reward, 2), terminated, truncated
        (0.51, False, False)
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 2}

    def __init__(
        self,
        scenes: SceneSource | str | Path | Sequence[str | Path],
        *,
        control: Literal["sdc", "all"] = "sdc",
        tokenizer: MotionTokenizer | None = None,
        horizon: int = 16,
        weights: Mapping[str, float] = WEIGHTS,
        terminate_on: Sequence[str] = ("collision", "offroad"),
        sight: Sight | None = None,
        max_controlled: int = MAX_CONTROLLED,
        render_mode: str | None = None,
    ) -> None:
        if control not in ("sdc", "all"):
            raise ValueError(f"control must be 'sdc' or 'all', got {control!r}.")
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"render_mode must be None or 'rgb_array', got {render_mode!r}.")
        _check_events(terminate_on)
        if unknown := sorted(set(weights) - set(SIGNALS)):
            raise ValueError(f"weights must be of the signals {', '.join(sorted(SIGNALS))}, got {', '.join(unknown)}.")
        self.tokenizer, self.sight = tokenizer or VerletTokenizer(), sight or Sight()
        self.weights, self.terminate_on = dict(weights), tuple(terminate_on)
        self.render_mode = render_mode
        self.metadata = {**self.metadata, "render_fps": round(1 / (self.tokenizer.steps * STEP_SECONDS))}
        signals = sorted({*weights, *terminate_on})
        self._events = [name for name in signals if name in SIGNALS and SIGNALS[name].dtype is torch.bool]
        self._env = TrafficEnv(
            open_scenes(scenes),
            EpisodeOptions(
                max_controlled=max_controlled,
                decision_steps=self.tokenizer.steps,
                horizon=horizon,
                control=control,
            ),
            signals=signals,
            order="random",
        )
        self._rows = None if control == "sdc" else min(self._env.num_agents, max_controlled)
        vocabulary = self.tokenizer.vocab_size
        self.observation_space = self.sight.space(self._rows)
        self.action_space = (
            spaces.Discrete(vocabulary) if self._rows is None else spaces.MultiDiscrete([vocabulary] * self._rows)
        )
        self._seeded = self._over = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode of a scene drawn at random; the same seeds draw the same scenes."""
        super().reset(seed=seed)
        if seed is not None or not self._seeded:
            with torch.random.fork_rng(devices=[]):  # TorchRL seeds the global generator as well
                self._env.set_seed(int(self.np_random.integers(2**31)))
            self._seeded = True
        self._state, self._over = self._env.reset()[0], False
        self._scene = self._env.scenes[int(self._state[keys.SCENE])]
        self._egos = self._state[keys.CONTROLLED].nonzero()[:, 0]
        self._sdc = self._scene.agents.sdc[self._scene.agents.present].nonzero()[:, 0]
        self._observer = Observer(self._scene, self.sight, self._env.episode.horizon)
        self._displacement, self._happened = 0.0, dict.fromkeys(self._events, torch.zeros(len(self._egos)).bool())
        self._poses: list[Tensor] = []
        return self._observe(), self._info()

    def step(self, action: Any) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Take a decision.

        Raises:
            ValueError: an action outside of the action space.
            RuntimeError: the episode is over.
        """
        if self._over:
            raise RuntimeError("the episode is over; call reset().")
        after = self._env.step(self._acted(action))["next"]
        reward = weighted_reward(after, self.weights)[0, self._egos, 0]
        self._state = after[0]
        self._displacement -= float(after[keys.REWARD][0, self._egos].mean()) if len(self._egos) else 0.0
        for name in self._events:
            self._happened[name] = self._happened[name] | self._state[keys.AGENTS, name][self._egos]
        poses = self._state[keys.RECENT][:, 1:]
        self._poses.append(torch.where(self._state[keys.VALID][:, None, None], poses, torch.nan))
        terminated = any(bool(self._state[keys.AGENTS, name][self._sdc].any()) for name in self.terminate_on)
        truncated = bool(self._state[keys.TRUNCATED])
        self._over = terminated or truncated
        return self._observe(), float(reward.mean()) if len(reward) else 0.0, terminated, truncated, self._info()

    def render(self) -> NDArray[np.uint8] | None:
        """The scene from above at this decision, ``[H, W, 3]``; None without a render mode."""
        if self.render_mode is None:
            return None
        num = int(self._scene.agents.present.sum())
        nothing_yet = torch.full((self._env.num_agents, 1, 3), torch.nan)
        poses = torch.cat(self._poses, 1) if self._poses else nothing_yet
        step = CURRENT_STEP + len(self._poses) * self.tokenizer.steps
        return render_frame(self._scene, poses[:num], step=step, pixels=PIXELS)

    def _acted(self, action: Any) -> TensorDictBase:
        """The state with the poses of an action."""
        if not self.action_space.contains(action if self._rows is None else np.asarray(action)):
            raise ValueError(f"an action must be of {self.action_space}, got {action!r}.")
        state = self._state[None].exclude(keys.REWARD, *(keys.DONE, keys.TERMINATED, keys.TRUNCATED))
        token = torch.zeros(1, self._env.num_agents, dtype=torch.int64)
        token[0, self._egos] = torch.as_tensor(action).flatten()[: len(self._egos)]
        return state.set(keys.ACTION, self.tokenizer.decode(token, state[keys.RECENT], state[keys.KIND]))

    def _observe(self) -> Observation:
        seen = self._observer.observe(self._state, self._egos)
        if self._rows is None:
            return {name: value[0] for name, value in seen.items()}
        missing = self._rows - len(self._egos)
        return {name: np.pad(value, ((0, missing), *[(0, 0)] * (value.ndim - 1))) for name, value in seen.items()}

    def _info(self) -> dict[str, Any]:
        rates = {f"{name}_rate": float(events.float().mean()) for name, events in self._happened.items()}
        taken = max(1, len(self._poses))
        return {"scene_id": self._scene.scene_id, "log_displacement": self._displacement / taken, **rates}


def open_scenes(scenes: SceneSource | str | Path | Sequence[str | Path]) -> SceneSource:
    """Scenes of one folder or several, or the source itself."""
    if isinstance(scenes, str | Path):
        return SceneStore(scenes)
    if isinstance(scenes, list | tuple) and scenes and all(isinstance(each, str | Path) for each in scenes):
        return SceneStore(*scenes)
    return scenes


def _check_events(names: Sequence[str]) -> None:
    events = sorted(name for name, each in SIGNALS.items() if each.dtype is torch.bool)
    wrong = [name for name in names if name not in events]
    if wrong:
        raise ValueError(f"terminate_on must name events of {events}, got {wrong}.")
