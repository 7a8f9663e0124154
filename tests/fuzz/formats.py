"""The formats that are fuzzed, by name."""

from __future__ import annotations

from tests.fuzz.argoverse import ARGOVERSE
from tests.fuzz.arrays import ROLLOUTS, SCENARIOS
from tests.fuzz.case import Format
from tests.fuzz.gpudrive import GPUDRIVE
from tests.fuzz.policies import POLICIES, ZOO
from tests.fuzz.store import STORE
from tests.fuzz.womd import WOMD

ALL = (WOMD, GPUDRIVE, ARGOVERSE, STORE, ROLLOUTS, SCENARIOS, POLICIES, ZOO)
FORMATS: dict[str, Format] = {format.name: format for format in ALL}
