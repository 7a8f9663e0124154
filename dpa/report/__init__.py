"""What experiments found, for people: statistics, tables, figures and one page with playable scenes.

Everything here works on plain data (dicts that JSON can hold, tensors, scenes) and on the files of a study; nothing
knows a policy or an environment. A study is a folder RUNS::

    experiments/<name>.json      what an experiment found: dpa.report.experiment.read_experiment
    seed_<n>/<method>/           scalars of a training run, and the evaluations behind the rows
    seed_<n>/preferences_*/      ranked rollouts of the policies of a seed
    stages.json                  seconds and jobs of each stage
    scenes.json                  what the scenes of each split hold: dpa.report.scenes.read_scene_cards
    players.json                 scenes and rollouts to play: dpa.report.player.pack_players
    validity/, sensitivity/, discriminator/    summary.json of a study of rankings

:func:`dpa.report.study.read_study` reads it and :func:`dpa.report.page.write_study` makes one page of it. In a row, a
number that was not measured is None, never NaN. The reference's rows carry the method name
:data:`~dpa.report.table.REFERENCE`.
"""
