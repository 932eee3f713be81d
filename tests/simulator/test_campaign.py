"""Campaign files, trials and the table: repeatable, independent of workers, clear about mistakes."""

from __future__ import annotations

import csv
import re
import sys
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from typer.testing import CliRunner

from common.channel import Channel, Delivery
from common.errors import MissingExtraError, ParameterError, PointsError
from common.surface import Region
from common.wire import WireOptions, encode
from sender.features import extract_features
from simulator.__main__ import app
from simulator.campaign import Campaign, FeatureSettings, Trial
from simulator.choice import choose_features
from simulator.runner import Cell, Run
from simulator.sweep import DEFAULT_PLAN, code_digest, plan_of_options, run_campaign, sweep_command
from simulator.table import COLUMNS, to_csv, to_parquet
from simulator.transports import Way
from simulator.trial import notes_of, run_trial

PLAN: dict[str, Any] = {
    "name": "small",
    "surfaces": ["surface-1", "surface-3"],
    "channels": [{"spec": "gaussian:std={z},axes=z", "axis": "noise", "levels": [0.02, 0.1]}],
    "methods": ["network", "linear", "cubic@cloud"],
    "seeds": 2,
    "grid": [12, 14],
}


def campaign(**changes: object) -> Campaign:
    return Campaign.build(PLAN | changes)


def options_of(**given: Any) -> dict[str, Any]:
    names = (
        "surface",
        "columns",
        "no_data",
        "channel",
        "method",
        "points",
        "gap",
        "pieces",
        "budget",
        "seeds",
        "seed",
        "grid",
        "rounds",
    )
    return plan_of_options(**{**dict.fromkeys(names), **given})


def rows_of(plan: Campaign) -> list[dict[str, Cell]]:
    return [dict(row) for trial in plan.trials() for row in run_trial(trial).rows]


def test_every_combination_once() -> None:
    plan = campaign(features=[{"pieces": 4}, {"pieces": 6}], wire=[{}, {"precision": "float64"}])
    trials = plan.trials()
    assert len(trials) == plan.size == 2 * 2 * 2 * 2 * 2
    assert len({trial.key for trial in trials}) == len(trials)


def test_a_row_has_the_columns_of_the_table_and_is_redone_from_them() -> None:
    rows = rows_of(campaign(seeds=1))
    assert all(set(row) == set(COLUMNS) for row in rows)
    again = campaign(seeds=1, methods=["linear"])
    first = next(row for row in rows if row["method"] == "linear")
    assert rows_of(again)[0] == first


def test_the_table_is_the_same_for_one_worker_and_two_and_after_an_interruption(tmp_path: Path) -> None:
    plan = campaign(surfaces=["surface-1"])
    run_campaign(plan, tmp_path / "one", workers=1)
    run_campaign(plan, tmp_path / "two", workers=2)

    def stop(done: int, total: int) -> None:
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_campaign(plan, tmp_path / "cut", workers=2, progress=stop)
    seen: list[int] = []
    run_campaign(plan, tmp_path / "cut", workers=1, progress=lambda done, total: seen.append(done))
    assert seen[0] >= 2
    tables = {(tmp_path / name / "table.csv").read_bytes() for name in ("one", "two", "cut")}
    assert len(tables) == 1


def test_a_finished_campaign_runs_nothing_again(tmp_path: Path) -> None:
    plan = campaign(surfaces=["surface-1"], seeds=1, methods=["linear"])
    run_campaign(plan, tmp_path, workers=1)
    seen: list[tuple[int, int]] = []
    run_campaign(plan, tmp_path, workers=1, progress=lambda *now: seen.append(now))
    assert seen == [(2, 2)]


def test_what_is_to_go_another_way_is_run_again(tmp_path: Path) -> None:
    plan = campaign(surfaces=["surface-1"], seeds=1, methods=["linear"])
    run_campaign(plan, tmp_path, workers=1)
    seen: list[tuple[int, int]] = []
    run_campaign(plan, tmp_path, workers=1, way=Way.ASGI, progress=lambda *now: seen.append(now))
    assert seen[0] == (0, 2)


