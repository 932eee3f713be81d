"""One trial of a campaign: a cloud is sampled, its features are sent once, every method reconstructs what arrived.

All methods get the same harmed features. Every random draw follows from the trial: the cloud from (seed, surface,
sample), so that channels are compared on the same clouds; the harm from (seed, transmission); a method's own draws
from (seed, sample, method).
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from typing import Protocol

import numpy as np
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator

from common.channel import Channel
from common.errors import ConflictError, LimitError, NotReadyError, ParameterError, SurfacelinkError
from common.metrics import max_error, nrmse, rmse
from common.surface import FeatureSet, FloatArray, HeightGrid, Region, as_points
from common.wire import PacketDecoder, Reassembly, WireOptions, encode
from sender.features import extract_features, merge_repeated
from sender.readers import read_points
from sender.surfaces import find_surface
from simulator.campaign import FeatureSettings, SurfaceChoice, Trial
from simulator.methods import Method, parse_method
from simulator.runner import Cell, Result, Row

FILE_NOISE = 0.05
"""Usual noise of a surface from a file, over its range of z."""


@dataclass(frozen=True)
class Arrived:
    """What a transmission cost and what came of it; `features` is None where nothing usable arrived."""

    features: FeatureSet | None
    packets: int
    sent_bytes: int
    received: int
    damaged: int


class Transport(Protocol):
    """Carries features through a channel."""

    def __call__(
        self, features: FeatureSet, *, transmission: str, channel: Channel, options: WireOptions, rounds: int
    ) -> Arrived: ...


def direct(features: FeatureSet, *, transmission: str, channel: Channel, options: WireOptions, rounds: int) -> Arrived:
    """Encoder, channel and decoder in this process, in virtual time."""
    packets = encode(features, transmission=transmission, options=options)
    reassembly = Reassembly(transmission)
    sent = sent_bytes = damaged = 0
    outgoing = packets
    for attempt in range(rounds):
        delivery = channel.transmit(outgoing, transmission=transmission, attempt=attempt)
        sent, sent_bytes = sent + len(outgoing), sent_bytes + sum(map(len, outgoing))
        decoder = PacketDecoder()
        for packet in [*decoder.feed(b"".join(delivery.packets)), *decoder.close()]:
            try:
                reassembly.add(packet)
            except (ConflictError, LimitError):
                damaged += 1
        damaged += decoder.damaged
        if reassembly.complete:
            break
        outgoing = packets if reassembly.total is None else [packets[k] for k in reassembly.missing]
    try:
        arrived = reassembly.features()
    except NotReadyError:
        arrived = None
    return Arrived(arrived, sent, sent_bytes, reassembly.received, damaged)


@dataclass(frozen=True)
class Source:
    """Where clouds come from: a named surface or a file."""

    region: Region
    noise: float
    points: int
    gap: float | None
    truth: Callable[[tuple[int, int]], HeightGrid]
    sample: Callable[[np.random.Generator, int], FloatArray]


@lru_cache(maxsize=16)
def source_of(choice: SurfaceChoice) -> Source:
    """The source of a campaign's surface; raises FileFormatError or PointsError for a file that is no surface."""
    if choice.file is None:
        surface = find_surface(str(choice.name))
        return Source(surface.region, surface.noise, surface.points, surface.gap, surface.grid, surface.sample)
    cloud = merge_repeated(read_points(choice.file, choice.columns), "mean")
    region = Region.of(cloud)

    def truth(shape: tuple[int, int]) -> HeightGrid:
        x, y = region.axes(shape)
        at = np.stack(np.meshgrid(x, y), axis=-1)
        z = LinearNDInterpolator(cloud[:, :2], cloud[:, 2])(at)
        beyond = np.isnan(z)
        z[beyond] = NearestNDInterpolator(cloud[:, :2], cloud[:, 2])(at[beyond])
        return HeightGrid(x, y, z)

    def sample(rng: np.random.Generator, n: int) -> FloatArray:
        if n > len(cloud):
            raise ParameterError(f"{choice.label} holds {len(cloud)} points; {n} were asked for")
        return as_points(cloud[rng.permutation(len(cloud))[:n]])

    return Source(region, FILE_NOISE * float(np.ptp(cloud[:, 2])), len(cloud), None, truth, sample)


@lru_cache(maxsize=64)
def _truth(choice: SurfaceChoice, shape: tuple[int, int]) -> HeightGrid:
    return source_of(choice).truth(shape)


def _number(*parts: object) -> int:
    return int.from_bytes(hashlib.blake2b(repr(parts).encode(), digest_size=8).digest(), "little")


def _generator(*parts: object) -> np.random.Generator:
    return np.random.default_rng(_number(*parts))


