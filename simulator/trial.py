"""One trial of a campaign: a cloud is sampled, its features are sent once, every method reconstructs what arrived.

All methods get the same harmed features. Every random draw follows from the trial: the cloud from (seed, surface,
sample), so that channels are compared on the same clouds; the harm from (seed, cell, sample), so that the k-th datagram
of all that is sent in a cell meets the same luck; a method's own draws from (seed, sample, method).
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Protocol

import numpy as np

from common.channel import Channel
from common.errors import ConflictError, LimitError, NotReadyError, ParameterError, SurfacelinkError
from common.metrics import max_error, nrmse, rmse
from common.surface import FeatureSet, FloatArray, HeightGrid, Region, as_points
from common.version import product_version
from common.wire import PacketDecoder, Reassembly, WireOptions, encode
from receiver.surfaces import MISSING_NAMED
from sender.features import linear_heights, merge_repeated
from sender.readers import read_points
from sender.surfaces import GriddedSurface, Surface, find_surface
from simulator.campaign import CodecSettings, FeatureSettings, SurfaceChoice, Trial
from simulator.choice import choose_features
from simulator.codecs import Message, best
from simulator.codecs.protection import find_protection
from simulator.codecs.survival import expose
from simulator.fields import field
from simulator.methods import Method, parse_method
from simulator.runner import Cell, Result, Row
from simulator.table import COLUMNS

FILE_NOISE = 0.05
"""Usual noise of a surface from a file, over its range of z."""


@dataclass(frozen=True)
class Arrived:
    """What a transmission cost and what came of it.

    Attributes
    ----------
    features : FeatureSet or None
        None where nothing usable arrived.
    packets, sent_bytes : int
        Put on the air, retransmissions included.
    received, damaged : int
        Different packets that arrived intact; packets that were found damaged, or contradicted others.
    grid : HeightGrid or None
        What the receiver's default network made of it, where a receiver was there.
    """

    features: FeatureSet | None
    packets: int
    sent_bytes: int
    received: int
    damaged: int
    grid: HeightGrid | None = None


class Transport(Protocol):
    """Carries features through a channel."""

    def __call__(
        self,
        features: FeatureSet,
        *,
        transmission: str,
        draws: str,
        channel: Channel,
        options: WireOptions,
        rounds: int,
        shape: tuple[int, int],
    ) -> Arrived:
        """Send `features` up to `rounds` times; `shape` (rows, columns) is that of the grid to compare on.

        The channel's draws follow from the name `draws`.
        """


def direct(
    features: FeatureSet,
    *,
    transmission: str,
    draws: str | None = None,
    channel: Channel,
    options: WireOptions,
    rounds: int = 1,
    shape: tuple[int, int] | None = None,  # noqa: ARG001 - a transport; who is handed the features trains the network
) -> Arrived:
    """Encoder, channel and decoder in this process, in virtual time; a transport that has no grid to give.

    The channel's draws follow from the transmission unless `draws` is given.
    """
    packets = encode(features, transmission=transmission, options=options)
    reassembly = Reassembly(transmission)
    sent = sent_bytes = damaged = 0
    outgoing = packets
    reference = None
    for attempt in range(rounds):
        delivery = channel.transmit(outgoing, transmission=draws or transmission, attempt=attempt, reference=reference)
        reference = delivery.reference
        sent, sent_bytes = sent + len(outgoing), sent_bytes + sum(map(len, outgoing))
        decoder = PacketDecoder()
        for packet in [*decoder.feed(delivery.body), *decoder.close()]:
            try:
                reassembly.add(packet)
            except (ConflictError, LimitError):
                damaged += 1
        damaged += decoder.damaged
        if reassembly.complete:
            break
        named = reassembly.missing[: max(MISSING_NAMED, reassembly.received)]  # as in a receipt
        outgoing = packets if reassembly.total is None else [packets[k] for k in named]
    try:
        arrived = reassembly.features()
    except NotReadyError:
        arrived = None
    return Arrived(arrived, sent, sent_bytes, reassembly.received, damaged)


@dataclass(frozen=True)
class Source:
    """Where clouds come from: a named surface, a field or a file.

    Attributes
    ----------
    region : Region
    noise : float
        Amplitude of the noise it is usually tried with, in the unit of z.
    points : int
        Of a cloud, unless features are chosen from another number.
    gap : float or None
        Segment gap, in the units of x and y; None where nothing says how large pieces should be.
    nodes : int or None
        Points there are in all; None where there is no end to them.
    truth : callable
        ``truth((rows, columns))``: the true heights on a grid.
    sample : callable
        ``sample(rng, n)``: a cloud of n points, shape (n, 3).
    """

    region: Region
    noise: float
    points: int
    gap: float | None
    nodes: int | None
    truth: Callable[[tuple[int, int]], HeightGrid]
    sample: Callable[[np.random.Generator, int], FloatArray]


@lru_cache(maxsize=16)
def source_of(choice: SurfaceChoice) -> Source:
    """The source of a campaign's surface; raises FileFormatError or PointsError for a file that is no surface."""
    source = _source(choice)
    gap = max(source.region.width, source.region.height) / choice.pieces if choice.pieces else source.gap
    return replace(source, points=choice.points or source.points, gap=gap)


