"""A discriminator that tells logs from rollouts (paper figure 10, appendix F), and what its ranking is held against.

``motion`` is what it sees of an agent, ``network`` what it makes of it; ``smoothness`` measures jerk without any of it.
"""

from dpa.discriminator.motion import OWN, ROAD, observed_motion, until_first_hole, width_of
from dpa.discriminator.network import Discriminator, auc, discriminator_loss
from dpa.discriminator.smoothness import mean_squared_jerk

__all__ = [
    "OWN",
    "ROAD",
    "Discriminator",
    "auc",
    "discriminator_loss",
    "mean_squared_jerk",
    "observed_motion",
    "until_first_hole",
    "width_of",
]
