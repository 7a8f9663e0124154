"""Realism of rollouts, by the definition of the Waymo Open Sim Agents Challenge (WOSAC)."""

from __future__ import annotations

from dpa.realism.config import Histogram, Indicator, Kernel, RealismConfig
from dpa.realism.encounters import Encounter, encounters
from dpa.realism.features import Features, measure
from dpa.realism.likelihood import CLASS_RATES, class_rates
from dpa.realism.metric import RealismResult, contributions, mean_result, realism, realism_of, realism_of_groups
from dpa.realism.quirks import Quirk
from dpa.realism.tracks import Generated, compare

__all__ = [
    "CLASS_RATES",
    "Encounter",
    "Features",
    "Generated",
    "Histogram",
    "Indicator",
    "Kernel",
    "Quirk",
    "RealismConfig",
    "RealismResult",
    "class_rates",
    "compare",
    "contributions",
    "encounters",
    "mean_result",
    "measure",
    "realism",
    "realism_of",
    "realism_of_groups",
]
