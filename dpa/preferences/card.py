"""The data card of a preference store: what it holds, how clear its preferences are, what people would take for it."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from dpa.preferences.pairs import nearest_farthest
from dpa.preferences.provenance import SHAPE, Provenance
from dpa.preferences.store import PreferenceStore
from dpa.ranking.agreement import rank_correlation
from envs.scene import AgentKind
from envs.shards import check_shape

ANNOTATION_AGENTS = (1, 10, 20, 40, 80)
ANNOTATION_SECONDS = (0.7, 4.9, 9.8, 29.4, 42.1)
"""Time that a person takes to rank one pair, by number of agents [s] (paper appendix G)."""


CLASSES = {"vehicle": AgentKind.VEHICLE, "pedestrian": AgentKind.PEDESTRIAN, "cyclist": AgentKind.CYCLIST}
"""Classes that the card tells apart; all others are ``other``."""


_NUMBER = float | None
_SHAPE = {
    **dict.fromkeys(("scenes", "rollouts", "pairs", "agents", "tied_scenes"), int),
    **dict.fromkeys(("tied_pairs", "margin", "relative_margin", "spearman", "same_side"), _NUMBER),
    **dict.fromkeys(("human_hours", "scene_bytes"), _NUMBER),
    "classes": {str: {"agents": int, "distance": _NUMBER}},
    "feature_shares": {str: _NUMBER},
    "origin": SHAPE,
}
"""Of what :meth:`DataCard.to_json` gives, see :func:`~envs.shards.check_shape`."""


@dataclass(frozen=True)
class ClassDistance:
    """How far the agents of one class are from the log.

    Attributes:
        agents: ranked agents of all scenes.
        distance: mean over these and the rollouts; nan if there is none.
    """

    agents: int
    distance: float


@dataclass(frozen=True)
class DataCard:
    """Numbers about a store; means over scenes.

    Attributes:
        scenes: S.
        rollouts: K.
        pairs: M, pairs of each scene (nearest against farthest).
        agents: ranked agents of all scenes.
        classes: agents and distances by class.
        feature_shares: mean share of each feature in the distance of a rollout; empty if the store has none.
        tied_scenes: scenes whose rollouts are all at one distance, so that their pairs carry no preference.
        tied_pairs: share of pairs of which both sides are at one distance.
        margin: distance of the unpreferred minus that of the preferred rollout of a pair.
        relative_margin: the same divided by the mean distance of the scene.
        spearman: rank correlation of preference distance and ADE within a scene; over scenes where both vary.
        same_side: share of the pairs that ADE makes (nearest against farthest by it) which the preference distance
            orders alike, half of the tied ones; at 1 both rankings teach the same.
        human_hours: time that one person would take to rank the pairs, beyond 80 agents as if there were 80 [h].
        scene_bytes: of the files for each scene.
        origin: what the groups came from.
    """

    scenes: int
    rollouts: int
    pairs: int
    agents: int
    classes: dict[str, ClassDistance]
    feature_shares: dict[str, float]
    tied_scenes: int
    tied_pairs: float
    margin: float
    relative_margin: float
    spearman: float
    same_side: float
    human_hours: float
    scene_bytes: float
    origin: Provenance

    def __str__(self) -> str:
        shares = [f"{name} {share:.0%}" for name, share in self.feature_shares.items()]
        kinds = [
            f"{f'distance, {name}':20} {kind.distance:.3f} in the mean over {kind.agents} agents"
            for name, kind in self.classes.items()
            if kind.agents
        ]
        return "\n".join(
            (
                f"scenes               {self.scenes}",
                f"rollouts per scene   {self.rollouts}",
                f"ranked agents        {self.agents} ({self.agents / self.scenes:.1f} per scene)",
                f"pairs                {self.scenes * self.pairs} ({self.pairs} per scene, nearest against farthest)",
                f"margin of a pair     {self.margin:.3f} ({self.relative_margin:.0%} of the scene's mean distance)",
                f"without preference   {self.tied_scenes} scenes, {self.tied_pairs:.1%} of pairs",
                *kinds,
                f"distance made of     {', '.join(shares) or 'not stored'}",
                f"distance and ADE     Spearman {self.spearman:.2f}, {self.same_side:.0%} of ADE's pairs ordered alike",
                f"ranked by a person   {self.human_hours:.1f} h ({self.human_hours / 24:.1f} days without a break)",
                f"on disk              {self.scene_bytes / 1000:.1f} kB per scene",
                "",
                f"origin\n{self.origin.to_json()}",
            )
        )

    def to_json(self) -> dict[str, Any]:
        """The same as plain values, None in place of a nan."""
        return _finite(asdict(self))

    @classmethod
    def from_json(cls, content: Any) -> DataCard:
        """What :meth:`to_json` gave.

        Raises:
            ValueError: it is of another shape; the message says where.
        """
        check_shape(content, _SHAPE, "card")
        numbers = {name: _number(content[name]) for name, shape in _SHAPE.items() if shape is _NUMBER}
        classes = {
            name: ClassDistance(each["agents"], _number(each["distance"])) for name, each in content["classes"].items()
        }
        shares = {name: _number(share) for name, share in content["feature_shares"].items()}
        return cls(
            **content
            | numbers
            | {"classes": classes, "feature_shares": shares, "origin": Provenance(**content["origin"])}
        )


def data_card(store: PreferenceStore, pairs: int | None = None) -> DataCard:
    """Look through a store; every group is read once and none is kept.

    Args:
        store: with at least one scene.
        pairs: M; a quarter of K by default, as in the paper (16 of 64).

    Raises:
        ValueError: the store is empty, or K is too small for the pairs.

    Examples:
        >>> import tempfile
        >>> from dpa.preferences.examples import example_groups, example_provenance
        >>> from dpa.preferences.writer import PreferenceWriter
        >>> folder = tempfile.mkdtemp()
        >>> with PreferenceWriter(folder, example_provenance()) as writer:
        ...     writer.append(example_groups(num_scenes=3))
        3
        >>> data_card(PreferenceStore(folder)).pairs
        2
    """
    if len(store) == 0:
        raise ValueError(f"{store.folder} holds no scene yet; append groups to it first.")
    content = _gather(store)
    distance = content.distance
    pairs = max(1, distance.shape[1] // 4) if pairs is None else pairs
    preferred, unpreferred = nearest_farthest(distance, pairs)
    margin = distance.gather(1, unpreferred) - distance.gather(1, preferred)
    scale = distance.mean(1, keepdim=True).clamp_min(torch.finfo(torch.float32).tiny)
    return DataCard(
        scenes=len(store),
        rollouts=distance.shape[1],
        pairs=pairs,
        agents=int(content.agents.sum()),
        classes=content.classes,
        feature_shares=content.feature_shares,
        tied_scenes=int((distance == distance[:, :1]).all(1).sum()),
        tied_pairs=float((margin == 0).float().mean()),
        margin=float(margin.mean()),
        relative_margin=float((margin / scale).mean()),
        spearman=_mean_correlation(distance, content.ade),
        same_side=_same_side(distance, content.ade, pairs),
        human_hours=float(annotation_seconds(content.agents).sum()) * pairs / 3600,
        scene_bytes=store.num_bytes / len(store),
        origin=store.provenance,
    )


def _same_side(distance: Tensor, ade: Tensor, pairs: int) -> float:
    nearer, farther = (distance.gather(1, side) for side in nearest_farthest(ade, pairs))
    return float(((nearer < farther).float() + 0.5 * (nearer == farther).float()).mean())


class _Content(NamedTuple):
    """What the card reads of all groups: ``[S, K]``, ``[S, K]``, ``[S]``, by class, and by feature."""

    distance: Tensor
    ade: Tensor
    agents: Tensor
    classes: dict[str, ClassDistance]
    feature_shares: dict[str, float]


def _gather(store: PreferenceStore) -> _Content:
    """One pass over the groups."""
    distance, ade, agents, shares = [], [], [], []
    count, total = np.zeros(max(AgentKind) + 1, np.int64), np.zeros(max(AgentKind) + 1)
    for group in store:
        distance.append(group.distance)
        ade.append(group.ade)
        agents.append(int(group.agent_ranked.sum()))
        shares.append(group.feature_share.mean(0))
        kinds = group.agent_kind[group.agent_ranked]
        np.add.at(count, kinds, 1)
        np.add.at(total, kinds, group.agent_distance[group.agent_ranked].mean(1))
    sets = {name: [kind] for name, kind in CLASSES.items()}
    sets["other"] = [kind for kind in AgentKind if kind not in CLASSES.values()]
    classes = {}
    for name, kinds in sets.items():
        number = int(count[kinds].sum())
        classes[name] = ClassDistance(number, float(total[kinds].sum() / number) if number else float("nan"))
    mean = np.stack(shares).mean(0, dtype=np.float64).tolist()
    return _Content(
        distance=torch.from_numpy(np.stack(distance)),
        ade=torch.from_numpy(np.stack(ade)),
        agents=torch.tensor(agents),
        classes=classes,
        feature_shares=dict(zip(store.provenance.features, mean, strict=True)) if mean else {},
    )


def _finite(value: Any) -> Any:
    """JSON has no nan."""
    if isinstance(value, dict):
        return {key: _finite(inner) for key, inner in value.items()}
    return None if isinstance(value, float) and math.isnan(value) else value


def _number(value: float | None) -> float:
    return math.nan if value is None else value


def annotation_seconds(agents: Tensor) -> Tensor:
    """Time that a person takes to rank one pair, between the paper's points.

    Args:
        agents: ``[S]``, agents of each scene.

    Returns:
        ``[S]`` [s].

    Examples:
        >>> annotation_seconds(torch.tensor([1, 30, 200]))
        tensor([ 0.7000, 19.6000, 42.1000], dtype=torch.float64)
    """
    return torch.from_numpy(np.interp(agents.numpy(), ANNOTATION_AGENTS, ANNOTATION_SECONDS))


def _mean_correlation(first: Tensor, second: Tensor) -> float:
    """Mean of the rank correlation over the scenes that have one; nan if none has."""
    found = rank_correlation(first, second)
    return float(np.nanmean(found)) if not np.isnan(found).all() else float("nan")
