"""What the player is given: poses to a centimetre, mishaps, ranks and couplings as they are."""

from __future__ import annotations

import json
import math
import string
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from dpa.ranking import PreferenceDistance, log_trajectory
from dpa.realism import realism
from dpa.report.coupling import couple_agent
from dpa.report.judged import couple, kept_rollouts, logged_mishaps, mishaps
from dpa.report.packing import pack_numbers, pack_tracks, run_lengths, simplified
from dpa.report.player import PlayerScene, pack_players
from envs.render import pose_tracks
from envs.scene import AgentKind, MapKind, Scene
from envs.sources.synthetic import build_scene, red_light, straight_road, two_cars_head_on
from tests.dpa.report.made_rollouts import COLLISION, OFFROAD, judged, made_players, slower, with_mishaps

LETTERS = string.ascii_uppercase + string.ascii_lowercase + string.digits + "+/"


# --- the decoder that the page has, once more -----------------------------------------------------------------------
def unpack_numbers(text: str) -> list[int]:
    numbers, value, shift = [], 0, 0
    for letter in text:
        bits = LETTERS.index(letter)
        value += (bits & 31) << shift
        shift += 5
        if bits < 32:
            numbers.append(-(value // 2) if value % 2 else value // 2)
            value = shift = 0
    return numbers


def unpack_track(text: str, steps: int) -> list[tuple[int, int, int] | None]:
    """Poses in whole centimetres."""
    numbers = iter([*unpack_numbers(text), *[0] * (3 * steps + 1)])
    runs = [(next(numbers), next(numbers)) for _ in range(next(numbers))]
    poses: list[tuple[int, int, int] | None] = [None] * steps
    pose, change, seen = np.zeros(3, dtype=int), np.zeros(3, dtype=int), 0
    for first, length in runs:
        for step in range(first, first + length):
            given = np.array([next(numbers) for _ in range(3)])
            change = given if seen < 2 else change + given
            pose, seen = pose + change, seen + 1
            poses[step] = tuple(pose.tolist())
    return poses


def unpack_flags(runs: dict[str, list[int]], agents: int, steps: int) -> Tensor:
    flags = torch.zeros(agents, steps, dtype=torch.bool)
    for agent, spans in runs.items():
        for first, length in zip(spans[::2], spans[1::2], strict=True):
            flags[int(agent), first : first + length] = True
    return flags


@pytest.fixture(scope="module")
def packed() -> dict[str, Any]:
    return json.loads(json.dumps(pack_players(made_players()), allow_nan=False))


# --- numbers --------------------------------------------------------------------------------------------------------
@given(st.lists(st.integers(-(2**40), 2**40), max_size=30))
def test_packed_numbers_unpack_to_themselves_but_for_zeros_at_the_end(numbers: list[int]) -> None:
    while numbers and numbers[-1] == 0:
        numbers.pop()
    assert unpack_numbers(pack_numbers([*numbers, 0, 0])) == numbers


@settings(max_examples=40, deadline=None)
@given(st.lists(st.one_of(st.none(), st.tuples(*[st.floats(-900, 900)] * 3)), min_size=1, max_size=12))
def test_packed_tracks_unpack_to_the_rounded_poses(poses: list[tuple[float, float, float] | None]) -> None:
    rows = torch.tensor([[pose or (math.nan,) * 3 for pose in poses]], dtype=torch.float64)
    (text,) = pack_tracks(rows)
    expected = [None if pose is None else tuple(np.rint(np.array(pose) / 0.01).astype(int)) for pose in poses]
    assert unpack_track(text, len(poses)) == expected


@given(st.lists(st.booleans(), max_size=20))
def test_runs_are_the_steps_at_which_a_flag_is_set(flags: list[bool]) -> None:
    runs = run_lengths(np.array(flags, dtype=bool))
    steps = [step for first, length in zip(runs[::2], runs[1::2], strict=True) for step in range(first, first + length)]
    assert steps == [step for step, flag in enumerate(flags) if flag]


@settings(max_examples=25, deadline=None)
@given(st.lists(st.tuples(st.floats(-50, 50), st.floats(-50, 50)), min_size=1, max_size=15))
def test_a_simplified_line_keeps_its_ends_and_stays_near_its_points(points: list[tuple[float, float]]) -> None:
    line = np.array(points)
    keep = simplified(line, 0.5)
    assert keep[0] and keep[-1]
    kept = keep.nonzero()[0]
    for index in (~keep).nonzero()[0]:
        start, end = line[kept[kept < index][-1]], line[kept[kept > index][0]]
        chord = end - start
        along = np.clip((line[index] - start) @ chord / max(chord @ chord, 1e-12), 0, 1)
        assert np.linalg.norm(line[index] - start - along * chord) <= 0.5 + 1e-9


# --- the scene ------------------------------------------------------------------------------------------------------
def test_the_packed_log_is_the_log_and_absent_agents_stay_absent() -> None:
    scene = straight_road(2)
    scene.agents.valid[1, 20:] = False
    scene.agents.kind[1] = AgentKind.PEDESTRIAN
    data = pack_players([PlayerScene(scene, {})])
    (entry,) = data["scenes"]
    assert [data["classes"][index]["name"] for index in entry["class"]] == ["SDC", "Pedestrian"]
    assert entry["agents"] == ["SDC 1", "pedestrian 2"]
    first, second = (unpack_track(text, 91) for text in entry["log"]["tracks"])
    assert second[20:] == [None] * 71 and None not in second[:20]
    np.testing.assert_allclose(np.array(first) / 100, pose_tracks(scene)[0].numpy(), atol=0.0051)


def test_lights_are_packed_step_by_step() -> None:
    scene: Scene = red_light()
    scene.lights.state[0, 5] = -1
    (light,) = pack_players([PlayerScene(scene, {})])["scenes"][0]["lights"]
    assert light["at"] == [2000, -250]
    assert [step for step, group in enumerate(light["groups"]) if group != "stop"] == [5]


# --- rollouts -------------------------------------------------------------------------------------------------------
def test_rollouts_unpack_to_their_poses_within_half_a_centimetre(packed: dict[str, Any]) -> None:
    scene, given = made_players()[0].scene, packed["scenes"][0]["rollouts"]["reference"]
    made = [slower(scene, 10), with_mishaps(scene), log_trajectory(scene, 80), slower(scene, 30)]
    assert [kept["number"] for kept in given["kept"]] == [0, 1, 2, 3] and given["sampled"] == 4
    for kept in given["kept"]:
        poses = np.array([unpack_track(text, 80) for text in kept["tracks"]]) / 100
        np.testing.assert_allclose(poses, made[kept["number"]][..., [0, 1, 3]].numpy(), atol=0.0051)


@pytest.mark.parametrize("shape", [(2, 80, 3), (1, 3, 80, 3), (1, 2, 79, 3), (0, 2, 80, 3)])
def test_rollouts_that_do_not_fit_are_refused_with_scene_and_method(shape: tuple[int, ...]) -> None:
    scene = straight_road(2)
    wrong = replace(judged(scene, [slower(scene, 5)], [-1.0]), poses=torch.zeros(shape))
    with pytest.raises(ValueError, match=r"straight_road_2_None, method 'm': .*A'=2"):
        pack_players([PlayerScene(scene, {"m": wrong})])


def test_ranks_say_who_is_nearest_and_who_is_likeliest_of_all_that_were_sampled(packed: dict[str, Any]) -> None:
    kept = packed["scenes"][0]["rollouts"]["reference"]["kept"]
    assert [each["likelier"] for each in kept] == [2, 0, 1, 3]
    assert [each["nats"] for each in kept] == [-2.0, -1.0, -1.5, -3.0]
    assert kept[2]["distance"] == 0 and kept[2]["nearer"] == 0
    assert sorted(kept, key=lambda each: each["nearer"]) == sorted(kept, key=lambda each: each["distance"])


@given(st.lists(st.tuples(st.floats(0, 9), st.floats(-9, 0)), min_size=1, max_size=70), st.integers(1, 8))
def test_kept_rollouts_hold_the_likeliest_the_nearest_and_the_farthest(
    made: list[tuple[float, float]], kept: int
) -> None:
    distance, nats = (torch.tensor(values, dtype=torch.float64) for values in zip(*made, strict=True))
    numbers = kept_rollouts(distance, nats, kept)
    assert len(numbers) <= kept + 1 and len(numbers) == len(set(numbers.tolist()))
    assert len(numbers) >= min(kept, len(made))
    assert nats[numbers].max() == nats.max() and distance[numbers].min() == distance.min()
    assert kept == 1 or distance[numbers].max() == distance.max()


def test_a_likelihood_that_is_no_number_is_told_with_its_scene() -> None:
    scene = straight_road(2)
    with pytest.raises(ValueError, match="straight_road_2_None: .*nan"):
        judged(scene, [slower(scene, 5)], [math.nan])


# --- mishaps --------------------------------------------------------------------------------------------------------
def by_hand(trajectory: Tensor, extent: Tensor) -> tuple[Tensor, Tensor]:
    """Of boxes that all look along x, on a road from y = -5 to y = 5: ``[A, T]`` each."""
    low, high = (trajectory[..., :2] + sign * extent[:, None, :2] / 2 for sign in (-1, 1))
    meet = ((low[:, None] < high[None]) & (low[None] < high[:, None])).all(-1)
    meet[range(len(meet)), range(len(meet))] = False
    return meet.any(1), (low[..., 1] < -5) | (high[..., 1] > 5)


def test_mishaps_are_those_of_a_computation_by_hand(packed: dict[str, Any]) -> None:
    scene = made_players()[0].scene
    collides, offroad = by_hand(with_mishaps(scene), scene.agents.extent)
    wanted = torch.zeros(2, 3, 80, dtype=torch.bool)
    wanted[0, :2, COLLISION], wanted[1, 2, OFFROAD] = True, True
    assert torch.equal(torch.stack((collides, offroad)), wanted)
    kept = packed["scenes"][0]["rollouts"]["reference"]["kept"][1]
    for name, flags in (("collides", collides), ("offroad", offroad)):
        assert torch.equal(unpack_flags(kept[name], 3, 80), flags), name


def test_a_rollout_like_the_log_has_no_mishaps(packed: dict[str, Any]) -> None:
    kept = packed["scenes"][0]["rollouts"]["reference"]["kept"][2]
    assert kept["collides"] == kept["offroad"] == {}


def test_the_realism_metric_counts_the_same_mishaps() -> None:
    scene = straight_road(3)
    scene.agents.predict[:] = True
    trajectories = torch.stack((with_mishaps(scene), log_trajectory(scene, 80)))
    values = realism(scene, trajectories, features=True).features.values
    collides, offroad = mishaps(scene, trajectories)
    assert torch.equal(values["collision_per_step"][1:], collides)
    assert torch.equal(values["offroad_per_step"][1:], offroad)


def test_mishaps_of_the_log_are_those_of_agents_that_are_there() -> None:
    scene = straight_road(2)
    scene.agents.position[1, 30:50, 0] = scene.agents.position[0, 30:50, 0]
    scene.agents.valid[1, 40:] = False
    collides, offroad = logged_mishaps(scene)
    assert collides.nonzero().tolist() == [[agent, step] for agent in (0, 1) for step in range(30, 40)]
    assert not offroad.any()


def test_a_scene_without_road_edges_is_named() -> None:
    poses = torch.zeros(1, 91, 3)
    scene = build_scene(poses, [(MapKind.LANE_SURFACE_STREET, torch.tensor([[0.0, 0], [9, 0]]))], scene_id="bare")
    with pytest.raises(ValueError, match="scene bare has no road edge"):
        pack_players([PlayerScene(scene, {})])


# --- the coupling ---------------------------------------------------------------------------------------------------
METHODS = [("exact", {}), ("windowed", {"window": 1.0}), ("sinkhorn", {}), ("time_aligned", {})]


@pytest.mark.parametrize(("method", "solver"), METHODS)
def test_couplings_are_those_of_the_ranking(method: str, solver: dict[str, float]) -> None:
    scene = two_cars_head_on()
    scene.road = straight_road(2).road
    distance = PreferenceDistance(stride=5, method=method, solver=solver)
    trajectories = torch.stack((slower(scene, 12.0), slower(scene, -6.0)))
    found = couple(distance, scene, trajectories, torch.arange(2))
    for rollout in range(2):
        for agent in range(2):
            one = couple_agent(distance, scene, trajectories[rollout], agent)
            assert torch.equal(found.partner[rollout, agent], one.coupling.argmax(-1))
            torch.testing.assert_close(found.share[rollout, agent], one.parts / one.distance)
            torch.testing.assert_close(found.rollouts[rollout, agent], one.rollout)
            torch.testing.assert_close(found.log[agent], one.log)


def test_a_distance_at_ten_hertz_is_shown_at_two() -> None:
    scene = straight_road(2)
    trajectories = slower(scene, 20.0)[None]
    fine, coarse, coarsest = (
        couple(PreferenceDistance(stride=stride), scene, trajectories, torch.arange(2)) for stride in (1, 5, 10)
    )
    assert fine.stride == coarse.stride == 5 and torch.equal(fine.partner, coarse.partner)
    assert coarsest.stride == 10 and coarsest.partner.shape[-1] == 8


def test_the_packed_pairs_are_an_optimal_assignment_and_their_cost_is_the_distance(packed: dict[str, Any]) -> None:
    given = packed["scenes"][0]["rollouts"]["reference"]
    assert given["valid"] == [[0, 16]] * 3 and given["stride"] == 5
    weights = np.array([feature["weight"] for feature in given["features"]])

    def features(text: str) -> np.ndarray:
        numbers = [*unpack_numbers(text), *[0] * 80][:80]
        return np.cumsum(np.array(numbers).reshape(16, 5), axis=0) / 100

    for kept in given["kept"]:
        for agent in range(3):
            rollout, log = features(kept["features"][agent]), features(given["log"][agent])
            cost = np.sqrt((weights * (rollout[:, None] - log) ** 2).sum(-1))
            partner = [*unpack_numbers(kept["coupling"][agent]), *[0] * 16][:16]
            assert sorted(partner) == list(range(16))
            assert cost[range(16), partner].mean() == pytest.approx(kept["paid"][agent], abs=0.02)
            assert cost[range(16), partner].mean() == pytest.approx(cost[linear_sum_assignment(cost)].mean(), abs=0.02)


def test_steps_that_the_log_lacks_are_coupled_with_nothing() -> None:
    scene = straight_road(2)
    scene.agents.valid[1, 50:60] = False
    packed = pack_players([PlayerScene(scene, {"m": judged(scene, [slower(scene, 10)], [-1.0])})])
    given = packed["scenes"][0]["rollouts"]["m"]
    assert given["valid"][0] == [0, 16] and given["valid"][1] == [0, 7, 10, 6]
    partner = unpack_numbers(given["kept"][0]["coupling"][1])
    assert len(partner) <= 13 and not {7, 8, 9} & set(partner)


if __name__ == "__main__":
    pytest.main([__file__])
