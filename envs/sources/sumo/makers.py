"""Random road networks: by SUMO's ``netgenerate``, or drawn here and built by ``netconvert``."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from envs.sources.sumo.motorway import make_motorway
from envs.sources.sumo.network import Network, read_network, run_sumo
from envs.sources.sumo.options import draw_options
from envs.sources.sumo.plain import PlainRoads, convert_roads
from envs.sources.sumo.roundabout import make_roundabouts

NETGENERATE_RULES = {
    # nobody turns round in the middle of a road; a street that ends is an end of the world
    "no-turnarounds": True,
    # the corner of a kerb and the shape of a turn: wide and fine enough for a truck and for a smooth heading
    "default.junctions.radius": 6,
    "junctions.internal-link-detail": 8,
    "default.bikelane-width": 1.5,
    "precision": 3,
}
"""What every network of netgenerate has in common."""
DRAWN: dict[str, Callable[[dict[str, float], np.random.Generator], PlainRoads]] = {
    "motorway": make_motorway,
    "roundabout": make_roundabouts,
}
"""Makers of roads that netgenerate cannot make."""


def make_network(folder: Path, rules: dict[str, object], signalled: float, seed: int) -> Network:
    """Make one network.

    Args:
        folder: where ``net.xml`` is written.
        rules: the ``network`` of a preset in ``sumo.yaml``: its ``maker``, and what that is told; pairs are drawn, see
            :func:`~envs.sources.sumo.options.draw_options`.
        signalled: share of the junctions of ``netgenerate`` that get a traffic light; 1 leaves the choice to ``rules``.
        seed: of the network.

    Raises:
        ImportError: SUMO is not installed.
        RuntimeError: ``netgenerate`` or ``netconvert`` refused the options.
    """
    rng = np.random.default_rng(seed)
    rules = dict(rules)
    maker = rules.pop("maker")
    drawn = draw_options(rules, rng)
    if maker in DRAWN:
        return convert_roads(DRAWN[maker](drawn, rng), folder, seed)
    options = NETGENERATE_RULES | drawn | {"seed": seed, "output-file": folder / "net.xml"}
    run_sumo("netgenerate", options)
    network = read_network(folder / "net.xml")
    if signalled < 1:
        crossroads = sorted({edge.end for edge in network.edges.values()} - network.dead_ends)
        chosen = [node for node in crossroads if rng.random() < signalled]
        if chosen:
            run_sumo("netgenerate", options | {"tls.set": ",".join(chosen)})
            network = read_network(folder / "net.xml")
    return network
