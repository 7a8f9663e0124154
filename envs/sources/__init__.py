"""Raw files to :class:`~envs.scene.Scene`: one module for each source."""
