"""The preference store: what goes in comes out, small, and nothing is mixed or silently damaged."""

from __future__ import annotations

import dataclasses
import json
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from tensordict import TensorDict

from dpa.preferences import PreferenceStore, PreferenceWriter, StoreError, verify
from dpa.preferences.chunk import PackedGroup, chunk_content, chunk_name, read_record
from dpa.preferences.codec import decode, encode
from dpa.preferences.examples import example_groups, example_provenance
from dpa.preferences.group import NUMBERS, Group, group_shapes, take_groups
from dpa.preferences.provenance import TokenLayout
from dpa.ranking.distance import rank_of
from envs import keys


def written(folder: Path, *, scenes: int = 5, chunk: int = 2) -> PreferenceStore:
    with PreferenceWriter(folder, example_provenance(), chunk_scenes=chunk) as writer:
        writer.append(example_groups(scenes))
    return PreferenceStore(folder)


def test_groups_come_back_as_they_were(tmp_path: Path) -> None:
    store, groups = written(tmp_path), example_groups(5)
    assert len(store) == 5
    assert store.scenes.tolist() == [0, 1, 2, 3, 4]
    back = store[:]
    assert set(back.keys()) == set(groups.keys())
    for key in groups.keys():
        assert back[key].dtype == groups[key].dtype and torch.equal(back[key], groups[key]), key
    assert torch.equal(store.distance, groups[keys.DISTANCE])
    assert torch.equal(store.ade, groups[keys.ADE])


def test_any_selection_is_padded_to_its_largest_group(tmp_path: Path) -> None:
    store, groups = written(tmp_path), example_groups(5)
    assert store.num_agents.tolist() == [2, 3, 4, 2, 3]
    some = store[torch.tensor([4, 0])]
    assert torch.equal(some[keys.TOKENS], groups[keys.TOKENS][[4, 0]][:, :, :3])
    assert store[3][keys.AGENT_RANKED].shape == (1, 2)
    assert torch.equal(store[-1][keys.DISTANCE], groups[keys.DISTANCE][4:])
    wide = store.read([0], num_agents=6)
    assert wide[keys.AGENT_DISTANCE].shape == (1, 8, 6)
    assert not wide[keys.TOKEN_VALID][:, 2:].any()
    with pytest.raises(ValueError, match="at least 4"):
        store.read([2], num_agents=3)
    with pytest.raises(IndexError, match="group 5"):
        store[5]


def test_a_large_vocabulary_comes_back_too(tmp_path: Path) -> None:
    groups = example_groups(2)
    groups[keys.TOKENS] += 1000 * groups[keys.TOKEN_VALID][:, None]
    with PreferenceWriter(tmp_path, dataclasses.replace(example_provenance(), vocab_size=2048)) as writer:
        writer.append(groups)
    assert torch.equal(PreferenceStore(tmp_path).read([0, 1], num_agents=4)[keys.TOKENS], groups[keys.TOKENS])


def paper_group(tokens: torch.Tensor) -> TensorDict:
    """One scene of 64 rollouts x 32 agents x 16 decisions, whose numbers share no bits; tokens ``[1, 64, 32, 16]``."""
    generator = torch.Generator().manual_seed(0)
    agent_distance = 5 * torch.rand(1, 64, 32, generator=generator)
    return TensorDict(
        {
            keys.SCENE: torch.tensor([7]),
            keys.TOKENS: tokens,
            keys.TOKEN_VALID: torch.ones(1, 32, 16, dtype=torch.bool),
            keys.DISTANCE: agent_distance.sum(-1),
            keys.AGENT_DISTANCE: agent_distance,
            keys.ADE: torch.rand(1, 64, generator=generator),
            keys.AGENT_RANKED: torch.ones(1, 32, dtype=torch.bool),
            keys.AGENT_KIND: torch.ones(1, 32, dtype=torch.int64),
            keys.FEATURE_SHARE: torch.rand(1, 64, 5, generator=generator),
            keys.RANK: rank_of(agent_distance.sum(-1)),
        },
        batch_size=[1],
    )


def test_a_group_of_the_papers_size_takes_at_most_40_kb_even_with_random_tokens(tmp_path: Path) -> None:
    groups = paper_group(torch.randint(169, (1, 64, 32, 16), generator=torch.Generator().manual_seed(1)))
    ranking = {"weights": dict.fromkeys("abcde", 1.0)}
    origin = dataclasses.replace(example_provenance(num_rollouts=64), ranking=ranking)
    with PreferenceWriter(tmp_path, origin) as writer:
        writer.append(groups)
    store = PreferenceStore(tmp_path)
    assert store.num_bytes <= 40_000
    for key in groups.keys():
        assert torch.equal(store[0][key], groups[key]), key


