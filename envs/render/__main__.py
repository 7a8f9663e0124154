"""``python -m envs.render STORE --scene ID_or_index [--out X.png|X.gif|X.mp4]``: draw one logged scene."""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path

from envs.progress import progress
from envs.render.layers import fit_view
from envs.render.picture import render_frames
from envs.render.save import WRITERS, save_picture
from envs.scene import CURRENT_STEP, LOG_STEPS, SceneError
from envs.store import SceneStore


def main(arguments: list[str] | None = None) -> None:
    """Draw one scene of a store; ``python -m envs.render --help`` says how."""
    parser = argparse.ArgumentParser(prog="python -m envs.render", description="Draw one logged scene of a store.")
    parser.add_argument("store", type=Path, help="folder of the store")
    parser.add_argument("--scene", required=True, help="scene id, or index in the store")
    parser.add_argument(
        "--out", type=Path, help="file to write: .png (one step), .gif or .mp4 (all steps) (default: SCENE_ID.png)"
    )
    parser.add_argument("--step", type=int, default=CURRENT_STEP, help="step of a .png, 0 to 90 (default: %(default)s)")
    parser.add_argument("--radius", type=float, help="half the side of the window [m] (default: fits the agents)")
    parser.add_argument("--pixels", type=int, default=900, help="height and width (default: %(default)s)")
    chosen = parser.parse_args(arguments)
    try:
        store = SceneStore(chosen.store)
        scene = store[store.find(chosen.scene)]
    except SceneError as error:
        parser.error(str(error))
    out = chosen.out or Path(scene.scene_id.replace("/", "_") + ".png")
    if out.suffix.lower() not in WRITERS:
        parser.error(f"--out must end in {', '.join(WRITERS)}, got {out}")
    if not 0 <= chosen.step < LOG_STEPS:
        parser.error(f"--step must lie in 0 to {LOG_STEPS - 1}, got {chosen.step}")
    if chosen.pixels < 1:
        parser.error(f"--pixels must be 1 or more, got {chosen.pixels}")
    view = fit_view(scene)
    if chosen.radius is not None:
        if not math.isfinite(chosen.radius) or chosen.radius <= 0:
            parser.error(f"--radius must be greater than 0 m, got {chosen.radius}")
        view = view._replace(radius=chosen.radius)
    steps = [chosen.step] if out.suffix.lower() == ".png" else range(LOG_STEPS)
    frames = render_frames(scene, steps=steps, view=view, pixels=chosen.pixels)
    try:
        save_picture(out, progress(frames, "draw", total=len(steps), unit="frame", disable=len(steps) == 1))
    except ImportError as error:
        parser.error(str(error))
    except OSError as error:
        parser.error(f"{out} cannot be written: {error}")
    sys.stdout.write(f"{out}\n")


if __name__ == "__main__":
    main()
