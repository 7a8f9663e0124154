"""Safety of rollouts by measures of their own: two that the preference distance and the metric know nothing of."""

from __future__ import annotations

from dpa.safety.measure import MEASURES, safety
from dpa.safety.motion import Motion

__all__ = ["MEASURES", "Motion", "safety"]
