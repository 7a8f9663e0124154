"""What MotionLM keeps of running rollouts: the encoded scenes, and keys and values of all that was decided."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from dpa.models.base import Choose, Decision, Observation
from dpa.models.encoder import SceneMemory
from dpa.models.motionlm.decoder import NodeCache, NodeInputs
from dpa.models.scene import SceneContext

if TYPE_CHECKING:
    from dpa.models.motionlm.model import MotionLM


class RolloutMemory:
    """A :class:`~dpa.models.base.Memory`: a scene is encoded once for its rollouts, a decision is added to a cache.

    Args:
        model: that decides.
        compile: run the decoder through :func:`torch.compile`.
    """

    def __init__(self, model: MotionLM, *, compile: bool = False) -> None:
        self.model = model
        self._decode = torch.compile(model.decoder.forward) if compile else model.decoder.forward
        self._scenes: SceneMemory | None = None
        self._cache: NodeCache | None = None

    def begin(self, context: SceneContext, rollouts: int, anew: bool) -> None:
        """See :meth:`dpa.models.base.Memory.begin`; buffers of the episodes before serve again."""
        config, (scenes, agents) = self.model.config, context.episode.kind.shape
        size = (scenes * rollouts, config.heads, config.horizon, agents)
        if self._cache is None or self._cache.shape != size:
            like = self.model.decoder.head.weight
            self._cache = NodeCache(config.decoder_layers, size, config.width // config.heads, like)
        if anew:
            self._cache.clear()
        self._scenes = self.model.encode(context)

    def step(self, seen: Observation, choose: Choose) -> Decision:
        """See :meth:`dpa.models.base.Memory.step`."""
        masks = self._cache.start(seen.step, seen.latest, seen.valid)
        when = seen.step[:, None].expand_as(seen.token)
        nodes = NodeInputs(seen.recent, seen.token, when, seen.kind, seen.valid)
        logits = self._decode(nodes, self._scenes, masks, self._cache).float()
        return Decision(choose(logits), logits)
