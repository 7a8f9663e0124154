"""WOMD files -> scenes, against independent decodings of the same bytes."""

from __future__ import annotations

import gzip
import struct
from collections import Counter, defaultdict
from pathlib import Path

import numpy as np
import pytest
import torch

from envs.scene import AgentKind, LightState, LinkKind, MapKind, Scene, SceneError
from envs.sources import recording, womd
from envs.sources.scenario import Scenario
from envs.sources.tfrecord import frame, masked_crc
from envs.sources.womd import METRES_PER_SECOND_PER_MPH, WOMD, read_womd

# --- an oracle that knows the wire format and nothing of our reader ------------------------------------------------


def varint(data: bytes, at: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        byte = data[at]
        value |= (byte & 127) << shift
        at, shift = at + 1, shift + 7
        if byte < 128:
            return value, at


def wire(data: bytes) -> dict[int, list]:
    """Field number -> values of one message: numbers for varints, bytes for all the rest."""
    fields, at = defaultdict(list), 0
    while at < len(data):
        tag, at = varint(data, at)
        size = {1: 8, 5: 4}.get(tag & 7)
        if tag & 7 == 0:
            value, at = varint(data, at)
        else:
            if size is None:
                size, at = varint(data, at)
            value, at = data[at : at + size], at + size
        fields[tag >> 3].append(value)
    return fields


def number(message: dict, field: int, kind: str) -> float:
    return struct.unpack(f"<{kind}", message[field][0])[0] if field in message else 0.0


def xyz(point: bytes) -> list[float]:
    return [number(wire(point), field, "d") for field in (1, 2, 3)]


def world_points(scene: Scene) -> torch.Tensor:
    return scene.road.points.double() + scene.origin


def only_record(path: Path) -> bytes:
    data = path.read_bytes()
    (length,) = struct.unpack("<Q", data[:8])
    assert len(data) == length + 16
    return data[12 : 12 + length]


@pytest.mark.parametrize("name", ["motion_data_one_scenario", "womd_scenario_input"])
def test_scene_equals_an_independent_decoding_of_the_file(shared: Path, name: str) -> None:
    path = shared / "scenes/womd" / f"{name}.tfrecord"
    (scene,) = read_womd(path)
    root = wire(only_record(path))
    assert scene.scene_id.encode() == root[5][0]
    tracks = [wire(track) for track in root[2]]
    assert scene.agents.track_id.tolist() == [track[1][0] for track in tracks]
    assert scene.agents.kind.tolist() == [track[2][0] for track in tracks]
    assert scene.agents.sdc.nonzero().tolist() == [[root[6][0]]]
    wanted = sorted(wire(required)[1][0] if 1 in wire(required) else 0 for required in root[11])
    assert scene.agents.predict.nonzero().flatten().tolist() == wanted
    origin = scene.origin.tolist()
    states = [[wire(state) for state in track[3]] for track in tracks]
    valid = np.array([[state.get(11, [0])[0] for state in row] for row in states], dtype=bool)
    position = np.array([[[number(state, f, "d") for f in (2, 3, 4)] for state in row] for row in states])
    other = np.array([[[number(state, f, "f") for f in (8, 9, 10)] for state in row] for row in states])
    moved = np.where(valid[..., None], position - origin, 0).astype(np.float32)
    np.testing.assert_array_equal(scene.agents.valid, valid)
    np.testing.assert_array_equal(scene.agents.position, moved)
    other = np.where(valid[..., None], other, 0).astype(np.float32)  # one of the files has values at invalid steps
    np.testing.assert_array_equal(scene.agents.heading, other[..., 0])
    np.testing.assert_array_equal(scene.agents.velocity, other[..., 1:])
    points = []
    for feature in map(wire, root[8]):
        (kind,) = set(feature) - {1}
        body = wire(feature[kind][0])
        points += body[{3: 8, 4: 2, 5: 2, 7: 2}.get(kind, 1)]
    expected = (np.array([xyz(point) for point in points]) - origin).astype(np.float32)
    np.testing.assert_array_equal(scene.road.points, expected)
    assert scene.road.feature_id.tolist() == [wire(feature)[1][0] for feature in root[8]]


def golden_file(shared: Path, name: str) -> Path:
    if name.startswith("synth"):
        return shared / f"realism/golden/raw/{name}.scenario.binproto"
    return shared / "scenes/womd/motion_data_one_scenario.tfrecord"


@pytest.mark.parametrize("name", ["637f20cafde22ff8", "synth_a", "synth_b"])
def test_scene_equals_the_golden_arrays(shared: Path, name: str) -> None:
    with np.load(shared / f"realism/golden/scenarios/{name}.npz", allow_pickle=False) as file:
        golden = dict(file)
    (scene,) = read_womd(golden_file(shared, name))
    agents, road, valid = scene.agents, scene.road, golden["valid"]
    np.testing.assert_array_equal(agents.valid, valid)
    for axis, field in enumerate("xyz"):
        expected = np.where(valid, golden[field] - scene.origin[axis].item(), 0)
        np.testing.assert_array_equal(agents.position[..., axis], expected.astype(np.float32))
    np.testing.assert_array_equal(agents.heading, np.where(valid, golden["heading"], 0))
    velocity = np.stack((golden["vx"], golden["vy"]), -1)
    np.testing.assert_array_equal(agents.velocity, np.where(valid[..., None], velocity, 0))
    size = np.stack([golden[field] for field in ("length", "width", "height")], -1)
    np.testing.assert_array_equal(agents.extent[agents.present], size[:, 10][valid[:, 10]])
    np.testing.assert_array_equal(agents.track_id, golden["object_id"])
    np.testing.assert_array_equal(agents.kind, golden["object_type"])
    assert set(agents.predict.nonzero().flatten().tolist()) == set(golden["tracks_to_predict"].tolist())

    def check(what: str, kinds: list[int] | None, low: int, high: int) -> None:
        keep = (road.kind >= low) & (road.kind <= high)
        assert road.feature_id[keep].tolist() == golden[f"{what}_id"].tolist()
        assert road.count[keep].tolist() == np.diff(golden[f"{what}_ptr"]).tolist()
        if kinds is not None:
            assert road.kind[keep].tolist() == kinds
        parts = [
            world_points(scene)[s : s + n]
            for s, n in zip(road.start[keep].tolist(), road.count[keep].tolist(), strict=True)
        ]
        mine = torch.cat([torch.empty(0, 3, dtype=torch.float64), *parts])
        torch.testing.assert_close(mine, torch.from_numpy(golden[f"{what}_xyz"]), rtol=0, atol=2e-5)

    check("lane", golden["lane_type"].tolist(), 0, 3)
    check("road_line", (golden["road_line_type"] + 5).tolist(), 5, 13)
    check("road_edge", (golden["road_edge_type"] + 14).tolist(), 14, 16)
    for what, kind in (("stop_sign", 17), ("crosswalk", 18), ("speed_bump", 19), ("driveway", 20)):
        check(what, None, kind, kind)
    speed = road.speed_limit[road.kind <= MapKind.LANE_BIKE].double()
    np.testing.assert_allclose(speed, golden["lane_speed_limit_mph"] * 0.44704, rtol=1e-6)

    listed = {}
    for step, (first, last) in enumerate(zip(golden["tl_ptr"][:-1], golden["tl_ptr"][1:], strict=True)):
        for row in range(first, last):
            listed[int(golden["tl_lane_id"][row]), step] = golden["tl_state"][row], golden["tl_stop_point"][row]
    lights = scene.lights
    assert int((lights.state != LightState.ABSENT).sum()) == len(listed)
    for g, lane in enumerate(lights.lane_id.tolist()):
        for step in range(91):
            state, stop = listed.get((lane, step), (LightState.ABSENT, scene.origin.numpy()))
            assert lights.state[g, step] == state
            np.testing.assert_array_equal(lights.stop_point[g, step], (stop - scene.origin.numpy()).astype(np.float32))


# --- synthetic protos ----------------------------------------------------------------------------------------------


def scene_of(scenario: object, folder: Path) -> Scene:
    path = folder / "one.tfrecord"
    path.write_bytes(frame(scenario.SerializeToString()))
    (scene,) = read_womd(path)
    return scene


def test_checksum_is_the_published_one() -> None:
    crc = 0xE3069283  # CRC-32C of "123456789", RFC 3720 appendix and every table of check values
    assert masked_crc(b"123456789") == (((crc >> 15) | (crc << 17)) + 0xA282EAD8) % 2**32


def test_the_origin_is_whole_metres_and_moving_there_is_exact(make_scenario, tmp_path: Path) -> None:
    scene = scene_of(make_scenario(), tmp_path)
    assert scene.origin.tolist() == [12_010.0, -7_000.0, 30.0]
    assert (scene.agents.position[1, 3].double() + scene.origin).tolist() == [11_993.0, -7_000.5, 30.25]
    assert scene.agents.sdc.tolist() == [True, False]
    assert scene.agents.predict.tolist() == [False, True]
    assert scene.road.kind.tolist() == [MapKind.LANE_SURFACE_STREET, MapKind.EDGE_BOUNDARY]
    assert scene.road.speed_limit[0].item() == pytest.approx(45 * METRES_PER_SECOND_PER_MPH)


def test_values_at_invalid_steps_become_zero(make_scenario, tmp_path: Path) -> None:
    scenario = make_scenario()
    state = scenario.tracks[1].states[5]
    state.valid, state.center_x = False, float("nan")
    agents = scene_of(scenario, tmp_path).agents
    assert not agents.position[1, 5].any()
    assert agents.heading[1, 5] == 0
    assert not agents.velocity[1, 5].any()


def test_extent_is_taken_at_the_current_step_or_else_the_first_valid_one(make_scenario, tmp_path: Path) -> None:
    scenario = make_scenario()
    scenario.tracks[0].states[10].length = 5.0
    for step, state in enumerate(scenario.tracks[1].states):
        state.valid, state.length = step >= 40, float(step)
    agents = scene_of(scenario, tmp_path).agents
    assert agents.extent[:, 0].tolist() == [5.0, 40.0]


def test_links_are_unique_and_stay_within_the_map(make_scenario, tmp_path: Path) -> None:
    scenario = make_scenario()
    lane, after = scenario.map_features[0].lane, scenario.map_features.add(id=9).lane
    lane.exit_lanes.extend([9, 555])
    after.entry_lanes.append(7)
    lane.left_neighbors.add(feature_id=9)
    after.right_neighbors.add(feature_id=7)
    links = scene_of(scenario, tmp_path).road.links
    assert links.tolist() == [[7, 9, LinkKind.EXIT], [7, 9, LinkKind.LEFT], [9, 7, LinkKind.RIGHT]]


def test_the_later_listing_of_a_light_counts(make_scenario, tmp_path: Path) -> None:
    scenario = make_scenario()
    scenario.dynamic_map_states[3].lane_states.add(lane=7, state=6).stop_point.x = 12_010.0
    del scenario.dynamic_map_states[4].lane_states[:]
    lights = scene_of(scenario, tmp_path).lights
    assert lights.state[0, 2:6].tolist() == [LightState.STOP, LightState.GO, LightState.ABSENT, LightState.STOP]
    assert lights.stop_point[0, 3].tolist() == [0.0, 7_000.0, -30.0]
    assert lights.stop_point[0, 4].tolist() == [0.0, 0.0, 0.0]


def test_polygons_and_stop_signs_are_polylines_too(make_scenario, tmp_path: Path) -> None:
    scenario = make_scenario()
    scenario.map_features.add(id=20).stop_sign.position.x = 12_010.0
    for number_, field in enumerate(("crosswalk", "speed_bump", "driveway"), 21):
        polygon = getattr(scenario.map_features.add(id=number_), field).polygon
        for _ in range(3):
            polygon.add(x=1.0)
    road = scene_of(scenario, tmp_path).road
    assert road.kind[2:].tolist() == [17, 18, 19, 20]
    assert road.count[2:].tolist() == [1, 3, 3, 3]


def test_gzip_and_bare_protos_give_the_same_scene(make_scenario, tmp_path: Path) -> None:
    data = make_scenario().SerializeToString()
    files = {"a.tfrecord": frame(data), "b.tfrecord-00000-of-00001": gzip.compress(frame(data)), "c.pb": data}
    scenes = []
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
        scenes += read_womd(tmp_path / name)
    assert len(scenes) == 3
    for scene in scenes[1:]:
        assert (scene.agents == scenes[0].agents).all()
        assert (scene.road == scenes[0].road).all()


# --- bad input -----------------------------------------------------------------------------------------------------


def break_track(field: str, value: float):
    return lambda scenario: setattr(scenario.tracks[1].states[12], field, value)


def cut_to_history(scenario: object) -> None:
    for track in scenario.tracks:
        del track.states[11:]


BROKEN = {
    "NaN": (break_track("center_x", float("nan")), r"tracks\[1\].states\[12\].center_x is nan"),
    "infinite heading": (break_track("heading", float("inf")), r"tracks\[1\].states\[12\].heading is inf"),
    "SDC nowhere": (
        lambda s: setattr(s.tracks[0].states[10], "center_y", float("nan")),
        r"tracks\[0\].states\[10\].center_y",
    ),
    "no road edge": (lambda s: s.map_features.pop(1), "no road edge"),
    "beyond the Earth": (break_track("center_y", -1e308), r"tracks\[1\].states\[12\].center_y is -1e\+308"),
    "no SDC": (lambda s: s.ClearField("sdc_track_index"), "SDC is track -1 of 2"),
    "SDC out of range": (lambda s: setattr(s, "sdc_track_index", 2), "SDC is track 2 of 2"),
    "SDC not there": (lambda s: setattr(s.tracks[0].states[10], "valid", False), "SDC is not valid"),
    "prediction out of range": (lambda s: s.tracks_to_predict.add(track_index=9), "track to predict is track 9 of 2"),
    "test split": (cut_to_history, "11 steps.*test split"),
    "other current step": (lambda s: setattr(s, "current_time_index", 0), "current step is 0"),
    "lights of some steps": (lambda s: s.dynamic_map_states.pop(), "90 steps of traffic lights"),
    "stop point": (
        lambda s: setattr(s.dynamic_map_states[2].lane_states[0].stop_point, "x", float("nan")),
        "light of lane 7",
    ),
    "map point": (lambda s: setattr(s.map_features[1].road_edge.polyline[0], "x", float("nan")), "map feature 8"),
    "float32 overflow": (lambda s: setattr(s.map_features[0].lane.polyline[1], "y", 1e300), "map feature 7"),
    "speed limit": (
        lambda s: setattr(s.map_features[0].lane, "speed_limit_mph", 1e300),
        "map feature 7 has speed_limit",
    ),
    "two tracks of one id": (lambda s: setattr(s.tracks[1], "id", 100), "share an id"),
    "no tracks": (lambda s: s.ClearField("tracks"), "no tracks"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_an_unusable_scenario_is_named_with_file_and_record(make_scenario, tmp_path: Path, case: str) -> None:
    change, message = BROKEN[case]
    bad = make_scenario("bad")
    change(bad)
    path = tmp_path / "two.tfrecord"
    path.write_bytes(frame(make_scenario("good").SerializeToString()) + frame(bad.SerializeToString()))
    scenes = read_womd(path)
    assert next(scenes).scene_id == "good"
    with pytest.raises(SceneError, match=rf"two\.tfrecord, record 1.*bad.*{message}"):
        next(scenes)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda data: data[:20] + bytes([data[20] ^ 1]) + data[21:], "checksum of the record is wrong"),
        (lambda data: bytes([data[0] ^ 1]) + data[1:], "checksum of the record's length"),
        (lambda data: data[:-1], "ends within the record"),
        (lambda data: data[:7], "ends within the record"),
        (lambda data: frame(b"\xff\xff\xff"), "not a Scenario proto"),
    ],
)
def test_a_damaged_record_is_named(make_scenario, tmp_path: Path, damage, message: str) -> None:
    good = frame(make_scenario().SerializeToString())
    path = tmp_path / "two.tfrecord"
    path.write_bytes(good + damage(good))
    scenes = read_womd(path)
    next(scenes)
    with pytest.raises(SceneError, match=rf"two\.tfrecord, record 1: .*{message}"):
        next(scenes)


