"""What a discriminator learns from: the log of a scene beside its rollouts, seen alike, and kept on disk until then."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from dpa.discriminator import ROAD, observed_motion, width_of
from dpa.ranking.features import feature_names
from envs.files import PARTIAL_PREFIX, read_arrays, whole, write_json
from envs.options import differences
from envs.scene import CURRENT_STEP
from recipes.common.rolled import Rolled


class Motions(NamedTuple):
    """The controlled agents of one scene, as a discriminator sees them.

    Attributes:
        log: ``[1, E, T, D]``.
        rollouts: ``[K, E, T, D]``.
        valid: ``[E, T]`` bool, the same for both.
    """

    log: Tensor
    rollouts: Tensor
    valid: Tensor


@dataclass(frozen=True)
class Sight:
    """How a discriminator looks at scenes.

    Args:
        stride: see :func:`~dpa.discriminator.observed_motion`.
        road: names of features that it sees of the road and of what is near.
        tokenized: the log goes through tokens and back, as rollouts do. Otherwise motions that no token makes give the
            log away.

    Raises:
        ValueError: no such stride, or an unknown feature.

    Examples:
        >>> Sight().width
        33
    """

    stride: int = 5
    road: Sequence[str] = ROAD
    tokenized: bool = True

    def __post_init__(self) -> None:
        if not 1 <= self.stride <= CURRENT_STEP:
            raise ValueError(f"stride must be 1 to {CURRENT_STEP}, the history of a scene, got {self.stride!r}.")
        feature_names(self.road)

    @property
    def width(self) -> int:
        """D: numbers that are seen of an agent at a step."""
        return width_of(self.road)

    def __call__(self, each: Rolled, log: Tensor, decision_steps: int = 1) -> Motions:
        """See a scene's rollouts, and its log as ``[A, 80, 4]``, which may have been decoded from tokens."""
        ego = each.controlled.nonzero()[:, 0]
        both = torch.cat((log[None].to(each.trajectories), each.trajectories))
        looks = {"stride": self.stride, "road": self.road, "decision_steps": decision_steps}
        values, valid = observed_motion(each.scene, both, ego=ego, **looks)
        return Motions(values[:1], values[1:], valid)


class MotionShelf:
    """A folder with the motions of scenes, one file each, which appears whole or not at all.

    Numbers are kept as float16: nobody sees a centimetre at 50 m.

    Args:
        folder: made if it is not there.
        decided_by: all that decides the motions, ready for JSON.

    Raises:
        ValueError: the folder holds motions of other options, or its options are damaged.

    Examples:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     shelf = MotionShelf(folder, {"seed": 0})
        ...     valid = torch.ones(2, 16, dtype=torch.bool)
        ...     shelf.put(3, Motions(torch.zeros(1, 2, 16, 33), torch.zeros(4, 2, 16, 33), valid))
        ...     shelf.scenes(), shelf.get(3).rollouts.shape
        ([3], torch.Size([4, 2, 16, 33]))
    """

    def __init__(self, folder: str | Path, decided_by: dict[str, Any]) -> None:
        self.folder = Path(folder)
        self._options = self.folder / "options.json"
        if not self._options.is_file():
            self.remove()
            write_json(self._options, decided_by)
            return
        try:
            differ = differences(json.loads(self._options.read_text(encoding="utf-8")), decided_by)
        except (ValueError, TypeError) as error:
            raise ValueError(f"{self._options} is damaged ({error}); remove {self.folder} and run again.") from None
        if differ:
            raise ValueError(
                f"{self.folder} holds motions of other options ({differ}); name another output folder, or remove it."
            )

    def scenes(self) -> list[int]:
        """Scenes that are there, in order."""
        return sorted(int(path.stem) for path in self.folder.glob("[0-9]*.npz"))

    def put(self, scene: int, motions: Motions) -> None:
        """Keep the motions of a scene."""
        with whole(self.folder / f"{scene}.npz") as part, part.open("wb") as file:
            np.savez(file, **{name: _small(value).numpy() for name, value in motions._asdict().items()})

    def get(self, scene: int) -> Motions:
        """Read the motions of a scene.

        Raises:
            ValueError: its file is damaged.
        """
        path = self.folder / f"{scene}.npz"
        try:
            arrays = read_arrays(path)
            parts = {name: torch.from_numpy(arrays[name]) for name in Motions._fields}
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"{path} is damaged ({error}); remove it and run again.") from None
        return Motions(**{name: part if part.dtype == torch.bool else part.float() for name, part in parts.items()})

    def remove(self) -> None:
        """Remove all that is kept, and the folder."""
        self._options.unlink(missing_ok=True)
        for path in (*self.folder.glob("[0-9]*.npz"), *self.folder.glob(f"{PARTIAL_PREFIX}*")):
            path.unlink()
        if self.folder.is_dir():
            self.folder.rmdir()


def _small(value: Tensor) -> Tensor:
    largest = torch.finfo(torch.float16).max  # an acceleration across a slip of a raw log can be beyond it
    return value if value.dtype == torch.bool else value.clamp(-largest, largest).half()
