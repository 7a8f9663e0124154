"""Safety of rollouts by measures that neither the preference distance nor the realism metric knows."""

from __future__ import annotations

from dpa.safety.measure import MEASURES, safety
from dpa.safety.motion import Motion

__all__ = ["MEASURES", "Motion", "safety"]
