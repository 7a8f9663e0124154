"""Policies that come with the package: what a name opens, what a card says, and what may not be given away."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from dpa import zoo
from dpa.training.checkpoint import load_policy, save_policy
from recipes import zoo as command
from recipes.common.models import digest_of, open_policy, policy_file


@pytest.fixture
def shelf(tmp_path: Path) -> Path:
    """A copy of one policy of the zoo in a zoo of its own."""
    shutil.copytree(zoo.FOLDER / "motionlm-nano-sumo", tmp_path / "zoo/mine")
    return tmp_path / "zoo"


# --- what comes with the package ------------------------------------------------------------------------------------
@pytest.mark.parametrize("name", zoo.names())
def test_every_policy_is_what_its_card_says(name: str) -> None:
    card = zoo.card(name)
    model, _, _ = open_policy(f"zoo:{name}")
    weights, _, made = load_policy(zoo.find(name))
    assert sum(value.numel() for value in model.parameters()) == card["parameters"]
    assert set(command.sources(made)) == {"sumo"}, "no licence is attached to it"
    assert made["tune_nll"] == card["tune_nll"] and made["seed"] == card["seed"]
    assert card["made_by"]["command"].startswith("python -m recipes.pretrain")
    for measured in card["measures"].values():
        assert measured["options"]["policy"] == digest_of(weights)
        assert 0 < measured["mean"]["realism"] < 1 and measured["scenes"] > 0


def test_policies_are_a_few_megabytes() -> None:
    assert all(zoo.find(name).stat().st_size < 8e6 for name in zoo.names())


# --- names ----------------------------------------------------------------------------------------------------------
def test_a_name_opens_the_file_and_a_path_stays_a_path() -> None:
    assert policy_file("zoo:motionlm-nano-sumo") == zoo.FOLDER / "motionlm-nano-sumo/policy.pt"
    assert policy_file(Path("zoo/policy.pt")) == Path("zoo/policy.pt")


def test_a_wrong_name_is_refused_with_the_nearest_one() -> None:
    with pytest.raises(ValueError, match="policy 'motionlm-nan-sumo'; it has .* Did you mean zoo:motionlm-nano-sumo"):
        policy_file("zoo:motionlm-nan-sumo")
    with pytest.raises(ValueError, match="no policy '../secret'; it has behaviorgpt-nano-sumo, motionlm"):
        policy_file("zoo:../secret")


def test_changed_weights_are_refused(shelf: Path) -> None:
    file = shelf / "mine/policy.pt"
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)
    with pytest.raises(ValueError, match=r"policy.pt has the checksum .* weights of zoo:mine are damaged"):
        zoo.find("mine", shelf)
    file.unlink()
    with pytest.raises(ValueError, match=r"policy.pt is missing, the weights of zoo:mine"):
        zoo.find("mine", shelf)


@pytest.mark.parametrize("content", ["{", "[]", "{}", '{"sha256": 1}'])
def test_a_damaged_card_is_refused(shelf: Path, content: str) -> None:
    (shelf / "mine/card.json").write_text(content)
    with pytest.raises(ValueError, match=r"card.json (is damaged|has no sha256)"):
        zoo.find("mine", shelf)


# --- the command ----------------------------------------------------------------------------------------------------
def test_the_list_has_every_policy_with_its_measures(capsys: pytest.CaptureFixture) -> None:
    assert command.main([]) == 0
    printed = capsys.readouterr().out
    for name in zoo.names():
        assert name in printed
        for measured in zoo.card(name)["measures"].values():
            assert f"{measured['mean']['realism']:.3f}" in printed


def test_the_card_of_one_is_its_json(capsys: pytest.CaptureFixture) -> None:
    assert command.main(["show", "zoo:motionlm-nano-sumo"]) == 0
    assert json.loads(capsys.readouterr().out) == zoo.card("motionlm-nano-sumo")


def test_a_name_that_is_none_ends_in_one_error(capsys: pytest.CaptureFixture) -> None:
    assert command.main(["show", "x"]) == 2
    assert capsys.readouterr().err.startswith("error: the zoo has no policy 'x'")


@pytest.fixture
def trained(run: Callable, options: Callable, tmp_path: Path) -> Path:
    """A finished training, said to be of simulated scenes."""
    assert run("pretrain", *options("pretrain", f"output={tmp_path / 'run'}")).status == 0
    marked(tmp_path / "run", source="sumo")
    return tmp_path / "run"


def marked(folder: Path, **made: object) -> None:
    """Write something else about a policy into its file."""
    weights, config, metadata = load_policy(folder / "policy.pt")
    save_policy(folder / "policy.pt", weights, config, {**metadata, **made})


def test_a_finished_training_is_put_there_with_its_evaluation(trained: Path, tmp_path: Path) -> None:
    digest = digest_of(load_policy(trained / "policy.pt")[0])
    result = {"options": {"policy": digest}, "mean": {"realism": 0.5}, "scenes": ["a", "b"]}
    (tmp_path / "result.json").write_text(json.dumps(result))
    place = command.add("new", trained, {"roads": tmp_path / "result.json"}, tmp_path / "zoo")
    card = zoo.card("new", tmp_path / "zoo")
    assert zoo.find("new", tmp_path / "zoo") == place / "policy.pt"
    assert card["measures"]["roads"] == {"mean": {"realism": 0.5}, "scenes": 2, "options": {"policy": digest}}
    assert card["hours"] >= 0 and card["options"]["pretraining"]["steps"] == 6
    assert "pretrain" in card["made_by"]["command"]


def test_an_evaluation_of_another_policy_is_refused(trained: Path, tmp_path: Path) -> None:
    result = {"options": {"policy": "0123"}, "mean": {}, "scenes": []}
    (tmp_path / "result.json").write_text(json.dumps(result))
    with pytest.raises(ValueError, match=r"result.json is of the policy 0123 and this one is"):
        command.add("new", trained, {"roads": tmp_path / "result.json"}, tmp_path / "zoo")
    assert not (tmp_path / "zoo").exists(), "nothing half-made is left"


@pytest.mark.parametrize(
    "made", [{"source": "womd"}, {"source": "sumo", "start": {"source": "gpudrive", "start": None}}, {"source": None}]
)
def test_what_has_seen_scenes_with_a_licence_is_not_given_away(
    trained: Path, tmp_path: Path, made: dict[str, object]
) -> None:
    marked(trained, **made)
    with pytest.raises(ValueError, match=r"learnt from scenes of the source (womd|gpudrive|None)"):
        command.add("new", trained, {}, tmp_path / "zoo")


@pytest.mark.parametrize("name", ["", "..", ".", "../up", ".hidden", "A", "a b"])
def test_a_name_that_is_no_folder_is_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="small letters and digits"):
        command.add(name, tmp_path, {}, tmp_path / "zoo")


def test_a_policy_that_is_there_is_not_replaced(trained: Path, shelf: Path) -> None:
    before = zoo.card("mine", shelf)
    with pytest.raises(ValueError, match="has a policy 'mine' already; give another name, or remove .*mine first"):
        command.add("mine", trained, {}, shelf)
    assert zoo.card("mine", shelf) == before


def test_an_aligned_policy_is_refused_for_what_it_is(trained: Path, tmp_path: Path) -> None:
    marked(trained, method="dpa_omf")
    with pytest.raises(ValueError, match="was aligned by dpa_omf; the zoo takes policies of recipes.pretrain alone"):
        command.add("new", trained, {}, tmp_path / "zoo")


def test_a_training_without_a_policy_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="holds no policy.pt; run recipes.pretrain to its end"):
        command.add("new", tmp_path, {}, tmp_path / "zoo")


def test_weights_of_the_zoo_are_read_without_unpickling() -> None:
    payload = torch.load(zoo.find("motionlm-nano-sumo"), weights_only=True)
    assert payload["policy"]


if __name__ == "__main__":
    pytest.main([__file__])
