"""Preferences: ranked groups on disk, and the pairs made from them."""

from dpa.preferences.card import DataCard, data_card
from dpa.preferences.pairs import nearest, nearest_farthest, random_pairs, random_rollouts
from dpa.preferences.provenance import Provenance, StoreError
from dpa.preferences.store import PreferenceStore, verify
from dpa.preferences.writer import PreferenceWriter

__all__ = [
    "DataCard",
    "PreferenceStore",
    "PreferenceWriter",
    "Provenance",
    "StoreError",
    "data_card",
    "nearest",
    "nearest_farthest",
    "random_pairs",
    "random_rollouts",
    "verify",
]