def test_what_the_format_does_not_know_is_counted_and_not_dropped_silently(make_scenario, tmp_path: Path) -> None:
    scenario = make_scenario()
    scenario.tracks[1].object_type = 9
    scenario.map_features[0].lane.type = 6  # more than the types of lanes, though a line may have it
    scenario.map_features.add(id=77)
    scenario.map_features.add(id=78).road_edge.type = 99
    scenario.dynamic_map_states[0].lane_states[0].state = 12
    unknown = bytes([0x98, 0x06, 0x01])  # field 99, a number
    state = scenario.tracks[0].states[3]
    state.MergeFromString(state.SerializeToString() + unknown)
    path = tmp_path / "new.tfrecord"
    path.write_bytes(frame(scenario.SerializeToString() + unknown))
    notes: Counter[str] = Counter()
    (scene,) = WOMD.scenes(str(path), notes)
    assert scene.agents.kind.tolist() == [AgentKind.VEHICLE, AgentKind.OTHER]
    assert scene.road.kind.tolist() == [MapKind.LANE_UNDEFINED, MapKind.EDGE_BOUNDARY, MapKind.EDGE_UNKNOWN]
    assert scene.lights.state[0, :2].tolist() == [LightState.UNKNOWN, LightState.STOP]
    assert notes == {
        "track of unknown object type 9, taken as OTHER": 1,
        "lane of unknown type 6, taken as LANE_UNDEFINED": 1,
        "map feature of an unknown kind, left out": 1,
        "road_edge of unknown type 99, taken as EDGE_UNKNOWN": 1,
        "light of unknown state 12, taken as UNKNOWN": 1,
        "unknown field Scenario.99, left out": 1,
        "unknown field ObjectState.99, left out": 1,
    }


