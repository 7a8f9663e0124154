"""Looking at stored rollouts: the recipe as a user runs it, and what it refuses."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from PIL import Image

from dpa.preferences import PreferenceStore, PreferenceWriter
from dpa.ranking import PreferenceDistance
from envs import keys
from envs.store import SceneStore
from recipes.look import RankedScene, chosen_agent, chosen_rollout, distance_of, open_ranked

RANKING = ("collection.ranking.stride=5", "collection.ranking.agents=evaluated", "collection.ranking.aggregate=max")


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory, run: Callable, options: Callable) -> Path:
    """A folder with two policies, and ``preferences`` of the first one on the evaluation scenes."""
    folder = tmp_path_factory.mktemp("look")
    for name, seed in (("reference", 0), ("other", 1)):
        command = options("pretrain", f"output={folder / name}", f"seed={seed}", "pretraining.steps=2")
        assert run("pretrain", *command).status == 0
    policy = f"policy={folder / 'reference/policy.pt'}"
    outcome = run("collect", *options("collect", policy, "split=eval", f"output={folder / 'preferences'}", *RANKING))
    assert outcome.status == 0, outcome.err
    return folder


@pytest.fixture
def look(run: Callable, options: Callable, runs: Path, tmp_path: Path) -> Callable:
    """Runs the recipe; what is given comes on top."""

    def look_with(*more: str) -> tuple:
        files = (f"policy={runs / 'reference/policy.pt'}", f"preferences={runs / 'preferences'}")
        return run("look", *options("play", *files, "split=eval", "scene=0", f"output={tmp_path / 'a.png'}", *more))

    return look_with


@pytest.fixture(scope="module")
def group(runs: Path, stores: Path) -> RankedScene:
    scenes = SceneStore(stores / "eval")
    return open_ranked(runs / "reference/policy.pt", runs / "preferences", scenes, "1")


def assert_refused(outcome: tuple, *words: str) -> None:
    errors = [line for line in outcome.err.splitlines() if line.startswith("error:")]
    assert outcome.status == 2 and len(errors) == 1, outcome.err
    for word in words:
        assert word in errors[0]


# --- what it draws --------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    "more",
    [
        (),
        ("rollout=2", "agent=0"),
        ("figure=rollouts", "each=2"),
        *(pytest.param((option,), marks=pytest.mark.slow) for option in ("rollout=best", "agent=id:1")),
    ],
)
def test_a_figure_is_written(look: Callable, tmp_path: Path, more: tuple[str, ...]) -> None:
    outcome = look(*more)
    assert outcome.status == 0, outcome.err
    assert outcome.out.endswith(f"figure: {tmp_path / 'a.png'}\n")
    with Image.open(tmp_path / "a.png") as picture:
        assert picture.width > 800


def test_rollouts_of_any_ranking_are_drawn_and_couplings_of_one_that_couples_alone(
    run: Callable, options: Callable, runs: Path, tmp_path: Path
) -> None:
    files = (f"policy={runs / 'reference/policy.pt'}", f"preferences={runs / 'preferences'}", "split=eval")
    again = options("rerank", *files, "ranking=displacement", f"output={tmp_path / 'other'}")
    assert run("rerank", *again).status == 0
    given = options("play", files[0], f"preferences={tmp_path / 'other'}", *files[2:], f"output={tmp_path / 'a.png'}")
    assert run("look", *given, "scene=0", "figure=rollouts", "each=2").status == 0
    assert_refused(run("look", *given, "scene=0"), "was ranked by displacement", "say figure=rollouts")


def test_a_scene_may_be_given_by_its_id(look: Callable, stores: Path) -> None:
    assert look(f"scene={SceneStore(stores / 'eval').scene_ids[2]}").status == 0


def test_help_says_what_the_recipe_does_and_takes(run: Callable) -> None:
    outcome = run("look", "--help")
    assert outcome.status == 0
    assert outcome.out.startswith("python -m recipes.look") and "rollout: worst" in outcome.out


# --- what it reads --------------------------------------------------------------------------------------------------
def test_poses_from_tokens_have_the_distances_that_are_stored(group: RankedScene) -> None:
    ranking = group.distance(group.scene, group.trajectories, group.ranked[keys.TOKEN_VALID][:, 0])
    torch.testing.assert_close(ranking.agent_distance, group.ranked[keys.AGENT_DISTANCE], rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(ranking.distance, group.ranked[keys.DISTANCE], rtol=1e-5, atol=1e-6)


def test_agents_that_the_policy_does_not_move_follow_their_log(run: Callable, runs: Path, stores: Path) -> None:
    folder = runs / "one_replayed"
    store = PreferenceStore(runs / "preferences")
    groups = store[[1]]
    groups[keys.TOKEN_VALID][:, 1] = False
    shutil.rmtree(folder, ignore_errors=True)
    with PreferenceWriter(folder, store.provenance) as writer:
        writer.append(groups)
    scene, trajectories, *_ = open_ranked(
        runs / "reference/policy.pt", folder, SceneStore(stores / "eval"), str(int(store.scenes[1]))
    )
    log = scene.agents.position[scene.agents.present][:, 11:, :2]
    assert torch.equal(trajectories[:, 1, :, :2], log[1].expand(4, -1, -1))
    assert not torch.equal(trajectories[0, 0, :, :2], log[0])


def test_the_distance_of_a_store_is_the_one_that_ranked_it(runs: Path) -> None:
    store = PreferenceStore(runs / "preferences")
    assert distance_of(store).describe() == store.provenance.ranking
    assert distance_of(store) == replace(distance_of(store), stride=5, agents="evaluated", aggregate="max")


@pytest.mark.parametrize(
    "distance",
    [
        PreferenceDistance(),
        PreferenceDistance("progress", method="time_aligned", aggregate="mean_rank"),
        PreferenceDistance(("speed", "collision"), weights={"speed": 2.5}, clips={"speed": (1.0, 9.0)}, stride=3),
    ],
)
def test_a_distance_comes_back_from_its_description(runs: Path, distance: PreferenceDistance) -> None:
    store = PreferenceStore(runs / "preferences")
    store.provenance = replace(store.provenance, ranking=distance.describe())
    assert distance_of(store).describe() == distance.describe()


# --- what it chooses ------------------------------------------------------------------------------------------------
def test_among_equal_distances_the_worst_rollout_is_the_one_of_the_last_rank() -> None:
    assert chosen_rollout(torch.tensor([0, 1, 2]), "worst") == 2


def test_the_worst_agent_is_the_one_with_the_largest_distance_in_the_rollout(group: RankedScene) -> None:
    ranked = group.ranked[keys.AGENT_RANKED]
    for rollout in range(4):
        distance = torch.where(ranked, group.ranked[keys.AGENT_DISTANCE][rollout], -1)
        assert chosen_agent(group, rollout, "worst") == int(distance.argmax())


# --- what it refuses ------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("option", "words"),
    [
        ("scene=9999", ("9999",)),
        ("scene=nowhere", ("nowhere",)),
        ("rollout=4", ("rollout must be best, worst or 0 to 3, got '4'",)),
        ("rollout=middle", ("rollout must be best, worst or 0 to 3, got 'middle'",)),
        ("agent=17", ("agent=17 is none of the 1 ranked agents of scene", "0 (id:1)")),
        ("agent=id:0", ("agent=id:0 is none of", "0 (id:1)")),
        ("agent=first", ("agent must be worst, a row such as 0, or id:NUMBER, got 'first'",)),
        ("figure=pie", ("figure must be one of coupling, rollouts, got 'pie'",)),
        ("output=a.pdf", ("must end in .png",)),
        ("split=test", ("split must be one of train, tune, eval, got 'test'",)),
        ("preferences=nowhere", ("nowhere is no preference store",)),
        ("policy=none.pt", ("none.pt does not exist",)),
    ],
)
def test_options_that_make_no_sense_are_refused(look: Callable, option: str, words: tuple[str, ...]) -> None:
    assert_refused(look(option), *words)


def test_more_rollouts_than_are_stored_are_refused(look: Callable) -> None:
    assert_refused(look("figure=rollouts", "each=3"), "each must be 1 to 2, half of the 4 rollouts, got 3")


def test_preferences_of_other_scenes_are_refused(look: Callable) -> None:
    assert_refused(look("split=tune"), "preferences ranks rollouts of other scenes; give the scenes and the split")


def test_preferences_of_another_policy_are_refused(look: Callable, runs: Path) -> None:
    outcome = look(f"policy={runs / 'other/policy.pt'}")
    assert_refused(outcome, "preferences ranks rollouts of another policy than", "other/policy.pt")


def test_a_scene_that_the_store_lacks_is_told(look: Callable, runs: Path, tmp_path: Path) -> None:
    store = PreferenceStore(runs / "preferences")
    with PreferenceWriter(tmp_path / "some", store.provenance) as writer:
        writer.append(store[[1]])
    missing, there = (int(store.scenes[row]) for row in (0, 1))
    outcome = look(f"preferences={tmp_path / 'some'}", f"scene={missing}")
    assert_refused(outcome, f"some holds 1 of 3 scenes and not scene {missing}", f"for example scene={there}")


def test_distances_that_the_tokens_no_longer_give_are_refused(look: Callable, runs: Path, tmp_path: Path) -> None:
    store = PreferenceStore(runs / "preferences")
    groups = store[[0, 1, 2]]
    groups[keys.AGENT_DISTANCE] *= 2
    with PreferenceWriter(tmp_path / "old", store.provenance) as writer:
        writer.append(groups)
    outcome = look(f"preferences={tmp_path / 'old'}")
    assert_refused(outcome, "was ranked with distance", "code of features or tokens has changed; collect again")


def test_features_that_are_not_registered_are_named(runs: Path) -> None:
    store = PreferenceStore(runs / "preferences")
    ranking = store.provenance.ranking
    ranking = {**ranking, "weights": {**ranking["weights"], "turn_rate": 5.0}}
    store.provenance = replace(store.provenance, ranking=ranking)
    with pytest.raises(ValueError, match=r"preferences was ranked with the features \['turn_rate'\]"):
        distance_of(store)


if __name__ == "__main__":
    pytest.main([__file__])
