from __future__ import annotations

import errno
import os
import sqlite3
import threading
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np
import pytest

from common.errors import NotFoundError, StoreError
from receiver.store import RESERVE, SCHEMA_VERSION, Row, Store, pack_state, unpack_state

STATE = {"centers": np.arange(6.0).reshape(3, 2), "name": np.array(["a", "b"])}


def take(store: Store, name: str = "hills", packets: bytes = b"one", renew: bool = True, **options: Any) -> Row:
    settings, contents = options.get("settings", {"spread": 0.3}), options.get("contents", {"points": 3})
    return store.receive(name, packets, features="digest", settings=settings, contents=contents, renew=renew)


def test_everything_survives_a_reopening(tmp_path: Path) -> None:
    with Store(tmp_path) as store:
        take(store)
        row = take(store, packets=b"two")
        digest = store.trained(row.n, row.revision, state=STATE, summary={"centers": 3})
        take(store, "dales")
        before = store.latest(limit=10)
    with Store(tmp_path) as store:
        assert store.latest(limit=10) == before
        row = store.get("hills")
        assert row.revision == row.trained == 2
        assert row.summary == {"centers": 3}
        assert row.settings == {"spread": 0.3}
        assert store.arrivals(row.n) == [b"one", b"two"]
        assert row.digest == digest
        state = store.model(row.n, digest)
        assert state is not None
        np.testing.assert_array_equal(state["centers"], STATE["centers"])
        assert state["name"].tolist() == ["a", "b"]
        assert [row.id for row in store.untrained()] == ["dales"]


def test_what_was_received_is_on_disk_when_the_call_returns(tmp_path: Path) -> None:
    with Store(tmp_path) as store:
        take(store)
        copy = tmp_path / "copy"
        copy.mkdir()
        for file in tmp_path.glob("receiver.sqlite3*"):
            (copy / file.name).write_bytes(file.read_bytes())
        with Store(copy) as rescued:
            assert rescued.arrivals(rescued.get("hills").n) == [b"one"]


def test_synchronous_is_full(tmp_path: Path) -> None:
    with Store(tmp_path) as store:
        assert store._fetch("PRAGMA synchronous") == [(2,)]
        assert store._fetch("PRAGMA fullfsync") == [(1,)]
        assert store._fetch("PRAGMA journal_mode") == [("wal",)]


def test_a_revision_grows_only_where_it_is_renewed(tmp_path: Path) -> None:
    with Store(tmp_path) as store:
        assert take(store, renew=False).revision == 0
        assert store.untrained() == []
        assert take(store).revision == 1
        assert take(store, renew=False).revision == 1


def test_failures_are_kept_until_the_next_revision(tmp_path: Path) -> None:
    with Store(tmp_path) as store:
        row = take(store)
        store.failed(row.n, row.revision, {"title": "no"})
        assert store.get("hills").error == {"title": "no"}
        assert store.untrained() == []
        take(store)
        assert [row.id for row in store.untrained()] == ["hills"]


def test_updated_never_goes_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with Store(tmp_path) as store:
        before = take(store).updated
        monkeypatch.setattr("receiver.store._now", lambda: "2001-01-01T00:00:00.000000+00:00")
        assert take(store).updated == before
        store.failed(1, 2, {"detail": "no"})
        assert store.get("hills").updated == before
        store.trained(1, 2, state=STATE, summary={})
        assert store.get("hills").updated == before


def test_delete_removes_all_that_belongs_to_it_and_numbers_are_not_given_again(tmp_path: Path) -> None:
    with Store(tmp_path) as store:
        row = take(store)
        digest = store.trained(row.n, row.revision, state=STATE, summary={})
        store.delete("hills")
        assert store.arrivals(row.n) == []
        assert store.model(row.n, digest) is None
        assert store.count() == 0
        # A training that ends after its surface was deleted must not bring anything back.
        store.trained(row.n, row.revision, state=STATE, summary={})
        assert store.model(row.n, digest) is None
        assert take(store).n != row.n
        with pytest.raises(NotFoundError, match="no surface 'dales'"):
            store.delete("dales")