def test_unknown_fields_by_the_million_are_told_as_one(make_scenario, tmp_path: Path) -> None:
    path = tmp_path / "new.tfrecord"
    path.write_bytes(frame(make_scenario().SerializeToString() + bytes([0x98, 0x06, 0x01]) * 400_000))
    notes: Counter[str] = Counter()
    assert len(list(WOMD.scenes(str(path), notes))) == 1
    assert notes == {"unknown field (megabytes of them), left out": 1}


def test_cut_gzip_is_refused(make_scenario, tmp_path: Path) -> None:
    path = tmp_path / "cut.tfrecord.gz"
    path.write_bytes(gzip.compress(frame(make_scenario().SerializeToString()))[:-20])
    with pytest.raises(SceneError, match="cannot be unpacked"):
        list(read_womd(path))


@pytest.mark.parametrize("damage", [lambda data: data[:-20], lambda data: data[:40] + b"xxxx" + data[44:]])
def test_a_damaged_bare_proto_in_gzip_is_named(make_scenario, tmp_path: Path, damage) -> None:
    path = tmp_path / "cut.pb.gz"
    path.write_bytes(damage(gzip.compress(make_scenario().SerializeToString())))
    with pytest.raises(SceneError, match=r"cut\.pb\.gz, record 0: cannot be unpacked"):
        list(read_womd(path))


