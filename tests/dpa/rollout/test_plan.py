"""Plans hold every rollout of every scene once, within the bound, and do not depend on what is done."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dpa.models.motionlm import MotionLM
from dpa.rollout.plan import plan_tasks
from dpa.tokens import VerletTokenizer

SCENES = st.dictionaries(st.integers(0, 30), st.integers(1, 128), max_size=12)


@given(sizes=SCENES, num_rollouts=st.integers(1, 64), max_rows=st.integers(1, 5000))
def test_every_rollout_is_planned_once_within_the_bound(
    sizes: dict[int, int], num_rollouts: int, max_rows: int
) -> None:
    tasks = plan_tasks(sizes, num_rollouts, max_rows)
    assert sorted(scene for task in tasks for scene in task.scenes) == sorted(sizes)
    for task in tasks:
        assert [k for piece in task.pieces for k in piece] == list(range(num_rollouts))
        largest = max(sizes[scene] for scene in task.scenes)
        for piece in task.pieces:
            rows = len(task.scenes) * largest * len(piece)
            assert rows <= max_rows or (len(task.scenes) == 1 and len(piece) == 1)


@given(sizes=SCENES, done=st.sets(st.integers(0, 30)))
def test_what_is_done_leaves_the_other_tasks_as_they_are(sizes: dict[int, int], done: set[int]) -> None:
    whole = plan_tasks(sizes, 4, max_rows=200)
    assert plan_tasks(sizes, 4, 200, done) == [task for task in whole if not done.issuperset(task.scenes)]


def test_scenes_of_similar_size_go_together() -> None:
    tasks = plan_tasks({0: 2, 1: 1, 2: 3, 3: 2}, num_rollouts=2, max_rows=8)
    assert [task.scenes for task in tasks] == [(1, 0), (3,), (2,)]


def test_a_larger_model_takes_more_memory_per_row() -> None:
    small, large = (MotionLM(size, VerletTokenizer()).bytes_per_row() for size in ("nano", "paper"))
    assert small < large


@pytest.mark.parametrize(("num_rollouts", "max_rows"), [(0, 10), (4, 0)])
def test_nothing_to_do_is_refused(num_rollouts: int, max_rows: int) -> None:
    with pytest.raises(ValueError, match=f"must be 1 or more, got {num_rollouts} and {max_rows}"):
        plan_tasks({0: 1}, num_rollouts, max_rows)
