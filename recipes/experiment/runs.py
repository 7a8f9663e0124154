"""Where everything of a study lies: one folder, shared by all its experiments, so that nothing is made twice."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from dpa.models import Decoding
from dpa.report.table import REFERENCE

SNAPSHOT = "@"
"""Between a method and a step: ``dpa_omf@60`` is what DPA-OMF was after 60 steps."""


class Run(NamedTuple):
    """What is rolled out.

    Attributes:
        policy: a method, or one of its snapshots.
        decoding: how its tokens are drawn.
    """

    policy: str
    decoding: Decoding


@dataclass(frozen=True)
class RunFolder:
    """Paths in the folder of a study; policies are named by their method, with a step for a snapshot.

    Attributes:
        root: the folder.

    Examples:
        >>> runs = RunFolder(Path("runs/real"))
        >>> runs.policy(0, "dpa_omf@60").as_posix()
        'runs/real/seed_0/dpa_omf/step_60/policy.pt'
        >>> runs.evaluation(0, Run("reference", Decoding(0.9, 0.8)), "eval").as_posix()
        'runs/real/seed_0/reference/eval_top_p_0.9_t_0.8.json'
        >>> runs.preferences(0, "train", "dpa_omf", "collision").name
        'preferences_train_of_dpa_omf_by_collision'
    """

    root: Path

    def training(self, seed: int, policy: str) -> Path:
        """Folder of the training run; of a snapshot, its own folder inside."""
        method, _, step = policy.partition(SNAPSHOT)
        folder = self.root / f"seed_{seed}" / method
        return folder / f"step_{step}" if step else folder

    def policy(self, seed: int, policy: str) -> Path:
        """Weights."""
        return self.training(seed, policy) / "policy.pt"

    def preferences(self, seed: int, split: str, source: str = REFERENCE, ranking: str | None = None) -> Path:
        """Ranked rollouts of a policy; ranked by the collection's own distance, or by another one with a name."""
        of = "" if source == REFERENCE else f"_of_{source}"
        by = "" if ranking is None else f"_by_{ranking}"
        return self.root / f"seed_{seed}" / f"preferences_{split}{of}{by}"

    def evaluation(self, seed: int, run: Run, split: str) -> Path:
        """Figures of one policy at one decoding."""
        name = f"{split}_top_p_{run.decoding.top_p:g}_t_{run.decoding.temperature:g}.json"
        return self.training(seed, run.policy) / name

    def likelihood(self, seed: int, policy: str, split: str) -> Path:
        """How likely logs and ranked rollouts are under one policy."""
        return self.training(seed, policy) / f"likelihood_{split}.json"

    def experiment(self, name: str) -> Path:
        """What an experiment found."""
        return self.root / "experiments" / f"{name}.json"

    @property
    def stages(self) -> Path:
        """How long everything took."""
        return self.root / "stages.json"

    @property
    def scenes(self) -> Path:
        """What the scenes of each split hold."""
        return self.root / "scenes.json"

    @property
    def players(self) -> Path:
        """Scenes and rollouts to play."""
        return self.root / "players.json"

    @property
    def likely(self) -> Path:
        """Picture of the most likely rollout of each policy in these scenes."""
        return self.root / "likely.png"

    def relative(self, path: Path) -> str:
        """A path as results name it."""
        return path.relative_to(self.root).as_posix()


def method_of(policy: str) -> str:
    """The method whose policy, or whose snapshot, this is.

    Examples:
        >>> method_of("dpa_omf@60"), method_of("reference")
        ('dpa_omf', 'reference')
    """
    return policy.partition(SNAPSHOT)[0]
