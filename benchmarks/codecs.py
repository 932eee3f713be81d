"""Codecs against the figures measured elsewhere for the elevation field: ``python -m benchmarks.codecs [--trials N]``.

Prints the fewest bytes for an NRMSE of 0.03 and of 0.01, and what bit errors and lost packets leave of the messages of
0.01, each beside the reference: share of decodes that gave nothing in %, and the median NRMSE of the others.
"""

from __future__ import annotations

import argparse

from rich.console import Console
from rich.table import Table

from common.channel import Channel
from simulator.codecs import CODECS, Sandbox, smallest
from simulator.codecs.survival import Survival, expose
from simulator.fields import field

BYTES = {
    "scattered_samples": (1470, 8094),
    "lattice_spline": (1013, 4467),
    "mesh": (1752, 7970),
    "dct": (753, 3680),
    "jpeg2000": (760, 3356),
    "sperr": (617, 3463),
    "sz3": (2343, 7180),
    "zfp": (12488, 18520),
    "lerc": (10391, 21327),
}
"""Fewest bytes of the reference for an NRMSE of 0.03 and 0.01."""

CHANNELS = (
    "bit_errors:ber=1e-5",
    "bit_errors:ber=1e-4",
    "bit_errors:ber=1e-3",
    "bit_errors:ber=1e-2",
    "erasure:p=0.01",
    "erasure:p=0.05",
    "erasure:p=0.1",
    "erasure:p=0.3",
)
HEADINGS = ("BER 1e-5", "1e-4", "1e-3", "1e-2", "loss 1 %", "5 %", "10 %", "30 %")

SURVIVAL = {
    ("scattered_samples", "none"): "0/.0098 0/.0099 0/.012 0/.026 0/.0098 0/.010 0/.012 7/.015",
    ("sperr", "none"): "0/.010 3/.024 3/.068 60/.24 0/.010 7/.013 0/.017 40/.022",
    ("jpeg2000", "none"): "0/.0099 3/.016 53/.080 100 0/.0099 7/.014 10/.016 30/.070",
    ("dct", "none"): "0/.010 3/.054 53/.73 97/.71 0/.010 7/.010 0/.039 37/.71",
    ("sz3", "none"): "0/.010 13/.045 100 100 20/.010 67/.010 93/.075 100",
    ("lerc", "none"): "77 100 100 100 63 97 100 100",
    ("jpeg2000", "rs223"): "- - - - - - - -",
    ("jpeg2000", "rs127"): "- - - - - - - -",
}
"""The reference's outcome in each of the channels, 30 trials; "-" where it gives none."""


def cell(survival: Survival) -> str:
    """Failures in % and the median of the rest."""
    median = f"/{survival.median:.4f}".replace("0.", ".") if survival.median is not None else ""
    return f"{100 * survival.failed:.0f}{median}"


def main() -> None:
    """Both tables."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.codecs",
        description="Codecs against the figures measured elsewhere for the elevation field.",
    )
    parser.add_argument("--trials", type=int, default=30, help="seeds of each channel (%(default)s)")
    trials = parser.parse_args().trials
    console = Console(width=160)
    z = field("elevation").z
    sizes = Table("codec", "bytes for 0.03", "reference", "bytes for 0.01", "reference", title="elevation, 256 x 256")
    messages = {}
    for name in CODECS:
        if name not in BYTES or not CODECS[name].available:
            continue
        loose, messages[name] = smallest(name, z, 0.03), smallest(name, z, 0.01)
        found = (len(loose.data), BYTES[name][0], len(messages[name].data), BYTES[name][1])
        sizes.add_row(name, *(f"{size:,}" for size in found))
    console.print(sizes)
    table = Table(
        "codec", "code", "bytes", "", *HEADINGS, title="elevation at 0.01: % without a surface / median NRMSE"
    )
    with Sandbox(workers=2) as box:
        for (name, protection), reference in SURVIVAL.items():
            if name not in messages:
                continue
            outcomes = [
                expose(z, messages[name], Channel.parse(text), range(trials), protection=protection, sandbox=box)
                for text in CHANNELS
            ]
            table.add_row(name, protection, f"{outcomes[0].sent:,}", "here", *map(cell, outcomes))
            table.add_row("", "", "", "reference", *reference.split(), style="dim")
    console.print(table)


if __name__ == "__main__":
    main()
