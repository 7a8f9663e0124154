"""Unlimited multi-agent scenes from the traffic simulator SUMO; needs the extra ``sumo`` and no data at all.

    python -m envs.convert sumo num_scenes=160,split=train scenes/train --workers 2 --shard-size 12
    python -m envs.convert sumo num_scenes=24,split=test,max_agents=24 scenes/test --workers 2 --shard-size 12

A unit of work is one random network with one random traffic on it: :func:`units` lists them, :func:`simulate` turns one
into scenes, in any process. What a unit gives depends on its fields alone, so any number of workers gives the same
scenes. The splits draw from ranges of unit numbers that never meet: no two share a network.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import cache
from importlib.resources import files
from pathlib import Path

import yaml

from envs.scene import LOG_STEPS, STEP_SECONDS, Lacks, Scene, SceneError
from envs.sources.source import Record, Source
from envs.sources.sumo_map import build_map
from envs.sources.sumo_network import make_network, sumo_binary
from envs.sources.sumo_scene import Crop, cut_scene, sdc_candidates
from envs.sources.sumo_tracks import Tracks, make_tracks
from envs.sources.sumo_traffic import simulate_traffic

SPLITS = ("train", "tune", "test")
"""Names of the splits; the place of a name sets the range of its unit numbers."""
_SEEDS = 10_000
"""Seeds of a split; also units of a seed. The largest unit number then fits SUMO's 31-bit seed."""


@dataclass(frozen=True)
class SumoOptions:
    """Options of ``sumo.yaml``, which explains each one and holds all defaults."""

    scenes_per_unit: int
    windows: int
    window_spacing: float
    warmup: float
    radius: float
    map_margin: float
    max_agents: int
    min_agents: int
    max_predict: int
    point_spacing: float

    @property
    def crop(self) -> Crop:
        """What belongs to a scene."""
        return Crop(**{field.name: getattr(self, field.name) for field in fields(Crop)})


@dataclass(frozen=True)
class SumoUnit:
    """One simulation to run; small, hashable and picklable.

    Attributes:
        preset: name of a preset of one kind of network.
        number: seed of the network, of its traffic and of the simulation.
        num_scenes: how many scenes to cut from it.
        options: of the scenes.
    """

    preset: str
    number: int
    num_scenes: int
    options: SumoOptions

    @property
    def text(self) -> str:
        """The unit in words, as a store notes where a scene came from; options only where they are not the default.

        Examples:
            >>> units(5, max_agents=24)[0].text
            'preset=grid,number=0,num_scenes=5,max_agents=24'
        """
        default = make_options()
        told = {"preset": self.preset, "number": self.number, "num_scenes": self.num_scenes}
        names = [field.name for field in fields(SumoOptions)]
        told |= {n: getattr(self.options, n) for n in names if getattr(self.options, n) != getattr(default, n)}
        return ",".join(f"{name}={value}" for name, value in told.items())


@cache
def _settings() -> dict[str, dict]:
    return yaml.safe_load(files("envs.sources").joinpath("sumo.yaml").read_text(encoding="utf-8"))


def presets() -> list[str]:
    """Names of all presets.

    Examples:
        >>> presets()
        ['mixed', 'grid', 'town', 'irregular', 'arterial']
    """
    return list(_settings()["presets"])


def _known(what: str, unknown: Iterable[str], names: Iterable[str]) -> None:
    """Refuse names that do not exist."""
    for name in unknown:
        raise ValueError(f"SUMO scenes have no {what} {name!r}; there are {', '.join(names)}.")


def make_options(**overrides: float) -> SumoOptions:
    """The options of ``sumo.yaml``, some replaced.

    Raises:
        ValueError: an option that does not exist, or a value that makes no scenes.

    Examples:
        >>> make_options(radius=60.0).radius
        60.0
    """
    names = [field.name for field in fields(SumoOptions)]
    _known("option", sorted(set(overrides) - set(names)), names)
    options = replace(SumoOptions(**_settings()["options"]), **overrides)
    for name in names:
        if name != "warmup" and getattr(options, name) <= 0:
            raise ValueError(f"SUMO option {name} must be positive, got {getattr(options, name)}.")
    shortest = LOG_STEPS * STEP_SECONDS
    if options.window_spacing < shortest:
        raise ValueError(f"window_spacing must be at least {shortest:.1f} s, got {options.window_spacing}.")
    return options


