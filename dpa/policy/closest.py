"""A policy that stays near the log by its own likely tokens: what CAT-K learns from."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from dpa.policy.actor import Contexts, MotionActor
from dpa.policy.motionlm import MotionLM
from envs import keys
from envs.geometry.boxes import box_corners
from envs.geometry.frames import to_local


class ClosestActor(MotionActor):
    """Takes, of its K most probable tokens, the one that ends nearest to the log, and says which token would be best.

    So it visits states that it drives into by itself, and never strays far from where the log still has an answer
    (closest among top-K, Zhang et al., CVPR 2025, section 4). How far two ends are apart is the mean distance of the
    corners of the agent's box. Where the log has no pose at the end of a decision, the most probable token is taken,
    and there is no label.

    Args:
        model: the distribution.
        contexts: of the scenes that the environment's ``scene`` index points to.

    Keyword Args:
        candidates: K; the paper has 32.

    Raises:
        ValueError: no such number of tokens.

    Beside what a :class:`~dpa.policy.MotionActor` writes stand ``label`` and ``label_valid`` of each agent. Nothing is
    drawn; ``sampling_log_prob`` is 0.

    Examples:
        >>> from torchrl.envs import TransformedEnv
        >>> from dpa.tokens import TokenAction, VerletTokenizer
        >>> from envs.sources.synthetic import straight_road
        >>> from envs.traffic import TrafficEnv
        >>> scenes, tokenizer = [straight_road(2)], VerletTokenizer()
        >>> env = TransformedEnv(TrafficEnv(scenes), TokenAction(tokenizer))
        >>> actor = ClosestActor(MotionLM("nano", tokenizer), Contexts(scenes), candidates=169)
        >>> followed = env.rollout(16, actor)
        >>> (followed["agents", "token"] == followed["agents", "label"]).float().mean() > 0.8
        tensor(True)
    """

    def __init__(self, model: MotionLM, contexts: Contexts, *, candidates: int = 32) -> None:
        super().__init__(model, contexts)
        if not 1 <= candidates <= model.tokenizer.vocab_size:
            raise ValueError(
                f"candidates must be 1 to {model.tokenizer.vocab_size}, the number of tokens, got {candidates}."
            )
        self.candidates = candidates
        self.out_keys = [*self.out_keys, keys.LABEL, keys.LABEL_VALID]

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write a token and a label for every agent."""
        logits = self.logits(tensordict).float()
        recent, kind = tensordict[keys.RECENT], tensordict[keys.KIND]
        target, logged = self._target(tensordict[keys.STEP][:, 0], recent)
        likely = logits.topk(self.candidates).indices
        chosen = torch.where(logged, self._apart(likely, target, recent, kind).argmin(-1), 0)
        token = likely.gather(-1, chosen[..., None])[..., 0]
        self._last = token
        tensordict[keys.TOKEN] = token
        tensordict[keys.LOG_PROB] = logits.log_softmax(-1).gather(-1, token[..., None])[..., 0]
        tensordict[keys.SAMPLING_LOG_PROB] = torch.zeros_like(tensordict[keys.LOG_PROB])
        tensordict[keys.LABEL] = self.model.tokenizer.encode(target, recent, kind)
        tensordict[keys.LABEL_VALID] = logged & tensordict[keys.CONTROLLED]
        return tensordict

    def _target(self, step: Tensor, recent: Tensor) -> tuple[Tensor, Tensor]:
        """``[B, A, F, 3]``: logged poses of the decision in the agents' own frames; ``[B, A]``: the last is known."""
        steps, rows = self.model.tokenizer.steps, torch.arange(len(step), device=step.device)
        decisions = self._context.logged.unflatten(2, (-1, steps)), self._context.logged_valid.unflatten(2, (-1, steps))
        poses, valid = (value[rows // self.num_rollouts, :, step] for value in decisions)
        return to_local(poses, recent[..., -1:, :]), valid[..., -1]

    def _apart(self, tokens: Tensor, target: Tensor, recent: Tensor, kind: Tensor) -> Tensor:
        """``[B, A, K]``: mean distance of the box's corners at the ends of tokens from those at the target [m]."""
        size = self._context.extent[..., None, :2].repeat_interleave(self.num_rollouts, 0)
        many = tokens.shape[-1]
        ends = self.model.tokenizer.decode(
            tokens, recent[:, :, None].expand(-1, -1, many, -1, -1), kind[..., None].expand_as(tokens)
        )[..., -1, :]
        there, here = (
            box_corners(torch.cat((pose, size.expand(*pose.shape[:-1], 2)), -1)) for pose in (target[..., -1:, :], ends)
        )
        return (here - there).norm(dim=-1).mean(-1)