def test_all_methods_share_one_cloud_and_one_harm() -> None:
    for trial in campaign(seeds=1).trials():
        shared = [
            {k: v for k, v in row.items() if k not in {"method", "rmse", "nrmse", "max_error", "failure"}}
            for row in run_trial(trial).rows
        ]
        assert all(row == shared[0] for row in shared)


def by_sample(method: str, **changes: object) -> list[Cell]:
    """The errors of one method in three samples."""
    rows = rows_of(campaign(**changes, methods=[method], seeds=3))
    assert [row["sample"] for row in rows] == [0, 1, 2]
    return [row["nrmse"] for row in rows]


NODES: dict[str, Any] = {"surfaces": [{"field": "peaks"}], "features": [{"pieces": 6}], "grid": [16, 16]}
"""All nodes of a field are the same cloud in every sample."""


def test_each_sample_is_a_cloud_of_its_own() -> None:
    for method in ("linear", "linear@cloud"):
        assert len(set(by_sample(method, surfaces=["surface-1"], channels=["clean"]))) == 3
    assert len(set(by_sample("linear", **NODES, channels=["clean"]))) == 1


@pytest.mark.parametrize("channel", ["gaussian:std=0.1,axes=z", "erasure:p=0.3"])
def test_each_sample_meets_a_harm_of_its_own(channel: str) -> None:
    assert len(set(by_sample("linear", **NODES, channels=[channel], wire=[{"datagram": 64}]))) == 3


def test_a_method_draws_anew_in_each_sample() -> None:
    found = by_sample("random_network", **NODES, channels=["clean"])
    assert len(set(found)) == 3
    assert not set(found) & set(by_sample("random_network", **NODES, channels=["clean"], seed=1))


def test_more_of_anything_keeps_the_trials_there_are() -> None:
    base = {trial.key for trial in campaign(surfaces=["surface-1"], seeds=1).trials()}
    levels = [{"spec": "gaussian:std={z},axes=z", "axis": "noise", "levels": [0.02, 0.05, 0.1]}]
    assert base < {trial.key for trial in campaign(surfaces=["peaks", "surface-1"], seeds=2, channels=levels).trials()}


def test_channels_are_compared_on_the_same_clouds() -> None:
    by_level = {row["level"]: row for row in rows_of(campaign(seeds=1)) if row["method"] == "cubic@cloud"}
    assert by_level[0.02]["nrmse"] == by_level[0.1]["nrmse"]
    assert by_level[0.02]["transmission"] != by_level[0.1]["transmission"]


@pytest.mark.parametrize(
    "change",
    [
        {"seed": 1},
        {"grid": [13, 14]},
        {"features": [{"points": 150}]},
        {"features": [{"gap": 0.5}]},
        {"features": [{"pieces": 7}]},
        {"features": [{"budget": 150}]},
        {"features": [{"kind": "cloud"}]},
        {"wire": [{"precision": 8}]},
        {"channels": [{"spec": "gaussian:std={z},axes=z", "axis": "noise", "levels": [0.03]}]},
        {"channels": [{"spec": "gaussian:std={noise},axes=z", "axis": "noise", "levels": [0.02]}]},
        {"channels": [{"spec": "gaussian:std={level},axes=z", "axis": "noise", "levels": [0.02]}]},
        {"methods": ["network[smoothing=0]"]},
        {"methods": ["network@cloud"]},
        {"surfaces": [{"name": "surface-1", "points": 150}]},
        {"surfaces": [{"name": "surface-1", "pieces": 7}]},
        {"features": [{"kind": "lattice"}]},
    ],
    ids=str,
)
def test_every_setting_changes_the_outcome(change: dict[str, object]) -> None:
    base = PLAN | {"surfaces": ["surface-1"], "seeds": 1, "methods": ["network"]}
    before, after = (rows_of(Campaign.build(plan))[0]["nrmse"] for plan in (base, base | change))
    assert before != after


def test_rounds_send_again_what_was_lost() -> None:
    lossy = {
        "surfaces": ["surface-1"],
        "channels": ["erasure:p=0.5"],
        "wire": [{"min_packets": 10}],
        "methods": ["linear"],
        "seeds": 1,
    }
    once, often = (rows_of(campaign(**lossy, rounds=rounds))[0] for rounds in (1, 20))
    assert int(once["features_received"] or 0) < int(once["features"] or 0) == often["features_received"]
    assert int(often["bytes"] or 0) > int(once["bytes"] or 0)