@settings(max_examples=40, deadline=None)
@given(
    data=st.data(),
    agents=st.integers(0, 4),
    rollouts=st.integers(1, 5),
    decisions=st.integers(1, 4),
    shares=st.integers(0, 3),
    layout=st.sampled_from([TokenLayout(np.int16), TokenLayout(np.float32, (6,))]),
)
def test_any_group_comes_back_to_the_last_bit(
    data, agents: int, rollouts: int, decisions: int, shares: int, layout: TokenLayout
) -> None:
    def array(name: str, dtype: type, most: int) -> np.ndarray:
        return data.draw(arrays(dtype, shapes[name], elements=st.integers(0, most)), label=name)

    shapes = group_shapes(agents, rollouts, decisions, shares, layout.shape)
    bits = {name: array(name, np.uint32, 2**32 - 1).view(np.float32) for name in NUMBERS}
    whole = {
        "tokens": array("tokens", np.int16, 2047).astype(layout.dtype),
        "agent_kind": array("agent_kind", np.uint8, 4),
    }
    flags = {name: array(name, np.uint8, 1).astype(bool) for name in ("token_valid", "agent_ranked")}
    group = Group(data.draw(st.integers(0, 2**62)), **bits, **whole, **flags)
    back = decode(encode(group, layout), layout)
    assert back.scene == group.scene
    for name in shapes:
        mine, theirs = getattr(back, name), getattr(group, name)
        assert mine.dtype == theirs.dtype and mine.shape == theirs.shape and mine.tobytes() == theirs.tobytes(), name


def test_what_is_read_does_not_reach_the_disk(tmp_path: Path) -> None:
    store = written(tmp_path)
    store[:][keys.TOKENS].zero_()
    store.distance.zero_()
    assert torch.equal(PreferenceStore(tmp_path)[:][keys.TOKENS], example_groups(5)[keys.TOKENS])
    assert verify(tmp_path) == []


def test_groups_of_another_origin_are_refused_naming_what_differs(tmp_path: Path) -> None:
    written(tmp_path)
    other = dataclasses.replace(example_provenance(), policy="abc", seed=7)
    with pytest.raises(StoreError, match=r"policy \('none' there, 'abc' now\); seed \(0 there, 7 now\)"):
        PreferenceWriter(tmp_path, other)
    PreferenceWriter(tmp_path, example_provenance()).close()


def test_a_folder_with_other_things_is_refused(tmp_path: Path) -> None:
    (tmp_path / "photos.txt").write_text("mine")
    with pytest.raises(StoreError, match="photos"):
        PreferenceWriter(tmp_path, example_provenance())
    with pytest.raises(StoreError, match="no preference store"):
        PreferenceStore(tmp_path)


@pytest.mark.parametrize(
    "text",
    ["", "[]", "[" * 100_000, '{"format": 99}', '{"format": 1}', '{"format": 2, "policy": "x"}', " " * (1 << 21)],
)
def test_metadata_that_cannot_be_read_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "metadata.json").write_text(text)
    with pytest.raises(StoreError, match=r"metadata\.json"):
        PreferenceStore(tmp_path)


def test_tokens_of_agents_that_do_not_act_are_stored_as_zero(tmp_path: Path) -> None:
    groups = example_groups(1)
    groups[keys.TOKENS][:, :, 3] = -1
    with PreferenceWriter(tmp_path, example_provenance()) as writer:
        writer.append(groups)
    assert PreferenceStore(tmp_path).read([0], num_agents=4)[keys.TOKENS][:, :, 3].eq(0).all()


def test_groups_lie_in_the_order_of_their_scenes_whoever_wrote_them_when(tmp_path: Path) -> None:
    groups = example_groups(7)
    for rows in ([5, 1], [6, 0, 3], [2, 4]):
        with PreferenceWriter(tmp_path, example_provenance()) as writer:
            writer.append(groups[rows])
    store = PreferenceStore(tmp_path)
    assert store.scenes.tolist() == list(range(7))
    assert torch.equal(store[:][keys.TOKENS], groups[keys.TOKENS])
    assert torch.equal(store.distance, groups[keys.DISTANCE])


def test_a_store_without_feature_shares_gives_none(tmp_path: Path) -> None:
    groups = example_groups(2)
    groups[keys.FEATURE_SHARE] = torch.empty(2, 8, 0)
    with PreferenceWriter(tmp_path, example_provenance()) as writer:
        writer.append(groups)
    assert PreferenceStore(tmp_path)[:][keys.FEATURE_SHARE].shape == (2, 8, 0)
    with (
        PreferenceWriter(tmp_path, example_provenance()) as writer,
        pytest.raises(StoreError, match="2 features where .0"),
    ):
        writer.append(example_groups(1, first=2))


