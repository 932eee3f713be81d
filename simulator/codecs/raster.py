"""Raster codecs: those of imagecodecs, and a plain transform codec.

`encode` takes heights (rows, columns) and a setting, `decode` the bytes and which of them are known to be lost. SPERR
and the transform codec are decoded up to the first of these; the others do as well, or better, with zeros in their
place. Their own headers stay where they are needed; shape and scale are in ours.
"""

from __future__ import annotations

import struct
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from scipy.fft import dctn, idctn

from common.errors import PacketError
from common.surface import BoolArray, FloatArray, IntArray
from simulator.codecs.message import (
    HEADER,
    Ladders,
    Setting,
    deflate,
    inflate,
    read_header,
    scaled,
    unbroken,
    write_header,
)

FINE = 1.02
"""Ratio between the settings of a ladder."""


def _ladder(coarse: float, fine: float) -> tuple[Setting, ...]:
    steps = int(abs(np.log(coarse / fine)) / np.log(FINE)) + 1
    return tuple((float(v),) for v in np.geomspace(coarse, fine, steps))


def error_ladders(shape: tuple[int, int]) -> Ladders:  # noqa: ARG001 - the same for every shape
    """Greatest errors over the range."""
    return (_ladder(1.0, 1e-6),)


def quality_ladders(shape: tuple[int, int]) -> Ladders:
    """JPEG 2000: peak signal-to-noise ratios in dB, and levels of the wavelet."""
    most = int(np.clip(np.log2(min(shape)) - 1, 1, 6))
    return tuple(
        tuple((float(v), float(levels)) for v in np.arange(5.0, 96.0, 0.1))
        for levels in range(max(1, most - 2), most + 1)
    )


def rate_ladders(shape: tuple[int, int]) -> Ladders:
    """SPERR: bits a node (mode 0), then peak signal-to-noise ratios (mode 1)."""
    rates = np.geomspace(64 / (shape[0] * shape[1]), 24.0, 600)
    return (
        tuple((0.0, float(v)) for v in rates),
        tuple((1.0, float(v)) for v in np.arange(10.0, 120.0, 0.2)),
    )


def step_ladders(shape: tuple[int, int]) -> Ladders:
    """Steps of the quantiser, and the dead zone."""
    widest = float(np.sqrt(shape[0] * shape[1]))
    return tuple(tuple((step, dead) for (step,) in _ladder(widest, 1e-4)) for dead in (0.5, 0.6))


def _float32(z: FloatArray) -> npt.NDArray[np.float32]:
    return np.ascontiguousarray(scaled(z), dtype=np.float32)


def encode_jpeg2000(z: FloatArray, setting: Setting) -> bytes:
    """The irreversible 9/7 wavelet on 16-bit heights, as a bare code stream."""
    import imagecodecs

    heights = np.rint(scaled(z) * 65535).astype(np.uint16)
    level: Any = setting[0]  # declared as int, taken as the float it is
    resolutions = int(setting[1])
    stream = imagecodecs.jpeg2k_encode(heights, level, codecformat="j2k", reversible=False, resolutions=resolutions)
    return write_header(z) + bytes(stream)


def decode_jpeg2000(data: bytes, lost: BoolArray) -> FloatArray:  # noqa: ARG001
    """OpenJPEG."""
    import imagecodecs

    header, stream = read_header(data)
    return header.heights(imagecodecs.jpeg2k_decode(stream) / 65535)


SPERR_LEAST = 28
"""Bytes of a stream below which the decoder crashes, but for whole ones."""


def encode_sperr(z: FloatArray, setting: Setting) -> bytes:
    """A given rate or a given peak signal-to-noise ratio."""
    import imagecodecs

    mode: Literal["psnr", "bpp"] = "psnr" if setting[0] else "bpp"
    return write_header(z) + bytes(imagecodecs.sperr_encode(_float32(z), setting[1], mode, header=False))


def decode_sperr(data: bytes, lost: BoolArray) -> FloatArray:
    """SPERR, of what stands before the first loss; it may crash on damaged bytes."""
    import imagecodecs

    header, stream = read_header(unbroken(data, lost, HEADER.size + SPERR_LEAST))
    return header.heights(imagecodecs.sperr_decode(stream, shape=header.shape, dtype=np.float32, header=False))


