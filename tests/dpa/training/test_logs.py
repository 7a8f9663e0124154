"""Logs to learn from: what is kept is what would be made anew, and draws depend on the generator alone."""

from __future__ import annotations

import copy
from dataclasses import fields

import pytest
import torch

from dpa.models import make_context
from dpa.models.motionlm import featurize
from dpa.tokens import VerletTokenizer
from dpa.training.batches import Item
from dpa.training.logs import LogItems, choose_agents, log_item, log_items
from envs.episode import Episode, EpisodeOptions
from envs.loader import SceneLoader
from envs.scene import Scene
from envs.seeding import make_generator
from envs.sources.synthetic import build_scene, straight_road

TOKENIZER = VerletTokenizer()
SCENES = [straight_road(count, seed=count) for count in (2, 9, 5)]


class Counted(list):
    """Scenes that count how often they are read."""

    reads = 0

    def __getitem__(self, index: int) -> Scene:
        self.reads += 1
        return super().__getitem__(index)


def logs(scenes: list[Scene] = SCENES, **options: object) -> LogItems:
    return LogItems(scenes, TOKENIZER, featurize, EpisodeOptions(), **{"max_agents": 4, **options})


def shown(made: LogItems, draws: range | list[int]) -> list[list[Item]]:
    """The items of all scenes, once for each draw."""
    return [
        made.collate([made.prepare(index, make_generator(draw, index)) for index in range(len(made))]) for draw in draws
    ]


@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_of_no_scenes_there_are_no_items(noise: float) -> None:
    """More ranks than tuning scenes leave some ranks without any."""
    assert logs(noise=noise).collate([]) == []


def equal(one: Item, other: Item) -> bool:
    tensors = all(torch.equal(*pair) for pair in zip(one[1:], other[1:], strict=True))
    return tensors and bool((one.context == other.context).all())


def test_the_log_is_one_rollout_of_its_scene() -> None:
    context, tokenizer = make_context(straight_road(2, seed=3), featurize), VerletTokenizer()
    result = log_item(context, tokenizer)
    assert result.tokens.shape == (1, 2, 16) and result.token_valid.all()
    poses = tokenizer.decode_tracks(result.tokens[0], context.episode.recent, context.episode.kind)
    assert (poses - context.episode.logged)[:, 4::5, :2].norm(dim=-1).max() < 0.2


def test_agents_that_are_not_controlled_or_leave_the_log_have_no_valid_tokens() -> None:
    valid = torch.ones(3, 91, dtype=torch.bool)
    valid[1, 31:] = False
    scene = straight_road(3)
    scene.agents = build_scene(scene.agents.poses, [(0, torch.zeros(2, 2))], valid=valid).agents
    result = log_item(make_context(scene, featurize, EpisodeOptions(max_controlled=2)), VerletTokenizer())
    assert result.token_valid.sum(-1).tolist() == [16, 4, 0]


def test_logs_side_by_side_are_the_logs_one_by_one() -> None:
    contexts = [make_context(scene, featurize) for scene in SCENES]
    together = log_items(contexts, TOKENIZER)
    assert all(equal(one, log_item(context, TOKENIZER)) for one, context in zip(together, contexts, strict=True))


# --- a crowd --------------------------------------------------------------------------------------------------------
def test_a_crowd_is_cropped_to_the_agents_around_one_of_them() -> None:
    crowd = make_context(straight_road(9), featurize)
    x = crowd.episode.recent[choose_agents(crowd, 4, make_generator(0, "crop", 5)), -1, 0]
    assert x.shape == (4,) and ((x[:-1] - x[1:]) == 15).all(), "in file, 15 m apart: four neighbours, in order"


def test_cropping_depends_on_the_generator_alone() -> None:
    crowd = make_context(straight_road(9), featurize)
    draws = [choose_agents(crowd, 4, make_generator(0, "crop", step)) for step in (1, 1, 2, 3, 4)]
    assert torch.equal(draws[0], draws[1])
    assert any(not torch.equal(draws[0], other) for other in draws[2:])


def test_few_agents_are_left_alone() -> None:
    generator, untouched = make_generator(0), make_generator(0)
    assert choose_agents(make_context(straight_road(3), featurize), 3, generator) is None
    assert torch.equal(generator.get_state(), untouched.get_state()), "nothing is drawn"


