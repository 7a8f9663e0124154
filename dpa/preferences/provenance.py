"""Where the groups of a preference store come from."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

FORMAT = 1
"""Version of the store's layout."""
METADATA_FILE = "metadata.json"


class StoreError(ValueError):
    """A preference store cannot be used as asked; the message names it and says the fix."""


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
        vocab_size: V.
    """

    policy: str
    scenes: str
    ranking: dict[str, Any]
    sampling: dict[str, Any]
    seed: int
    num_rollouts: int
    horizon: int
    vocab_size: int

    @property
    def token_dtype(self) -> type[np.integer]:
        """The smallest integer that holds a token."""
        return np.uint8 if self.vocab_size <= 256 else np.int16

    def to_json(self) -> str:
        """The text of the metadata file."""
        return json.dumps({"format": FORMAT, **asdict(self)}, indent=2, sort_keys=True)

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
            values = json.loads(path.read_text())
            version = values.pop("format")
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise StoreError(
                f"{path} is not the metadata of a preference store ({error}); restore or delete it."
            ) from None
        if version != FORMAT:
            raise StoreError(f"{path} has format {version} and this version reads {FORMAT}; generate the store again.")
        missing = {field.name for field in fields(cls)} ^ set(values)
        if missing:
            raise StoreError(
                f"{path} lacks or does not know {sorted(missing)}; restore it or generate the store again."
            )
        return cls(**values)

    def check_same(self, other: Provenance, folder: Path) -> None:
        """Refuse to mix groups of different origin.

        Raises:
            StoreError: the message lists every field that differs.
        """
        # Through JSON, so that a tuple and the list that it was stored as are the same.
        mine, theirs = json.loads(self.to_json()), json.loads(other.to_json())
        differ = [f"{name} ({mine[name]!r} there, {theirs[name]!r} now)" for name in mine if mine[name] != theirs[name]]
        if differ:
            raise StoreError(
                f"{folder} holds groups of another origin: {'; '.join(differ)}. Name a new folder, or run with the "
                "options of this one."
            )
