"""Motion tokens: a decision of 0.5 s as one word of a small vocabulary."""

from dpa.tokens.base import MotionTokenizer, TokenizedTracks
from dpa.tokens.disks import KDisksTokenizer
from dpa.tokens.patches import PatchTokenizer
from dpa.tokens.transform import TokenAction
from dpa.tokens.verlet import VerletTokenizer

__all__ = ["KDisksTokenizer", "MotionTokenizer", "PatchTokenizer", "TokenAction", "TokenizedTracks", "VerletTokenizer"]
