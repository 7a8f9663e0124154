"""The method: tokens, policy, ranking, preferences, losses, realism, training and report.

This package imports :mod:`envs` and never :mod:`recipes`.
"""
