"""BehaviorGPT: next-patch prediction with a mixture of densities (Zhou et al., NeurIPS 2024, arXiv 2405.17372)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from dpa.models.base import named_size
from dpa.models.behaviorgpt.mixture import CELLS, PatchMixture
from dpa.models.factorised import METRES, FactorisedConfig, FactorisedModel, NeighbourhoodOptions, mlp, quiet
from dpa.tokens.base import MotionTokenizer
from envs.geometry.frames import rotate, to_local
from envs.scene import AgentKind

SPREAD, SURE = -4.0, 7.0
"""What an untrained head says of scale (softplus: 0.018 m) and log-concentration (0.03 rad) of every frame."""


@dataclass(frozen=True)
class BehaviorGPTConfig(FactorisedConfig):
    """Size of the model.

    Attributes:
        modes: K of the mixture, beside standing still.
        frame_width: channels of a frame, and of what unrolls the frames of a mode.
    """

    modes: int = 16
    frame_width: int = 32


SIZES: dict[str, BehaviorGPTConfig] = {
    "nano": BehaviorGPTConfig(width=36, heads=4, map_layers=1, agent_layers=2, frequencies=8, feed=2, past=3),
    "3m": BehaviorGPTConfig(width=128, heads=8, map_layers=3, agent_layers=2, frequencies=64, past=8,
                            map_pieces=32, agent_map_radius=50.0, agent_pieces=32, agent_radius=50.0, agents=32,
                            frame_width=128),
}  # fmt: skip
"""Named sizes; ``3m`` has the published parameters within 10 %."""


class BehaviorGPT(FactorisedModel):
    """Nodes are made of the frames of the last patch, and a density of the next patch is made of a node.

    Args:
        config: size, or the name of one in :data:`SIZES`.
        tokenizer: of patches.
        context: how scenes are cut up.

    Raises:
        ValueError: a name that is no size, or a tokenizer with a vocabulary.

    Examples:
        >>> from dpa.models.context import collate_contexts, make_context
        >>> from dpa.tokens import PatchTokenizer
        >>> from envs.episode import EpisodeOptions
        >>> from envs.sources.synthetic import straight_road
        >>> model = BehaviorGPT("nano", PatchTokenizer())
        >>> options = EpisodeOptions(decision_steps=10, horizon=8)
        >>> context = collate_contexts([make_context(straight_road(2), model.featurize, options)])
        >>> patches = torch.zeros(1, 3, 2, 8, 30)  # three rollouts of one scene
        >>> logits = model(context, patches, torch.ones(1, 1, 2, 8, dtype=torch.bool))
        >>> model.distribution.log_prob(logits, patches).shape
        torch.Size([1, 3, 2, 8])
    """

    def __init__(
        self, config: BehaviorGPTConfig | str, tokenizer: MotionTokenizer, context: NeighbourhoodOptions | None = None
    ) -> None:
        if tokenizer.vocab_size:
            raise ValueError(
                "BehaviorGPT predicts patches of poses, and a vocabulary is no use to it; set tokenizer=patches."
            )
        config = named_size(config, SIZES)
        super().__init__(config, tokenizer, context)
        self.distribution = PatchMixture(tokenizer.steps)
        width, inner = config.width, config.frame_width
        self.kind = quiet(nn.Embedding(len(AgentKind), width))
        self.frame, self.key, self.value = mlp(7, inner), nn.Linear(inner, inner), nn.Linear(inner, width)
        self.own = mlp(3, width)
        self.weight = nn.Sequential(nn.Linear(width, width), nn.ReLU(), nn.Linear(width, config.modes + 1))
        self.start, self.mode = nn.Linear(width, inner), nn.Embedding(config.modes, inner)
        self.when, self.recur = nn.Embedding(tokenizer.steps, 3 * inner), nn.Linear(inner, 3 * inner)
        self.out = nn.Linear(inner, 6)
        self._calm()

    def bytes_per_row(self) -> int:
        """See :meth:`~dpa.models.base.MotionModel.bytes_per_row`: as many modes are unrolled, and one is drawn.

        Examples:
            >>> from dpa.tokens import PatchTokenizer
            >>> round(BehaviorGPT("nano", PatchTokenizer()).bytes_per_row() / 1024)  # 64 measured
            81
        """
        unrolled = self.config.modes * (6 * self.tokenizer.steps + 6 * self.config.frame_width)
        return super().bytes_per_row() + 4 * (unrolled + 3 * CELLS * self.tokenizer.steps)

    @torch.no_grad()
    def _calm(self) -> None:
        """At first all modes go on as agents do, with little noise: a density far off would drown what is learnt."""
        self.out.weight.mul_(0.1)
        self.out.bias.copy_(torch.tensor([0.0, 0.0, 0.0, SPREAD, SPREAD, SURE]))

    def embed(self, recent: Tensor, token: Tensor, kind: Tensor, extent: Tensor) -> Tensor:
        """See :meth:`~dpa.models.factorised.FactorisedModel.embed`: frames, pooled by attention of the last one."""
        local = to_local(recent, recent[:, :, -1:])
        steps = local.diff(dim=2)
        steps = torch.cat((steps[..., :2], steps[..., 2:].sin()), -1)
        place = torch.cat((local[:, :, 1:, :2] / METRES, local[:, :, 1:, 2:].cos(), local[:, :, 1:, 2:].sin()), -1)
        frames = self.frame(torch.cat((place, steps), -1))  # [R, A, F, inner]
        score = (self.key(frames) * frames[:, :, -1:]).sum(-1, keepdim=True) * frames.shape[-1] ** -0.5
        pooled = (score.softmax(2) * frames).sum(2)
        return self.value(pooled) + self.own(extent / METRES) + self.kind(kind)

    def _next(self, state: Tensor, when: Tensor) -> Tensor:
        """State of the frame to come, by a gated recurrent unit whose input is which frame it is."""
        reset, keep, new = when.chunk(3)
        forget, hold, said = self.recur(state).chunk(3, -1)
        new = (new + (reset + forget).sigmoid() * said).tanh()
        return new + (keep + hold).sigmoid() * (state - new)

    def decide(self, x: Tensor, recent: Tensor, kind: Tensor) -> Tensor:
        """See :meth:`~dpa.models.factorised.FactorisedModel.decide`: a row of :class:`Mixture` numbers."""
        hidden = (self.start(x)[..., None, :] + self.mode.weight).tanh()  # [*, K, inner]
        shape, state, frames = hidden.shape, hidden.flatten(0, -2), []
        for when in self.when.weight:
            state = self._next(state, when)
            frames.append(self.out(state))
        said = torch.stack(frames, -2).view(*shape[:-1], len(frames), 6)
        last = to_local(recent[..., -1, :], recent[..., -2, :])
        forwards = rotate(last[..., :2], -last[..., 2] / 2)[..., :1]
        return torch.cat((self.weight(x), said.flatten(-3), forwards), -1)
