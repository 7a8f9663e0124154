"""The network that every loss works on, and masked means."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictParams
from torch import Tensor, nn
from torchrl.objectives import LossModule

from dpa.models.base import check_logits
from dpa.models.distribution import TOKENS, Distribution
from dpa.models.precision import Precision, check_precision, running_in
from envs import keys

CONTEXT = "context"
LOGITS = "logits"


class _Rounded(nn.Module):
    """A model whose linear layers run in another precision; its logits are float32 again."""

    def __init__(self, model: nn.Module, precision: Precision) -> None:
        super().__init__()
        self.model, self.precision = model, precision

    def forward(self, context: TensorDictBase, tokens: Tensor, token_valid: Tensor) -> Tensor:
        with running_in(self.precision, tokens.device):
            return self.model(context, tokens, token_valid).float()


def token_network(model: nn.Module, precision: Precision = "float32") -> TensorDictModule:
    """Wrap a model as the network of a loss.

    Args:
        model: called with a context of batch size ``[S]``, tokens ``[S, M, A, T]`` and their validity
            ``[S, M or 1, A, T]``; gives logits ``[S, M, A, T, V]`` (:class:`~dpa.models.MotionModel` does). A
            ``distribution`` of its own says what they mean; without one they are logits of tokens.
        precision: of its linear layers; weights, gradients and logits are float32 all the same.

    Returns:
        The network, in training or evaluation mode as the model is.

    Raises:
        ValueError: an unknown precision.
    """
    rounded = model if check_precision(precision) == "float32" else _Rounded(model, precision)
    network = TensorDictModule(rounded, in_keys=[CONTEXT, keys.TOKENS, keys.TOKEN_VALID], out_keys=[LOGITS])
    network.distribution = getattr(model, "distribution", TOKENS)
    return network.train(model.training)


def model_of(network: TensorDictModule) -> nn.Module:
    """The model that :func:`token_network` wrapped."""
    return network.module.model if isinstance(network.module, _Rounded) else network.module


def distribution_of(network: TensorDictModule) -> Distribution:
    """What the logits of a network mean."""
    return getattr(network, "distribution", TOKENS)


def hold_network(loss: LossModule, network: TensorDictModule, *, keep_reference: bool) -> None:
    """Make a network that of a loss, if asked to beside a frozen copy of it as it is now."""
    loss.convert_to_functional(network, "actor_network", create_target_params=keep_reference)
    if keep_reference:
        # The reference stays as it is: tell torchrl, which warns otherwise, that no updater is missing.
        loss._has_update_associated["actor_network"] = True


def network_input(context: TensorDictBase, tokens: Tensor, token_valid: Tensor) -> TensorDict:
    """What :func:`token_network` reads, of S scenes, under its own keys whatever those of a loss are."""
    return TensorDict(
        {CONTEXT: context, keys.TOKENS: tokens, keys.TOKEN_VALID: token_valid}, batch_size=tokens.shape[:1]
    )


def logits_under(parameters: TensorDictParams, network: TensorDictModule, batch: TensorDictBase) -> Tensor:
    """Logits ``[S, M, A, T, P]`` of a network under some parameters of its kind; the batch stays as it is.

    Raises:
        ContractError: logits of other agents or decisions than those of the tokens.
    """
    with parameters.to_module(network):
        logits = network(batch.copy())[LOGITS]
    check_logits(logits, batch[keys.TOKENS], f"{type(getattr(network, 'module', network)).__name__}.forward")
    return logits


def reference_logits(loss: LossModule, batch: TensorDictBase) -> Tensor:
    """Logits of the frozen copy of a loss's network: without gradients, and without dropout even in training."""
    with torch.no_grad(), without_dropout(loss.actor_network) as network:
        return logits_under(loss.target_actor_network_params, network, batch)


@contextmanager
def without_dropout(module: nn.Module) -> Iterator[nn.Module]:
    """A module in evaluation mode; afterwards each part of it is in its own mode again.

    Examples:
        >>> model = nn.Sequential(nn.Dropout().eval(), nn.Dropout())
        >>> with without_dropout(model) as asked:
        ...     [part.training for part in asked]
        [False, False]
        >>> [part.training for part in model]
        [False, True]
    """
    in_training = [part for part in module.modules() if part.training]
    try:
        yield module.eval()
    finally:
        for part in in_training:
            part.training = True


def masked_mean(value: Tensor, mask: Tensor) -> Tensor:
    """Mean of the entries where ``mask`` is true, 0 where none is; ``mask`` is broadcast to ``value``.

    Examples:
        >>> import torch
        >>> masked_mean(torch.tensor([1.0, 9.0]), torch.tensor([True, False]))
        tensor(1.)
    """
    mask = mask.expand_as(value)
    return value.where(mask, value.new_zeros(())).sum() / mask.sum().clamp(min=1)


def scene_mean(value: Tensor, mask: Tensor) -> Tensor:
    """Mean over scenes ``[S, ...]`` of the mean of each one's entries where ``mask`` is true; 0 for a scene without.

    Unlike a mean over all entries it does not depend on which scenes share a part of a batch.

    Examples:
        >>> import torch
        >>> scene_mean(torch.tensor([[1.0, 3.0], [6.0, 9.0]]), torch.tensor([[True, True], [True, False]]))
        tensor(4.)
    """
    mask = mask.expand_as(value)
    within = tuple(range(1, value.ndim))
    return (value.where(mask, value.new_zeros(())).sum(within) / mask.sum(within).clamp(min=1)).mean()
