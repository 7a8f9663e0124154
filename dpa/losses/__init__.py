"""Losses as TorchRL ``LossModule``s: next token (eq. 1) and contrastive preference (eq. 4)."""

from dpa.losses.contrastive import ContrastivePreferenceLoss
from dpa.losses.network import token_network
from dpa.losses.next_token import NextTokenLoss

__all__ = ["ContrastivePreferenceLoss", "NextTokenLoss", "token_network"]
