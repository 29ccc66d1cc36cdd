# SPDX-License-Identifier: MIT
"""What a drive of every class is left with when it falls silent while it is restored."""

from __future__ import annotations

from pathlib import Path

import pytest

from pmsmtool.drive.changed_objects import ChangedObjects
from pmsmtool.drive.guard import guarded
from pmsmtool.errors import PmsmtoolError
from tests.drive.test_limits_contract import CLASSES, ENVELOPE, opened


@pytest.mark.chain
@pytest.mark.parametrize("name", CLASSES)
def test_a_drive_that_falls_silent_while_it_is_restored_names_what_is_left(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The voltage is off by then; lowered limits stay, and were not named."""
    restore = ChangedObjects.restore
    with opened(name, tmp_path) as rig:
        before = rig.memory()

        def silent(changed: ChangedObjects) -> int:
            rig.drive.node.connection.bus.line.nodes[0].plugged = False  # type: ignore[attr-defined]
            return restore(changed)

        monkeypatch.setattr(ChangedObjects, "restore", silent)
        named = pytest.raises(PmsmtoolError, match="the drive could not be restored: 0x")
        with named as caught, guarded(rig.drive, ENVELOPE) as guard:
            guard.enable()
        now = rig.memory()
        left = {f"0x{at[0]:04X}:{at[1]:02X}" for at, data in before.items() if now[at] != data}
        # the reference drive's whole set as one object, and a maker's own object of the limit that 0x6073 shows: what
        # changed is named by itself
        left -= {"0x2001:00", "0x3001:02"}
        assert left and not [address for address in left if address not in caught.value.what]
        assert not rig.energised and caught.value.hint
