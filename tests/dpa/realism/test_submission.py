"""Submission files: the bytes of the format, poses there and back, kill and resume, and reading."""

from __future__ import annotations

import io
import json
import struct
import tarfile
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from dpa.realism import realism
from dpa.realism.submission import (
    CorruptError,
    Metadata,
    SubmissionError,
    SubmissionReader,
    decode_rollouts,
    encode_rollouts,
    validate,
    wire,
)
from dpa.realism.submission.messages import ScenarioRollouts, SimAgentsChallengeSubmission, SimulatedTrajectory
from envs.scene import CURRENT_STEP
from envs.sources.synthetic import straight_road
from tests.dpa.realism.submissions import METADATA, ORIGIN, ROLLOUTS, SCENES, far_road, open_writer, shard_bytes, write


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("whole") / "mine.tar.gz"
    write(path)
    return path


def journal_of(path: Path) -> Path:
    return path.with_name(f".{path.name}.journal") / "rollouts"


# --- bytes ---------------------------------------------------------------------------------------------------------


def test_a_trajectory_has_the_bytes_of_the_official_layout() -> None:
    trajectory = SimulatedTrajectory(
        object_id=300,
        **{name: [1.5, -2.0] for name in ("center_x", "center_y", "center_z", "heading")},
        **{name: [4.0] for name in ("width", "length", "height")},
        object_type=1,
        valid=[True, False],
    )
    two, one = struct.pack("<2f", 1.5, -2.0), struct.pack("<f", 4.0)
    packed = b"".join(bytes([number << 3 | 2, 8]) + two for number in (2, 3, 4, 5))
    generated = b"".join(bytes([number << 3 | 2, 4]) + one for number in (7, 8, 9))
    expected = packed + b"\x30\xac\x02" + generated + b"\x50\x01" + b"\x5a\x02\x01\x00"
    assert trajectory.SerializeToString(deterministic=True) == expected


def test_metadata_have_the_bytes_of_the_official_layout() -> None:
    metadata = Metadata("a@b.c", "m", False, True, False, "24", True, ("x", "y"), "f", "d", "l", ("p",))
    expected = b"\x10\x01\x1a\x05a@b.c\x22\x01m\x2a\x01x\x2a\x01y\x32\x01f\x3a\x01d\x42\x01l"
    expected += b"\x48\x00\x50\x01\x58\x00\x62\x0224\x6a\x01p\x70\x01"
    assert metadata.to_bytes() == expected


def test_a_shard_is_one_message_of_all_its_scenarios(archive: Path) -> None:
    with tarfile.open(archive) as packed:
        names = packed.getnames()
        shard = SimAgentsChallengeSubmission.FromString(packed.extractfile(names[1]).read())
    assert names == ["submission.binproto-00000-of-00002", "submission.binproto-00001-of-00002"]
    assert [message.scenario_id for message in shard.scenario_rollouts] == ["scene_1", "scene_3"]
    assert shard.scenario_rollouts[1] == encode_rollouts(SCENES[3], ROLLOUTS[3])
    assert shard.account_name == "me@example.org" and list(shard.authors) == ["A", "B"]


@given(st.integers(0, 2**63 - 1))
def test_numbers_of_any_size_are_walked_over(value: int) -> None:
    data = b"\x08" + wire.varint(value) + wire.rollouts_head(2) + b"ab"
    numbers, delimited = wire.walk(io.BytesIO(data), len(data), "shard")
    assert numbers.head + numbers.body == b"\x08" + wire.varint(value) and delimited.body == b"ab"


# --- poses ---------------------------------------------------------------------------------------------------------


def test_positions_are_those_of_the_world_rounded_once() -> None:
    message = encode_rollouts(SCENES[0], ROLLOUTS[0])
    values = list(message.joint_scenes[5].simulated_trajectories[1].center_x)
    expected = (ROLLOUTS[0][5, 1, :, 0].double() + ORIGIN[0]).float()
    assert torch.equal(torch.tensor(values), expected)


