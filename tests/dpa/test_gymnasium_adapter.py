"""The Gymnasium environment: its contract, what an agent sees, and that other libraries can train on it."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env

import dpa.gymnasium_adapter  # noqa: F401
from dpa.gymnasium_adapter.env import WEIGHTS, TrafficGym
from dpa.gymnasium_adapter.observation import Observer, Sight
from dpa.tokens import VerletTokenizer
from envs import keys
from envs.scene import CURRENT_STEP, AgentKind, LightState, Scene
from envs.sources.synthetic import red_light, straight_road, two_cars_head_on
from envs.traffic import TrafficEnv

SAME_SPEED = 84
"""The Verlet token that goes on nearly as before."""
SCENES = [straight_road(3, seed=1), red_light(), two_cars_head_on()]


def make(scenes: Any = SCENES, **options: Any) -> gymnasium.Env:
    return gymnasium.make("dpa/Traffic-v0", scenes=scenes, **options)


@pytest.mark.parametrize("control", ["sdc", "all"])
@pytest.mark.parametrize("steps", [5, 10])
def test_the_environment_keeps_the_contract_of_gymnasium(control: str, steps: int) -> None:
    env = make(control=control, tokenizer=VerletTokenizer(steps=steps), horizon=4, render_mode="rgb_array")
    check_env(env.unwrapped)


def test_the_environment_is_registered_when_its_module_is_imported_and_that_is_cheap() -> None:
    code = (
        "import sys, gymnasium\n"
        "assert 'dpa/Traffic-v0' not in gymnasium.registry\n"
        "import dpa.gymnasium_adapter\n"
        "assert 'dpa/Traffic-v0' in gymnasium.registry and 'torch' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", code], cwd=Path(__file__).resolve().parents[2], check=True, timeout=120)


def test_the_environment_is_found_by_the_name_of_its_module() -> None:
    env = gymnasium.make("dpa.gymnasium_adapter:dpa/Traffic-v0", scenes=SCENES)
    assert isinstance(env.unwrapped, TrafficGym)


def play(env: gymnasium.Env, num: int, seed: int) -> list[tuple]:
    """Steps of actions that are drawn with the seed, episodes that end begin anew."""
    generator = np.random.default_rng(0)
    seen = [env.reset(seed=seed)]
    for _ in range(num):
        action = generator.integers(0, 169, env.action_space.shape)
        seen.append(env.step(action if env.action_space.shape else int(action)))
        if seen[-1][2] or seen[-1][3]:
            seen.append(env.reset())
    return seen


def same(first: Any, second: Any) -> bool:
    if isinstance(first, dict):
        return first.keys() == second.keys() and all(same(first[key], second[key]) for key in first)
    if isinstance(first, tuple | list):
        return len(first) == len(second) and all(map(same, first, second))
    return bool(np.all(first == second))


@pytest.mark.parametrize("control", ["sdc", "all"])
def test_one_seed_gives_one_sequence_of_episodes(control: str) -> None:
    torch.manual_seed(5)
    before = torch.get_rng_state()
    env = make(control=control, horizon=3)
    first = play(env, 12, seed=3)
    assert same(first, play(env, 12, seed=3)) and same(first, play(make(control=control, horizon=3), 12, seed=3))
    assert not same(first, play(env, 12, seed=4))
    assert torch.equal(torch.get_rng_state(), before), "the global generator is left alone"


def test_every_scene_comes_up() -> None:
    env = make(horizon=1)
    assert {env.reset(seed=0)[1]["scene_id"]} | {env.reset()[1]["scene_id"] for _ in range(30)} == {
        scene.scene_id for scene in SCENES
    }


# --- episodes -------------------------------------------------------------------------------------------------------
def test_an_episode_of_driving_on() -> None:
    env = make([straight_road(2, speed=10.0)], terminate_on=())
    env.reset(seed=0)
    total = 0.0
    for step in range(16):
        _, reward, terminated, truncated, info = env.step(SAME_SPEED)
        total += reward
        assert not terminated and truncated == (step == 15)
    assert total == pytest.approx(16 * 5 * WEIGHTS["progress"], abs=1e-3)
    agents = straight_road(2, speed=10.0).agents
    tokens, kind = torch.full((1, 16), SAME_SPEED), agents.kind[:1]
    moved = VerletTokenizer().decode_tracks(tokens, agents.recent(5)[:1], kind)
    displacement = (moved - agents.poses[:1, CURRENT_STEP + 1 :])[..., :2].norm(dim=-1).mean()
    assert info == {
        "scene_id": "straight_road_2_None",
        "log_displacement": pytest.approx(float(displacement), abs=1e-4),
        "collision_rate": 0.0,
        "offroad_rate": 0.0,
        "red_light_rate": 0.0,
    }
    with pytest.raises(RuntimeError, match=r"the episode is over; call reset\(\)"):
        env.step(SAME_SPEED)


def test_a_collision_of_the_sdc_ends_the_episode_where_that_is_asked_for() -> None:
    for terminate_on, expected in ((("collision",), 7), ((), 16)):
        env = make([two_cars_head_on(8.0)], terminate_on=terminate_on, weights={"collision": -2.0})
        env.reset(seed=0)
        rewards, over = [], False
        while not over:
            _, reward, terminated, truncated, info = env.step(SAME_SPEED)
            rewards.append(reward)
            over = terminated or truncated
        assert len(rewards) == expected, "they overlap from 3.46 s to 4.04 s"
        assert terminated == bool(terminate_on)
        assert rewards[6] == -2.0 and sum(rewards) == (-2.0 if terminate_on else -4.0)
        assert info["collision_rate"] == 1.0 and "offroad_rate" not in info


def test_a_red_light_costs_what_its_weight_says() -> None:
    env = make([red_light(8.5)], weights={"red_light": -3.0})
    env.reset(seed=0)
    assert [env.step(SAME_SPEED)[1] for _ in range(6)] == [0, 0, 0, 0, -3.0, 0]


def test_the_reward_of_all_agents_is_their_mean() -> None:
    env = make([straight_road(3, speed=10.0)], control="all", weights={"progress": 1.0})
    env.reset(seed=0)
    tokenizer, slower = VerletTokenizer(), 84 - 13 * 3
    state = TrafficEnv([straight_road(3, speed=10.0)]).reset()
    motion = tokenizer.decode(torch.tensor([[84, slower, 84]]), state[keys.RECENT], state[keys.KIND])
    reward = env.step(np.array([84, slower, 84]))[1]
    assert motion[0, 1, -1, 0] < 4.9
    assert reward == pytest.approx(float(motion[0, :, -1, 0].mean()), abs=1e-3)


def test_entries_beyond_the_agents_of_a_scene_are_ignored() -> None:
    scenes = [straight_road(1), straight_road(3)]
    env = make(scenes, control="all", terminate_on=())
    assert env.action_space == gymnasium.spaces.MultiDiscrete([169] * 3)
    info = {}
    while info.get("scene_id") != scenes[0].scene_id:
        observation, info = env.reset(seed=None if info else 0)
    assert not any(value[1:].any() for value in observation.values())
    assert all(value[0].any() for name, value in observation.items() if name in ("ego", "path", "points"))
    one = env.step(np.array([SAME_SPEED, 0, 168]))
    alone = make(scenes[:1])
    alone.reset(seed=0)
    assert one[1] == alone.step(SAME_SPEED)[1] > 0
    assert make(scenes, control="all", max_controlled=2).action_space.shape == (2,)


def test_pictures_show_the_scene_as_it_moves() -> None:
    env = make(render_mode="rgb_array")
    env.reset(seed=0)
    first = env.render()
    env.step(SAME_SPEED)
    second = env.render()
    assert first.shape == second.shape == (480, 480, 3) and first.dtype == np.uint8
    assert (first != second).any()
    quiet = TrafficGym(SCENES)
    quiet.reset(seed=0)
    assert quiet.render() is None


def test_a_store_is_given_by_its_folder(tmp_path: Path, write_store: Callable[..., Path]) -> None:
    stores = [write_store(tmp_path / name, [scene]) for name, scene in (("a", straight_road(2)), ("b", red_light()))]
    for scenes, names in ((str(stores[0]), {"straight_road_2_None"}), (stores, {"straight_road_2_None", "red_light"})):
        env = make(scenes)
        env.reset(seed=0)
        assert {env.reset()[1]["scene_id"] for _ in range(20)} == names


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"control": "predict"}, "control must be 'sdc' or 'all', got 'predict'"),
        ({"render_mode": "human"}, "render_mode must be None or 'rgb_array', got 'human'"),
        ({"terminate_on": ("progress",)}, r"terminate_on must name events of .*, got \['progress'\]"),
        ({"weights": {"speed": 1.0}}, "weights must be of the signals .*, got speed"),
        ({"scenes": []}, "at least one scene"),
        ({"horizon": 17}, r"at most 80 steps of 0.1 s, got 17 \* 5"),
    ],
    ids=str,
)
def test_options_that_make_no_sense_are_refused(wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        TrafficGym(**{"scenes": SCENES, **wrong})


def test_an_action_outside_of_the_space_is_refused() -> None:
    env = TrafficGym(SCENES)
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"an action must be of Discrete\(169\), got 169"):
        env.step(169)


# --- what an agent sees ---------------------------------------------------------------------------------------------
def look(scene: Scene, agent: int = 0, sight: Sight | None = None) -> dict[str, np.ndarray]:
    state = TrafficEnv([scene]).reset()[0]
    seen = Observer(scene, sight or Sight(), horizon=16).observe(state, torch.tensor([agent]))
    return {name: value[0] for name, value in seen.items()}


def test_what_the_second_of_two_cars_sees() -> None:
    seen = look(straight_road(2, speed=12.0, gap=15.0), agent=1)
    vehicle = [float(kind == AgentKind.VEHICLE) for kind in AgentKind]
    np.testing.assert_allclose(seen["ego"], [0.4, 0, 0, 4.6 / 20, 1.9 / 20, *vehicle, 0], atol=1e-5)
    ahead = np.stack(((1 + np.arange(8)) * 5.0 / 60, np.zeros(8)), -1)
    np.testing.assert_allclose(seen["path"], ahead, atol=1e-5)
    np.testing.assert_allclose(seen["agents"][0], [15 / 60, 0, 1, 0, 0.4, 0, 4.6 / 20, 1.9 / 20, 1], atol=1e-5)
    assert not seen["agents"][1:].any() and not seen["lights"].any()
    near = seen["points"][0]
    assert np.hypot(*near[:2]) * 60 <= 5 and near[2] == pytest.approx(1) and near[4:].tolist() == [1, 0]
    assert {tuple(flags) for flags in seen["points"][:, 4:]} == {(1, 0), (0, 1)}


def test_lights_are_seen_as_they_are_now() -> None:
    scene = red_light()
    seen = look(scene)["lights"]
    np.testing.assert_allclose(seen[0], [20 / 60, 0, 1, 0, 0, 1], atol=1e-5)
    scene.lights.state[:, CURRENT_STEP] = LightState.CAUTION
    np.testing.assert_allclose(look(scene)["lights"][0], [20 / 60, 0, 0, 1, 0, 1], atol=1e-5)
    scene.lights.state[:, CURRENT_STEP] = LightState.ABSENT
    assert not look(scene)["lights"].any()


def test_what_is_out_of_reach_is_not_seen() -> None:
    near, far = (look(straight_road(2), sight=Sight(reach=reach))["agents"] for reach in (16.0, 14.0))
    assert near[0].any() and not far.any()


def test_observations_do_not_depend_on_where_the_scene_lies() -> None:
    here, there = red_light(), red_light()
    for points in (there.agents.position, there.road.points, there.lights.stop_point):
        points[..., 0] += 300.0
    for name, value in look(here).items():
        np.testing.assert_allclose(value, look(there)[name], atol=1e-5)


def test_a_sight_of_nothing_is_refused() -> None:
    with pytest.raises(ValueError, match="reach of the sight must be positive, got 0"):
        Sight(reach=0)


# --- with other libraries -------------------------------------------------------------------------------------------
@pytest.mark.filterwarnings("default")  # what other libraries warn of is theirs
@pytest.mark.parametrize("control", [pytest.param("sdc", marks=pytest.mark.slow), "all"])
def test_stable_baselines_trains(control: str) -> None:
    sb3 = pytest.importorskip("stable_baselines3")
    env = make(control=control, horizon=8)
    model = sb3.PPO("MultiInputPolicy", env, n_steps=64, batch_size=64, n_epochs=1, seed=0, device="cpu")
    before = {name: value.clone() for name, value in model.policy.state_dict().items()}
    model.learn(256)
    assert model.num_timesteps == 256
    assert any((value != before[name]).any() for name, value in model.policy.state_dict().items())
    observation, _ = env.reset(seed=1)
    assert env.action_space.contains(np.asarray(model.predict(observation)[0])[()])


def test_in_a_vector_of_environments() -> None:
    envs = gymnasium.make_vec("dpa/Traffic-v0", num_envs=2, vectorization_mode="sync", scenes=SCENES, horizon=3)
    observation, _ = envs.reset(seed=0)
    assert observation["agents"].shape == (2, 8, 9)
    for _ in range(8):
        observation, reward, *_ = envs.step(envs.action_space.sample())
    assert reward.shape == (2,)
    envs.close()


if __name__ == "__main__":
    pytest.main([__file__])