def test_what_never_arrives_is_a_failure_of_every_method_that_needs_it() -> None:
    rows = rows_of(campaign(surfaces=["surface-1"], channels=["erasure:p=1"], seeds=1))
    by_method = {row["method"]: row for row in rows}
    assert by_method["linear"]["failure"] == "NotReadyError: nothing arrived"
    assert by_method["linear"]["nrmse"] is None
    assert by_method["cubic@cloud"]["failure"] is None


def test_a_method_that_breaks_down_loses_its_cell_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*given: object) -> None:
        raise np.linalg.LinAlgError("Singular matrix")

    monkeypatch.setattr("simulator.methods.reconstruct", broken)
    network, linear, cubic = rows_of(campaign(surfaces=["surface-1"], channels=["clean"], seeds=1))
    assert network["failure"] is None
    assert linear["failure"] == cubic["failure"] == "LinAlgError: Singular matrix"


def test_the_budget_holds_and_is_used() -> None:
    plan = campaign(surfaces=["peaks"], features=[{"budget": 700}], channels=["clean"], seeds=2, methods=["linear"])
    for row in rows_of(plan):
        assert 0.6 * 700 < int(row["bytes"] or 0) <= 700


def test_finer_pieces_that_take_fewer_bytes_are_found() -> None:
    # Cut into 9, 860 m have a gap of 17 digits, which leaves little of a datagram of 64 bytes; cut into 10 it is 86.
    x, y = np.meshgrid(np.arange(0.0, 601, 10), np.arange(0.0, 861, 10))
    cloud = np.column_stack([x.ravel(), y.ravel(), np.hypot(x, y).ravel()])
    wire = WireOptions(datagram=64, coding="compact", parity=0.5)

    def sent(gap: float) -> int:
        return sum(map(len, encode(extract_features(cloud, gap=gap), transmission="budget", options=wire)))

    budget = sent(86)
    assert sent(860 / 9) > 2 * budget
    features = choose_features(cloud, Region(0, 600, 0, 860), FeatureSettings(budget=budget), wire, None)
    assert features.gap == 86


def test_a_budget_nothing_fits_into_is_a_clear_error() -> None:
    with pytest.raises(ParameterError, match="64 bytes"):
        rows_of(campaign(surfaces=["surface-1"], features=[{"budget": 64, "kind": "cloud"}], seeds=1))


def test_a_file_is_a_surface_known_by_its_contents(tmp_path: Path) -> None:
    x, y = np.meshgrid(np.linspace(0, 1, 30), np.linspace(0, 2, 30))
    cloud = np.column_stack([x.ravel(), y.ravel(), (x + 2 * y).ravel()])
    plan = PLAN | {"features": [{"pieces": 5}], "channels": ["clean"], "methods": ["thin_plate"], "seeds": 1}
    found = []
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        np.savetxt(tmp_path / folder / "plane.csv", cloud, delimiter=",")
        file = plan | {"surfaces": [{"file": "plane.csv"}]}
        found.append(rows_of(Campaign.build(file, folder=tmp_path / folder))[0])
    assert found[0] == found[1]
    assert found[0]["surface"] == "plane.csv"
    assert float(found[0]["nrmse"] or 1) < 1e-3  # a plane, quantised to 16 bits


def test_grids_in_files_are_surfaces(tmp_path: Path) -> None:
    z = np.add.outer(np.arange(20.0), 2 * np.arange(30.0))
    np.savez(tmp_path / "plane.npz", z=z, dx=2.0, dy=2.0)
    scale, tie = (33_550, "d", 3, (2.0, 2.0, 0.0), True), (33_922, "d", 6, (0.5, 19.5, 0.0, 0.0, 0.0, 0.0), True)
    tifffile.imwrite(tmp_path / "plane.tif", z, extratags=[scale, tie], photometric="minisblack", metadata=None)
    changes = {
        "surfaces": [{"file": "plane.npz"}, {"file": "plane.tif"}],
        "features": [{"pieces": 5}],
        "channels": ["clean"],
        "methods": ["linear"],
        "seeds": 1,
    }
    plan = Campaign.build(PLAN | changes, folder=tmp_path)
    rows = rows_of(plan)
    assert [row["surface"] for row in rows] == ["plane.npz", "plane.tif"]
    assert [row["gap"] for row in rows] == [58 / 5] * 2
    assert rows[0]["nrmse"] == rows[1]["nrmse"]
    assert [notes_of(choice) for choice in plan.surfaces] == [(), ()]


