"""Argoverse 2 motion forecasting: ``scenario_<id>.parquet`` beside ``log_map_archive_<id>.json`` -> scenes.

What the files lack is filled in by convention, and what they have too much of is cut:

- **Time**: 110 steps at 10 Hz (5 s of history, 6 s of future) become the last 91
  (:data:`~envs.sources.argoverse_tracks.FIRST_STEP`).
- **Boxes**: there are none; :data:`SIZES` gives each class one size.
- **Height**: tracks have none; a box stands on the map (:func:`_ground`).
- **Track ids** are text. One that is a number keeps it, the others (the ego car is ``AV``) get the numbers after the
  largest one, in order of their first row.
- **Tracks to predict** are the scored and focal ones (categories 2 and 3 of ``av2``'s ``TrackCategory``) that are there
  at the current step. A track that is nowhere in the 91 steps is left out.
- **Map**: see :mod:`envs.sources.argoverse_map`. There are no lights.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from functools import partial
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from envs.scene import CURRENT_STEP, LOG_STEPS, AgentKind, Lacks, Scene, SceneError
from envs.sources.argoverse_map import read_map
from envs.sources.argoverse_tracks import MOST_ROWS, NUMBER_COLUMNS, TEXT_COLUMNS, WHOLE_COLUMNS, read_tracks
from envs.sources.fields import Field, decode_json, one_line, shown
from envs.sources.files import find_files, read_file
from envs.sources.parquet_pages import ENCODINGS, read_pages
from envs.sources.recording import Polyline, Recording
from envs.sources.source import Notes, Record, Source

KINDS = {
    "vehicle": AgentKind.VEHICLE,
    "bus": AgentKind.VEHICLE,
    "pedestrian": AgentKind.PEDESTRIAN,
    "cyclist": AgentKind.CYCLIST,
    "motorcyclist": AgentKind.CYCLIST,
    "static": AgentKind.OTHER,
    "background": AgentKind.OTHER,
    "construction": AgentKind.OTHER,
    "riderless_bicycle": AgentKind.OTHER,
    "unknown": AgentKind.OTHER,
}
"""Object types of ``av2.datasets.motion_forecasting.data_schema.ObjectType``."""
SIZES = {
    "vehicle": (4.7, 2.1, 1.7),
    "bus": (12.0, 2.5, 3.2),
    "pedestrian": (0.9, 0.85, 1.7),
    "cyclist": (1.75, 0.8, 1.75),
    "motorcyclist": (2.2, 0.8, 1.7),
    "riderless_bicycle": (1.75, 0.6, 1.1),
}
"""Length, width, height of each object type [m]. They are conventions, not measurements: the means of WOMD boxes for
vehicles, pedestrians and cyclists (1,839 tracks of 25 scenes, rounded), so that a model sees what it sees there; the
bus of ScenarioNet's converter (12 m x 2.5 m); usual two-wheelers. (The pictures of the Argoverse 2 API draw vehicles
of 4.0 m x 2.0 m and cyclists of 2.0 m x 0.7 m.)"""
OTHER_SIZE = (1.0, 1.0, 1.0)
"""Size of all other types [m], as ScenarioNet has it: cones, barrels, signs."""
PREDICTED_CATEGORIES = (2, 3)
"""Scored and focal tracks; 0 and 1 are fragments and tracks for context."""
GROUND_STEPS = 5
"""Steps of 0.1 s between two looks at the map, as :mod:`envs.geometry.ground` looks for rollouts."""

_LACKS = Lacks.HEIGHT | Lacks.SIZES | Lacks.LIGHTS | Lacks.SPEED_LIMITS

LARGEST_PARQUET = 64 * 2**20
LARGEST_MAP = 16 * 2**20
LARGEST_DATA = 128 * 2**20
"""Bytes of a parquet file, of a map, and of a parquet file's columns once unpacked, beyond which it is refused; a
scenario has about 0.3, 0.1 and 0.5 MB."""


def scene_from_tables(columns: Mapping[str, Any], map_data: Field, name: str, notes: Notes | None = None) -> Scene:
    """One decoded scenario -> scene.

    Args:
        columns: columns of the parquet file by name, each an array or list with one value for each row, a row for each
            track and time step: positions [m] and velocities [m/s] in city coordinates, headings [rad].
        map_data: what the map's JSON holds.
        name: what errors call it.
        notes: what was not understood and taken for something is counted here.

    Raises:
        SceneError: naming the file and the field: a column or entry missing or of the wrong type, not the whole 11 s,
            no track ``AV``, and all that :meth:`~envs.scene.Scene.validate` refuses.
    """
    notes = Counter() if notes is None else notes
    tracks = read_tracks(columns, name)
    polylines, links = read_map(map_data, notes)
    for kind in tracks.object_type:
        if kind not in KINDS:
            notes[f"object type {shown(kind)} unknown, taken as OTHER"] += 1
    size = np.array([SIZES.get(kind, OTHER_SIZE) for kind in tracks.object_type])
    height = _ground(tracks.states[..., :2], tracks.valid, polylines) + size[:, None, 2] / 2
    predicted = np.isin(tracks.category, PREDICTED_CATEGORIES) & tracks.valid[:, CURRENT_STEP]
    return Recording(
        scene_id=tracks.scenario_id,
        position=np.concatenate((tracks.states[..., :2], height[..., None]), -1),
        heading=tracks.states[..., 2],
        velocity=tracks.states[..., 3:],
        extent=np.broadcast_to(size[:, None], (len(size), LOG_STEPS, 3)),
        valid=tracks.valid,
        kind=[KINDS.get(kind, AgentKind.OTHER) for kind in tracks.object_type],
        track_id=tracks.number,
        sdc=tracks.sdc,
        predict=predicted.nonzero()[0].tolist(),
        polylines=polylines,
        links=links,
        lacks=_LACKS,
    ).to_scene(name)


def _ground(xy: np.ndarray, valid: np.ndarray, polylines: list[Polyline]) -> np.ndarray:
    """Height of the map under tracks.

    The nearest map point in the plane counts. It is looked up every half second and interpolated between, as
    :func:`envs.geometry.ground.lift` does for rollouts: from step to step the nearest point jumps by centimetres, which
    would be vertical speed. With no level to start from, a track under a bridge may get the height of the bridge.

    Args:
        xy: ``[A, L, 2]`` city coordinates [m].
        valid: ``[A, L]``, some step of each track is.
        polylines: the map.

    Returns:
        ``[A, L]`` [m]; 0 everywhere if the map is empty.
    """
    if not polylines:
        return np.zeros(valid.shape)
    points = np.concatenate([np.asarray(line.points) for line in polylines])
    steps, knots = np.arange(LOG_STEPS), np.arange(0, LOG_STEPS, GROUND_STEPS)
    # Where a track is not valid at a knot, the line between the valid steps around it is followed.
    held = [
        [np.interp(knots, steps[ok], track[ok, axis]) for axis in (0, 1)] for track, ok in zip(xy, valid, strict=True)
    ]
    _, nearest = cKDTree(points[:, :2]).query(np.moveaxis(np.array(held), 1, -1))
    return np.array([np.interp(steps, knots, row) for row in points[nearest, 2]])


def _read(path: str, notes: Notes) -> Scene:
    name = f"{path}, record 0"
    columns = _decode_parquet(read_file(path, LARGEST_PARQUET), name)
    folder, slash, file = path.rpartition("/")
    scenario = file.removesuffix(".parquet").removeprefix("scenario_")
    map_path = f"{folder}{slash}log_map_archive_{scenario}.json"
    map_data = decode_json(read_file(map_path, LARGEST_MAP), f"{name}, map {map_path.rpartition('/')[2]}")
    return scene_from_tables(columns, map_data, name, notes)


def _decode_parquet(data: bytes, name: str) -> dict[str, np.ndarray]:
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError as error:
        raise ImportError("Argoverse 2 needs pyarrow and shapely: pip install 'dpa-omf[argoverse]'") from error
    try:
        metadata = parquet.read_metadata(pyarrow.BufferReader(data))
        _check_size(metadata, name)
        _check_pages(data, metadata, name)
        there = set(metadata.schema.to_arrow_schema().names)
        wanted = [field for field in (*TEXT_COLUMNS, *WHOLE_COLUMNS, *NUMBER_COLUMNS) if field in there]
        # Text stays a table of its different values: a few bytes of a file could unpack to a long text in each row.
        file = parquet.ParquetFile(
            pyarrow.BufferReader(data),
            metadata=metadata,
            read_dictionary=[field for field in TEXT_COLUMNS if field in there],
        )
        table = file.read(columns=wanted, use_threads=False)
        return {field: _to_numpy(table[field]) for field in wanted}
    except SceneError:
        raise
    except Exception as error:  # whatever a damaged file makes of the decoder, its fault is the file
        raise SceneError(
            f"{name}: not a parquet file that can be read ({one_line(error)}); fetch the file again."
        ) from error


def _check_size(metadata: Any, name: str) -> None:
    """What the footer announces must fit in memory, before anything is unpacked."""
    size = sum(metadata.row_group(index).total_byte_size for index in range(metadata.num_row_groups))
    if not 0 <= metadata.num_rows <= MOST_ROWS:
        raise SceneError(f"{name}: it has {metadata.num_rows} rows; at most {MOST_ROWS} are read.")
    if not 0 <= size <= LARGEST_DATA:
        raise SceneError(f"{name}: it has {size} bytes once unpacked; at most {LARGEST_DATA} are read.")


def _check_pages(data: bytes, metadata: Any, name: str) -> None:
    """The pages themselves, which need not be as large as the footer says."""
    size = 0
    for group in range(metadata.num_row_groups):
        for index in range(metadata.num_columns):
            column = metadata.row_group(group).column(index)
            for page in read_pages(data, column):
                size += page.unpacked
                if page.encoding is not None and page.encoding not in ENCODINGS:
                    raise SceneError(
                        f"{name}: column {shown(column.path_in_schema)[1:-1]} has the encoding {page.encoding}; only "
                        f"{', '.join(ENCODINGS.values())} are read."
                    )
    if size > LARGEST_DATA:
        raise SceneError(f"{name}: its pages have {size} bytes once unpacked; at most {LARGEST_DATA} are read.")


def _to_numpy(column: Any) -> np.ndarray:
    """A column as ``[n]`` values; equal texts are one object, and a missing value is None or NaN."""
    if not column.num_chunks or not hasattr(column.chunk(0), "dictionary"):
        return column.to_numpy()
    chunks = []
    for chunk in column.chunks:
        values = np.array([*chunk.dictionary.to_pylist(), None], dtype=object)
        chunks.append(values[chunk.indices.fill_null(len(values) - 1).to_numpy()])
    return np.concatenate(chunks)


def _records(path: str) -> Iterator[Record]:
    yield Record(path, 0, partial(_read, path))


ARGOVERSE = Source(
    name="argoverse",
    help="Argoverse 2 motion forecasting: scenario_*.parquet, each beside its log_map_archive_*.json",
    find=lambda paths: find_files(paths, "scenario_*.parquet"),
    records=_records,
    count=lambda path: 1,
    lacks=_LACKS,
)
