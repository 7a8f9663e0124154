"""A preference store in a TorchRL replay buffer."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torchrl.data import ReplayBuffer
from torchrl.data.replay_buffers.samplers import RandomSampler, SamplerWithoutReplacement

from dpa.preferences import PreferenceStorage, PreferenceStore, PreferenceWriter, StoreError
from dpa.preferences.examples import example_groups, example_provenance
from envs import keys


@pytest.fixture
def store(tmp_path: Path) -> PreferenceStore:
    with PreferenceWriter(tmp_path, example_provenance(), chunk_scenes=3) as writer:
        writer.append(example_groups(10))
    return PreferenceStore(tmp_path)


def buffer_of(store: PreferenceStore, **options: object) -> ReplayBuffer:
    storage = PreferenceStorage(store, options.pop("num_agents", None))
    return ReplayBuffer(storage=storage, collate_fn=PreferenceStorage.collate, **options)


@pytest.mark.parametrize("prefetch", [None, 2])
@pytest.mark.parametrize("sampler", [RandomSampler, SamplerWithoutReplacement])
def test_samples_are_what_the_store_reads(store: PreferenceStore, prefetch: int | None, sampler: type) -> None:
    buffer = buffer_of(store, sampler=sampler(), batch_size=5, prefetch=prefetch)
    assert len(buffer) == 10
    for _ in range(8):
        sample = buffer.sample()
        assert sample.batch_size == (5,)
        want = store.read(sample[keys.SCENE])
        assert set(want.keys()) == set(sample.keys())
        for key in want.keys():
            assert torch.equal(sample[key], want[key]), key


def test_an_epoch_without_replacement_gives_every_scene_once(store: PreferenceStore) -> None:
    buffer = buffer_of(store, sampler=SamplerWithoutReplacement(), batch_size=5, prefetch=2)
    for _ in range(3):
        assert sorted(buffer.sample()[keys.SCENE].tolist() + buffer.sample()[keys.SCENE].tolist()) == list(range(10))


def test_samples_of_one_shape_where_it_is_asked_for(store: PreferenceStore) -> None:
    buffer = buffer_of(store, batch_size=2, num_agents=6)
    assert {tuple(buffer.sample()[keys.TOKENS].shape) for _ in range(6)} == {(2, 8, 6, 16)}
    with pytest.raises(ValueError, match="at least 4, the largest group"):
        PreferenceStorage(store, num_agents=3)


def test_a_buffer_is_indexed_like_the_store(store: PreferenceStore) -> None:
    buffer = buffer_of(store, batch_size=2)
    assert buffer[3].batch_size == () and int(buffer[3][keys.SCENE]) == 3
    for index in ([1, 7], slice(2, 9, 3), torch.tensor([5])):
        assert torch.equal(buffer[index][keys.TOKENS], store[index][keys.TOKENS])


def test_everything_that_writes_is_refused(store: PreferenceStore) -> None:
    buffer = buffer_of(store, batch_size=2)
    sample = buffer.sample()
    for write in (
        lambda: buffer.add(sample[0]),
        lambda: buffer.extend(sample),
        lambda: buffer.empty(),
        lambda: buffer.__setitem__(0, sample[0]),
    ):
        with pytest.raises(StoreError, match="is read-only in a replay buffer; append with a PreferenceWriter"):
            write()
    sample[keys.TOKENS].zero_()
    assert store[:][keys.TOKENS].any(), "a sample is a copy"


def test_a_buffers_state_goes_on_with_the_same_store_only(store: PreferenceStore, tmp_path: Path) -> None:
    state = buffer_of(store, batch_size=2).state_dict()
    buffer_of(store, batch_size=2).load_state_dict(state)
    with PreferenceWriter(tmp_path, example_provenance()) as writer:
        writer.append(example_groups(11)[10:])
    with pytest.raises(StoreError, match="open the store that it was saved with"):
        buffer_of(PreferenceStore(tmp_path), batch_size=2).load_state_dict(state)


def test_an_empty_store_is_refused(tmp_path: Path) -> None:
    PreferenceWriter(tmp_path / "empty", example_provenance()).close()
    with pytest.raises(ValueError, match="holds no scene yet"):
        PreferenceStorage(PreferenceStore(tmp_path / "empty"))
