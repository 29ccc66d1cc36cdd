# SPDX-License-Identifier: MIT
"""Readings one after the other: when they are taken, what is made of them, and a drive that falls silent."""

from __future__ import annotations

import statistics
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import islice
from types import SimpleNamespace

import pytest

from pmsmtool.drive import logged_values
from pmsmtool.drive.logged_values import Column, available, readings, sent
from pmsmtool.drive.objects import IDENTITY, DriveObject
from pmsmtool.drive_maps.drive_map import REFERENCE_PRODUCT, REFERENCE_VENDOR, reference_map
from pmsmtool.errors import DriveTimeout, NotAvailable
from pmsmtool.params.catalogue import layout_signature

NAMES = ["i_d_a", "i_q_a"]
GET_S = 0.01


class Node:
    """A node whose transfers take 10 ms."""

    def __init__(self, vendor: int = REFERENCE_VENDOR, signature: int = 0) -> None:
        self.node, self.map = 1, reference_map()
        self.numbers = {IDENTITY: {1: vendor, 2: REFERENCE_PRODUCT}, 0x2000: {2: signature}}
        self.t_s = 100.0
        self.connection = self.clock = self.supervision = self
        self.checks = 0

    def now(self) -> float:
        return self.t_s

    def wait(self, seconds: float) -> None:
        assert seconds >= 0.0
        self.t_s += seconds

    def get(self, item: object) -> float:
        self.t_s += GET_S
        return self.t_s

    def check(self) -> None:
        self.checks += 1

    def held(self, item: DriveObject) -> float:
        return self.numbers[item.index][item.sub]

    def has(self, index: int, sub: int) -> bool:
        return True


def test_a_column_is_what_statistics_say() -> None:
    column, values = Column(), [3.0, -1.0, 4.5, 4.5, 2.0]
    assert column.std == 0.0
    for k, value in enumerate(values, 1):
        column.add(value)
        assert (column.last, column.low, column.high) == (value, min(values[:k]), max(values[:k]))
        assert column.std == pytest.approx(statistics.stdev(values[:k]) if k > 1 else 0.0)


@pytest.mark.parametrize(("period_s", "expected"), [(0.1, [0.0, 0.1, 0.2, 0.3]), (0.005, [0.0, 0.02, 0.04, 0.06])])
def test_readings_keep_their_period_or_follow_one_another(period_s: float, expected: list[float]) -> None:
    node = Node()
    taken = list(islice(readings(node, NAMES, period_s, None), 4))  # type: ignore[arg-type]
    assert [t for t, _ in taken] == pytest.approx(expected)
    assert list(taken[0][1].values()) == pytest.approx([100.0 + GET_S, 100.0 + 2.0 * GET_S])
    assert node.checks == 3


def test_readings_end_in_time() -> None:
    taken = list(readings(Node(), NAMES, 0.25, 0.75))  # type: ignore[arg-type]
    assert [t for t, _ in taken] == pytest.approx([0.0, 0.25, 0.5])


def test_a_quantity_must_be_wanted_and_there() -> None:
    assert available(Node(), lambda name: name in NAMES) == NAMES  # type: ignore[arg-type]
    with pytest.raises(NotAvailable):
        available(Node(), lambda name: False)  # type: ignore[arg-type]


def test_the_objects_of_another_makers_drive_are_no_live_quantities() -> None:
    """Of a firmware with this program's core they are, whoever sells it."""
    assert available(Node(0x6A, layout_signature()), lambda name: name in NAMES) == NAMES  # type: ignore[arg-type]
    with pytest.raises(NotAvailable, match="none of these live quantities"):
        available(Node(0x6A), lambda name: name in NAMES)  # type: ignore[arg-type]


def silent_after(node: Node, sets: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """The drive sends one quantity, then both, and nothing more after so many periods."""
    live = SimpleNamespace(values={}, received=0)

    @contextmanager
    def values(*arguments: object) -> Iterator[SimpleNamespace]:
        yield live

    def wait(seconds: float) -> None:
        node.t_s += seconds
        if live.received < sets:
            live.received += 1
            live.values = dict.fromkeys(NAMES[: live.received], 1.0 * live.received)

    monkeypatch.setattr(logged_values, "live_values", values)
    monkeypatch.setattr(node, "wait", wait)


def test_what_is_sent_is_read_once_all_of_it_has_come(monkeypatch: pytest.MonkeyPatch) -> None:
    node = Node()
    silent_after(node, 100, monkeypatch)
    taken = list(sent(node, NAMES, 0.1, 0.45))  # type: ignore[arg-type]
    assert [t for t, _ in taken] == pytest.approx([0.2, 0.3, 0.4, 0.5])
    assert taken[0][1] == dict.fromkeys(NAMES, 2.0)


@pytest.mark.parametrize(("period_s", "allowed"), [(0.25, 4), (0.125, 8), (0.5, 3), (2.0, 3)])
def test_a_drive_that_falls_silent_is_lost_after_a_second_and_three_periods(
    period_s: float, allowed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    node = Node()
    silent_after(node, 5, monkeypatch)
    with pytest.raises(DriveTimeout, match=rf"for {(allowed + 1) * period_s:.1f} s"):
        list(sent(node, NAMES, period_s, None))  # type: ignore[arg-type]
    assert node.t_s == pytest.approx(100.0 + (5 + allowed + 1) * period_s)
