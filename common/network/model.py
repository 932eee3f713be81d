"""The network of a feature set, in the surface's own terms."""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field

from common.network.estimator import Callback, RBFNetwork
from common.surface import FeatureSet, FloatArray, HeightGrid, Region, Units

PositiveNumber = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NumberFromZero = Annotated[float, Field(ge=0, allow_inf_nan=False)]
CountFromOne = Annotated[int, Field(ge=1)]


class NetworkSettings(BaseModel):
    """How a receiver trains. Bounds stand at the fields."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    spread: Literal["auto", "paper"] | PositiveNumber = Field(
        "auto",
        description="Spread of the neurons in the units of x and y; auto: from the data; paper: its rule of thumb.",
    )
    smoothing: Literal["auto"] | NumberFromZero = Field(
        "auto", description="Noise variance over that of the surface; auto."
    )
    tolerance: NumberFromZero = Field(0.0, description="Error at the points, in the units of z.")
    max_centers: Literal["all"] | CountFromOne = Field("all", description="Most centres chosen; all: every point.")
    mapping: Literal["height", "autoassociative"] = Field("height", description="What the network maps.")


class SurfaceModel:
    """A network with the region and the units of the feature set that it was trained on.

    Parameters
    ----------
    network : RBFNetwork
        Fitted; positions (x, y), values z.
    region : Region
    units : Units
    """

    def __init__(self, network: RBFNetwork, region: Region, units: Units) -> None:
        self.network = network
        self.region = region
        self.units = units

    @classmethod
    def train(
        cls,
        features: FeatureSet,
        settings: NetworkSettings = NetworkSettings(),
        *,
        callback: Callback | None = None,
    ) -> Self:
        """Train on the points of `features`; raises PointsError, ParameterError or TrainingError."""
        given = settings.model_dump() | ({"max_centers": None} if settings.max_centers == "all" else {})
        network = RBFNetwork(**given, callback=callback).fit(features.xy, features.z)
        network.set_params(callback=None)
        return cls(network, features.region, features.units)

    def grid(self, x: npt.ArrayLike, y: npt.ArrayLike) -> HeightGrid:
        """Heights at the nodes of ascending axes x and y."""
        return HeightGrid(
            np.asarray(x, dtype=np.float64),
            np.asarray(y, dtype=np.float64),
            self.network.predict_grid(x, y),
            self.units,
        )

    def std(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        """Standard deviation of the heights, shape (len(y), len(x)), in the units of z."""
        return self.network.predict_grid(x, y, return_std=True)[1]

    def summary(self) -> dict[str, Any]:
        """What was trained, in types that JSON knows."""
        network = self.network
        return {
            "centers": len(network.centers_),
            "patches": network.patches_,
            "spread": np.asarray(network.spread_).tolist(),
            "smoothing": network.smoothing_,
            "mapping": network.mapping,
            "stop_reason": network.stop_reason_,
            "outliers": network.outliers_.tolist(),
            "notes": list(network.notes_),
        }

    def to_state(self) -> dict[str, np.ndarray[Any, Any]]:
        """Everything, as arrays that `numpy.savez` takes without pickling."""
        state = {f"network_{name}": value for name, value in self.network.to_state().items()}
        state["region"] = np.array(self.region.bounds)
        state["units"] = np.array([self.units.xy, self.units.z])
        return state

    @classmethod
    def from_state(cls, state: dict[str, np.ndarray[Any, Any]]) -> Self:
        """The model that `to_state` wrote."""
        prefix = "network_"
        network = RBFNetwork.from_state(
            {name.removeprefix(prefix): value for name, value in state.items() if name.startswith(prefix)}
        )
        unit_xy, unit_z = state["units"].tolist()
        return cls(network, Region(*state["region"].tolist()), Units(unit_xy, unit_z))
