"""Files of arrays, ``.npz``: rollouts and scenarios as dpa.realism.score takes them."""

from __future__ import annotations

import io
import warnings
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch

from dpa.realism import RealismConfig
from dpa.realism.files import poses_from_arrays, scene_from_arrays
from dpa.realism.metric import _check as check_simulated
from envs.files import read_arrays
from envs.scene import CURRENT_STEP, Scene
from envs.sources.synthetic import straight_road
from tests.fuzz.case import Files, Format, Maker, load_file, on_first
from tests.fuzz.edits import edit_bytes, flip_bits

NEVER = (1980, 1, 1, 0, 0, 0)
"""Time of day in an archive, so that an input stays the same whenever it is made."""
SHARED_DATA = Path(__file__).parents[1] / "data/realism/scenarios"
ROLLED, METRIC = straight_road(3), RealismConfig.load("2024")


def pack(arrays: dict[str, Any], compression: int = zipfile.ZIP_DEFLATED) -> bytes:
    """An ``.npz`` of arrays, or of bytes that stand for one."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", compression) as archive:
        for name, array in arrays.items():
            archive.writestr(zipfile.ZipInfo(f"{name}.npy", NEVER), array if isinstance(array, bytes) else npy(array))
    return out.getvalue()


def npy(array: np.ndarray) -> bytes:
    out = io.BytesIO()
    np.save(out, array, allow_pickle=True)
    return out.getvalue()


def unpack(data: bytes) -> dict[str, np.ndarray]:
    """The arrays of a file; nothing of one that is broken already."""
    try:
        with TemporaryDirectory() as folder:
            path = Path(folder, "arrays.npz")
            path.write_bytes(data)
            return read_arrays(path)
    except ValueError:
        return {}


# --- rollouts -------------------------------------------------------------------------------------------------------
def rolled(seed: int) -> dict[str, np.ndarray]:
    """Two rollouts of a small scene, in world coordinates."""
    agents, r = ROLLED.agents, np.random.default_rng(seed)
    world = (agents.position[:, CURRENT_STEP + 1 :].double() + ROLLED.origin).numpy()
    poses = {key: world[..., axis] + r.normal(size=(2, *world.shape[:2])) for axis, key in enumerate("xyz")}
    return {**poses, "heading": r.normal(size=poses["x"].shape), "object_id": agents.track_id.numpy()}


def rollouts() -> list[Files]:
    return [
        {"road.npz": pack(rolled(seed), how)} for seed, how in enumerate((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))
    ]


def read_rolled(path: Path) -> Iterator[Maker]:
    yield lambda: poses_from_arrays(read_arrays(path), ROLLED, str(path))


def check_rolled(poses: torch.Tensor) -> None:
    """As the metric looks at them first: what it refuses it must name."""
    check_simulated(ROLLED, poses, METRIC, None)


# --- scenarios ------------------------------------------------------------------------------------------------------
def scenarios() -> list[Files]:
    return [{path.name: pack(unpack(path.read_bytes()))} for path in sorted(SHARED_DATA.glob("*.npz"))[:2]]


def read_scenario(path: Path) -> Iterator[Maker]:
    def made() -> Scene:
        return scene_from_arrays(read_arrays(path), str(path))

    yield made


# --- edits ----------------------------------------------------------------------------------------------------------
def edit_array(files: Files, r: Random) -> Files:
    """One array becomes another: other values, another shape, another type, or it is not there."""
    first = next(iter(files))
    arrays = unpack(files[first])
    if not arrays:
        return files
    name = r.choice([*arrays])
    changed: dict[str, Any] = dict(arrays)
    edit = r.choice(EDITS)
    made = edit(arrays[name], r)
    changed.pop(name) if made is None else changed.update({name: made})
    return files | {first: pack(changed)}


def _value(array: np.ndarray, r: Random) -> np.ndarray:
    array = array.copy()
    if array.size and array.dtype.kind in "fiu":
        value = r.choice((0, -1, 1, 91, 255, 2**31 - 1, float("nan"), float("inf"), -1e30, 1e300))
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            array.flat[r.randrange(array.size)] = np.array(value).astype(array.dtype)
    return array


def _shape(array: np.ndarray, r: Random) -> np.ndarray:
    return r.choice((
        array[None], array.ravel(), array[..., :0] if array.ndim else array, array[:1] if array.ndim else array,
        np.concatenate((array, array)) if array.ndim else array, array.T,
        array.sum() if array.dtype.kind in "fiu" else array,
    ))  # fmt: skip


def _type(array: np.ndarray, r: Random) -> np.ndarray:
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return array.astype(r.choice(("U8", "S4", "c8", "?", "f2", "f4", "i1", "u8", "M8[s]", ">f8", "O")))
        except (TypeError, ValueError):
            return np.array("x")


def _bytes(array: np.ndarray, r: Random) -> bytes:
    return r.choice((edit_bytes, flip_bits))(npy(array), r)


def _header(array: np.ndarray, r: Random) -> bytes:
    """Other words in the header of an array, and a size that no memory has."""
    data = npy(array)
    old, new = r.choice((
        (b"(", b"(99999999999, "), (b"'<f8'", b"'|O'"), (b"'<f4'", b"'<f9'"), (b"False", b"True "), (b"descr", b"x"),
        (b"{", b"("), (b"'", b'"'), (b"shape", b"\xff\xfe\x00\x00\x00"), (b"(", b"(-1, "), (b"}", b"L}"),
    ))  # fmt: skip
    return data.replace(old, new, 1)


def _gone(array: np.ndarray, r: Random) -> None:
    return None


EDITS: tuple[Callable[[np.ndarray, Random], Any], ...] = (_value, _value, _shape, _type, _bytes, _header, _gone)

MUTATORS = {on_first(edit_bytes): 2, on_first(flip_bits): 2, edit_array: 5}
ROLLOUTS = Format(
    "rollouts",
    rollouts,
    load_file,
    MUTATORS,
    {},
    read_rolled,
    also_named=(f"scene {ROLLED.scene_id}",),
    answer=ValueError,
    check=check_rolled,
)
SCENARIOS = Format("scenarios", scenarios, load_file, MUTATORS, {}, read_scenario, answer=ValueError)
