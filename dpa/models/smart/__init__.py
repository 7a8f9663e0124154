"""SMART: tokens of motion and map, factorised attention on neighbourhoods (Wu et al., NeurIPS 2024)."""

from dpa.models.smart.context import SmartContext, SmartContextOptions, featurize
from dpa.models.smart.model import SIZES, SMART, SmartConfig

__all__ = ["SIZES", "SMART", "SmartConfig", "SmartContext", "SmartContextOptions", "featurize"]
