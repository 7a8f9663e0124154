"""Files of policies, alone and in a zoo with their cards."""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from collections.abc import Iterator
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory
from typing import Any

import torch

from dpa import zoo
from dpa.models.motionlm import MotionLM, MotionLMConfig
from dpa.tokens import VerletTokenizer
from dpa.training.checkpoint import FORMAT, CheckpointError, load_policy, save_policy
from recipes.common.models import open_policy
from tests.fuzz.arrays import NEVER
from tests.fuzz.case import Files, Format, Maker, load_file, on_first
from tests.fuzz.edits import edit_bytes, flip_bits
from tests.fuzz.trees import edit_json

TINY = {"width": 12, "heads": 3, "feed": 8, "encoder_layers": 1, "decoder_layers": 1, "horizon": 16, "dropout": 0.0}
CONFIG = {
    "family": "motionlm",
    "model": TINY,
    "context": {"max_pieces": 16},
    "tokenizer": {"name": "verlet"},
    "episode": {"horizon": 16, "decision_steps": 5},
}


def policy() -> bytes:
    torch.manual_seed(0)
    model = MotionLM(MotionLMConfig(**TINY), VerletTokenizer())
    with TemporaryDirectory() as folder:
        path = save_policy(Path(folder, "policy.pt"), model.state_dict(), CONFIG, {"seed": 0})
        return repacked(path.read_bytes())


def repacked(data: bytes, **content: bytes) -> bytes:
    """The archive of a policy without the time of day; ``content`` replaces what ends so."""
    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(out, "w") as new:
        for name in old.namelist():
            end = name.rpartition("/")[2].replace(".", "_")
            new.writestr(zipfile.ZipInfo(name, NEVER), content.get(end, old.read(name)))
    return out.getvalue()


def policies() -> list[Files]:
    return [{"policy.pt": policy()}]


def shelf() -> list[Files]:
    return [shelved(policy())]


def shelved(weights: bytes) -> Files:
    """A policy beside its card, which fits."""
    card = {"sha256": hashlib.sha256(weights).hexdigest(), "parameters": 1, "measures": {}}
    return {"policy.pt": weights, "card.json": json.dumps(card).encode()}


def read_policy(path: Path) -> Iterator[Maker]:
    yield lambda: open_policy(path)[0]


def read_shelf(path: Path) -> Iterator[Maker]:
    yield lambda: load_policy(zoo.find(path.parent.name, path.parent.parent))


def sound(model: Any) -> None:
    assert model is not None


def edit_payload(files: Files, r: Random) -> Files:
    """Other plain values, missing ones or other weights, in a whole file."""
    first = next(iter(files))
    try:
        with TemporaryDirectory() as folder:
            path = Path(folder, "policy.pt")
            path.write_bytes(files[first])
            weights, config, metadata = load_policy(path)
            payload = {"format": FORMAT, "kind": "policy", "config": config, "versions": {}, "policy": weights,
                       "metadata": metadata}  # fmt: skip
            _change(payload, r)
            torch.save(payload, path)
            return files | {first: repacked(path.read_bytes())}
    except (CheckpointError, ValueError, zipfile.BadZipFile):
        return files


def _change(payload: dict[str, Any], r: Random) -> None:
    what = r.randrange(5)
    if what == 0:
        payload.pop(r.choice([*payload]))
    elif what == 1:
        payload[r.choice([*payload])] = r.choice((None, 3, "x", [], {}, torch.zeros(2)))
    elif what == 2 and payload["policy"]:
        name = r.choice([*payload["policy"]])
        payload["policy"][name] = r.choice((torch.zeros(3), torch.full((2, 2), torch.nan), "x", None))
    elif what == 3 and payload["policy"]:
        payload["policy"].pop(r.choice([*payload["policy"]]))
    else:
        section = r.choice([*payload["config"]] or ["model"])
        payload["config"][section] = json.loads(json.dumps(r.choice((None, 1, {}, {"name": "x"}, {"width": -1}, []))))


def edit_card(files: Files, r: Random) -> Files:
    return files | {"card.json": edit_json(files["card.json"], r)} if "card.json" in files else files


def fit_card(files: Files, r: Random) -> Files:
    """A card that fits whatever the weights are."""
    return shelved(files["policy.pt"])


BYTES = {on_first(edit_bytes): 2, on_first(flip_bits): 2}
POLICIES = Format("policies", policies, load_file, {**BYTES, edit_payload: 4}, {}, read_policy, answer=ValueError,
                  check=sound)  # fmt: skip
ZOO = Format("zoo", shelf, load_file, {**BYTES, edit_payload: 1, edit_card: 4, fit_card: 1}, {}, read_shelf,
             also_named=("the zoo has no policy",), answer=ValueError, check=sound)  # fmt: skip
