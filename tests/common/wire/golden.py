"""Messages and their bytes: what every implementation of the format must write and read.

docs/wire.md quotes these bytes. ``python -m tests.common.wire.golden`` prints them anew.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from common.surface import FeatureSet, Region, Units
from common.wire import WireOptions, encode

SQUARE = Region(-1.0, 1.0, -1.0, 1.0)


class Golden(NamedTuple):
    """A message, how it is sent, and the datagrams."""

    name: str
    features: FeatureSet
    transmission: str
    options: WireOptions
    datagrams: tuple[str, ...]


def _grid(rows: int, columns: int) -> FeatureSet:
    x, y = np.meshgrid(*SQUARE.axes((rows, columns)))
    return FeatureSet(np.column_stack([x.ravel(), y.ravel(), (x * y).ravel()]), SQUARE, None, "lattice")


_TWO = FeatureSet(np.array([[-1.0, -1.0, 0.25], [0.5, 1.0, 4.0]]), SQUARE, 0.4, "extrema", Units("m", "mm"))
_OUTSIDE = FeatureSet(np.array([[-1.5, 0.0, 1.0], [0.5, 0.25, -1.0]]), SQUARE)
_PIECES = FeatureSet(
    np.array(
        [
            [-0.9, -0.8, -1.0],
            [-0.1, -0.2, 1.0],
            [0.1, -0.9, -0.5],
            [0.9, -0.1, 0.5],
            [-0.9, 0.1, 0.0],
            [-0.2, 0.9, 2.0],
            [0.9, 0.9, 0.75],
            [0.1, 0.1, 0.125],
        ]
    ),
    SQUARE,
    1.0,
    "extrema",
)

GOLDEN = (
    Golden(
        "quantised",
        _TWO,
        "hills",
        WireOptions(),
        ("c72153120c00c74571013f413f41c108140c100910780000000000bfffffffff53280da1",),
    ),
    Golden(
        "float64",
        _TWO,
        "hills",
        WireOptions(precision="float64"),
        (
            "c74253100c00c74571013f413f41c10814000000000000f0bf000000000000f0bf000000000000d03f000000000000e03f00"
            "0000000000f03f00000000000010407804c4a3",
        ),
    ),
    Golden(
        "float32",
        _TWO,
        "hills",
        WireOptions(precision="float32"),
        ("c72a53110c00c74571013f413f41c10814000080bf000080bf0000803e0000003f0000803f00008040cf2cf7a4",),
    ),
    Golden(
        "11 and 9 bits, beyond the region",
        _OUTSIDE,
        "",
        WireOptions(precision=9, position_bits=11),
        ("c72253121100000000013f413f410b09095f50093f40093f40001003ff99a7f80096d3bfcf",),
    ),
    Golden(
        "compact",
        _PIECES,
        "hills",
        WireOptions(coding="compact"),
        ("c73253130400c74571013f413f41410710093f605d8d7b48554646a543d06fed7529293fff0aaafcf0769fe8a1eca7bbf7d0a05df3",),
    ),
    Golden(
        "lattice",
        _grid(3, 4),
        "hills",
        WireOptions(precision=8, min_packets=2),
        (
            "c71c53140200c74571023f413f418008093f400304ff55808000aab62387a3",
            "c71c53140201c74571023f413f418008093f400304aa00808055ffd17636f6",
        ),
    ),
    Golden(
        "compact lattice",
        _grid(12, 12),
        "hills",
        WireOptions(precision=12, coding="compact"),
        (
            "c7d353150200c74571013f413f41800c093f400c0c00c00257ffafff3ccd5dbb953d9e437e5093171e2dddfffd9c19cf7db9"
            "2fc44e1b5bcc09dc2d54f8681a12f4510cf9eb6586aeee13bb92664a9975aef00ea064aea7a21c669b81af4bf4fe2b2f666c"
            "281ff02b01113a9f6effd05cc539d2d7abef5e468aeb585ea6958166b024ce6a7337d37519fc4f43814b10acc2cdb487a6f1"
            "7bc52fbb6899a62f9ca6334767f11f0b2c18aec0ced7348ef3c5559156329f3304114e07a5f76813f3f39674f68f2f19f8d1"
            "c83a26a29d6c345f8d5562e4a047",
        ),
    ),
    Golden(
        "parity",
        _PIECES,
        "hills",
        WireOptions(parity=0.5, min_packets=2, precision=8, position_bits=8),
        (
            "c72253122400c7457102013f413f41410808093f600d19008c0d2a0d8c558c8c6028b7481e",
            "c72253122401c7457102013f413f41410808093f607366aaf2738066f2fff2f29571ba83e6",
            "c72853122402c7457102013f413f41410808093f60005af8d4229f29b9a124297b01248b2424bed6d46d06",
        ),
    ),
    Golden(
        "copies",
        _TWO,
        "hills",
        WireOptions(copies=2, precision=8, position_bits=8),
        (
            "c71d53120c00c74571013f413f41c108140808091078000000bffffff1b55888",
            "c71d53120c01c74571013f413f41c108140808091078000000bfffff6ac6b25c",
        ),
    ),
    Golden(
        "inner code",
        _TWO,
        "hills",
        WireOptions(inner=16),
        (
            "c7342c100021120c00c74571013f413f41c108140c100910780000000000bfffffffff53280da1d4a7761f9dadd63cbcf39f"
            "eda8ba3c19",
        ),
    ),
)


def written(golden: Golden) -> tuple[str, ...]:
    """The datagrams as they are written now, in hexadecimal."""
    datagrams = encode(golden.features, transmission=golden.transmission, options=golden.options)
    return tuple(datagram.hex() for datagram in datagrams)


if __name__ == "__main__":
    for golden in GOLDEN:
        print(golden.name, *written(golden), sep="\n  ")  # noqa: T201
