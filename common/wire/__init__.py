"""FeatureSet <-> packets <-> bytes, sans-IO. The format is specified in docs/wire.md."""

from common.wire.cost import Cost, cost, encode_with_cost
from common.wire.decoder import PacketDecoder
from common.wire.encoder import encode
from common.wire.framing import MEDIA_TYPE, MEDIA_TYPES, split
from common.wire.header import transmission_tag
from common.wire.options import WireOptions
from common.wire.packet import Packet, repack
from common.wire.reassembly import Arrival, Reassembly

__all__ = [
    "MEDIA_TYPE",
    "MEDIA_TYPES",
    "Arrival",
    "Cost",
    "Packet",
    "PacketDecoder",
    "Reassembly",
    "WireOptions",
    "cost",
    "encode",
    "encode_with_cost",
    "repack",
    "split",
    "transmission_tag",
]
