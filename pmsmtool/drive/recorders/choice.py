# SPDX-License-Identifier: MIT
"""Which recorder a drive has, by what its map states."""

from __future__ import annotations

from collections.abc import Mapping

from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.drive.recorders.commanded import CommandedRecorder
from pmsmtool.drive.recorders.copley import RowRecorder
from pmsmtool.drive.recorders.epos2 import RingRecorder
from pmsmtool.drive.recorders.ingenia import MonitorRecorder
from pmsmtool.drive.recorders.reference import Recorder
from pmsmtool.errors import NotAvailable

COMMANDED: Mapping[str, type[CommandedRecorder]] = {
    "index": MonitorRecorder,
    "rows": RowRecorder,
    "rings": RingRecorder,
}
"""Makers' recorders by the kind a map states (``drive_maps.recorder_map.Recording``)."""


def recorder_of(node: DriveNode, period_s: float) -> Recorder:
    """Return the recorder of a drive.

    Raises NotAvailable: it has none that this program reads, or its map does not state enough of it.

    Parameters
    ----------
    period_s : float
        Control period, for the reference drive's recorder (s).
    """
    if node.map.staging:
        return Recorder(node, period_s)
    kind = COMMANDED.get(node.map.capabilities.recorder)
    if kind is None:
        raise NotAvailable(
            f"the drive map {node.map.name!r} has no recorder that this program reads", where=f"node {node.node}"
        )
    return kind(node)


def described(node: DriveNode) -> str:
    """Return what a maker's recorder takes and how often, or why it is not read; empty where the map names none."""
    if node.map.staging or node.map.capabilities.recorder == "none":
        return ""
    try:
        recorder = recorder_of(node, 0.0)
    except NotAvailable as reason:
        return f"not read: {reason.what}" + (f" ({reason.hint})" if reason.hint else "")
    assert isinstance(recorder, CommandedRecorder)
    if not recorder.signals:
        return f"{recorder.what}: nothing, the map names no channels"
    return f"{recorder.what} of {', '.join(recorder.signals)}, every {1e6 * recorder.period_s:.4g} us"
