"""The command line: one clear line for whatever is wrong, exit status not 0, no traceback."""

from __future__ import annotations

import re
import socket
import sys
import warnings
from pathlib import Path
from typing import Any
from unittest.mock import AsyncMock

import anyio
import httpx
import pytest

from sender.__main__ import _say_seconds, _wait_for_channel, duration, main
from sender.client import ReceiverClient, RetryPolicy, Sent

SUMMARY = {"outliers": [3, 7], "notes": ["the spread [narrowest] stays"]}
NOWHERE = ["--receiver", "http://127.0.0.1:9"]  # the discard port: nothing listens there


def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str, str]:
    monkeypatch.setattr(sys, "argv", ["sender", *arguments])
    monkeypatch.setenv("COLUMNS", "120")
    with pytest.raises(SystemExit) as stop:
        main()
    out, err = capsys.readouterr()
    return int(stop.value.code or 0), out, err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["surface1"], "did you mean 'surface-1'?"),
        (["surface-1", "--gap", "5"], "larger than the region"),
        (["surface-1", "--gap", "0.001"], "nearly all of them empty"),
        (["surface-1", "--gap", "1e-9"], "at most 16000000"),
        (["surface-1", "--gap", "-1"], "gap: Input should be greater than 0"),
        (
            ["surface-1", "--precision", "200"],
            "error: --precision: expected float64, float32, or 2 to 32 bits\n",
        ),
        (["surface-1", "--precision", "\N{SUPERSCRIPT TWO}"], "--precision: expected float64, float32, or 2"),
        (["surface-1", "--inner", "300"], "--inner: Input should be 0, or 16, 32, 64 or 128\n"),
        (["names.csv"], "names.csv holds a line of names and no point"),
        (["huge.csv"], "1e+300; accepted are coordinates up to 1e+100"),
        (["surface-1", "--points", "1"], "at least 3"),
        (["surface-1", "--points", "99999999999"], "the number of points must be 1 to 10000000"),
        (["surface-1", "--receiver", "localhost"], "not a receiver's URL"),
        (["surface-1", "--receiver", "http://127.0.0.1:99999"], "its port must be 1 to 65535"),
        (["surface-1", "--channel", "gausian:std=1"], "did you mean 'gaussian'?"),
        (["surface-1", "--channel", "erasure:p=0.1;seed=5", "--channel-seed", "0"], "two seeds, 0 and 5; give one"),
        (["surface-1", "--id", "a b"], "id: expected 1 to 64 characters: letters"),
        (["surface-1", "--id", ".."], "hyphens; not . or .. alone"),
        (["nothing.csv"], "No such file"),
        (["empty.csv"], "is empty"),
        (["one.csv"], "at least 3"),
        (["place.csv"], "one place"),
        (["line.csv"], "one line"),
        (
            ["nan.csv"],
            "nan.csv: 1 of 3 points have no height (an empty cell, NaN, NODATA), the first on line 1; --no-data nan",
        ),
        (["nan.csv", "--no-data", "nan"], "2 point(s) given"),
        (["surface-1", "--no-data", "0", "--xy-unit", "m"], "no_data, xy_unit: for a file of points alone; surface-1"),
        (["nan.csv", "--no-data", "none"], "error: --no-data: Input should be 'nan'"),
        (["repeated.csv"], "choose which to keep: --repeated mean, min or max"),
        (["wide.csv"], "say which they are, for example --columns 0,1,2"),
        (["wide.csv", "--columns", "0,0,2"], "0, 0, 2 name the same column twice; the file's columns: numbers 0 to 3"),
        (["surface-1", "--precision", "float16"], "error: --precision: expected float64, float32, or 2 to 32 bits\n"),
        (["surface-1", "--xy-unit", "m", "--rounds", "0"], "error: --rounds: Input should be"),
        (["surface-1", "--receiver", "http://127.0.0.1:9/v1/"], "give the receiver's URL without /v1"),
        (["binary.csv"], "not text in UTF-8"),
        (["place.csv", "--columns", "lon,lat"], "three columns are needed, those of x, y and z, not 2 (lon, lat)"),
        (["picture.png"], ".csv, .txt, .xyz, .asc, .npy, .npz, .tif, .tiff, .hgt, each also with .gz or .xz behind it"),
    ],
)
def test_bad_input_is_one_line(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    message: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    for name, text in {
        "empty.csv": b"",
        "one.csv": b"1,2,3",
        "place.csv": b"1,2,3\n" * 5,
        "names.csv": b"x,y,z\n",
        "huge.csv": b"1,1,3\n-1e300,2,4\n3,1,0\n",
        "line.csv": b"1,1,3\n2,2,4\n3,3,0\n",
        "nan.csv": b"1,1,nan\n2,0,4\n3,3,0\n",
        "repeated.csv": b"1,1,1\n1,1,4\n3,3,0\n5,0,0\n",
        "binary.csv": b"\x89PNG\xff",
        "wide.csv": b"1,1,1,1\n2,1,4,2\n3,3,0,0\n",
        "picture.png": b"\x89PNG",
    }.items():
        (tmp_path / name).write_bytes(text)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        status, _, err = run(monkeypatch, capsys, "send", *arguments)
    assert status == 1
    assert message in err
    assert err.startswith("error: ")
    assert err.count("\n") == 1


def test_a_receiver_that_is_not_running_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    connect = ReceiverClient.connect

    def impatient(*arguments: Any) -> ReceiverClient:
        client = connect(*arguments)
        client.retry = RetryPolicy(tries=1)
        return client

    monkeypatch.setattr(ReceiverClient, "connect", impatient)
    status, out, err = run(monkeypatch, capsys, "send", "surface-1", *NOWHERE)
    assert status == 1
    assert "50 feature points" in out
    assert "does not answer" in err
    assert "receiver serve" in err


@pytest.mark.parametrize(
    "arguments", [["snd"], ["send"], ["send", "surface-1", "--kind", "all"], ["serve", "--prt", "1"]]
)
def test_a_typo_is_a_usage_error(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], arguments: list[str]
) -> None:
    status, _, err = run(monkeypatch, capsys, *arguments)
    assert status == 2
    assert "Usage: " in err
    assert "Traceback" not in err