def test_files_of_equal_contents_are_told_apart_by_their_names(tmp_path: Path) -> None:
    text = "\n".join(",".join(map(repr, point)) for point in np.random.default_rng(0).random((200, 3)).tolist())
    for name in ("a.csv", "b.csv"):
        (tmp_path / name).write_text(text)

    def plan(*names: str) -> Campaign:
        surfaces = [{"file": name, "points": 100} for name in names]
        changes = {"surfaces": surfaces, "features": [{"pieces": 5}], "channels": ["clean"], "methods": ["linear"]}
        return Campaign.build(PLAN | changes | {"seeds": 1}, folder=tmp_path)

    for names in (("a.csv",), ("a.csv", "b.csv"), ("b.csv",)):  # all in one journal
        rows = run_campaign(plan(*names), tmp_path / "out", workers=1)
        assert [row["surface"] for row in rows] == list(names)
        assert rows == rows_of(plan(*names))
        assert len({row["transmission"] for row in rows}) == len(names)


def test_points_of_a_file_without_a_height_are_left_out_where_that_is_asked_for(tmp_path: Path) -> None:
    points = np.random.default_rng(0).random((200, 3)).tolist()
    (tmp_path / "a.csv").write_text("\n".join(",".join(map(repr, point)) for point in points) + "\n0.5,0.5,-9999\n")

    def plan(**reading: object) -> Campaign:
        changes = {"surfaces": [{"file": "a.csv", **reading}], "channels": ["clean"], "methods": ["linear"], "seeds": 1}
        return Campaign.build(PLAN | changes, folder=tmp_path)

    (whole,), (rid,) = rows_of(plan()), rows_of(plan(no_data=-9999))
    assert (whole["points"], rid["points"]) == (201, 200)
    assert len({plan(**each).trials()[0].key for each in ({}, {"no_data": -9999}, {"no_data": "nan"})}) == 3
    assert "often stands for none" in notes_of(plan().surfaces[0])[0]
    assert "1 of 201 points have no height" in notes_of(plan(no_data=-9999).surfaces[0])[0]
    with pytest.raises(ParameterError, match=r"surfaces\.0\.no_data: should be 'nan', or a valid number"):
        plan(no_data="x")
    with pytest.raises(ParameterError, match="no_data belongs to a file"):
        Campaign.build(PLAN | {"surfaces": [{"name": "peaks", "no_data": 1}]}, folder=tmp_path)


def test_the_transmissions_of_named_surfaces_are_those_of_the_published_campaigns() -> None:
    # Their harm is drawn by these ids.
    (trial,) = Campaign.build({"name": "small", "surfaces": ["surface-1"], "channels": ["clean"], "seeds": 1}).trials()
    assert trial.digest == "b0dda5b141"
    assert trial.draws == trial.transmission == "small-b0dda5b141-0"


def test_rivals_of_a_cell_lose_the_same_datagrams(monkeypatch: pytest.MonkeyPatch) -> None:
    lost: list[list[bool]] = []
    transmit = Channel.transmit

    def watched(self: Channel, packets: Sequence[bytes], **named: Any) -> Delivery:
        delivery = transmit(self, packets, **named)
        gone = {fault.packet for fault in delivery.faults if fault.kind == "erasure"}
        lost.append([number in gone for number in range(len(packets))])
        return delivery

    monkeypatch.setattr(Channel, "transmit", watched)
    sent = {"budget": 600, "datagram": 64}
    plan = campaign(
        surfaces=[{"field": "peaks"}],
        features=[{"pieces": 12}, {"kind": "lattice", "pieces": 24}],
        wire=[{"datagram": 64}, {"datagram": 64, "precision": "float64"}],
        methods=["nearest"],
        codecs=[sent | {"codec": "scattered_samples"}, sent | {"codec": "dct", "protection": "rs127"}],
        channels=[{"spec": "reordering:p=1;erasure:p={level}", "levels": [0.3, 0.5]}],
    )
    rows = rows_of(plan)
    assert len({row["transmission"] for row in rows}) == len(rows) == len(lost) == 6 * 2 * 2
    cells: dict[Cell, list[list[bool]]] = {}
    for row, its in zip(rows, lost, strict=True):
        cells.setdefault(row["draws"], []).append(its)
    assert [len(cell) for cell in cells.values()] == [6] * 4
    for cell in cells.values():
        least = min(map(len, cell))
        assert least >= 5
        assert all(its[:least] == cell[0][:least] for its in cell)
    assert len({str(cell[0]) for cell in cells.values()}) == 4
    assert rows[0]["draws"] == rows[0]["transmission"]  # more that is sent changes nothing for the first


