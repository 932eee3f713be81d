"""What was received and trained, kept on disk: one SQLite file in a folder.

A call returns when the disk has what it was told (``synchronous=FULL``), so nothing that is acknowledged after it can
be lost. Calls block: the service makes them in threads.
"""

from __future__ import annotations

import io
import json
import os
import sqlite3
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from hashlib import sha256
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, Any, Self, TypeAlias
from zipfile import BadZipFile

import numpy as np
import numpy.typing as npt

from common.errors import NotFoundError, StoreError

SCHEMA_VERSION = 2

RESERVE = 4 << 20
"""Bytes held back on the disk for a deletion where it is full: as many as SQLite's log takes before its pages go to
where they belong (1,000 pages of 4 KiB)."""

PROBE = 64 << 10
"""Bytes that must fit on the disk for the store to count as one that can be written."""

STEP = 256
"""Pages given back to the disk at once: their log fits the reserve many times."""

_SCHEMA = """
CREATE TABLE surfaces (
    n        INTEGER PRIMARY KEY AUTOINCREMENT,
    id       TEXT NOT NULL UNIQUE,
    created  TEXT NOT NULL,
    updated  TEXT NOT NULL,
    revision INTEGER NOT NULL,  -- grows with every body that changed what is trained on
    features TEXT,              -- SHA-256 of the points that are here
    settings TEXT NOT NULL,     -- of the network, JSON
    contents TEXT NOT NULL,     -- what has arrived, JSON
    failed   INTEGER,           -- the revision whose training failed
    error    TEXT               -- the problem it failed with, JSON
) STRICT;
CREATE TABLE arrivals (
    k       INTEGER PRIMARY KEY, -- in order of arrival
    surface INTEGER NOT NULL REFERENCES surfaces (n) ON DELETE CASCADE,
    packets BLOB NOT NULL       -- those of one body that were new, end to end
) STRICT;
CREATE INDEX arrivals_of ON arrivals (surface);
CREATE TABLE models (
    surface  INTEGER PRIMARY KEY REFERENCES surfaces (n) ON DELETE CASCADE,
    revision INTEGER NOT NULL,  -- what it was trained on
    digest   TEXT NOT NULL,     -- SHA-256 of state
    summary  TEXT NOT NULL,     -- JSON
    state    BLOB NOT NULL      -- npz without pickle
) STRICT;
"""

_ROW = """
SELECT s.n, s.id, s.created, s.updated, s.revision, s.features, s.settings, s.contents, s.failed, s.error,
       m.revision, m.digest, m.summary
FROM surfaces s LEFT JOIN models m ON m.surface = s.n
"""

State: TypeAlias = dict[str, npt.NDArray[Any]]
"""The arrays of a model, by name."""


@dataclass(frozen=True, slots=True)
class Row:
    """A surface as it is kept.

    Attributes
    ----------
    n : int
        Its number, in order of first arrival; never given twice.
    revision : int
        Grows with every body that changed what is trained on.
    features : str or None
        SHA-256 of the feature points that are here, None while there are none.
    trained, failed : int or None
        The revision that the kept model was trained on; the one whose training failed with `error`.
    """

    n: int
    id: str
    created: str
    updated: str
    revision: int
    features: str | None
    settings: dict[str, Any]
    contents: dict[str, Any]
    failed: int | None
    error: dict[str, Any] | None
    trained: int | None
    digest: str | None
    summary: dict[str, Any] | None

    @classmethod
    def of(cls, values: Sequence[Any]) -> Self:
        """A row of `_ROW`."""
        n, name, created, updated, revision, features, settings, contents, *rest = values
        failed, error, trained, digest, summary = rest
        return cls(
            n=n,
            id=name,
            created=created,
            updated=updated,
            revision=revision,
            features=features,
            settings=json.loads(settings),
            contents=json.loads(contents),
            failed=failed,
            error=json.loads(error) if error else None,
            trained=trained,
            digest=digest,
            summary=json.loads(summary) if summary else None,
        )


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="microseconds")


def pack_state(state: State) -> bytes:
    """Arrays by name as npz bytes, the same bytes for the same arrays; raises StoreError for arrays of objects."""
    buffer = io.BytesIO()
    try:
        np.savez(buffer, allow_pickle=False, **state)
    except ValueError as error:
        raise StoreError(f"a model's state must be plain arrays: {error}") from error
    return buffer.getvalue()


def unpack_state(data: bytes) -> State:
    """The arrays of `pack_state`; raises StoreError where `data` is something else."""
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except (ValueError, OSError, BadZipFile, KeyError, EOFError) as error:
        raise StoreError("a stored model cannot be read") from error


