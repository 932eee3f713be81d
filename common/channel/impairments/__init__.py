"""The impairments there are, one a file. A new one is made known by adding it to `IMPAIRMENTS`."""

from __future__ import annotations

from common.channel.impairment import Impairment
from common.channel.impairments.awgn import Awgn
from common.channel.impairments.bias import Bias
from common.channel.impairments.bit_errors import BitErrors
from common.channel.impairments.clean import Clean
from common.channel.impairments.delay import Delay
from common.channel.impairments.duplication import Duplication
from common.channel.impairments.erasure import Erasure
from common.channel.impairments.gaussian import Gaussian
from common.channel.impairments.gilbert_elliott import GilbertElliott
from common.channel.impairments.impulse import Impulse
from common.channel.impairments.jitter import Jitter
from common.channel.impairments.rate import Rate
from common.channel.impairments.rayleigh import Rayleigh
from common.channel.impairments.reordering import Reordering
from common.channel.impairments.truncation import Truncation
from common.channel.impairments.uniform import Uniform

IMPAIRMENTS: tuple[type[Impairment], ...] = (
    Clean,
    Gaussian,
    Uniform,
    Impulse,
    Bias,
    BitErrors,
    Awgn,
    Rayleigh,
    Erasure,
    GilbertElliott,
    Duplication,
    Reordering,
    Truncation,
    Delay,
    Jitter,
    Rate,
)

REGISTRY: dict[str, type[Impairment]] = {model.model_fields["kind"].default: model for model in IMPAIRMENTS}
"""Impairments by kind."""

__all__ = ["IMPAIRMENTS", "REGISTRY"]
