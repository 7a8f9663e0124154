"""Submission files of the Waymo Open Sim Agents Challenge (realism.md section 9), without TensorFlow.

:func:`encode_rollouts` and :func:`decode_rollouts` turn poses into messages and back, :class:`SubmissionWriter`
makes the archive, :class:`SubmissionReader` goes through one, and :func:`validate` lists what is wrong with it.
"""

from __future__ import annotations

from dpa.realism.submission.convert import decode_rollouts, encode_rollouts
from dpa.realism.submission.messages import NUM_ROLLOUTS, CorruptError, SubmissionError
from dpa.realism.submission.metadata import Metadata
from dpa.realism.submission.reader import SubmissionReader
from dpa.realism.submission.validate import Fault, validate
from dpa.realism.submission.writer import SubmissionWriter, plan_submission

__all__ = [
    "NUM_ROLLOUTS",
    "CorruptError",
    "Fault",
    "Metadata",
    "SubmissionError",
    "SubmissionReader",
    "SubmissionWriter",
    "decode_rollouts",
    "encode_rollouts",
    "plan_submission",
    "validate",
]
