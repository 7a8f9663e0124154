"""Preferences: ranked groups on disk, and the pairs made from them."""

from dpa.preferences.card import DataCard, data_card
from dpa.preferences.pairs import (
    agent_preference,
    all_pairs,
    nearest,
    nearest_farthest,
    random_pairs,
    random_rollouts,
    separated,
    thin_out,
)
from dpa.preferences.provenance import Provenance, StoreError
from dpa.preferences.storage import PreferenceStorage
from dpa.preferences.store import PreferenceStore, verify
from dpa.preferences.writer import PreferenceWriter

__all__ = [
    "DataCard",
    "PreferenceStorage",
    "PreferenceStore",
    "PreferenceWriter",
    "Provenance",
    "StoreError",
    "agent_preference",
    "all_pairs",
    "data_card",
    "nearest",
    "nearest_farthest",
    "random_pairs",
    "random_rollouts",
    "separated",
    "thin_out",
    "verify",
]
