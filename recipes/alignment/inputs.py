"""What an alignment starts from and learns from, read and checked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from dpa.models import Contexts, MotionModel
from dpa.preferences import PreferenceStore
from envs.episode import EpisodeOptions
from envs.progress import message
from envs.store import SceneStore
from recipes.alignment.candidates import Candidates, make_candidates
from recipes.alignment.data import ON_POLICY, ROLLED, SIDES, rewards_of
from recipes.alignment.watch import ImitationLook, Look, Watch
from recipes.common.cli import deciding, plain
from recipes.common.models import open_policy, weights_digest
from recipes.common.rankings import build_distance, open_preferences
from recipes.common.scenes import fingerprint

OBSERVING = (
    *("checkpoint_interval", "max_rows", "snapshots", "watch_interval", "watch_scenes", "watch_pairs"),
    *("memory", "workers"),
)
"""Options of the section ``alignment`` that change nothing about the policy."""


@dataclass(frozen=True)
class Inputs:
    """A policy, and ranked rollouts of it, for a method that learns from such.

    Attributes:
        model: to align, without dropout.
        episode: options of its episodes.
        config: of the model, as its file has it.
        scenes: that the rollouts are of.
        store: of the rollouts; None for a method that makes its own in every step.
        expert: store of the rollouts of an expert in the same scenes, if there is one.
        learnt: indices of the scenes to learn from.
    """

    model: MotionModel
    episode: EpisodeOptions
    config: dict[str, Any]
    scenes: SceneStore
    store: PreferenceStore | None
    expert: PreferenceStore | None
    learnt: list[int]

    @classmethod
    def open(
        cls,
        policy: Path,
        preferences: Path | None,
        expert: Path | None,
        scenes: SceneStore,
        among: Sequence[int] | None,
        device: str,
    ) -> Inputs:
        """Read a policy and the stores.

        Args:
            policy: file of the policy.
            preferences: folder of the store that :mod:`recipes.collect` made with it; None: there is none.
            expert: folder of the store of an expert.
            scenes: that the preferences are of.
            among: indices of the scenes to learn from; by default all, or all that the preferences are of: where these
                are not all scenes it is told how many.
            device: of the model.

        Raises:
            ValueError: preferences of other scenes or of another policy, or that lack a scene of ``among``.
        """
        model, episode, config = open_policy(policy, device)
        if preferences is None:
            everything = list(range(len(scenes)))
            return cls(model, episode, config, scenes, None, None, everything if among is None else sorted(among))
        store = open_preferences(preferences, scenes, model, policy)
        ranked = set(store.scenes.tolist())
        learnt = sorted(ranked if among is None else among)
        if missing := len(set(learnt) - ranked):
            raise ValueError(
                f"{preferences} lacks {missing} of the {len(learnt)} scenes to learn from; run what fills it to the "
                "end."
            )
        if among is None and len(learnt) < len(scenes):
            message(f"{preferences} holds {len(learnt)} of {len(scenes)} scenes; only these are learnt from.")
        return cls(model, episode, config, scenes, store, None if expert is None else PreferenceStore(expert), learnt)

    def deciding(self, method: DictConfig, alignment: DictConfig, seed: int) -> dict[str, Any]:
        """All that decides what becomes of the policy: a run with the same goes on, or is finished.

        Args:
            method: ``data`` and ``loss``.
            alignment: the section.
            seed: of batches.
        """
        kind, data = method.data.kind, plain(method.data)
        read = {"pairs_per_scene": kind not in ON_POLICY, "staleness": kind in ROLLED}
        says_nothing = [name for name, of_use in read.items() if not of_use]
        if kind in ROLLED:  # of a metric in a file its content counts, and not how many threads rank
            data["ranking"] = build_distance(method.data.ranking, "method.data.ranking").describe()
        if "rewards" in data:
            data["rewards"] = rewards_of(method.data)
        return {
            "data": data,
            "loss": plain(method.loss),
            "alignment": deciding(alignment, *OBSERVING, *says_nothing),
            "scenes": fingerprint(self.scenes.subset(self.learnt)),
            "seed": seed,
            "reference": weights_digest(self.model),
            "preferences": None if self.store is None else asdict(self.store.provenance),
            "expert": None if self.expert is None else asdict(self.expert.provenance),
        }

    def candidates(self, data: DictConfig, seed: int) -> Candidates:
        """See :func:`~recipes.alignment.candidates.make_candidates`."""
        tokenizer = self.model.tokenizer.on_cpu()
        contexts = Contexts(self.scenes, self.model.featurize, self.episode)
        return make_candidates(data, self.store, contexts, tokenizer, seed, self.expert, self.learnt)

    def looks(self, data: DictConfig, alignment: DictConfig, watch: Watch | None) -> list[Look | ImitationLook]:
        """What is looked at along the way: what no loss sees, and what a method that imitates does not see.

        Args:
            data: of the method.
            alignment: the section.
            watch: scenes that no loss sees, if some are to be looked at.
        """
        looks: list[Look | ImitationLook] = []
        if watch is not None:
            looks.append(Look(watch, self.episode, self.model, alignment, self.config["tokenizer"]))
        if self.store is not None and SIDES[data.kind] == "targets" and self.store.provenance.num_rollouts > 1:
            looks.append(
                ImitationLook(self.store, self.scenes, self.episode, self.model, alignment, data.rank_by, self.learnt)
            )
        return looks
