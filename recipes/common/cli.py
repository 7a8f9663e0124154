"""What every recipe's ``main`` shares: options from YAML, and one clear error instead of a traceback."""

from __future__ import annotations

import functools
import json
import os
import re
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from inspect import Parameter
from pathlib import Path
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, MissingMandatoryValue, OmegaConfBaseException

from dpa.training.distributed import started_ranks
from dpa.training.loggers import check_backend
from envs.allocator import keep_freed_memory
from envs.files import check_file
from envs.options import differences
from recipes.common.kinds import check_kinds, taken_by
from recipes.common.limits import check_added, check_limits

CONFIG = {"version_base": "1.3", "config_path": str(Path(__file__).parents[1] / "config")}
"""Arguments of ``hydra.main`` that all recipes share; with an absolute path, ``main`` may also be imported."""
REFUSED_STATUS, INTERRUPTED_STATUS = 2, 130
GRACE_SECONDS = 10.0
"""Given to rank 0 to refuse what all ranks refuse alike: torchrun then ends the others, and one error is told."""
USER_ERRORS = (ValueError, OSError, ImportError, FloatingPointError, HydraException, OmegaConfBaseException)


def recipe(main: Callable[[DictConfig], None]) -> Callable[[DictConfig], None]:
    """Run a recipe of one process; what a user can mend ends in one line on stderr and exit status 2."""

    @functools.wraps(main)
    def alone(cfg: DictConfig) -> None:
        ranks = started_ranks()
        if not ranks.alone:
            name = f"recipes.{Path(sys.argv[0]).stem}"
            raise ValueError(
                f"{name} runs in one process and torchrun has started {ranks.world_size}; start it with python -m "
                f"{name}. Training is what torchrun is for: recipes.pretrain and recipes.align."
            )
        main(cfg)

    return ranked_recipe(alone)


def study_recipe(main: Callable[[DictConfig], None]) -> Callable[[DictConfig], None]:
    """Like :func:`recipe`, for one that logs into ``output`` what it has found: not over the curves of a training."""

    @functools.wraps(main)
    def beside(cfg: DictConfig) -> None:
        check_output(cfg)
        main(cfg)

    return recipe(beside)


def ranked_recipe(main: Callable[[DictConfig], None]) -> Callable[[DictConfig], None]:
    """Like :func:`recipe`, for one process or for several that ``torchrun`` has started."""

    @functools.wraps(main)
    def run(cfg: DictConfig) -> None:
        warnings.filterwarnings("ignore", category=DeprecationWarning, module="torchrl")
        try:
            check_added(HydraConfig.get().overrides.task if HydraConfig.initialized() else (), cfg)
            check_limits(cfg)
            check_resources(cfg)
            main(cfg)
        except MissingMandatoryValue as error:
            sys.exit(refused(f"{error.full_key} is not given; say {error.full_key}=VALUE (--help says more)."))
        except (ConfigAttributeError, ConfigKeyError) as error:
            base = (
                " (that of a model begins with `defaults: [base]`)" if str(error.full_key).startswith("model") else ""
            )
            sys.exit(refused(f"there is no {error.full_key}: the YAML that should give it does not{base}."))
        except USER_ERRORS as error:
            sys.exit(refused(error))
        except KeyboardInterrupt:
            sys.exit(interrupted())
        except RuntimeError as error:
            # tensordict hides an interrupt that comes while it has swapped a module's parameters.
            if not isinstance(error.__context__, KeyboardInterrupt):
                raise
            sys.exit(interrupted())

    return run


def refused(error: object) -> int:
    """Say what a user can mend; returns the exit status. A rank that is refused alone says which it is."""
    if rank := int(os.environ.get("RANK", "0")):
        time.sleep(GRACE_SECONDS)
        error = f"rank {rank}: {error}"
    print(f"error: {error}", file=sys.stderr)
    return REFUSED_STATUS


def interrupted() -> int:
    """Say how to go on after Ctrl-C; returns the exit status that shells expect."""
    if os.environ.get("RANK", "0") == "0":
        print("interrupted; run the same command again to go on", file=sys.stderr)
    return INTERRUPTED_STATUS


def check_resources(cfg: DictConfig) -> None:
    """Set torch's threads and the allocator, and refuse what is not there or in the way, before any work.

    Raises:
        ValueError: no such device or logger, or a result that cannot be written because a folder has its name.
        ImportError: the logger's package is missing.
    """
    if "logger" in cfg:
        check_backend(cfg.logger.backend)
    check_file(cfg.get("json"), "json=")
    check_device(cfg.device)
    torch.set_num_threads(cfg.threads)
    keep_freed_memory()


