"""Traffic scenes as a Gymnasium environment, ``dpa/Traffic-v0``.

Importing this module registers the environment, which is how Gymnasium 1.x finds those of other packages::

    import gymnasium
    import dpa.gymnasium_adapter

    env = gymnasium.make("dpa/Traffic-v0", scenes="runs/scenes/train")

``gymnasium.make("dpa.gymnasium_adapter:dpa/Traffic-v0", ...)`` imports it by itself. What the environment is made of
is loaded when the first one is made. Arguments, spaces and rewards: :class:`~dpa.gymnasium_adapter.env.TrafficGym`.
"""

from __future__ import annotations

from gymnasium.envs.registration import register, registry

ENVIRONMENT_ID = "dpa/Traffic-v0"

if ENVIRONMENT_ID not in registry:
    register(ENVIRONMENT_ID, entry_point="dpa.gymnasium_adapter.env:TrafficGym")
