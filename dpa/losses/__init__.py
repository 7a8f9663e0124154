"""Losses as TorchRL ``LossModule``s: next token (eq. 1), preferences (eq. 4 and its relatives) and policy gradients."""

from dpa.losses.contrastive import ContrastivePreferenceLoss
from dpa.losses.imitation import ImitationLoss
from dpa.losses.kahneman_tversky import KahnemanTverskyLoss
from dpa.losses.network import token_network
from dpa.losses.next_token import NextTokenLoss
from dpa.losses.plackett_luce import PlackettLuceLoss
from dpa.losses.policy_gradient import PolicyGradientLoss
from dpa.losses.preference import Comparison, PreferenceLoss, Side
from dpa.losses.saturation import SaturationWatch

__all__ = [
    "Comparison",
    "ContrastivePreferenceLoss",
    "ImitationLoss",
    "KahnemanTverskyLoss",
    "NextTokenLoss",
    "PlackettLuceLoss",
    "PolicyGradientLoss",
    "PreferenceLoss",
    "SaturationWatch",
    "Side",
    "token_network",
]
