"""The channel against theory, and how fast it is: ``python -m benchmarks.channel``."""

from __future__ import annotations

import argparse
import math
import time

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.special import erfc

from common.channel import Channel
from common.surface import FeatureSet, Region
from common.wire import encode

DATAGRAM = 256
BITS = 8_000_000
POINTS = 1_000_000

SPEEDS = (
    "erasure:p=0.05",
    "gilbert_elliott:p=0.02,r=0.2",
    "bit_errors:ber=1e-4",
    "awgn:ebn0_db=8",
    "rayleigh:ebn0_db=20",
    "gaussian:std=0.1,axes=xyz",
    "gaussian:std=0.1,axes=xyz;erasure:p=0.05",
)


def awgn(ebn0_db: float) -> float:
    """Bit-error rate of BPSK and QPSK in white noise."""
    return 0.5 * float(erfc(math.sqrt(10 ** (ebn0_db / 10))))


def rayleigh(ebn0_db: float) -> float:
    """Bit-error rate of BPSK and QPSK in Rayleigh fading."""
    g = 10 ** (ebn0_db / 10)
    return (1 - math.sqrt(g / (1 + g))) / 2


def error_rate(text: str, packets: list[bytes]) -> float:
    """Share of the bits that arrive wrong."""
    delivery = Channel.parse(text, seed=1).transmit(packets, transmission="benchmark")
    return sum(fault.amount for fault in delivery.faults) / (8 * sum(map(len, packets)))


def bit_errors(console: Console) -> None:
    """Measured and theoretical bit-error rates."""
    rng = np.random.default_rng(0)
    packets = [rng.bytes(DATAGRAM) for _ in range(BITS // (8 * DATAGRAM))]
    table = Table(title=f"bit-error rate over {len(packets) * 8 * DATAGRAM:,} bits")
    for heading in ("Eb/N0 dB", "AWGN theory", "BPSK", "QPSK", "Rayleigh theory", "BPSK", "QPSK"):
        table.add_column(heading, justify="right")
    for ebn0_db in range(0, 11, 2):
        cells = [awgn(ebn0_db)]
        cells += [error_rate(f"awgn:ebn0_db={ebn0_db},modulation={name}", packets) for name in ("bpsk", "qpsk")]
        cells.append(rayleigh(ebn0_db))
        cells += [
            error_rate(f"rayleigh:ebn0_db={ebn0_db},coherence=1,modulation={name}", packets)
            for name in ("bpsk", "qpsk")
        ]
        table.add_row(str(ebn0_db), *(f"{cell:.3g}" for cell in cells))
    console.print(table)


def bursts(console: Console) -> None:
    """Measured and theoretical loss and burst length."""
    table = Table(title="Gilbert-Elliott over 100,000 packets, k = 1, h = 0")
    for heading in ("p", "r", "loss", "theory", "burst", "theory"):
        table.add_column(heading, justify="right")
    for p, r in ((0.01, 0.5), (0.02, 0.2), (0.1, 0.1)):
        gone = np.zeros(100_000)
        faults = (
            Channel.parse(f"gilbert_elliott:p={p},r={r}", seed=1).transmit([b""] * len(gone), transmission="b").faults
        )
        gone[[fault.packet for fault in faults]] = 1
        starts = np.count_nonzero(np.diff(gone, prepend=0) > 0)
        row = (p, r, gone.mean(), p / (p + r), gone.sum() / starts, 1 / r)
        table.add_row(*(f"{cell:.4g}" for cell in row))
    console.print(table)


def speed(console: Console) -> None:
    """CPU seconds for a transmission of a million points."""
    points = np.random.default_rng(0).uniform(-1, 1, (POINTS, 3))
    packets = encode(FeatureSet(points, Region(-1, 1, -1, 1)), transmission="benchmark")
    table = Table(title=f"{POINTS:,} points in {len(packets):,} packets")
    table.add_column("channel")
    table.add_column("CPU seconds", justify="right")
    for text in SPEEDS:
        start = time.process_time()
        Channel.parse(text).transmit(packets, transmission="benchmark")
        table.add_row(text, f"{time.process_time() - start:.2f}")
    console.print(table)


def main() -> None:
    """Print the three tables."""
    argparse.ArgumentParser(
        prog="python -m benchmarks.channel", description="The channel against theory, and how fast it is."
    ).parse_args()
    console = Console()
    bit_errors(console)
    bursts(console)
    speed(console)


if __name__ == "__main__":
    main()
