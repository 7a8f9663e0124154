"""GPUDrive JSON -> scenes: both dialects."""

from __future__ import annotations

import gzip
import json
import lzma
import math
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from envs.scene import AgentKind, LightState, MapKind, Scene, SceneError
from envs.sources import gpudrive
from envs.sources.gpudrive import GPUDRIVE
from envs.sources.womd import read_womd
from tests.envs.made import gpudrive_road, newer_gpudrive, older_gpudrive


def read_gpudrive(path: Path) -> Scene:
    (scene,) = GPUDRIVE.scenes(str(path))
    return scene


@pytest.fixture
def newer() -> dict[str, Any]:
    return newer_gpudrive()


@pytest.fixture
def older() -> dict[str, Any]:
    return older_gpudrive()


@pytest.fixture
def save(tmp_path: Path) -> Callable[..., Path]:
    def write(data: Any, name: str = "scene.json") -> Path:
        packers = {".json": bytes, ".gz": gzip.compress, ".xz": lzma.compress}
        path = tmp_path / name
        path.write_bytes(packers[path.suffix](json.dumps(data).encode()))
        return path

    return write


def test_newer_dialect(newer, save) -> None:
    scene = read_gpudrive(save(newer))
    agents, road_map = scene.agents, scene.road
    assert scene.origin.tolist() == [1005.0, 200.0, 5.0]
    assert agents.position[1, 0].tolist() == [15.0, 0.0, 0.0]
    assert agents.heading[:, 0].tolist() == pytest.approx([0.1, -3.0])
    assert agents.track_id.tolist() == [7, 9]
    assert agents.kind.tolist() == [AgentKind.VEHICLE, AgentKind.CYCLIST]
    assert agents.sdc.tolist() == [True, False]
    assert agents.predict.tolist() == [False, True]
    assert agents.extent[0].tolist() == [4.5, 2.0, 1.5]
    assert road_map.kind.tolist() == [MapKind.LANE_SURFACE_STREET, MapKind.EDGE_MEDIAN]
    assert road_map.feature_id.tolist() == [3, 4]
    assert len(scene.lights.lane_id) == 0


def test_older_dialect_has_degrees_no_ids_and_the_sdc_last(older, save) -> None:
    scene = read_gpudrive(save(older))
    assert scene.agents.heading[:, 0].tolist() == pytest.approx([0.0, -math.pi / 2], abs=1e-6)
    assert scene.agents.track_id.tolist() == [0, 1]
    assert scene.agents.sdc.tolist() == [False, True]
    assert not scene.agents.predict.any()
    assert scene.road.kind.tolist() == [MapKind.LANE_UNDEFINED, MapKind.EDGE_UNKNOWN, MapKind.STOP_SIGN]
    assert scene.lights.state[0, 3:7].tolist() == [
        LightState.ABSENT,
        LightState.STOP,
        LightState.ARROW_GO,
        LightState.ABSENT,
    ]


def test_a_light_of_a_map_without_ids_belongs_to_the_lane_that_begins_where_it_stops_traffic(older, save) -> None:
    older["roads"] = [
        gpudrive_road(kind, xs) for kind, xs in [("road_edge", (1.0, 50.0)), ("lane", (90.0,)), ("lane", (2.0,))]
    ]
    scene = read_gpudrive(save(older))
    assert scene.road.feature_id.tolist() == [-1, -2, -3], "no number that a light could name"
    assert scene.lights.lane_id.tolist() == [-3]
    older["roads"] = older["roads"][:1]
    assert read_gpudrive(save(older)).lights.lane_id.tolist() == [117], "no lane to belong to"


def test_a_heading_of_pi_in_float32_is_not_taken_for_degrees(newer, save) -> None:
    newer["objects"][1]["heading"] = [float(np.float32(math.pi))] * 91
    assert read_gpudrive(save(newer)).agents.heading[1, 0].item() == pytest.approx(math.pi)


def test_headings_in_radians_that_are_not_wrapped_stay_radians(newer, save) -> None:
    newer["objects"][0]["heading"] = [2 * math.pi + 0.1] * 91
    newer["objects"][1]["heading"] = [0.0] * 91
    assert read_gpudrive(save(newer)).agents.heading[0, 0].item() == pytest.approx(2 * math.pi + 0.1)


