"""One simulation with SUMO, and what it recorded."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from envs.scene import STEP_SECONDS, SceneError
from envs.sources.sumo.classes import Body
from envs.sources.sumo.network import Network, run_sumo


@dataclass(frozen=True)
class Recording:
    """What a simulation wrote down, at 10 Hz.

    Attributes:
        names: SUMO's id of each road user.
        kind: ``[V]``, :class:`~envs.scene.AgentKind`.
        is_car: ``[V]`` bool, vehicles that can be an SDC.
        extent: ``[V, 3]``, length, width, height [m].
        front: ``[V, T, 2]``, middle of the front bumper; NaN where the road user is not there [m].
        angle: ``[V, T]``, clockwise from north; NaN likewise [degrees].
        speed: ``[V, T]``, along the lane; NaN likewise [m/s].
        lights: the letters of each traffic light at every step, ``{id: [state, ...]}``.
    """

    names: list[str]
    kind: np.ndarray
    is_car: np.ndarray
    extent: np.ndarray
    front: np.ndarray
    angle: np.ndarray
    speed: np.ndarray
    lights: dict[str, list[str]]


@dataclass(frozen=True)
class Run:
    """What SUMO simulates.

    Attributes:
        network: where.
        routes: route file with everybody's way.
        bodies: what a road user of each type looks like; nothing for those that are not recorded (trams).
        seed: of the simulation.
        begin: when it starts [s]; who departs before is not in it.
        warmup: simulated but not recorded [s].
        duration: recorded [s].
        options: of SUMO, beside the usual ones.
    """

    network: Network
    routes: Path
    bodies: dict[str, Body | None]
    seed: int
    begin: float
    warmup: float
    duration: float
    options: dict[str, object] = field(default_factory=dict)

    @property
    def first_step(self) -> int:
        """Step of the simulation that the recording begins with."""
        return round((self.begin + self.warmup) / STEP_SECONDS)


def simulate_traffic(run: Run, folder: Path) -> Recording:
    """Simulate, and read what happened after the warm-up.

    Args:
        run: what to simulate.
        folder: where SUMO writes.

    Raises:
        RuntimeError: SUMO failed.
        SceneError: somebody is of a type that the routes do not describe.
    """
    lights = run.network.lights
    events = [f'<timedEvent type="SaveTLSStates" source="{light}" dest="lights.xml"/>' for light in lights]
    (folder / "events.add.xml").write_text("\n".join(["<additional>", *events, "</additional>"]), encoding="utf-8")
    _simulate(run, folder)
    first, steps = run.first_step, round(run.duration / STEP_SECONDS)
    names, types, values = _read_tracks(folder / "tracks.csv", first, steps)
    unknown = sorted(set(types) - set(run.bodies))
    if unknown:
        raise SceneError(f"{run.routes}: somebody is of type {unknown[0]!r}; write its <vType> into this file.")
    recorded = [i for i, name in enumerate(types) if run.bodies[name] is not None]
    bodies, values = [run.bodies[types[i]] for i in recorded], values[recorded]
    return Recording(
        names=[names[i] for i in recorded],
        kind=np.array([int(body.kind) for body in bodies], dtype=np.int64),
        is_car=np.array([body.is_car for body in bodies], dtype=bool),
        extent=np.array([body.extent for body in bodies], dtype=np.float64).reshape(-1, 3),
        front=values[..., :2],
        angle=values[..., 2],
        speed=values[..., 3],
        lights=_read_lights(folder / "lights.xml", first, steps) if lights else {},
    )


def _simulate(run: Run, folder: Path) -> None:
    """Run SUMO; it records tracks and lights in the folder."""
    run_sumo(
        "sumo",
        {
            "net-file": run.network.path.resolve(),
            "route-files": run.routes.resolve(),
            "additional-files": folder / "events.add.xml",
            "fcd-output": folder / "tracks.csv",
            "fcd-output.attributes": "x,y,angle,speed,type",
            "device.fcd.begin": run.begin + run.warmup,
            "begin": run.begin,
            "end": run.begin + run.warmup + run.duration,
            "seed": run.seed,
            "step-length": STEP_SECONDS,
            "lateral-resolution": 0.8,
            "time-to-teleport": -1,  # a gridlock stays one: nobody vanishes and reappears elsewhere
            "collision.action": "none",
            "max-depart-delay": 5,
            "ignore-route-errors": True,
            "precision": 3,
            "xml-validation": "never",
            "no-step-log": True,
            "no-warnings": True,
        }
        | run.options,
    )


_LIGHT_STATE = re.compile(r'<tlsState time="([^"]+)" id="([^"]+)".* state="([^"]+)"')


def _read_lights(path: Path, first: int, steps: int) -> dict[str, list[str]]:
    """States of every light from step ``first`` on."""
    states: dict[str, list[str]] = {}
    for match in _LIGHT_STATE.finditer(path.read_text(encoding="utf-8")):
        step = round(float(match[1]) / STEP_SECONDS) - first
        if 0 <= step < steps:
            states.setdefault(match[2], []).append(match[3])
    return states


def _read_tracks(path: Path, first: int, steps: int) -> tuple[list[str], list[str], np.ndarray]:
    """Ids and types of those who were seen ``[V]``, and x, y, angle and speed ``[V, T, 4]`` (NaN where absent)."""
    with path.open(encoding="utf-8") as file:
        # SUMO names the columns after whoever is seen first: vehicle_id or person_id
        names = [name.split("_")[-1] for name in file.readline().strip().split(";")]
        rows = [line.rstrip("\n").split(";") for line in file]
    if not rows:
        return [], [], np.zeros((0, steps, 4))
    column = dict(zip(names, zip(*rows, strict=True), strict=True))
    seen = np.array(column["id"], dtype=object) != ""  # a step when nobody is there is a row of its own
    step = np.rint(np.array(column["time"], dtype=np.float64) / STEP_SECONDS).astype(np.int64) - first
    kept = np.flatnonzero(seen & (step >= 0) & (step < steps))
    ids = [column["id"][i] for i in kept]
    order = {name: row for row, name in enumerate(sorted(set(ids), key=lambda name: (len(name), name)))}
    type_of = dict(zip(ids, (column["type"][i] for i in kept), strict=True))
    values = np.full((len(order), steps, 4), np.nan)
    cells = np.array([[column[name][i] for name in ("x", "y", "angle", "speed")] for i in kept], dtype=np.float64)
    values[[order[name] for name in ids], step[kept]] = cells.reshape(-1, 4)
    return list(order), [type_of[name] for name in order], values
