"""Where results are written."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from common.errors import FileFormatError, ParameterError


def make_folder(path: Path) -> None:
    """Make the folder `path` where it is missing; raises ParameterError where that cannot be."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ParameterError(f"cannot write to {path}: {error.strerror}") from error


def write_whole(path: Path, content: str | bytes) -> Path:
    """Write a file whole or not at all, and give its path; raises FileFormatError where that cannot be.

    What stood there before stays until all of it is written.
    """
    unfinished = path.with_name(f".{path.name}.part")
    try:
        unfinished.write_bytes(content.encode() if isinstance(content, str) else content)
        unfinished.replace(path)
    except OSError as error:
        with suppress(OSError):
            unfinished.unlink()
        raise FileFormatError(f"cannot write {path}: {error.strerror or error}") from error
    return path
