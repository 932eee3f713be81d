"""Bytes, speed and safety of the wire: ``python -m benchmarks.wire [bytes speed flips hostile inner parity]``."""

from __future__ import annotations

import argparse
import time
import tracemalloc
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import numpy.typing as npt
import reedsolo
from rich.console import Console
from rich.table import Table

from common.errors import WireError
from common.surface import FeatureSet, Region
from common.wire import PacketDecoder, Reassembly, WireOptions, cost, encode
from common.wire.reedsolomon import correct
from common.wire.reedsolomon import encode as rs_encode
from sender.features import extract_features
from sender.surfaces import find_surface
from tests.common.wire.test_hostile import HOSTILE, receive

PAPER = ("surface-1", "surface-2", "surface-3")
SEEDS = 20
FLIPS = 1_000_000


def options(**choices: object) -> WireOptions:
    """Options by name."""
    return WireOptions.model_validate(choices)


def table(console: Console, title: str, headings: tuple[str, ...], rows: list[tuple[str, ...]]) -> None:
    """Print one."""
    out = Table(title=title)
    for i, heading in enumerate(headings):
        out.add_column(heading, justify="left" if not i else "right")
    for row in rows:
        out.add_row(*row)
    console.print(out)


def sizes(console: Console) -> None:
    """Bytes a point of the paper's features, all overhead included."""
    rows: list[tuple[str, ...]] = []
    for name in PAPER:
        surface = find_surface(name)
        sets = [
            extract_features(surface.sample(np.random.default_rng(seed)), gap=surface.gap, region=surface.region)
            for seed in range(SEEDS)
        ]
        for coding in ("plain", "compact"):
            costs = [cost(each, transmission=name, options=options(coding=coding)) for each in sets]
            each = sorted(c.bytes_per_point for c in costs)
            totals = sorted(c.total for c in costs)
            features, middle = f"{len(sets[0])}", SEEDS // 2
            rows.append((name, coding, features, f"{totals[middle]}", f"{each[middle]:.2f}", f"{each[-1]:.2f}"))
    headings = ("surface", "coding", "features", "bytes", "a point, median", "worst")
    table(console, f"bytes, 16-bit heights, datagrams of 256 bytes, {SEEDS} seeds", headings, rows)


def cloud(n: int) -> FeatureSet:
    """`n` random points of a smooth surface."""
    x, y = np.random.default_rng(0).uniform(-1, 1, (2, n))
    return FeatureSet(np.column_stack([x, y, np.sin(9 * x) * np.cos(7 * y)]), Region(-1.0, 1.0, -1.0, 1.0))


def speed(console: Console) -> None:
    """Millions of points a second, checksums included, best of three, one core."""
    rows: list[tuple[str, ...]] = []
    for n, name, chosen in (
        (1_000_000, "quantised", options()),
        (1_000_000, "quantised", options(datagram=1400)),
        (1_000_000, "float32", options(precision="float32", datagram=1400)),
        (1_000_000, "float64", options(precision="float64", datagram=1400)),
        (100_000, "quantised, parity 0.3", options(parity=0.3)),
        (100_000, "quantised, inner 64", options(inner=64)),
        (100_000, "compact", options(coding="compact")),
        (100_000, "compact", options(coding="compact", datagram=1400)),
    ):
        features = cloud(n)
        body = b"".join(encode(features, transmission="t", options=chosen))
        wrote = best(partial(encode, features, transmission="t", options=chosen))
        read = best(partial(received, body))
        each = f"{len(body) / n:.2f}"
        rows.append((name, f"{n:,}", f"{chosen.datagram}", each, f"{n / wrote / 1e6:.2f}", f"{n / read / 1e6:.2f}"))
    headings = ("form", "points", "datagram", "bytes a point", "encode, 10^6/s", "decode and reassemble, 10^6/s")
    table(console, "speed", headings, rows)


def received(body: bytes) -> FeatureSet:
    """The features in a body."""
    decoder, reassembly = PacketDecoder(), Reassembly("t")
    for packet in decoder.feed(body) + decoder.close():
        reassembly.add(packet)
    return reassembly.features()


def best(call: Callable[[], object], times: int = 3) -> float:
    """CPU seconds of the fastest of some calls: what one core needs, however busy the machine is."""
    seconds = []
    for _ in range(times):
        start = time.process_time()
        call()
        seconds.append(time.process_time() - start)
    return min(seconds)