def check_device(device: Any) -> None:
    """Refuse a device that is not there.

    Raises:
        ValueError: it is not.
    """
    if not re.fullmatch(r"cpu|cuda(:\d+)?", str(device)):
        raise ValueError(f"device must be cpu, cuda or cuda:N, got {device!r}.")
    if torch.device(device).type == "cuda" and not torch.cuda.is_available():
        raise ValueError(f"device={device}: torch {torch.__version__} finds no GPU here; say device=cpu.")
    if (index := torch.device(device).index) is not None and index >= torch.cuda.device_count():
        raise ValueError(f"device={device}: there are {torch.cuda.device_count()} GPUs, counted from 0.")


def check_output(cfg: DictConfig) -> None:
    """Refuse to write into the folder of a training, whose curves and options would be lost.

    Raises:
        ValueError: ``output`` is one.
    """
    output = cfg.get("output")
    if output is not None and any(Path(output, name).exists() for name in ("policy.pt", "checkpoints")):
        raise ValueError(f"output={output} holds a training, whose curves would be lost; name another folder.")


def check_steps(section: DictConfig, name: str) -> None:
    """Refuse a warm-up that does not end within the steps, before any work.

    Raises:
        ValueError: both are named.
    """
    if section.warmup >= section.steps:
        raise ValueError(
            f"{name}.warmup must be less than {name}.steps, got {section.warmup} and {section.steps}; say for example "
            f"{name}.warmup={section.steps // 10}."
        )


def plain(section: DictConfig) -> dict[str, Any]:
    """A section of the configuration as plain dicts and lists, interpolations resolved."""
    return OmegaConf.to_container(section, resolve=True, throw_on_missing=True)


@contextmanager
def told_of(name: str) -> Iterator[None]:
    """Errors inside the block say whom they are about.

    Examples:
        >>> with told_of("methods.ipo"):
        ...     raise ValueError("alpha must be positive, got 0.")
        Traceback (most recent call last):
        ...
        ValueError: methods.ipo: alpha must be positive, got 0.
    """
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error


def deciding(section: DictConfig, *without: str) -> dict[str, Any]:
    """A section without the options that change how a result is made and not the result."""
    return {key: value for key, value in plain(section).items() if key not in without}


def build(target: Callable[..., Any], section: DictConfig, name: str, *args: Any, **fixed: Any) -> Any:
    """Call ``target`` with a section of the configuration as keyword arguments.

    Raises:
        ValueError: a key that the target does not take, one that it lacks, or a value of another kind than it says; the
            message names both.
    """
    options, takes = plain(section), taken_by(target)
    known = [
        p.name for p in takes.parameters.values() if p.kind in (Parameter.POSITIONAL_OR_KEYWORD, Parameter.KEYWORD_ONLY)
    ]
    unknown = sorted(set(options) - set(known))
    if unknown:
        raise ValueError(f"{name} has no option {unknown[0]!r}; it takes {', '.join(known)}.")
    try:
        takes.bind(*args, **options, **fixed)
    except TypeError as error:
        raise ValueError(f"{name} {error}.") from None
    check_kinds(target, options, name.partition(" (")[0])
    with told_of(name):
        return target(*args, **options, **fixed)


def finite(value: float) -> float | None:
    """The value, or ``None`` in place of a NaN, as JSON can hold it."""
    return value if value == value else None


def mean_known(values: list[float | None]) -> float | None:
    """Mean of the values that are known; None where none is."""
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None


def finished(path: Path, decided_by: dict[str, Any]) -> dict[str, Any] | None:
    """The content of a result that an earlier run with the same options wrote, or ``None``.

    Args:
        path: JSON with an entry ``"options"``.
        decided_by: the options of this run.

    Raises:
        ValueError: the result is of other options, or the file is none.
    """
    if not path.is_file():
        return None
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        options = content["options"]
    except (ValueError, LookupError, TypeError) as error:
        raise ValueError(f"{path} is no result of this recipe ({error}); remove it, or name another file.") from None
    differ = differences(options, decided_by)
    if differ:
        raise ValueError(
            f"{path} was written with other options ({differ}); name another file or folder, or remove it."
        )
    return content