@settings(max_examples=30, deadline=None)
@given(
    origin=st.tuples(*[st.floats(-1e5, 1e5, width=64)] * 3),
    values=st.lists(st.floats(-1000, 1000, width=32), min_size=8, max_size=8),
    rollouts=st.integers(1, 3),
)
def test_poses_come_back_to_half_a_step_of_float32(
    origin: tuple[float, float, float], values: list[float], rollouts: int
) -> None:
    scene = straight_road(num_vehicles=2)
    scene.origin = torch.tensor(origin, dtype=torch.float64)
    poses = torch.tensor(values).reshape(2, 1, 4).expand(rollouts, 2, 80, 4)
    sent = ScenarioRollouts.FromString(encode_rollouts(scene, poses).SerializeToString())
    back = decode_rollouts(scene, sent)
    assert torch.equal(back[..., 3], poses[..., 3])
    largest = (poses[..., :3].double() + scene.origin).abs() + poses[..., :3].abs()
    assert ((back - poses)[..., :3].abs() <= largest * 2**-24 + 1e-30).all()


def test_objects_in_another_order_are_found_by_their_ids() -> None:
    message = encode_rollouts(SCENES[0], ROLLOUTS[0])
    for joint in message.joint_scenes:
        rows = list(joint.simulated_trajectories)
        del joint.simulated_trajectories[:]
        joint.simulated_trajectories.extend(reversed(rows))
    expected = decode_rollouts(SCENES[0], encode_rollouts(SCENES[0], ROLLOUTS[0]))
    assert torch.equal(decode_rollouts(SCENES[0], message), expected)


def test_agents_that_are_not_present_are_not_written() -> None:
    scene = far_road(0, vehicles=3)
    scene.agents.valid[1, CURRENT_STEP] = False
    message = encode_rollouts(scene, torch.zeros(1, 2, 80, 4))
    assert [trajectory.object_id for trajectory in message.joint_scenes[0].simulated_trajectories] == [1, 3]


def test_realism_of_what_was_read_back_is_that_of_what_was_written(archive: Path) -> None:
    message = next(iter(SubmissionReader(archive)))
    back = realism(SCENES[0], decode_rollouts(SCENES[0], message)).as_dict()
    assert back == pytest.approx(realism(SCENES[0], ROLLOUTS[0]).as_dict(), abs=1e-6, nan_ok=True)


@pytest.mark.parametrize(
    ("poses", "message"),
    [
        (torch.zeros(32, 3, 80, 4), r"must have shape \[R, 2, 80, 4\].* got \[32, 3, 80, 4\]"),
        (torch.full((1, 2, 80, 4), torch.nan), "scene_0, rollout 0, object 1: center_x is nan at simulated step 0"),
        (torch.full((1, 2, 80, 4), 3e38), None),
        (torch.full((1, 2, 80, 4), 1e39, dtype=torch.float64), "center_x is inf"),
    ],
)
def test_poses_that_cannot_be_written_are_refused(poses: Tensor, message: str | None) -> None:
    if message is None:
        assert encode_rollouts(SCENES[0], poses).joint_scenes
        return
    with pytest.raises(SubmissionError, match=message):
        encode_rollouts(SCENES[0], poses)


def test_rollouts_of_other_objects_do_not_become_poses() -> None:
    message = encode_rollouts(SCENES[0], ROLLOUTS[0])
    message.joint_scenes[3].simulated_trajectories[0].object_id = 99
    with pytest.raises(SubmissionError, match=r"scene_0, rollout 3: must hold the objects \[1, 2\].* holds \[2, 99\]"):
        decode_rollouts(SCENES[0], message)
    with pytest.raises(SubmissionError, match="'scene_0' do not belong to scene 'scene_1'"):
        decode_rollouts(SCENES[1], message)


# --- metadata ------------------------------------------------------------------------------------------------------


def test_metadata_list_all_that_is_wrong_at_once() -> None:
    with pytest.raises(SubmissionError) as caught:
        Metadata("me", " ", False, "no", False, "7 million", False)
    for text in ("'me'", "' '", "uses_camera_data must be true or false, got 'no'", "'7 million'", "acknowledge_"):
        assert text in str(caught.value)


