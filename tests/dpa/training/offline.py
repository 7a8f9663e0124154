"""What an offline run of Weights & Biases has kept, read without its client."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any


def wandb_records(run: Path) -> list[Any]:
    """Records of an offline run: its file is a header of 7 bytes, then blocks of checksummed pieces of records."""
    from wandb.proto.wandb_internal_pb2 import Record

    data, place, content, records = run.read_bytes(), 7, b"", []
    while place + 7 <= len(data):
        left = 32768 - place % 32768
        if left < 7:
            place += left
            continue
        length, kind = int.from_bytes(data[place + 4 : place + 6], "little"), data[place + 6]
        content += data[place + 7 : place + 7 + length]
        place += 7 + length
        if kind in (1, 4):  # a whole record, or the last piece of one
            records.append(Record.FromString(content))
            content = b""
    return records


def wandb_history(run: Path) -> list[dict[str, Any]]:
    """Rows that an offline run logged, once the process that writes them has closed it."""
    deadline = time.monotonic() + 60
    while not any(record.HasField("exit") for record in wandb_records(run)):
        assert time.monotonic() < deadline, f"{run} was not closed"
        time.sleep(0.1)
    histories = [record.history for record in wandb_records(run) if record.HasField("history")]
    return [
        {"/".join(item.nested_key) or item.key: json.loads(item.value_json) for item in history.item}
        for history in histories
    ]