def test_invalid_steps_may_hold_anything(newer, save) -> None:
    item = newer["objects"][1]
    item["valid"][20] = False
    item["heading"][20] = -10000.0
    item["position"][20] = dict.fromkeys("xyz", -10000.0)
    agents = read_gpudrive(save(newer)).agents
    assert agents.heading[0, 0].item() == pytest.approx(0.1)
    assert not agents.position[1, 20].any()


def test_packed_files_give_the_same_scene(newer, save) -> None:
    plain, *packed = (read_gpudrive(save(newer, f"scene.json{end}")) for end in ("", ".gz", ".xz"))
    for scene in packed:
        assert (scene.agents == plain.agents).all()


def drop(name: str):
    return lambda data: data.pop(name)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (drop("objects"), "objects is missing"),
        (drop("scenario_id"), "scenario_id is missing"),
        (lambda data: data["objects"].clear(), "objects has 0 items; must have 1 or more"),
        (lambda data: data["objects"][0]["heading"].pop(), r"objects\[0\]\.heading has 90 steps"),
        (lambda data: data["objects"][0]["position"][3].update(x=math.nan), "track 7 has position nan"),
        (lambda data: data["objects"][0].update(type=5), r"objects\[0\]\.type is 5; must be text"),
        (lambda data: data["objects"][0].update(valid=7), r"objects\[0\]\.valid is 7; must be a list"),
        (lambda data: data["objects"][1].update(length="x"), r"objects\[1\]\.length is 'x'; must be a number"),
        (lambda data: data["objects"][1].update(id=2**80), r"objects\[1\]\.id is 1208\d+; must be a whole number"),
        (lambda data: data["roads"][1].update(type="moat"), r"roads\[1\]\.type is 'moat'; must be one of lane"),
        (lambda data: data["roads"][1]["geometry"][0].update(y=None), r"roads\[1\]\.geometry\[0\]\.y is None"),
        (lambda data: data["metadata"].update(sdc_track_index=5), "SDC is track 5 of 2"),
        (lambda data: data["roads"].pop(), "no road edge"),
        (lambda data: data.update(scenario_id="\ud800"), r"scenario_id is '\\ud800'; must be text of at most 200"),
        (lambda data: data.update(scenario_id="x" * 201), "scenario_id is 'xxx.*; must be text of at most 200"),
        (lambda data: data["objects"][1].update(id=7), "two tracks share an id: 7, of track 1"),
        (lambda data: data.update(roads=[[]] * 200_001), "roads has 200001 items; at most 200000 are read"),
        (lambda data: data["tl_states"].update({"--1": {}}), r"the key of tl_states\[--1\] must be a whole number"),
        (lambda data: data["tl_states"].update({"5[7": {}}), r"the key of tl_states\[5\[7\] must be a whole number"),
        (lambda data: data["tl_states"].update({"9" * 40: {}}), r"the key of tl_states\[9+\.\.\.9+\] must be a whole"),
        (lambda data: data["tl_states"].update({"a\nb": {}}), r"the key of tl_states\[a\\nb\] must be a whole number"),
    ],
)
def test_an_unusable_file_is_named(newer, save, change, message: str) -> None:
    change(newer)
    with pytest.raises(SceneError, match=rf"scene\.json.*{message}"):
        read_gpudrive(save(newer))


@pytest.mark.parametrize("suffix", [".json", ".gz", ".xz"])
def test_a_damaged_file_is_named(newer, save, suffix: str) -> None:
    path = save(newer, f"scene{suffix}")
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(SceneError, match=f"scene{suffix}.*(cannot be unpacked|is no JSON)"):
        read_gpudrive(path)


