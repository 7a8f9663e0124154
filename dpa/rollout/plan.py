"""Which scenes are rolled out together, and in how many pieces, so that memory keeps to a budget."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass

from dpa.training.batches import micro_batches

GIB = 1 << 30
COLLECTED_BYTES = 100, 60
"""Of one agent and decision in a collector's batch: token, flags and reward; and of each of its poses: recent (now and
next), action, and patches."""


def collected_bytes(horizon: int, steps: int) -> int:
    """Of one agent in a collector's batch of episodes.

    Args:
        horizon: T, decisions.
        steps: F, poses of each.

    Examples:
        >>> collected_bytes(horizon=16, steps=5)
        6400
    """
    decision, pose = COLLECTED_BYTES
    return horizon * (decision + steps * pose)


@dataclass(frozen=True)
class RolloutTask:
    """The K rollouts of some scenes: what one worker does at a time.

    Attributes:
        scenes: indices into the source; their agents are padded to the largest of them.
        pieces: rollouts ``range(first, last)`` that run side by side, piece after piece; together ``range(K)``.
    """

    scenes: tuple[int, ...]
    pieces: tuple[range, ...]


def plan_tasks(
    sizes: Mapping[int, int], num_rollouts: int, max_rows: int, done: Collection[int] = ()
) -> list[RolloutTask]:
    """Group scenes of similar size, so that little is padded and rows stay within a bound.

    The groups depend on all scenes and not on what is done, so that an interrupted collection goes on as it would have.

    Args:
        sizes: scenes to roll out and their agents.
        num_rollouts: K.
        max_rows: agents times rollouts that run side by side at most; a scene that alone exceeds it is rolled out in
            pieces, down to one rollout at a time.
        done: scenes that are not needed; a group is left out when all its scenes are.

    Raises:
        ValueError: no rollouts, or no rows.

    Examples:
        >>> for task in plan_tasks({0: 5, 1: 30, 2: 6}, num_rollouts=4, max_rows=60):
        ...     print(task.scenes, task.pieces)
        (0, 2) (range(0, 4),)
        (1,) (range(0, 2), range(2, 4))
    """
    if num_rollouts < 1 or max_rows < 1:
        raise ValueError(f"num_rollouts and max_rows must be 1 or more, got {num_rollouts} and {max_rows}.")
    ordered = list(sizes)
    groups = micro_batches([sizes[index] * num_rollouts for index in ordered], max_rows)
    tasks = (_task([ordered[position] for position in group], sizes, num_rollouts, max_rows) for group in groups)
    return [task for task in tasks if not all(index in done for index in task.scenes)]


def _task(scenes: Sequence[int], sizes: Mapping[int, int], num_rollouts: int, max_rows: int) -> RolloutTask:
    side_by_side = max(1, min(num_rollouts, max_rows // max(1, len(scenes) * max(sizes[index] for index in scenes))))
    return RolloutTask(tuple(scenes), tuple(_pieces(num_rollouts, side_by_side)))


def _pieces(num_rollouts: int, most: int) -> Iterator[range]:
    """``range(K)`` in as few pieces as will do, of equal size within one."""
    count = -(-num_rollouts // most)
    for piece in range(count):
        yield range(piece * num_rollouts // count, (piece + 1) * num_rollouts // count)