def test_a_file_that_is_no_surface_says_so(tmp_path: Path) -> None:
    (tmp_path / "f.csv").write_text("0,0,0\n1,1,1\n2,2,2\n")
    plan = campaign(surfaces=[{"file": tmp_path / "f.csv"}], channels=["clean"])
    with pytest.raises(PointsError, match="on one line"):
        run_trial(plan.trials()[0])


HEAD = "surfaces = ['peaks']\n"
CLEAN = HEAD + "channels = ['clean']\n"


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("surfaces = ['surface-1'\n", "not a TOML file"),
        (HEAD, "channels is missing"),
        ("surfaces = []\nchannels = ['clean']\n", "surfaces: "),
        ("surfaces = ['sphere']\nchannels = ['clean']\n", "no surface is called 'sphere'; accepted are surface-1"),
        ("surfaces = [{name = 'peaks', file = 'x'}]\nchannels = ['clean']\n", "surfaces.0: give one of"),
        ("surfaces = [{name = 'bay', file = 'a.csv'}]\nchannels = ['clean']\n", "surfaces.0: .*called by its own name"),
        ("surfaces = [{field = 'moon'}]\nchannels = ['clean']\n", "surfaces.0: no field is called 'moon'"),
        ("surfaces = [{file = 'none.csv'}]\nchannels = ['clean']\n", "cannot read .*none.csv"),
        (CLEAN + "seed = -1\n", "seed: .*greater than or equal to 0"),
        (CLEAN + "method = ['linear']\n", r"method is not a key; did you mean 'methods'\? accepted are .*methods"),
        (CLEAN + "methods = ['linaer']\n", r"'linaer' is not a method; did you mean 'linear'\? accepted are"),
        (CLEAN + "methods = ['netwrok[spread=1]']\n", r"is not a method; did you mean 'network'\?"),
        ("surfaces = [{field = 'frnke'}]\nchannels = ['clean']\n", r"did you mean 'franke'\?"),
        (CLEAN + "[[features]]\nkind = 'lattics'\n", r"features.0.kind: .*; did you mean 'lattice'\?"),
        (
            CLEAN + "[[codecs]]\ncodec = 'jpg2000'\nbudget = 99\n",
            r"no codec is called 'jpg2000'; did you mean 'jpeg2000'\?",
        ),
        (CLEAN + "methods = ['linear', 'linear']\n", "stands twice"),
        (CLEAN + "methods = ['network[spraed=1]']\n", "spraed.*accepted are spread"),
        (CLEAN + "methods = ['linear[spread=1]']\n", "only network takes settings"),
        (HEAD + "channels = ['fog:p=1']\n", "channels.0: .*fog"),
        (HEAD + "channels = [{spec = 'erasure:p={level}'}]\n", "levels and a {level}"),
        (HEAD + "channels = [{spec = 'erasure:p=0.1', levels = [1.0]}]\n", "levels and a {level}"),
        (HEAD + "channels = [{spec = 'erasure:p={level}', levels = [2.0]}]\n", "channels.0: .*p"),
        (HEAD + "channels = [{spec = 'erasure:p={level}{x}', levels = [1.0]}]\n", "accepted in braces"),
        (HEAD + "channels = [{spec = 'erasure:p={level', levels = [1.0]}]\n", "channels.0: .*accepted in braces"),
        (HEAD + "channels = [{spec = 'erasure:p={level.foo}', levels = [1.0]}]\n", "channels.0: .*accepted in braces"),
        (HEAD + "channels = [{spec = 'erasure:p={level[x]}', levels = [1.0]}]\n", "channels.0: .*accepted in braces"),
        (HEAD + "channels = [{spec = 'erasure:p={level:%}', levels = [1.0]}]\n", "channels.0: .*accepted in braces"),
        (HEAD + "channels = [{spec = 'erasure:p={}', levels = [1.0]}]\n", "channels.0: .*accepted in braces"),
        (HEAD + "channels = ['erasure:p=0.1}']\n", "channels.0: .*accepted in braces"),
        (CLEAN + "[[features]]\ngap = 1\npieces = 2\n", "features.0: give at most one"),
        (CLEAN + "[[features]]\ngpa = 1\n", r"features.0.gpa is not a key; did you mean 'gap'\? accepted are .*gap"),
        (CLEAN + "[[wire]]\ndatagram = 7\n", "wire.0.datagram: "),
        (CLEAN + "[[codecs]]\ncodec = 'mp3'\nbudget = 99\n", "codecs.0: no codec is called 'mp3'"),
        (CLEAN + "[[codecs]]\ncodec = 'dct'\n", "codecs.0.budget is missing"),
        (CLEAN + "rounds = 2\n[[codecs]]\ncodec = 'dct'\nbudget = 99\n", "codecs are sent once"),
        (CLEAN + "grid = [1, 5]\n", "grid: .*2 to 4096"),
        (CLEAN + "name = '../up'\n", "name: "),
    ],
)
def test_a_mistake_is_one_line_that_names_the_key(tmp_path: Path, text: str, named: str) -> None:
    path = tmp_path / "plan.toml"
    path.write_text(text)
    with pytest.raises(ParameterError, match=named) as caught:
        Campaign.load(path)
    assert "\n" not in str(caught.value)