def test_a_failed_write_leaves_nothing_behind(tmp_path: Path) -> None:
    with Store(tmp_path) as store:
        take(store)
        with pytest.raises(StoreError, match="plain arrays"):
            store.trained(1, 1, state={"bad": np.array([object()])}, summary={})
        with pytest.raises(StoreError, match="store failed"):
            store.receive("hills", [1], features=None, settings={}, contents={}, renew=True)  # type: ignore[arg-type]
        assert store.get("hills").revision == 1
        assert take(store).revision == 2


def test_a_full_disk_is_named_and_what_fits_later_is_kept(tmp_path: Path) -> None:
    with Store(tmp_path) as store:
        take(store)
        ((pages,),) = store._fetch("PRAGMA page_count")
        store._fetch(f"PRAGMA max_page_count = {pages + 1}")
        with pytest.raises(StoreError, match="full"):
            take(store, packets=bytes(100_000))
        store._fetch("PRAGMA max_page_count = 1000000")
        assert take(store, packets=b"two").revision == 2
        assert store.arrivals(1) == [b"one", b"two"]


def test_a_deletion_finds_room_on_a_full_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    reserve, transaction = tmp_path / "receiver.reserve", Store._transaction

    @contextmanager
    def full(store: Store) -> Iterator[sqlite3.Connection]:
        with transaction(store) as db:
            yield db
            if reserve.exists():
                raise sqlite3.OperationalError("database or disk is full")

    with Store(tmp_path) as store:
        take(store)
        assert reserve.stat().st_size == RESERVE
        monkeypatch.setattr(Store, "_transaction", full)
        with pytest.raises(StoreError, match="full"):
            take(store, "dales")
        with pytest.raises(StoreError, match="full"):
            store.ping()
        store.delete("hills")
        assert store.count() == 0
        assert reserve.stat().st_size == RESERVE


@pytest.mark.parametrize("left", [None, b"", b"a part"])
def test_room_is_held_back_whole_whatever_an_earlier_run_left(tmp_path: Path, left: bytes | None) -> None:
    reserve = tmp_path / "receiver.reserve"
    if left is not None:
        reserve.write_bytes(left)
    Store(tmp_path).close()
    # A file of zeros takes no room on ZFS or a compressed Btrfs.
    assert len(zlib.compress(reserve.read_bytes(), 1)) >= RESERVE


def test_what_a_deletion_frees_is_given_back_to_the_disk(tmp_path: Path) -> None:
    with Store(tmp_path) as store:
        take(store, "first", packets=bytes(2_000_000))
        take(store, "second", packets=bytes(2_000_000))
        store.delete("first")
        assert sum(file.stat().st_size for file in tmp_path.glob("receiver.sqlite3*")) < 2_200_000
        assert store.arrivals(store.get("second").n) == [bytes(2_000_000)]


def test_a_ping_writes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(file: IO[bytes], length: int) -> None:
        file.write(b"a part")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with Store(tmp_path) as store:
        store.ping()
        before = sorted(tmp_path.iterdir())
        with monkeypatch.context() as patched:
            patched.setattr("receiver.store._write", full)
            with pytest.raises(StoreError, match="cannot be written: No space left on device"):
                store.ping()
        assert sorted(tmp_path.iterdir()) == before
        store._fetch("PRAGMA query_only = ON")
        with pytest.raises(StoreError, match="readonly"):
            store.ping()


