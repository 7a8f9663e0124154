"""Attention with relative poses: against a dense oracle that looks at every pair."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from dpa.models.attention import GAZE, METRES, KeyValues, NodeAttention, NodeMasks, RelativeAttention, added
from envs.geometry.frames import rotate, to_local, to_world

WIDTH, HEADS = 32, 2


def make_attention(seed: int = 0, width: int = WIDTH, heads: int = HEADS) -> RelativeAttention:
    """With gazes that look somewhere."""
    torch.manual_seed(seed)
    attention = RelativeAttention(width, heads)
    torch.nn.init.normal_(attention.gaze.weight, std=0.3)
    torch.nn.init.normal_(attention.gaze.bias, std=0.5)
    return attention


def tokens(num: int, seed: int = 0, width: int = WIDTH) -> tuple[Tensor, Tensor]:
    """Channels ``[2, num, width]`` and poses ``[2, num, 3]`` within some tens of metres."""
    generator = torch.Generator().manual_seed(seed)
    x = torch.randn(2, num, width, generator=generator)
    pose = torch.randn(2, num, 3, generator=generator) * torch.tensor([25.0, 25.0, 2.0])
    return x, pose


def seen_from(attention: RelativeAttention, channels: Tensor, relative: Tensor) -> Tensor:
    """``[H, D]`` channels of one token as they appear from another one: vectors turned and shifted."""
    vector, weight, rest = attention._blocks(channels)
    angle = relative[2].expand(vector.shape[:-1])
    vector = rotate(vector, angle) + weight[..., None] * relative[:2] / METRES
    return torch.cat((vector.flatten(-2), weight, rest), -1)


def dense(attention: RelativeAttention, x: Tensor, pose: Tensor, memory: Tensor, at: Tensor, mask: Tensor) -> Tensor:
    """The definition, pair by pair, for one row: relative pose, score, softmax, mean."""
    queries = attention.query(x).unflatten(-1, (attention.heads, attention.dim))
    keys, values = attention.key_value(memory).unflatten(-1, (2, attention.heads, attention.dim)).unbind(1)
    gaze = attention.gaze(x).unflatten(-1, (attention.heads, 3))
    out = []
    for i in range(len(x)):
        scores, seen = [], []
        for j in range(len(memory)):
            relative = to_local(at[j], pose[i])
            precision = attention.precision * METRES**2 * gaze[i, :, 2].exp()
            away = (gaze[i, :, :2] - relative[:2] / METRES).square().sum(-1)
            score = (queries[i] * seen_from(attention, keys[j], relative)).sum(-1) / attention.dim**0.5
            scores.append((score - precision * away / 2).masked_fill(~mask[i, j], -torch.inf))
            seen.append(seen_from(attention, values[j], relative))
        share = torch.stack(scores).softmax(0)
        out.append((share[..., None] * torch.stack(seen)).sum(0).flatten())
    return attention.out(torch.stack(out))


def attend(attention: RelativeAttention, queries: tuple, memory: tuple, mask: Tensor | None = None) -> Tensor:
    return attention(*queries, attention.remember(*memory), mask)


@pytest.mark.parametrize(("width", "heads"), [(32, 2), (24, 2), (30, 3)])
@torch.no_grad()
def test_it_equals_attention_over_relative_poses_of_every_pair(width: int, heads: int) -> None:
    attention = make_attention(width=width, heads=heads)
    (x, pose), (memory, at) = tokens(4, 1, width), tokens(6, 2, width)
    mask = torch.rand(2, 4, 6, generator=torch.Generator().manual_seed(3)) > 0.3
    mask[..., 0] = True
    fast = attend(attention, (x, pose), (memory, at), mask[:, None])
    for row in range(2):
        expected = dense(attention, x[row], pose[row], memory[row], at[row], mask[row])
        torch.testing.assert_close(fast[row], expected, atol=1e-4, rtol=1e-4)


@settings(max_examples=20, deadline=None)
@given(st.floats(-200, 200), st.floats(-200, 200), st.floats(-3.1, 3.1))
@torch.no_grad()
def test_it_does_not_change_when_the_scene_is_moved_and_turned(x: float, y: float, angle: float) -> None:
    attention, motion = make_attention(), torch.tensor([x, y, angle])
    queries, memory = tokens(5, 1), tokens(7, 2)
    here = attend(attention, queries, memory)
    there = attend(attention, *((channels, to_world(pose, motion)) for channels, pose in (queries, memory)))
    torch.testing.assert_close(there, here, atol=1e-4 * here.abs().max().item(), rtol=0)


@torch.no_grad()
def test_it_does_change_when_one_token_moves() -> None:
    attention, (x, pose) = make_attention(), tokens(5)
    other = pose.clone()
    other[:, 0, 0] += 1.0
    assert (attend(attention, (x, pose), (x, pose)) - attend(attention, (x, pose), (x, other))).abs().max() > 1e-3


@torch.no_grad()
def test_masked_tokens_change_nothing() -> None:
    attention, (x, pose) = make_attention(), tokens(5)
    mask = torch.tensor([True, True, True, False, False])[None, None, None]
    spoiled = (x.clone(), pose.clone())
    spoiled[0][:, 3:], spoiled[1][:, 3:] = 100.0, 500.0
    kept = attend(attention, (x, pose), (x, pose), mask)
    assert torch.equal(attend(attention, (x, pose), spoiled, mask), kept)
    torch.testing.assert_close(kept, attend(attention, (x, pose), (x[:, :3], pose[:, :3])))


@torch.no_grad()
def test_at_the_start_of_training_the_gaze_rests_on_the_agent_itself() -> None:
    """Without anything learnt, near tokens weigh more than far ones, narrow heads more so."""
    attention = RelativeAttention(WIDTH, HEADS)
    torch.nn.init.zeros_(attention.query.weight)
    torch.nn.init.zeros_(attention.query.bias)
    keys = attention.remember(torch.zeros(1, 2, WIDTH), torch.tensor([[[2.0, 0, 0], [20.0, 0, 0]]])).keys
    gaze = attention._gaze(torch.zeros(1, 1, WIDTH), torch.zeros(1, 1, 1, 3))
    narrow, wide = (gaze @ keys[..., -GAZE:].transpose(-1, -2))[0, :, 0].softmax(-1)
    assert narrow[0] > wide[0] > 0.5


@pytest.mark.parametrize(("width", "heads"), [(32, 3), (30, 2)])
def test_heads_without_an_even_number_of_channels_are_refused(width: int, heads: int) -> None:
    with pytest.raises(ValueError, match=f"multiple of twice the heads, got {width} and {heads}"):
        RelativeAttention(width, heads=heads)


# --- between nodes --------------------------------------------------------------------------------------------------
AGENTS, DECISIONS = 3, 6  # more decisions than attend at a time


def node_attention() -> NodeAttention:
    torch.manual_seed(0)
    attention = NodeAttention(WIDTH, heads=4)
    torch.nn.init.normal_(attention.gaze.weight, std=0.3)
    return attention


def staircase() -> NodeMasks:
    """What nodes see in one pass: the own past, and everybody up to the own decision."""
    own = torch.ones(DECISIONS, DECISIONS, dtype=torch.bool).tril()
    return NodeMasks(own, added(own.repeat_interleave(AGENTS, 0).repeat_interleave(AGENTS, 1)))


@torch.no_grad()
def test_some_heads_see_the_own_past_only_and_the_others_everybody() -> None:
    attention, (x, pose) = node_attention(), tokens(AGENTS * DECISIONS, 1)
    assert attention.own == 1 and attention.heads == 4
    masks, memory = staircase(), attention.remember(x, pose)
    agent = torch.arange(AGENTS).repeat(DECISIONS)
    everybody = masks.everybody == 0
    each_head = torch.stack((everybody & (agent[:, None] == agent), *[everybody] * 3))
    plain = RelativeAttention.forward(attention, x, pose, memory, each_head)
    torch.testing.assert_close(attention(x, pose, memory, masks, AGENTS), plain, atol=1e-5, rtol=1e-4)


@torch.no_grad()
def test_the_last_decision_can_be_attended_from_alone() -> None:
    attention, (x, pose) = node_attention(), tokens(AGENTS * DECISIONS, 1)
    masks, memory = staircase(), attention.remember(x, pose)
    whole = attention(x, pose, memory, masks, AGENTS)[:, -AGENTS:]
    last = NodeMasks(masks.own[-1:], masks.everybody[-AGENTS:])
    alone = attention(x[:, -AGENTS:], pose[:, -AGENTS:], KeyValues(*memory), last, AGENTS)
    torch.testing.assert_close(alone, whole, atol=1e-5, rtol=1e-4)


if __name__ == "__main__":
    pytest.main([__file__])
