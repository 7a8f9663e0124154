"""The auxiliary loss of SMART: which way a lane goes on where its next piece is hidden."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from dpa.losses import NextTokenLoss, token_network
from dpa.models import collate_contexts, make_context
from dpa.models.factorised import NeighbourhoodContext
from dpa.models.smart import SMART
from dpa.models.smart.road import TURN, TURNS, NextPiece, next_turn
from dpa.tokens import VerletTokenizer
from envs.scene import MapKind, Scene
from envs.sources.synthetic import build_scene

LANE = MapKind.LANE_SURFACE_STREET


def polyline(*turns: float) -> Tensor:
    """Pieces of 5 m in three points each, the first along x, each of the others turned by so much."""
    heading = torch.tensor([0.0, *turns]).cumsum(0).repeat_interleave(2)
    moves = 2.5 * torch.stack((heading.cos(), heading.sin()), -1)
    return torch.cat((torch.zeros(1, 2), moves.cumsum(0)))


def scene_of(*lines: tuple[int, Tensor]) -> Scene:
    return build_scene(torch.zeros(1, 91, 3), list(lines))


def context_of(model: SMART, *lines: tuple[int, Tensor]) -> NeighbourhoodContext:
    return collate_contexts([make_context(scene_of(*lines), model.featurize)])


@pytest.fixture
def model() -> SMART:
    torch.manual_seed(0)
    return SMART("nano", VerletTokenizer()).eval()


def test_the_turn_to_the_next_piece_is_its_class(model: SMART) -> None:
    turns = (0.0, 0.2, -0.4, 2.0, -2.0)
    turn, known = next_turn(context_of(model, (LANE, polyline(*turns))))
    straight = TURNS // 2
    told = [round(straight + each / TURN) for each in turns[:3]] + [TURNS - 1, 0]
    assert known.all() and turn.tolist() == [told]


def test_a_line_goes_on_in_one_that_begins_where_it_ends_and_is_of_its_kind(model: SMART) -> None:
    one = polyline(0.0)
    goes_on, elsewhere = one + one[-1], one + torch.tensor([0.0, 40.0])
    _, known = next_turn(context_of(model, (LANE, one), (LANE, goes_on), (LANE, elsewhere)))
    assert known.tolist() == [[True, True, True, False, True]]
    _, known = next_turn(context_of(model, (LANE, one), (MapKind.EDGE_BOUNDARY, goes_on)))
    assert known.tolist() == [[True, False, True]]


def test_padding_goes_on_from_nothing(model: SMART) -> None:
    scenes = [scene_of((LANE, polyline(*each))) for each in ((0.0, 0.0), (0.1,))]
    _, known = next_turn(collate_contexts([make_context(scene, model.featurize) for scene in scenes]))
    assert known.tolist() == [[True, True], [True, False]]


@torch.no_grad()
def test_a_hidden_piece_is_seen_by_itself_alone(model: SMART) -> None:
    context = context_of(model, (LANE, polyline(0.1, 0.2, 0.1)))
    hidden = torch.tensor([[False, True, False, False]])
    before, seen = model.read_map(context, hidden), model.read_map(context)
    context.map_points[:, 1] *= 3.0
    context.map_pose[:, 1, 2] += 0.3
    same = (model.read_map(context, hidden) == before).all(-1)
    assert same.tolist() == [True, False, True, True]
    assert not (model.read_map(context) == seen).all(-1).any()


@torch.no_grad()
def test_it_is_the_mean_surprise_of_those_who_are_asked(model: SMART, monkeypatch: pytest.MonkeyPatch) -> None:
    """Even logits: log of the number of classes, where anybody is asked."""
    context, loss = context_of(model, (LANE, polyline(0.1, 0.2, 0.1))), NextPiece(36)
    loss.head[-1].weight.zero_()
    loss.head[-1].bias.zero_()
    loss.head[-1].bias[TURNS // 2 + 5] = 3.0  # 0.2 rad to the left
    drawn = torch.tensor([[0.9, 0.9, 0.1, 0.9]])  # the third is hidden, the second is asked
    monkeypatch.setattr(torch, "rand", lambda *_, **__: drawn)
    assert loss(model, context).item() == pytest.approx(math.log(math.exp(3) + TURNS - 1) - 3, rel=1e-5)
    drawn = torch.full((1, 4), 0.9)
    assert loss(model, context).item() == 0, "nothing is hidden"


def test_lanes_teach_the_map_layers_which_way_they_go_on(model: SMART) -> None:
    """Those of one kind bend to the left, those of the other to the right."""
    kinds = ((LANE, 0.2), (MapKind.LANE_FREEWAY, -0.2))
    lines = [(kind, polyline(*[turn] * 6) + 100 * turn) for kind, turn in kinds]
    context, loss = context_of(model, *lines), NextPiece(36)
    optimizer = torch.optim.Adam([*model.parameters(), *loss.parameters()], 3e-3)
    torch.manual_seed(1)
    values = []
    for _ in range(60):
        optimizer.zero_grad()
        value = loss(model, context)
        value.backward()
        optimizer.step()
        values.append(value.item())
    assert sum(values[-10:]) < 0.1 * sum(values[:10])


def test_it_is_added_to_the_loss_of_the_tokens_by_its_weight(model: SMART) -> None:
    context = context_of(model, (LANE, polyline(*[0.1] * 20)))
    tokens, valid = torch.full((1, 1, 1, 16), 84), torch.ones(1, 1, 1, 16, dtype=torch.bool)
    batch = TensorDict({"context": context, "tokens": tokens, "token_valid": valid}, batch_size=[1])
    auxiliary, network = NextPiece(36), token_network(model, "bfloat16")
    plain = NextTokenLoss(network)
    loss = NextTokenLoss(network, auxiliary=auxiliary, auxiliary_weight=0.5)
    torch.manual_seed(3)
    alone = auxiliary(model, context)
    torch.manual_seed(3)
    out = loss(batch)
    assert alone > 0
    assert out["loss_auxiliary"].item() == pytest.approx(0.5 * alone.item(), rel=1e-5)
    assert out["loss_next_token"] == plain(batch)["loss_next_token"]
    sum(out[name] for name in loss.out_keys if name.startswith("loss_")).backward()
    assert all(each.grad.abs().sum() > 0 for each in auxiliary.parameters())
