"""The world: scenes, where they come from, and the multi-agent traffic environment.

This package imports nothing of :mod:`dpa`.
"""
