"""The report: self-contained, says who wins, counts failures."""

from __future__ import annotations

import io
import re
from html.parser import HTMLParser
from itertools import pairwise
from pathlib import Path

import pytest
from matplotlib.axis import Axis
from matplotlib.text import Text
from rich.console import Console

from simulator import report
from simulator.campaign import Campaign
from simulator.page import data_script, page, table
from simulator.runner import Row
from simulator.statistics import Quartiles
from simulator.sweep import MOST_COLUMNS, MOST_ROWS, medians_table
from simulator.table import COLUMNS

WORDS = report.Words("A <title>", "Lead & more.", "simulate sweep x.toml", {"peaks": "The note."})


def row(**known: object) -> Row:
    blank: dict[str, object] = dict.fromkeys(COLUMNS)
    defaults = {"surface": "peaks", "sends": "features", "axis": "noise", "points": 100, "features_received": 50}
    return blank | defaults | {"bytes": 300, "wire": "{}", "channel": "gaussian:std=1", "sample": 0} | known  # type: ignore[return-value]


def rows(network: float = 0.1, linear: float = 0.2, axis: str = "noise") -> list[Row]:
    return [
        row(method=method, level=level, sample=sample, axis=axis, nrmse=base * (1 + level) + 0.001 * sample)
        for method, base in (("network", network), ("linear", linear))
        for level in (0.01, 0.1)
        for sample in range(3)
    ]


def ticks(axis: Axis) -> list[tuple[float, Text]]:
    return list(zip(axis.get_majorticklocs(), axis.get_majorticklabels(), strict=True))


class References(HTMLParser):
    """Collects what a browser would load."""

    def __init__(self) -> None:
        super().__init__()
        self.loaded: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if name in {"src", "href", "xlink:href", "srcset", "data", "action"} and value:
                self.loaded.append(value)


def outside(html: str) -> list[str]:
    """References of a page that lead out of it."""
    parser = References()
    parser.feed(html)
    styles = re.findall(r"url\(([^)]*)\)|@import\s+(\S+)", html)
    found = [*parser.loaded, *(a or b for a, b in styles)]
    return [value for value in found if not value.strip("'\"").startswith(("data:", "#"))]


def test_the_page_loads_nothing() -> None:
    html = report.render(rows(), WORDS, [0.01] * 12)
    assert outside(html) == []
    assert "http" not in re.sub(r'xmlns(:\w+)?="http://www.w3.org/[^"]*"', "", html)


def test_the_same_rows_give_the_same_page() -> None:
    assert report.render(rows(), WORDS) == report.render(rows(), WORDS)


def test_one_of_a_kind_is_in_the_singular() -> None:
    html = report.render([row(surface="hills", method="network")], WORDS)
    assert "1 reconstruction: hills; 1 sample of each; 1 channel; 1 method; on a grid" in html


def test_a_file_keeps_its_name() -> None:
    html = report.render(
        [row(surface="Bay-North.csv", method=m, level=0.1, nrmse=1) for m in ("network", "cubic")], WORDS
    )
    assert "<th>Bay-North.csv</th>" in html
    assert "Bay north" not in html


def test_words_are_escaped() -> None:
    html = report.render(rows(), WORDS)
    assert "A &lt;title&gt;" in html
    assert "A <title>" not in html


def test_the_share_of_cells_won_is_counted() -> None:
    assert "2 of 2 cells with harm (100 %)" in report.render(rows(), WORDS)
    lost = report.render(rows(network=0.3), WORDS)
    assert "0 of 2 cells with harm (0 %)" in lost
    assert "The note." in lost


def test_a_clean_cell_does_not_count_as_harmed() -> None:
    clean = [
        row(method=m, level=0.0, axis="noise", nrmse=v, channel="clean") for m, v in (("network", 2), ("cubic", 1))
    ]
    assert "2 of 2 cells with harm (100 %)</b>, and in 0 of 1 without" in report.render([*rows(), *clean], WORDS)


