"""What a comparison found, for people: statistics, tables, figures and one page with playable scenes.

Everything here works on plain data (dicts that JSON can hold, tensors, scenes); nothing knows a policy or an
environment. The shape of the ``comparison`` dict that recipes write and this package reads is::

    {
        "metric": "2024",                            # configuration of the realism metric
        "scenes": {"train": 100, "tune": 24, "eval": 54, "source": "..."},
        "rows": [                                    # one for each method, seed and top_p
            {"method", "seed", "top_p", "n_scenes", "kinematic", "interactive", "map_based", "realism", "min_ade",
             "collision_rate", "offroad_rate", "preference_distance", "pair_accuracy"},
        ],
        "paired": [                                  # one for each method (and top_p) that is compared
            {"method", "realism_difference", "ci95": [low, high], "over", "n_seeds"},
        ],
        "per_scene": {method: {seed: [realism of each evaluation scene]}},
        "seeds": [0, 1, 2],
        "stages": {"pretrain": seconds, ...},
        "wall_seconds": 3600.0,
        "versions": {"torch": "...", ...},
        "command": "python -m recipes.compare ...",
    }

A number that was not measured is None, never NaN. The reference's rows carry the method name
:data:`~dpa.report.table.REFERENCE`.
"""
