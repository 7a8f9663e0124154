"""Message classes of a submission, and what they have in common.

Field numbers are facts of the format (realism.md section 9). The fields from ``width`` to ``valid`` belong to the
Scenario-Gen challenge; a Sim Agents submission leaves them unset.
"""

from __future__ import annotations

from envs.sources.protobuf import message_classes

NUM_ROLLOUTS = 32
"""Rollouts of every scenario in a submission."""
SIM_AGENTS_SUBMISSION = 1
"""Value of ``submission_type``."""
POSE_FIELDS = ("center_x", "center_y", "center_z", "heading")
"""Fields of a trajectory in the order of the last dimension of poses."""


class SubmissionError(ValueError):
    """Something cannot be written to a submission, or read from one; the message names it and says the fix."""


class CorruptError(SubmissionError):
    """A file is no submission, or a damaged one."""


_CLASSES = message_classes(
    "dpa.wosac",
    {
        "SimulatedTrajectory": {
            "center_x": (2, "float[]"),
            "center_y": (3, "float[]"),
            "center_z": (4, "float[]"),
            "heading": (5, "float[]"),
            "object_id": (6, "int32"),
            "width": (7, "float[]"),
            "length": (8, "float[]"),
            "height": (9, "float[]"),
            "object_type": (10, "int32"),
            "valid": (11, "bool[]"),
        },
        "JointScene": {"simulated_trajectories": (1, "SimulatedTrajectory*")},
        "ScenarioRollouts": {"scenario_id": (1, "string"), "joint_scenes": (2, "JointScene*")},
        "SimAgentsChallengeSubmission": {
            "scenario_rollouts": (1, "ScenarioRollouts*"),
            "submission_type": (2, "int32"),
            "account_name": (3, "string"),
            "unique_method_name": (4, "string"),
            "authors": (5, "string*"),
            "affiliation": (6, "string"),
            "description": (7, "string"),
            "method_link": (8, "string"),
            "uses_lidar_data": (9, "bool"),
            "uses_camera_data": (10, "bool"),
            "uses_public_model_pretraining": (11, "bool"),
            "num_model_parameters": (12, "string"),
            "public_model_names": (13, "string*"),
            "acknowledge_complies_with_closed_loop_requirement": (14, "bool"),
        },
    },
)

SimulatedTrajectory = _CLASSES["SimulatedTrajectory"]
"""The states of one object at the steps 11 to 90, in world coordinates [m, rad]."""
JointScene = _CLASSES["JointScene"]
"""One rollout: a trajectory for each object."""
ScenarioRollouts = _CLASSES["ScenarioRollouts"]
"""All rollouts of one scenario."""
SimAgentsChallengeSubmission = _CLASSES["SimAgentsChallengeSubmission"]
"""One shard: rollouts of some scenarios, and the metadata of the submission."""
