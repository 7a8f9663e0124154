"""Realism of rollouts, by the definition of the Waymo Open Sim Agents Challenge (WOSAC)."""

from __future__ import annotations

from dpa.realism.config import Histogram, Indicator, RealismConfig
from dpa.realism.features import Features, measure
from dpa.realism.metric import RealismResult, mean_result, realism

__all__ = ["Features", "Histogram", "Indicator", "RealismConfig", "RealismResult", "mean_result", "measure", "realism"]