def test_metadata_come_from_a_yaml_file(tmp_path: Path) -> None:
    path = tmp_path / "metadata.yaml"
    required = {name: getattr(METADATA, name) for name in list(Metadata.__dataclass_fields__)[:7]}
    path.write_text(json.dumps({**required, "authors": ["A", "B"], "affiliation": "home"}))
    assert Metadata.load(path) == METADATA
    path.write_text(json.dumps({"num_model_parameters": 24, "team": "x"}))
    with pytest.raises(SubmissionError, match="account_name is missing.*must be text, got 24.*'team' is unknown"):
        Metadata.load(path)


# --- writing -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("lost", [0, 1, 1000, 80_000])
def test_a_killed_run_goes_on_to_the_same_bytes(tmp_path: Path, archive: Path, lost: int) -> None:
    path = tmp_path / "mine.tar.gz"
    writer = open_writer(path)
    writer.add(2, SCENES[2], ROLLOUTS[2])
    writer.add(0, SCENES[0], ROLLOUTS[0])
    writer.close()
    journal = journal_of(path)
    with journal.open("r+b") as file:
        file.truncate(journal.stat().st_size - lost)
    with open_writer(path) as writer:
        assert writer.done == (frozenset({0, 2}) if lost == 0 else frozenset({2}))
        for index in (3, 0, 1, 2):
            writer.add(index, SCENES[index], ROLLOUTS[index])
        writer.finish()
    assert path.read_bytes() == archive.read_bytes()
    assert sorted(file.name for file in tmp_path.iterdir()) == ["mine.tar.gz", "mine.tar.gz.json"]


def test_a_tail_of_zeros_after_a_power_cut_is_dropped(tmp_path: Path) -> None:
    path = tmp_path / "mine.tar.gz"
    with open_writer(path) as writer:
        writer.add(0, SCENES[0], ROLLOUTS[0])
    size = journal_of(path).stat().st_size
    with journal_of(path).open("ab") as file:
        file.write(bytes(500))
    with open_writer(path) as writer:
        assert writer.done == {0}
    assert journal_of(path).stat().st_size == size


def test_a_kill_before_the_journal_is_removed_leaves_a_finished_archive(tmp_path: Path) -> None:
    path = tmp_path / "mine.tar.gz"
    write(path)
    journal_of(path).parent.mkdir()
    with open_writer(path) as writer:
        assert writer.finished and writer.done == {0, 1, 2, 3}
        assert writer.finish() == path


def test_a_kill_before_the_card_is_written_packs_again(tmp_path: Path, archive: Path) -> None:
    path = tmp_path / "mine.tar.gz"
    with open_writer(path) as writer:
        for index in range(4):
            writer.add(index, SCENES[index], ROLLOUTS[index])
    path.write_bytes(b"packed, and killed before the card")
    with open_writer(path) as writer:
        writer.finish()
    assert path.read_bytes() == archive.read_bytes()


def test_shards_and_metadata_may_change_until_the_end(tmp_path: Path) -> None:
    path = tmp_path / "mine.tar.gz"
    with open_writer(path) as writer:
        writer.add(0, SCENES[0], ROLLOUTS[0])
    write(path, (1, 2, 3), num_shards=3, metadata=Metadata("you@example.org", "m", False, False, False, "1", True))
    assert [message.scenario_id for message in SubmissionReader(path)] == ["scene_0", "scene_3", "scene_1", "scene_2"]
    assert SubmissionReader(path).metadata().account_name == "you@example.org"
    assert validate(path, SCENES) == []


def test_other_rollouts_are_not_mixed_in(tmp_path: Path) -> None:
    path = tmp_path / "mine.tar.gz"
    with open_writer(path) as writer:
        writer.add(0, SCENES[0], ROLLOUTS[0])
    with pytest.raises(SubmissionError, match=r"other options \('decided_by.seed': 0 there, 1 here\)"):
        open_writer(path, decided_by={"seed": 1})
    write(path, (1, 2, 3))
    with pytest.raises(SubmissionError, match=r"mine.tar.gz was written with other options \('num_shards': 2 there"):
        open_writer(path, num_shards=1)