def _source(choice: SurfaceChoice) -> Source:
    if choice.field is not None:
        name = choice.field
        nodes = GriddedSurface(name, name, lambda: field(name), pieces=1)
        return _of_surface(nodes, gap=None, nodes=nodes.points)
    if choice.file is None:
        surface = find_surface(str(choice.name))
        ends = isinstance(surface, GriddedSurface)
        return _of_surface(surface, gap=surface.gap, nodes=surface.points if ends else None)
    cloud = merge_repeated(read_points(choice.file, choice.columns, choice.no_data).points, "mean")
    region = Region.of(cloud)

    def truth(shape: tuple[int, int]) -> HeightGrid:
        x, y = region.axes(shape)
        z = linear_heights(cloud, region)(*np.meshgrid(x, y))
        return HeightGrid(x, y, z)

    def sample(rng: np.random.Generator, n: int) -> FloatArray:
        if n > len(cloud):
            raise ParameterError(f"{choice.label} holds {len(cloud)} points; {n} were asked for")
        return as_points(cloud[rng.permutation(len(cloud))[:n]])

    return Source(
        region=region,
        noise=FILE_NOISE * float(np.ptp(cloud[:, 2])),
        points=len(cloud),
        gap=None,
        nodes=len(cloud),
        truth=truth,
        sample=sample,
    )


def notes_of(choice: SurfaceChoice) -> tuple[str, ...]:
    """What is worth a word of how a surface's file is read; raises FileFormatError or PointsError."""
    return () if choice.file is None else read_points(choice.file, choice.columns, choice.no_data).notes


def _of_surface(surface: Surface, *, gap: float | None, nodes: int | None) -> Source:
    return Source(
        region=surface.region,
        noise=surface.noise,
        points=surface.points,
        gap=gap,
        nodes=nodes,
        truth=surface.grid,
        sample=surface.sample,
    )


@lru_cache(maxsize=64)
def _truth(choice: SurfaceChoice, shape: tuple[int, int]) -> HeightGrid:
    return source_of(choice).truth(shape)


