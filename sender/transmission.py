"""One transmission from end to end of the sender: cloud, features, packets, receipt."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from common.errors import ParameterError
from common.messages import SurfaceId
from common.network.model import NetworkSettings
from common.surface import FeatureSet, Region, Unit, Units
from common.wire import Cost, WireOptions, encode_with_cost
from sender.client import ReceiverClient, Sent
from sender.features import Extracted, Repeated, extract_features
from sender.readers import Cloud, NoData, bare_name
from sender.surfaces import find_surface


class Order(BaseModel):
    """What to send, and how: the JSON body of ``POST /v1/transmissions``."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    surface: str | None = Field(None, description="A surface by name (see GET /v1/surfaces); none for an upload.")
    id: SurfaceId | None = Field(
        None, examples=["surface-1"], description="Id at the receiver; by default the name of the surface or the file."
    )
    points: int | None = Field(None, ge=1, description="Points of the cloud; by default as many as is usual for it.")
    seed: int = Field(0, ge=0, description="Seed the cloud is drawn from.")
    gap: float | None = Field(None, gt=0, description="Segment gap, in the units of x and y.")
    kind: Extracted = Field("extrema", description="Points to send: extrema of pieces, a lattice, or the whole cloud.")
    repeated: Repeated = Field("error", description="What to do with positions that carry more than one height.")
    columns: tuple[str, ...] | None = Field(
        None, description="The three columns of a file that are x, y, z: names, or numbers counted from 0."
    )
    no_data: NoData | None = Field(
        None, description="A file's height that stands for none; such points, and those without a height, are left out."
    )
    xy_unit: Unit = Field("", description="Unit of x and y of an upload.")
    z_unit: Unit = Field("", description="Unit of z of an upload.")
    rounds: int = Field(1, ge=1, le=100, description="1 sends once; more sends again what the receipt calls missing.")
    wire: WireOptions = Field(WireOptions(), description="Packets: size, precision, coding, protection.")
    network: NetworkSettings | None = Field(
        None,
        description="Settings of the network that the receiver trains; what is left out stays as it was last given for "
        "this id, at first the receiver's default.",
    )


OF_FILES = ("columns", "no_data", "xy_unit", "z_unit")
"""Settings of an order that say how a file is read."""


@dataclass(frozen=True)
class Prepared:
    """An order carried out up to the packets.

    Attributes
    ----------
    id : str
        Of the surface at the receiver.
    cloud : int
        Points of the cloud that the features were chosen from.
    features : FeatureSet
    packets : list of bytes
    cost : Cost
        Of one sending.
    notes : tuple of str
        What is worth a word of how a file was read.
    """

    id: str
    cloud: int
    features: FeatureSet
    packets: list[bytes]
    cost: Cost
    notes: tuple[str, ...]


def prepare(order: Order, upload: tuple[str, Callable[[], Cloud]] | None = None) -> Prepared:
    """Draw or read the cloud, keep its feature points, encode them.

    Parameters
    ----------
    order : Order
    upload : (name, read), optional
        Name of a file and a function that reads it; the alternative to ``order.surface``.

    Raises
    ------
    NotFoundError
        If there is no such surface.
    InputError
        If the cloud is no surface, or a setting does not fit it; and what `read` raises.
    LimitError
        If there are more points or packets than the wire accepts.
    """
    region: Region | None = None
    gap: float | None
    notes: tuple[str, ...] = ()
    if order.surface is not None and upload is None:
        idle = [key for key in OF_FILES if getattr(order, key) != Order.model_fields[key].default]
        if idle:
            raise ParameterError(f"{', '.join(idle)}: for a file of points alone; {order.surface} is a surface by name")
        surface = find_surface(order.surface)
        cloud = surface.sample(np.random.default_rng(order.seed), order.points)
        name, region, units, gap = surface.name, surface.region, surface.units, order.gap or surface.gap
    elif upload is not None and order.surface is None:
        name, read = upload
        file = read()
        cloud, notes, units = file.points, file.notes, Units(order.xy_unit, order.z_unit)
        if order.points is not None:
            if order.points > len(cloud):
                raise ParameterError(f"{name} holds {len(cloud)} points; {order.points} were asked for")
            cloud = np.random.default_rng(order.seed).permutation(cloud)[: order.points]
        gap = order.gap
    else:
        raise ParameterError("name a surface or give a file: one of the two")
    features = extract_features(cloud, gap=gap, kind=order.kind, region=region, repeated=order.repeated, units=units)
    transmission = order.id or transmission_id(name)
    packets, cost = encode_with_cost(features, transmission=transmission, options=order.wire)
    return Prepared(transmission, len(cloud), features, packets, cost, notes)


def transmission_id(name: str) -> str:
    """An id made of a surface's or a file's name without its endings: letters, digits, ".", "_" and "-" stay."""
    return re.sub(r"[^A-Za-z0-9._-]+", "-", bare_name(name))[:64].strip("-.") or "surface"


async def deliver(prepared: Prepared, order: Order, client: ReceiverClient) -> Sent:
    """Post the packets to the receiver, again where its receipt calls some missing (see `ReceiverClient.send`)."""
    return await client.send(prepared.packets, transmission=prepared.id, rounds=order.rounds, network=order.network)
