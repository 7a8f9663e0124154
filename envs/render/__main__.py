"""``python -m envs.render STORE --scene ID_or_index --out X.png|X.gif``: draw one logged scene of a store."""

from __future__ import annotations

import argparse
import math
from pathlib import Path

from envs.progress import progress
from envs.render.layers import fit_view
from envs.render.picture import render_frames, save_picture
from envs.scene import CURRENT_STEP, LOG_STEPS, SceneError
from envs.store import SceneStore


def main(arguments: list[str] | None = None) -> None:
    """Draw one scene of a store; ``python -m envs.render --help`` says how."""
    parser = argparse.ArgumentParser(prog="python -m envs.render", description="Draw one logged scene of a store.")
    parser.add_argument("store", type=Path, help="folder of the store")
    parser.add_argument("--scene", required=True, help="scene id, or index in the store")
    parser.add_argument("--out", required=True, type=Path, help="picture to write: .png (one step) or .gif (all steps)")
    parser.add_argument("--step", type=int, default=CURRENT_STEP, help="step of a .png, 0 to 90 (default: %(default)s)")
    parser.add_argument("--radius", type=float, help="half the side of the window [m] (default: fits the agents)")
    parser.add_argument("--pixels", type=int, default=900, help="height and width (default: %(default)s)")
    chosen = parser.parse_args(arguments)
    try:
        store = SceneStore(chosen.store)
        scene = store[store.find(chosen.scene)]
    except SceneError as error:
        parser.error(str(error))
    if chosen.out.suffix.lower() not in (".png", ".gif"):
        parser.error(f"--out must end in .png or .gif, got {chosen.out}")
    if not 0 <= chosen.step < LOG_STEPS:
        parser.error(f"--step must lie in 0 to {LOG_STEPS - 1}, got {chosen.step}")
    view = fit_view(scene)
    if chosen.radius is not None:
        if not math.isfinite(chosen.radius) or chosen.radius <= 0:
            parser.error(f"--radius must be greater than 0 m, got {chosen.radius}")
        view = view._replace(radius=chosen.radius)
    steps = range(LOG_STEPS) if chosen.out.suffix.lower() == ".gif" else [chosen.step]
    frames = render_frames(scene, steps=steps, view=view, pixels=chosen.pixels)
    save_picture(chosen.out, progress(frames, "draw", total=len(steps), unit="frame", disable=len(steps) == 1))


if __name__ == "__main__":
    main()