def _generator(*parts: object) -> np.random.Generator:
    digest = hashlib.blake2b(repr(parts).encode(), digest_size=8).digest()
    return np.random.default_rng(int.from_bytes(digest, "little"))


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
        A row for each method. A method that fails has a row with its `failure`; a codec, and a network that a receiver
        trained, have no seconds.

    Raises
    ------
    SurfacelinkError
        If the trial itself cannot be run: the cloud is no surface, the gap does not fit, nothing fits the budget.
    """
    truth = _truth(trial.surface, trial.grid)
    extent = float(np.ptp(truth.z))
    noise = source_of(trial.surface).noise
    channel = Channel.parse(trial.channel.at(trial.level or 0.0, extent=extent, noise=noise), seed=trial.seed)
    common: dict[str, Cell] = dict.fromkeys(COLUMNS) | {
        "campaign": trial.campaign,
        "version": product_version(),
        "surface": trial.surface.label,
        "rounds": trial.rounds,
        "axis": trial.channel.axis,
        "level": trial.level,
        "channel": str(channel),
        "seed": trial.seed,
        "sample": trial.sample,
        "transmission": trial.transmission,
        "draws": trial.draws,
        "rows": trial.grid[0],
        "columns": trial.grid[1],
        "z_range": extent,
    }
    if trial.codec is not None:
        outcomes: list[tuple[Row, float | None]] = [(common | _codec_row(trial, trial.codec, truth, channel), None)]
    else:
        outcomes = list(_reconstructions(trial, common, truth, channel, transport, clock))
    return Result(tuple(row for row, _ in outcomes), tuple(seconds for _, seconds in outcomes))


@lru_cache(maxsize=64)
def _message(surface: SurfaceChoice, shape: tuple[int, int], codec: str, payload: int) -> Message:
    return best(codec, _truth(surface, shape).z, payload)


def _codec_row(trial: Trial, settings: CodecSettings, truth: HeightGrid, channel: Channel) -> dict[str, Cell]:
    """A raster codec on the same link, at the same bytes; damaged streams are decoded in a child process."""
    code = find_protection(settings.protection)
    message = _message(trial.surface, trial.grid, settings.codec, code.payload(settings.budget))
    survival = expose(
        truth.z,
        message,
        channel,
        [channel.seed],
        transmission=trial.draws,
        protection=settings.protection,
        datagram=settings.datagram,
    )
    (error,) = survival.errors
    row: dict[str, Cell] = {
        "sends": settings.label,
        "method": settings.method,
        "packets": -(-survival.sent // settings.datagram),
        "bytes": survival.sent,
    }
    if error is None:
        return row | {"failure": f"decoding: {', '.join(survival.failures)}"}
    return row | {"nrmse": error, "rmse": error * float(np.ptp(truth.z))}


@lru_cache(maxsize=256)
def _features(
    surface: SurfaceChoice, settings: FeatureSettings, wire: WireOptions, seed: int, sample: int
) -> FeatureSet:
    source = source_of(surface)
    cloud = _cloud(surface, settings.points, seed, sample)
    return choose_features(cloud, source.region, settings, wire, source.gap)


def _cloud(surface: SurfaceChoice, points: int | None, seed: int, sample: int) -> FloatArray:
    source = source_of(surface)
    n = points or source.points
    return source.sample(_generator(seed, "cloud", surface.label, n, sample), n)


def _reconstructions(
    trial: Trial,
    common: dict[str, Cell],
    truth: HeightGrid,
    channel: Channel,
    transport: Transport,
    clock: Callable[[], float],
) -> Iterator[tuple[Row, float | None]]:
    # What is sent depends neither on the channel nor on the methods: a sweep over channels chooses it once. A cloud of
    # all the points there are is the same in every sample.
    source = source_of(trial.surface)
    points = trial.features.points or source.points
    everything = points == source.nodes
    sent = _features(trial.surface, trial.features, trial.wire, trial.seed, 0 if everything else trial.sample)
    arrived = transport(
        sent,
        transmission=trial.transmission,
        draws=trial.draws,
        channel=channel,
        options=trial.wire,
        rounds=trial.rounds,
        shape=trial.grid,
    )
    common = common | {
        "points": points,
        "sends": trial.features.label,
        "kind": sent.kind,
        "gap": sent.gap,
        "wire": trial.wire.model_dump_json(exclude_defaults=True),
        "features": len(sent),
        "packets": arrived.packets,
        "bytes": arrived.sent_bytes,
        "packets_received": arrived.received,
        "packets_damaged": arrived.damaged,
        "features_received": None if arrived.features is None else len(arrived.features),
    }
    for text in trial.methods:
        method = parse_method(text)
        given = arrived.features
        if method.on_cloud:
            given = FeatureSet(_cloud(trial.surface, trial.features.points, trial.seed, trial.sample), sent.region)
        # A receiver's grid spans the region evenly; the nodes of a measured surface, thinned, need not.
        evenly = arrived.grid is not None and _same_nodes(arrived.grid, truth)
        grid = arrived.grid if method.is_default and not method.on_cloud and evenly else None
        if grid is not None:  # how long the receiver took is not known
            yield common | {"method": text} | _compared(truth, grid.z), None
            continue
        rng = _generator(trial.seed, "method", text, trial.sample)
        start = clock()
        errors = _errors(method, given, truth, rng)
        yield common | {"method": text} | errors, clock() - start


def _same_nodes(one: HeightGrid, other: HeightGrid) -> bool:
    return np.array_equal(one.x, other.x) and np.array_equal(one.y, other.y)


def _errors(method: Method, points: FeatureSet | None, truth: HeightGrid, rng: np.random.Generator) -> dict[str, Cell]:
    try:
        if points is None:
            raise NotReadyError("nothing arrived")
        return _compared(truth, method.heights(points, truth, rng))
    except (SurfacelinkError, np.linalg.LinAlgError) as error:
        # A method that breaks down loses its cell, not the campaign.
        return {"failure": f"{type(error).__name__}: {error}"}


def _compared(truth: HeightGrid, z: FloatArray) -> dict[str, Cell]:
    return {"rmse": rmse(truth.z, z), "nrmse": nrmse(truth.z, z), "max_error": max_error(truth.z, z)}
