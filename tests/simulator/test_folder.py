"""Results are written whole or not at all."""

from __future__ import annotations

import errno
from pathlib import Path

import pytest

from common.errors import FileFormatError
from simulator.folder import write_whole


@pytest.mark.parametrize("content", ["heights of 3 \N{MULTIPLICATION SIGN} 4\n", b"\x00\xff"])
def test_a_file_holds_what_was_given(tmp_path: Path, content: str | bytes) -> None:
    path = write_whole(tmp_path / "table.csv", content)
    assert path.read_bytes() == (content.encode() if isinstance(content, str) else content)
    assert [each.name for each in tmp_path.iterdir()] == ["table.csv"]


def test_a_full_disk_is_one_clear_error_and_leaves_what_was_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_whole(tmp_path / "table.csv", "old")
    write = Path.write_bytes

    def fill_up(unfinished: Path, data: bytes) -> int:
        write(unfinished, data[:3])
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", fill_up)
    with pytest.raises(FileFormatError, match=r"table.csv: No space left on device"):
        write_whole(path, "new and longer")
    assert path.read_text() == "old"
    assert [each.name for each in tmp_path.iterdir()] == ["table.csv"]


def test_a_folder_in_the_place_is_one_clear_error(tmp_path: Path) -> None:
    (tmp_path / "table.csv").mkdir()
    with pytest.raises(FileFormatError, match="cannot write"):
        write_whole(tmp_path / "table.csv", "new")
    assert [each.name for each in tmp_path.iterdir()] == ["table.csv"]