def units(
    num_scenes: int, seed: int = 0, *, split: str = "train", preset: str = "mixed", **options: float
) -> list[SumoUnit]:
    """The simulations that together give ``num_scenes`` scenes.

    Args:
        num_scenes: scenes in all; the last unit may give fewer than the others.
        seed: 0 to 9999; each seed of each split has networks of its own.
        split: ``"train"``, ``"tune"`` or ``"test"``.
        preset: see :func:`presets`.
        **options: overrides of ``sumo.yaml``, see :class:`SumoOptions`.

    Raises:
        ValueError: an unknown split, preset or option, or a number out of range.

    Examples:
        >>> [(unit.preset, unit.number, unit.num_scenes) for unit in units(30, seed=3)]
        [('grid', 30000, 12), ('arterial', 30001, 12), ('town', 30002, 6)]
    """
    known = _settings()["presets"]
    _known("preset", {preset} - set(known), known)
    _known("split", {split} - set(SPLITS), SPLITS)
    if not 0 <= seed < _SEEDS:
        raise ValueError(f"seed must lie in 0 ... {_SEEDS - 1}, got {seed}.")
    chosen = make_options(**options)
    per_unit = chosen.scenes_per_unit
    if not 0 < num_scenes <= _SEEDS * per_unit:
        raise ValueError(
            f"num_scenes must lie in 1 ... {_SEEDS * per_unit}, got {num_scenes}; use another seed for more."
        )
    cycle = known[preset] if isinstance(known[preset], list) else [preset]
    first = (SPLITS.index(split) * _SEEDS + seed) * _SEEDS
    return [
        SumoUnit(cycle[i % len(cycle)], first + i, min(per_unit, num_scenes - done), chosen)
        for i, done in enumerate(range(0, num_scenes, per_unit))
    ]


def simulate(unit: SumoUnit) -> list[Scene]:
    """Run one simulation and cut its scenes.

    Args:
        unit: from :func:`units`.

    Returns:
        ``unit.num_scenes`` scenes, named ``sumo_<preset>_<number>_<start step>_<track id of the SDC>``.

    Raises:
        ImportError: the extra ``sumo`` is not installed.
        RuntimeError: SUMO failed.
        SceneError: the traffic holds fewer cars that can be an SDC than scenes are asked for.
    """
    options, rules = unit.options, _settings()["presets"][unit.preset]
    with tempfile.TemporaryDirectory(prefix="sumo_") as folder:
        network = make_network(Path(folder), rules["network"], rules["signalled"], unit.number)
        duration = options.windows * options.window_spacing
        recording = simulate_traffic(
            network, rules["traffic"], seed=unit.number, warmup=options.warmup, duration=duration
        )
    tracks, road = make_tracks(recording), build_map(network, options.point_spacing)
    scenes: list[Scene] = []
    for start, sdc in _turns(unit, tracks):
        name = f"sumo_{unit.preset}_{unit.number}_{start}_{tracks.track_id[sdc]}"
        scene = cut_scene(tracks, road, recording.lights, sdc, start, options.crop, name)
        if scene is not None:
            scenes.append(scene)
        if len(scenes) == unit.num_scenes:
            return scenes
    raise SceneError(
        f"SUMO unit {unit.preset} {unit.number} holds only {len(scenes)} of {unit.num_scenes} scenes; "
        "lower scenes_per_unit or min_agents, or simulate more windows."
    )


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


def generate(
    num_scenes: int, seed: int = 0, *, split: str = "train", preset: str = "mixed", **options: float
) -> Iterator[Scene]:
    """Scenes one by one, in this process (arguments of :func:`units`).

    Examples:
        >>> scene = next(generate(1, seed=5, preset="town", windows=1, warmup=10.0))
        >>> scene.scene_id.startswith("sumo_town_50000_0_"), scene.agents.position.shape[1:]
        (True, torch.Size([91, 3]))
    """
    for unit in units(num_scenes, seed, split=split, preset=preset, **options):
        yield from simulate(unit)


def parse(text: str) -> dict[str, object]:
    """Words ``name=value,name=value`` -> arguments; numbers become numbers.

    Raises:
        ValueError: a word without a ``=``.

    Examples:
        >>> parse("num_scenes=160,split=train,radius=60.5")
        {'num_scenes': 160, 'split': 'train', 'radius': 60.5}
    """
    words = [word.partition("=") for word in text.split(",")]
    bad = [word[0] for word in words if not word[1]]
    if bad:
        raise ValueError(
            f"{text!r}: {bad[0]!r} is not of the form name=value; write for example num_scenes=160,seed=0."
        )
    return {name.strip(): yaml.safe_load(value) for name, _, value in words}


def _find(requests: Sequence[str]) -> list[str]:
    """Requests of scenes (arguments of :func:`units`) -> one input for each simulation."""
    sumo_binary("sumo")  # say now, not in a worker, that SUMO is missing
    inputs = []
    for request in requests:
        try:
            inputs += [unit.text for unit in units(**parse(request))]
        except TypeError as error:
            raise ValueError(f"{request!r}: {error}; say for example num_scenes=160,seed=0,split=train.") from error
    return inputs


def _read_unit(text: str) -> SumoUnit:
    told = parse(text)
    preset, number, num_scenes = (told.pop(name) for name in ("preset", "number", "num_scenes"))
    return SumoUnit(preset, number, num_scenes, make_options(**told))


def _records(text: str) -> Iterator[Record]:
    """The scenes of one simulation, which runs once, when the first of them is made."""
    unit = _read_unit(text)
    scenes = cache(lambda: simulate(unit))
    for index in range(unit.num_scenes):
        yield Record(text, index, lambda notes, index=index: scenes()[index])


SUMO = Source(
    name="sumo",
    help="scenes simulated with SUMO; instead of files: num_scenes=160,seed=0,split=train,preset=mixed",
    find=_find,
    records=_records,
    count=lambda text: _read_unit(text).num_scenes,
    size=lambda text: 0,
    lacks=Lacks.HEIGHT,
)
"""One input is one simulation; a shard size that is a multiple of ``scenes_per_unit`` runs each only once."""
