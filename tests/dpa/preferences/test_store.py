"""The preference store: what goes in comes out, and nothing is lost, doubled or mixed."""

from __future__ import annotations

import dataclasses
import os
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest
import torch

from dpa.preferences import PreferenceStore, PreferenceWriter, StoreError, verify
from dpa.preferences.examples import example_groups, example_provenance
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
        assert torch.equal(back[key], groups[key]), key
    assert torch.equal(store.distance, groups[keys.DISTANCE])
    assert torch.equal(store.ade, groups[keys.ADE])
    assert torch.equal(store.ranked_agents(), groups[keys.AGENT_RANKED].sum(-1))


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


def test_tokens_take_one_byte_where_the_vocabulary_allows(tmp_path: Path) -> None:
    written(tmp_path / "small")
    with PreferenceWriter(tmp_path / "large", dataclasses.replace(example_provenance(), vocab_size=2048)) as writer:
        writer.append(example_groups(5))
    kinds = [np.load(next((tmp_path / name).glob("chunk-*")) / "tokens.npy").dtype for name in ("small", "large")]
    assert kinds == [np.uint8, np.int16]


def test_what_is_read_does_not_reach_the_disk(tmp_path: Path) -> None:
    store = written(tmp_path)
    store[:][keys.TOKENS].zero_()
    store.distance.zero_()
    assert torch.equal(PreferenceStore(tmp_path)[:][keys.TOKENS], example_groups(5)[keys.TOKENS])
    assert verify(tmp_path) == []


def test_a_store_grows_over_several_runs_without_doubling(tmp_path: Path) -> None:
    written(tmp_path, scenes=3)
    with PreferenceWriter(tmp_path, example_provenance(), chunk_scenes=2) as writer:
        assert writer.scenes_done == {0, 1, 2}
        with pytest.raises(StoreError, match=r"scenes \[2\] would be stored twice"):
            writer.append(example_groups(2, first=2))
        writer.append(example_groups(2, first=3))
        with pytest.raises(StoreError, match="twice"):
            writer.append(example_groups(1, first=4))
    assert PreferenceStore(tmp_path).scenes.tolist() == [0, 1, 2, 3, 4]


def test_a_killed_writer_loses_only_the_chunk_in_progress(tmp_path: Path) -> None:
    script = f"""
        import os, signal
        import dpa.preferences.writer as module
        from dpa.preferences.examples import example_groups, example_provenance

        writer = module.PreferenceWriter({str(tmp_path)!r}, example_provenance(), chunk_scenes=2)
        writer.append(example_groups(4))
        module.checksum = lambda path: os.kill(os.getpid(), signal.SIGKILL)  # dies with the arrays of a chunk written
        writer.append(example_groups(2, first=4))
    """
    ended = subprocess.run([sys.executable, "-c", textwrap.dedent(script)], check=False, env=os.environ)
    assert ended.returncode == -signal.SIGKILL
    assert PreferenceStore(tmp_path).scenes.tolist() == [0, 1, 2, 3]
    assert list(tmp_path.glob(".unfinished-*"))
    with PreferenceWriter(tmp_path, example_provenance(), chunk_scenes=2) as writer:
        assert writer.scenes_done == {0, 1, 2, 3}
        writer.append(example_groups(2, first=4))
    assert PreferenceStore(tmp_path).scenes.tolist() == [0, 1, 2, 3, 4, 5]
    assert not list(tmp_path.glob(".unfinished-*"))
    assert verify(tmp_path) == []


def test_a_full_disk_leaves_whole_chunks_and_the_writer_can_go_on(tmp_path: Path, monkeypatch) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError("No space left on device")

    with PreferenceWriter(tmp_path, example_provenance(), chunk_scenes=2) as writer:
        with monkeypatch.context() as patch:
            patch.setattr(np, "save", full)
            with pytest.raises(OSError, match="No space"):
                writer.append(example_groups(2))
        assert writer.scenes_done == frozenset()
    assert PreferenceStore(tmp_path).scenes.tolist() == [0, 1]
    assert verify(tmp_path) == []


