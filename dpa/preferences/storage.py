"""A preference store as the storage of a TorchRL replay buffer."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping, Sequence
from typing import Any, NoReturn

from tensordict import TensorDict
from torch import Tensor
from torchrl.data.replay_buffers.storages import Storage

from dpa.preferences.provenance import StoreError
from dpa.preferences.store import PreferenceStore


class PreferenceStorage(Storage):
    """Ranked groups to sample from: read-only, and padded as :meth:`PreferenceStore.read` does.

    A sample is a tensordict of batch size ``[S]``. Nothing is kept in memory but what is sampled, and with
    ``prefetch`` the buffer's threads read and unpack the next samples while the last one is in use. Since samples are
    batches already, the buffer's ``collate_fn`` must leave them as they are: :meth:`collate`.

    Args:
        store: with at least one scene.
        num_agents: A to pad to, for samples of one shape; by default the largest group of each sample.

    Raises:
        StoreError: in everything that would write.
        ValueError: the store is empty, or has a group of more agents.

    Examples:
        >>> import tempfile
        >>> from torchrl.data import ReplayBuffer
        >>> from torchrl.data.replay_buffers.samplers import SamplerWithoutReplacement
        >>> from dpa.preferences import PreferenceWriter
        >>> from dpa.preferences.examples import example_groups, example_provenance
        >>> folder = tempfile.mkdtemp()
        >>> with PreferenceWriter(folder, example_provenance()) as writer:
        ...     writer.append(example_groups(num_scenes=6))
        6
        >>> buffer = ReplayBuffer(
        ...     storage=PreferenceStorage(PreferenceStore(folder)),
        ...     sampler=SamplerWithoutReplacement(),
        ...     collate_fn=PreferenceStorage.collate,
        ...     batch_size=3,
        ...     prefetch=2,
        ... )
        >>> sorted(scene for _ in range(2) for scene in buffer.sample()["scene"].tolist())
        [0, 1, 2, 3, 4, 5]
    """

    def __init__(self, store: PreferenceStore, num_agents: int | None = None) -> None:
        if len(store) == 0:
            raise ValueError(f"{store.folder} holds no scene yet; append groups to it first.")
        largest = int(store.num_agents.max())
        if num_agents is not None and largest > num_agents:
            raise ValueError(
                f"num_agents must be at least {largest}, the largest group of {store.folder}; got {num_agents}."
            )
        super().__init__(max_size=len(store))
        self.store, self.num_agents = store, num_agents

    def __len__(self) -> int:
        return len(self.store)

    def get(self, index: int | slice | Sequence[int] | Tensor) -> TensorDict:
        """Groups at positions in the store: batch size ``[S]``, or none for one position."""
        if isinstance(index, slice):
            index = range(len(self))[index]
        if isinstance(index, int) or (isinstance(index, Tensor) and index.dim() == 0):
            return self.store.read([int(index)], self.num_agents)[0]
        return self.store.read(index, self.num_agents)

    def contains(self, item: int) -> bool:
        """Whether there is such a position."""
        return 0 <= item < len(self)

    @staticmethod
    def collate(sample: TensorDict) -> TensorDict:
        """A sample is a batch already."""
        return sample

    def state_dict(self) -> dict[str, Any]:
        """What the groups are of: the origin and number of scenes; the groups themselves lie in the store."""
        return OrderedDict(origin=self.store.provenance.digest, scenes=len(self))

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Go on with the same groups.

        Raises:
            StoreError: the state is that of another store, or of another number of scenes.
        """
        if dict(state_dict) != dict(self.state_dict()):
            raise StoreError(
                f"{self.store.folder} is {dict(self.state_dict())} and the buffer was saved with {dict(state_dict)}; "
                "open the store that it was saved with."
            )

    def set(self, cursor: Any, data: Any, *, set_cursor: bool = True) -> NoReturn:
        """Refuse.

        Raises:
            StoreError: always.
        """
        raise StoreError(f"{self.store.folder} is read-only in a replay buffer; append with a PreferenceWriter.")

    def _empty(self) -> NoReturn:
        self.set(None, None)
