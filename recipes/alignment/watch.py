"""Looks at a policy in training: at what no loss sees (figures 4 and 6 of the paper), or imitation does not see."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

from numpy import isnan, nanmean
from omegaconf import DictConfig

from dpa.losses.network import without_dropout
from dpa.models import Contexts, MotionModel
from dpa.preferences import PreferenceStore
from envs.episode import EpisodeOptions
from envs.options import differences
from envs.store import SceneStore
from recipes.alignment.likelihoods import make_probes, probe, probe_sides
from recipes.common.models import open_policy
from recipes.common.rankings import open_ranked_scenes


class Watch(NamedTuple):
    """Scenes that no loss sees, and ranked rollouts of them, to look at along the way.

    Attributes:
        scenes: tuning scenes.
        preferences: folder of a store of ranked rollouts of them.
        reference: file of the policy that drift is measured from; in a second round it is not the one that the
            training starts from.
    """

    scenes: SceneStore
    preferences: Path
    reference: Path


class Look:
    """A look at the policy in training: what it thinks of logs and rollouts of scenes that no loss sees.

    Args:
        watch: the scenes.
        episode: options of their episodes.
        model: in training.
        options: the section ``alignment``.
        tokenizer: options that decide what a token of the model means.

    Raises:
        ValueError: rollouts of other scenes than the tuning ones, in other tokens, or one of each alone.
    """

    def __init__(
        self,
        watch: Watch,
        episode: EpisodeOptions,
        model: MotionModel,
        options: DictConfig,
        tokenizer: dict[str, Any],
    ) -> None:
        store = open_ranked_scenes(watch.preferences, watch.scenes)
        for name, mine in (("tokenizer", tokenizer), ("horizon", episode.horizon)):
            other = getattr(store.provenance, name)
            if differences({name: other}, {name: mine}):
                raise ValueError(
                    f"{store.folder} has {name} {other}, and the policy in training {mine}; let a policy of the same "
                    "tokens roll the watched scenes out."
                )
        if store.provenance.num_rollouts < 2:
            raise ValueError(
                f"{store.folder} holds one rollout of each scene, and a pair needs two; collect again with "
                "collection.num_rollouts=2 or more."
            )
        rows = range(min(options.watch_scenes, len(store)))
        pairs = min(options.watch_pairs, store.provenance.num_rollouts // 2)
        tokenizer = model.tokenizer.on_cpu()
        contexts = Contexts(watch.scenes, model.featurize, episode, most=1)
        self.probes = list(make_probes(store, contexts, tokenizer, pairs, rows))
        reference, _, _ = open_policy(watch.reference)
        self.model, self.reference = model, reference.to(next(model.parameters()).device)

    def __call__(self, device: str) -> dict[str, float]:
        """Means over the scenes, as curves are named."""
        with without_dropout(self.model):
            found = probe(self.model, self.reference, self.probes, device)
        return _means("tune", found)


class ImitationLook:
    """A look at what imitation is to bring apart: nearest and farthest rollouts of scenes that it learns from.

    A preference loss reads both sides and logs these figures of each step; one that imitates reads the near side alone.

    Args:
        store: of the rollouts, two or more of each scene.
        scenes: that it is of.
        episode: options of their episodes.
        model: in training.
        options: the section ``alignment``.
        rank_by: ``distance`` or ``ade``, by which the method ranks.
        learnt: indices of the scenes that the method learns from.
    """

    def __init__(
        self,
        store: PreferenceStore,
        scenes: SceneStore,
        episode: EpisodeOptions,
        model: MotionModel,
        options: DictConfig,
        rank_by: str,
        learnt: Collection[int],
    ) -> None:
        among = set(learnt)
        rows = (row for row, scene in enumerate(store.scenes.tolist()) if scene in among)
        pairs = min(options.watch_pairs, store.provenance.num_rollouts // 2)
        tokenizer = model.tokenizer.on_cpu()
        kept = list(islice(rows, options.watch_scenes))
        contexts = Contexts(scenes, model.featurize, episode, most=1)
        self.probes = list(make_probes(store, contexts, tokenizer, pairs, kept, rank_by))
        self.model = model

    def __call__(self, device: str) -> dict[str, float]:
        """Means over the scenes, as curves are named."""
        with without_dropout(self.model):
            found = probe_sides(self.model, self.probes, device)
        return _means("train", found)


def _means(where: str, found: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Means over the scenes that have a figure, without figures that none has."""
    figures = {name: [each[name] for each in found] for name in found[0]}
    return {f"{where}/{name}": nanmean(each) for name, each in figures.items() if not isnan(each).all()}