def nan_distance(groups: TensorDict) -> None:
    groups[keys.DISTANCE][1, 0] = torch.nan


def infinite_share(groups: TensorDict) -> None:
    groups[keys.FEATURE_SHARE][1, 0] = torch.inf


def token_beyond(groups: TensorDict) -> None:
    groups[keys.TOKENS][0, 0, 0, 0] = 169


def token_below(groups: TensorDict) -> None:
    groups[keys.TOKENS][0, 0, 0, 0] = -1


def distance_of_an_unranked_agent(groups: TensorDict) -> None:
    groups[keys.AGENT_RANKED][1, 0] = False


def class_that_is_none(groups: TensorDict) -> None:
    groups[keys.AGENT_KIND][1, 0] = 9


def negative_scene(groups: TensorDict) -> None:
    groups[keys.SCENE][0] = -3


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (nan_distance, "scene 1: distance is not finite"),
        (infinite_share, "scene 1: feature_share is not finite"),
        (token_beyond, "to 169 are outside the vocabulary of 169"),
        (token_below, "tokens from -1"),
        (distance_of_an_unranked_agent, "scene 1: an agent that took no part"),
        (class_that_is_none, "scene 1: 9 is no class"),
        (negative_scene, "scene -3"),
    ],
)
def test_groups_that_cannot_be_right_are_refused_and_nothing_is_taken(
    tmp_path: Path, spoil: Callable[[TensorDict], None], message: str
) -> None:
    groups = example_groups(2)
    spoil(groups)
    with PreferenceWriter(tmp_path, example_provenance()) as writer, pytest.raises(StoreError, match=message):
        writer.append(groups)
    assert len(PreferenceStore(tmp_path)) == 0


def test_groups_of_another_size_are_refused(tmp_path: Path) -> None:
    writer = PreferenceWriter(tmp_path, example_provenance())
    with pytest.raises(StoreError, match="8 rollouts of 16 decisions, got 6 of 16"):
        writer.append(example_groups(2, num_rollouts=6))


# --- damage ---------------------------------------------------------------------------------------------------------
def one_chunk(folder: Path, scenes: int = 6) -> Path:
    written(folder, scenes=scenes, chunk=scenes)
    (chunk,) = folder.glob("chunk-*")
    return chunk


def test_reading_a_group_needs_no_other_block_of_its_chunk(tmp_path: Path) -> None:
    chunk = one_chunk(tmp_path)
    record = read_record(chunk, example_provenance())
    content = bytearray(chunk.read_bytes())
    for row in (0, 1, 2, 4, 5):
        start = record.offsets[row]
        content[start : start + record.sizes[row]] = bytes(record.sizes[row])
    chunk.write_bytes(content)
    store = PreferenceStore(tmp_path)
    assert torch.equal(store[3][keys.TOKENS], example_groups(6)[keys.TOKENS][3:4, :, :2])
    with pytest.raises(StoreError, match=r"chunk-.*\.groups, scene 2 is damaged .* collect again"):
        store[2]


def test_every_byte_that_is_flipped_is_found(tmp_path: Path) -> None:
    chunk = one_chunk(tmp_path, scenes=2)
    whole, groups = chunk.read_bytes(), example_groups(2)
    for place in range(0, len(whole), 7):
        chunk.write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
        (problem,) = verify(tmp_path)
        assert chunk.name in problem and "collect again" in problem
        if place < 8:  # the first magic, which reading does not need
            back = PreferenceStore(tmp_path).read([0, 1], num_agents=4)
            assert all(torch.equal(back[key], groups[key]) for key in groups.keys())
        else:
            with pytest.raises(StoreError, match=chunk.name):
                PreferenceStore(tmp_path)[:]


