# SPDX-License-Identifier: MIT
"""Objects of the trace in Copley Controls amplifiers: up to six numbered variables, a row of them per sample.

Copley Motion Libraries, CML_AmpDef.h and the trace methods of the class Amp (Linkeway/BIRL_modular_robot@e0f9380), with
the EDS files there: objects, types, bits of the status, order of the data (32-bit numbers, little endian, one per
channel and sample). CopleyControlsOfficial/CMO_Examples@74210fd EX7_Trace: order of the calls. The data have no CRC,
and are whole only while no trace runs. Not used: triggers by level, edge or event, and the delay.
"""

from __future__ import annotations

from pmsmtool.drive_maps.recorder_map import Address

CHANNELS = 6
COUNT: Address = (0x2500, 0, "B")
"""Number of channels."""
FIRST_CHANNEL: Address = (0x2500, 1, "H")
"""Number of the variable of a channel, 0 for none."""
STATUS: Address = (0x2501, 0, "H")
REFERENCE_PERIOD_NS: Address = (0x2502, 0, "I")
RECORDED: Address = (0x2503, 0, "H")
LARGEST: Address = (0x2504, 0, "H")
"""Samples that fit with the channels chosen."""
PERIOD: Address = (0x2505, 0, "H")
"""Multiples of the reference period."""
TRIGGER = 0x2506
NO_TRIGGER = bytes(6)
"""Kind and channel, then the level: a trace that is started begins at once."""
DELAY: Address = (0x2507, 0, "h")
START: Address = (0x2508, 0, "H")
DATA = 0x2509

RUNNING_BIT = 1 << 0
NUMBER_BYTES = 4
