"""Where the groups of a preference store come from."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from envs.shards import check_shape
from envs.sources.fields import one_line, shown

FORMAT = 3
"""Version of the store's layout."""
METADATA_FILE = "metadata.json"
MAX_METADATA = 1 << 20
"""Bytes of the metadata file; a usual one has 1,000."""
SHAPE = {
    "policy": str,
    "scenes": str,
    "ranking": {str: object},
    "sampling": {str: object},
    "seed": object,
    "num_rollouts": int,
    "horizon": int,
    "vocab_size": int,
    "tokenizer": {str: object},
}
"""Of the fields of :class:`Provenance`, see :func:`~envs.shards.check_shape`."""


class StoreError(ValueError):
    """A preference store cannot be used as asked; the message names it and says the fix."""


class TokenLayout(NamedTuple):
    """How tokens lie in a store.

    Attributes:
        dtype: of a token, or of its numbers.
        shape: of one token, ``()`` for an index.
    """

    dtype: type[np.number] = np.uint8
    shape: tuple[int, ...] = ()


SMALL = TokenLayout()
"""Of indices below 256."""


@dataclass(frozen=True)
class Provenance:
    """What the groups of a store came from; two runs may share a store only if all of it agrees.

    Attributes:
        policy: fingerprint of the weights that made the rollouts.
        scenes: fingerprint of the scene source; scene indices mean nothing without it.
        ranking: options of the preference distance (:meth:`~dpa.ranking.PreferenceDistance.describe`).
        sampling: options of the rollouts (temperature, nucleus, ...).
        seed: of the rollouts.
        num_rollouts: K.
        horizon: T.
        vocab_size: V; 0 where tokens are patches of poses.
        tokenizer: options that decide what a token means.
    """

    policy: str
    scenes: str
    ranking: dict[str, Any]
    sampling: dict[str, Any]
    seed: int
    num_rollouts: int
    horizon: int
    vocab_size: int
    tokenizer: dict[str, Any]

    @property
    def features(self) -> tuple[str, ...]:
        """Names of the features that the preference distance weighs, in the order of the feature shares."""
        return tuple(self.ranking.get("weights", ()))

    @property
    def digest(self) -> str:
        """Names the origin; every file of a store carries it, so that files of another store are told."""
        content = json.dumps({**asdict(self), "features": self.features}, sort_keys=True)
        return hashlib.sha256(content.encode()).hexdigest()[:16]

    @property
    def layout(self) -> TokenLayout:
        """The smallest integer that holds a token; three numbers for each step of a patch."""
        if not self.vocab_size:
            return TokenLayout(np.float32, (3 * self.tokenizer["steps"],))
        return TokenLayout(np.uint8 if self.vocab_size <= 256 else np.int16)

    def to_json(self) -> str:
        """The text of the metadata file."""
        return json.dumps({"format": FORMAT, **asdict(self)}, indent=2)  # unsorted: features keep their order

    @classmethod
    def from_folder(cls, folder: Path) -> Provenance:
        """Read the metadata of a store.

        Raises:
            StoreError: the folder is no store, or one of another version.
        """
        path = folder / METADATA_FILE
        if not path.is_file():
            raise StoreError(f"{folder} is no preference store: it has no {METADATA_FILE}. Name the folder of a store.")
        try:
            if path.stat().st_size > MAX_METADATA:
                raise ValueError(f"more than {MAX_METADATA} bytes")
            values = dict(json.loads(path.read_text(encoding="utf-8")))
            version = values.pop("format")
        except (OSError, RecursionError, ValueError, KeyError, TypeError) as error:
            raise StoreError(
                f"{path} is not the metadata of a preference store ({one_line(error)}); restore it, or collect anew "
                "into another folder."
            ) from None
        if version != FORMAT:
            raise StoreError(
                f"{path} has format {shown(version)} and this version reads {FORMAT}; collect anew into another folder."
            )
        try:
            check_shape(values, SHAPE, "it")
            check_shape(values["ranking"].get("weights", {}), {str: object}, "its ranking.weights")
        except ValueError as error:
            raise StoreError(f"{path} is damaged ({error}); restore it, or collect anew into another folder.") from None
        return cls(**values)

    def check_same(self, other: Provenance, folder: Path) -> None:
        """Refuse to mix groups of different origin.

        Raises:
            StoreError: the message lists every field that differs.
        """
        # Through JSON, so that a tuple and the list that it was stored as are the same.
        mine, theirs = (json.loads(each.to_json()) | {"features": list(each.features)} for each in (self, other))
        differ = [f"{name} ({mine[name]!r} there, {theirs[name]!r} now)" for name in mine if mine[name] != theirs[name]]
        if differ:
            raise StoreError(
                f"{folder} holds groups of another origin: {'; '.join(differ)}. Name a new folder, or run with the "
                "options of this one."
            )
