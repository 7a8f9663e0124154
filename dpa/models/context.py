"""What policies see of scenes, whatever their family: an episode, and what the family cut out of the scene."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields
from typing import Any, ClassVar, Protocol, TypeVar

from torch import Tensor
from torch.nn import functional as F
from torch.nn.utils.rnn import pad_sequence

from envs.episode import Episode, EpisodeOptions, make_episode
from envs.scene import Scene, SceneSource


class Context(Protocol):
    """Inputs of a policy for one scene, or for a padded batch of them: a TensorClass.

    Attributes:
        episode: who is there, what they did, and whom the policy moves.
        of_agents: names of the other fields that have one row for each agent.
    """

    episode: Episode
    of_agents: ClassVar[tuple[str, ...]]


Featurize = Callable[[Scene, Episode], Any]
"""Makes the context of one uncollated scene; it travels to other processes."""
SomeContext = TypeVar("SomeContext", bound=Context)


def make_context(scene: Scene, featurize: Featurize, options: EpisodeOptions | None = None) -> Any:
    """What a policy sees of one uncollated scene.

    Args:
        scene: as it was recorded.
        featurize: of the policy.
        options: of the episode.

    Examples:
        >>> from dpa.models.motionlm import featurize
        >>> from envs.sources.synthetic import straight_road
        >>> make_context(straight_road(2), featurize).episode.kind
        tensor([1, 1])
    """
    return featurize(scene, make_episode(scene, options))


def collate_contexts(contexts: Sequence[SomeContext]) -> SomeContext:
    """Pad contexts of one kind to a batch of batch size ``[S]``; padding is 0 and invalid."""

    def together(values: Sequence[Any]) -> Any:
        return pad_sequence(values, batch_first=True) if isinstance(values[0], Tensor) else collate_contexts(values)

    kind = type(contexts[0])
    columns = {field.name: [getattr(context, field.name) for context in contexts] for field in fields(kind)}
    return kind(**{name: together(values) for name, values in columns.items()}, batch_size=[len(contexts)])


def keep_agents(context: SomeContext, index: Tensor) -> SomeContext:
    """Keep some agents of one uncollated context."""
    return _each_agent(context, lambda value: value[index])


def pad_context(context: SomeContext, agents: int) -> SomeContext:
    """Pad the agents of a batch of contexts to ``agents``.

    Raises:
        ValueError: the contexts hold more agents.
    """
    held = context.episode.kind.shape[1]
    if held > agents:
        raise ValueError(f"the contexts hold {held} agents and the environment {agents}.")
    return _each_agent(context, lambda value: F.pad(value, (0, 0) * (value.dim() - 2) + (0, agents - held)))


def num_bytes(context: Context) -> int:
    """Memory of a context's tensors."""
    values = [getattr(context, field.name) for field in fields(type(context))]
    return sum(v.numel() * v.element_size() if isinstance(v, Tensor) else num_bytes(v) for v in values)


def _each_agent(context: SomeContext, change: Callable[[Tensor], Tensor]) -> SomeContext:
    """The same context with every tensor changed that has a row for each agent."""
    context, episode = context.clone(recurse=False), context.episode.clone(recurse=False)
    for field in fields(Episode):
        setattr(episode, field.name, change(getattr(episode, field.name)))
    for name in context.of_agents:
        setattr(context, name, change(getattr(context, name)))
    context.episode = episode
    return context


class Contexts:
    """Contexts of the scenes of a source, made on first use; the latest are kept.

    Args:
        scenes: where scenes come from.
        featurize: of the policy.
        options: of the episodes.
        most: contexts that are kept, of about 100 KB each.

    Examples:
        >>> from dpa.models.motionlm import featurize
        >>> from envs.sources.synthetic import straight_road
        >>> contexts = Contexts([straight_road(2)], featurize)
        >>> len(contexts), contexts.scene_id(0)
        (1, 'straight_road_2_None')
    """

    def __init__(
        self, scenes: SceneSource, featurize: Featurize, options: EpisodeOptions | None = None, most: int = 4096
    ) -> None:
        self.scenes, self.featurize, self.options = scenes, featurize, options or EpisodeOptions()
        self.most = most
        self._made: dict[int, tuple[Any, str]] = {}

    def __len__(self) -> int:
        return len(self.scenes)

    def __getitem__(self, index: int) -> Any:
        return self._entry(index)[0]

    def scene_id(self, index: int) -> str:
        """The id of a scene."""
        return self._entry(index)[1]

    def _entry(self, index: int) -> tuple[Any, str]:
        entry = self._made.pop(index, None)
        if entry is None:
            scene = self.scenes[index]
            entry = make_context(scene, self.featurize, self.options), scene.scene_id
        if len(self._made) >= self.most:
            del self._made[next(iter(self._made))]  # the one whose last use is longest ago
        self._made[index] = entry
        return entry
