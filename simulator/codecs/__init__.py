"""What a user would send instead of feature points: codecs of raster heights, bare or under a Reed-Solomon code.

``best(codec, z, budget)`` is the finest message of at most so many bytes, ``smallest(codec, z, nrmse)`` the shortest
one that is close enough; `simulator.codecs.survival` sends them through a channel and counts what comes out. Bytes are
self-contained: shape, scale and parameters are in the message.

All of them presuppose a raster. Decoders of damaged bytes belong into a `Sandbox`: several of them crash.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from types import MappingProxyType

import numpy as np

from common.errors import NotFoundError, ParameterError, PointsError, hint
from common.extras import is_installed, require
from common.metrics import nrmse
from common.surface import BoolArray, FloatArray
from simulator.codecs import raster, samples
from simulator.codecs.message import MAX_NODES, Ladders, Setting
from simulator.codecs.protection import PROTECTIONS, Protection
from simulator.codecs.sandbox import Failure, Sandbox

__all__ = [
    "CODECS",
    "PROTECTIONS",
    "Codec",
    "Failure",
    "Message",
    "Protection",
    "Sandbox",
    "best",
    "decode",
    "find_codec",
    "smallest",
]


@dataclass(frozen=True, slots=True)
class Codec:
    """A way to write a grid of heights as bytes.

    Parameters
    ----------
    name, title, source : str
        Key of the registry; what it is, for a legend; where it is from.
    ladders : callable
        Settings from coarse to fine, in one or several families, for a shape (rows, columns).
    encode : callable
        (heights, setting) -> bytes.
    decode : callable
        (bytes, which of them are known to be lost) -> heights. Lost bytes are zeros.
    package : str
        Module that it needs, installed by the extra ``codecs``; "" for none.
    """

    name: str
    title: str
    source: str
    ladders: Callable[[tuple[int, int]], Ladders]
    encode: Callable[[FloatArray, Setting], bytes]
    decode: Callable[[bytes, BoolArray], FloatArray]
    package: str = ""

    @property
    def available(self) -> bool:
        """Whether what it needs is installed."""
        return is_installed(self.package)


@dataclass(frozen=True, slots=True)
class Message:
    """A grid as a codec writes it.

    Attributes
    ----------
    codec : str
    setting : Setting
    data : bytes
        Self-contained.
    nrmse : float
        Of what an undamaged message decodes to: RMSE over the range of the heights.
    """

    codec: str
    setting: Setting
    data: bytes
    nrmse: float


_ALL = (
    Codec(
        "dense_cloud",
        "the cloud itself, 3 x float32 a point",
        "triangulated at the receiver: Delaunay 1934",
        samples.cloud_ladders,
        samples.encode_cloud,
        samples.decode_cloud,
    ),
    Codec(
        "lattice_spline",
        "regular subsample, differences deflated, bicubic spline",
        "Dierckx 1993; scipy.interpolate.RectBivariateSpline",
        samples.lattice_ladders,
        samples.encode_lattice,
        samples.decode_lattice,
    ),
    Codec(
        "scattered_samples",
        "the same subsample, fixed width in scattered order, header three times, outlier filter",
        "interleaving against bursts; median filter: Tukey 1977; filling: Duchon 1976",
        samples.lattice_ladders,
        samples.encode_scattered,
        samples.decode_scattered,
    ),
    Codec(
        "mesh",
        "Delaunay mesh by greedy insertion, deflated",
        "Garland and Heckbert 1995; pydelatin",
        samples.mesh_ladders,
        samples.encode_mesh,
        samples.decode_mesh,
        package="pydelatin",
    ),
    Codec(
        "dct",
        "cosine transform, quantised, deflated",
        "Ahmed, Natarajan and Rao 1974; RFC 1951",
        raster.step_ladders,
        raster.encode_dct,
        raster.decode_dct,
    ),
    Codec(
        "jpeg2000",
        "JPEG 2000, irreversible",
        "ISO/IEC 15444-1; OpenJPEG",
        raster.quality_ladders,
        raster.encode_jpeg2000,
        raster.decode_jpeg2000,
        package="imagecodecs",
    ),
    Codec(
        "sperr",
        "SPERR",
        "Li, Lindstrom and Clyne 2023",
        raster.rate_ladders,
        raster.encode_sperr,
        raster.decode_sperr,
        package="imagecodecs",
    ),
    Codec(
        "zfp",
        "ZFP, fixed accuracy",
        "Lindstrom 2014",
        raster.error_ladders,
        raster.encode_zfp,
        raster.decode_zfp,
        package="imagecodecs",
    ),
    Codec(
        "sz3",
        "SZ3, bounded error",
        "Liang et al. 2023",
        raster.error_ladders,
        raster.encode_sz3,
        raster.decode_sz3,
        package="imagecodecs",
    ),
    Codec(
        "lerc",
        "LERC, bounded error, with Zstandard",
        "Esri, Limited Error Raster Compression",
        raster.error_ladders,
        raster.encode_lerc,
        raster.decode_lerc,
        package="imagecodecs",
    ),
)

CODECS: Mapping[str, Codec] = MappingProxyType({codec.name: codec for codec in _ALL})
"""Every codec by name; those whose `available` is false raise MissingExtraError when used."""


def find_codec(name: str) -> Codec:
    """The codec of that name; raises NotFoundError, or MissingExtraError where it is not installed."""
    if name not in CODECS:
        raise NotFoundError(f"no codec is called {name!r}{hint(name, CODECS)}")
    codec = CODECS[name]
    require(f"codec {name}", codec.package, "codecs")
    return codec


def decode(name: str, data: bytes, lost: BoolArray | None = None) -> FloatArray:
    """Heights (rows, columns) of a message.

    Parameters
    ----------
    name : str
        Key of `CODECS`.
    data : bytes
        The message; zeros stand for what is lost.
    lost : ndarray of bool, shape (len(data),), optional
        Which bytes are known to be lost.

    Raises
    ------
    PointsError
        If it decodes to heights that are not finite.
    Exception
        Whatever a decoder raises on damaged bytes; it may crash, too. See `Sandbox`.
    """
    codec = find_codec(name)
    heights = codec.decode(data, np.zeros(len(data), dtype=np.bool_) if lost is None else lost)
    if heights.ndim != 2 or not np.isfinite(heights).all():
        raise PointsError(f"codec {name} gave an array of shape {heights.shape} that is not finite heights")
    return heights


def _checked(z: FloatArray) -> FloatArray:
    heights = np.asarray(z, dtype=np.float64)
    if heights.ndim != 2 or min(heights.shape) < 8 or heights.size > MAX_NODES or not np.isfinite(heights).all():
        raise PointsError(f"codecs need finite heights of 8 x 8 to {MAX_NODES} nodes, got shape {heights.shape}")
    return heights


class _Encodings:
    """Encodings of one grid by one codec, each made once."""

    def __init__(self, codec: Codec, z: FloatArray) -> None:
        self.ladders = codec.ladders((z.shape[0], z.shape[1]))

        @cache
        def data(setting: Setting) -> bytes:
            return codec.encode(z, setting)

        @cache
        def message(setting: Setting) -> Message:
            return Message(codec.name, setting, data(setting), nrmse(z, decode(codec.name, data(setting))))

        self.data, self.message = data, message


def best(codec: str, z: FloatArray, budget: int) -> Message:
    """The message of at most `budget` bytes with the least error.

    Each family of settings is searched by bisection, as the bytes rise from coarse to fine; a codec whose bytes rise
    unevenly may have a better setting in between.

    Raises
    ------
    ParameterError
        If no setting gives so short a message.
    NotFoundError, MissingExtraError, PointsError
    """
    heights = _checked(z)
    encodings = _Encodings(find_codec(codec), heights)
    found: list[Message] = []
    least = len(encodings.data(encodings.ladders[0][0]))
    for ladder in encodings.ladders:
        fits = bisect_left(ladder, True, key=lambda setting: len(encodings.data(setting)) > budget)
        if fits > 0:
            found.append(encodings.message(ladder[fits - 1]))
    if not found:
        raise ParameterError(f"codec {codec} cannot write this grid in {budget} bytes; its coarsest takes {least}")
    return min(found, key=lambda message: (message.nrmse, len(message.data)))


def smallest(codec: str, z: FloatArray, target: float) -> Message:
    """The shortest message with an NRMSE of at most `target`; searched and raising as `best` does."""
    heights = _checked(z)
    encodings = _Encodings(find_codec(codec), heights)
    found: list[Message] = []
    for ladder in encodings.ladders:
        index = bisect_left(ladder, True, key=lambda setting: encodings.message(setting).nrmse <= target)
        if index < len(ladder):
            found.append(encodings.message(ladder[index]))
    if not found:
        raise ParameterError(f"codec {codec} does not reach an NRMSE of {target:g} on this grid")
    return min(found, key=lambda message: (len(message.data), message.nrmse))