def test_a_shard_of_two_gigabytes_is_refused_and_nothing_is_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, archive: Path
) -> None:
    path = tmp_path / "mine.tar.gz"
    size = len(encode_rollouts(SCENES[0], ROLLOUTS[0]).SerializeToString())
    monkeypatch.setattr(wire, "MAX_SHARD_BYTES", int(2.5 * size))
    with open_writer(path, num_shards=1) as writer:
        writer.add(0, SCENES[0], ROLLOUTS[0])
        writer.add(1, SCENES[1], ROLLOUTS[1])
        with pytest.raises(SubmissionError, match="00000-of-00001 would grow to .* with scene scene_2; .* more than 1"):
            writer.add(2, SCENES[2], ROLLOUTS[2])
    assert write(path, (2, 3)) == archive.read_bytes()


def test_two_processes_do_not_write_one_journal(tmp_path: Path) -> None:
    with open_writer(tmp_path / "mine.tar.gz"), pytest.raises(SubmissionError, match="another process is writing it"):
        open_writer(tmp_path / "mine.tar.gz")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"num_shards": 5}, "must be 1 to 4 .* got 5"),
        ({"scene_ids": ["a", "a"], "num_shards": 1}, "'a' occurs twice"),
        ({"scene_ids": []}, "needs scenes"),
    ],
)
def test_a_submission_that_cannot_be_is_refused_at_once(tmp_path: Path, changes: dict, message: str) -> None:
    with pytest.raises(SubmissionError, match=message):
        open_writer(tmp_path / "mine.tar.gz", **changes)


def test_what_the_rules_forbid_is_not_written(tmp_path: Path) -> None:
    with open_writer(tmp_path / "mine.tar.gz") as writer:
        with pytest.raises(SubmissionError, match="32 rollouts of each scene, got 8"):
            writer.add(0, SCENES[0], ROLLOUTS[0][:8])
        with pytest.raises(SubmissionError, match="1 agents followed their log .*track 2"):
            writer.add(0, SCENES[0], ROLLOUTS[0], torch.tensor([True, False]))
        with pytest.raises(SubmissionError, match="'scene_0' is not number 1"):
            writer.add(1, SCENES[0], ROLLOUTS[0])
        with pytest.raises(SubmissionError, match="4 of 4 scenes have no rollouts yet, the first is 'scene_0'"):
            writer.finish()
    with pytest.raises(SubmissionError, match=r"named \*.tar.gz"):
        open_writer(tmp_path / "mine.tar")


# --- reading -------------------------------------------------------------------------------------------------------


def test_folder_shard_and_archive_hold_the_same(tmp_path: Path, archive: Path) -> None:
    with tarfile.open(archive) as packed:
        for member in packed.getmembers():
            (tmp_path / member.name).write_bytes(packed.extractfile(member).read())
    folder = [message.scenario_id for message in SubmissionReader(tmp_path)]
    assert folder == [message.scenario_id for message in SubmissionReader(archive)]
    single = SubmissionReader(tmp_path / "submission.binproto-00001-of-00002")
    assert [message.scenario_id for message in single] == ["scene_1", "scene_3"]
    assert single.metadata() == SubmissionReader(archive).metadata() == METADATA


def test_metadata_behind_the_scenarios_are_found(tmp_path: Path) -> None:
    path = tmp_path / "submission.binproto"
    path.write_bytes(shard_bytes([ScenarioRollouts(scenario_id="a")], b"") + METADATA.to_bytes())
    assert SubmissionReader(path).metadata() == METADATA


def test_a_reader_takes_no_more_than_it_gives(tmp_path: Path) -> None:
    """The second scenario is said to have a gigabyte that is not there; the first is given all the same."""
    path = tmp_path / "submission.binproto"
    path.write_bytes(shard_bytes([ScenarioRollouts(scenario_id="a")]))
    with path.open("ab") as file:
        file.write(wire.rollouts_head(1 << 30))
        file.truncate(file.tell() + (1 << 30) - 1)
    messages = iter(SubmissionReader(path))
    assert next(messages).scenario_id == "a"
    with pytest.raises(CorruptError, match="ends within the field of 1073741824 bytes"):
        next(messages)


def test_a_missing_path_is_told() -> None:
    with pytest.raises(SubmissionError, match=r"nowhere.tar.gz does not exist or may not be read"):
        SubmissionReader("nowhere.tar.gz")


if __name__ == "__main__":
    pytest.main([__file__])
