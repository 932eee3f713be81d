"""What stands in the query of a grid."""

from __future__ import annotations

import pytest

from common.errors import ParameterError
from common.surface import Region
from receiver.grids import parse_bbox


def test_the_region_is_told_in_the_digits_the_surface_is_told_in() -> None:
    with pytest.raises(ParameterError, match=r" 10\.2,57\.3991,11\.1,58\.3; nothing is known there"):
        parse_bbox("0,0,1,1", Region(10.2, 11.1, 57.3991, 58.3))
