"""Policies kept along the way of an alignment."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from dpa.models import MotionModel
from recipes.common.models import write_policy


@dataclass(frozen=True)
class Snapshots:
    """Files of the policies that a run keeps, by the steps done.

    Examples:
        >>> from omegaconf import OmegaConf
        >>> options = OmegaConf.create({"snapshots": [20, 40, 400], "steps": 150})
        >>> [str(path) for path in Snapshots.of(Path("runs/dpa"), options).files.values()]
        ['runs/dpa/step_20/policy.pt', 'runs/dpa/step_40/policy.pt']
    """

    files: Mapping[int, Path]

    @classmethod
    def of(cls, folder: Path, options: DictConfig) -> Snapshots:
        """Those of a run.

        Args:
            folder: of the run.
            options: ``snapshots`` and ``steps`` of the section ``alignment``; later ones are left out.
        """
        return cls({step: folder / f"step_{step}" / "policy.pt" for step in options.snapshots if step <= options.steps})

    def check(self, done: int) -> None:
        """Refuse to go on with a run that kept other snapshots of the steps done: they cannot be had any more.

        Raises:
            ValueError: one is missing.
        """
        for step, path in self.files.items():
            if step <= done and not path.is_file():
                raise ValueError(
                    f"{path.parent.parent} was trained without a snapshot of step {step}, which alignment.snapshots "
                    "asks for; remove that folder to train it again, or leave the snapshot out."
                )

    def keep(self, done: int, model: MotionModel, config: dict[str, Any], described: dict[str, Any]) -> None:
        """Write the policy if one of these steps is done; arguments are those of :func:`write_policy`."""
        if done in self.files:
            write_policy(self.files[done], model, config, {**described, "step": done})
