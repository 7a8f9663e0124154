"""The scene player of a page, whichever page holds it, as a reader uses it in a real browser."""

from __future__ import annotations

import re
from typing import Any

COUNT = """([name, color]) => {
  const canvas = document.getElementById("player-" + name);
  const copy = new OffscreenCanvas(canvas.width, canvas.height).getContext("2d", {willReadFrequently: true});
  copy.drawImage(canvas, 0, 0);
  const {data} = copy.getImageData(0, 0, canvas.width, canvas.height);
  let count = 0;
  for (let i = 0; i < data.length; i += 4) {
    const away = [0, 1, 2].map(k => Math.abs(data[i + k] - color[k]));
    if (Math.max(...away) < 9) count++;
  }
  return count;
}"""
SETTLE = "() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))"
"""Two frames: the player draws in the first one after a change."""


class Player:
    """The player of an opened page, in the words of a reader."""

    def __init__(self, page: Any) -> None:
        self.page = page

    def __getitem__(self, name: str) -> Any:
        return self.page.locator(f"#player-{name}")

    def text(self, name: str) -> str:
        return self[name].inner_text().replace("\u00a0", " ")

    def at(self, seconds: float) -> None:
        self["time"].fill(str(10 + 10 * seconds))
        self.page.evaluate(SETTLE)

    def choose(self, name: str, label: str | re.Pattern[str]) -> None:
        if isinstance(label, re.Pattern):
            label = next(text for text in self.options(name) if label.search(text))
        self[name].select_option(index=self.options(name).index(label))
        self.page.evaluate(SETTLE)

    def click(self, name: str, **options: Any) -> None:
        self[name].click(**options)
        self.page.evaluate(SETTLE)

    def options(self, name: str) -> list[str]:
        return [text.replace("\u00a0", " ") for text in self[name].locator("option").all_inner_texts()]

    def chosen(self, name: str) -> str:
        return self[name].evaluate("select => select.selectedOptions[0].text.replaceAll('\\u00a0', ' ')")

    def picture(self, name: str) -> str:
        return self[name].evaluate("canvas => canvas.toDataURL()")

    def count(self, name: str, color: list[int]) -> int:
        return self.page.evaluate(COUNT, [name, color])

    def wait_past(self, seconds: float) -> None:
        """Until the clock, playing, shows more than this."""
        self.page.wait_for_function(
            f"() => parseFloat(document.getElementById('player-clock').value.slice(1)) > {seconds}"
        )