def test_a_campaign_that_is_too_large_is_refused() -> None:
    with pytest.raises(ParameterError, match="at most 1000000"):
        campaign(seeds=100_000, surfaces=["peaks"] * 10)


COSINES = {"codec": "dct", "budget": 600}


@pytest.mark.parametrize(
    "twice",
    [
        {"surfaces": ["peaks", "peaks"]},
        {"channels": ["clean", "clean"]},
        {"features": [{"pieces": 5}, {"pieces": 5}]},
        # Different, but one line of the tables, whose median would be of both.
        {"surfaces": [{"name": "peaks", "points": 100}, {"name": "peaks", "points": 400}]},
        {"surfaces": [{"name": "franke"}, {"field": "franke"}]},
        {"surfaces": [{"file": "a/bay.csv"}, {"file": "b/bay.csv"}]},
        {"channels": ["erasure:p=0.1", "erasure:p=0.10"]},
        {"channels": [{"spec": f"{kind}={{level}}", "levels": [0.1]} for kind in ("erasure:p", "gaussian:std")]},
        {"channels": [{"spec": "erasure:p={level}", "axis": "loss", "levels": [0.1, 0.2, 0.1]}]},
        {"codecs": [COSINES, COSINES | {"datagram": 64}], "channels": ["clean"]},
    ],
)
def test_what_stands_twice_is_refused(tmp_path: Path, twice: dict[str, object]) -> None:
    with pytest.raises(ParameterError, match="stands twice"):
        run_campaign(campaign(**twice), tmp_path, workers=1)


def test_levels_of_one_axis_may_be_of_several_tables() -> None:
    channels = [{"spec": "erasure:p={level}", "axis": "loss", "levels": [level]} for level in (0.1, 0.2)]
    assert campaign(channels=channels).size == 2 * 2 * 2


def test_a_missing_file_is_one_clear_error(tmp_path: Path) -> None:
    with pytest.raises(ParameterError, match="cannot read"):
        Campaign.load(tmp_path / "none.toml")


@pytest.mark.parametrize("kind", ["extrema", "lattice"])
def test_a_file_of_an_option_has_the_gap_that_the_sender_takes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    cloud = np.random.default_rng(0).random((300, 3))
    np.savetxt(tmp_path / "survey.csv", cloud, delimiter=",")
    monkeypatch.chdir(tmp_path)
    plan = campaign(
        **options_of(surface=["survey.csv"]), features=[{"kind": kind}], channels=["clean"], methods=["linear"], seeds=1
    )
    (row,) = rows_of(plan)
    expected = extract_features(cloud, gap=None, kind=kind)  # type: ignore[arg-type]
    assert (row["surface"], row["gap"], row["features"]) == ("survey.csv", expected.gap, len(expected))