class Store:
    """The file ``receiver.sqlite3`` in `folder`, which is made where it is missing.

    Beside it ``receiver.reserve`` holds room back, for a deletion needs some where the disk is full. Safe to call from
    several threads. One process at a time owns the file.

    Raises
    ------
    StoreError
        If the folder cannot be written, another process owns the file, or it was written by a newer version; from
        every method where the disk fails.
    """

    def __init__(self, folder: Path) -> None:
        self.path = folder / "receiver.sqlite3"
        self._reserve = folder / "receiver.reserve"
        self._lock = threading.Lock()
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise StoreError(f"the data folder {folder} cannot be made: {error.strerror}") from error
        try:
            self._db = sqlite3.connect(self.path, timeout=1.0, isolation_level=None, check_same_thread=False)
        except sqlite3.Error as error:
            raise StoreError(f"the data folder {folder} cannot be used: {error}") from error
        try:
            self._prepare()
        except sqlite3.Error as error:
            self._db.close()
            if "locked" in str(error):
                raise StoreError(f"the data folder {folder} is in use by another receiver") from error
            raise StoreError(f"{self.path} cannot be used: {error}") from error
        except StoreError:
            self._db.close()
            raise
        self._hold_reserve()

    def _prepare(self) -> None:
        if self._db.execute("PRAGMA page_count").fetchone() == (0,):
            # In an older file, room that a deletion gives is used again and not given back.
            self._db.execute("PRAGMA auto_vacuum = INCREMENTAL")
        # Else a deletion overwrites what it removes, and needs as much room as it frees.
        self._db.execute("PRAGMA secure_delete = OFF")
        # The caches of a receiver hold only while no other process writes.
        self._db.execute("PRAGMA locking_mode = EXCLUSIVE")
        self._db.execute("PRAGMA journal_mode = WAL")
        self._db.execute("PRAGMA synchronous = FULL")
        # On macOS a sync alone leaves what was written in the disk's own cache.
        self._db.execute("PRAGMA fullfsync = ON")
        self._db.execute("PRAGMA foreign_keys = ON")
        self._db.execute("BEGIN EXCLUSIVE")
        (version,) = self._db.execute("PRAGMA user_version").fetchone()
        if version == 0:
            for statement in _SCHEMA.split(";"):
                self._db.execute(statement)
        elif version == 1:
            # It kept the number of each missing packet, as many as a packet claimed.
            self._db.execute("UPDATE surfaces SET contents = json_remove(contents, '$.packets.missing')")
        elif version != SCHEMA_VERSION:
            raise StoreError(
                f"{self.path} has schema version {version}, this receiver knows {SCHEMA_VERSION}; "
                "start a newer receiver, or choose another folder"
            )
        if version != SCHEMA_VERSION:  # a disk that is full must not keep the receiver from starting
            self._db.execute(f"PRAGMA user_version = {SCHEMA_VERSION}")
        self._db.execute("COMMIT")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def close(self) -> None:
        """Release the file."""
        with self._lock:
            self._db.close()

    @contextmanager
    def _transaction(self) -> Iterator[sqlite3.Connection]:
        with self._lock:
            try:
                self._db.execute("BEGIN IMMEDIATE")
                try:
                    yield self._db
                    self._db.execute("COMMIT")
                except BaseException:
                    # A disk that is full or fails has SQLite roll back by itself.
                    if self._db.in_transaction:
                        self._db.execute("ROLLBACK")
                    raise
            except sqlite3.Error as error:
                raise StoreError(f"the store failed: {error}") from error

    def _fetch(self, sql: str, values: Sequence[Any] = ()) -> list[Any]:
        with self._lock:
            try:
                return self._db.execute(sql, values).fetchall()
            except sqlite3.Error as error:
                raise StoreError(f"the store failed: {error}") from error

    def receive(
        self,
        name: str,
        packets: bytes,
        *,
        features: str | None,
        settings: dict[str, Any],
        contents: dict[str, Any],
        renew: bool,
    ) -> Row:
        """Keep new packets of the surface `name` and what is known of it by now; `renew` starts a new revision."""
        now = _now()
        with self._transaction() as db:
            db.execute(
                "INSERT INTO surfaces (id, created, updated, revision, features, settings, contents)"
                " VALUES (?, ?, ?, ?, ?, ?, ?)"
                " ON CONFLICT (id) DO UPDATE SET updated = MAX(updated, excluded.updated),"
                " revision = revision + excluded.revision, features = excluded.features,"
                " settings = excluded.settings, contents = excluded.contents",
                (name, now, now, int(renew), features, json.dumps(settings), json.dumps(contents)),
            )
            row = Row.of(db.execute(_ROW + "WHERE s.id = ?", (name,)).fetchone())
            if packets:
                db.execute("INSERT INTO arrivals (surface, packets) VALUES (?, ?)", (row.n, packets))
            return row

    def find(self, name: str) -> Row | None:
        """The surface `name`, None where there is none."""
        rows = self._fetch(_ROW + "WHERE s.id = ?", (name,))
        return Row.of(rows[0]) if rows else None

    def get(self, name: str) -> Row:
        """The surface `name`; raises NotFoundError where there is none."""
        row = self.find(name)
        if row is None:
            raise NotFoundError(f"there is no surface {name!r}; GET /v1/surfaces lists them")
        return row

    def latest(self, *, before: int | None = None, limit: int) -> list[Row]:
        """At most `limit` surfaces, the latest first, from those older than number `before`."""
        where = "" if before is None else "WHERE s.n < ?"
        values = (limit,) if before is None else (before, limit)
        return [Row.of(row) for row in self._fetch(f"{_ROW} {where} ORDER BY s.n DESC LIMIT ?", values)]

    def untrained(self) -> list[Row]:
        """Surfaces whose latest revision is neither trained nor failed, the oldest first."""
        return [
            Row.of(row)
            for row in self._fetch(
                f"{_ROW} WHERE s.revision > 0 AND s.revision IS NOT m.revision AND s.revision IS NOT s.failed"
                " ORDER BY s.n"
            )
        ]

    def count(self) -> int:
        """How many surfaces there are."""
        ((n,),) = self._fetch("SELECT COUNT(*) FROM surfaces")
        return int(n)

    def arrivals(self, n: int) -> list[bytes]:
        """What arrived of surface number `n`, a run of packets each, in order of arrival."""
        return [data for (data,) in self._fetch("SELECT packets FROM arrivals WHERE surface = ? ORDER BY k", (n,))]

    def trained(self, n: int, revision: int, *, state: State, summary: dict[str, Any]) -> str:
        """Keep the model that was trained on `revision` of surface number `n`; nothing if that is deleted or has
        a later revision by now. The digest of the model is returned."""
        data = pack_state(state)
        digest = sha256(data).hexdigest()
        with self._transaction() as db:
            db.execute(
                "INSERT OR REPLACE INTO models SELECT n, revision, ?, ?, ? FROM surfaces WHERE n = ? AND revision = ?",
                (digest, json.dumps(summary), data, n, revision),
            )
            db.execute(
                "UPDATE surfaces SET updated = MAX(updated, ?) WHERE n = ? AND revision = ?", (_now(), n, revision)
            )
        return digest

    def failed(self, n: int, revision: int, error: dict[str, Any]) -> None:
        """Keep that training on `revision` of surface number `n` failed; nothing if that has a later one by now."""
        with self._transaction() as db:
            db.execute(
                "UPDATE surfaces SET failed = revision, error = ?, updated = MAX(updated, ?)"
                " WHERE n = ? AND revision = ?",
                (json.dumps(error), _now(), n, revision),
            )

    def model(self, n: int, digest: str) -> State | None:
        """The state of the model `digest` of surface number `n`, None where it is another one or none by now; raises
        StoreError where it was harmed on disk."""
        rows = self._fetch("SELECT state FROM models WHERE surface = ? AND digest = ?", (n, digest))
        if not rows:
            return None
        (data,) = rows[0]
        if sha256(data).hexdigest() != digest:
            raise StoreError("a stored model was harmed")
        return unpack_state(data)

    def forget_model(self, n: int, digest: str) -> None:
        """Drop the model `digest` of surface number `n`, so that it counts as untrained; no other one."""
        with self._transaction() as db:
            db.execute("DELETE FROM models WHERE surface = ? AND digest = ?", (n, digest))

    def delete(self, name: str) -> Row:
        """Remove a surface and all that belongs to it; raises NotFoundError where there is none.

        What it frees is given back to the disk; on a full one, what is held back is spent on it.
        """
        row = self.get(name)
        try:
            self._delete(row.n)
        except StoreError:
            with suppress(OSError):
                self._reserve.unlink(missing_ok=True)
            self._delete(row.n)
        finally:
            self._give_back()
            self._hold_reserve()
        return row

    def _delete(self, n: int) -> None:
        with self._transaction() as db:
            db.execute("DELETE FROM surfaces WHERE n = ?", (n,))

    def _give_back(self) -> None:
        """Shorten the files by the pages that are free, as far as there is room to move others in their place."""
        with suppress(StoreError):
            free, before = self._free_pages(), None
            while free != before:
                self._fetch(f"PRAGMA incremental_vacuum({STEP})")
                self._fetch("PRAGMA wal_checkpoint(TRUNCATE)")
                free, before = self._free_pages(), free

    def _free_pages(self) -> int:
        ((pages,),) = self._fetch("PRAGMA freelist_count")
        return int(pages)

    def _hold_reserve(self) -> None:
        """Hold room back, unless that is done or there is none."""
        try:
            if not self._reserve.exists() or self._reserve.stat().st_size != RESERVE:
                with self._reserve.open("wb") as file:
                    _write(file, RESERVE)
        except OSError:
            with suppress(OSError):
                self._reserve.unlink(missing_ok=True)

    def ping(self) -> None:
        """Raise StoreError unless the store takes a small write, and the disk has room for more."""
        with self._transaction() as db:
            db.execute(f"PRAGMA user_version = {SCHEMA_VERSION}")
        try:
            with TemporaryFile(dir=self.path.parent) as probe:
                _write(probe, PROBE)
        except OSError as error:
            raise StoreError(f"the data folder cannot be written: {error.strerror or error}") from error


def _write(file: IO[bytes], length: int) -> None:
    """Write and sync `length` bytes that take as much room where the disk compresses; raises OSError."""
    file.write(np.random.default_rng(0).bytes(length))
    file.flush()
    os.fsync(file.fileno())
