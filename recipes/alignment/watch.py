"""A look at a policy in training: scenes that no loss sees (figures 4 and 6 of the paper)."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import NamedTuple

from numpy import nanmean
from omegaconf import DictConfig

from dpa.policy import ContextOptions, MotionLM
from envs.store import SceneStore
from recipes.alignment.likelihoods import PROBED, make_probes, probe
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
        context: how scenes are cut up.
        model: in training.
        options: the section ``alignment``.

    Raises:
        ValueError: rollouts of other scenes than the tuning ones.
    """

    def __init__(self, watch: Watch, context: ContextOptions, model: MotionLM, options: DictConfig) -> None:
        store = open_ranked_scenes(watch.preferences, watch.scenes)
        rows = range(min(options.watch_scenes, len(store)))
        pairs = min(options.watch_pairs, store.provenance.num_rollouts // 2)
        tokenizer = copy.deepcopy(model.tokenizer).cpu()  # logs are read on the CPU, wherever the model is
        self.probes = make_probes(store, watch.scenes, context, tokenizer, pairs, rows)
        reference, _, _ = open_policy(watch.reference)
        self.model, self.reference = model, reference.to(next(model.parameters()).device)

    def __call__(self, device: str) -> dict[str, float]:
        """Means over the scenes, as curves are named."""
        training = self.model.training
        self.model.eval()
        found = probe(self.model, self.reference, self.probes, device)
        self.model.train(training)
        return {f"tune/{name}": nanmean([each[name] for each in found]) for name in (*PROBED, "kl")}
