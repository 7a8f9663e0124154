"""A policy that stays near the log by its own likely tokens: what CAT-K learns from."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from dpa.models.actor import MotionActor
from dpa.models.base import MotionModel, of_agents
from dpa.models.context import Contexts
from dpa.tokens.base import MotionTokenizer
from envs import keys
from envs.geometry.boxes import box_corners
from envs.geometry.frames import beside, to_local


class Follow:
    """Chooses among the K most probable tokens the one that ends nearest to a target.

    Args:
        tokenizer: what a token means.
        candidates: K.
        target: ``[B, A, F, 3]`` where to be, in the agents' own frames.
        logged: ``[B, A]`` bool, there is a target; elsewhere the most probable token is taken.
        recent: ``[B, A, F + 1, 3]``.
        kind: ``[B, A]``.
        size: ``[B, A, 2]`` length and width [m].

    Attributes:
        label: ``[B, A]`` the token of all that is best.
        log_prob: 0, since nothing is drawn.
    """

    def __init__(
        self,
        tokenizer: MotionTokenizer,
        candidates: int,
        target: Tensor,
        logged: Tensor,
        recent: Tensor,
        kind: Tensor,
        size: Tensor,
    ) -> None:
        self.tokenizer, self.candidates = tokenizer, candidates
        self.target, self.logged, self.recent, self.kind, self.size = target, logged, recent, kind, size
        self.label = tokenizer.encode(target, recent, kind)
        self.log_prob = torch.zeros_like(recent[:, :, 0, 0])

    def __call__(self, logits: Tensor, agents: Tensor | None = None) -> Tensor:
        """See :class:`~dpa.models.actor.Chooser`."""
        likely = logits.topk(self.candidates).indices
        best = likely == of_agents(self.label, agents)[..., None]
        apart = self._apart(likely, agents).masked_fill(best, -1.0)
        chosen = torch.where(of_agents(self.logged, agents), apart.argmin(-1), 0)
        return likely.gather(-1, chosen[..., None])[..., 0]

    def _apart(self, tokens: Tensor, agents: Tensor | None) -> Tensor:
        """``[B, n, K]``: mean distance of the box's corners at the ends of tokens from those at the target [m]."""
        target, recent, kind, size = (
            of_agents(value, agents)[:, :, None] for value in (self.target, self.recent, self.kind, self.size)
        )
        many = tokens.shape[-1]
        ends = self.tokenizer.decode(tokens, recent.expand(-1, -1, many, -1, -1), kind.expand_as(tokens))[..., -1, :]
        there, here = (
            box_corners(torch.cat((pose, size.expand(*pose.shape[:-1], 2)), -1)) for pose in (target[..., -1, :], ends)
        )
        return (here - there).norm(dim=-1).mean(-1)


def check_following(model: MotionModel, candidates: int, recovery: float) -> None:
    """Refuse what a policy cannot follow a log by; see :class:`ClosestActor` for the arguments.

    Raises:
        ValueError: a policy without a vocabulary, or an option out of range.
    """
    if not model.distribution.discrete:
        raise ValueError("CAT-K follows the log by a policy's own most probable tokens, and patches have none.")
    if not 1 <= candidates <= model.tokenizer.vocab_size:
        raise ValueError(
            f"candidates must be 1 to {model.tokenizer.vocab_size}, the number of tokens, got {candidates}."
        )
    if not 0 < recovery <= 1:
        raise ValueError(f"recovery must lie in (0, 1], got {recovery}.")


class ClosestActor(MotionActor):
    """Follows a target by its own K most probable tokens, and says which token of all would be best.

    So it visits states that it drives into by itself, and never strays far from where the log still has an answer
    (closest among top-K, Zhang et al., CVPR 2025, section 4). The best token, the label, is what the tokenizer makes of
    the motion to the target. It is taken where it is one of the K; elsewhere the one of them whose box ends nearest, by
    the mean distance of corners.
    Where the log has no pose at the end of a decision, the most probable token is taken, and there is no label.

    The paper's target is the log. Tokens that change a velocity must undo at once what they do to be back there, so
    with them it pays to come back slowly: ``recovery`` is the share of the offset from the log, seen from the log's own
    pose, that one decision makes good.

    Args:
        model: the distribution.
        contexts: of the scenes that the environment's ``scene`` index points to.

    Keyword Args:
        candidates: K; the paper has 32.
        recovery: above 0, and 1 for the log itself, as in the paper.

    Raises:
        ValueError: no such number of tokens, or no such share; a policy without a vocabulary.

    Beside what a :class:`~dpa.models.MotionActor` writes stand ``label`` and ``label_valid`` of each agent. Nothing is
    drawn; ``sampling_log_prob`` is 0.

    Examples:
        >>> from torchrl.envs import TransformedEnv
        >>> from dpa.models.motionlm import MotionLM
        >>> from dpa.tokens import TokenAction, VerletTokenizer
        >>> from envs.sources.synthetic import straight_road
        >>> from envs.traffic import TrafficEnv
        >>> scenes, model = [straight_road(2)], MotionLM("nano", VerletTokenizer())
        >>> env = TransformedEnv(TrafficEnv(scenes), TokenAction(model.tokenizer))
        >>> actor = ClosestActor(model, Contexts(scenes, model.featurize), candidates=169)
        >>> followed = env.rollout(16, actor)
        >>> (followed["agents", "token"] == followed["agents", "label"]).float().mean() > 0.8
        tensor(True)
    """

    def __init__(self, model: MotionModel, contexts: Contexts, *, candidates: int = 32, recovery: float = 1.0) -> None:
        super().__init__(model, contexts)
        check_following(model, candidates, recovery)
        self.candidates, self.recovery = candidates, recovery
        self.out_keys = [*self.out_keys, keys.LABEL, keys.LABEL_VALID]

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write a token and a label for every agent."""
        super().forward(tensordict)
        tensordict[keys.LABEL] = self._following.label
        tensordict[keys.LABEL_VALID] = self._following.logged & tensordict[keys.CONTROLLED]
        return tensordict

    def chooser(self, tensordict: TensorDictBase) -> Follow:
        """Chooses what ends nearest to the target."""
        recent, kind = tensordict[keys.RECENT], tensordict[keys.KIND]
        target, logged = self._target(tensordict[keys.STEP][:, 0], recent)
        size = self._context.episode.extent[..., :2].repeat_interleave(self.num_rollouts, 0)
        self._following = Follow(self.model.tokenizer, self.candidates, target, logged, recent, kind, size)
        return self._following

    def _target(self, step: Tensor, recent: Tensor) -> tuple[Tensor, Tensor]:
        """``[B, A, F, 3]``: where to be, in the agents' own frames; ``[B, A]``: the log knows the decision's end."""
        steps, rows = self.model.tokenizer.steps, torch.arange(len(step), device=step.device) // self.num_rollouts
        decisions = (
            each.unflatten(2, (-1, steps))
            for each in (self._context.episode.logged, self._context.episode.logged_valid)
        )
        (logged, valid), before = decisions, (step - 1).clamp(min=0)  # [S, A, T, F, ...]
        poses, current = logged[rows, :, step], recent[..., -1, :]
        # Nothing is left of the offset where the log had no pose to be beside, nor before the first decision.
        left = (1 - self.recovery) * (valid[rows, :, before, -1] & (step > 0)[:, None])[..., None]
        target = beside(poses, current, logged[rows, :, before, -1], left)
        return to_local(target, current[..., None, :]), valid[rows, :, step, -1]
