"""Which pieces of the map policies of neighbourhoods look at."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from dpa.models import collate_contexts, make_context
from dpa.models.factorised import NeighbourhoodContext
from dpa.models.smart import SMART
from dpa.tokens import VerletTokenizer
from envs.scene import AgentKind, MapKind
from envs.sources.synthetic import build_scene

LANE, EDGE = MapKind.LANE_SURFACE_STREET, MapKind.EDGE_BOUNDARY


@pytest.fixture
def model() -> SMART:
    torch.manual_seed(0)
    return SMART("nano", VerletTokenizer()).eval()


def along(y: float) -> Tensor:
    x = torch.arange(-100.0, 101.0, 2.5)
    return torch.stack((x, torch.full_like(x, y)), -1)


def looked_at(model: SMART, speed: float, kind: AgentKind) -> tuple[NeighbourhoodContext, Tensor]:
    """The context of one agent on a lane among eight edges of the road, and the pieces that it looks at."""
    track = torch.zeros(1, 91, 3)
    track[0, :, 0] = speed * (torch.arange(91) - 10) / 10
    edges = [(EDGE, along(sign * (2 + row))) for row in range(4) for sign in (-1, 1)]
    scene = build_scene(track, [(LANE, along(0.0)), *edges])
    scene.agents.kind[:] = int(kind)
    context = collate_contexts([make_context(scene, model.featurize)])
    edges = model.map_edges(context, context.episode.recent, context.episode.kind)
    return context, edges.index[0][edges.valid[0]]


def places(context: NeighbourhoodContext, seen: Tensor, kind: MapKind) -> Tensor:
    """Where the pieces of a kind begin that are looked at [m]."""
    return context.map_pose[0, seen[context.map_kind[0, seen] == kind], 0]


def test_a_fast_car_sees_the_lane_all_along_its_next_two_seconds(model: SMART) -> None:
    context, seen = looked_at(model, 15.0, AgentKind.VEHICLE)
    lanes = places(context, seen, LANE)
    for ahead in torch.arange(0.0, 31.0, 2.5):
        assert (lanes - ahead).abs().min() <= 2.5, f"the piece at {ahead} m is not looked at"
    assert len(seen) == len(set(seen.tolist())) <= model.config.agent_pieces


def test_ahead_of_it_a_car_looks_at_lanes_alone_and_a_pedestrian_at_all(model: SMART) -> None:
    context, seen = looked_at(model, 15.0, AgentKind.VEHICLE)
    assert places(context, seen, EDGE).abs().max() < 5
    context, seen = looked_at(model, 15.0, AgentKind.PEDESTRIAN)
    assert places(context, seen, EDGE).max() > 25


def test_where_nobody_moves_all_looks_go_around_the_agent(model: SMART) -> None:
    context, seen = looked_at(model, 0.0, AgentKind.CYCLIST)
    lanes = places(context, seen, LANE).abs()
    assert len(lanes) >= 12 and lanes.max() <= model.config.agent_map_radius
