"""Unlimited multi-agent scenes from the traffic simulator SUMO; needs the extra ``sumo`` and no data at all.

    python -m envs.convert sumo num_scenes=160,split=train scenes/train --workers 2 --shard-size 12
    python -m envs.convert sumo num_scenes=24,split=test,preset=motorway,density=1.5 scenes/test --shard-size 12
    python -m envs.convert sumo net=town.net.xml,routes=town.rou.xml,num_scenes=40 scenes/town

A unit of work is one random network with one random traffic on it (or the user's own): :func:`units` lists them,
:func:`simulate` turns one into scenes, in any process. What a unit gives depends on its fields and on the user's files
alone, so any number of workers gives the same scenes. The splits draw from ranges of unit numbers that never meet: no
two share a random network.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import numpy as np

from envs.scene import STEP_SECONDS, Lacks, Scene, SceneError
from envs.sources.files import file_size
from envs.sources.source import Notes, Record, Source
from envs.sources.sumo.classes import make_body
from envs.sources.sumo.cut import cut_scene, sdc_candidates
from envs.sources.sumo.demand import draw_types, traffic_rules, write_demand
from envs.sources.sumo.makers import make_network
from envs.sources.sumo.netmap import NetMap, build_map
from envs.sources.sumo.network import Network, sumo_binary
from envs.sources.sumo.options import (
    NAMES,
    SumoOptions,
    check_count,
    check_names,
    draw_options,
    make_options,
    parse,
    settings,
    settings_digest,
)
from envs.sources.sumo.own import own_network, read_routes, stem
from envs.sources.sumo.tracks import Tracks, make_tracks
from envs.sources.sumo.traffic import Recording, Run, simulate_traffic

__all__ = [
    "SPLITS",
    "SUMO",
    "SumoUnit",
    "generate",
    "make_options",
    "parse",
    "prepared",
    "read_unit",
    "recorded",
    "rules_of",
    "simulate",
    "units",
]

SPLITS = ("train", "tune", "test")
"""Names of the splits; the place of a name sets the range of its unit numbers."""
REQUEST = ("num_scenes", "seed", "split", "preset", "net", "routes")
"""Names of a request beside those of the options."""
_SEEDS = 10_000
"""Seeds of a split; also units of a seed. The largest unit number then fits SUMO's 31-bit seed."""


@dataclass(frozen=True)
class SumoUnit:
    """One simulation to run; small, hashable and picklable.

    Attributes:
        preset: name of a preset of one kind of network; empty where ``net`` is given.
        number: seed of the network, of its traffic and of the simulation.
        num_scenes: how many scenes to cut from it.
        options: of the scenes and of the traffic.
        net: network file of the user's own; empty for a random one.
        routes: route file of the user's own; empty for random traffic.
    """

    preset: str
    number: int
    num_scenes: int
    options: SumoOptions
    net: str = ""
    routes: str = ""

    @property
    def name(self) -> str:
        """What its scenes are named after.

        Examples:
            >>> units(5, net="maps/town.net.xml")[0].name, units(5, seed=2)[0].name
            ('town_0', 'grid_20000')
        """
        return f"{self.preset or stem(self.net)}_{self.number}"

    @property
    def text(self) -> str:
        """The unit in words, as a store notes where a scene came from; options only where they are not the default.

        Examples:
            >>> units(5, max_agents=24)[0].text
            'preset=grid,number=0,num_scenes=5,max_agents=24'
        """
        where = {"preset": self.preset, "net": self.net, "routes": self.routes}
        told = {name: value for name, value in where.items() if value}
        told |= {"number": self.number, "num_scenes": self.num_scenes} | self.options.changed
        return ",".join(f"{name}={value}" for name, value in told.items())


def units(
    num_scenes: int,
    seed: int = 0,
    *,
    split: str = "train",
    preset: str = "mixed",
    net: str = "",
    routes: str = "",
    **options: float,
) -> list[SumoUnit]:
    """The simulations that together give ``num_scenes`` scenes.

    Args:
        num_scenes: scenes in all; the last unit may give fewer than the others.
        seed: 0 to 9999; each seed of each split has networks of its own.
        split: ``"train"``, ``"tune"`` or ``"test"``.
        preset: name of one in ``sumo.yaml``.
        net: a network file of your own (``.net.xml``) instead of random ones; leave ``preset`` out.
        routes: a route file on that network instead of random traffic.
        **options: overrides of ``sumo.yaml``, see :class:`SumoOptions`.

    Raises:
        ValueError: an unknown split, preset or option, or a number out of range.

    Examples:
        >>> [(unit.preset, unit.number, unit.num_scenes) for unit in units(30, seed=3)]
        [('grid', 30000, 12), ('arterial', 30001, 12), ('town', 30002, 6)]
    """
    known = settings()["presets"]
    check_names("preset", [preset], known)
    check_names("split", [split], SPLITS)
    check_names("option", sorted(options), [*REQUEST, *NAMES])
    chosen = make_options(**options)
    _check_own(preset, str(net), str(routes), chosen)
    check_count("seed", seed, 0, _SEEDS - 1)
    per_unit = chosen.scenes_per_unit
    check_count("num_scenes", num_scenes, 1, _SEEDS * per_unit, "; use another seed for more")
    cycle = [""] if net else known[preset] if isinstance(known[preset], list) else [preset]
    first = (SPLITS.index(split) * _SEEDS + seed) * _SEEDS
    return [
        SumoUnit(cycle[i % len(cycle)], first + i, min(per_unit, num_scenes - done), chosen, str(net), str(routes))
        for i, done in enumerate(range(0, num_scenes, per_unit))
    ]


