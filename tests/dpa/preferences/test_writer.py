"""Writers of a preference store: several at once, killed at any moment, and none of them breaks or doubles anything."""

from __future__ import annotations

import dataclasses
import itertools
import multiprocessing
import os
import random
import signal
import time
from multiprocessing.synchronize import Event
from pathlib import Path

import pytest
import torch

from dpa.preferences import PreferenceStore, PreferenceWriter, StoreError, verify
from dpa.preferences import writer as module
from dpa.preferences.examples import example_groups, example_provenance
from envs import keys

NUM_SCENES = 48
PROCESSES = multiprocessing.get_context("forkserver")
PROCESSES.set_forkserver_preload(["dpa.preferences.writer", "dpa.preferences.examples"])


def append(folder: Path, scenes: range, chunk: int, begun: Event, start: Event) -> None:
    """Appends scenes one by one, those that the store lacks, once it is told to start."""
    groups = example_groups(NUM_SCENES)
    begun.set()
    with PreferenceWriter(folder, example_provenance(), chunk_scenes=chunk) as writer:
        start.wait()
        for scene in scenes:
            if scene not in writer.scenes_done:
                writer.append(groups[scene : scene + 1])


def append_and_die(folder: Path) -> None:
    """Dies with the third chunk written, and not yet in place."""
    groups = example_groups(NUM_SCENES)
    writer = PreferenceWriter(folder, example_provenance(), chunk_scenes=2)
    writer.append(groups[:4])
    module.os.replace = lambda *_: os.kill(os.getpid(), signal.SIGKILL)
    writer.append(groups[4:6])


class Appending:
    """A process that appends scenes."""

    def __init__(self, folder: Path, scenes: range = range(NUM_SCENES), chunk: int = 2) -> None:
        self.begun, self.start = PROCESSES.Event(), PROCESSES.Event()
        self.process = PROCESSES.Process(
            target=append, args=(folder, scenes, chunk, self.begun, self.start), daemon=True
        )
        self.process.start()

    def end(self) -> None:
        """Let it start, and wait until it is done."""
        self.start.set()
        self.process.join(60)
        assert self.process.exitcode == 0

    def kill(self, after: float) -> bool:
        """Let it start, kill it, and say whether it was still at work."""
        self.start.set()
        self.begun.wait(60)
        time.sleep(after)
        self.process.kill()
        self.process.join()
        return self.process.exitcode == -signal.SIGKILL


def assert_whole(folder: Path) -> None:
    """Every scene once, to the last bit, and nothing left over."""
    store, groups = PreferenceStore(folder), example_groups(NUM_SCENES)
    assert store.scenes.tolist() == list(range(NUM_SCENES))
    back = store[:]
    for key in groups.keys():
        assert torch.equal(back[key], groups[key]), key
    assert verify(folder) == []
    assert not list(folder.glob(".partial-*"))


def test_a_store_grows_over_several_runs_and_keeps_each_scene_once(tmp_path: Path) -> None:
    groups = example_groups(5)
    with PreferenceWriter(tmp_path, example_provenance(), chunk_scenes=2) as writer:
        assert writer.append(groups[:3]) == 3
    with PreferenceWriter(tmp_path, example_provenance(), chunk_scenes=2) as writer:
        assert writer.scenes_done == {0, 1, 2}
        assert writer.append(groups[2:4]) == 1
        assert writer.append(groups[[4, 4, 3]]) == 1
    assert torch.equal(PreferenceStore(tmp_path)[:][keys.TOKENS], groups[keys.TOKENS])
    assert verify(tmp_path) == []


def test_options_written_as_1_and_as_1_0_fill_one_store(tmp_path: Path) -> None:
    groups = example_groups(4)
    for top_p, some in ((1.0, groups[:2]), (1, groups[2:])):
        origin = dataclasses.replace(example_provenance(), sampling={"top_p": top_p})
        with PreferenceWriter(tmp_path, origin) as writer:
            writer.append(some)
    assert PreferenceStore(tmp_path).scenes.tolist() == [0, 1, 2, 3]


def test_groups_are_asked_for_by_position_alone_or_by_a_mask(tmp_path: Path) -> None:
    with PreferenceWriter(tmp_path, example_provenance()) as writer:
        writer.append(example_groups(4))
    store = PreferenceStore(tmp_path)
    assert store[store.scenes >= 2][keys.SCENE].tolist() == [2, 3]
    assert store[torch.tensor(1)][keys.SCENE].tolist() == store[store.scenes.numpy()[1]][keys.SCENE].tolist() == [1]
    with pytest.raises(IndexError, match=r"one value for each of 4, got shape \(2,\)"):
        store[torch.tensor([True, False])]


def test_of_two_open_writers_the_first_to_store_a_scene_wins(tmp_path: Path) -> None:
    mine, theirs = example_groups(2), example_groups(2)
    theirs[keys.ADE] += 1
    first, second = (PreferenceWriter(tmp_path, example_provenance()) for _ in range(2))
    assert (first.append(mine), second.append(theirs[1:])) == (2, 1)
    second.close()
    assert first.scenes_done == frozenset(), "as of its last look"
    first.close()
    assert first.scenes_done == {0, 1}
    assert torch.equal(PreferenceStore(tmp_path).ade, torch.stack((mine[keys.ADE][0], theirs[keys.ADE][1])))
    assert len(list(tmp_path.glob("chunk-*"))) == 2