def test_a_file_of_an_option_is_where_the_command_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "plans").mkdir()
    (tmp_path / "plans" / "plan.toml").write_text(CLEAN)
    (tmp_path / "survey.csv").write_text("0,0,1\n0,1,2\n1,0,3\n1,1,4\n")
    monkeypatch.chdir(tmp_path)
    plan = Campaign.load(Path("plans/plan.toml"), options_of(surface=["survey.csv"]))
    assert plan.surfaces[0].content


def test_a_file_of_an_option_that_is_not_there_is_said_to_be_missing() -> None:
    with pytest.raises(ParameterError, match=r"cannot read .*nosuch\.csv: No such file"):
        campaign(**options_of(surface=["nosuch.csv"]))


def test_options_go_before_the_file(tmp_path: Path) -> None:
    path = tmp_path / "plan.toml"
    path.write_text("surfaces = ['peaks']\nchannels = ['clean']\nseeds = 3\n")
    options = options_of(surface=["surface-1"], method=["cubic"], gap=0.5, seeds=7, grid="20x30", rounds=2)
    plan = Campaign.load(path, options)
    assert (plan.seeds, plan.grid, plan.rounds, plan.methods) == (7, (20, 30), 2, ("cubic",))
    assert plan.surfaces[0].name == "surface-1"
    assert plan.features[0].gap == 0.5
    assert plan.channels[0].spec == "clean"


@pytest.mark.parametrize(("text", "grid"), [("64", (64, 64)), ("64x48", (64, 48)), ("64,48", (64, 48))])
def test_a_grid_is_rows_and_columns_or_one_number_for_both(text: str, grid: tuple[int, int]) -> None:
    assert campaign(**options_of(grid=text)).grid == grid


@pytest.mark.parametrize("text", ["", "64x", "axb", "64x64x3", "-2x4"])
def test_a_grid_that_is_none_is_told_what_one_is(text: str) -> None:
    with pytest.raises(ParameterError, match="--grid is rows x columns, for example 64x48"):
        options_of(grid=text)


