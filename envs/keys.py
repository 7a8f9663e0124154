"""Every tensordict key of the project, and the alphabet of shapes.

Shapes are written with one alphabet everywhere:

====== ==================================================================
``S``  scenes
``K``  rollouts of each scene; the K rollouts of a scene are contiguous
``B``  ``S * K`` rows of the vectorised environment
``A``  agents, padded to the largest scene of a batch, with a ``valid`` mask
``T``  decisions (of 0.5 s, 16 in an episode, by default)
``F``  poses of 0.1 s inside one decision (5 by default)
``L``  logged steps of 0.1 s (91: ten of history, the current one, eighty to come)
``V``  motion tokens
``P``  polylines of a map
``N``  points of a map
``G``  lanes with a traffic light
====== ==================================================================

Units are metres, seconds and radians. A *pose* is ``(x, y, heading)``; x points forward, y left and angles are
counter-clockwise. Positions are relative to the origin of their scene.
"""

from __future__ import annotations

from tensordict import NestedKey

# --- what the environment shows -------------------------------------------------------------------------------------
SCENE: NestedKey = "scene"
"""``[B]`` int64: the index of the row's scene in its :class:`~envs.scene.SceneSource`."""
STEP: NestedKey = "step"
"""``[B, 1]`` int64: decisions taken so far in the episode."""
AGENTS = "agents"
RECENT: NestedKey = (AGENTS, "recent")
"""``[B, A, F + 1, 3]``: poses of the last decision, the current one last."""
VALID: NestedKey = (AGENTS, "valid")
"""``[B, A]`` bool: the agent exists now."""
KIND: NestedKey = (AGENTS, "kind")
"""``[B, A]`` int64: class of the agent, :class:`~envs.scene.AgentKind`."""
CONTROLLED: NestedKey = (AGENTS, "controlled")
"""``[B, A]`` bool: the policy moves the agent (otherwise it follows its log)."""

# --- what a policy writes -------------------------------------------------------------------------------------------
ACTION: NestedKey = (AGENTS, "action")
"""``[B, A, F, 3]``: the next F poses, in the agent's own current frame."""
TOKEN: NestedKey = (AGENTS, "token")
"""``[B, A, ...]``: the motion token that an action came from, int64, or the numbers of one without a vocabulary."""
LOG_PROB: NestedKey = (AGENTS, "log_prob")
"""``[B, A]``: log-probability of the token under the whole model (temperature 1, nothing cut) [nats]."""
SAMPLING_LOG_PROB: NestedKey = (AGENTS, "sampling_log_prob")
"""``[B, A]``: log-probability of the token under the distribution that it was drawn from [nats]."""

LABEL: NestedKey = (AGENTS, "label")
"""``[B, A]`` int64: the token that comes nearest to the log from where the agent is (of a policy that follows it)."""
LABEL_VALID: NestedKey = (AGENTS, "label_valid")
"""``[B, A]`` bool: a controlled agent whose log says where it is at the end of the decision."""

# --- what a step gives back -----------------------------------------------------------------------------------------
REWARD: NestedKey = (AGENTS, "reward")
"""``[B, A, 1]``: minus the mean displacement from the log over the decision's poses [m]."""
COLLISION: NestedKey = (AGENTS, "collision")
"""``[B, A]`` bool: the agent's box overlapped another one in the decision (on request)."""
OFFROAD: NestedKey = (AGENTS, "offroad")
"""``[B, A]`` bool: a corner of the agent's box was off the road in the decision (on request)."""
PROGRESS: NestedKey = (AGENTS, "progress")
"""``[B, A]``: metres that the agent advanced along its own logged path in the decision (on request)."""
RED_LIGHT: NestedKey = (AGENTS, "red_light")
"""``[B, A]`` bool: the agent passed the stop point of a red light in the decision (on request)."""
DONE: NestedKey = "done"
TERMINATED: NestedKey = "terminated"
TRUNCATED: NestedKey = "truncated"

# --- what ranking attaches to a group of K rollouts of one scene (batch size [S]) -----------------------------------
TOKENS: NestedKey = "tokens"
"""``[S, K, A, T, ...]`` (uint8 or int16 on disk where they are indices): tokens of every rollout."""
TOKEN_VALID: NestedKey = "token_valid"
"""``[S, A, T]`` bool: controlled agents whose tokens count."""
DISTANCE: NestedKey = "distance"
"""``[S, K]``: preference distance of a rollout to the log, agents aggregated."""
AGENT_DISTANCE: NestedKey = "agent_distance"
"""``[S, K, A]``: the same for each agent (0 where the agent took no part)."""
ADE: NestedKey = "ade"
"""``[S, K]``: mean displacement from the log [m]."""
AGENT_RANKED: NestedKey = "agent_ranked"
"""``[S, A]`` bool: agents that took part in the ranking."""
AGENT_KIND: NestedKey = "agent_kind"
"""``[S, A]`` int64: class of the agent, :class:`~envs.scene.AgentKind`; 0 for padding."""
FEATURE_SHARE: NestedKey = "feature_share"
"""``[S, K, D]``: share of each of the D features in the summed distance of the ranked agents (D may be 0)."""
RANK: NestedKey = "rank"
"""``[S, K]`` int64: 0 is the nearest rollout."""
SPREAD: NestedKey = "spread"
"""``[S, A]``: how far apart the rollouts of an agent end, root mean square distance from their mean [m]."""
REWARDS = "rewards"
"""Under it by name, ``[S, K, A, T]``: what a rollout is paid from each decision on (of methods that follow rewards)."""
RANKED_IN: NestedKey = "ranked_in"
"""``[S]``: what ranking and paying a group took, of several the mean [s]."""

# --- what a loss reads ----------------------------------------------------------------------------------------------
LABELS: NestedKey = "labels"
"""``[S, M, A, T, ...]``: tokens to predict, those of ``tokens`` or, after noise, those that lead back to the log."""
ADVANTAGE: NestedKey = "advantage"
"""``[S, K, A, T]``: how much better a rollout, or an agent's part of it, was than the others of its group."""
SAMPLE_LOG_PROB: NestedKey = "sample_log_prob"
"""``[S, K, A, T]``: ``SAMPLING_LOG_PROB`` of the rollouts of a group, TorchRL's name of it in losses [nats]."""
LEARNT: NestedKey = "learnt"
"""``[S, M or 1, A, T]`` bool: labels that count, where these are others than the tokens that count."""
PREFERRED: NestedKey = "preferred"
"""``[S, M, A, T, ...]``: tokens of the preferred rollouts."""
UNPREFERRED: NestedKey = "unpreferred"
"""``[S, N, A, T, ...]``: tokens of the unpreferred rollouts; pair by pair where rollouts come in pairs (N = M)."""
AGENT_PREFERENCE: NestedKey = "agent_preference"
"""``[S, M, A]`` int64: 1 where an agent itself prefers the preferred rollout of a pair, -1 the other, 0: no say."""
