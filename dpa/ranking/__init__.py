"""Ranking of rollouts by how near they come to the log.

``features`` (phi of the paper) and ``transport`` (optimal transport) make the preference distance of ``distance``;
``displacement`` is its rival; ``transform`` puts both behind a collector.
"""

from dpa.ranking.displacement import Displacement, agent_spread, average_displacement, final_displacement
from dpa.ranking.distance import AGGREGATES, Distance, PreferenceDistance, Ranking, rank_of
from dpa.ranking.features import FEATURE_SETS, FEATURES, Feature, Motion, log_trajectory, occupancy_features, register
from dpa.ranking.rival import DisplacementDistance
from dpa.ranking.transport import SOLVERS, Dense, Pairs, Problems, Transport, transport_cost

__all__ = [
    "AGGREGATES",
    "FEATURES",
    "FEATURE_SETS",
    "SOLVERS",
    "Dense",
    "Displacement",
    "DisplacementDistance",
    "Distance",
    "Feature",
    "Motion",
    "Pairs",
    "PreferenceDistance",
    "Problems",
    "Ranking",
    "Transport",
    "agent_spread",
    "average_displacement",
    "final_displacement",
    "log_trajectory",
    "occupancy_features",
    "rank_of",
    "register",
    "transport_cost",
]
