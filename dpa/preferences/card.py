"""The data card of a preference store: what it holds, how clear its preferences are, what people would take for it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.stats import rankdata
from torch import Tensor

from dpa.preferences.pairs import nearest_farthest
from dpa.preferences.store import PreferenceStore

ANNOTATION_AGENTS = (1, 10, 20, 40, 80)
ANNOTATION_SECONDS = (0.7, 4.9, 9.8, 29.4, 42.1)
"""Time that a person takes to rank one pair, by number of agents [s] (paper appendix G)."""


@dataclass(frozen=True)
class DataCard:
    """Numbers about a store; means over scenes.

    Attributes:
        scenes: S.
        rollouts: K.
        pairs: M, pairs of each scene (nearest against farthest).
        agents: ranked agents of all scenes.
        tied_scenes: scenes whose rollouts are all at one distance, so that their pairs carry no preference.
        tied_pairs: share of pairs of which both sides are at one distance.
        margin: distance of the unpreferred minus that of the preferred rollout of a pair.
        relative_margin: the same divided by the mean distance of the scene.
        spearman: rank correlation of preference distance and ADE within a scene; over scenes where both vary.
        human_hours: time that one person would take to rank the pairs, beyond 80 agents as if there were 80 [h].
    """

    scenes: int
    rollouts: int
    pairs: int
    agents: int
    tied_scenes: int
    tied_pairs: float
    margin: float
    relative_margin: float
    spearman: float
    human_hours: float

    def __str__(self) -> str:
        return "\n".join(
            (
                f"scenes               {self.scenes}",
                f"rollouts per scene   {self.rollouts}",
                f"ranked agents        {self.agents} ({self.agents / max(self.scenes, 1):.1f} per scene)",
                f"pairs                {self.scenes * self.pairs} ({self.pairs} per scene, nearest against farthest)",
                f"margin of a pair     {self.margin:.3f} ({self.relative_margin:.0%} of the scene's mean distance)",
                f"without preference   {self.tied_scenes} scenes, {self.tied_pairs:.1%} of pairs",
                f"distance and ADE     Spearman {self.spearman:.2f}",
                f"ranked by a person   {self.human_hours:.1f} h ({self.human_hours / 24:.1f} days without a break)",
            )
        )


def data_card(store: PreferenceStore, pairs: int | None = None) -> DataCard:
    """Look through a store.

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
        >>> data_card(PreferenceStore(folder)).pairs
        2
    """
    if len(store) == 0:
        raise ValueError(f"{store.folder} holds no scene yet; append groups to it first.")
    distance = store.distance
    pairs = max(1, distance.shape[1] // 4) if pairs is None else pairs
    preferred, unpreferred = nearest_farthest(distance, pairs)
    margin = distance.gather(1, unpreferred) - distance.gather(1, preferred)
    scale = distance.mean(1, keepdim=True).clamp_min(torch.finfo(torch.float32).tiny)
    agents = store.ranked_agents()
    return DataCard(
        scenes=len(store),
        rollouts=distance.shape[1],
        pairs=pairs,
        agents=int(agents.sum()),
        tied_scenes=int((distance == distance[:, :1]).all(1).sum()),
        tied_pairs=float((margin == 0).float().mean()),
        margin=float(margin.mean()),
        relative_margin=float((margin / scale).mean()),
        spearman=mean_spearman(distance, store.ade),
        human_hours=float(annotation_seconds(agents).sum()) * pairs / 3600,
    )


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


def mean_spearman(first: Tensor, second: Tensor) -> float:
    """Mean over scenes of the rank correlation of two measures of the same rollouts.

    Args:
        first: ``[S, K]``.
        second: ``[S, K]``.

    Returns:
        between -1 and 1, ties at their mean rank; nan when in every scene one of the two is constant.

    Examples:
        >>> round(mean_spearman(torch.tensor([[1.0, 2, 3], [5, 5, 5]]), torch.tensor([[4.0, 6, 5], [1, 2, 3]])), 3)
        0.5
    """
    ranks = np.stack([rankdata(value.numpy(), axis=1) for value in (first, second)])
    ranks -= ranks.mean(-1, keepdims=True)
    norm = np.linalg.norm(ranks, axis=-1).prod(0)
    vary = norm > 0
    return float((ranks.prod(0).sum(-1)[vary] / norm[vary]).mean()) if vary.any() else float("nan")
