"""SMART: tokens of motion and map, factorised attention on neighbourhoods (Wu et al., NeurIPS 2024)."""

from dpa.models.smart.model import SIZES, SMART

__all__ = ["SIZES", "SMART"]