def test_a_cropped_item_is_the_log_of_the_agents_that_are_left() -> None:
    (item,) = shown(logs([SCENES[1]]), [3])[0]
    whole = log_item(make_context(SCENES[1], featurize), TOKENIZER)
    rows = [int((whole.context.episode.recent == row).all(-1).all(-1).nonzero()) for row in item.context.episode.recent]
    assert torch.equal(item.tokens, whole.tokens[:, rows]) and torch.equal(item.token_valid, whole.token_valid[rows])
    for name in (field.name for field in fields(Episode)):
        assert torch.equal(getattr(item.context.episode, name), getattr(whole.context.episode, name)[rows])


# --- what is kept ---------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    "options",
    [
        {"mirror": 0.5},
        {"mirror": 0.5, "noise": 0.3},
    ],
    ids=["mirror", "noise"],
)
def test_what_is_kept_is_what_would_be_made_anew(options: dict[str, object]) -> None:
    kept, anew = shown(logs(keep_gib=1.0, **options), range(6)), shown(logs(**options), range(6))
    pairs = [pair for both in zip(kept, anew, strict=True) for pair in zip(*both, strict=True)]
    assert len(pairs) == 18 and all(equal(*pair) for pair in pairs)


def test_scenes_are_read_once_where_they_are_kept_and_each_time_where_not() -> None:
    scenes = Counted(SCENES)
    shown(logs(scenes, keep_gib=1.0), range(5))
    assert scenes.reads == 3
    shown(logs(scenes), range(5))
    assert scenes.reads == 3 + 15


def test_memory_that_is_full_keeps_what_it_has() -> None:
    scenes, some = Counted(SCENES), 1e-5  # more than nothing and less than the second scene needs
    made = logs(scenes, keep_gib=some)
    shown(made, range(2))
    assert scenes.reads == 3 + 2 and list(made._kept) == [(0, False)]


def test_what_is_kept_holds_no_more_than_itself() -> None:
    made = logs(keep_gib=1.0)
    shown(made, range(1))
    for item in made._kept.values():
        assert all(value.untyped_storage().nbytes() == value.nbytes for value in item[1:])


def test_a_worker_gets_the_scenes_and_not_what_is_kept() -> None:
    made = logs(keep_gib=1.0)
    before = shown(made, range(1))[0]
    there = copy.deepcopy(made)  # by the state that travels to a worker
    assert not there._kept and made._kept
    assert all(equal(*pair) for pair in zip(shown(there, range(1))[0], before, strict=True))


# --- through a loader -----------------------------------------------------------------------------------------------
def test_a_log_is_drawn_as_the_generator_says() -> None:
    made = logs([SCENES[1]], mirror=0.5, noise=0.5)
    items = [one for (one,) in shown(made, [0, 0, 1, 2, 3, 4])]
    assert all(one.tokens.shape == (1, 4, 16) for one in items)
    assert torch.equal(items[0].tokens, items[1].tokens) and torch.equal(items[0].labels, items[1].labels)
    assert not torch.equal(items[0].tokens, items[0].labels), "noise changes tokens and labels lead back"
    sides = {float(one.context.episode.recent[0, -1, 1].sign()) for one in items}
    assert sides == {-1.0, 1.0}, "some are mirrored"


def test_noise_of_a_scene_does_not_depend_on_who_is_beside_it() -> None:
    made = logs(noise=0.5)
    together = shown(made, range(1))[0]
    alone = [made.collate([made.prepare(index, make_generator(0, index))])[0] for index in range(3)]
    assert all(equal(*pair) for pair in zip(together, alone, strict=True))


def test_a_loader_shows_every_log_of_an_epoch_once() -> None:
    made = logs(keep_gib=1.0)
    loader = SceneLoader(made, batch_size=2, prepare=made.prepare, collate=made.collate, drop_last=False)
    agents = [item.tokens.shape[1] for batch in loader for item in batch]
    assert sorted(agents[:3]) == [2, 4, 4], "the last batch is filled up"


def test_scenes_in_which_there_is_nothing_to_learn_are_left_out() -> None:
    gone = straight_road(3)
    gone.agents.valid[:, 11:] = False
    assert [item.tokens.shape[1] for item in shown(logs([SCENES[0], gone]), range(1))[0]] == [2]


if __name__ == "__main__":
    pytest.main([__file__])