@pytest.mark.parametrize("text", [b"\xff\xfe", b"two\nlines", b"x" * 201, "\u202e".encode()])
def test_an_id_that_is_no_printable_text_is_refused(make_scenario, tmp_path: Path, text: bytes) -> None:
    unnamed = make_scenario()
    unnamed.ClearField("scenario_id")
    path = tmp_path / "bad.tfrecord"
    path.write_bytes(frame(unnamed.SerializeToString() + b"\x2a" + varint_bytes(len(text)) + text))
    with pytest.raises(SceneError, match=r"bad\.tfrecord, record 0: scenario_id is .*; must be text of at most 200"):
        list(read_womd(path))


def varint_bytes(value: int) -> bytes:
    return bytes([value]) if value < 128 else bytes([value & 127 | 128, value >> 7])


def add_lane_points(scenario: object, count: int) -> None:
    scenario.map_features[0].lane.MergeFromString(b"\x42\x00" * count)  # an empty point takes two bytes


CLAIMS = {
    "track to predict": lambda s: s.MergeFromString(b"\x5a\x00" * 10_001),
    "map feature": lambda s: s.MergeFromString(b"\x42\x00" * 100_001),
    "point of the map": lambda s: add_lane_points(s, 1_000_001),
    "light listing": lambda s: s.dynamic_map_states[0].MergeFromString(b"\x0a\x00" * 100_001),
    "link": lambda s: s.map_features[0].lane.exit_lanes.extend([1] * 500_001),
}


