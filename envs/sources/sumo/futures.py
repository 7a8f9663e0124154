"""Other futures of a simulated scene: SUMO goes on from its current step with other random numbers.

They are what the scene's log was drawn from, and bound from above how well one can drive it who sees only the scene:
SUMO knows every driver, and everybody's way, which it can be made to draw anew.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal, get_args
from xml.etree import ElementTree

import numpy as np
import torch
from torch import Tensor

from envs.scene import CURRENT_STEP, LOG_STEPS, STEP_SECONDS, Scene
from envs.sources.sumo import SumoUnit, prepared, read_unit, recorded, rules_of
from envs.sources.sumo.demand import exits_by_lane
from envs.sources.sumo.tracks import KERNEL_REACH, Tracks, make_tracks
from envs.sources.sumo.traffic import Recording, Run
from envs.sources.sumo.ways import draw_ways, possible_ways
from envs.sources.sumo.xml import read_xml

Keeps = Literal["all", "ways", "drivers"]
"""What a future has of its log: its random numbers too, so that it is the log again but for what a saved state lacks
(who waits at a stop sign waits anew); every driver and everybody's way; or the drivers, and of the scene's vehicles
and cyclists ways that they may be on for all that one sees (:mod:`envs.sources.sumo.ways`)."""

FUTURE_STEPS = LOG_STEPS - CURRENT_STEP - 1
SPARE_STEPS = KERNEL_REACH + 1
"""Simulated beyond a scene, so that smoothing sees at its end what it saw in the log."""
ALONG, AHEAD, SPEED, WAITED = 7, 9, 10, 14
"""Words of the state of somebody who walks: where on the lane [m], in which direction (1 or -1), speed, time waited."""
STEP_BACK = 0.3
"""Of pedestrians who wait [m]; see :func:`_mended`."""
SAME = 1e-3
"""A scene is of a simulation if its agents are where this has them, to this [m]."""


def futures(origin: str, scene: Scene, seeds: Sequence[int], *, keeps: Keeps = "ways") -> Tensor:
    """What SUMO does from a scene's current step on, once for each seed.

    Args:
        origin: the simulation, as a store keeps it (:meth:`~envs.store.SceneStore.provenance`).
        scene: uncollated, of that simulation.
        seeds: of all that is drawn from here on.

    Keyword Args:
        keeps: what is as in the log, see :data:`Keeps`.

    Returns:
        ``[len(seeds), A, 80, 3]`` x, y [m] and heading [rad] of the present agents; one that leaves the network stays
        where it was last.

    Raises:
        ImportError: the extra ``sumo`` is not installed.
        ValueError: the scene is of another simulation, or the simulation of another version of SUMO; ways are to be
            drawn for traffic that is the user's own, or it was scaled; or there is no such ``keeps``.
        SceneError: a file of the user's own cannot be used.

    Examples:
        >>> from envs.sources.sumo import simulate, units
        >>> (unit,) = units(1, seed=5, preset="town", windows=1, warmup=10.0, max_agents=8)
        >>> (scene,) = simulate(unit)
        >>> futures(unit.text, scene, seeds=[0, 1]).shape
        torch.Size([2, 8, 80, 3])
    """
    if keeps not in get_args(Keeps):
        raise ValueError(f"keeps must be one of {', '.join(get_args(Keeps))}, got {keeps!r}.")
    unit = read_unit(origin)
    if keeps == "drivers" and unit.routes:
        raise ValueError(f"{origin}: only random traffic says which ways are possible; keep them (keeps='ways').")
    if unit.routes and unit.options.density != 1:
        raise ValueError(f"{origin}: SUMO cannot go on with routes that density scales; convert with density=1.")
    first = int(scene.scene_id.split("_")[-2])  # see `simulate`
    now = first + CURRENT_STEP
    with tempfile.TemporaryDirectory(prefix="sumo_") as name:
        folder = Path(name)
        _, run = prepared(unit, folder)
        resumed = _resumed(run, now, folder / "state.xml")
        log, state = _saved(unit, run, resumed.begin, keeps == "all", folder)
        rows = _rows(scene, make_tracks(log), now, origin)
        possible = {}
        if keeps == "drivers":
            names = {log.names[row] for row in rows}
            by_lane = exits_by_lane(rules_of(unit)["traffic"])
            possible = possible_ways(state, names, run.network, run.routes, by_lane, folder)
        ahead = []
        for seed in seeds:
            draw_ways(state, possible, np.random.default_rng(seed))
            ElementTree.ElementTree(state).write(folder / "state.xml", encoding="utf-8")
            ahead.append(recorded(unit, replace(resumed, seed=seed), folder))
    here = _present_poses(scene)
    tracks = [make_tracks(_joined(log, each, rows, now)) for each in ahead]
    poses = np.stack([_from_now(each, here, scene.origin.numpy()[:2], now) for each in tracks])
    return torch.from_numpy(poses).float()


def _saved(
    unit: SumoUnit, run: Run, when: float, random_numbers: bool, folder: Path
) -> tuple[Recording, ElementTree.Element]:
    """The log, and the state of the simulation at some time."""
    saved = {"save-state.times": when, "save-state.files": folder / "state.xml"}
    saved |= {"save-state.transportables": True, "save-state.rng": random_numbers, "save-state.precision": 15}
    log = recorded(unit, replace(run, options=run.options | saved), folder)
    return log, _mended(folder / "state.xml", run.routes)


def _resumed(run: Run, now: int, state: Path) -> Run:
    """The simulation from a step of its recording on."""
    steps = run.first_step + now - round(run.begin / STEP_SECONDS)
    begin = round(run.begin + steps * STEP_SECONDS, 3)
    duration = (1 + FUTURE_STEPS + SPARE_STEPS) * STEP_SECONDS
    return replace(run, begin=begin, warmup=0.0, duration=duration, options=run.options | {"load-state": state})


def _mended(state: Path, routes: Path) -> ElementTree.Element:
    """A saved state, in which is put right what SUMO 1.28 does to pedestrians.

    It forgets how fast a type may be, and they run; and who waits at a crossing is let go, because no vehicle has
    announced itself yet: a step back makes them come to the crossing when all have.
    """
    told = {each.get("id"): each.get("maxSpeed") for each in read_xml(routes, "a route file").iter("vType")}
    root = read_xml(state, "a state of SUMO")
    for each in root.iter("vType"):
        if speed := told.get(each.get("id")):
            each.set("maxSpeed", speed)
    for person in root.iter("person"):
        words = person.get("state", "").split()
        if len(words) > WAITED and float(words[SPEED]) == 0 and float(words[WAITED]) > 0:
            words[ALONG] = str(float(words[ALONG]) - int(words[AHEAD]) * STEP_BACK)
            person.set("state", " ".join(words))
    return root


def _rows(scene: Scene, tracks: Tracks, now: int, origin: str) -> np.ndarray:
    """Places in the recording of the scene's present agents."""
    agents = scene.agents
    of_track = {int(track): row for row, track in enumerate(tracks.track_id)}
    rows = np.array([of_track.get(track, -1) for track in agents.track_id[agents.present].tolist()])
    away = tracks.centre[rows, now] - scene.origin.numpy()[:2] - _present_poses(scene)[:, :2]
    if (rows < 0).any() or np.abs(away).max() > SAME:
        raise ValueError(
            f"{scene.scene_id}: the simulation {origin} has other traffic now (another version of SUMO, or files that "
            "have changed); convert the scenes again."
        )
    return tracks.owner[rows]


