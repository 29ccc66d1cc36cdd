# SPDX-License-Identifier: MIT
"""What is looked at before a drive is moved: how fast it answers."""

from __future__ import annotations

import pytest

from pmsmtool.drive.drive_node import LOOKS, DriveNode
from pmsmtool.drive_maps.shipped_maps import load_family
from pmsmtool.errors import DriveTimeout
from tests.drive.table_drive import node_of


@pytest.mark.parametrize(("answers_s", "refused"), [([0.02] * LOOKS, False), ([0.0, 0.9] * (LOOKS // 2), True)])
def test_a_drive_that_answers_late_is_refused_at_once(
    answers_s: list[float], refused: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`check` took 114 s to refuse it, by the supervision that could not be tested."""
    with node_of({}, load_family("cia402")) as (_, node):
        left = list(answers_s)
        monkeypatch.setattr(DriveNode, "state", lambda self: self.connection.wait(left.pop()))
        if not refused:
            node.refuse_late()
            return
        with pytest.raises(DriveTimeout, match="450 ms on average and up to 900 ms") as caught:
            node.refuse_late()
        assert "nothing was energised" in caught.value.hint
