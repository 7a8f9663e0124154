"""Items and batches: functions of a seed and a step, and padding that means nothing."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dpa.models import make_context
from dpa.models.motionlm import featurize
from dpa.tokens import VerletTokenizer
from dpa.training.batches import Item, ShuffledOrder, collate_items, micro_batches
from dpa.training.logs import log_item
from envs.sources.synthetic import straight_road


def item(num_agents: int, seed: int = 0) -> Item:
    return log_item(make_context(straight_road(num_agents, seed=seed), featurize), VerletTokenizer())


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
        assert batch["context"].episode.valid[row].tolist() == [True] * agents + [False] * (3 - agents)


def test_batches_go_to_a_device_as_a_whole() -> None:
    batch = collate_items([item(1)]).to("meta")
    assert batch["tokens"].is_meta and batch["context"].episode.recent.is_meta


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
