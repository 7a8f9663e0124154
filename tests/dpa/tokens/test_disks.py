"""k-disks: a vocabulary covers what it was made of, encoding finds the nearest, and a policy carries its motions."""

from __future__ import annotations

import copy
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from dpa.models.motionlm import MotionLM
from dpa.tokens import KDisksTokenizer
from dpa.tokens.vocabulary import (
    Vocabulary,
    corners,
    digest_of,
    k_disks,
    logged_motions,
    read_vocabulary,
    smallest_radius,
    stacked,
    write_vocabulary,
)
from envs.scene import AgentKind
from envs.sources.synthetic import straight_road

VEHICLE, PEDESTRIAN = AgentKind.VEHICLE, AgentKind.PEDESTRIAN
MOTIONS = logged_motions([straight_road(8, seed=seed) for seed in range(12)], steps=5)[VEHICLE]


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def tokenizer_of(size: int = 40, radius: float = 0.1) -> KDisksTokenizer:
    walk = MOTIONS[:50] * torch.tensor([0.1, 0.1, 1.0])
    disks = {VEHICLE: k_disks(MOTIONS, VEHICLE, size, radius, generator())}
    return KDisksTokenizer.of(stacked(disks | {PEDESTRIAN: k_disks(walk, PEDESTRIAN, size, radius / 4, generator())}))


def apart(first: Tensor, second: Tensor, kind: AgentKind = VEHICLE) -> Tensor:
    """Root mean square distance of corners by hand: ``[n, F, 3]`` and ``[m, F, 3]`` to ``[n, m]``."""
    length, width = {VEHICLE: (4.8, 2.0), PEDESTRIAN: (1.0, 1.0)}[kind]
    ends = []
    for motions in (first, second):
        ahead = torch.stack((motions[..., 2].cos(), motions[..., 2].sin()), -1)
        left = torch.stack((-ahead[..., 1], ahead[..., 0]), -1)
        signs = [(1, 1), (1, -1), (-1, 1), (-1, -1)]
        ends.append(
            torch.stack([motions[..., :2] + a * length / 2 * ahead + b * width / 2 * left for a, b in signs], -2)
        )
    return (ends[0][:, None] - ends[1][None]).square().sum(-1).mean((-1, -2)).sqrt()


# --- vocabularies ---------------------------------------------------------------------------------------------------
@settings(max_examples=10, deadline=None)
@given(st.floats(0.05, 0.5), st.integers(0, 9))
def test_every_motion_lies_near_an_entry_and_the_first_is_standing_still(radius: float, seed: int) -> None:
    entries = k_disks(MOTIONS, VEHICLE, 10_000, radius, generator(seed))
    assert not entries[0].any()
    # An entry is the mean of its disk, so what the disk held lies within twice its radius.
    assert apart(MOTIONS, entries).amin(1).max() <= 2 * radius + 1e-4


def test_the_smallest_radius_fills_the_vocabulary_and_a_smaller_one_does_not_hold_all() -> None:
    radius = smallest_radius("k_disks", MOTIONS, VEHICLE, 40, seed=0)
    assert len(k_disks(MOTIONS, VEHICLE, 99, radius, generator())) <= 40
    assert len(k_disks(MOTIONS, VEHICLE, 99, 0.9 * radius, generator())) > 40


def test_corners_are_compared_as_by_hand() -> None:
    rows = corners(MOTIONS[:20], VEHICLE)
    torch.testing.assert_close(torch.cdist(rows, rows) / 20**0.5, apart(MOTIONS[:20], MOTIONS[:20]), atol=2e-3, rtol=0)


def test_a_class_without_motions_has_those_of_vehicles_and_a_smaller_one_repeats_its_own() -> None:
    tables = stacked({VEHICLE: torch.rand(5, 4, 3), PEDESTRIAN: torch.rand(2, 4, 3)})
    assert tables.shape == (len(AgentKind), 5, 4, 3)
    assert torch.equal(tables[AgentKind.CYCLIST], tables[VEHICLE])
    assert torch.equal(tables[PEDESTRIAN][2:4], tables[PEDESTRIAN][:2])


def test_a_file_gives_back_what_was_written(tmp_path: Path) -> None:
    made = Vocabulary(tokenizer_of().motions, {"size": 40})
    write_vocabulary(tmp_path / "a/words.npz", made)
    again = read_vocabulary(tmp_path / "a/words.npz")
    assert torch.equal(again.motions, made.motions) and again.card == made.card


@pytest.mark.parametrize("content", [b"", b"PK", b"\x93NUMPY"])
def test_a_damaged_file_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "words.npz").write_bytes(content)
    with pytest.raises(ValueError, match="words.npz is no vocabulary"):
        read_vocabulary(tmp_path / "words.npz")


def test_a_table_of_another_shape_and_one_with_objects_are_refused(tmp_path: Path) -> None:
    card = np.frombuffer(b"{}", dtype=np.uint8)
    np.savez(tmp_path / "flat.npz", motions=np.zeros((2, 3), np.float32), card=card)
    with pytest.raises(ValueError, match=r"motions must be finite and \[\d+, V, F, 3\], got \[2, 3\]"):
        read_vocabulary(tmp_path / "flat.npz")
    np.savez(tmp_path / "objects.npz", motions=np.array([{}], dtype=object), card=card)
    with pytest.raises(ValueError, match="objects.npz is no vocabulary"):
        read_vocabulary(tmp_path / "objects.npz")


