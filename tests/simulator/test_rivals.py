"""Features and codecs meet the same channels at the same bytes; the page says who is closest."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from common.channel import Channel, Delivery
from common.errors import ParameterError
from sender.surfaces import find_surface
from simulator import rivals
from simulator.codecs.protection import PROTECTIONS
from simulator.page import line_style
from simulator.rivals import AXES, RIVALS, Contest, Rival, run_rivals, summarise, verdict, winners
from simulator.statistics import Quartiles

CONTEST = Contest("franke", 512, 64)
FEW = (RIVALS[0], RIVALS[2], RIVALS[3], Rival("scattered", codec="scattered_samples"))


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few levels and a small field: what is tested is the contest, not its outcome."""
    levels = {"ber": (1e-4, 1e-2), "loss": (0.0, 0.4)}
    monkeypatch.setattr(rivals, "AXES", {name: AXES[name]._replace(levels=few) for name, few in levels.items()})
    monkeypatch.setattr(rivals, "field", lambda name: find_surface(name).grid((48, 48)))


@pytest.mark.usefixtures("small")
def test_every_rival_keeps_to_the_bytes_and_the_files_say_what_was_measured(tmp_path: Path) -> None:
    rows = run_rivals(tmp_path, seeds=3, workers=2, contests=[CONTEST], rivals=FEW)
    assert {row["rival"] for row in rows} == {rival.label for rival in FEW}
    assert len(rows) == len(FEW) * (2 * 3 + 1 + 3)
    assert all(0 < int(row["sent"] or 0) <= 512 for row in rows)

    with (tmp_path / "rivals.csv").open(newline="") as file:
        table = list(csv.DictReader(file))
    assert [row["rival"] for row in table] == [row["rival"] for row in rows]
    assert [float(row["nrmse"]) if row["nrmse"] else None for row in table] == [row["nrmse"] for row in rows]
    assert (tmp_path / "rivals-franke.png").read_bytes().startswith(b"\x89PNG")
    assert "Median NRMSE by bit-error rate" in (tmp_path / "rivals.html").read_text("utf-8")

    loss = summarise(rows, "franke", "loss")
    bare, safe = loss["lattice, network"], loss["lattice protected, network"]
    assert bare[0.0].median < 0.002
    assert bare[0.0].median < bare[0.4].median < 0.1  # a thinner lattice is a surface still
    assert bare[0.4].failed == 0
    assert summarise(rows, "franke", "ber")["lattice protected, network"][1e-2].median == safe[0.0].median
    for rival in ("features, network", "lattice, network", "scattered"):
        lossy = [row["nrmse"] for row in rows if (row["rival"], row["axis"], row["level"]) == (rival, "loss", 0.4)]
        assert len(set(lossy)) == 3


@pytest.mark.usefixtures("small")
def test_rivals_lose_the_same_datagrams(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lost: list[set[int]] = []
    transmit = Channel.transmit

    def watched(self: Channel, packets: Sequence[bytes], **named: Any) -> Delivery:
        delivery = transmit(self, packets, **named)
        if str(self).startswith("erasure:p=0.4"):
            lost.append({fault.packet for fault in delivery.faults if fault.packet < 5})
        return delivery

    monkeypatch.setattr(Channel, "transmit", watched)
    entered = [RIVALS[2], FEW[3], Rival("dct", codec="dct"), Rival("safe", codec="dct", protection="rs223")]
    run_rivals(tmp_path, seeds=3, workers=1, contests=[CONTEST], rivals=entered)
    assert len(lost) == 3 * len(entered)
    assert lost == lost[:3] * len(entered)
    assert lost[0] != lost[1]


def test_the_winner_has_the_least_median_and_failures_never_win() -> None:
    found = {
        "a": {0.1: Quartiles.of([0.1, 0.2, 0.3]), 0.2: Quartiles.of([None, None, 0.1])},
        "b": {0.1: Quartiles.of([0.3, 0.1, 0.1]), 0.2: Quartiles.of([None, None, None])},
    }
    assert winners(found) == {0.1: ("b",), 0.2: ()}


def test_a_tie_is_no_win_of_the_network() -> None:
    network = RIVALS[0].label
    tied = {
        rival: {level: Quartiles.of([error] * 3) for level, error in ((0.1, 0.2), (0.2, last))}
        for rival, last in ((network, 0.6), ("codec", 0.3), ("other", 0.3))
    }
    tied["other"][0.1] = Quartiles.of([0.25] * 3)
    assert winners(tied) == {0.1: (network, "codec"), 0.2: ("codec", "other")}
    said = verdict(tied, "loss")
    assert f"at 0.1 {network} and codec tie; at 0.2 codec and other tie, the best network behind by" in said


@pytest.mark.usefixtures("small")
def test_bytes_too_few_for_a_rival_leave_it_out(tmp_path: Path) -> None:
    rows = run_rivals(tmp_path, seeds=1, workers=1, contests=[Contest("franke", 70, 64)], rivals=[RIVALS[3], FEW[3]])
    assert {row["rival"] for row in rows} == {"scattered"}


def test_a_folder_that_cannot_be_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ParameterError, match="cannot write to"):
        run_rivals(tmp_path / "file" / "out", seeds=1, workers=1, contests=[], rivals=[])


def test_the_rivals_are_told_apart_by_their_labels_and_their_lines() -> None:
    assert len({rival.label for rival in RIVALS}) == len(RIVALS)
    assert len({str(line_style(k)) for k in range(len(RIVALS))}) == len(RIVALS)


def test_the_transform_codecs_have_every_protection() -> None:
    entered = {(rival.codec, rival.protection) for rival in RIVALS}
    assert entered >= {(codec, protection) for codec in ("jpeg2000", "sperr") for protection in PROTECTIONS}


def test_the_verdict_says_who_wins_where_and_how_far_the_network_is_behind() -> None:
    network = RIVALS[0].label
    found = {
        network: {level: Quartiles.of([error] * 3) for level, error in ((0.0, 0.02), (0.1, 0.03), (0.2, 0.04))},
        "codec": {level: Quartiles.of([error] * 3) for level, error in ((0.0, 0.01), (0.1, 0.01), (0.2, None))},
        "frail": {0.3: Quartiles.of([None] * 3)},
    }
    said = verdict(found, "loss")
    assert "at 0 to 0.1 codec wins, the best network behind by a factor of 2.00 to 3.00" in said
    assert f"at 0.2 {network} wins" in said
    assert "at 0.3 no rival has a surface" in said