@pytest.mark.parametrize(
    ("channel", "level", "harmful"),
    [
        ("clean", None, False),
        ("clean;seed=1", None, False),
        ("gaussian:std=0.0,axes=z", 0.0, False),
        ("gaussian:std=0.0,axes=z;erasure:p=0.1", 0.0, True),
        ("erasure:p=0.0;seed=3", 0.0, False),
        ("bit_errors:ber=0.1,probability=0", None, False),
        ("gilbert_elliott:p=0,r=0.5", 0.0, False),
        ("gilbert_elliott:p=0,r=0.5,k=0.9", 0.0, True),
        ("gilbert_elliott:p=0.1,r=0.5,k=0.9,probability=0", None, False),
        ("gilbert_elliott:p=0.1,r=0.5,h=1", None, False),
        ("awgn:ebn0_db=0.0", 0.0, True),
        ("gaussian:snr_db=0", 0.0, True),
        ("lora", None, True),
    ],
)
def test_harm_is_what_the_channel_does(channel: str, level: float | None, harmful: bool) -> None:
    cell = [row(method=m, level=level, nrmse=e, channel=channel) for m, e in (("network", 0.1), ("linear", 0.2))]
    assert [found.harmful for found in report.contests(cell)] == [harmful]
    sized = [row(method="network", level=level, bytes=b, nrmse=10 / b, channel=channel) for b in (100, 1000)]
    sized[1] |= {"sends": "features pieces=9"}  # type: ignore[operator]
    assert ("Distortion against bytes" in report.render(sized, WORDS)) != harmful


def test_one_line_stands_for_the_network() -> None:
    errors = {"network[spread=1]": (0.1, 0.4), "network": (0.3, 0.3), "linear": (0.2, 0.35), "cubic": (0.4, 0.5)}
    given = [
        row(method=method, level=level, nrmse=error)
        for method, of in errors.items()
        for level, error in zip((0.1, 0.2), of, strict=True)
    ]
    first, second = report.contests(given)
    assert first.own == second.own == "network"
    assert (first.winner, second.winner) == ("linear", "network")
    assert [cell.won_by("network[spread=1]") for cell in (first, second)] == [True, False]
    html = report.render(given, WORDS)
    assert "the one called \u201cnetwork\u201d alone is counted" in html
    assert "1 of 2 cells with harm (50 %)" in html
    won = dict(re.findall(r'<tr><td class="name">([^<]*)</td><td>(\d+)</td>', html))
    assert won == {"network[spread=1]": "1", "network": "1", "linear": "1", "cubic": "0"}


def test_a_tie_is_said_to_be_one() -> None:
    given = [
        row(method=method, level=level, nrmse=error)
        for level, of in ((0.1, (0.2, 0.1, 0.1)), (0.2, (0.3, 0.1, 0.2)), (0.3, (0.1, 0.1, 0.4)))
        for method, error in zip(("linear", "network", "network[spread=1]"), of, strict=True)
    ]
    cells = report.contests(given)
    assert [cell.winner for cell in cells] == ["network"] * 3
    assert [cell.tied("network") for cell in cells] == [True, False, True]
    html = report.render(given, WORDS)
    won = dict(re.findall(r'<tr><td class="name">([^<]*)</td><td>([^<]*)</td>', html))
    assert won == {
        "network": "3, 2 of them tied",
        "network[spread=1]": "2, 1 of them tied",
        "linear": "1, 1 of them tied",
    }
    assert "another line has the same median, and each is counted" in html
    assert "tied" not in report.render(given[3:6], WORDS)


def test_the_medians_are_told_on_the_terminal_where_they_are_few() -> None:
    given = rows()
    table = medians_table(given)
    assert table is not None
    console = Console(width=200, file=io.StringIO(), record=True)
    console.print(table)
    said = console.export_text()
    for line in report.cells_csv(given).splitlines()[1:]:
        surface, _, _, method, *_, median, _, _ = line.split(",")
        assert surface in said
        assert method in said
        assert f"{float(median):.3g}" in said
    assert table.row_count == len({(each["surface"], each["level"]) for each in given})
    assert medians_table([row(method="network", level=k / 100, nrmse=1.0) for k in range(MOST_ROWS + 1)]) is None


def test_lines_beyond_the_width_of_a_terminal_are_counted() -> None:
    table = medians_table([row(method=f"m{k}", level=0.1, nrmse=1.0 + k) for k in range(MOST_COLUMNS + 2)])
    assert table is not None
    assert len(table.columns) == 2 + MOST_COLUMNS
    assert "2 lines more are in cells.csv" in str(table.caption)


def test_a_cell_that_only_another_line_of_the_network_survives_is_lost() -> None:
    given = [
        row(method=m, level=0.1, nrmse=e) for m, e in (("network", None), ("network[spread=1]", 0.1), ("linear", None))
    ]
    (cell,) = report.contests(given)
    assert (cell.winner, cell.lost_by_all) == ("", False)
    assert "0 of 1 cells with harm" in report.render(given, WORDS)


