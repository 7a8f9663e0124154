"""Poses in the frame of a scene <-> the message of a scenario, which holds world coordinates."""

from __future__ import annotations

from collections import Counter
from typing import Any

import torch
from torch import Tensor

from dpa.realism.submission.messages import POSE_FIELDS, ScenarioRollouts, SubmissionError
from dpa.realism.tracks import HORIZON
from envs.scene import Scene

_INT32 = torch.iinfo(torch.int32)


def present_ids(scene: Scene) -> list[int]:
    """Ids of the agents that a submission holds, in the order of poses (realism.md section 1.2).

    Raises:
        SubmissionError: an id is not unique, or does not fit the format.

    Examples:
        >>> from envs.sources.synthetic import straight_road
        >>> present_ids(straight_road(3))
        [1, 2, 3]
    """
    ids = scene.agents.track_id[scene.agents.present].tolist()
    wrong = [track for track, count in Counter(ids).items() if count > 1 or not _INT32.min <= track <= _INT32.max]
    if wrong:
        raise SubmissionError(
            f"scene {scene.scene_id}: track id {wrong[0]} occurs twice or is no int32; objects of a submission need "
            "ids of their own: give the tracks others and convert the scene again."
        )
    return ids


def encode_rollouts(scene: Scene, poses: Tensor) -> Any:
    """Rollouts of one scene -> ``ScenarioRollouts``.

    The origin of the scene is added in float64 and the sum rounded to float32, as the metric does; headings stay.

    Args:
        scene: one uncollated scene.
        poses: ``[R, A, 80, 4]`` float, x, y, z [m], heading [rad] of the steps 11 to 90 in the scene's frame; A are the
            agents with ``scene.agents.present``, in that order.

    Raises:
        SubmissionError: the shape does not fit the scene, a value is not finite, or an id cannot be written.

    Examples:
        >>> from envs.sources.synthetic import straight_road
        >>> scene = straight_road(num_vehicles=2)
        >>> scene.origin += 1000.0
        >>> message = encode_rollouts(scene, torch.zeros(32, 2, 80, 4))
        >>> message.joint_scenes[0].simulated_trajectories[1].center_x[79]
        1000.0
    """
    ids = present_ids(scene)
    if poses.ndim != 4 or not len(poses) or poses.shape[1:] != (len(ids), HORIZON, 4):
        raise SubmissionError(
            f"scene {scene.scene_id}: rollouts must have shape [R, {len(ids)}, {HORIZON}, 4] (rollouts, agents present "
            f"at the current step, steps, x y z heading), got {list(poses.shape)}."
        )
    origin = torch.nn.functional.pad(scene.origin, (0, 1)).cpu()
    world = (poses.detach().cpu().double() + origin).float()
    _check_finite(scene, ids, world)
    message = ScenarioRollouts(scenario_id=scene.scene_id)
    for rollout in world.transpose(-1, -2).tolist():
        joint = message.joint_scenes.add()
        for track, columns in zip(ids, rollout, strict=True):
            trajectory = joint.simulated_trajectories.add(object_id=track)
            for field, values in zip(POSE_FIELDS, columns, strict=True):
                getattr(trajectory, field).extend(values)
    return message


def decode_rollouts(scene: Scene, message: Any) -> Tensor:
    """``ScenarioRollouts`` -> rollouts in the frame of its scene, ready for :func:`dpa.realism.realism`.

    Args:
        scene: one uncollated scene.
        message: rollouts of this scene; the objects may come in any order.

    Returns:
        ``[R, A, 80, 4]`` float32, x, y, z [m], heading [rad]; A are the agents with ``scene.agents.present``, in that
        order.

    Raises:
        SubmissionError: the message is of another scenario, holds no rollout, other objects than the scene, an object
            twice, not 80 entries in a field, or a value that is not finite.

    Examples:
        >>> from envs.sources.synthetic import straight_road
        >>> scene = straight_road(num_vehicles=2)
        >>> poses = torch.rand(32, 2, 80, 4)
        >>> torch.equal(decode_rollouts(scene, encode_rollouts(scene, poses)), poses)
        True
    """
    if message.scenario_id != scene.scene_id:
        raise SubmissionError(
            f"rollouts of scenario {message.scenario_id!r} do not belong to scene {scene.scene_id!r}."
        )
    if not message.joint_scenes:
        raise SubmissionError(f"scenario {scene.scene_id}: it has no rollout; write it again.")
    ids = present_ids(scene)
    rows = [_columns(scene, ids, number, joint) for number, joint in enumerate(message.joint_scenes)]
    world = torch.tensor(rows, dtype=torch.float64).transpose(-1, -2)
    _check_finite(scene, ids, world)
    return (world - torch.nn.functional.pad(scene.origin, (0, 1)).cpu()).float()


def _columns(scene: Scene, ids: list[int], number: int, joint: Any) -> list[list[list[float]]]:
    """x, y, z and heading of the objects of one rollout, in the order of the ids."""
    where = f"scenario {scene.scene_id}, rollout {number}"
    by_id = {trajectory.object_id: trajectory for trajectory in joint.simulated_trajectories}
    if len(joint.simulated_trajectories) != len(ids) or by_id.keys() != set(ids):
        given = sorted(trajectory.object_id for trajectory in joint.simulated_trajectories)
        raise SubmissionError(f"{where}: must hold the objects {sorted(ids)}, once each, and holds {given}.")
    columns = [[list(getattr(by_id[track], field)) for field in POSE_FIELDS] for track in ids]
    for track, values in zip(ids, columns, strict=True):
        for field, column in zip(POSE_FIELDS, values, strict=True):
            if len(column) != HORIZON:
                raise SubmissionError(
                    f"{where}, object {track}: {field} must have {HORIZON} entries, has {len(column)}."
                )
    return columns


def _check_finite(scene: Scene, ids: list[int], world: Tensor) -> None:
    finite = torch.isfinite(world)
    if not finite.all():
        rollout, agent, step, column = (~finite).nonzero()[0].tolist()
        raise SubmissionError(
            f"scenario {scene.scene_id}, rollout {rollout}, object {ids[agent]}: {POSE_FIELDS[column]} is "
            f"{world[rollout, agent, step, column].item()} at simulated step {step}; give finite float32 values."
        )
