"""How methods of an experiment hang together, what is told where they do not, and the account of their stages."""

from __future__ import annotations

import json
import time
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig

from recipes.cli import CONFIG
from recipes.compare import check_experiment, snapshots_of
from recipes.methods import read_setups
from recipes.pool import Workers
from recipes.stages import Stages, read_account

EXPERIMENTS = sorted(path.stem for path in (Path(CONFIG["config_path"]) / "experiment").glob("*.yaml"))
FURTHER = "+experiment.setup.dpa_omf={start:dpa_adef}"


def configuration(*options: str) -> DictConfig:
    with initialize_config_dir(CONFIG["config_path"], version_base="1.3"):
        return compose("compare", list(options))


@pytest.mark.parametrize("name", [name for name in EXPERIMENTS if name != "base"])
def test_every_experiment_fits_together(name: str) -> None:
    cfg = configuration(f"experiment={name}")
    check_experiment(cfg)
    assert cfg.experiment.name == name and cfg.experiment.headline in cfg.methods
    assert set(cfg.experiment.published) <= {"reference", *cfg.methods}
    assert set((cfg.experiment.axis or {}).get("values", {})) <= set(cfg.methods)
    assert set(cfg.methods) <= set(cfg.experiment.labels)


def test_a_method_comes_after_those_that_it_starts_from_or_learns_from() -> None:
    order = list(read_setups(configuration("experiment=rounds")))
    assert order.index("dpa_omf") < order.index("omf_round_2") < order.index("omf_round_3")
    order = list(read_setups(configuration("+experiment.setup.dpa_omf={expert:sft_best_oa}")))
    assert order.index("sft_best_oa") < order.index("dpa_omf")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ((FURTHER, "+experiment.setup.dpa_adef={start:dpa_omf}"), "dpa_omf, dpa_adef need each other"),
        (("+experiment.setup.nobody={start:reference}",), "experiment.setup.nobody: there is no such method"),
        (("+experiment.setup.dpa_omf={start:nobody}",), "experiment.setup.dpa_omf names 'nobody'"),
        (("+experiment.setup.dpa_omf={ranking:nothing}",), "ranking='nothing' is not among rankings"),
        (("+experiment.setup.dpa_omf={begin:dpa_adef}",), "experiment.setup.dpa_omf has no option 'begin'"),
        (("+methods.reference=${methods.dpa_omf}",), "methods.reference: .* are taken"),
        (("experiment.split=train",), "experiment.split must be one of tune, eval, got 'train'"),
        (("experiment.checkpoints=best",), "experiment.checkpoints must be one of last, select, all, got 'best'"),
        (("experiment.checkpoints=all",), r"needs checkpoints: say for example alignment.snapshots=\[75\]"),
        (("decoding.common=[0.5,1.0]",), r"decoding.common=\[0.5, 1.0\] must be one of decoding.grid"),
    ],
)
def test_an_experiment_that_cannot_work_is_refused_before_any_work(options: tuple[str, ...], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        check_experiment(configuration(*options))


def test_snapshots_end_before_the_last_step_of_their_method() -> None:
    cfg = configuration("alignment.snapshots=[40,150]", "+experiment.setup.dpa_omf={alignment:{steps:300}}")
    assert snapshots_of(cfg, "dpa_omf") == ["dpa_omf@40", "dpa_omf@150"]
    assert snapshots_of(cfg, "dpa_adef") == ["dpa_adef@40"]


# --- the account ----------------------------------------------------------------------------------------------------
def test_the_account_keeps_what_each_job_took_the_first_time(tmp_path: Path) -> None:
    path = tmp_path / "stages.json"
    with Workers(1, threads=1) as workers:
        Stages(workers, path).run("sleep", _sleep, 1.0, [(0.01, "a"), (0.03, "b")])
        first = read_account(path)
        assert first == json.loads(path.read_text()) and set(first["sleep"]) == {"sleep 0.01 a", "sleep 0.03 b"}
        assert first["sleep"]["sleep 0.03 b"] >= 0.03
        again = Stages(workers, path)
        again.run("sleep", _sleep, 0.0, [(0.01, "a"), (0.03, "b"), (0.02, "c")])  # done before: takes no time
    kept = read_account(path)["sleep"]
    assert {name: kept[name] for name in first["sleep"]} == first["sleep"] and "sleep 0.02 c" in kept
    assert again.seconds["sleep"] == pytest.approx(sum(kept.values()))


def _sleep(factor: float, seconds: float, name: str) -> None:
    time.sleep(factor * seconds)


if __name__ == "__main__":
    pytest.main([__file__])
