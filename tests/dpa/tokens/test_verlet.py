"""Verlet tokens: whole numbers of bins, exact round trips, and headings that a road user can have."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from torch import Tensor

from dpa.tokens import TokenizedTracks, VerletTokenizer
from dpa.tokens.verlet import CHANGES, DEFAULT_BINS, DEFAULT_TURN, REACH
from envs.geometry.frames import to_local, to_world, wrap_angle
from envs.scene import AgentKind
from envs.sources.synthetic import straight_road

FEW = settings(max_examples=25, deadline=None)
KEEP = 84
VEHICLE, PEDESTRIAN, CYCLIST = AgentKind.VEHICLE, AgentKind.PEDESTRIAN, AgentKind.CYCLIST
FRAMES, INTERPOLATIONS = ("current", "scene"), ("linear", "quadratic")
tokenizers = st.builds(VerletTokenizer, interpolation=st.sampled_from(INTERPOLATIONS), frame=st.sampled_from(FRAMES))
kinds = st.sampled_from([VEHICLE, PEDESTRIAN, CYCLIST, AgentKind.OTHER])
small_changes = st.lists(st.tuples(st.integers(-3, 3), st.integers(-3, 3)), min_size=16, max_size=16)


def token(forward: int = 0, left: int = 0) -> int:
    return CHANGES * (forward + 6) + left + 6


def at_speed(metres: float, heading: float = 0.0, x: float = 0.0, y: float = 0.0) -> Tensor:
    """``[1, 6, 3]``: an agent that moved so far along its heading in the last decision."""
    own = torch.zeros(6, 3)
    own[:, 0] = torch.linspace(-metres, 0, 6)
    return to_world(own, torch.tensor([x, y, heading]))[None]


def decode(tokenizer: VerletTokenizer, tokens: list[int], recent: Tensor, kind: int = VEHICLE) -> Tensor:
    """``[T * F, 3]``."""
    return tokenizer.decode_tracks(torch.tensor([tokens]), recent, torch.tensor([int(kind)]))[0]


# --- round trips ----------------------------------------------------------------------------------------------------
@FEW
@given(tokenizers, small_changes, kinds, st.floats(0, 5), st.floats(-math.pi, math.pi), st.floats(-300, 300))
def test_tokens_decode_to_poses_that_encode_to_the_same_tokens(
    tokenizer: VerletTokenizer, changes: list, kind: int, metres: float, heading: float, x: float
) -> None:
    tokens = torch.tensor([[token(*change) for change in changes]])
    recent, kind = at_speed(metres, heading, x, -x / 2), torch.tensor([int(kind)])
    poses = tokenizer.decode_tracks(tokens, recent, kind)
    moved = torch.cat((recent[:, -1:, :2], poses[:, 4::5, :2]), 1).diff(dim=1).norm(dim=-1)
    assume(moved.max() < (REACH - 1) * tokenizer.bins[kind].min())  # at the reach several changes mean the same
    again = tokenizer.encode_tracks(poses, torch.ones(1, 80, dtype=torch.bool), recent, kind)
    assert again.tokens.tolist() == tokens.tolist()
    torch.testing.assert_close(again.poses, poses)
    assert again.valid.all()


def test_finer_bins_with_as_hard_braking_lose_less_of_a_log() -> None:
    scene = straight_road(6, seed=3)
    log, valid = scene.agents.poses[:, 11:], scene.agents.valid[:, 11:]
    half = {kind: tuple(width / 2 for width in widths) for kind, widths in DEFAULT_BINS.items()}
    fine = VerletTokenizer(bins=half, changes=25, reach=2 * REACH)
    errors = []
    for tokenizer in (VerletTokenizer(), fine):
        tracks = tokenizer.encode_tracks(log, valid, scene.agents.recent(5), scene.agents.kind)
        errors.append((tracks.poses - log)[..., :2].norm(dim=-1).mean())
        assert tokenizer.vocab_size == tokenizer.changes**2 > int(tracks.tokens.max())
    assert errors[1] < 0.7 * errors[0]
    hardest, keep = torch.tensor([[12]]), torch.tensor([[25 * 12 + 12]])
    recent, kind = at_speed(6.0), torch.tensor([int(VEHICLE)])
    moved = [fine.decode_tracks(token, recent, kind)[0, -1, 0] for token in (hardest, keep)]
    coarse = VerletTokenizer().decode_tracks(torch.tensor([[6]]), recent, kind)[0, -1, 0]
    torch.testing.assert_close(moved[0], coarse, atol=0.15, rtol=0)
    assert moved[1] == pytest.approx(6.0, abs=0.1)


@pytest.mark.parametrize(("options", "message"), [({"changes": 12}, "odd number .* got 12"), ({"reach": 0}, "got 0")])
def test_bins_that_make_no_tokens_are_refused(options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        VerletTokenizer(**options)


@FEW
@given(tokenizers, st.lists(st.integers(0, CHANGES**2 - 1), min_size=16, max_size=16))
def test_any_tokens_decode_to_poses_that_their_encoding_reproduces(tokenizer: VerletTokenizer, tokens: list) -> None:
    """Even where the largest displacement cuts a token short and another token says the same."""
    kind = torch.tensor([int(VEHICLE)])
    poses = tokenizer.decode_tracks(torch.tensor([tokens]), at_speed(2.0), kind)
    assert torch.isfinite(poses).all()
    again = tokenizer.encode_tracks(poses, torch.ones(1, 80, dtype=torch.bool), at_speed(2.0), kind)
    torch.testing.assert_close(again.poses, poses, atol=1e-3, rtol=0)


@FEW
@given(tokenizers, st.integers(0, 10_000), kinds)
def test_reconstruction_is_never_more_than_half_a_bin_away(tokenizer: VerletTokenizer, seed: int, kind: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    turn, phase = torch.rand(2, generator=generator).tolist()
    heading = 0.3 * (turn - 0.5) * torch.arange(81) * 0.1
    speed = 0.6 + 0.15 * torch.sin(torch.arange(81) * 0.07 + phase)
    xy = (0.1 * speed[:, None] * torch.stack((heading.cos(), heading.sin()), -1)).cumsum(0)
    track = torch.cat((xy, heading[:, None]), -1)[None]
    recent, kind = to_world(at_speed(0.3), track[:, :1]), torch.tensor([int(kind)])
    result = tokenizer.encode_tracks(track[:, 1:], torch.ones(1, 80, dtype=torch.bool), recent, kind)
    change = torch.stack((result.tokens // CHANGES, result.tokens % CHANGES), -1) - 6
    assert change.abs().max() < 6, "the track is meant to be slow enough that no change is clipped"
    error = (result.poses - track[:, 1:])[0, 4::5, :2].norm(dim=-1)
    assert error.max() <= tokenizer.bins[kind[0]].norm() / 2 + 1e-4


def test_errors_do_not_add_up() -> None:
    """Encoded against the log instead of the reconstruction, an odd speed would drift by half a bin a decision."""
    bin_size = DEFAULT_BINS["vehicle"][0]
    step = 0.4 * bin_size / 5
    track = torch.zeros(1, 80, 3)
    track[0, :, 0] = step * torch.arange(1, 81)
    result = VerletTokenizer().encode_tracks(
        track, torch.ones(1, 80, dtype=torch.bool), at_speed(5 * step), torch.tensor([int(VEHICLE)])
    )
    error = (result.poses - track)[0, 4::5, 0].abs()
    assert error.max() <= bin_size / 2 + 1e-5
    assert len(set(result.tokens[0].tolist())) > 1


def test_a_turn_through_pi_is_tokenized_like_any_other() -> None:
    tokenizer = VerletTokenizer()
    tokens = [token(1, 2)] * 16
    straight, turned = (decode(tokenizer, tokens, at_speed(4.0, heading)) for heading in (0.0, 3.1))
    torch.testing.assert_close(wrap_angle(turned[:, 2] - straight[:, 2]), torch.full((80,), 3.1), atol=1e-3, rtol=0)
    assert turned[:, 2].abs().max() <= math.pi + 1e-6


# --- what a token means ---------------------------------------------------------------------------------------------
@pytest.mark.parametrize("interpolation", INTERPOLATIONS)
@pytest.mark.parametrize("frame", FRAMES)
def test_token_84_keeps_the_velocity(frame: str, interpolation: str) -> None:
    tokenizer = VerletTokenizer(frame=frame, interpolation=interpolation)
    metres = 10 * DEFAULT_BINS["vehicle"][0]
    poses = decode(tokenizer, [KEEP] * 4, at_speed(metres))
    torch.testing.assert_close(poses[:, 0], metres / 5 * torch.arange(1, 21), atol=1e-4, rtol=0)
    assert (poses[:, 1:].abs() < 1e-5).all()


@pytest.mark.parametrize(("name", "kind"), [("vehicle", VEHICLE), ("pedestrian", PEDESTRIAN), ("cyclist", CYCLIST)])
def test_each_class_has_its_own_bins(name: str, kind: int) -> None:
    forward, lateral = DEFAULT_BINS[name]
    end = decode(VerletTokenizer(), [token(2, -3)], at_speed(0.0), kind)[-1]
    torch.testing.assert_close(end[:2], torch.tensor([2 * forward, -3 * lateral]))


@pytest.mark.parametrize("kind", [AgentKind.UNSET, AgentKind.OTHER])
def test_agents_of_no_class_move_like_vehicles(kind: int) -> None:
    like = decode(VerletTokenizer(), [token(3, 1)], at_speed(2.0), VEHICLE)
    assert torch.equal(decode(VerletTokenizer(), [token(3, 1)], at_speed(2.0), kind), like)


def test_bins_lie_along_the_heading_or_along_the_axes_of_the_scene() -> None:
    forward, lateral = DEFAULT_BINS["vehicle"]
    north = at_speed(0.0, heading=math.pi / 2)
    own = decode(VerletTokenizer(frame="current"), [token(4, 2)], north)[-1, :2]
    axes = decode(VerletTokenizer(frame="scene"), [token(4, 2)], north)[-1, :2]
    torch.testing.assert_close(own, torch.tensor([-2 * lateral, 4 * forward]))
    torch.testing.assert_close(axes, torch.tensor([4 * forward, 2 * lateral]))


def test_constant_acceleration_is_exact_with_quadratic_interpolation() -> None:
    bin_size = DEFAULT_BINS["vehicle"][0]
    # The displacement grows by two bins a decision of 0.5 s: an acceleration of 2 bins / (0.5 s)^2.
    accel, time = 2 * bin_size / 0.25, torch.arange(1, 41) * 0.1
    start = 10 * bin_size / 0.5 + accel * 0.25  # speed now; that of the last decision's middle is ten bins
    expected = start * time + accel * time**2 / 2
    quadratic = decode(VerletTokenizer(interpolation="quadratic"), [token(2)] * 8, at_speed(10 * bin_size))
    torch.testing.assert_close(quadratic[:, 0], expected, atol=1e-3, rtol=0)
    linear = decode(VerletTokenizer(interpolation="linear"), [token(2)] * 8, at_speed(10 * bin_size))
    torch.testing.assert_close(linear[4::5, 0], expected[4::5], atol=1e-3, rtol=0)
    assert (linear[:, 0] - expected).abs().max() > 0.05


def test_linear_interpolation_moves_at_constant_speed_inside_a_decision() -> None:
    poses = decode(VerletTokenizer(interpolation="linear"), [token(5)], at_speed(2.8125))
    moves = torch.diff(poses[:, 0], prepend=torch.zeros(1))
    torch.testing.assert_close(moves, torch.full((5,), 15 * 0.28125 / 5))


def test_displacements_end_at_the_largest_bin() -> None:
    bin_size = DEFAULT_BINS["vehicle"][0]
    moves = torch.diff(decode(VerletTokenizer(), [token(6)] * 16, at_speed(0.0))[4::5, 0])
    torch.testing.assert_close(moves[-4:], torch.full((4,), REACH * bin_size), atol=1e-3, rtol=0)


# --- headings -------------------------------------------------------------------------------------------------------
def test_standing_holds_the_heading() -> None:
    poses = decode(VerletTokenizer(), [KEEP] * 3, at_speed(0.0, heading=1.2))
    torch.testing.assert_close(poses[:, 2], torch.full((15,), 1.2))
    assert (poses[:, :2] == 0).all()


@pytest.mark.parametrize("kind", [VEHICLE, PEDESTRIAN, CYCLIST])
def test_reversing_keeps_the_heading(kind: int) -> None:
    poses = decode(VerletTokenizer(), [token(-4), KEEP, KEEP], at_speed(0.0, heading=1.2), kind)
    torch.testing.assert_close(poses[:, 2], torch.full((15,), 1.2), atol=1e-4, rtol=0)
    assert poses[-1, :2].norm() > 1


@pytest.mark.parametrize("kind", [VEHICLE, PEDESTRIAN, CYCLIST])
@pytest.mark.parametrize(("before", "change"), [(4, -4), (3, -5), (5, -6), (-3, 5), (-5, 6)])
def test_stopping_and_changing_direction_keep_the_heading(kind: int, before: int, change: int) -> None:
    tokenizer = VerletTokenizer()
    poses = decode(tokenizer, [token(change), KEEP], at_speed(before * tokenizer.bins[kind, 0].item()), kind)
    assert poses[:, 2].abs().max() < 1e-5


@FEW
@given(tokenizers, st.lists(st.integers(0, CHANGES**2 - 1), min_size=6, max_size=6), kinds)
def test_the_heading_turns_no_faster_than_the_class_allows(tokenizer: VerletTokenizer, tokens: list, kind: int) -> None:
    poses = decode(tokenizer, tokens, at_speed(1.0, heading=0.7), kind)
    track = torch.cat((torch.tensor([[0.0, 0.0, 0.7]]), poses))
    moved = torch.diff(track[:, :2], dim=0).norm(dim=-1)
    turned = wrap_angle(torch.diff(track[:, 2])).abs()
    assert (turned <= tokenizer.turn[kind] * moved + 1e-4).all()


def test_a_slow_turn_follows_the_motion() -> None:
    """Where the limit does not bind the heading is the direction of the motion."""
    tokenizer = VerletTokenizer(turn={"vehicle": 9.0, "pedestrian": 9.0, "cyclist": 9.0})
    poses = decode(tokenizer, [token(0, 1)], at_speed(5.0))
    moves = torch.diff(poses[:, :2], dim=0, prepend=torch.zeros(1, 2))
    torch.testing.assert_close(poses[:, 2], torch.atan2(moves[:, 1], moves[:, 0]))


# --- logs with holes ------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("missing", "expected"),
    [
        ([], 16),
        ([4], 0),  # the pose that the first token ends at
        ([0, 1, 2, 3], 16),  # inside a decision: its end is all that a token needs
        ([14], 2),
        ([14, 15, 16], 2),  # valid again later, but no longer the same track
    ],
)
def test_tokens_are_valid_up_to_the_first_hole(missing: list[int], expected: int) -> None:
    agents = straight_road(1).agents
    valid = torch.ones(1, 80, dtype=torch.bool)
    valid[0, missing] = False
    poses = agents.poses[:, 11:] * valid[..., None]
    result = VerletTokenizer().encode_tracks(poses, valid, agents.recent(5), agents.kind)
    assert result.valid.sum() == expected and result.valid[0, :expected].all()
    assert torch.isfinite(result.poses).all()


# --- noise ----------------------------------------------------------------------------------------------------------
def noisy_tracks(noise: float, seed: int = 0, recovery: float = 1.0) -> tuple[TokenizedTracks, TokenizedTracks]:
    """The same tracks with noise and without."""
    agents = straight_road(6, seed=1).agents
    given = (agents.poses[:, 11:], agents.valid[:, 11:], agents.recent(5), agents.kind)
    drawn = torch.rand(6, 16, 3, generator=torch.Generator().manual_seed(seed))
    tokenizer = VerletTokenizer()
    noisy = tokenizer.encode_tracks(*given, noise=noise, recovery=recovery, drawn=drawn)
    return noisy, tokenizer.encode_tracks(*given)


def test_without_noise_the_labels_are_the_tokens() -> None:
    plain, same = noisy_tracks(0.0)
    assert torch.equal(plain.labels, plain.tokens) and torch.equal(plain.tokens, same.tokens)


def test_noise_replaces_tokens_by_neighbours_and_labels_lead_back_to_the_log() -> None:
    noisy, plain = noisy_tracks(0.5)
    replaced = noisy.tokens != noisy.labels
    assert 0.2 < replaced.float().mean() < 0.7
    for part in (lambda t: t // CHANGES, lambda t: t % CHANGES):
        assert (part(noisy.tokens) - part(noisy.labels)).abs().max() <= 1
    # The poses are those of the noisy tokens, and stay near the log all the same.
    agents = straight_road(6, seed=1).agents
    decoded = VerletTokenizer().decode_tracks(noisy.tokens, agents.recent(5), agents.kind)
    torch.testing.assert_close(noisy.poses, decoded)
    assert (noisy.poses - agents.poses[:, 11:])[..., :2].norm(dim=-1).max() < 1.5
    assert torch.equal(noisy.valid, plain.valid)
    # The label is what brings the agent back: the token that a fresh encoding from there gives.
    first = replaced.nonzero()[0]
    agent, step = first[0].item(), first[1].item()
    assert torch.equal(noisy.tokens[agent, :step], plain.tokens[agent, :step])
    assert noisy.labels[agent, step] == plain.tokens[agent, step]


def test_labels_that_come_back_slowly_aim_beside_the_log() -> None:
    """By hand, for each decision: the target lies beside the log as the agent lies beside it, but nearer."""
    noisy, _ = noisy_tracks(0.5, recovery=0.25)
    agents, tokenizer = straight_road(6, seed=1).agents, VerletTokenizer()
    logged, driven = agents.poses[:, 11:].unflatten(1, (16, 5)), noisy.poses.unflatten(1, (16, 5))
    for step in range(1, 16):
        recent = torch.cat(
            ((driven[:, step - 2, -1:] if step > 1 else agents.recent(5)[:, -1:]), driven[:, step - 1]), 1
        )
        offset = 0.75 * to_local(driven[:, step - 1, -1], logged[:, step - 1, -1])
        target = to_local(to_world(offset[:, None], logged[:, step]), recent[:, -1:])
        assert torch.equal(noisy.labels[:, step], tokenizer.encode(target, recent, agents.kind))


def test_labels_that_come_back_slowly_drive_more_smoothly_and_are_the_plain_ones_without_noise() -> None:
    def change(tracks: TokenizedTracks) -> float:
        """How far labels lie from unchanged velocity, in bins, in the mean."""
        return float(
            (torch.stack((tracks.labels // CHANGES, tracks.labels % CHANGES)) - CHANGES // 2).abs().float().mean()
        )

    (slow, plain), (fast, _) = noisy_tracks(0.5, recovery=0.25), noisy_tracks(0.5)
    assert change(slow) < change(fast)
    assert torch.equal(noisy_tracks(0.0, recovery=0.25)[0].labels, plain.labels)


def test_noise_is_that_of_the_draws() -> None:
    (one, _), (same, _), (other, _) = (noisy_tracks(0.5, seed) for seed in (1, 1, 2))
    assert torch.equal(one.tokens, same.tokens) and not torch.equal(one.tokens, other.tokens)


def test_neighbours_of_the_outermost_tokens_are_tokens() -> None:
    corners = torch.tensor([0, 12, 156, 168]).repeat(100)
    kind = torch.ones_like(corners)
    neighbours = VerletTokenizer().neighbour(
        corners, kind, torch.rand(400, 2, generator=torch.Generator().manual_seed(0))
    )
    assert neighbours.min() >= 0 and neighbours.max() < CHANGES**2
    assert set(neighbours.view(100, 4)[:, 0].tolist()) == {0, 1, 13, 14}


# --- options --------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"interpolation": "cubic"}, "'linear' or 'quadratic', got 'cubic'"),
        ({"frame": "world"}, "'current' or 'scene', got 'world'"),
        ({"bins": {"vehicle": (0.3, 0.1)}}, r"bins needs exactly the classes .* got \['vehicle'\]"),
        ({"bins": {**DEFAULT_BINS, "tram": (1.0, 1.0)}}, "bins needs exactly the classes"),
        ({"bins": {**DEFAULT_BINS, "cyclist": (0.0, 0.1)}}, "bins must be positive"),
        ({"turn": {**DEFAULT_TURN, "vehicle": -1.0}}, "turn must be positive"),
    ],
)
def test_options_that_make_no_sense_are_refused(options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        VerletTokenizer(**options)


def test_decisions_may_have_another_length() -> None:
    tokenizer = VerletTokenizer(steps=10)
    recent = torch.zeros(1, 11, 3)
    recent[0, :, 0] = torch.linspace(-2.8125, 0, 11)
    assert tokenizer.decode(torch.tensor([KEEP]), recent, torch.tensor([1])).shape == (1, 10, 3)


if __name__ == "__main__":
    pytest.main([__file__])