def test_a_full_disk_keeps_no_receiver_from_starting(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(file: IO[bytes], length: int) -> None:
        file.write(b"a part")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("receiver.store._write", full)
    with Store(tmp_path) as store:
        take(store)
    before = (tmp_path / "receiver.sqlite3").read_bytes()
    with Store(tmp_path) as store:
        assert store.count() == 1
        assert sum(file.stat().st_size for file in tmp_path.glob("receiver.sqlite3-wal")) == 0
    assert (tmp_path / "receiver.sqlite3").read_bytes() == before
    assert not (tmp_path / "receiver.reserve").exists()


def test_a_model_is_asked_for_and_forgotten_by_its_digest(tmp_path: Path) -> None:
    with Store(tmp_path) as store:
        row = take(store)
        old = store.trained(row.n, 1, state=STATE, summary={})
        take(store)
        new = store.trained(row.n, 2, state=STATE | {"name": np.array(["c"])}, summary={})
        store.forget_model(row.n, old)
        assert store.model(row.n, old) is None
        assert store.model(row.n, new) is not None
        store.forget_model(row.n, new)
        assert [row.id for row in store.untrained()] == ["hills"]


def test_what_came_of_an_earlier_revision_does_not_replace_what_came_of_a_later_one(tmp_path: Path) -> None:
    with Store(tmp_path) as store:
        take(store)
        take(store)
        store.trained(1, 2, state=STATE, summary={"revision": 2})
        store.trained(1, 1, state=STATE, summary={"revision": 1})
        assert (store.get("hills").trained, store.get("hills").summary) == (2, {"revision": 2})
        take(store)
        store.failed(1, 3, {"title": "third"})
        store.failed(1, 2, {"title": "second"})
        assert (store.get("hills").failed, store.get("hills").error) == (3, {"title": "third"})


def test_threads_may_share_it(tmp_path: Path) -> None:
    with Store(tmp_path) as store:
        threads = [
            threading.Thread(target=lambda k=k: [take(store, f"s{k}", bytes([k])) for _ in range(10)]) for k in range(8)
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert {row.revision for row in store.latest(limit=100)} == {10}
        assert store.arrivals(store.get("s3").n) == [b"\x03"] * 10


def test_pages(tmp_path: Path) -> None:
    with Store(tmp_path) as store:
        rows = [take(store, name) for name in "abcde"]
        assert [row.id for row in store.latest(limit=2)] == ["e", "d"]
        assert [row.id for row in store.latest(before=rows[2].n, limit=9)] == ["b", "a"]


def test_a_second_receiver_cannot_use_the_same_folder(tmp_path: Path) -> None:
    with Store(tmp_path), pytest.raises(StoreError, match="in use by another receiver"):
        Store(tmp_path)
    Store(tmp_path).close()


def test_a_store_of_the_first_schema_is_taken_over_without_its_lists_of_missing_packets(tmp_path: Path) -> None:
    packets = {"received": 1, "damaged": 0, "duplicate": 0, "total": 9}
    with Store(tmp_path) as store:
        take(store, contents={"points": 3, "packets": packets | {"missing": list(range(1, 9))}})
        store._fetch("PRAGMA user_version = 1")
    for _ in range(2):
        with Store(tmp_path) as store:
            assert store.get("hills").contents == {"points": 3, "packets": packets}
            assert store.arrivals(1) == [b"one"]
            assert store._fetch("PRAGMA user_version") == [(SCHEMA_VERSION,)]


def test_a_newer_schema_is_refused(tmp_path: Path) -> None:
    Store(tmp_path).close()
    db = sqlite3.connect(tmp_path / "receiver.sqlite3")
    db.execute(f"PRAGMA user_version = {SCHEMA_VERSION + 1}")
    db.close()
    with pytest.raises(StoreError, match=f"version {SCHEMA_VERSION + 1}, this receiver knows {SCHEMA_VERSION}"):
        Store(tmp_path)


def test_unusable_folders(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_bytes(b"")
    with pytest.raises(StoreError, match="cannot be made"):
        Store(file / "below")
    junk = tmp_path / "junk"
    junk.mkdir()
    (junk / "receiver.sqlite3").write_bytes(b"no database" * 1000)
    with pytest.raises(StoreError, match="cannot be used"):
        Store(junk)


def test_states_are_the_same_bytes_and_never_pickles() -> None:
    assert pack_state(STATE) == pack_state({name: array.copy() for name, array in STATE.items()})
    with pytest.raises(StoreError):
        pack_state({"object": np.array([{}])})
    for data in (b"", b"PK", pack_state(STATE)[:-30], b"\x80\x04."):
        with pytest.raises(StoreError, match="cannot be read"):
            unpack_state(data)