def test_the_first_network_stands_for_it_where_none_has_the_usual_settings() -> None:
    given = [row(method=m, level=0.1, nrmse=e) for m, e in (("linear", 3), ("network[spread=2]", 2), ("network[a]", 1))]
    assert report.contests(given)[0].own == "network[spread=2]"


def test_the_network_does_not_win_against_itself() -> None:
    assert "Who wins where" not in report.render(
        [row(method="network", sends=sends, level=0.1, nrmse=0.1) for sends in ("features", "features pieces=9")], WORDS
    )


def test_a_cell_without_a_rival_is_none_that_the_network_wins() -> None:
    """A channel that moves points has no rasters, and a raster of so many bytes meets no features of another number."""
    sent = [row(method="network", channel=channel, nrmse=0.1) for channel in ("gaussian:std=1", "erasure:p=0.1")]
    raster, sized = (
        row(method="zfp", channel="erasure:p=0.1", nrmse=0.2, sends=s) for s in ("raster", "raster budget=9")
    )
    assert [cell.channel for cell in report.contests([*sent, raster])] == ["erasure:p=0.1"]
    assert report.contests([*sent, sized]) == []
    assert "Who wins where" not in report.render([*sent, sized], WORDS)


def test_a_method_on_the_clean_cloud_does_not_compete() -> None:
    cheat = [row(method="cubic@cloud", level=level, nrmse=1e-9) for level in (0.01, 0.1)]
    assert "2 of 2 cells" in report.render([*rows(), *cheat], WORDS)


@pytest.mark.parametrize("axis", [*report.AXES, "humidity"])
def test_every_axis_is_drawn_and_explained(axis: str) -> None:
    html = report.render(rows(axis=axis), WORDS)
    assert report.look_of(axis).label in html
    assert report.look_of(axis).sentence in html
    assert html.count("<svg") == 1


def test_the_axes_of_the_published_campaigns_are_known() -> None:
    campaigns = [Campaign.load(path) for path in (Path(__file__).parents[2] / "docs" / "campaigns").glob("*.toml")]
    assert campaigns
    assert {sweep.axis for plan in campaigns for sweep in plan.channels if sweep.levels} <= set(report.AXES)


def test_bytes_and_times_are_drawn_where_they_are_known() -> None:
    sized = [
        row(method="network", sends=f"features budget={b}", level=0.0, bytes=b, nrmse=10 / b, channel="clean")
        for b in (100, 1000)
    ]
    html = report.render(sized, WORDS, [0.1, 0.2])
    assert "Distortion against bytes" in html
    assert "Time against points" in html


def test_times_that_were_not_measured_are_not_drawn() -> None:
    timed = report.render(rows(), WORDS, [None] * 6 + [0.5] * 6)
    assert "Time against points" in timed
    assert "Time against points" not in report.render(rows(), WORDS, [None] * 12)
    assert report.draw_time(rows(), [None] * 12) is None


def test_bytes_are_compared_with_as_many_bytes_and_a_channel_with_itself() -> None:
    given = [
        row(method=m, sends=f"{s} budget={b}", axis="channel", level=None, channel=channel, nrmse=error)
        for m, s, errors in (("network", "features", (0.1, 0.01)), ("zfp", "raster", (0.2, 0.005)))
        for b, error in zip((100, 1000), errors, strict=True)
        for channel in ("clean", "lora")
    ]
    cells = report.contests(given)
    assert {(cell.channel, cell.budget, cell.winner) for cell in cells} == {
        (channel, budget, winner)
        for channel in ("clean", "lora")
        for budget, winner in (("100", "network"), ("1000", "zfp"))
    }
    html = report.render(given, WORDS)
    assert "1 of 2 cells with harm (50 %)" in html
    assert "and in 1 of 2 without" in html
    assert "lora, 1,000 bytes" in html


def test_no_cell_with_harm_is_said_plainly() -> None:
    html = report.render(
        [row(method=m, level=0.0, channel="clean", nrmse=e) for m, e in (("network", 0.1), ("linear", 0.2))], WORDS
    )
    assert "lowest median NRMSE in 1 of 1 cells without harm" in html


