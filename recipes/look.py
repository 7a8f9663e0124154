"""See why a rollout is preferred: its coupling with the log, or the nearest and the farthest rollouts of a scene.

    python -m recipes.look policy=runs/pretrain/policy.pt preferences=runs/preferences scene=0 rollout=worst
    python -m recipes.look policy=runs/pretrain/policy.pt preferences=runs/preferences scene=0 figure=rollouts

Scenes and split are those that the preferences were collected with.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import hydra
from omegaconf import DictConfig
from tensordict import TensorDict
from torch import Tensor

from dpa.preferences import PreferenceStore
from dpa.ranking import FEATURES, PreferenceDistance
from dpa.report.coupling import agent_name, couple_agent, plot_coupling
from dpa.report.ranked import plot_ranked
from envs import keys
from envs.scene import Scene
from envs.store import SceneStore
from recipes.common.cli import CONFIG, build, recipe
from recipes.common.models import given_policy, open_policy
from recipes.common.rankings import open_preferences
from recipes.common.rolled import stored
from recipes.common.scenes import open_splits

FIGURES = ("coupling", "rollouts")
TOLERANCE = 0.01
"""Most that a distance may differ from the stored one: another device rounds poses otherwise, relative above 1."""


class RankedScene(NamedTuple):
    """A scene of a store with its rollouts as they drove; A are the agents present at the current step.

    Attributes:
        scene: uncollated.
        trajectories: ``[K, A, T * F, 4]`` x, y, z, heading.
        ranked: what the store holds of the scene, agents padded to those of the simulation.
        distance: that ranked them, where couplings are looked at.
    """

    scene: Scene
    trajectories: Tensor
    ranked: TensorDict
    distance: PreferenceDistance | None


def open_ranked(policy: Path, preferences: Path, scenes: SceneStore, name: str, *, coupled: bool = True) -> RankedScene:
    """One scene of a preference store; its poses follow from its tokens.

    Args:
        policy: file of the policy whose rollouts these are.
        preferences: folder of the store.
        scenes: that the preferences are of.
        name: id or index of the scene.
        coupled: couplings are to be looked at, which not every distance has.

    Raises:
        SceneError: no such scene.
        ValueError: preferences of other scenes or of another policy, or without this scene.
    """
    model, options, _ = open_policy(policy)
    store = open_preferences(preferences, scenes, model, policy)
    index = scenes.find(name)
    rows = (store.scenes == index).nonzero()[:, 0].tolist()
    if not rows:
        raise ValueError(
            f"{preferences} holds {len(store)} of {len(scenes)} scenes and not scene {name}; collect on, or choose one "
            f"of them, for example scene={store.scenes[0] if len(store) else '...'}."
        )
    (rolled,) = stored(store, rows, scenes, model, options)
    ranked = store.read(rows, num_agents=len(rolled.controlled))[0]
    return RankedScene(rolled.scene, rolled.trajectories, ranked, distance_of(store) if coupled else None)


def distance_of(store: PreferenceStore) -> PreferenceDistance:
    """The distance that ranked a store: the inverse of :meth:`~dpa.ranking.PreferenceDistance.describe`.

    Raises:
        ValueError: it has features or options that this program does not have.
    """
    options: dict[str, Any] = dict(store.provenance.ranking)
    if (kind := options.pop("kind", "preference")) != "preference":
        raise ValueError(
            f"{store.folder} was ranked by {kind}, which couples nothing; say figure=rollouts, or open another store."
        )
    unknown = sorted(set(options["weights"]) - set(FEATURES))
    if unknown:
        raise ValueError(
            f"{store.folder} was ranked with the features {unknown}, which are not registered here; add them to "
            "dpa/ranking/features/more.py."
        )
    return build(
        PreferenceDistance, DictConfig({**options, "features": list(options["weights"])}), f"{store.folder}: ranking"
    )


def chosen_rollout(rank: Tensor, name: str) -> int:
    """Number of a rollout in the store.

    Args:
        rank: ``[K]``, 0 for the nearest.
        name: best, worst or the number itself.

    Raises:
        ValueError: another word, or a number that is not there.

    Examples:
        >>> import torch
        >>> [chosen_rollout(torch.tensor([1, 0, 2]), name) for name in ("best", "worst", "0")]
        [1, 2, 0]
    """
    if name in ("best", "worst"):
        return int(rank.argmin() if name == "best" else rank.argmax())
    if not name.isdecimal() or int(name) >= len(rank):
        raise ValueError(f"rollout must be best, worst or 0 to {len(rank) - 1}, got {name!r}.")
    return int(name)


def chosen_agent(group: RankedScene, rollout: int, name: str) -> int:
    """Row of an agent in the store: of those that were ranked.

    Args:
        group: the scene.
        rollout: number of a rollout.
        name: ``worst`` (of this rollout), a row, or ``id:NUMBER`` as in the recording.

    Raises:
        ValueError: another word, or an agent that is not there or was not ranked.
    """
    ranked = group.ranked[keys.AGENT_RANKED].nonzero()[:, 0].tolist()
    if not ranked:
        raise ValueError(f"no agent of scene {group.scene.scene_id} was ranked; choose another scene.")
    if name == "worst":
        return max(ranked, key=lambda row: float(group.ranked[keys.AGENT_DISTANCE][rollout, row]))
    kind, _, number = name.rpartition(":")
    if kind not in ("", "id") or not number.isdecimal():
        raise ValueError(f"agent must be worst, a row such as {ranked[0]}, or id:NUMBER, got {name!r}.")
    ids = group.scene.agents.track_id[group.scene.agents.present].tolist()
    rows = [row for row in ranked if int(number) == (ids[row] if kind else row)]
    if not rows:
        known = ", ".join(f"{row} (id:{ids[row]})" for row in ranked[:8]) + (", ..." if len(ranked) > 8 else "")
        raise ValueError(
            f"agent={name} is none of the {len(ranked)} ranked agents of scene {group.scene.scene_id}; choose one of "
            f"{known}."
        )
    return rows[0]


def look_at_coupling(group: RankedScene, rollout: int, agent: int, output: Path) -> None:
    """Draw one agent of one rollout against its log.

    Raises:
        ValueError: its distance is no longer the stored one.
    """
    scene, trajectory = group.scene, group.trajectories[rollout]
    coupled = couple_agent(group.distance, scene, trajectory, agent)
    stored = float(group.ranked[keys.AGENT_DISTANCE][rollout, agent])
    if abs(coupled.distance - stored) > TOLERANCE * max(1.0, stored):
        raise ValueError(
            f"{agent_name(scene, agent)} of scene {scene.scene_id} was ranked with distance {stored:.4g}, and its "
            f"tokens now give {coupled.distance:.4g}: the code of features or tokens has changed; collect again."
        )
    rank, last = int(group.ranked[keys.RANK][rollout]), len(group.trajectories) - 1
    total = float(group.ranked[keys.DISTANCE][rollout])
    place = f"rank {rank} of 0–{last}, distance {total:.2f} over all agents"
    title = f"scene {scene.scene_id}, rollout {rollout} ({place}), {agent_name(scene, agent)}"
    plot_coupling(scene, trajectory, agent, coupled, output, title=title)


@hydra.main(**CONFIG, config_name="look")
@recipe
def main(cfg: DictConfig) -> None:
    """Entry point of ``python -m recipes.look``."""
    if cfg.figure not in FIGURES:
        raise ValueError(f"figure must be one of {', '.join(FIGURES)}, got {cfg.figure!r}.")
    policy = given_policy(cfg.policy)
    scenes = open_splits(cfg.scenes)[cfg.split]
    coupled = cfg.figure == "coupling"
    group = open_ranked(policy, Path(cfg.preferences), scenes, str(cfg.scene), coupled=coupled)
    output = Path(cfg.output)
    output.parent.mkdir(parents=True, exist_ok=True)
    if coupled:
        rollout = chosen_rollout(group.ranked[keys.RANK], str(cfg.rollout))
        look_at_coupling(group, rollout, chosen_agent(group, rollout, str(cfg.agent)), output)
    else:
        ranked = group.ranked[keys.AGENT_RANKED].nonzero()[:, 0]
        plot_ranked(group.scene, group.trajectories, group.ranked[keys.DISTANCE], ranked, output, each=cfg.each)
    print(f"figure: {output}")


if __name__ == "__main__":
    main()
