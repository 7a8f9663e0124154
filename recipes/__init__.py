"""The experiments: every module here is a command that reads top to bottom, and every named method is one YAML.

What commands share lies one floor down: :mod:`recipes.common` (options, scenes, policies, ranked rollouts),
:mod:`recipes.alignment` (what ``align`` learns from), :mod:`recipes.studies` (of rankings), and
:mod:`recipes.experiment` (the jobs behind ``compare``, which run the commands themselves).
"""