def test_groups_of_another_origin_are_refused_naming_what_differs(tmp_path: Path) -> None:
    written(tmp_path)
    other = dataclasses.replace(example_provenance(), policy="abc", seed=7)
    with pytest.raises(StoreError, match=r"policy \('none' there, 'abc' now\); seed \(0 there, 7 now\)"):
        PreferenceWriter(tmp_path, other)
    PreferenceWriter(tmp_path, example_provenance()).close()


def test_two_writers_at_once_are_refused(tmp_path: Path) -> None:
    with PreferenceWriter(tmp_path, example_provenance()), pytest.raises(StoreError, match="another process"):
        PreferenceWriter(tmp_path, example_provenance())


def test_a_folder_with_other_things_is_refused(tmp_path: Path) -> None:
    (tmp_path / "photos.txt").write_text("mine")
    with pytest.raises(StoreError, match="photos"):
        PreferenceWriter(tmp_path, example_provenance())
    with pytest.raises(StoreError, match="no preference store"):
        PreferenceStore(tmp_path)


@pytest.mark.parametrize("text", ["", "[]", '{"format": 99}', '{"format": 1, "policy": "x"}'])
def test_metadata_that_cannot_be_read_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "metadata.json").write_text(text)
    with pytest.raises(StoreError, match=r"metadata\.json"):
        PreferenceStore(tmp_path)


def test_groups_that_do_not_fit_are_refused_and_nothing_is_taken(tmp_path: Path) -> None:
    with PreferenceWriter(tmp_path, example_provenance()) as writer:
        with pytest.raises(StoreError, match="8 rollouts .* got 6"):
            writer.append(example_groups(2, num_rollouts=6))
        groups = example_groups(2)
        groups[keys.TOKENS][0, 0, 0, 0] = 169
        with pytest.raises(StoreError, match="to 169 are outside the vocabulary of 169"):
            writer.append(groups)
        groups = example_groups(2)
        groups[keys.DISTANCE][1, 0] = torch.nan
        with pytest.raises(StoreError, match="scene 1 has a distance that is not finite"):
            writer.append(groups)
    assert len(PreferenceStore(tmp_path)) == 0


def test_tokens_of_agents_that_do_not_act_are_stored_as_zero(tmp_path: Path) -> None:
    groups = example_groups(1)
    groups[keys.TOKENS][:, :, 3] = -1
    with PreferenceWriter(tmp_path, example_provenance()) as writer:
        writer.append(groups)
    assert PreferenceStore(tmp_path).read([0], num_agents=4)[keys.TOKENS][:, :, 3].eq(0).all()


def test_verify_finds_a_flipped_byte_a_missing_file_and_a_copied_chunk(tmp_path: Path) -> None:
    written(tmp_path, scenes=8)
    chunks = sorted(tmp_path.glob("chunk-*"))
    data = bytearray((chunks[0] / "tokens.npy").read_bytes())
    data[-1] ^= 1
    (chunks[0] / "tokens.npy").write_bytes(data)
    (chunks[1] / "ade.npy").unlink()
    chunks[3].rename(tmp_path / "aside")
    (tmp_path / chunks[3].name).mkdir()
    for file in chunks[2].iterdir():
        (tmp_path / chunks[3].name / file.name).write_bytes(file.read_bytes())
    problems = verify(tmp_path)
    assert len(problems) == 4
    assert "chunk-00000000: tokens.npy does not match" in problems[0]
    assert "chunk-00000001: ade.npy is missing" in problems[1]
    assert "scene 4 is in chunk-00000002 too" in problems[2]
    with pytest.raises(StoreError, match=r"chunk-00000001 is damaged"):
        PreferenceStore(tmp_path)
