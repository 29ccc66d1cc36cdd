# SPDX-License-Identifier: MIT
"""The step that a report's page computes, against the same step of the compiled kernel, bit for bit.

``python -m benchmarks.recomputed_page --designs 1000`` draws machines and values that a reader may move to, runs the
page's script in node and the kernel here, and counts the steps of which a byte differs.
"""

from __future__ import annotations

import argparse
import base64
import ctypes
import json
import shutil
import struct
import subprocess
import sys
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.random_drives import draw_drive
from pmsmtool.commissioning.recomputed_page import recomputed
from pmsmtool.design.design_file import Design
from pmsmtool.design.tune import tune
from pmsmtool.design.tune_request import TuneRequest
from pmsmtool.errors import DesignInfeasible
from pmsmtool.proof.simulated_margins import MOVED, SHIFT, SIGNALS, StepTask, step_task
from pmsmtool.report.report import template
from pmsmtool.sim.kernel import Part, Setup, Simulation, Target

GOVERNORS = ("off", "line", "best")
"""Those whose design takes no seconds."""
LEAD = r"""
const fs = require("fs"), input = fs.readFileSync(0, "utf8").split("\n").filter(Boolean).map(line => JSON.parse(line));
(async () => {
  for (const {data, asked} of input) {
    const document = {getElementById: () => ({textContent: data})};
    const drive = await Function("document", SCRIPT + "; return loaded;")(document);
    const text = row => Buffer.from(row.buffer).toString("base64");
    const rows = asked.map(([machine, moved]) => drive.run(machine, moved).map(text));
    console.log(JSON.stringify(rows));
  }
})();
"""


Asked = list[tuple[int, Mapping[str, float]]]
"""Machines and the values they are moved to."""


def in_node(given: list[tuple[Mapping[str, Any], Asked]]) -> Iterator[list[list[bytes]]]:
    """Run steps by the page's script: per page its data and (machine, moved values); yields the signals' bytes."""
    script = f"const SCRIPT = {json.dumps(template('recompute.js.j2').render())};{LEAD}"
    lines = "".join(json.dumps({"data": str(page["data"]), "asked": asked}) + "\n" for page, asked in given)
    done = subprocess.run(["node", "-e", script], input=lines, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(done.stderr)
    for line in done.stdout.splitlines():
        yield [[base64.b64decode(signal) for signal in step] for step in json.loads(line)]


def by_kernel(task: StepTask, machine: int, moved: Mapping[str, float]) -> NDArray[np.float64]:
    """Run one step by the compiled kernel; shape (signals, periods)."""
    setup = bytearray(task.setups[machine])
    for name, places in MOVED.items():
        for at in places.setup:
            struct.pack_into("<d", setup, at, struct.unpack_from("<d", setup, at)[0] * moved[name])
    struct.pack_into("<d", setup, SHIFT, -moved["delay"] * task.T_s)
    simulation = Simulation(Setup.from_buffer_copy(setup), task.image)
    for name, places in MOVED.items():
        for at in places.params:
            held = ctypes.c_float.from_address(simulation.part(Part.PARAMS) + at)
            held.value = held.value * moved[name]
    for target, t_s, values in task.schedules:
        simulation.schedule(Target(target), t_s, values)
    record = simulation.record(list(SIGNALS.values()), task.periods)
    simulation.reference.mode = task.mode
    simulation.word(Part.ENABLED).value = 1
    simulation.run(task.periods)
    return np.ascontiguousarray(record.T)


def random_design(seed: int) -> Design | None:
    """Return a design of a drawn machine, one of the governors, predictor or not; None where there is none."""
    rng = np.random.default_rng([seed, 7])
    machine = replace(draw_drive(seed), simulation={})
    request = TuneRequest(predictor=bool(rng.integers(2)), governor=str(rng.choice(GOVERNORS)))
    try:
        return tune(machine, request)
    except DesignInfeasible:
        return None


def random_moves(page: Mapping[str, Any], rng: np.random.Generator) -> dict[str, float]:
    """Return values that the sliders of a page can have."""
    found = {}
    for name, slider in page["sliders"].items():
        steps = round((slider["most"] - slider["least"]) / slider["step"])
        found[name] = float(slider["least"] + slider["step"] * int(rng.integers(steps + 1)))
    return found


def differing(seeds: list[int]) -> tuple[int, int]:
    """Return the steps that were compared, and those of which a byte differs."""
    given: list[tuple[Mapping[str, Any], Asked]] = []
    tasks = []
    for seed in seeds:
        design = random_design(seed)
        if design is None:
            continue
        page, task, rng = recomputed(design), step_task(design), np.random.default_rng([seed, 8])
        given.append((page, [(int(rng.integers(len(task.setups))), random_moves(page, rng))]))
        tasks.append(task)
    wrong = 0
    for task, (_, asked), (seen,) in zip(tasks, given, in_node(given), strict=True):
        wrong += b"".join(seen) != by_kernel(task, *asked[0]).tobytes()
    return len(tasks), wrong


def main() -> int:
    """Compare, a hundred designs at a time; exit 1 where a byte differs."""
    parser = argparse.ArgumentParser(description="Compare the step of a report's page with that of the kernel.")
    parser.add_argument("--designs", type=int, default=1000)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    options = parser.parse_args()
    if shutil.which("node") is None:
        parser.error("node is not installed: it runs the page's script")
    compared = wrong = 0
    for start in range(options.first, options.first + options.designs, 100):
        counts = differing(list(range(start, min(start + 100, options.first + options.designs))))
        compared, wrong = compared + counts[0], wrong + counts[1]
    print(f"{compared} designs, {wrong} of their steps differ")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