def test_a_cut_file_is_one_error_wherever_it_is_cut(tmp_path: Path) -> None:
    chunk = one_chunk(tmp_path)
    whole = chunk.read_bytes()
    for length in (0, 1, 8, 15, 16, 100, len(whole) // 2, len(whole) - 16, len(whole) - 1):
        chunk.write_bytes(whole[:length])
        with pytest.raises(StoreError, match=r"chunk-.* is damaged .* delete it and collect again"):
            PreferenceStore(tmp_path)
        with pytest.raises(StoreError, match="is damaged"):
            PreferenceWriter(tmp_path, example_provenance())
        assert len(verify(tmp_path)) == 1


def with_record(chunk: Path, change: Callable[[dict], None]) -> None:
    """The same chunk with another record and its right name."""
    content = chunk.read_bytes()
    magic = content[-8:]
    (length,) = struct.unpack("<Q", content[-16:-8])
    record = json.loads(zstandard.ZstdDecompressor().decompress(content[-16 - length : -16]))
    change(record)
    packed = zstandard.ZstdCompressor().compress(json.dumps(record).encode())
    content = content[: -16 - length] + packed + struct.pack("<Q", len(packed)) + magic
    chunk.unlink()
    (chunk.parent / chunk_name(content)).write_bytes(content)


@pytest.mark.parametrize(
    "change",
    [
        lambda record: record.clear(),
        lambda record: record.update(sizes=[2**62] * 6),
        lambda record: record.update(sizes=record["sizes"][:5]),
        lambda record: record.update(scenes=["0"] * 6),
        lambda record: record.update(num_agents=[-1] * 6),
        lambda record: record.update(more=1),
        lambda record: record.update(scenes=[], sizes=[], num_agents=[]),
        lambda record: record.update(origin="x" * (1 << 24)),
    ],
)
def test_a_record_that_cannot_be_is_refused(tmp_path: Path, change: Callable[[dict], None]) -> None:
    with_record(one_chunk(tmp_path), change)
    with pytest.raises(StoreError, match=r"chunk-.* is damaged"):
        PreferenceStore(tmp_path)
    assert len(verify(tmp_path)) == 1


@pytest.mark.parametrize(
    "change",
    [
        lambda record: record.update(scenes=[0, 1, 2, 3, 4, 6]),
        lambda record: record.update(num_agents=[record["num_agents"][0] + 1, *record["num_agents"][1:]]),
        lambda record: record.update(num_features=7),
    ],
)
def test_a_record_that_does_not_fit_its_groups_is_told_when_they_are_read(
    tmp_path: Path, change: Callable[[dict], None]
) -> None:
    with_record(one_chunk(tmp_path), change)
    with pytest.raises(StoreError, match="is damaged"):
        PreferenceStore(tmp_path)[:]
    assert len(verify(tmp_path)) == 1


def test_sizes_that_a_block_declares_do_not_claim_memory() -> None:
    (group,) = take_groups(example_groups(1), example_provenance())
    data = bytearray(zstandard.ZstdDecompressor().decompress(encode(group)))
    data[8:24] = struct.pack("<4I", *[2**32 - 1] * 4)
    with pytest.raises(StoreError, match="bytes where the header asks for"):
        decode(zstandard.ZstdCompressor().compress(bytes(data)))
    with pytest.raises(StoreError, match="at most"):
        decode(zstandard.ZstdCompressor().compress(bytes(1 << 29)))
    with pytest.raises(StoreError, match="shorter than a header"):
        decode(zstandard.ZstdCompressor().compress(b"x"))
    with pytest.raises(StoreError, match="does not fit its checksum"):
        decode(b"nothing of ours")


def test_a_chunk_of_another_store_is_told(tmp_path: Path) -> None:
    chunk = one_chunk(tmp_path / "mine")
    other = dataclasses.replace(example_provenance(), scenes="others")
    with PreferenceWriter(tmp_path / "other", other):
        pass
    (tmp_path / "other" / chunk.name).write_bytes(chunk.read_bytes())
    with pytest.raises(StoreError, match=f"{chunk.name} belongs to another store; move it out"):
        PreferenceStore(tmp_path / "other")
    assert len(verify(tmp_path / "other")) == 1


def test_a_scene_that_is_there_twice_is_told(tmp_path: Path) -> None:
    chunk, origin = one_chunk(tmp_path), example_provenance()
    (group,) = take_groups(example_groups(6)[3:4], origin)
    packed = PackedGroup(group.scene, len(group.tokens), group.feature_share.shape[-1], encode(group))
    content = chunk_content([packed], origin)
    (tmp_path / chunk_name(content)).write_bytes(content)
    with pytest.raises(StoreError, match=f"scene 3 is in .*{chunk.name}.*; delete one of the two"):
        PreferenceStore(tmp_path)
    assert "scene 3 is in" in verify(tmp_path)[0]


def test_verify_looks_at_values_too(tmp_path: Path) -> None:
    """A group that a writer would refuse, with all its checksums right."""
    with PreferenceWriter(tmp_path, example_provenance()):
        pass
    (group,) = take_groups(example_groups(1), example_provenance())
    group.tokens[0, 0, 0] = 200
    content = chunk_content([PackedGroup(0, len(group.tokens), 2, encode(group))], example_provenance())
    (tmp_path / chunk_name(content)).write_bytes(content)
    (problem,) = verify(tmp_path)
    assert "scene 0: tokens from 1 to 200 are outside the vocabulary of 169" in problem
