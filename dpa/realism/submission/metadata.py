"""Who submits what: the metadata that every shard of a submission repeats (realism.md section 9)."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import MISSING, asdict, dataclass, fields
from pathlib import Path
from typing import Any

import yaml
from google.protobuf.message import DecodeError

from dpa.realism.submission.messages import SIM_AGENTS_SUBMISSION, SimAgentsChallengeSubmission, SubmissionError

_MAIL = re.compile(r"[^@\s]+@[^@\s]+\.[^@\s]+")
_COUNT = re.compile(r"\d+(\.\d+)?[KMBT]?")
_ACKNOWLEDGE = "acknowledge_complies_with_closed_loop_requirement"


@dataclass(frozen=True)
class Metadata:
    """What the challenge asks about a submission; all without a default is required since 2024.

    Attributes:
        account_name: e-mail address that the account is registered with.
        unique_method_name: name on the leaderboard.
        uses_lidar_data: the method saw lidar data.
        uses_camera_data: the method saw camera data.
        uses_public_model_pretraining: the method starts from a public model.
        num_model_parameters: a number as text, with K, M, B or T for powers of 1000: ``"24"``, ``"7M"``.
        acknowledge_complies_with_closed_loop_requirement: the rollouts obey the rules of closed loop; must be true.
        authors: names.
        affiliation: of the authors.
        description: of the method.
        method_link: to a paper or code.
        public_model_names: of the models that the method starts from.
        submission_type: 1, a Sim Agents submission; nothing else is written here.

    Raises:
        SubmissionError: one error that lists every field that is wrong.

    Examples:
        >>> metadata = Metadata("me@example.org", "mine", False, False, False, "7M", True)
        >>> Metadata.from_bytes(metadata.to_bytes()) == metadata
        True
        >>> Metadata("me", "mine", False, False, False, "7M", True)
        Traceback (most recent call last):
        ...
        dpa.realism.submission.messages.SubmissionError: metadata: account_name must be ... got 'me'.
    """

    account_name: str
    unique_method_name: str
    uses_lidar_data: bool
    uses_camera_data: bool
    uses_public_model_pretraining: bool
    num_model_parameters: str
    acknowledge_complies_with_closed_loop_requirement: bool
    authors: tuple[str, ...] = ()
    affiliation: str = ""
    description: str = ""
    method_link: str = ""
    public_model_names: tuple[str, ...] = ()
    submission_type: int = SIM_AGENTS_SUBMISSION

    def __post_init__(self) -> None:
        faults = metadata_faults(asdict(self))
        if faults:
            raise SubmissionError(f"metadata: {'; '.join(faults)}.")

    @classmethod
    def load(cls, path: str | Path) -> Metadata:
        """Read a YAML file whose keys are the attributes.

        Raises:
            SubmissionError: no such file, no YAML, an unknown key, or a field that is missing or wrong.
        """
        try:
            values = yaml.safe_load(Path(path).read_text(encoding="utf-8"))
        except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
            raise SubmissionError(f"{path}: no YAML file with metadata of a submission ({error}).") from None
        if not isinstance(values, dict):
            raise SubmissionError(f"{path}: must map names of metadata to values, got {values!r}.")
        plain = {name: tuple(value) if isinstance(value, list) else value for name, value in values.items()}
        faults = metadata_faults({"submission_type": SIM_AGENTS_SUBMISSION, **plain})
        if faults:
            raise SubmissionError(f"{path}: {'; '.join(faults)}.")
        return cls(**plain)

    @classmethod
    def from_bytes(cls, data: bytes) -> Metadata:
        """The metadata of a serialized ``SimAgentsChallengeSubmission``.

        Raises:
            SubmissionError: a field is missing or wrong.
        """
        try:
            values = read_fields(data)
        except DecodeError as error:
            raise SubmissionError(f"the metadata cannot be read ({error}); write the file again.") from None
        faults = metadata_faults(values)
        if faults:
            raise SubmissionError(f"metadata: {'; '.join(faults)}.")
        return cls(**values)

    def to_bytes(self) -> bytes:
        """A serialized ``SimAgentsChallengeSubmission`` without rollouts; empty optional fields stay unset."""
        optional = {field.name for field in fields(self) if field.default is not MISSING}
        values = {name: value for name, value in asdict(self).items() if value or name not in optional}
        return SimAgentsChallengeSubmission(**values).SerializeToString(deterministic=True)


def read_fields(data: bytes) -> dict[str, Any]:
    """The metadata that are set in a serialized ``SimAgentsChallengeSubmission``, right or wrong, by name.

    Raises:
        google.protobuf.message.DecodeError: no such message.

    Examples:
        >>> read_fields(SimAgentsChallengeSubmission(authors=["A", "B"]).SerializeToString())
        {'authors': ('A', 'B')}
    """
    message = SimAgentsChallengeSubmission.FromString(data)
    known = {field.name for field in fields(Metadata)}
    values = {field.name: value for field, value in message.ListFields() if field.name in known}
    return {name: tuple(value) if name in _REPEATED else value for name, value in values.items()}


def metadata_faults(values: Mapping[str, Any]) -> list[str]:
    """Everything that is wrong with metadata, in the order of :class:`Metadata`; unknown names come last.

    Examples:
        >>> metadata_faults({"account_name": "me@example.org"})[:2]
        ['submission_type is missing', 'unique_method_name is missing']
    """
    faults = [f"{name} is missing" for name in _REQUIRED if name not in values]
    for name, kind in _KINDS.items():
        if name in values and not _is(values[name], kind):
            faults.append(f"{name} must be {_WORDS[kind]}, got {values[name]!r}")
        elif name in values and name in _RULES and not _RULES[name][0](values[name]):
            faults.append(f"{name} must be {_RULES[name][1]}, got {values[name]!r}")
    return faults + [f"{name!r} is unknown" for name in values if name not in _KINDS]


def _is(value: Any, kind: str) -> bool:
    if kind == "tuple[str, ...]":
        return isinstance(value, tuple) and all(isinstance(item, str) for item in value)
    return type(value) is {"str": str, "bool": bool, "int": int}[kind]


_KINDS = {field.name: str(field.type) for field in fields(Metadata)}
_REPEATED = [name for name, kind in _KINDS.items() if kind.startswith("tuple")]
_REQUIRED = ["submission_type", *(field.name for field in fields(Metadata) if field.default is MISSING)]
_WORDS = {"str": "text", "bool": "true or false", "int": "a whole number", "tuple[str, ...]": "a list of texts"}
_RULES = {
    "account_name": (_MAIL.fullmatch, "the e-mail address of the registered account"),
    "unique_method_name": (str.strip, "a name"),
    "num_model_parameters": (_COUNT.fullmatch, 'a number as text, such as "24" or "7M"'),
    _ACKNOWLEDGE: (bool, "true: the challenge takes closed-loop rollouts only"),
    "submission_type": (SIM_AGENTS_SUBMISSION.__eq__, f"{SIM_AGENTS_SUBMISSION} (Sim Agents)"),
}
"""What else must hold for a field: a test, and its words."""
