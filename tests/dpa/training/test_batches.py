"""Items and batches: functions of a seed and a step, and padding that means nothing."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dpa.policy import ContextOptions, make_context
from dpa.tokens import VerletTokenizer
from dpa.training.batches import Item, LogReader, ShuffledOrder, collate_items, crop_agents, log_item, micro_batches
from envs.augment import Augmentation
from envs.seeding import make_generator
from envs.sources.synthetic import build_scene, straight_road


def item(num_agents: int, seed: int = 0) -> Item:
    return log_item(make_context(straight_road(num_agents, seed=seed)), VerletTokenizer())


# --- order ----------------------------------------------------------------------------------------------------------
@settings(max_examples=30, deadline=None)
@given(st.integers(1, 12), st.integers(1, 20), st.integers(0, 99), st.integers(0, 9))
def test_every_epoch_takes_every_item_once(num_items: int, batch_size: int, seed: int, epoch: int) -> None:
    order = ShuffledOrder(num_items, batch_size, seed)
    taken = [index for step in range((epoch + 1) * num_items // batch_size + 1) for index in order(step)]
    assert sorted(taken[epoch * num_items : (epoch + 1) * num_items]) == list(range(num_items))


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 12), st.integers(1, 20), st.integers(0, 99), st.lists(st.integers(0, 50), min_size=1))
def test_a_step_takes_the_same_items_whenever_it_is_asked_for(
    num_items: int, batch_size: int, seed: int, steps: list[int]
) -> None:
    asked_in_any_order = ShuffledOrder(num_items, batch_size, seed)
    for step in steps:
        assert asked_in_any_order(step) == ShuffledOrder(num_items, batch_size, seed)(step)


def test_epochs_and_seeds_give_different_orders() -> None:
    order = ShuffledOrder(100, 100, seed=0)
    assert order(0) != order(1) and order(0) != ShuffledOrder(100, 100, seed=1)(0)


@pytest.mark.parametrize("sizes", [(0, 1), (1, 0)])
def test_nothing_to_draw_from_is_refused(sizes: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match=f"must be positive, got {sizes[0]} and {sizes[1]}"):
        ShuffledOrder(*sizes, seed=0)


# --- items ----------------------------------------------------------------------------------------------------------
def test_the_log_is_one_rollout_of_its_scene() -> None:
    context, tokenizer = make_context(straight_road(2, seed=3)), VerletTokenizer()
    result = log_item(context, tokenizer)
    assert result.tokens.shape == (1, 2, 16) and result.token_valid.all()
    poses = tokenizer.decode_tracks(result.tokens[0], context.recent, context.kind)
    assert (poses - context.logged)[:, 4::5, :2].norm(dim=-1).max() < 0.2


def test_agents_that_are_not_controlled_or_leave_the_log_have_no_valid_tokens() -> None:
    valid = torch.ones(3, 91, dtype=torch.bool)
    valid[1, 31:] = False
    scene = straight_road(3)
    scene.agents = build_scene(scene.agents.poses, [(0, torch.zeros(2, 2))], valid=valid).agents
    result = log_item(make_context(scene, ContextOptions(max_controlled=2)), VerletTokenizer())
    assert result.token_valid.sum(-1).tolist() == [16, 4, 0]


def test_a_crowd_is_cropped_to_the_agents_around_one_of_them() -> None:
    cropped = crop_agents(make_context(straight_road(9)), 4, make_generator(0, "crop", 5))
    assert cropped.kind.shape == (4,)
    x = cropped.recent[:, -1, 0]
    assert ((x[:-1] - x[1:]) == 15).all(), "in file, 15 m apart: four neighbours, in the order of the scene"


def test_cropping_depends_on_the_generator_alone() -> None:
    crowd = make_context(straight_road(9))
    draws = [crop_agents(crowd, 4, make_generator(0, "crop", step)).recent for step in (1, 1, 2, 3, 4)]
    assert torch.equal(draws[0], draws[1])
    assert any(not torch.equal(draws[0], other) for other in draws[2:])


def test_few_agents_are_left_alone() -> None:
    few = make_context(straight_road(3))
    assert crop_agents(few, 3, make_generator(0)) is few


def test_a_log_is_read_as_the_generator_says() -> None:
    read = LogReader(VerletTokenizer(), ContextOptions(), Augmentation(mirror=0.5), noise=0.5, max_agents=4)
    crowd = straight_road(9, seed=1)
    items = [read(crowd, make_generator(0, draw)) for draw in (0, 0, 1, 2, 3, 4)]
    assert all(one.tokens.shape == (1, 4, 16) for one in items)
    assert torch.equal(items[0].tokens, items[1].tokens) and torch.equal(items[0].labels, items[1].labels)
    assert not torch.equal(items[0].tokens, items[0].labels), "noise changes tokens and labels lead back"
    sides = {float(one.context.recent[0, -1, 1].sign()) for one in items}
    assert sides == {-1.0, 1.0}, "some are mirrored"


def test_labels_are_the_tokens_where_nothing_else_is_said() -> None:
    one = item(2)
    labelled = one._replace(tokens=one.tokens + 1)
    batch = collate_items([labelled, Item(one.context, one.tokens, one.token_valid)])
    assert torch.equal(batch["labels"][0], one.tokens) and torch.equal(batch["tokens"][0], one.tokens + 1)
    assert torch.equal(batch["labels"][1], one.tokens)


# --- batches --------------------------------------------------------------------------------------------------------
def test_batches_are_padded_with_tokens_that_do_not_count() -> None:
    items = [item(1), item(3)]
    batch = collate_items(items)
    assert batch.batch_size == (2,)
    assert batch["tokens"].shape == (2, 1, 3, 16) and batch["token_valid"].shape == (2, 1, 3, 16)
    assert batch["token_valid"].sum((1, 3)).tolist() == [[16, 0, 0], [16, 16, 16]]
    for row, one in enumerate(items):
        agents = one.tokens.shape[1]
        assert torch.equal(batch["tokens"][row, :, :agents], one.tokens)
        assert batch["context"].valid[row].tolist() == [True] * agents + [False] * (3 - agents)


def test_batches_go_to_a_device_as_a_whole() -> None:
    batch = collate_items([item(1)]).to("meta")
    assert batch["tokens"].is_meta and batch["context"].recent.is_meta


@settings(max_examples=50, deadline=None)
@given(st.lists(st.integers(1, 60), min_size=1, max_size=12), st.integers(1, 200))
def test_parts_of_a_batch_hold_every_item_once_within_the_bound(sizes: list[int], max_rows: int) -> None:
    parts = micro_batches(sizes, max_rows)
    assert sorted(position for part in parts for position in part) == list(range(len(sizes)))
    for part in parts:
        rows = [sizes[position] for position in part]
        assert len(part) == 1 or len(part) * max(rows) <= max_rows
        assert max(rows) <= 2 * min(rows)


if __name__ == "__main__":
    pytest.main([__file__])
