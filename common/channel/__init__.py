"""The channel between sender and receiver: pure functions of datagrams and a seed.

>>> from common.channel import Channel
>>> Channel.parse("erasure:p=1").transmit([b"any", b"bytes"], transmission="t").packets
()
"""

from common.channel.channel import Channel, Delivery
from common.channel.impairment import Impairment, PointImpairment
from common.channel.impairments import IMPAIRMENTS, REGISTRY
from common.channel.passage import Fault, Reference
from common.channel.profiles import PROFILES, Profile

__all__ = [
    "IMPAIRMENTS",
    "PROFILES",
    "REGISTRY",
    "Channel",
    "Delivery",
    "Fault",
    "Impairment",
    "PointImpairment",
    "Profile",
    "Reference",
]