def _check_own(preset: str, net: str, routes: str, options: SumoOptions) -> None:
    """Refuse what cannot go together."""
    if net and preset != "mixed":
        raise ValueError(f"net={net} brings a network of its own; leave preset={preset} out.")
    if routes and not net:
        raise ValueError(f"routes={routes} needs the network that it was made for; add net=....net.xml.")
    fixed = [name for name in ("trucks", "cyclists", "pedestrians", "imperfection") if name in options.changed]
    if routes and fixed:
        raise ValueError(
            f"{fixed[0]} changes random traffic, and routes={routes} brings its own; only density scales it."
        )
    for name, value in (("net", net), ("routes", routes)):
        if "," in value:
            raise ValueError(f"{name}={value!r} holds a comma, which ends a word of a request; rename the file.")


def simulate(unit: SumoUnit) -> list[Scene]:
    """Run one simulation and cut its scenes.

    Args:
        unit: from :func:`units`.

    Returns:
        ``unit.num_scenes`` scenes, named ``sumo_<preset or network>_<number>_<start step>_<track id of the SDC>``.

    Raises:
        ImportError: the extra ``sumo`` is not installed.
        RuntimeError: SUMO failed on a network of its own.
        SceneError: a file of the user's own cannot be used, or the traffic holds fewer cars that can be an SDC than
            scenes are asked for.
    """
    sumo_binary("sumo")
    with tempfile.TemporaryDirectory(prefix="sumo_") as folder:
        road, run = prepared(unit, Path(folder))
        recording = recorded(unit, run, Path(folder))
    tracks = make_tracks(recording)
    scenes: list[Scene] = []
    for start, sdc in _turns(unit, tracks):
        name = f"sumo_{unit.name}_{start}_{tracks.track_id[sdc]}"
        scene = cut_scene(tracks, road, recording.lights, sdc, start, unit.options.crop, name)
        if scene is not None:
            scenes.append(scene)
        if len(scenes) == unit.num_scenes:
            return scenes
    raise SceneError(
        f"SUMO unit {unit.name.replace('_', ' ')} holds only {len(scenes)} of {unit.num_scenes} scenes; "
        "lower scenes_per_unit or min_agents, raise density, or simulate more windows."
    )


def rules_of(unit: SumoUnit) -> dict[str, dict]:
    """Rules of a simulation's network and of its random traffic, from ``sumo.yaml``."""
    return settings()["presets"][unit.preset] if unit.preset else settings()["own_network"]


def prepared(unit: SumoUnit, folder: Path) -> tuple[NetMap, Run]:
    """The map of a simulation, and what SUMO is to simulate on it.

    Args:
        unit: from :func:`units`.
        folder: where network and traffic are written.

    Raises:
        RuntimeError: SUMO failed to make the network.
        SceneError: a file of the user's own cannot be used.
    """
    if unit.net:
        return _own(unit, folder)
    rules = rules_of(unit)
    network = make_network(folder, rules["network"], rules["signalled"], unit.number)
    return build_map(network, unit.options.point_spacing), _random_run(unit, network, folder)


def recorded(unit: SumoUnit, run: Run, folder: Path) -> Recording:
    """What happens in a simulation.

    Args:
        unit: from :func:`units`.
        run: of :func:`prepared`, or one like it.
        folder: where SUMO writes.

    Raises:
        RuntimeError: SUMO failed on a network of its own.
        SceneError: it failed on the user's files.
    """
    try:
        return simulate_traffic(run, folder)
    except RuntimeError as error:
        if not unit.net:
            raise
        files = " with ".join(file for file in (unit.net, unit.routes) if file)
        raise SceneError(f"{files}: SUMO cannot simulate it; correct what it says: {error}") from error


