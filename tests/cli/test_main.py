# SPDX-License-Identifier: MIT
"""The frame of the command line: start-up, options, exit codes, consents, help."""

from __future__ import annotations

import errno
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from pmsmtool.cli import command_table, main, options
from pmsmtool.cli.help_topics import EXIT_CODES, TOPICS
from pmsmtool.cli.output import Output
from pmsmtool.errors import (
    BusError,
    ConfigError,
    Declined,
    DesignInfeasible,
    DriveFault,
    DriveTimeout,
    ExitCode,
    IdentificationError,
    Interrupted,
    LimitExceeded,
    NotAvailable,
    PmsmtoolError,
    SdoAbort,
    StopNotConfirmed,
    VerifyMismatch,
)
from pmsmtool.machine.machine_keys import machine_file_keys
from pmsmtool.measurement.run_account import accounted
from pmsmtool.run_directory import RunDirectory, new_record
from pmsmtool.sim.scenarios import BUILT_IN, SCHEDULES

ROOT = Path(__file__).resolve().parents[2]
SLOW = ("numpy", "scipy", "can", "canopen", "matplotlib", "rich", "jinja2", "filterpy")


def fresh(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run the program in a fresh process."""
    env = {name: value for name, value in os.environ.items() if not name.startswith(("PMSMTOOL_", "CAN_"))}
    return subprocess.run(
        [sys.executable, "-m", "pmsmtool", *arguments],
        cwd=ROOT,
        env={**env, **environment},
        capture_output=True,
        text=True,
        stdin=subprocess.DEVNULL,
    )


# ---- start-up ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "arguments", [["--help"], ["--version"], ["help"], ["help", "exit-codes"], ["completion", "zsh"], ["nonsense"]]
)
def test_nothing_slow_is_imported(arguments: list[str]) -> None:
    program = (
        "import sys\nfrom pmsmtool.cli.main import run\n"
        f"run({arguments!r})\n"
        f"print('loaded:', *(name for name in {SLOW!r} if name in sys.modules), file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True)
    assert done.stderr.splitlines()[-1] == "loaded:"


def test_linear_algebra_has_one_thread_whatever_the_processors() -> None:
    """More threads sum in another order: a flux map was not replayed bit for bit with another number of them."""
    program = (
        "import atexit, os, sys\nfrom pmsmtool.cli.main import main\nassert 'numpy' not in sys.modules\n"
        "atexit.register(lambda: print(os.environ['OPENBLAS_NUM_THREADS']))\nsys.argv[1:] = ['--version']\nmain()"
    )
    environment = {name: text for name, text in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, env=environment)
    assert done.stdout.splitlines()[-1] == "1"


def test_help_lists_every_command_under_its_section_without_importing_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(command_table, "load_command", lambda row: pytest.fail(f"imported {row.name}"))
    text = CliRunner().invoke(main.cli, ["--help"]).output
    for section in command_table.Section:
        rows = [row for row in command_table.COMMANDS if row.section is section]
        block = text.split(f"\n{section.value}:\n")[1].split("\n\n")[0] if rows else ""
        assert re.findall(r"^  (\S+)", block, re.MULTILINE) == [row.name for row in rows]


def test_no_arguments_prints_help_and_is_a_usage_error() -> None:
    done = fresh()
    assert (done.returncode, done.stdout) == (2, "")
    assert "Usage: pmsmtool" in done.stderr


# ---- the table of commands ---------------------------------------------------------------------------------


@pytest.mark.parametrize("row", command_table.COMMANDS, ids=lambda row: row.name)
def test_row_names_a_command(row: command_table.Row) -> None:
    command = command_table.load_command(row)
    assert isinstance(command, click.Command)
    assert command.name == row.name
    assert re.fullmatch(r"[a-z]+(-[a-z]+)*", row.name)
    assert row.help.endswith(".")
    assert len(row.help) <= 90
    assert row.target.startswith("pmsmtool.cli.")


@pytest.mark.parametrize(("typed", "command"), list(command_table.leaves()), ids=str)
def test_every_command_explains_itself(typed: str, command: click.Command) -> None:
    assert command.help, f"{typed} has no help"
    assert command.epilog, f"{typed} shows no examples"
    lines = [line.strip() for line in command.epilog.splitlines()]
    shown = [line for line in lines if "pmsmtool " in line and not line.startswith("#")]
    assert lines[1] == "Examples:"
    assert 1 <= len(shown) <= 4
    assert any(typed in line for line in shown)
    for parameter in command.params:
        assert isinstance(parameter, click.Argument) or parameter.help, f"{typed}: {parameter.name} has no help"


def test_modules_of_commands_are_all_registered() -> None:
    frame = {
        "__init__",
        "command_table",
        "consent",
        "main",
        "options",
        "output",
    }
    registered = {row.target.split(":")[0].split(".")[2] for row in command_table.COMMANDS}
    present = {path.stem for path in (ROOT / "pmsmtool" / "cli").glob("*.py")}
    unregistered = {
        name
        for name in present - frame - registered
        if "@click." in (ROOT / f"pmsmtool/cli/{name}.py").read_text("utf-8")
    }
    assert unregistered == set()


def test_option_before_a_command_that_ignores_it_is_refused() -> None:
    done = fresh("--json", "completion", "bash")
    assert done.returncode == 2
    assert "completion takes no --json" in done.stderr
    assert fresh("-q", "help", "units", PMSMTOOL_JSON="1").returncode == 0


def test_did_you_mean() -> None:
    done = fresh("complation")
    assert done.returncode == 2
    assert "did you mean completion?" in done.stderr


# ---- errors to exit codes ----------------------------------------------------------------------------------


def exit_code(action: Callable[[], object], monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    """Run a command that does ``action`` through the real main loop."""

    @click.command("probe")
    @options.text_options
    def command(out: Output) -> None:
        action()

    row = command_table.Row("probe", "pmsmtool.cli.nowhere:command", command_table.Section.LOOK, "Probe.")
    monkeypatch.setattr(command_table, "COMMANDS", (row,))
    monkeypatch.setattr(command_table, "load_command", lambda _: command)
    return main.run([*arguments, "probe"])


def raising(error: BaseException) -> Callable[[], object]:
    def action() -> None:
        raise error

    return action


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (DesignInfeasible("x"), 1),
        (VerifyMismatch("x", differences=["motor.R_s_ohm 1 2"]), 1),
        (ConfigError("x"), 2),
        (click.UsageError("x"), 2),
        (click.FileError("x"), 2),
        (FileNotFoundError(2, "No such file or directory", "machine.toml"), 2),
        (PermissionError(13, "Permission denied", "runs"), 2),
        (OSError(28, "No space left on device"), 2),
        (BusError("x"), 3),
        (DriveTimeout("x"), 3),
        (DriveFault("x"), 4),
        (SdoAbort(0x06090030, 0x2010, 2, "x"), 4),
        (LimitExceeded("current", 12.0, 10.0, "A"), 5),
        (IdentificationError("E_SNR", "x"), 6),
        (Declined("x"), 7),
        (StopNotConfirmed("x"), 8),
        (NotAvailable("x"), 9),
        (PmsmtoolError("x"), 70),
        (Interrupted("x"), 130),
        (KeyboardInterrupt(), 130),
        (click.Abort(), 130),
        (click.exceptions.Exit(1), 1),
        (ExceptionGroup("two", [ValueError("x"), BusError("y")]), 3),
        (ExceptionGroup("two", [BusError("y"), StopNotConfirmed("x")]), 8),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, BaseException) else str(value),
)
def test_error_to_exit_code(
    error: BaseException, code: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert exit_code(raising(error), monkeypatch) == code
    printed = capsys.readouterr()
    assert printed.out == ""
    assert "Traceback" not in printed.err


@pytest.mark.parametrize("error", [ValueError("x"), KeyError("x"), OSError(98, "Address already in use"), EOFError()])
def test_bug_keeps_its_traceback_in_a_named_file(
    error: Exception, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setenv("PMSMTOOL_HOME", str(tmp_path / "new"))
    assert exit_code(raising(error), monkeypatch) == 70
    printed = capsys.readouterr().err
    match = re.search(r"traceback in (.*)", printed)
    assert match is not None
    kept = Path(match[1])
    assert kept.is_relative_to(tmp_path)
    assert "raise error" in kept.read_text(encoding="utf-8")
    assert type(error).__name__ in printed
    assert "Traceback" not in printed


def test_bug_without_a_writable_folder_prints_its_traceback(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("")
    monkeypatch.setenv("PMSMTOOL_HOME", str(blocked / "below"))
    monkeypatch.setattr("tempfile.gettempdir", lambda: str(blocked))
    assert exit_code(raising(ValueError("x")), monkeypatch) == 70
    assert "Traceback" in capsys.readouterr().err


def test_traceback_of_an_ordinary_error_only_with_vv(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert exit_code(raising(BusError("x")), monkeypatch, "-v") == 3
    assert "Traceback" not in capsys.readouterr().err
    assert exit_code(raising(BusError("x")), monkeypatch, "-vv") == 3
    assert "Traceback" in capsys.readouterr().err


def stop_fails_during(cause: BaseException) -> Callable[[], object]:
    def action() -> None:
        try:
            raise cause
        finally:
            raise StopNotConfirmed("no answer to quick stop")

    return action


def clean_up_fails_after_stop() -> None:
    try:
        raise StopNotConfirmed("no answer to quick stop")
    finally:
        raise BusError("parameters not restored")


@pytest.mark.parametrize(
    "action",
    [
        stop_fails_during(KeyboardInterrupt()),
        stop_fails_during(IdentificationError("E_SNR", "x")),
        stop_fails_during(ValueError("bug")),
        clean_up_fails_after_stop,
    ],
)
def test_stop_not_confirmed_outranks_everything(
    action: Callable[[], object], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert exit_code(action, monkeypatch) == 8
    printed = capsys.readouterr().err
    lines = printed.splitlines()
    assert lines[-1] == "STOP NOT CONFIRMED: no answer to quick stop; use the hardware stop", "last on the screen"
    assert any("also:   " in line for line in lines[:-1])


def test_message_says_what_where_likely_and_try(capsys: pytest.CaptureFixture[str]) -> None:
    error = ConfigError(
        "two keys are wrong", where="m.toml", likely="old file", hint="see help files", violations=["a: 1", "b: 2"]
    )
    assert main.report(error) == 2
    lines = capsys.readouterr().err.splitlines()
    assert lines[:3] == ["error: two keys are wrong", "  - a: 1", "  - b: 2"]
    assert lines[3:] == ["  where:  m.toml", "  likely: old file", "  try:    see help files"]


def test_every_exit_code_is_explained() -> None:
    assert set(EXIT_CODES) == set(ExitCode)


@pytest.mark.skipif(sys.platform == "win32", reason="no shell of this kind")
@pytest.mark.parametrize("closed", ["1>&-", "2>&-", "0<&-", "0<&- 1>&- 2>&-"])
def test_a_closed_standard_stream_is_no_bug_and_its_number_no_files(closed: str, tmp_path: Path) -> None:
    """`>&-` ended in a traceback; the first file that is opened must not become standard output, either."""
    line = f"{sys.executable} -m pmsmtool tune {ROOT / 'profiles' / 'interior-2k2.toml'} -o {tmp_path / 'd.toml'}"
    done = subprocess.run(["sh", "-c", f"{line} {closed}"], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    assert (tmp_path / "d.toml").read_text().startswith("# Design of one drive")


def test_a_run_that_a_closed_pipe_ends_is_not_recorded_as_a_bug(tmp_path: Path) -> None:
    run_directory = RunDirectory(tmp_path)
    run_directory.write(new_record(["test"], drive={}, bus={}, versions={}))
    with pytest.raises(BrokenPipeError), accounted(run_directory, "identify", lambda line: None):
        raise BrokenPipeError(errno.EPIPE, "Broken pipe")
    assert run_directory.read().account["exit_code"] == ExitCode.READER_GONE == 141


@pytest.mark.skipif(sys.platform == "win32", reason="no pipes of this kind")
def test_a_closed_pipe_behind_standard_error_is_no_bug(tmp_path: Path) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    command = [sys.executable, "-m", "pmsmtool", "tune", "interior-2k2", "-o", str(tmp_path / "d.toml")]
    home = {**os.environ, "PMSMTOOL_HOME": str(tmp_path)}
    done = subprocess.run(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=writing, env=home, check=False)
    os.close(writing)
    assert done.returncode == ExitCode.READER_GONE
    assert not list(tmp_path.glob("crashes/*"))


@pytest.mark.skipif(sys.platform == "win32", reason="no pipes of this kind")
@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_reader_gone_and_full_disk(unbuffered: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONUNBUFFERED", unbuffered)
    command = [sys.executable, "-m", "pmsmtool", "help", "units"]
    reading, writing = os.pipe()
    os.close(reading)
    done = subprocess.run(command, cwd=ROOT, stdout=writing, stderr=subprocess.PIPE, text=True)
    os.close(writing)
    assert (done.returncode, done.stderr) == (ExitCode.READER_GONE, "")
    if Path("/dev/full").exists():
        with Path("/dev/full").open("w") as full:
            done = subprocess.run(command, cwd=ROOT, stdout=full, stderr=subprocess.PIPE, text=True)
        assert done.returncode == 2
        assert "No space left" in done.stderr


@pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_signals_leave_through_finally(number: signal.Signals) -> None:
    program = """
import sys, time
from pmsmtool.cli import main
def wait(arguments):
    try:
        print("ready", flush=True)
        time.sleep(30)
    except KeyboardInterrupt as error:
        return main.report(error)
    finally:
        print("stopped", flush=True)
main.run = wait
main.main()
"""
    with subprocess.Popen(
        [sys.executable, "-c", program], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as child:
        assert child.stdout is not None
        assert child.stdout.readline() == "ready\n"
        child.send_signal(number)
        out, _ = child.communicate(timeout=20)
    assert (out, child.returncode) == ("stopped\n", 130)


# ---- help and completion -----------------------------------------------------------------------------------


@pytest.mark.parametrize("topic", TOPICS)
def test_help_topic(topic: str) -> None:
    done = fresh("help", topic)
    assert (done.returncode, done.stderr) == (0, "")
    assert len(done.stdout.splitlines()) > 5
    assert max(map(len, done.stdout.splitlines())) <= 130


def test_help_names_every_key_of_a_machine_file_and_of_a_scenario() -> None:
    text = TOPICS["machine-file"][1]() + TOPICS["simulation"][1]()
    words = set(text.split())
    assert {key.name for key in machine_file_keys()} <= words
    assert set(SCHEDULES) | set(BUILT_IN) <= set(re.split(r"[\s,]+", TOPICS["scenario"][1]()))


def test_help_names_every_variable_of_the_global_options() -> None:
    text = TOPICS["environment"][1]()
    for parameter in main.cli.params:
        variable = parameter.envvar or f"PMSMTOOL_{(parameter.name or '').upper()}"
        wanted = parameter.name not in ("yes", "version")
        assert (str(variable) in text.split()) == wanted


def test_help_of_nothing_known() -> None:
    done = fresh("help", "nonsense")
    assert done.returncode == 2
    assert "refusals" in done.stderr


def test_help_command_equals_its_help_option() -> None:
    assert fresh("help", "completion").stdout == fresh("completion", "--help").stdout


def test_completion_answers() -> None:
    done = fresh(COMP_WORDS="pmsmtool comp", COMP_CWORD="1", _PMSMTOOL_COMPLETE="bash_complete")
    assert (done.returncode, done.stdout) == (0, "plain,completion\n")
    done = fresh(COMP_WORDS="pmsmtool --tra", COMP_CWORD="1", _PMSMTOOL_COMPLETE="bash_complete")
    assert done.stdout == "plain,--trace-can\n"


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_script(shell: str) -> None:
    done = fresh("completion", shell)
    assert done.returncode == 0
    assert "_PMSMTOOL_COMPLETE" in done.stdout


def test_public_names_resolve_lazily() -> None:
    import pmsmtool

    for name in pmsmtool.__all__:
        assert getattr(pmsmtool, name).__name__ == name
    with pytest.raises(AttributeError, match="nonsense"):
        pmsmtool.nonsense  # noqa: B018