@pytest.mark.slow
def test_four_processes_that_append_overlapping_scenes_store_each_once(tmp_path: Path) -> None:
    ranges = (range(30), range(10, 40), range(20, 48), range(47, -1, -1))
    writers = [Appending(tmp_path, scenes, chunk) for chunk, scenes in enumerate(ranges, start=1)]
    for writer in writers:
        writer.start.set()
    for writer in writers:
        writer.end()
    assert_whole(tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("kills", [4, 50])
def test_writers_killed_at_random_moments_leave_what_one_that_lives_leaves(tmp_path: Path, kills: int) -> None:
    """One of two writers at a time is killed; a store that is full before there were enough kills is begun anew."""
    folders = (tmp_path / str(number) for number in itertools.count())
    draw, killed, folder, found, before, longest = random.Random(0), 0, next(folders), set(), 0, 0.1
    while killed < kills or len(found) < 2:  # kills come at different moments
        other = Appending(folder, range(NUM_SCENES - 2, NUM_SCENES), chunk=1)
        killed += Appending(folder, chunk=1).kill(after=draw.uniform(0, longest))
        other.end()
        assert verify(folder) == []
        held = len(PreferenceStore(folder))
        longest = 0.1 if held > before else 2 * longest  # a slow disk needs longer for a chunk
        found.add(held)
        before = held
        if held == NUM_SCENES:
            assert_whole(folder)
            folder, before = next(folders), 0
    Appending(folder).end()
    assert_whole(folder)


def test_a_writer_killed_while_it_writes_a_chunk_loses_that_chunk_only(tmp_path: Path) -> None:
    victim = PROCESSES.Process(target=append_and_die, args=(tmp_path,))
    victim.start()
    victim.join(60)
    assert victim.exitcode == -signal.SIGKILL
    assert PreferenceStore(tmp_path).scenes.tolist() == [0, 1, 2, 3]
    assert list(tmp_path.glob(".partial-*"))
    Appending(tmp_path).end()
    assert_whole(tmp_path)


def test_leftovers_of_the_dead_go_and_files_of_the_living_stay(tmp_path: Path) -> None:
    """A file in progress exists only while its writer holds the lock, so nobody else gets to look at it."""
    PreferenceWriter(tmp_path, example_provenance()).close()
    (tmp_path / ".partial-of-the-dead").write_bytes(b"half a chunk")
    with module._locked(tmp_path), module._new_file(tmp_path) as living:
        assert not (tmp_path / ".partial-of-the-dead").exists()
        other = Appending(tmp_path)
        other.start.set()
        other.process.join(1)
        assert other.process.is_alive() and Path(living.name).exists(), "it waits for the lock"
    other.end()
    assert_whole(tmp_path)


def test_a_lock_that_is_never_let_go_ends_in_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "LOCK_SECONDS", 0.05)
    with PreferenceWriter(tmp_path, example_provenance()) as writer:
        writer.append(example_groups(1))
        with module._locked(tmp_path), pytest.raises(StoreError, match="held by another writer for 0.05 s"):
            writer.close()
    assert len(PreferenceStore(tmp_path)) == 1


def test_a_file_system_without_locks_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def unknown(*_: object) -> None:
        raise OSError(95, "Operation not supported")

    monkeypatch.setattr(module.fcntl, "flock", unknown)
    with pytest.raises(
        StoreError, match="cannot be locked .Operation not supported.; write to a file system that knows"
    ):
        PreferenceWriter(tmp_path, example_provenance())


def test_a_full_disk_leaves_whole_chunks_and_the_writer_can_go_on(tmp_path: Path, monkeypatch) -> None:
    def full(*_: object) -> None:
        raise OSError("No space left on device")

    with PreferenceWriter(tmp_path, example_provenance(), chunk_scenes=2) as writer:
        with monkeypatch.context() as patch:
            patch.setattr(module.os, "fsync", full)
            with pytest.raises(OSError, match="No space"):
                writer.append(example_groups(2))
        assert writer.scenes_done == frozenset()
        assert not list(tmp_path.glob(".partial-*")) and not list(tmp_path.glob("chunk-*"))
    assert PreferenceStore(tmp_path).scenes.tolist() == [0, 1]
    assert verify(tmp_path) == []


def test_writers_of_two_origins_that_begin_one_folder_do_not_mix(tmp_path: Path) -> None:
    PreferenceWriter(tmp_path, example_provenance()).close()
    ranking = {"weights": {"effort": 1.0, "speed": 1.0}, "aggregate": "sum"}
    with pytest.raises(StoreError, match=r"features \(\['speed', 'effort'\] there, \['effort', 'speed'\] now\)"):
        PreferenceWriter(tmp_path, dataclasses.replace(example_provenance(), ranking=ranking))


if __name__ == "__main__":
    pytest.main([__file__, "-m", ""])
