"""BehaviorGPT: patches of poses from a mixture of densities (Zhou et al., NeurIPS 2024)."""

from dpa.models.behaviorgpt.mixture import PatchMixture
from dpa.models.behaviorgpt.model import SIZES, BehaviorGPT, BehaviorGPTConfig

__all__ = ["SIZES", "BehaviorGPT", "BehaviorGPTConfig", "PatchMixture"]
