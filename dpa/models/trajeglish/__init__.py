"""Trajeglish: agents decide one after another inside a decision (Philion et al., ICLR 2024)."""

from dpa.models.trajeglish.context import TrajeglishContext, featurize
from dpa.models.trajeglish.model import SIZES, Trajeglish, TrajeglishConfig

__all__ = ["SIZES", "Trajeglish", "TrajeglishConfig", "TrajeglishContext", "featurize"]
