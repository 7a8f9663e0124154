"""Signals of a decision: against the realism metric, against cases worked out by hand, and nothing for nothing."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import check_env_specs

from dpa.realism import RealismConfig, compare, measure
from dpa.rollout import lifted, simulated_poses
from dpa.tokens import TokenAction, VerletTokenizer
from envs import keys, signals
from envs.episode import EpisodeOptions
from envs.geometry.paths import distance_along
from envs.scene import CURRENT_STEP, AgentKind, Lights, LightState, MapKind, Scene
from envs.signals import SIGNALS, signal
from envs.sources.synthetic import build_scene, red_light, straight_road, two_cars_head_on
from envs.traffic import TrafficEnv

ALL = ("collision", "offroad", "progress", "red_light")
CLEAN = RealismConfig.load("2025").replace(quirks=frozenset())


def crossing(num_agents: int = 5, seed: int = 0) -> Scene:
    """Two streets that climb and cross, lights that change, and agents that come from all sides."""
    generator = torch.Generator().manual_seed(seed)
    along = torch.linspace(-80, 80, 33)
    zero = torch.zeros_like(along)

    def line(kind: MapKind, side: float, turned: bool, backward: bool = False) -> tuple[MapKind, Tensor]:
        xy = (zero + side, along) if turned else (along, zero + side)
        points = torch.stack((*xy, 0.08 * (xy[0] + xy[1])), -1)
        return kind, points.flip(0) if backward else points

    lines = [line(MapKind.LANE_SURFACE_STREET, -2.0, turned) for turned in (False, True)]
    lines += [line(MapKind.EDGE_BOUNDARY, -6.0, turned, backward=turned) for turned in (False, True)]
    lines += [line(MapKind.EDGE_MEDIAN, 6.0, turned, backward=not turned) for turned in (False, True)]
    time = (torch.arange(91) - CURRENT_STEP) * 0.1
    speed = 4 + 6 * torch.rand(num_agents, 1, generator=generator)
    at = 25 * torch.randn(num_agents, 1, generator=generator) + speed * time
    turned = (torch.arange(num_agents) % 2 == 1)[:, None]
    x, y = torch.where(turned, -2.0, at), torch.where(turned, at, -2.0)
    heading = torch.where(turned, torch.pi / 2, 0.0).expand_as(at)
    state = torch.randint(1, 7, (2, 10), generator=generator).repeat_interleave(10, 1)[:, :91]
    stop = torch.tensor([[-8.0, -2.0, -0.8], [-2.0, -8.0, -0.8]])[:, None].expand(2, 91, 3).clone()
    state[1, 40:50] = LightState.ABSENT
    stop[1, 40:50] = 0
    lights = Lights(lane_id=torch.tensor([1, 2]), state=state, stop_point=stop, batch_size=[])
    kind = torch.where(torch.arange(num_agents) == 2, int(AgentKind.CYCLIST), int(AgentKind.VEHICLE))
    scene = build_scene(torch.stack((x, y, heading), -1), lines, lights=lights, kind=kind, scene_id=f"crossing_{seed}")
    scene.agents.position[..., 2] = 0.08 * scene.agents.position[..., :2].sum(-1) + 0.75
    return scene


class Gentle(TensorDictModuleBase):
    """Random tokens of small changes, so that agents stay near the road for a while."""

    in_keys, out_keys = [keys.VALID], [keys.TOKEN]

    def __init__(self, seed: int) -> None:
        super().__init__()
        self.generator = torch.Generator().manual_seed(seed)

    def forward(self, state: TensorDictBase) -> TensorDictBase:
        change = torch.randint(5, 8, (2, *state[keys.VALID].shape), generator=self.generator)
        return state.set(keys.TOKEN, 13 * change[0] + change[1])


def roll(env: TrafficEnv, seed: int = 0) -> TensorDictBase:
    """An episode of random tokens ``[B, T]``."""
    tokens = TokenAction(VerletTokenizer(steps=env.episode.decision_steps))
    return TransformedEnv(env, tokens).rollout(env.episode.horizon, Gentle(seed))


# --- against the realism metric -------------------------------------------------------------------------------------
ORACLES = {
    "collision": "collision_per_step",
    "offroad": "offroad_per_step",
    "red_light": "traffic_light_violation_per_step",
}


@pytest.mark.parametrize("decision_steps", [5, 10])
def test_events_are_those_of_the_realism_metric_on_the_same_trajectories(decision_steps: int) -> None:
    scenes, rollouts = [crossing(5, seed=1), crossing(3, seed=2), straight_road(2)], 3
    horizon = 80 // decision_steps
    env = TrafficEnv(
        scenes,
        EpisodeOptions(decision_steps=decision_steps, horizon=horizon),
        num_scenes=3,
        num_rollouts=rollouts,
        signals=ALL,
    )
    rollout = roll(env)
    poses = simulated_poses(rollout, rollouts)
    seen = dict.fromkeys(ORACLES, 0)
    for index, scene in enumerate(scenes):
        agents = len(scene.agents.kind)
        (features,) = measure([compare(scene, lifted(scene, poses[index]), CLEAN)], CLEAN)
        for name, feature in ORACLES.items():
            expected = features.values[feature][1:].unflatten(-1, (horizon, decision_steps)).any(-1)
            rows = slice(index * rollouts, (index + 1) * rollouts)
            got = rollout["next", keys.AGENTS, name][rows, :, :agents].transpose(1, 2)
            assert torch.equal(got, expected), name
            seen[name] += int(got.sum())
            assert name == "red_light" or index == 2 or not got.all()
    assert all(seen.values()), seen


def test_rows_at_different_decisions_see_their_own_lights() -> None:
    """A row that is reset alone is as it would be in an episode of its own."""
    env = TrafficEnv([crossing(5, seed=1)], num_rollouts=2, signals=ALL)
    state = env.reset()

    def ahead(state: TensorDictBase) -> TensorDictBase:
        poses = torch.zeros(2, 5, 5, 3)
        poses[..., 0] = torch.arange(1, 6) * 0.9
        return state.set(keys.ACTION, poses)

    steps: list[TensorDictBase] = []
    for step in range(16):
        if step == 6:
            state = env.reset(state.set("_reset", torch.tensor([[False], [True]]))).exclude("_reset")
            assert not state[keys.OFFROAD][1].any() and not state[keys.PROGRESS][1].any()
        steps.append(env.step(ahead(state))["next"])
        state = steps[-1].exclude("reward", keys.REWARD)
    for name in ALL:
        values = torch.stack([step[keys.AGENTS, name] for step in steps])
        torch.testing.assert_close(values[6:, 1], values[:10, 0])
        assert values[:10, 0].any() or name == "collision"


# --- by hand --------------------------------------------------------------------------------------------------------
def replay(scene: Scene, signals: Sequence[str], **episode: int) -> TensorDictBase:
    """An episode ``[T]`` in which everybody follows the log."""
    options = EpisodeOptions(control=lambda s: torch.zeros_like(s.agents.sdc), **episode)
    env = TrafficEnv([scene], options, signals=signals)
    return env.rollout(env.episode.horizon)[0]["next"]


def test_two_cars_collide_while_they_overlap_and_not_before_or_after() -> None:
    # 60 m apart at 16 m/s together, 4.6 m long: they overlap from 3.46 s to 4.04 s, in the poses 35 to 40
    events = replay(two_cars_head_on(8.0), signals=("collision",))[keys.COLLISION]
    assert events[:, 0].nonzero()[:, 0].tolist() == [6, 7]
    assert torch.equal(events[:, 0], events[:, 1])


def test_an_agent_that_has_left_or_not_arrived_collides_with_nobody() -> None:
    scene = two_cars_head_on(8.0)
    scene.agents.valid[1, CURRENT_STEP + 37 :] = False
    events = replay(scene, signals=("collision",))[keys.COLLISION]
    assert events.nonzero().tolist() == [[6, 0], [6, 1], [7, 0], [7, 1]], "in the poses 35 and 36 of both decisions"
    scene = two_cars_head_on(8.0)
    scene.agents.valid[1, : CURRENT_STEP + 38] = False
    events = replay(scene, signals=("collision",), arrivals=True)[keys.COLLISION]
    assert events.nonzero().tolist() == [[7, 0], [7, 1]]


def test_progress_counts_metres_along_the_own_log() -> None:
    scene = straight_road(3, speed=10.0)
    torch.testing.assert_close(replay(scene, signals=("progress",))[keys.PROGRESS], torch.full((16, 3), 5.0))
    env = TrafficEnv([scene], signals=("progress",))
    poses = torch.zeros(1, 3, 5, 3)
    poses[0, 0, :, 0] = torch.arange(1, 6) * 0.4  # 2 m ahead
    poses[0, 1, :, 0] = -torch.arange(1, 6) * 0.2  # 1 m back
    poses[0, 2, :, 1] = torch.arange(1, 6) * 0.5  # aside
    after = env.step(env.reset().set(keys.ACTION, poses))["next"]
    torch.testing.assert_close(after[keys.PROGRESS], torch.tensor([[2.0, -1.0, 0.0]]), atol=1e-4, rtol=0)


def test_progress_ends_with_the_log() -> None:
    env = TrafficEnv([straight_road(1, speed=1.0)], signals=("progress",))
    poses = torch.zeros(1, 1, 5, 3)
    poses[..., 0] = torch.arange(1, 6) * 4.0  # the log goes on for 8 m
    after = env.step(env.reset().set(keys.ACTION, poses))["next"]
    torch.testing.assert_close(after[keys.PROGRESS], torch.tensor([[8.0]]), atol=1e-4, rtol=0)


def test_passing_at_red_counts_in_the_decision_in_which_it_happens() -> None:
    # 8.5 m/s reach the stop point at 20 m after 2.35 s, in the fifth decision
    assert replay(red_light(8.5), signals=("red_light",))[keys.RED_LIGHT][:, 0].nonzero()[:, 0].tolist() == [4]
    green = red_light(8.5)
    green.lights.state[:, CURRENT_STEP + 24] = LightState.GO
    assert not replay(green, signals=("red_light",))[keys.RED_LIGHT].any()


def test_an_arrival_beyond_the_light_has_not_passed_it() -> None:
    scene = straight_road(2, speed=8.5, gap=-15.0)
    scene.lights = red_light().lights
    scene.agents.valid[1, : CURRENT_STEP + 8] = False  # at 15 m it would pass after 0.6 s
    events = replay(scene, signals=("red_light",), arrivals=True)[keys.RED_LIGHT]
    assert events.nonzero().tolist() == [[4, 0]]


def test_heights_tell_a_bridge_from_the_road_below() -> None:
    """The road below the bridge is wide, that on the bridge narrow: only the one on the bridge is off the road."""
    poses = torch.zeros(2, 91, 3)
    poses[..., 0] = (torch.arange(91) - CURRENT_STEP) * 0.5
    poses[1, :, 1] = 4.0
    along = torch.linspace(-100, 100, 41)

    def edge(y: float, z: float, backward: bool) -> tuple[MapKind, Tensor]:
        points = torch.stack((along, torch.full_like(along, y), torch.full_like(along, z)), -1)
        return MapKind.EDGE_BOUNDARY, points.flip(0) if backward else points

    lines = [edge(-9, 0, False), edge(9, 0, True), edge(-3, 8, False), edge(3, 8, True)]
    scene = build_scene(poses, lines)
    scene.agents.position[..., 2] = torch.tensor([0.75, 8.75])[:, None]
    for height, expected in ((8.75, [False, True]), (0.75, [False, False])):
        scene.agents.position[1, :, 2] = height
        for control in ("all", lambda s: torch.zeros_like(s.agents.sdc)):
            env = TrafficEnv([scene], EpisodeOptions(control=control), signals=("offroad",))
            action = torch.zeros(1, 2, 5, 3)
            action[..., 0] = torch.arange(1, 6) * 0.5
            after = env.step(env.reset().set(keys.ACTION, action))["next"]
            assert after[keys.OFFROAD][0].tolist() == expected


def test_agents_that_are_not_there_signal_nothing() -> None:
    scene = crossing(4)
    scene.agents.valid[3, 30:] = False
    rollout = roll(TrafficEnv([scene], EpisodeOptions(control="sdc"), signals=ALL, num_agents=6))["next"]
    for name in ALL:
        assert not rollout[keys.AGENTS, name][:, 4:, 3:].any()


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 1000), st.integers(2, 8))
def test_distances_along_a_path_are_those_of_a_fine_search(seed: int, points: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    path = torch.randn(points, 2, generator=generator).cumsum(0)
    valid = torch.rand(points, generator=generator) < 0.8
    valid[int(torch.randint(points, (), generator=generator))] = True
    place = torch.randn(2, generator=generator)
    kept = path[valid]
    share = torch.linspace(0, 1, 2001)[:, None]
    dense = torch.cat([torch.lerp(a, b, share) for a, b in itertools.pairwise(kept)] or [kept])
    nearest = (dense - place).norm(dim=-1).amin()
    at = distance_along(path, valid, place)
    moved = torch.cat((torch.zeros(1), (dense[1:] - dense[:-1]).norm(dim=-1).cumsum(0)))
    found = dense[(moved - at).abs().argmin()]
    assert (found - place).norm() <= nearest + 5e-3


# --- on request -----------------------------------------------------------------------------------------------------
GEOMETRY = ("nearest_box_distance", "RoadEdges", "Ground", "climb", "Lanes", "crosses_red", "distance_along")
NEEDS = {
    "collision": {"nearest_box_distance"},
    "offroad": {"RoadEdges", "Ground", "climb"},
    "progress": {"distance_along"},
    "red_light": {"Lanes", "crosses_red"},
}


@pytest.mark.parametrize("asked", [(), *((name,) for name in ALL)], ids=lambda asked: asked[0] if asked else "none")
def test_what_is_not_asked_for_costs_nothing(monkeypatch: pytest.MonkeyPatch, asked: tuple[str, ...]) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("computed")

    refuse.from_polylines = refuse
    needed = set().union(*(NEEDS[name] for name in asked))
    for name in set(GEOMETRY) - needed:
        monkeypatch.setattr(signals, name, refuse)
    env = TrafficEnv([crossing(3)], EpisodeOptions(horizon=2), signals=asked)
    rollout = env.rollout(2)
    for name in ALL:
        assert ((keys.AGENTS, name) in rollout["next"].keys(True)) == (name in asked)
        assert ((keys.AGENTS, name) in env.observation_spec.keys(True)) == (name in asked)


def test_each_needs_what_it_is_said_to_need(monkeypatch: pytest.MonkeyPatch) -> None:
    """So that the test above can fail."""
    called = set()
    for name in ("nearest_box_distance", "climb", "crosses_red", "distance_along"):
        inner = getattr(signals, name)

        def spy(*arguments: object, _inner: Callable = inner, _name: str = name) -> object:
            called.add(_name)
            return _inner(*arguments)

        monkeypatch.setattr(signals, name, spy)
    TrafficEnv([crossing(3)], EpisodeOptions(horizon=1), signals=ALL).rollout(1)
    assert called == {"nearest_box_distance", "climb", "crosses_red", "distance_along"}


@settings(max_examples=12, deadline=None)
@given(st.integers(1, 10), st.integers(1, 8), st.sets(st.sampled_from(ALL)), st.booleans())
def test_any_length_of_a_decision_keeps_the_specs(steps: int, horizon: int, asked: set[str], arrivals: bool) -> None:
    scene = crossing(4, seed=3)
    scene.agents.valid[1, :14] = False
    episode = EpisodeOptions(decision_steps=steps, horizon=horizon, arrivals=arrivals)
    check_env_specs(TrafficEnv([scene, crossing(2)], episode, num_scenes=2, signals=sorted(asked)))


def test_a_step_is_a_decision_whatever_its_length() -> None:
    """Events of two decisions of 0.5 s are those of one of 1 s, progress adds up."""
    short, long = (replay(crossing(5), signals=ALL, decision_steps=n, horizon=80 // n) for n in (5, 10))
    for name in ("collision", "offroad", "red_light"):
        assert torch.equal(short[keys.AGENTS, name].unflatten(0, (-1, 2)).any(1), long[keys.AGENTS, name])
    both = short[keys.PROGRESS].unflatten(0, (-1, 2)).sum(1)
    torch.testing.assert_close(both, long[keys.PROGRESS], atol=1e-3, rtol=0)


def test_a_signal_of_ones_own() -> None:
    @signal("turned", dtype=torch.float32)
    def turned(decision: signals.Decision) -> Tensor:
        return (decision.poses[..., -1, 2] - decision.poses[..., 0, 2]).abs()

    try:
        env = TrafficEnv([straight_road(2)], signals=("turned",))
        check_env_specs(env)
        action = torch.zeros(1, 2, 5, 3)
        action[0, 1, -1, 2] = 0.25
        after = env.step(env.reset().set(keys.ACTION, action))["next"]
        torch.testing.assert_close(after[keys.AGENTS, "turned"], torch.tensor([[0.0, 0.25]]))
        with pytest.raises(ValueError, match="the name 'turned' of a signal is taken"):
            signal("turned", dtype=torch.float32)
    finally:
        del SIGNALS["turned"]


@pytest.mark.parametrize("names", [("speed",), ("collision", "collision")])
def test_signals_that_are_none_are_refused(names: tuple[str, ...]) -> None:
    with pytest.raises(
        ValueError, match=r"different names of \['collision', 'offroad', 'progress', 'red_light'\], got"
    ):
        TrafficEnv([straight_road()], signals=names)


def test_a_scene_without_a_road_edge_is_named() -> None:
    scene = build_scene(torch.zeros(1, 91, 3), [(MapKind.LANE_SURFACE_STREET, torch.zeros(2, 2))], scene_id="bare")
    with pytest.raises(ValueError, match="scene bare: no road edge"):
        TrafficEnv([scene], signals=("offroad",)).rollout(1)


if __name__ == "__main__":
    pytest.main([__file__])
