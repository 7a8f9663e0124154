"""Policies: the contract of a family, the families, and their use as TorchRL policies."""

from dpa.models.actor import MotionActor
from dpa.models.base import Choose, Decision, Memory, MotionModel, Observation
from dpa.models.context import Contexts, collate_contexts, make_context
from dpa.models.sampling import Decoding

__all__ = [
    "Choose",
    "Contexts",
    "Decision",
    "Decoding",
    "Memory",
    "MotionActor",
    "MotionModel",
    "Observation",
    "collate_contexts",
    "make_context",
]
