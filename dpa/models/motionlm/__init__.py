"""MotionLM: scene encoder, causal decoder over agents x decisions (Seff et al., ICCV 2023)."""

from dpa.models.motionlm.model import SIZES, MotionLM, MotionLMConfig
from dpa.models.scene import ContextOptions, SceneContext, featurize

__all__ = ["SIZES", "ContextOptions", "MotionLM", "MotionLMConfig", "SceneContext", "featurize"]