@pytest.mark.parametrize("bits", [36, 38, 40])
def test_an_xz_file_that_asks_for_gigabytes_is_refused(newer, save, bits: int) -> None:
    path = save(newer, "scene.json.xz")
    packed = bytearray(path.read_bytes())
    end = 12 + (packed[12] + 1) * 4  # of the header of the first block, whose last word is its checksum
    packed[16] = bits  # size of the dictionary: 1, 2, 4 GiB
    packed[end - 4 : end] = struct.pack("<I", zlib.crc32(packed[12 : end - 4]))
    path.write_bytes(packed)
    with pytest.raises(SceneError, match=r"scene\.json\.xz, record 0: cannot be unpacked \(Memory usage limit"):
        read_gpudrive(path)


@pytest.mark.parametrize("suffix", [".gz", ".xz"])
def test_a_packed_file_that_is_too_large_is_refused(newer, save, suffix: str, monkeypatch) -> None:
    path = save(newer, f"scene.json{suffix}")
    monkeypatch.setattr(gpudrive, "MAX_BYTES", path.stat().st_size)
    with pytest.raises(SceneError, match=rf"scene\.json\{suffix}, record 0: has more than .* when unpacked"):
        read_gpudrive(path)


def real_files(shared: Path, folder: str, count: int) -> list[Path]:
    return sorted((shared / "scenes/gpudrive" / folder).glob("*.json.xz"))[:count]


@pytest.mark.parametrize("folder", ["train", "val", "lights"])
def test_real_scenes_head_where_they_travel_and_equal_their_file(shared: Path, folder: str) -> None:
    for path in real_files(shared, folder, 3):
        scene = read_gpudrive(path)
        with lzma.open(path, "rt") as file:
            data = json.load(file)
        agents = scene.agents
        for index, item in enumerate(data["objects"]):
            steps = [step for step, ok in enumerate(item["valid"]) if ok]
            assert agents.valid[index].nonzero().flatten().tolist() == steps
            world = np.array([[item["position"][step][axis] for axis in "xyz"] for step in steps])
            np.testing.assert_array_equal(agents.position[index, steps], (world - scene.origin.numpy()).astype("f4"))
        fast = agents.valid & (agents.velocity.norm(dim=-1) > 4) & (agents.kind == AgentKind.VEHICLE)[:, None]
        travel, heading = agents.velocity[fast], agents.heading[fast]
        along = travel[:, 0] * heading.cos() + travel[:, 1] * heading.sin()
        assert (along / travel.norm(dim=-1)).median() > 0.999
        assert scene.road.count.tolist() == [len(item["geometry"]) for item in data["roads"]]
        assert agents.sdc.nonzero().tolist() == [[len(data["objects"]) - 1]]


def test_real_lights_are_read(shared: Path) -> None:
    scenes = [read_gpudrive(path) for path in real_files(shared, "lights", 5)]
    assert [len(scene.lights.lane_id) for scene in scenes] == [19, 5, 7, 0, 12]
    for scene in scenes:
        assert set(scene.lights.lane_id.tolist()) <= set(scene.road.feature_id.tolist())


def test_a_real_radian_recording_that_passes_pi_is_not_turned(shared: Path, save) -> None:
    (scene,) = read_womd(shared / "scenes/womd/womd_scenario_input.tfrecord")
    agents = scene.agents
    assert agents.heading.abs().max() > 2 * math.pi
    objects = [
        {
            "position": [dict(zip("xyz", point, strict=True)) for point in agents.position[a].tolist()],
            "heading": agents.heading[a].tolist(),
            "velocity": [dict(zip("xy", pair, strict=True)) for pair in agents.velocity[a].tolist()],
            "valid": agents.valid[a].tolist(),
            **dict(zip(("length", "width", "height"), agents.extent[a].tolist(), strict=True)),
            "type": AgentKind(int(agents.kind[a])).name.lower(),
        }
        for a in range(len(agents.kind))
    ]
    metadata = {"sdc_track_index": int(agents.sdc.nonzero()), "tracks_to_predict": []}
    edge = gpudrive_road("road_edge", (0.0, 1.0))
    path = save({"scenario_id": "w", "objects": objects, "roads": [edge], "tl_states": {}, "metadata": metadata})
    np.testing.assert_array_equal(read_gpudrive(path).agents.heading, agents.heading)


if __name__ == "__main__":
    pytest.main([__file__])