# --- tokens ---------------------------------------------------------------------------------------------------------
def test_an_entry_is_encoded_as_itself_and_any_motion_as_the_nearest() -> None:
    tokenizer, recent = tokenizer_of(), torch.zeros(len(MOTIONS), 6, 3)
    kind = torch.full((len(MOTIONS),), int(VEHICLE))
    tokens = tokenizer.encode(MOTIONS, recent, kind)
    errors = apart(MOTIONS, tokenizer.motions[VEHICLE])
    torch.testing.assert_close(errors.gather(1, tokens[:, None])[:, 0], errors.amin(1), atol=1e-3, rtol=0)
    own = tokenizer.motions[VEHICLE]
    assert torch.equal(tokenizer.decode(tokenizer.encode(own, recent[: len(own)], kind[: len(own)]),
                                        recent[: len(own)], kind[: len(own)]), own)  # fmt: skip


def test_classes_have_tables_of_their_own_in_any_shape_of_batch() -> None:
    tokenizer = tokenizer_of()
    kind = torch.tensor([[int(VEHICLE), int(PEDESTRIAN)]]).expand(3, 2)
    target, recent = MOTIONS[:6].view(3, 2, 5, 3), torch.zeros(3, 2, 6, 3)
    tokens = tokenizer.encode(target, recent, kind)
    for row in range(3):
        for column in range(2):
            one = (value[row, column][None] for value in (target, recent, kind))
            assert tokens[row, column] == tokenizer.encode(*one)[0]


def test_errors_of_a_whole_track_do_not_add_up() -> None:
    scene, tokenizer = straight_road(6, seed=40), tokenizer_of(size=200, radius=0.03)
    agents = scene.agents
    tracks = tokenizer.encode_tracks(agents.poses[:, 11:], agents.valid[:, 11:], agents.recent(5), agents.kind)
    error = (tracks.poses - agents.poses[:, 11:])[..., :2].norm(dim=-1)
    assert error[:, -5:].mean() < 0.5


def test_noise_takes_one_of_the_nearest_entries() -> None:
    tokenizer = tokenizer_of()
    token = torch.arange(tokenizer.vocab_size)
    kind = torch.full_like(token, int(VEHICLE))
    order = apart(tokenizer.motions[VEHICLE], tokenizer.motions[VEHICLE]).argsort(-1)[:, :5]
    for drawn in (0.0, 0.5, 0.999):
        near = tokenizer.neighbour(token, kind, torch.full((len(token), 2), drawn))
        assert (order == near[:, None]).any(-1).float().mean() > 0.9, "but for ties"


def test_noise_leaves_a_class_of_few_motions_for_one_of_its_others() -> None:
    few = torch.zeros(8, 5, 3)
    few[..., 0] = torch.arange(8)[:, None] * torch.linspace(0.2, 1, 5)
    few = few.repeat(5, 1, 1)  # as a class is filled up
    tokenizer = KDisksTokenizer.of(stacked({VEHICLE: few}))
    token = torch.arange(tokenizer.vocab_size)
    kind = torch.full_like(token, int(VEHICLE))
    moved = torch.zeros(len(token))
    for drawn in torch.linspace(0.1, 0.9, 5):  # each of the five nearest once
        near = tokenizer.neighbour(token, kind, drawn.expand(len(token), 2))
        moved += (apart(few[near], few[token]).diagonal() > 0).float()
    assert (moved == 4).all(), "one of five leaves a token as it is"


def test_a_single_motion_has_itself_for_a_neighbour() -> None:
    tokenizer = KDisksTokenizer.of(stacked({VEHICLE: MOTIONS[:1].repeat(6, 1, 1)}))
    near = tokenizer.neighbour(torch.zeros(3, dtype=torch.int64), torch.tensor([1, 1, 1]), torch.rand(3, 2))
    assert near.tolist() == [0, 0, 0]


# --- in a policy ----------------------------------------------------------------------------------------------------
def test_a_policy_brings_its_motions_in_its_weights() -> None:
    tokenizer = tokenizer_of()
    trained = MotionLM("nano", tokenizer)
    opened = MotionLM("nano", KDisksTokenizer(5, tokenizer.vocab_size, tokenizer.digest))
    opened.load_state_dict(trained.state_dict())
    assert torch.equal(opened.tokenizer.motions, tokenizer.motions)
    assert torch.equal(opened.tokenizer.points, tokenizer.points), "what follows from them is there as well"


def test_a_copy_takes_weights_as_well() -> None:
    tokenizer = tokenizer_of()
    again = copy.deepcopy(tokenizer)  # a collector's workers have copies, whose weights change
    again.load_state_dict(tokenizer.state_dict())
    assert torch.equal(again.points, tokenizer.points)


def test_a_file_settles_size_and_digest_and_another_one_is_refused(tmp_path: Path) -> None:
    first, other = tokenizer_of(), tokenizer_of(radius=0.2)
    for name, each in (("first", first), ("other", other)):
        write_vocabulary(tmp_path / f"{name}.npz", Vocabulary(each.motions, {}))
    settled = KDisksTokenizer.settled(table=str(tmp_path / "first.npz"))
    assert settled == {"steps": 5, "size": first.vocab_size, "digest": digest_of(first.motions)}
    assert KDisksTokenizer.settled(**settled) == settled
    fresh = KDisksTokenizer(**settled)
    with pytest.raises(ValueError, match=rf"holds the vocabulary {other.digest}, and {first.digest} is asked for"):
        fresh.fill(table=str(tmp_path / "other.npz"))
    fresh.fill(table=str(tmp_path / "first.npz"))
    assert torch.equal(fresh.motions, first.motions)
    with pytest.raises(ValueError, match="k_disks needs table=FILE.npz"):
        fresh.fill()


if __name__ == "__main__":
    pytest.main([__file__])
