"""Bird's-eye pictures of a scene: its map, its lights, its agents and where they went.

A picture has three layers that can be used alone: :func:`draw_map` (never changes), :func:`draw_trails` (one set per
rollout) and :func:`draw_agents` (one per step). :func:`render_frames` is all of them; it draws the map once and then
only what moves. From a shell::

    python -m envs.render STORE --scene 637f20cafde22ff8 --out scene.png
    python -m envs.render STORE --scene 0 --out scene.mp4
"""

from envs.render.layers import View, draw_agents, draw_map, draw_trails, fit_view, frame_view, pose_tracks
from envs.render.picture import frames_over, render_frame, render_frames
from envs.render.save import check_writable, save_picture

__all__ = [
    "View",
    "check_writable",
    "draw_agents",
    "draw_map",
    "draw_trails",
    "fit_view",
    "frame_view",
    "frames_over",
    "pose_tracks",
    "render_frame",
    "render_frames",
    "save_picture",
]
