"""Who takes part in a simulation of a scene, and whom a policy moves."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, get_args

import torch
from torch import Tensor

from envs.scene import CURRENT_STEP, LOG_STEPS, STEP_SECONDS, Agents, Scene, SceneSource, select_agents

MAX_CONTROLLED = 128
"""Agents of one scene that a policy moves at most (WOSAC; realism.md section 1.2)."""

ControlName = Literal["all", "sdc", "predict"]
Control = ControlName | Callable[[Scene], Tensor]
"""Whom a policy may move: everybody, the SDC, the tracks to predict, or a function that is given one uncollated scene
with its present agents only and gives those agents as an ``[A]`` bool mask."""


def check_control(control: Control) -> None:
    """Refuse what is neither a name nor a function.

    Raises:
        ValueError: another name.
    """
    if not callable(control) and control not in get_args(ControlName):
        raise ValueError(
            f"control must be one of {list(get_args(ControlName))} or a function Scene -> [A] bool, got {control!r}."
        )


def simulated_agents(scene: Scene, *, arrivals: bool = False, last_step: int = LOG_STEPS - 1) -> Scene:
    """One uncollated scene with the agents of a simulation only.

    Those are the agents valid at the current step, in their order. Arrivals follow in their order: agents that are not
    there at the current step but are logged by ``last_step``. From the current step on every agent has poses: where the
    log has none, before it arrives, in a hole or after it has left, they are carried back from the next logged one at
    constant velocity or stay at the last one, and are not valid.

    Args:
        scene: an uncollated scene.

    Keyword Args:
        arrivals: whether they take part.
        last_step: of the episode, 0 to 90.

    Examples:
        >>> from envs.sources.synthetic import straight_road
        >>> scene = straight_road(3)
        >>> scene.agents.valid[0, :40] = False
        >>> simulated_agents(scene).agents.track_id, simulated_agents(scene, arrivals=True).agents.track_id
        (tensor([2, 3]), tensor([2, 3, 1]))
    """
    agents = scene.agents
    present = agents.present.nonzero()[:, 0]
    arrive = _arrive(agents, last_step).nonzero()[:, 0]
    scene = select_agents(scene, torch.cat((present, arrive)) if arrivals else present)
    _fill(scene.agents)
    return scene


def num_simulated(scene: Scene, *, arrivals: bool = False, last_step: int = LOG_STEPS - 1) -> int:
    """How many agents :func:`simulated_agents` leaves, with the same arguments."""
    agents = scene.agents
    return int((agents.present | _arrive(agents, last_step) if arrivals else agents.present).sum())


def _arrive(agents: Agents, last_step: int) -> Tensor:
    return ~agents.present & agents.valid[:, CURRENT_STEP + 1 : last_step + 1].any(-1)


def _fill(agents: Agents) -> None:
    """Write poses where the log has none from the current step on.

    Before a logged step they are carried back from it at constant velocity and heading; after the last one they stay.
    """
    valid = agents.valid[:, CURRENT_STEP:]
    steps, end = torch.arange(valid.shape[1], device=valid.device), valid.shape[1]
    later = torch.where(valid, steps, end).flip(-1).cummin(-1).values.flip(-1)
    earlier = torch.where(valid, steps, 0).cummax(-1).values
    source = torch.where(later < end, later, earlier)
    back = (source - steps).clamp(min=0)[..., None] * STEP_SECONDS
    rows = torch.arange(len(valid), device=valid.device)[:, None]
    position, velocity = agents.position[rows, CURRENT_STEP + source], agents.velocity[rows, CURRENT_STEP + source]
    position[..., :2] -= back * velocity
    heading = agents.heading[rows, CURRENT_STEP + source]
    # select_agents has copied these tensors, so nobody else sees the change
    for value, held in ((agents.position, position), (agents.heading[..., None], heading[..., None])):
        value[:, CURRENT_STEP:] = torch.where(valid[..., None], value[:, CURRENT_STEP:], held)


def largest_scene(scenes: SceneSource, *, arrivals: bool = False, last_step: int = LOG_STEPS - 1) -> int:
    """The largest number of simulated agents of any scene; without arrivals, a store knows it without loading scenes.

    Args:
        scenes: where scenes come from.

    Keyword Args:
        arrivals: see :func:`simulated_agents`.
        last_step: see :func:`simulated_agents`.
    """
    counts = None if arrivals else getattr(scenes, "num_agents", None)
    if counts is None:
        every = (scenes[index] for index in range(len(scenes)))
        counts = [num_simulated(scene, arrivals=arrivals, last_step=last_step) for scene in every]
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


def choose_controlled(scene: Scene, limit: int, control: Control = "all") -> Tensor:
    """Which agents a policy moves: of those it may, evaluated agents first, then those nearest to the SDC.

    Args:
        scene: an uncollated scene; agents that are not there at the current step are never controlled.
        limit: agents at most.
        control: whom it may move.

    Returns:
        ``[A]`` bool.

    Raises:
        ValueError: a control function that gives something else than an ``[A]`` bool mask.

    Examples:
        >>> from envs.sources.synthetic import straight_road
        >>> choose_controlled(straight_road(3), limit=1)
        tensor([ True, False, False])
        >>> choose_controlled(straight_road(3), limit=9, control=lambda scene: ~scene.agents.sdc)
        tensor([False,  True,  True])
    """
    agents = scene.agents
    eligible = _may_control(scene, control)
    xy = agents.position[:, CURRENT_STEP, :2]
    sdc = (xy * agents.sdc[:, None]).sum(0)
    distance = (xy - sdc).norm(dim=-1) - agents.sdc * 2e6 - agents.predict * 1e6
    rank = distance.masked_fill(~eligible, torch.inf).argsort(stable=True).argsort()
    return eligible & (rank < limit)


def _may_control(scene: Scene, control: Control) -> Tensor:
    """``[A]`` bool: the present agents that control allows."""
    agents = scene.agents
    if not callable(control):
        return {"all": agents.present, "sdc": agents.sdc, "predict": agents.predict}[control] & agents.present
    mask, num = control(select_agents(scene, agents.present)), int(agents.present.sum())
    if not isinstance(mask, Tensor) or mask.dtype != torch.bool or mask.shape != (num,):
        got = f"{tuple(mask.shape)} {mask.dtype}" if isinstance(mask, Tensor) else repr(mask)
        raise ValueError(
            f"scene {scene.scene_id}: control must give a bool mask of its {num} present agents, got {got}."
        )
    return agents.present.masked_scatter(agents.present, mask)
