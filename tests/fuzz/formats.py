"""The formats that are fuzzed, by name."""

from __future__ import annotations

from tests.fuzz.argoverse import ARGOVERSE
from tests.fuzz.case import Format
from tests.fuzz.gpudrive import GPUDRIVE
from tests.fuzz.store import STORE
from tests.fuzz.womd import WOMD

FORMATS: dict[str, Format] = {format.name: format for format in (WOMD, GPUDRIVE, ARGOVERSE, STORE)}