@pytest.mark.parametrize("what", ["track", *CLAIMS])
def test_counts_that_no_scene_has_are_refused_before_anything_is_built(
    make_scenario, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    scenario = make_scenario(num_tracks=3)
    monkeypatch.setitem(recording.MOST, "track", 2 if what == "track" else 3)
    CLAIMS.get(what, lambda scenario: None)(scenario)
    path = tmp_path / "huge.tfrecord"
    path.write_bytes(frame(scenario.SerializeToString()))
    monkeypatch.setattr(womd, "_state", lambda _: pytest.fail("it was built"))
    with pytest.raises(SceneError, match=rf"huge\.tfrecord, record 0 .*: it has \d+ times a {what}; at most"):
        list(read_womd(path))


def test_a_bare_proto_beyond_the_limit_is_refused_and_not_cut(make_scenario, tmp_path: Path, monkeypatch) -> None:
    path = tmp_path / "large.pb"
    path.write_bytes(make_scenario().SerializeToString())
    monkeypatch.setattr(womd, "MAX_PAYLOAD", 100)
    with pytest.raises(SceneError, match=r"large\.pb, record 0: has more than 100 bytes"):
        list(read_womd(path))


def test_an_own_message_class_does_not_clash_with_another_pool() -> None:
    assert Scenario.DESCRIPTOR.full_name == "envs.womd.Scenario"


if __name__ == "__main__":
    pytest.main([__file__])