def test_options_say_how_files_are_read(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("Depth,a,b\n1,2,3\n4,5,7\n,6,6\n")
    plan = campaign(**options_of(surface=["peaks", str(tmp_path / "a.csv")], columns="a, b,depth", no_data="nan"))
    _, choice = plan.surfaces
    assert (choice.columns, choice.no_data) == (("a", "b", "depth"), "nan")
    assert notes_of(choice) == ("a.csv: 1 of 3 points have no height and are left out",)
    for wrong in ({"no_data": "nan"}, {"surface": ["peaks"], "columns": "0,1,2"}):
        with pytest.raises(ParameterError, match="--columns and --no-data go with a file"):
            options_of(**wrong)


def test_the_help_names_the_campaign_that_runs_without_a_file() -> None:
    words = " ".join(re.sub("[│╭╰─]", " ", CliRunner().invoke(app, ["sweep", "--help"]).output).split())
    for key, values in DEFAULT_PLAN.items():
        assert f"{key} {', '.join(values)}" in words


def test_a_folder_that_cannot_be_made_is_our_error(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ParameterError, match="cannot write to"):
        sweep_command(out=tmp_path / "file" / "out", fresh=True)


def test_the_table_reads_back_to_the_bit() -> None:
    rows = rows_of(campaign(seeds=1, channels=["erasure:p=1", "clean"]))
    read = csv.DictReader(to_csv(rows).splitlines())
    assert [
        {name: None if row[name] == "" else kind(row[name]) for name, kind in COLUMNS.items()} for row in read
    ] == rows


def test_parquet_holds_the_same_rows(tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet", reason="the extra parquet is not installed")
    rows = rows_of(campaign(surfaces=["surface-1"], seeds=1))
    (tmp_path / "t.parquet").write_bytes(to_parquet(rows))
    assert parquet.read_table(tmp_path / "t.parquet").to_pylist() == rows


def test_parquet_without_its_package_says_how_to_install_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'surfacelink\[parquet\]'"):
        to_parquet([])


def test_the_code_digest_is_stable() -> None:
    assert code_digest() == code_digest()
    assert len(code_digest()) == 8


@pytest.mark.parametrize("library", ["numpy", "scipy", "scikit-learn", "imagecodecs", "startinpy"])
def test_the_code_digest_stands_for_the_libraries_too(library: str, monkeypatch: pytest.MonkeyPatch) -> None:
    before = code_digest.__wrapped__()

    def newer(name: str) -> str:
        return "99" if name == library else metadata.version(name)

    monkeypatch.setattr("simulator.sweep.version", newer)
    assert code_digest.__wrapped__() != before


def test_a_trial_survives_the_way_into_a_worker() -> None:
    trial = campaign(seeds=1).trials()[0]
    assert Trial.model_validate(trial.model_dump()) == trial
    assert Run([trial], run_trial, 2).collect()[0].rows == run_trial(trial).rows


RASTER: dict[str, Any] = {
    "surfaces": [{"field": "peaks"}],
    "features": [{"pieces": 12}],
    "methods": ["linear"],
    "codecs": [{"codec": "dct", "protection": "rs223", "budget": 900}],
    "seeds": 1,
    "grid": [64, 64],
}


def test_a_raster_is_sent_beside_the_features_at_its_budget() -> None:
    features, raster = rows_of(campaign(**RASTER, channels=["clean"]))
    assert (features["method"], raster["method"]) == ("linear", "dct rs223")
    assert int(raster["bytes"] or 0) <= 900
    assert float(raster["nrmse"] or 1) < 0.05
    assert set(raster) == set(features) == set(COLUMNS)


def test_the_time_of_a_raster_is_left_empty(tmp_path: Path) -> None:
    for _ in range(2):  # the second time from the journal
        run_campaign(campaign(**RASTER, channels=["clean"]), tmp_path, workers=1)
        _, features, raster = (tmp_path / "seconds.csv").read_text().splitlines()
        assert float(features) > 0
        assert raster == ""


def test_a_raster_meets_a_harm_of_its_own_in_each_sample() -> None:
    sent = {"codec": "scattered_samples", "budget": 900, "datagram": 64}
    rows = rows_of(campaign(**RASTER | {"codecs": [sent], "seeds": 3}, channels=["erasure:p=0.3"]))
    assert len({row["nrmse"] for row in rows if row["method"] == "scattered_samples"}) == 3


def test_a_raster_is_lost_by_its_own_datagrams() -> None:
    sent = {"codec": "scattered_samples", "budget": 900, "datagram": 1400}
    plan = RASTER | {"codecs": [sent], "seeds": 8, "methods": ["nearest"], "features": [{"pieces": 4}]}
    whole, *_ = rows_of(campaign(**plan | {"seeds": 1}, channels=["clean"]))[1:]
    rows = rows_of(campaign(**plan, channels=["erasure:p=0.5"]))
    assert {row["nrmse"] for row in rows if row["method"] == "scattered_samples"} == {whole["nrmse"], None}


def test_a_raster_has_no_points_to_move() -> None:
    plan = campaign(**RASTER, channels=["gaussian:std=0.1,axes=z;erasure:p=0.1", "erasure:p=0.1"])
    assert [row["method"] for row in rows_of(plan)] == ["linear", "linear", "dct rs223"]
    assert plan.size == len(plan.trials()) == 3


def test_a_raster_that_cannot_be_decoded_is_a_failure() -> None:
    row = rows_of(campaign(**RASTER, channels=["erasure:p=1"]))[1]
    assert str(row["failure"]).startswith("decoding: ")
    assert row["nrmse"] is None


def test_a_lattice_is_the_senders() -> None:
    region = Region(0.0, 6.0, 0.0, 1.0)
    cloud = np.random.default_rng(0).random((400, 3)) * (6.0, 1.0, 1.0)
    chosen = choose_features(cloud, region, FeatureSettings(kind="lattice", pieces=12), WireOptions(), None)
    expected = extract_features(cloud, gap=0.5, kind="lattice", region=region)
    np.testing.assert_array_equal(chosen.points, expected.points)
    assert (chosen.kind, chosen.gap, chosen.region) == (expected.kind, expected.gap, expected.region)
