"""Attention on neighbourhoods, factorised into past, map and agents: what some families are made of."""

from dpa.models.factorised.context import NeighbourhoodContext, NeighbourhoodOptions, featurize
from dpa.models.factorised.edges import METRES
from dpa.models.factorised.model import FactorisedConfig, FactorisedModel, mlp, quiet

__all__ = [
    "METRES",
    "FactorisedConfig",
    "FactorisedModel",
    "NeighbourhoodContext",
    "NeighbourhoodOptions",
    "featurize",
    "mlp",
    "quiet",
]