def flips(console: Console) -> None:
    """Damaged packets among a million that a decoder accepts."""
    rows: list[tuple[str, ...]] = []
    rng = np.random.default_rng(3)
    choices = {"quantised": options(), "float64": options(precision="float64"), "compact": options(coding="compact")}
    for name, chosen in choices.items():
        for count in (1, 2):
            datagram = np.frombuffer(encode(cloud(40), transmission="t", options=chosen)[0], dtype=np.uint8)
            accepted = tried = 0
            while tried < FLIPS // 6:
                places = rng.integers(0, 8 * datagram.size, (4000, count))
                places = places[np.ptp(places, axis=1) > 0] if count > 1 else places
                bodies = np.repeat(datagram[None], len(places), axis=0)
                for column in places.T:
                    bodies[np.arange(len(places)), column // 8] ^= (128 >> column % 8).astype(np.uint8)
                decoder = PacketDecoder()
                accepted += len(decoder.feed(bodies.tobytes()) + decoder.close())
                tried += len(places)
            rows.append((name, f"{count}", f"{tried:,}", f"{accepted}"))
    table(console, "damaged packets", ("form", "bits flipped", "packets", "accepted"), rows)


def hostile(console: Console) -> None:
    """Seconds and memory of a megabyte of each hostile body."""
    rows: list[tuple[str, ...]] = []
    for name, make in HOSTILE.items():
        body = make()
        start = time.process_time()
        ended = outcome(body)
        seconds = time.process_time() - start
        tracemalloc.start()
        outcome(body)
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        rows.append((name, f"{len(body):,}", f"{seconds:.2f}", f"{peak / 1e6:.0f}", ended))
    table(console, "hostile bodies", ("body", "bytes", "CPU seconds", "peak MB", "ends in"), rows)


def outcome(body: bytes) -> str:
    """What becomes of a body."""
    try:
        known, damaged = receive(body)
    except WireError as error:
        return type(error).__name__
    return f"{known} packets, {damaged} damaged"


def flip(body: bytes, rate: float, rng: np.random.Generator) -> bytes:
    """The body with each bit wrong at the rate."""
    bits: npt.NDArray[np.uint8] = np.unpackbits(np.frombuffer(body, dtype=np.uint8))
    return np.packbits(bits ^ (rng.random(bits.size) < rate)).tobytes()


def inner(console: Console) -> None:
    """Packets that arrive through bit errors, and the code's speed beside another library's."""
    features, rng = cloud(1500), np.random.default_rng(4)
    rows: list[tuple[str, ...]] = []
    for strength in (0, 16, 32, 64, 128):
        datagrams = encode(features, transmission="t", options=options(inner=strength))
        body, cells = b"".join(datagrams), []
        for rate in (1e-4, 1e-3, 3e-3, 1e-2, 2e-2):
            found = 0
            for _ in range(5):
                decoder = PacketDecoder()
                found += len(decoder.feed(flip(body, rate, rng)) + decoder.close())
            cells.append(f"{100 * found / 5 / len(datagrams):.1f}")
        share = cost(features, transmission="t", options=options(inner=strength)).protection / len(body)
        rows.append((f"{strength}", f"{100 * share:.0f}", *cells))
    headings = ("parity bytes", "% of all bytes", "BER 1e-4", "1e-3", "3e-3", "1e-2", "2e-2")
    table(console, "inner code: % of the packets that arrive", headings, rows)
    rows = []
    for parity in (16, 64):
        data = rng.integers(0, 256, (1000, 255 - parity), dtype=np.uint8)
        words = np.concatenate([data, rs_encode(data, parity)], axis=1)
        for word in words:
            word[rng.choice(255, parity // 4, replace=False)] ^= 0x55
        ours = best(partial(correct, words, parity)) / len(words)
        codec = reedsolo.RSCodec(parity)
        theirs = best(partial(decode_all, codec, [word.tobytes() for word in words[:20]])) / 20
        rows.append((f"{parity}", f"{1e3 * ours:.2f}", f"{1e3 * theirs:.2f}", f"{theirs / ours:.0f}"))
    table(console, "correcting a word of 255 bytes", ("parity", "ms", "reedsolo, ms", "ratio"), rows)


def decode_all(codec: reedsolo.RSCodec, words: Sequence[bytes]) -> None:
    """Correct words one by one."""
    for word in words:
        codec.decode(word)


def parity(console: Console) -> None:
    """Points that are there after losses, with and without parity."""
    features, rng = cloud(400), np.random.default_rng(5)
    rows: list[tuple[str, ...]] = []
    for share in (0.0, 0.1, 0.3, 0.5):
        datagrams = encode(features, transmission="t", options=options(parity=share, datagram=128))
        cells = []
        for loss in (0.05, 0.1, 0.2, 0.3, 0.5):
            points = []
            for _ in range(50):
                kept = [datagram for datagram in datagrams if rng.random() >= loss]
                points.append(len(received(b"".join(kept))) / len(features) if kept else 0.0)
            cells.append(f"{100 * float(np.mean(points)):.1f}")
        rows.append((f"{share:g}", f"{sum(map(len, datagrams)):,}", *cells))
    headings = ("parity", "bytes", "loss 5 %", "10 %", "20 %", "30 %", "50 %")
    table(console, "400 points in datagrams of 128 bytes: % of the points that are there", headings, rows)


SECTIONS: dict[str, Callable[[Console], None]] = {
    "bytes": sizes,
    "speed": speed,
    "flips": flips,
    "hostile": hostile,
    "inner": inner,
    "parity": parity,
}


def main() -> None:
    """Run the sections named on the command line, or all."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.wire", description="Bytes, speed and safety of the wire."
    )
    parser.add_argument("section", nargs="*", help=f"of {', '.join(SECTIONS)}; all by default")
    sections = parser.parse_args().section or list(SECTIONS)
    if not SECTIONS.keys() >= set(sections):
        parser.error(f"a section is one of {', '.join(SECTIONS)}")
    console = Console()
    for name in sections:
        SECTIONS[name](console)


if __name__ == "__main__":
    main()
