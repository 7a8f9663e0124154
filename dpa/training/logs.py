"""Logs as what pre-training learns from: cut up and tokenized once, kept while there is room, noisy if asked."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from dpa.models import make_context
from dpa.models.context import Context, Featurize, keep_agents, num_bytes
from dpa.tokens.base import MotionTokenizer
from dpa.training.batches import Item, with_tokens
from envs.episode import EpisodeOptions
from envs.mirror import mirror
from envs.scene import SceneSource

GIB = 1 << 30


def log_item(context: Context, tokenizer: MotionTokenizer) -> Item:
    """The log of a scene as one rollout (M = 1).

    Examples:
        >>> from dpa.models import make_context
        >>> from dpa.models.motionlm import featurize
        >>> from dpa.tokens import VerletTokenizer
        >>> from envs.sources.synthetic import straight_road
        >>> log_item(make_context(straight_road(2), featurize), VerletTokenizer()).tokens.shape
        torch.Size([1, 2, 16])
    """
    return log_items([context], tokenizer)[0]


def log_items(
    contexts: Sequence[Context],
    tokenizer: MotionTokenizer,
    *,
    noise: float = 0.0,
    recovery: float = 1.0,
    drawn: Sequence[Tensor] | None = None,
) -> list[Item]:
    """The logs of scenes, tokenized side by side: decision after decision costs the same for one scene and for many.

    Args:
        contexts: uncollated.
        tokenizer: on the CPU.

    Keyword Args:
        noise: of :meth:`~dpa.tokens.MotionTokenizer.encode_tracks`.
        recovery: as there.
        drawn: ``[A, T, 3]`` for each scene, as there.
    """

    def padded(name: str) -> Tensor:
        return pad_sequence([getattr(context.episode, name) for context in contexts], batch_first=True)

    given = (padded(name) for name in ("logged", "logged_valid", "recent", "kind"))
    draws = pad_sequence(list(drawn), batch_first=True) if drawn is not None else None
    tracks = tokenizer.encode_tracks(*given, noise=noise, recovery=recovery, drawn=draws)
    rows = zip(contexts, tracks.tokens, tracks.labels, tracks.valid, strict=True)
    return [_item(context, *(row[: len(context.episode.kind)] for row in each)) for context, *each in rows]


def _item(context: Context, tokens: Tensor, labels: Tensor, valid: Tensor) -> Item:
    return Item(context, tokens[None], valid & context.episode.controlled[:, None], labels[None])


class Drawn(NamedTuple):
    """What was drawn for a scene when it came up.

    Attributes:
        key: of what is worth keeping of it; None where nothing is.
        log: the whole scene: its item, or its context where it has not been tokenized yet.
        chosen: ``[n]`` indices of the agents to learn from; None for all.
        noise: ``[n, T, 3]`` that noisy tokens are taken from; None where there is no noise.
    """

    key: tuple[int, bool] | None
    log: Item | Context
    chosen: Tensor | None
    noise: Tensor | None


class LogItems:
    """The logs of scenes, for a :class:`~envs.loader.SceneLoader`: itself its scenes, with ``prepare`` and ``collate``.

    What a batch holds depends on the generators alone. A scene and its mirror image are cut up and tokenized when they
    first come up, and kept in memory; noise is new each time.

    Args:
        scenes: a store or a list.
        tokenizer: on the CPU.
        featurize: what a policy sees of them.
        options: of their episodes.

    Keyword Args:
        mirror: probability of the mirror image, drawn anew each time that a scene comes up.
        noise: share of tokens that are replaced, drawn anew as well.
        recovery: share of the offset from the log that a label makes good after noise.
        max_agents: see :func:`choose_agents`.
        keep_gib: memory for what is kept, in each process that reads; once full, the rest is made anew each time.

    Examples:
        >>> from dpa.models.motionlm import featurize
        >>> from dpa.tokens import VerletTokenizer
        >>> from envs.loader import SceneLoader
        >>> from envs.sources.synthetic import straight_road
        >>> logs = LogItems([straight_road(3)], VerletTokenizer(), featurize, EpisodeOptions(), max_agents=2)
        >>> loader = SceneLoader(logs, batch_size=1, prepare=logs.prepare, collate=logs.collate)
        >>> [item.tokens.shape for item in next(iter(loader))]
        [torch.Size([1, 2, 16])]
    """

    def __init__(
        self,
        scenes: SceneSource,
        tokenizer: MotionTokenizer,
        featurize: Featurize,
        options: EpisodeOptions,
        *,
        mirror: float = 0.0,
        noise: float = 0.0,
        recovery: float = 1.0,
        max_agents: int,
        keep_gib: float = 0.0,
    ) -> None:
        self.scenes, self.tokenizer, self.featurize, self.options = scenes, tokenizer, featurize, options
        self.mirror, self.max_agents = mirror, max_agents
        self.noise, self.recovery = noise, recovery
        self.keep_gib = keep_gib
        self._kept: dict[tuple[int, bool], Item] = {}
        self._bytes = 0

    def __len__(self) -> int:
        return len(self.scenes)

    def __getitem__(self, index: int) -> int:
        return range(len(self))[index]  # what :meth:`prepare` makes a log of

    def __getattr__(self, name: str) -> Any:
        # Of a store: its ids and blocks, by which a loader orders scenes.
        if name in ("scene_ids", "blocks"):
            return getattr(self.scenes, name)
        raise AttributeError(f"{type(self).__name__} has no attribute {name!r}")

    def prepare(self, index: int, generator: torch.Generator) -> Drawn:
        """Draw for one scene."""
        mirrored = bool(torch.rand((), generator=generator) < self.mirror)
        key = (index, mirrored)
        log = self._kept[key] if key in self._kept else self._context(index, mirrored)
        context = log.context if isinstance(log, Item) else log
        chosen = choose_agents(context, self.max_agents, generator)
        shape = (len(context.episode.kind if chosen is None else chosen), self.options.horizon, 3)
        return Drawn(key, log, chosen, torch.rand(shape, generator=generator) if self.noise else None)

    def collate(self, drawn: Sequence[Drawn]) -> list[Item]:
        """Items of scenes that were drawn, without those in which there is nothing to learn."""
        new = [place for place, each in enumerate(drawn) if not isinstance(each.log, Item)]
        made = log_items([drawn[place].log for place in new], self.tokenizer) if new else []
        logs = {place: self._keep(drawn[place].key, item) for place, item in zip(new, made, strict=True)}
        items = [_of_agents(logs.get(place, each.log), each.chosen) for place, each in enumerate(drawn)]
        if self.noise and items:
            noise = [each.noise for each in drawn]
            contexts = [item.context for item in items]
            items = log_items(contexts, self.tokenizer, noise=self.noise, recovery=self.recovery, drawn=noise)
        return with_tokens(items)

    def _context(self, index: int, mirrored: bool) -> Context:
        scene = self.scenes[index]
        return make_context(mirror(scene) if mirrored else scene, self.featurize, self.options)

    def _keep(self, key: tuple[int, bool], item: Item) -> Item:
        if key not in self._kept and self._bytes < self.keep_gib * GIB:
            # Tokens are rows of a whole batch, which would be kept with them.
            item = Item(item.context, *(value.clone() for value in item[1:]))
            self._kept[key] = item
            self._bytes += _bytes_of(item)
        return item

    def __getstate__(self) -> dict[str, Any]:
        """Without what is kept: a worker of a loader keeps its own."""
        return self.__dict__ | {"_kept": {}, "_bytes": 0}


def choose_agents(context: Context, limit: int, generator: torch.Generator) -> Tensor | None:
    """``[n]`` indices of the ``limit`` agents nearest to a random one, to bound the cost of a crowded scene.

    Returns:
        None where all are few enough; nothing is drawn then.
    """
    count = len(context.episode.kind)
    if count <= limit:
        return None
    xy = context.episode.recent[:, -1, :2]
    centre = xy[torch.randint(count, (), generator=generator)]
    return (xy - centre).norm(dim=-1).argsort(stable=True)[:limit].sort().values


def _of_agents(item: Item, chosen: Tensor | None) -> Item:
    """The item of some agents of a scene: what one does in the log depends on no other."""
    if chosen is None:
        return item
    valid, (tokens, labels) = item.token_valid[chosen], (each[:, chosen] for each in (item.tokens, item.labels))
    return Item(keep_agents(item.context, chosen), tokens, valid, labels)


def _bytes_of(item: Item) -> int:
    return num_bytes(item.context) + sum(tensor.numel() * tensor.element_size() for tensor in item[1:])
