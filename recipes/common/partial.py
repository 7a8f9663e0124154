"""What an evaluation has scored so far, kept beside its result, so that a kill costs one scene at most."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from envs.files import write_bytes
from envs.options import differences


class PartialResult:
    """JSON lines ``[scene index, entry]`` after a first line with the options; removed once the result is written.

    Each is appended in one write. What a kill cut short is left out.

    Args:
        result: the JSON that the entries are for.
        decided_by: the options of this run.

    Examples:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     partial = PartialResult(Path(folder) / "result.json", {"seed": 0})
        ...     partial.add({3: {"realism": 0.7}})
        ...     PartialResult(Path(folder) / "result.json", {"seed": 0}).read()
        {3: {'realism': 0.7}}
    """

    def __init__(self, result: Path, decided_by: dict[str, Any]) -> None:
        self.path = result.with_name(f".{result.name}.scored")
        self._decided_by = decided_by

    def read(self) -> dict[int, dict[str, Any]]:
        """Entries of the scenes scored so far, by index; afterwards the file holds them and nothing else.

        Raises:
            ValueError: the file is damaged, or of other options.
        """
        text = self.path.read_text(encoding="utf-8") if self.path.is_file() else ""
        lines = [line for line in text.splitlines(keepends=True) if line.endswith("\n")]
        try:
            differ = differences(json.loads(lines[0]), self._decided_by) if lines else ""
            found = {int(index): dict(entry) for index, entry in map(json.loads, lines[1:])}
        except (ValueError, TypeError) as error:
            raise ValueError(f"{self.path} is damaged ({error}); remove it and run again.") from None
        if differ:
            raise ValueError(
                f"{self.path} holds scenes that were scored with other options ({differ}); name another "
                "file or folder, or remove it."
            )
        self.path.parent.mkdir(parents=True, exist_ok=True)
        head = json.dumps(self._decided_by, sort_keys=True) + "\n"
        write_bytes(self.path, "".join([head, *lines[1:]]).encode())
        return found

    def add(self, entries: dict[int, dict[str, Any]]) -> None:
        """Append entries; :meth:`read` comes first."""
        if not self.path.is_file():
            self.read()
        with self.path.open("a", encoding="utf-8") as file:
            file.write("".join(json.dumps(item) + "\n" for item in entries.items()))

    def remove(self) -> None:
        """The result is written: nothing is partial any more."""
        self.path.unlink(missing_ok=True)