def _present_poses(scene: Scene) -> np.ndarray:
    """``[A, 3]`` at the current step."""
    agents = scene.agents
    return agents.poses[agents.present, CURRENT_STEP].numpy().astype(np.float64)


def _joined(log: Recording, ahead: Recording, rows: np.ndarray, now: int) -> Recording:
    """Some road users of the log up to a step, and what they do from there on."""
    place = {name: row for row, name in enumerate(ahead.names)}
    names = [log.names[row] for row in rows]
    known = [row for row, name in enumerate(names) if name in place]
    there = [place[names[row]] for row in known]

    def join(past: np.ndarray, future: np.ndarray) -> np.ndarray:
        value = np.full((len(rows), now + future.shape[1], *future.shape[2:]), np.nan)
        value[:, :now] = past[rows, :now]
        value[known, now:] = future[there]
        return value

    return Recording(
        names=names,
        kind=log.kind[rows],
        is_car=log.is_car[rows],
        extent=log.extent[rows],
        front=join(log.front, ahead.front),
        angle=join(log.angle, ahead.angle),
        speed=join(log.speed, ahead.speed),
        lights={},
    )


def _from_now(tracks: Tracks, here: np.ndarray, origin: np.ndarray, now: int) -> np.ndarray:
    """``[A, 80, 3]`` after a step, each agent staying where it was last."""
    poses = np.repeat(here[:, None], FUTURE_STEPS, 1)
    for row in np.flatnonzero(tracks.valid[:, now]):
        stays = int(tracks.valid[row, now + 1 : now + 1 + FUTURE_STEPS].sum())
        last = np.minimum(np.arange(FUTURE_STEPS), stays - 1) + now + 1
        heading = (tracks.heading[row, last, None] + np.pi) % (2 * np.pi) - np.pi
        poses[tracks.owner[row]] = np.concatenate((tracks.centre[row, last] - origin, heading), -1)
    return poses
