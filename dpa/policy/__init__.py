"""MotionLM: scene encoder, causal decoder over agents x decisions, and its use as a TorchRL policy."""

from dpa.policy.actor import MotionActor
from dpa.policy.context import ContextOptions, SceneContext, collate_contexts, make_context
from dpa.policy.motionlm import SIZES, MotionLM, MotionLMConfig
from dpa.policy.sampling import Decoding

__all__ = [
    "SIZES",
    "ContextOptions",
    "Decoding",
    "MotionActor",
    "MotionLM",
    "MotionLMConfig",
    "SceneContext",
    "collate_contexts",
    "make_context",
]
