"""What an evaluation has scored so far, kept beside its result, so that a kill costs one scene at most."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from envs.files import write_bytes


class PartialResult:
    """JSON lines ``[scene index, entry]`` after a first line with the options; removed once the result is written.

    Each is appended in one write. What a kill cut short is left out, and so is all that was scored
    with other options.

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
        self._options = json.dumps(decided_by, sort_keys=True) + "\n"

    def read(self) -> dict[int, dict[str, Any]]:
        """Entries of the scenes scored so far, by index; afterwards the file holds them and nothing else.

        Raises:
            ValueError: the file is damaged.
        """
        lines = self.path.read_text(encoding="utf-8").splitlines(keepends=True) if self.path.is_file() else []
        same = lines[:1] == [self._options]
        whole = [line for line in lines[1:] if line.endswith("\n")] if same else []
        self.path.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(self.path, "".join([self._options, *whole]).encode())
        try:
            return {int(index): dict(entry) for index, entry in map(json.loads, whole)}
        except (ValueError, TypeError) as error:
            raise ValueError(f"{self.path} is damaged ({error}); remove it and run again.") from None

    def add(self, entries: dict[int, dict[str, Any]]) -> None:
        """Append entries; :meth:`read` comes first."""
        if not self.path.is_file():
            self.read()
        with self.path.open("a", encoding="utf-8") as file:
            file.write("".join(json.dumps(item) + "\n" for item in entries.items()))

    def remove(self) -> None:
        """The result is written: nothing is partial any more."""
        self.path.unlink(missing_ok=True)
