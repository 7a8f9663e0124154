"""phi: what the occupancy measure of an agent is made of (paper section 3.2 and eq. 2).

A feature is a function of the poses of all agents, with a unit, a clip range, the paper's weight and the number of past
steps that it needs. Clip ranges are those of the WOSAC 2024 histograms: beyond them, realism does not tell values
apart either. They matter: the share of a feature in the cost follows from its range more than from its weight.
"""

from dpa.ranking.features.measure import (
    WEIGHTS,
    feature_clips,
    feature_names,
    feature_weights,
    log_trajectory,
    logged_steps,
    occupancy_features,
)
from dpa.ranking.features.paper import FEATURE_SETS
from dpa.ranking.features.registry import CONTEXT, FEATURES, Feature, Motion, register

__all__ = [
    "CONTEXT",
    "FEATURES",
    "FEATURE_SETS",
    "WEIGHTS",
    "Feature",
    "Motion",
    "feature_clips",
    "feature_names",
    "feature_weights",
    "log_trajectory",
    "logged_steps",
    "occupancy_features",
    "register",
]