def encode_zfp(z: FloatArray, setting: Setting) -> bytes:
    """Fixed accuracy."""
    import imagecodecs

    level: Any = setting[0]  # declared as int, taken as the float it is
    return write_header(z) + bytes(imagecodecs.zfp_encode(_float32(z), level, mode="a", header=True))


def decode_zfp(data: bytes, lost: BoolArray) -> FloatArray:  # noqa: ARG001
    """ZFP; it may crash on damaged bytes."""
    import imagecodecs

    header, stream = read_header(data)
    return header.heights(imagecodecs.zfp_decode(stream))


def encode_sz3(z: FloatArray, setting: Setting) -> bytes:
    """Bounded absolute error."""
    import imagecodecs

    return write_header(z) + bytes(imagecodecs.sz3_encode(_float32(z), "abs", abs=setting[0]))


def decode_sz3(data: bytes, lost: BoolArray) -> FloatArray:  # noqa: ARG001
    """SZ3; it may crash on damaged bytes."""
    import imagecodecs

    header, stream = read_header(data)
    return header.heights(imagecodecs.sz3_decode(stream, header.shape, np.float32))


def encode_lerc(z: FloatArray, setting: Setting) -> bytes:
    """Bounded absolute error, then Zstandard."""
    import imagecodecs

    return write_header(z) + bytes(imagecodecs.zstd_encode(imagecodecs.lerc_encode(_float32(z), setting[0]), 19))


def decode_lerc(data: bytes, lost: BoolArray) -> FloatArray:  # noqa: ARG001
    """LERC; it carries a checksum of its own."""
    import imagecodecs

    header, stream = read_header(data)
    return header.heights(imagecodecs.lerc_decode(imagecodecs.zstd_decode(stream)))


def _frequencies(shape: tuple[int, int]) -> IntArray:
    """Coefficients by rising frequency."""
    rows, columns = np.indices(shape)
    return np.argsort((rows / shape[0]) ** 2 + (columns / shape[1]) ** 2, axis=None, kind="stable")


DCT = struct.Struct("<fI")
"""Step and count, between the header and the deflated coefficients."""


def encode_dct(z: FloatArray, setting: Setting) -> bytes:
    """A cosine transform of the whole grid, quantised, by rising frequency, deflated."""
    step, dead = setting
    coefficients = dctn(scaled(z), norm="ortho").ravel()[_frequencies(z.shape)]
    levels = (np.sign(coefficients) * np.floor(np.abs(coefficients) / step + 1 - dead)).astype(np.int64)
    levels = np.clip(levels, -(2**31) + 1, 2**31 - 1)
    count = int(np.flatnonzero(levels)[-1]) + 1 if np.any(levels) else 0
    folded = np.where(levels >= 0, 2 * levels, -2 * levels - 1)[:count]
    wide = folded >= 255
    body = np.where(wide, 255, folded).astype(np.uint8).tobytes() + folded[wide].astype("<u4").tobytes()
    return write_header(z) + DCT.pack(step, count) + deflate(body)


def decode_dct(data: bytes, lost: BoolArray) -> FloatArray:
    """The inverse, of what can be inflated before the first loss."""
    header, rest = read_header(unbroken(data, lost, HEADER.size + DCT.size))
    shape = header.shape
    if len(rest) < DCT.size:
        raise PacketError(f"the transform's step and count take {DCT.size} bytes, {len(rest)} are left")
    step, count = DCT.unpack_from(rest)
    size = shape[0] * shape[1]
    count = min(count, size)
    body = inflate(rest[DCT.size :], 5 * count)
    folded = np.frombuffer(body[:count], dtype=np.uint8).astype(np.int64)
    wide = np.flatnonzero(folded == 255)
    folded[wide] = np.frombuffer(body[count : count + 4 * len(wide)], dtype="<u4")
    levels = np.zeros(size)
    levels[_frequencies(shape)[:count]] = np.where(folded % 2, -(folded + 1) // 2, folded // 2)
    return header.heights(idctn(levels.reshape(shape) * step, norm="ortho"))
