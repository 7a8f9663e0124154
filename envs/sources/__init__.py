"""Raw files to :class:`~envs.scene.Scene`: one module for each source, all listed in :data:`SOURCES`."""

from __future__ import annotations

from envs.sources.argoverse import ARGOVERSE
from envs.sources.gpudrive import GPUDRIVE
from envs.sources.source import Notes, Record, Source
from envs.sources.sumo import SUMO
from envs.sources.womd import WOMD

SOURCES: dict[str, Source] = {source.name: source for source in (WOMD, GPUDRIVE, ARGOVERSE, SUMO)}
"""Every source that ``python -m envs.convert`` knows, by name."""

__all__ = ["SOURCES", "Notes", "Record", "Source"]
