# SPDX-License-Identifier: MIT
"""A small part of ``benchmarks/fuzz.py``: damaged files of every kind end in one of our errors, never in another."""

import json
import random

import pytest

from benchmarks import fuzz
from pmsmtool.errors import ConfigError, PmsmtoolError
from pmsmtool.run_directory import RunDirectory

EACH = 30


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", [*fuzz.TEXTS, *fuzz.BINARIES])
def test_the_undamaged_file_is_read(name: str) -> None:
    """Otherwise every damaged one is refused at the same first check."""
    if name in fuzz.TEXTS:
        text, read = fuzz.TEXTS[name]
        read(text)
    else:
        make, use = fuzz.BINARIES[name]
        use(make())


@pytest.mark.parametrize("name", [*fuzz.TEXTS, *fuzz.BINARIES])
def test_damaged_files_end_in_our_errors(name):
    rng, refused = random.Random(f"suite {name}"), 0
    if name in fuzz.TEXTS:
        text, read = fuzz.TEXTS[name]
        attempts = [lambda: read(fuzz.damaged(text, rng))] * EACH
    else:
        make, use = fuzz.BINARIES[name]
        data = make()
        attempts = [lambda: use(fuzz.damaged_bytes(data, rng))] * EACH
    for attempt in attempts:
        try:
            attempt()
        except PmsmtoolError:
            refused += 1
    assert refused > 0 or name in ("eds", "dcf")  # data sheets are read with warnings


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda body: body["stages"][0].update(status="half done"), "[0] status = 'half done' is not one of pass"),
        (
            lambda body: body["stages"][1]["values"][0].pop("systematic"),
            "stages[1] values[0]: systematic is not",
        ),
        (lambda body: body["stages"][0]["acceptance"][0].update(ok=1), "stages[0] acceptance[0]: ok is int, not bool"),
        (lambda body: body["stages"][0].update(files=["a"]), "stages[0] files is list, not Mapping"),
        (lambda body: body.update(stages={}), "stages is dict, not Sequence"),
        (lambda body: body.update(state="odd"), "state: unknown"),
        (lambda body: body.pop("operator"), "operator is missing"),
    ],
)
def test_a_run_of_an_unknown_state_is_refused_with_all_that_is_wrong(tmp_path, change, said):
    body = json.loads(fuzz._record())
    path = tmp_path / "run.json"
    path.write_text(json.dumps(body))
    assert RunDirectory(tmp_path).read().passed("identify")
    change(body)
    body["bus"] = 3
    path.write_text(json.dumps(body))
    with pytest.raises(ConfigError) as caught:
        RunDirectory(tmp_path).read()
    assert any(said in violation for violation in caught.value.violations)
    assert "bus is int, not Mapping" in caught.value.violations
