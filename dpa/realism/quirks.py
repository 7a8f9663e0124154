"""Behaviours of the official code that look like accidents, by name.

To give the official numbers is to give these too, so every configuration of a year has those of its year. Without any
of them (``realism(..., quirks=False)``) the metric is what its description says; its numbers compare with nothing else.
"""

from __future__ import annotations

from enum import StrEnum


class Quirk(StrEnum):
    """One behaviour; the comment says what the clean definition does instead.

    Examples:
        >>> Quirk("unwrapped_turn") is Quirk.UNWRAPPED_TURN
        True
    """

    NAN_IN_LAST_BIN = "nan_in_last_bin"
    """Differences that do not exist (a rollout's end) count in the last bin (realism.md 2.1); clean: they do not."""

    UNMASKED_SAMPLES = "unmasked_samples"
    """Rollouts are counted at steps that the log lacks too (6.2); clean: at the steps at which the log is scored."""

    INVALID_AT_ORIGIN = "invalid_at_origin"
    """A step that the log lacks lies at the origin of the world, and differences reach there (2.2); clean: none do."""

    ENDS_UNSCORED = "ends_unscored"
    """Speeds at the first step are not scored, although the step before it is known (2.3); clean: they are."""

    UNWRAPPED_TURN = "unwrapped_turn"
    """Headings of +3.1 and -3.1 count as 6.2 rad apart when a leader is looked for (3.2); clean: as 0.08 rad."""

    LAST_TTC = "last_ttc"
    """The time to collision of the last step is 5 s, as no speed is known there (3.2); clean: it is not scored."""

    LONGEST_RING = "longest_ring"
    """A ring of road edge is closed only if it is the longest polyline, for padding (4.1); clean: every ring is."""

    POINTS_AT_ZERO = "points_at_zero"
    """An edge whose nearest piece has no length is at distance 0, however far (2023 only); clean: where it is."""

    PLUS_FOR_MINUS = "plus_for_minus"
    """Distances to lanes add the projection that they should subtract (4.2); clean: they subtract it."""

    LANES_TO_ORIGIN = "lanes_to_origin"
    """Lanes shorter than the longest go on to the origin of the world, for padding (4.2); clean: no lane does."""

    ABSENT_STOP_AT_ORIGIN = "absent_stop_at_origin"
    """A stop point of a step without one is the origin of the world (4.2); clean: nothing is crossed then."""

    HISTORY_IN_ADE = "history_in_ade"
    """The eleven steps of history, whose error is 0, take part in the mean displacement (5); clean: they do not."""

    GHOSTS = "ghosts"
    """Agents that the log lacks at a step are there, at the origin of the world, and events count at all steps (8; only
    the first code of 2023, pip 1.6.0); clean and ever since: only what is logged counts."""