def test_what_fails_for_everyone_is_named_and_not_counted() -> None:
    nothing = [
        row(method=m, level=0.5, nrmse=None, failure="NotReadyError: nothing arrived") for m in ("network", "linear")
    ]
    html = report.render([*rows(), *nothing], WORDS)
    assert "2 of 2 cells with harm" in html
    assert "loses everything sent: Peaks noise 50 %" in html


def test_quartiles_come_with_the_median() -> None:
    assert Quartiles.of(range(9)) == Quartiles(4.0, 2.0, 6.0, 9, 0)


@pytest.mark.parametrize("least", [0.1, 0.003, 0.0003])
def test_values_can_be_read_at_labels_that_stand_apart(least: float) -> None:
    of = [(level, Quartiles(value, value, value, 1, 0)) for level, value in ((0.0, least), (0.2, 0.23))]
    curves = {name: {"network": of} for name in ("peaks", "franke", "surface-1")}
    figure = report.draw_curves(curves, report.look_of("noise"), ["network"])
    figure.set_dpi(72)
    figure.draw_without_rendering()
    for axes in figure.axes:
        low, high = axes.get_ylim()
        assert sum(bool(label.get_text()) and low <= tick <= high for tick, label in ticks(axes.yaxis)) >= 3
        left, right = axes.get_xlim()
        boxes = [label.get_window_extent() for tick, label in ticks(axes.xaxis) if left <= tick <= right]
        assert all(one.x1 + 4 < other.x0 for one, other in pairwise(boxes))


def test_a_failure_is_infinitely_bad() -> None:
    assert Quartiles.of([1.0, None, 3.0]) == Quartiles(3.0, 1.0, float("inf"), 3, 1)
    assert Quartiles.of([1.0, 2.0, None, None]).median == float("inf")
    assert Quartiles.of([1.0, 3.0]).median == 2.0


def test_a_line_names_what_is_sent_only_where_that_differs() -> None:
    two = [row(method="network", sends=s) for s in ("features", "features budget=9")] + [row(method="zfp", sends="zfp")]
    lines = report.Lines(two)
    assert [lines(r) for r in two] == ["network, features", "network, features budget=9", "zfp"]


def test_the_network_is_drawn_first_and_the_worst_are_left_out() -> None:
    many = [row(method=f"m{k}", level=0.1, nrmse=0.01 * (k + 1)) for k in range(20)]
    lines = report.choose_lines([*many, row(method="network", level=0.1, nrmse=9.0)])
    assert lines == ["network", *(f"m{k}" for k in range(7))]


def test_data_in_a_page_cannot_end_its_script() -> None:
    assert "</script><" not in data_script("x", {"a": "</script><b>"})


def test_tables_escape_text_and_pages_name_their_language() -> None:
    assert "&lt;b&gt;" in table(["<b>"], [["<b>"]])
    assert '<html lang="en">' in page("t", "")


def test_the_cells_are_medians_and_quartiles_over_the_samples() -> None:
    lines = report.cells_csv([row(method="network", level=0.1, sample=k, nrmse=n) for k, n in enumerate((1, 2, 9))])
    assert lines.splitlines()[1] == "peaks,noise,0.1,network,300,3,0,2,1,9"


def test_lines_that_neither_contest_nor_plot_shows_are_in_a_table() -> None:
    wires = [f'{{"parity":{k / 10}}}' for k in range(10)]
    one_channel = [
        row(method="network", level=None, axis="channel", wire=wire, sample=s, bytes=900 + k, nrmse=0.1 * (10 - k))
        for k, wire in enumerate(wires[:2])
        for s in range(3)
    ]
    failed = row(method="network", level=None, axis="channel", wire=wires[0], sample=3, failure="NotReadyError")
    html = report.render([*one_channel, failed], WORDS)
    assert "<h2>Distortion of every line</h2>" in html
    assert html.index("network, parity 0.1") < html.index("network, parity 0</td>")  # the best first
    assert re.search(
        r"gaussian:std=1</td>.*parity 0.1</td><td>0.9000</td><td>0.9000 to 0.9000</td><td></td><td>901</td>", html
    )
    assert "<td>1</td><td>900</td>" in html

    many = [row(method="network", level=x, wire=wire, nrmse=x) for wire in wires for x in (0.1, 0.2)]
    html = report.render(many, WORDS)
    assert html.index("<h2>Distortion of every line</h2>") < html.index("the table above has them all")

    drawn = report.render([each for each in many if each["wire"] in wires[:8]], WORDS)
    assert "every line" not in drawn
    assert "every line" not in report.render(rows(), WORDS)
