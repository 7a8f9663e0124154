"""What holds for every file of the repository, whoever wrote it."""

from __future__ import annotations

import ast
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from collections.abc import Iterator
from importlib.metadata import packages_distributions
from itertools import chain
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]
PACKAGES = ("envs", "dpa", "recipes")
MAX_LINES = 400
"""A module longer than this holds more than one idea."""
# Put together here, so that this file does not name what it looks for.
REGISTRIES = [".".join(parts) for parts in [
    ("pypi", "org"), ("pythonhosted", "org"), ("download", "pytorch", "org"), ("anaconda", "com"), ("anaconda", "org"),
    ("npmjs", "org"), ("npmjs", "com"), ("unpkg", "com"), ("jsdelivr", "net"), ("crates", "io"),
]]  # fmt: skip
MACHINE_PATH = re.compile(
    r"(?<![\w.*~])/(?:" + "|".join(["data", "home", "mnt", "opt", "root", "tmp", "Users", "work"]) + r")(?![\w-])"
)


def repository_files() -> list[Path]:
    """Files that git tracks or would track."""
    if not (REPOSITORY / ".git").exists() or shutil.which("git") is None:
        pytest.skip("needs git and a checkout")
    listing = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard", "-z"],
        cwd=REPOSITORY, capture_output=True, text=True,
    )  # fmt: skip
    assert listing.returncode == 0, listing.stderr
    paths = [REPOSITORY / name for name in listing.stdout.split("\0") if name]
    assert Path(__file__).resolve() in paths, "git lists the files of this checkout"
    return [path for path in paths if path.is_file()]


def texts() -> Iterator[tuple[str, str]]:
    """Name and text of every file that is text."""
    for path in repository_files():
        content = path.read_bytes()
        if b"\0" not in content:
            yield str(path.relative_to(REPOSITORY)), content.decode()


def archived() -> Iterator[tuple[str, str]]:
    """Name and text of every file in an archive."""
    for path in repository_files():
        if path.suffix == ".zip":
            with zipfile.ZipFile(path) as archive:
                for name in archive.namelist():
                    yield f"{path.relative_to(REPOSITORY)}/{name}", archive.read(name).decode()


def modules() -> Iterator[tuple[str, str, ast.Module]]:
    """Name, text and syntax tree of every Python file."""
    for name, text in texts():
        if name.endswith(".py"):
            yield name, text, ast.parse(text)


def test_no_file_names_a_package_registry() -> None:
    found = [f"{name}: {host}" for name, text in chain(texts(), archived()) for host in REGISTRIES if host in text]
    assert not found


def test_no_file_names_a_path_of_one_machine() -> None:
    everywhere = chain(texts(), archived())
    found = [f"{name}: {match[0]}" for name, text in everywhere for match in MACHINE_PATH.finditer(text)]
    assert not found


def test_every_recipe_configuration_begins_with_the_command_that_runs_it() -> None:
    without = []
    for name, text in texts():
        if name.startswith("recipes/") and name.endswith((".yaml", ".yml")):
            lines = text.splitlines()
            header = "\n".join(lines[: next((i for i, line in enumerate(lines) if line[:1] != "#"), len(lines))])
            if not re.search(r"python -m recipes\.\w+|make \w+", header):
                without.append(name)
    assert not without, "begin each file with a comment: # python -m recipes.<name> --config-name <file>"


def unsafe_call(call: ast.Call) -> str | None:
    """Name the call if it can run code out of a file."""
    name = ast.unparse(call.func)
    options = {keyword.arg: ast.unparse(keyword.value) for keyword in call.keywords}
    if name == "torch.load" and options.get("weights_only") != "True":
        return "torch.load without weights_only=True"
    if name.endswith((".load", ".load_npz")) and options.get("allow_pickle") == "True":
        return f"{name} with allow_pickle=True"
    if name in ("yaml.load", "yaml.unsafe_load", "yaml.full_load", "pd.read_pickle", "pandas.read_pickle"):
        return name
    return None


def test_nothing_is_unpickled() -> None:
    found = []
    for name, _, tree in modules():
        for node in ast.walk(tree):
            imported = []
            if isinstance(node, ast.Import):
                imported = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                imported = [node.module or ""]
            found += [f"{name}: import {m}" for m in imported if m in ("pickle", "cloudpickle", "dill", "joblib")]
            if isinstance(node, ast.Call) and (what := unsafe_call(node)):
                found.append(f"{name}:{node.lineno}: {what}")
    assert not found


@pytest.mark.parametrize(
    ("code", "unsafe"),
    [
        ("torch.load(path)", True),
        ("torch.load(path, weights_only=False)", True),
        ("torch.load(path, weights_only=True)", False),
        ("np.load(path, allow_pickle=True)", True),
        ("np.load(path)", False),
        ("yaml.safe_load(text)", False),
    ],
)
def test_the_search_for_unsafe_calls_finds_them(code: str, unsafe: bool) -> None:
    assert (unsafe_call(ast.parse(code, mode="eval").body) is not None) == unsafe


def test_units_in_brackets_are_printed_and_not_taken_for_markup() -> None:
    consoles = [
        f"{name}: {call}"
        for name, text, _ in modules()
        for call in re.findall(r"\bConsole\([^)]*\)", text)
        if name.startswith(PACKAGES)
    ]
    assert consoles and not [call for call in consoles if "markup=False" not in call], "rich would swallow [m]"


def test_every_module_says_what_it_is() -> None:
    assert not [name for name, text, tree in modules() if text.strip() and not ast.get_docstring(tree)]


def test_no_module_is_longer_than_one_idea() -> None:
    lengths = {name: len(text.splitlines()) for name, text, _ in modules() if name.startswith(PACKAGES)}
    assert not {name: lines for name, lines in lengths.items() if lines > MAX_LINES}


def project() -> dict:
    return tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]


def distribution(requirement: str) -> str:
    """``Some_Name>=1`` -> ``some-name``."""
    return re.sub(r"[-_.]+", "-", re.match(r"[\w.-]+", requirement)[0]).lower()


def test_every_tested_dependency_is_pinned() -> None:
    lines = (REPOSITORY / "constraints.txt").read_text().splitlines()
    pins = {distribution(line) for line in lines if re.fullmatch(r"[\w.-]+==[\w.]+", line)}
    extras = project()["optional-dependencies"]
    needed = [*project()["dependencies"], *extras["sumo"], *extras["dev"]]
    assert {distribution(requirement) for requirement in needed} <= pins
    assert all(line.startswith("#") or distribution(line) in pins for line in lines), "every line is one exact pin"


def test_every_imported_package_is_a_declared_dependency() -> None:
    """At the top of a module only what is always installed; an extra's package is imported where it is used."""
    always = {distribution(requirement) for requirement in project()["dependencies"]}
    extras = {distribution(r) for name, rs in project()["optional-dependencies"].items() if name != "dev" for r in rs}
    provided = packages_distributions()
    missing = []
    for name, _, tree in modules():
        if not name.startswith(PACKAGES):
            continue
        top_level = set(map(id, tree.body))
        for node in ast.walk(tree):
            if isinstance(node, ast.Import):
                roots = {alias.name.split(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.level == 0:
                roots = {node.module.split(".")[0]}
            else:
                continue
            allowed = always if id(node) in top_level else always | extras
            for root in roots - set(sys.stdlib_module_names) - set(PACKAGES):
                if not {distribution(d) for d in provided.get(root, [root])} & allowed:
                    missing.append(f"{name}:{node.lineno}: {root}")
    assert not missing


if __name__ == "__main__":
    pytest.main([__file__])
