"""What stands in a drawn figure."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.colors import to_rgba

from dpa.report.panels import MARKS


def marks(axes: Axes, name: str) -> np.ndarray:
    """Where the marks of one kind stand: ``[n, 2]``."""
    found = [each for each in axes.collections if isinstance(each, PathCollection) and len(each.get_offsets())]
    of_kind = [each.get_offsets() for each in found if np.allclose(each.get_facecolor()[0], to_rgba(MARKS[name][1]))]
    return np.concatenate(of_kind) if of_kind else np.zeros((0, 2))
