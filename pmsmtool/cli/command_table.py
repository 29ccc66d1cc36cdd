# SPDX-License-Identifier: MIT
"""The table of commands. To add one: write ``pmsmtool/cli/<command>.py`` and add a row here.

The row is all that ``pmsmtool --help`` and completion read; the module is imported when its command runs.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


class Section(Enum):
    """Sections of ``pmsmtool --help``: what a command does to the machine."""

    LOOK = "Look"
    MOVE = "Move the machine"
    COMPUTE = "Compute"
    WRITE = "Write to the drive"
    TOOL = "The tool itself"


@dataclass(frozen=True, slots=True)
class Row:
    """One command.

    Attributes
    ----------
    name : str
        What is typed; kebab-case.
    target : str
        ``module:attribute`` of the click command.
    section : Section
        Where the help lists it.
    help : str
        One sentence; the short help everywhere.
    """

    name: str
    target: str
    section: Section
    help: str


COMMANDS: tuple[Row, ...] = (
    Row("doctor", "pmsmtool.cli.doctor:doctor_command", Section.LOOK, "Examine adapters, wiring and bit rate."),
    Row("scan", "pmsmtool.cli.scan:scan_command", Section.LOOK, "List the nodes on a bus."),
    Row("info", "pmsmtool.cli.info:info_command", Section.LOOK, "Show identity, state and parameter set."),
    Row("caps", "pmsmtool.cli.caps:caps_command", Section.LOOK, "Show what a drive can measure, and what is missing."),
    Row("monitor", "pmsmtool.cli.monitor:monitor_command", Section.LOOK, "Show live values."),
    Row("scope", "pmsmtool.cli.scope:scope_command", Section.LOOK, "Show live signals on a local page."),
    Row("fault", "pmsmtool.cli.fault:fault_command", Section.LOOK, "Show or reset faults."),
    Row("commission", "pmsmtool.cli.commission:commission_command", Section.MOVE, "Identify, design, flash, prove."),
    Row("nmt", "pmsmtool.cli.nmt:nmt_command", Section.WRITE, "Send a network management command."),
    Row("lss", "pmsmtool.cli.lss:lss_command", Section.WRITE, "Give node ids to nodes without one."),
    Row("stop", "pmsmtool.cli.stop:stop_command", Section.MOVE, "Stop a drive, confirmed."),
    Row("identify", "pmsmtool.cli.identify:identify_command", Section.MOVE, "Measure the machine on its drive."),
    Row("track", "pmsmtool.cli.track:track_command", Section.LOOK, "Follow R and psi while the machine runs."),
    Row("check", "pmsmtool.cli.check:check_command", Section.MOVE, "Look for wrong wiring at a first power-on."),
    Row("map", "pmsmtool.cli.map:map_group", Section.MOVE, "Measure the units of a drive's gains."),
    Row("jog", "pmsmtool.cli.jog:jog_command", Section.MOVE, "Move for a short time, within limits."),
    Row("move", "pmsmtool.cli.move:move_command", Section.MOVE, "Move there and back, and see how it follows."),
    Row("prove", "pmsmtool.cli.prove:prove_command", Section.MOVE, "Show that the machine does what was designed."),
    Row("param", "pmsmtool.cli.param:param_command", Section.WRITE, "Read, write, compare parameters."),
    Row("flash-params", "pmsmtool.cli.flash_params:flash_params_command", Section.WRITE, "Write and store a set."),
    Row("verify", "pmsmtool.cli.verify:verify_command", Section.LOOK, "Compare what a drive holds."),
    Row("backup", "pmsmtool.cli.backup:backup_command", Section.LOOK, "Save everything a drive holds."),
    Row("restore", "pmsmtool.cli.restore:restore_command", Section.WRITE, "Bring a backup or download back."),
    Row("machine", "pmsmtool.cli.machine:machine_command", Section.COMPUTE, "Make a machine file from a datasheet."),
    Row("tune", "pmsmtool.cli.tune:tune_command", Section.COMPUTE, "Design the control of a machine."),
    Row("diff", "pmsmtool.cli.compare_runs:diff_command", Section.COMPUTE, "Compare two runs with their intervals."),
    Row("fleet", "pmsmtool.cli.fleet_runs:fleet_command", Section.COMPUTE, "Show the statistics of many runs."),
    Row("report", "pmsmtool.cli.report:report_command", Section.COMPUTE, "Write the report of a run."),
    Row("export", "pmsmtool.cli.export:export_command", Section.COMPUTE, "Write a design as DCF, C, CSV."),
    Row("margins", "pmsmtool.cli.margins:margins_command", Section.COMPUTE, "Judge a design over its tolerances."),
    Row("lut", "pmsmtool.cli.lut:lut_command", Section.COMPUTE, "Make current references over torque and speed."),
    Row("simulate", "pmsmtool.cli.simulate:simulate_command", Section.COMPUTE, "Run the closed loop in simulation."),
    Row("reproduce", "pmsmtool.cli.reproduce:reproduce_command", Section.COMPUTE, "Recompute figures of the papers."),
    Row("sim", "pmsmtool.cli.sim:sim_command", Section.TOOL, "Serve simulated drives to other programs."),
    Row("help", "pmsmtool.cli.help_topics:help_command", Section.TOOL, "Explain a topic or a command."),
    Row("completion", "pmsmtool.cli.completion:completion_command", Section.TOOL, "Print a shell's completion script."),
)
