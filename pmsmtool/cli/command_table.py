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
    Row("machine", "pmsmtool.cli.machine:machine_command", Section.COMPUTE, "Make a machine file from a datasheet."),
    Row("tune", "pmsmtool.cli.tune:tune_command", Section.COMPUTE, "Design the control of a machine."),
    Row("report", "pmsmtool.cli.report:report_command", Section.COMPUTE, "Write the report of a run."),
    Row("export", "pmsmtool.cli.export:export_command", Section.COMPUTE, "Write a design as DCF, C, CSV."),
    Row("margins", "pmsmtool.cli.margins:margins_command", Section.COMPUTE, "Judge a design over its tolerances."),
    Row("lut", "pmsmtool.cli.lut:lut_command", Section.COMPUTE, "Make current references over torque and speed."),
    Row("simulate", "pmsmtool.cli.simulate:simulate_command", Section.COMPUTE, "Run the closed loop in simulation."),
    Row("sim", "pmsmtool.cli.sim:sim_command", Section.TOOL, "Serve simulated drives to other programs."),
    Row("help", "pmsmtool.cli.help_topics:help_command", Section.TOOL, "Explain a topic or a command."),
    Row("completion", "pmsmtool.cli.completion:completion_command", Section.TOOL, "Print a shell's completion script."),
)
