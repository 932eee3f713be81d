"""Where results are written."""

from __future__ import annotations

from pathlib import Path

from common.errors import ParameterError


def make_folder(path: Path) -> None:
    """Make the folder `path` where it is missing; raises ParameterError where that cannot be."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ParameterError(f"cannot write to {path}: {error.strerror}") from error
