# SPDX-License-Identifier: MIT
"""Where `map learn` looks for the gains of a speed loop when nobody names their objects."""

from __future__ import annotations

import math

import pytest

from pmsmtool.drive.objects import DriveObject
from pmsmtool.drive_maps.shipped_maps import load_family
from pmsmtool.errors import NotAvailable
from pmsmtool.identification.learned_gains import Learned
from pmsmtool.measurement.changed_gains import DOWN, GAIN, INTEGRAL, changed_counts, gain_address, gain_object
from pmsmtool.measurement.learn_position_gain import DERIVATIVE, POSITION
from pmsmtool.measurement.learned_rows import measured_row
from tests.drive.table_drive import node_of


@pytest.mark.parametrize(
    ("family", "there", "gain", "integral"),
    [
        ("zeroerr", 0x2381, (0x2381, 1), (0x2381, 2)), ("nanotec", 0x3210, (0x3210, 3), (0x3210, 4)),
        ("faulhaber", 0x2331, (0x2331, 1), (0x2331, 2)), ("faulhaber", 0x60F9, (0x60F9, 1), (0x60F9, 2)),
        ("copley", 0x60F9, (0x60F9, 1), (0x60F9, 2)), ("epos4", 0, (0x30A2, 1), (0x30A2, 2)),
        ("cia402", 0x60F9, (0x60F9, 1), (0x60F9, 2)),
    ],
)  # fmt: skip
def test_the_maps_own_reason_names_the_object(
    family: str, there: int, gain: tuple[int, int], integral: tuple[int, int]
) -> None:
    held = {DriveObject(there, sub, "H"): 7.0 for sub in (1, 2, 3, 4)} if there else {}
    with node_of(held, load_family(family)) as (_, node):
        assert (gain_address(node, GAIN), gain_address(node, INTEGRAL)) == (gain, integral)


@pytest.mark.parametrize(
    ("family", "named"), [("cia402", "it has no 0x60F9:01"), ("zeroerr", "it has no 0x2381:01 or 0x60F9:01")]
)
def test_a_drive_without_such_an_object_is_told_so(family: str, named: str) -> None:
    """The shift of Copley's gain (0x60F9:04) is no gain."""
    with node_of({DriveObject(0x60F9, 4, "h"): 1.0}, load_family(family)) as (_, node):
        with pytest.raises(NotAvailable) as caught:
            gain_address(node, GAIN)
        assert named in caught.value.what and "0xINDEX:SUB" in caught.value.hint


def test_the_reason_s_limits_go_into_the_measured_row() -> None:
    """A gain of 300 counts was designed for an object that takes 255: the drive refused it when it was written."""
    held = {DriveObject(0x2332, sub, "H"): 20.0 for sub in (1, 2)}
    with node_of(held, load_family("faulhaber")) as (_, node):
        found = [gain_object(node, name, 0x2332, sub) for sub, name in ((1, POSITION), (2, DERIVATIVE))]
    assert [gain.limits for gain in found] == [(1.0, 255.0)] * 2
    cell = measured_row(found[0], Learned(POSITION, 0.1, 0.05, "value", "1/s")).cell()
    assert (cell.low, cell.largest) == (1.0, 255.0)
    with node_of(held, load_family("copley")) as (_, node):
        assert gain_object(node, POSITION, 0x2332, 1).limits == (-math.inf, math.inf)


def test_a_gain_that_is_a_float_is_changed_as_one() -> None:
    """0.7 of the bits of 5.65 is 6e-11, and twice those of 15 a negative gain: both were written to the drive."""
    place = DriveObject(0x250A, 0, "f")
    with node_of({place: 5.65}, load_family("ingenia")) as (_, node):
        gain = gain_object(node, GAIN, *gain_address(node, GAIN))
        assert gain.counts == pytest.approx(5.65) and changed_counts(gain, DOWN) == pytest.approx(0.7 * 5.65)
    with node_of({place: 5.65}, load_family("cia402")) as (_, node), pytest.raises(NotAvailable, match="REAL32"):
        gain_object(node, GAIN, place.index, place.sub)