def test_a_port_that_is_taken_is_one_line(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        status, _, err = run(monkeypatch, capsys, "serve", "--port", str(port))
    assert status == 1
    assert err == f"error: cannot listen on 127.0.0.1 port {port}: Address already in use; choose another --port\n"


def test_the_surfaces_are_listed(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    status, out, _ = run(monkeypatch, capsys, "surfaces")
    assert status == 0
    assert "surface-3-squared" in out
    assert "138632" in out


def test_every_option_of_send_reaches_the_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    seen: dict[str, Any] = {}

    def record(_function: object, prepared: object, order: object, receiver: str, *_rest: object) -> Sent:
        seen.update(prepared=prepared, order=order, receiver=receiver)
        raise SystemExit(0)

    monkeypatch.setattr("sender.__main__.anyio.run", record)
    path = tmp_path / "cloud.csv"
    path.write_text("a,b,c,d\n" + "".join(f"9,{i % 7},{i // 7},{i}\n" for i in range(49)))
    _, _, err = run(
        monkeypatch, capsys, "send", str(path), "--id", "n", "--gap", "2", "--points", "40", "--seed", "3", "--columns",
        "b,c,d", "--repeated", "max", "--no-data", "7", "--xy-unit", "km", "--z-unit", "m", "--rounds", "4",
        "--datagram", "300", "--precision", "float32", "--receiver", "http://r.test",
    )  # fmt: skip
    order = seen["order"].model_dump()
    expected = {"id": "n", "gap": 2.0, "points": 40, "seed": 3, "columns": ("b", "c", "d"), "repeated": "max",
                "no_data": 7.0,
                "xy_unit": "km", "z_unit": "m", "rounds": 4}  # fmt: skip
    assert expected.items() <= order.items()
    assert (order["wire"]["datagram"], order["wire"]["precision"]) == (300, "float32")
    assert seen["prepared"].cloud == 40
    assert "note: cloud.csv: 1 of 49 points have no height and are left out\n" in err
    assert seen["receiver"] == "http://r.test"


@pytest.mark.parametrize(("new", "repeats"), [(2, 0), (0, 1)])
def test_send_says_what_was_kept_and_what_the_network_left_out(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], new: int, repeats: int
) -> None:
    def receive(request: httpx.Request) -> httpx.Response:
        if request.method == "GET":
            return httpx.Response(200, json={"state": "ready", "points": 50, "network": SUMMARY})
        counts = {"received": 2, "damaged": 0, "duplicate": 2 - new, "total": 2, "missing": []}
        delivery = {"new": new, "duplicate": 2 - new, "damaged": 0, "foreign": 0}
        receipt = {"id": "a", "points": 50, "complete": True, "state": "training"}
        return httpx.Response(202, json={**receipt, "packets": counts, "delivery": delivery})

    def connect(url: str, _transport: object) -> ReceiverClient:
        return ReceiverClient(httpx.AsyncClient(base_url=url, transport=httpx.MockTransport(receive)))

    monkeypatch.setattr(ReceiverClient, "connect", connect)
    status, out, _ = run(monkeypatch, capsys, "send", "surface-1", "--wait", *NOWHERE)
    assert status == 0
    assert out.count("curl -X DELETE http://127.0.0.1:9/v1/surfaces/surface-1") == repeats
    assert "2 of 50 points set aside as outliers\nnetwork: the spread [narrowest] stays\n" in out


def test_where_nothing_arrived_all_packets_are_missing(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    counts: dict[str, Any] = {"received": 0, "damaged": 0, "duplicate": 0, "total": None, "missing": []}
    receipt = {"id": "a", "points": 0, "complete": False, "state": "receiving", "packets": counts}

    def connect(url: str, _transport: object) -> ReceiverClient:
        transport = httpx.MockTransport(lambda _: httpx.Response(202, json=receipt))
        return ReceiverClient(httpx.AsyncClient(base_url=url, transport=transport))

    monkeypatch.setattr(ReceiverClient, "connect", connect)
    status, out, _ = run(monkeypatch, capsys, "send", "surface-1", *NOWHERE)
    assert status == 0
    assert "receiver: 0 of 2 packets, 0 damaged, 0 duplicate, 0 rebuilt, 2 missing, 0 sent again" in out


@pytest.mark.parametrize("options", [[], ["--virtual-time"]])
def test_how_long_a_channel_takes_is_said_before_it_starts(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], options: list[str]
) -> None:
    slept: list[float] = []
    said: list[str] = []
    counts: dict[str, Any] = {"received": 9, "damaged": 0, "duplicate": 0, "total": 9, "missing": []}
    receipt = {"id": "a", "points": 50, "complete": True, "state": "training", "packets": counts}

    async def sleep(seconds: float) -> None:
        if not slept:
            said.append(capsys.readouterr().out)
        slept.append(seconds)

    monkeypatch.setattr("sender.__main__.anyio.sleep", sleep)
    monkeypatch.setattr(
        "sender.__main__.httpx.AsyncHTTPTransport",
        lambda: httpx.MockTransport(lambda _: httpx.Response(202, json=receipt)),
    )
    status, out, _ = run(
        monkeypatch, capsys, "send", "surface-1", "--channel", "rate:bits_per_second=2", "--datagram", "64",
        *options, *NOWHERE,
    )  # fmt: skip
    assert status == 0
    before = out if options else said[0]
    assert re.search(r"\nthe channel takes about \d+ min \d+ s\n", before)
    assert "receiver: " not in before.partition("the channel takes")[0]
    (minutes, seconds) = re.findall(r"about (\d+) min (\d+) s", before)[0]
    assert sum(slept) == pytest.approx(0 if options else 60 * int(minutes) + int(seconds), abs=0.6)


def test_a_quick_channel_is_not_worth_a_word(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    sleep = AsyncMock()
    monkeypatch.setattr("sender.__main__.anyio.sleep", sleep)
    anyio.run(_wait_for_channel, 0.3)
    sleep.assert_awaited_once_with(0.3)
    assert capsys.readouterr().out == ""


def test_in_virtual_time_a_quick_channel_is_told_too(capsys: pytest.CaptureFixture[str]) -> None:
    anyio.run(_say_seconds, 1.864)
    assert capsys.readouterr().out == "the channel takes about 1.9 s\n"
    anyio.run(_say_seconds, 0.0)
    assert capsys.readouterr().out == ""


def test_durations_are_said_as_people_say_them() -> None:
    assert [duration(seconds) for seconds in (4.6, 59.7, 1326.4, 7380.0)] == [
        "5 s",
        "1 min 0 s",
        "22 min 6 s",
        "2 h 3 min 0 s",
    ]
