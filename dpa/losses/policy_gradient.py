"""Policy gradients on groups of rollouts: REINFORCE with a baseline of the group, and its clipped form."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictParams, dispatch
from torch import Tensor
from torchrl.objectives import LossModule

from dpa.losses.network import (
    CONTEXT,
    distribution_of,
    hold_network,
    logits_under,
    masked_mean,
    network_input,
    reference_logits,
)
from dpa.losses.preference import check_not_negative, check_positive
from envs import keys


class PolicyGradientLoss(LossModule):
    """What raises the likelihood of tokens with an advantage above 0 and lowers that of the others.

    Without ``clip`` it is REINFORCE, ``-advantage * log pi``; with it PPO's surrogate (Schulman et al., 2017, eq. 7),
    ``-min(r * advantage, clip(r, 1 - clip, 1 + clip) * advantage)`` of the ratio r of likelihoods now and when the
    rollout was drawn, for several passes over the same rollouts. Both are means over the valid tokens, and have the
    same gradient in the first pass. The rollouts must be drawn from the policy itself: of a nucleus or another
    temperature this is not the gradient.

    TorchRL's ``GRPOLoss`` is for language models and ``ClipPPOLoss`` wants a critic and the distribution of an actor,
    decision by decision; rollouts of a scene are scored here in one teacher-forced pass, as preferences are. Names of
    keys and outputs are theirs where they mean the same.

    A frozen copy of the network as it is when the loss is made is the reference of ``kl``.

    Args:
        actor_network: from :func:`~dpa.losses.token_network`.

    Keyword Args:
        clip: half the width of the range of ratios; None for REINFORCE.
        kl: weight of the KL divergence of the policy from the reference, per token, over the whole vocabulary.
        entropy: weight of the policy's entropy, which it then keeps up.

    Raises:
        ValueError: an option outside its range.

    Returns ``loss_objective``, ``loss_kl_to_ref``, ``loss_entropy`` and, detached: ``kl`` and ``entropy`` per token
    [nats], ``nll`` of the rollouts' tokens [nats] and, of a clipped loss, ``clip_fraction``: the share of tokens whose
    ratio the clip holds back.

    Examples:
        >>> from dpa.losses import token_network
        >>> from dpa.models import collate_contexts, make_context
        >>> from dpa.models.motionlm import MotionLM
        >>> from dpa.tokens import VerletTokenizer
        >>> from envs.sources.synthetic import straight_road
        >>> model = MotionLM("nano", VerletTokenizer())
        >>> loss = PolicyGradientLoss(token_network(model), kl=0.1)
        >>> batch = TensorDict(
        ...     {
        ...         "context": collate_contexts([make_context(straight_road(2), model.featurize)]),
        ...         "tokens": torch.randint(169, (1, 4, 2, 16)),
        ...         "token_valid": torch.ones(1, 1, 2, 16, dtype=torch.bool),
        ...         "advantage": torch.tensor([1.0, -1.0, 0.5, -0.5])[None, :, None, None],
        ...     },
        ...     batch_size=[1],
        ... )
        >>> loss(batch)["loss_kl_to_ref"].item()  # before the first step
        0.0
    """

    @dataclass
    class _AcceptedKeys:
        """Keys of the input.

        Attributes:
            context: :class:`~dpa.models.context.Context` of batch size ``[S]``.
            tokens: ``[S, K, A, T, ...]``.
            token_valid: ``[S, 1, A, T]`` bool.
            advantage: broadcastable to ``[S, K, A, T]``.
            sample_log_prob: ``[S, K, A, T]`` when the tokens were drawn, read by a clipped loss alone.
        """

        context: NestedKey = CONTEXT
        tokens: NestedKey = keys.TOKENS
        token_valid: NestedKey = keys.TOKEN_VALID
        advantage: NestedKey = keys.ADVANTAGE
        sample_log_prob: NestedKey = keys.SAMPLE_LOG_PROB

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys
    actor_network: TensorDictModule
    actor_network_params: TensorDictParams
    target_actor_network_params: TensorDictParams
    sides = "groups"
    """It reads all rollouts of a scene; see :attr:`~dpa.losses.PreferenceLoss.sides`."""

    def __init__(
        self, actor_network: TensorDictModule, *, clip: float | None = None, kl: float = 0.0, entropy: float = 0.0
    ) -> None:
        super().__init__()
        if clip is not None:
            check_positive("clip", clip)
        check_not_negative("kl", kl)
        check_not_negative("entropy", entropy)
        hold_network(self, actor_network, keep_reference=True)
        self.clip, self.kl, self.entropy = clip, kl, entropy
        clipped = [] if clip is None else ["clip_fraction"]
        self.out_keys = ["loss_objective", "loss_kl_to_ref", "loss_entropy", "kl", "entropy", "nll", *clipped]

    @property
    def in_keys(self) -> list[NestedKey]:
        """Where the input lies, in the order in which plain tensors are taken."""
        accepted = self.tensor_keys
        read = [accepted.context, accepted.tokens, accepted.token_valid, accepted.advantage]
        return read if self.clip is None else [*read, accepted.sample_log_prob]

    def _forward_value_estimator_keys(self, **_: object) -> None:
        """There is no value estimator."""

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The loss and its diagnostics, each a scalar, of a batch of groups."""
        accepted = self.tensor_keys
        tokens, valid = tensordict[accepted.tokens], tensordict[accepted.token_valid]
        batch = network_input(tensordict[accepted.context], tokens, valid)
        logits = logits_under(self.actor_network_params, self.actor_network, batch)
        says = distribution_of(self.actor_network)
        log_prob = says.log_prob(logits, tokens)
        gain, diagnostics = self._gain(log_prob, tensordict)
        with torch.set_grad_enabled(self.kl > 0 and torch.is_grad_enabled()):
            drift = masked_mean(says.divergence(logits, reference_logits(self, batch)), valid)
        with torch.set_grad_enabled(self.entropy > 0 and torch.is_grad_enabled()):
            entropy = masked_mean(says.entropy(logits), valid)
        diagnostics |= {"kl": drift, "entropy": entropy, "nll": masked_mean(-log_prob, valid)}
        out = {
            "loss_objective": -masked_mean(gain, valid),
            "loss_kl_to_ref": self.kl * drift,
            "loss_entropy": -self.entropy * entropy,
            **{name: value.detach() for name, value in diagnostics.items()},
        }
        return TensorDict(out, batch_size=[])

    def _gain(self, log_prob: Tensor, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """``[S, K, A, T]`` that is to become large, and what is told of the clip."""
        accepted = self.tensor_keys
        advantage = tensordict[accepted.advantage]
        if self.clip is None:
            return advantage * log_prob, {}
        valid = tensordict[accepted.token_valid]
        # A density of what does not count may be anything, and the gradient of its ratio no number.
        ratio = torch.where(valid, log_prob - tensordict[accepted.sample_log_prob], 0.0).exp()
        free, held = advantage * ratio, advantage * ratio.clamp(1 - self.clip, 1 + self.clip)
        share = masked_mean((held < free).to(ratio.dtype), valid)
        return torch.minimum(free, held), {"clip_fraction": share}
