"""A policy family of one's own, as docs/how-to.md has it, goes through everything that a recipe does; so do others."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch
from torchrl.envs import TransformedEnv

from dpa.models import Contexts, MotionActor, MotionModel, collate_contexts
from dpa.models.registry import FAMILIES
from dpa.tokens import TokenAction
from dpa.training.checkpoint import load_policy
from envs import keys
from envs.sources.synthetic import straight_road
from envs.traffic import TrafficEnv
from recipes.common.models import open_policy

HOW_TO = Path(__file__).resolve().parents[2] / "docs" / "how-to.md"


def block(language: str, first_line: str) -> str:
    """The block of the how-to that begins with a line."""
    (found,) = re.findall(rf"^```{language}\n({re.escape(first_line)}\n.*?)^```$", HOW_TO.read_text(), re.DOTALL | re.M)
    return found


@pytest.fixture(scope="module")
def habit(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The option that finds the YAML of the family, which is registered as long as the tests run."""
    folder = tmp_path_factory.mktemp("config")
    (folder / "model").mkdir()
    (folder / "model/habit.yaml").write_text(block("yaml", "# recipes/config/model/habit.yaml"))
    namespace: dict = {}
    for first in ("# dpa/models/habit/__init__.py", "from dpa.models.contract import check_contract"):
        exec(compile(block("python", first), "how-to", "exec", dont_inherit=True), namespace)
    yield f"hydra.searchpath=[file://{folder}]"
    del FAMILIES["habit"]


@pytest.fixture(scope="module", params=["habit", "trajeglish_nano"])
def trained(
    request: pytest.FixtureRequest,
    habit: str,
    run: Callable,
    options: Callable,
    tmp_path_factory: pytest.TempPathFactory,
) -> Path:
    folder = tmp_path_factory.mktemp(request.param)
    outcome = run("pretrain", *options("pretrain", f"model={request.param}", habit, f"output={folder}"))
    assert outcome.status == 0, outcome.err
    return folder / "policy.pt"


def test_it_is_opened_by_its_file_alone(trained: Path) -> None:
    model, episode, config = open_policy(trained)
    assert trained.parent.name.startswith(config["family"]) and episode.horizon == model.config.horizon == 16
    assert isinstance(model, MotionModel)


def test_what_it_decides_step_by_step_is_what_it_thinks_of_the_whole(trained: Path) -> None:
    model, _, _ = open_policy(trained)
    scenes = [straight_road(3, seed=1), straight_road(2, seed=2)]
    env = TransformedEnv(TrafficEnv(scenes, num_scenes=2, num_rollouts=3), TokenAction(model.tokenizer))
    contexts = Contexts(scenes, model.featurize)
    rolled = env.rollout(16, MotionActor(model, contexts, num_rollouts=3))
    tokens = rolled[keys.TOKEN].transpose(1, 2).unflatten(0, (2, 3))
    context = collate_contexts([contexts[0], contexts[1]])
    with torch.no_grad():
        logits = model(context, tokens, context.episode.controlled[:, None, :, None].expand(-1, 1, -1, 16))
    expected = logits.log_softmax(-1).gather(-1, tokens[..., None])[..., 0]
    controlled = rolled[keys.CONTROLLED].transpose(1, 2).unflatten(0, (2, 3))
    written = rolled[keys.LOG_PROB].transpose(1, 2).unflatten(0, (2, 3))
    torch.testing.assert_close(written[controlled], expected[controlled], atol=1e-5, rtol=0)


@pytest.mark.parametrize(
    ("trained", "method"),
    [
        *(("habit", method) for method in ("dpa_omf", "sft_best_oa", "rloo", "cat_k")),
        *(("trajeglish_nano", method) for method in ("dpa_omf", "rloo", "cat_k")),
    ],
    indirect=["trained"],
)
def test_it_is_collected_aligned_and_evaluated(
    trained: Path, habit: str, run: Callable, options: Callable, tmp_path: Path, method: str
) -> None:
    ranked = [] if method in ("rloo", "cat_k") else [f"preferences={tmp_path / 'ranked'}"]
    if ranked:
        outcome = run("collect", *options("collect", f"policy={trained}", f"output={tmp_path / 'ranked'}"))
        assert outcome.status == 0, outcome.err
    aligning = options("align", f"method={method}", f"policy={trained}", *ranked, f"output={tmp_path / 'aligned'}")
    outcome = run("align", *aligning)
    assert outcome.status == 0, outcome.err
    before, after = (load_policy(path)[0] for path in (trained, tmp_path / "aligned/policy.pt"))
    assert any(not torch.equal(before[name], value) for name, value in after.items())
    scored = options("evaluate", f"policy={tmp_path / 'aligned/policy.pt'}", f"json={tmp_path / 'scores.json'}")
    outcome = run("evaluate", *scored)
    assert outcome.status == 0 and (tmp_path / "scores.json").is_file(), outcome.err


def test_an_unknown_family_is_refused(run: Callable, options: Callable, tmp_path: Path) -> None:
    outcome = run("pretrain", *options("pretrain", "model.family=transformer", f"output={tmp_path}"))
    assert outcome.status == 2
    assert re.search(r"model\.family must be one of \[.*'motionlm'.*\], got 'transformer'", outcome.err)


if __name__ == "__main__":
    pytest.main([__file__])