def choose_features(cloud: FloatArray, source: Source, settings: FeatureSettings, wire: WireOptions) -> FeatureSet:
    """The features of a cloud as a campaign asks for them.

    Raises
    ------
    ParameterError
        If neither the settings nor the source say how large the pieces are, or nothing fits into the budget.
    """
    longer = max(source.region.width, source.region.height)

    def extract(gap: float) -> FeatureSet:
        return extract_features(cloud, gap=gap, kind=settings.kind, region=source.region)

    if settings.budget is not None:
        return _finest(lambda pieces: extract(longer / pieces), len(cloud), settings.budget, wire)
    gap = longer / settings.pieces if settings.pieces is not None else settings.gap or source.gap
    if gap is None:
        raise ParameterError("features of a file need gap, pieces or budget")
    return extract(gap)


def _finest(extract: Callable[[int], FeatureSet], points: int, budget: int, wire: WireOptions) -> FeatureSet:
    """The features of the most pieces along the longer side whose packets fit into `budget` bytes."""

    def fits(pieces: int) -> bool:
        packets = encode(extract(pieces), transmission="budget", options=wire)
        return sum(map(len, packets)) <= budget

    # Beyond two pieces a point along each side every point is a feature, and more pieces change nothing.
    low, high = 0, 2 * int(np.ceil(np.sqrt(points))) + 1
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if fits(middle) else (low, middle)
    if not low:
        raise ParameterError(f"not even the features of a single piece fit into {budget} bytes")
    return extract(low)


def product_version() -> str:
    """Version of the installed distribution, or "source" for a checkout that is not installed."""
    try:
        return version("surfacelink")
    except PackageNotFoundError:
        return "source"


def run_trial(trial: Trial, *, transport: Transport = direct, clock: Callable[[], float] = time.perf_counter) -> Result:
    """Run one trial.

    Parameters
    ----------
    trial : Trial
    transport : Transport
        What carries the features.
    clock : function of no arguments
        Seconds, for the time that each reconstruction takes.

    Returns
    -------
    Result
        A row for each method. A method that fails has a row with its `failure`.

    Raises
    ------
    SurfacelinkError
        If the trial itself cannot be run: the cloud is no surface, the gap does not fit, nothing fits the budget.
    """
    source = source_of(trial.surface)
    truth = _truth(trial.surface, trial.grid)
    extent = float(np.ptp(truth.z))
    points = trial.features.points or source.points
    cloud = source.sample(_generator(trial.seed, "cloud", trial.surface.label, points, trial.sample), points)
    sent = choose_features(cloud, source, trial.features, trial.wire)
    spec = trial.channel.at(trial.level or 0.0, extent=extent, noise=source.noise)
    transmission = f"{trial.campaign}-{trial.digest}-{trial.sample}"
    channel = Channel.parse(spec, seed=trial.seed)
    arrived = transport(sent, transmission=transmission, channel=channel, options=trial.wire, rounds=trial.rounds)
    common: dict[str, Cell] = {
        "campaign": trial.campaign,
        "version": product_version(),
        "surface": trial.surface.label,
        "points": points,
        "sends": trial.features.label,
        "kind": sent.kind,
        "gap": sent.gap,
        "wire": trial.wire.model_dump_json(exclude_defaults=True),
        "rounds": trial.rounds,
        "axis": trial.channel.axis,
        "level": trial.level,
        "channel": str(channel),
        "seed": trial.seed,
        "sample": trial.sample,
        "transmission": transmission,
        "rows": trial.grid[0],
        "columns": trial.grid[1],
        "features": len(sent),
        "packets": arrived.packets,
        "bytes": arrived.sent_bytes,
        "packets_received": arrived.received,
        "packets_damaged": arrived.damaged,
        "features_received": None if arrived.features is None else len(arrived.features),
        "z_range": extent,
    }
    whole = FeatureSet(cloud, source.region)
    outcomes = list(_reconstructions(trial, arrived.features, whole, truth, clock))
    return Result(tuple({**common, **row} for row, _ in outcomes), tuple(seconds for _, seconds in outcomes))


def _reconstructions(
    trial: Trial, arrived: FeatureSet | None, cloud: FeatureSet, truth: HeightGrid, clock: Callable[[], float]
) -> Iterator[tuple[Row, float]]:
    for text in trial.methods:
        method = parse_method(text)
        rng = _generator(trial.seed, "method", text, trial.sample)
        start = clock()
        errors = _errors(method, cloud if method.on_cloud else arrived, truth, rng)
        yield {"method": text, **errors}, clock() - start


def _errors(method: Method, points: FeatureSet | None, truth: HeightGrid, rng: np.random.Generator) -> dict[str, Cell]:
    try:
        if points is None:
            raise NotReadyError("nothing arrived")
        z = method.heights(points, truth, rng)
        return {
            "rmse": rmse(truth.z, z),
            "nrmse": nrmse(truth.z, z),
            "max_error": max_error(truth.z, z),
            "failure": None,
        }
    except SurfacelinkError as error:
        return {"rmse": None, "nrmse": None, "max_error": None, "failure": f"{type(error).__name__}: {error.detail}"}
