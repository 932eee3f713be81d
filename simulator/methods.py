"""The reconstructions a campaign can name.

``network`` is the product's own, with settings in brackets where they are not the receiver's defaults, for example
``network[spread=0.3,smoothing=0]``; every other name is a baseline of `simulator.baselines`. ``@cloud`` behind a name
gives the method the whole clean cloud instead of the features that arrived: what the link would have to carry if
features did not suffice.
"""

from __future__ import annotations

import re
import warnings
from dataclasses import dataclass

import numpy as np
from pydantic import ValidationError

from common.errors import ParameterError, hint
from common.network import NetworkWarning
from common.network.model import NetworkSettings, SurfaceModel
from common.surface import FeatureSet, FloatArray, HeightGrid
from simulator.baselines import BASELINES, reconstruct

NETWORK = "network"

NAMES = tuple(dict.fromkeys((NETWORK, *BASELINES)))
"""Every method, the product's own first."""

ON_CLOUD = "@cloud"
"""Ends a method that is given the cloud."""

_METHOD = re.compile(rf"(?P<name>[^\[\]@]+)(\[(?P<settings>[^\[\]]*)\])?(?P<cloud>{ON_CLOUD})?")


@dataclass(frozen=True)
class Method:
    """A way to grow heights from points: `name` of a baseline, or "network" with its `settings`."""

    name: str
    settings: NetworkSettings
    on_cloud: bool

    @property
    def is_network(self) -> bool:
        """Whether it is the product's own network."""
        return self.name == NETWORK

    @property
    def is_default(self) -> bool:
        """Whether it is what a receiver does unless told otherwise."""
        return self.is_network and self.settings == NetworkSettings()

    def heights(self, features: FeatureSet, grid: HeightGrid, rng: np.random.Generator) -> FloatArray:
        """Heights at the nodes of `grid`, shape (rows, columns); raises SurfacelinkError where the method fails."""
        if self.is_network:
            with warnings.catch_warnings():
                # "Fitted, but not as asked": in a sweep of settings the errors in the table say how well.
                warnings.simplefilter("ignore", NetworkWarning)
                return SurfaceModel.train(features, self.settings).grid(grid.x, grid.y).z
        return reconstruct(self.name, features.points, grid.x, grid.y, rng)


def parse_method(text: str) -> Method:
    """The method that `text` names; raises ParameterError that says what is accepted."""
    match = _METHOD.fullmatch(text)
    if match is None or match["name"] not in NAMES:
        raise ParameterError(
            f"{text!r} is not a method{hint(match['name'] if match else text, NAMES)}, "
            "network[spread=0.3,smoothing=0], each also with @cloud"
        )
    if match["settings"] is not None and match["name"] != NETWORK:
        raise ParameterError(f"{text!r}: only network takes settings in brackets")
    pairs = [part.partition("=") for part in (match["settings"] or "").split(",") if part.strip()]
    try:
        settings = NetworkSettings.model_validate({key.strip(): _value(value) for key, _, value in pairs})
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        raise ParameterError(
            f"{text!r}: {first['loc'][0]}: {first['msg']}; accepted are {', '.join(NetworkSettings.model_fields)}"
        ) from error
    return Method(match["name"], settings, match["cloud"] is not None)


def _value(text: str) -> str | float:
    try:
        return float(text)
    except ValueError:
        return text.strip()