def _random_run(unit: SumoUnit, network: Network, folder: Path) -> Run:
    """Random traffic on any network."""
    options, rules = unit.options, rules_of(unit)
    rng = np.random.default_rng((unit.number, 1))  # a stream of its own: the network has (number)
    types = draw_types(rules.get("road_users", {}), options.imperfection, rng)
    traffic = draw_options(traffic_rules(rules["traffic"], options), rng)
    duration = options.windows * options.window_spacing
    write_demand(folder / "demand.rou.xml", network, types, traffic, options.warmup + duration, rng)
    bodies = {name: make_body(attributes) for name, attributes in types.items()}
    return Run(network, folder / "demand.rou.xml", bodies, unit.number, 0.0, options.warmup, duration)


def _own(unit: SumoUnit, folder: Path) -> tuple[NetMap, Run]:
    """The user's own network, with random traffic or the user's own."""
    network, road = own_network(Path(unit.net), unit.options.point_spacing)
    if not unit.routes:
        return road, _random_run(unit, network, folder)
    routes, options = read_routes(Path(unit.routes)), unit.options
    duration = options.windows * options.window_spacing
    begin = routes.stretch(unit.number, duration)
    extra = {"scale": options.density, "route-steps": 0}  # all routes at once, so they need no order
    return road, Run(network, routes.path, routes.bodies, unit.number, begin, options.warmup, duration, extra)


def _turns(unit: SumoUnit, tracks: Tracks) -> Iterator[tuple[int, int]]:
    """Start step and SDC of every possible scene: one of each window in turn, the ones far apart first."""
    spacing = round(unit.options.window_spacing / STEP_SECONDS)
    starts = [window * spacing for window in range(unit.options.windows)]
    waiting = [(start, sdc_candidates(tracks, start, unit.options.crop)) for start in starts]
    while waiting:
        still = []
        for start, candidates in waiting:
            sdc = next(candidates, None)
            if sdc is not None:
                yield start, sdc
                still.append((start, candidates))
        waiting = still


def generate(num_scenes: int, seed: int = 0, **request: object) -> Iterator[Scene]:
    """Scenes one by one, in this process (arguments of :func:`units`).

    Examples:
        >>> scene = next(generate(1, seed=5, preset="town", windows=1, warmup=10.0))
        >>> scene.scene_id.startswith("sumo_town_50000_0_"), scene.agents.position.shape[1:]
        (True, torch.Size([91, 3]))
    """
    for unit in units(num_scenes, seed, **request):
        yield from simulate(unit)


def _find(requests: Sequence[str]) -> list[str]:
    """Requests of scenes (arguments of :func:`units`) -> one input for each simulation."""
    sumo_binary("sumo")  # say now, not in a worker, that SUMO is missing
    inputs = []
    for request in requests:
        told = parse(request)
        if "num_scenes" not in told:
            raise ValueError(
                f"{request!r}: num_scenes is missing among its options; say for example num_scenes=160,seed=0."
            )
        made = units(**told)
        _try_files(made[0])
        inputs += [unit.text for unit in made]
    return inputs


def _try_files(unit: SumoUnit) -> None:
    """Say now, not in a worker, that a file of the user's own cannot be used."""
    if unit.net:
        own_network(Path(unit.net), unit.options.point_spacing)
    if unit.routes:
        read_routes(Path(unit.routes))


def read_unit(text: str) -> SumoUnit:
    """The simulation that :attr:`SumoUnit.text` tells.

    Examples:
        >>> read_unit(units(5, max_agents=24)[0].text).options.max_agents
        24
    """
    told = parse(text)
    own = {name: str(told.pop(name, "")) for name in ("preset", "net", "routes")}
    number, num_scenes = told.pop("number"), told.pop("num_scenes")
    return SumoUnit(number=number, num_scenes=num_scenes, options=make_options(**told), **own)


def _records(text: str) -> Iterator[Record]:
    """The scenes of one simulation, which runs once, when the first of them is made."""
    unit = read_unit(text)

    @cache
    def outcome() -> list[Scene] | SceneError:
        try:
            return simulate(unit)
        except SceneError as error:  # a cache keeps no errors, and each of its scenes would run the simulation again
            return error

    def make(index: int, notes: Notes) -> Scene:
        if isinstance(made := outcome(), SceneError):
            raise made
        return made[index]

    for index in range(unit.num_scenes):
        yield Record(text, index, partial(make, index))


def _size(text: str) -> int:
    """A number that changes with the user's own files, by their bytes, and with the settings of all simulations."""
    unit = read_unit(text)
    return sum(file_size(path) for path in (unit.net, unit.routes) if path) + settings_digest()


SUMO = Source(
    name="sumo",
    help="scenes simulated with SUMO; instead of files: num_scenes=160,seed=0,split=train,preset=mixed (or net=FILE)",
    find=_find,
    records=_records,
    count=lambda text: read_unit(text).num_scenes,
    size=_size,
    lacks=Lacks.HEIGHT,
)
"""One input is one simulation; a shard size that is a multiple of ``scenes_per_unit`` runs each only once."""
