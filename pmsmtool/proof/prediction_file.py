# SPDX-License-Identifier: MIT
"""A prediction as the arrays of the ``.npz`` file that is committed before the first step."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pmsmtool.arrays import Array
from pmsmtool.design.prediction import Band, Fault, Prediction, Quantity
from pmsmtool.errors import ConfigError, next_step

NEXT_STEP = "prove again: the prediction beside the traces was damaged"

SCHEMA = "pmsmtool.prediction/1"


def to_arrays(prediction: Prediction) -> dict[str, NDArray[Any]]:
    """Return the members of the ``.npz`` file; :func:`from_arrays` brings it back."""
    arrays: dict[str, NDArray[Any]] = {f"time|{name}": t for name, t in prediction.t_s.items()}
    for (experiment, signal), band in prediction.bands.items():
        arrays[f"mean|{experiment}|{signal}"], arrays[f"std|{experiment}|{signal}"] = band.mean, band.std
    for name, quantity in prediction.quantities.items():
        arrays |= {f"signature|{name}|{e}|{s}": weights for (e, s), weights in quantity.signature.items()}
    for name, fault in prediction.faults.items():
        for experiment, signal in fault.mean:
            key = f"{name}|{experiment}|{signal}"
            arrays[f"fault_mean|{key}"] = fault.mean[experiment, signal]
            arrays[f"fault_std|{key}"] = fault.std[experiment, signal]
    facts = {
        "schema": SCHEMA,
        "factor": {f"{e}|{s}": band.factor for (e, s), band in prediction.bands.items()},
        "quantity": {
            name: {
                "nominal": q.nominal,
                "unit": q.unit,
                "low": q.low,
                "high": q.high,
                "below": q.below,
                "above": q.above,
            }
            for name, q in prediction.quantities.items()
        },
        "fault": {name: fault.text for name, fault in prediction.faults.items()},
        "facts": dict(prediction.facts),
    }
    return {**arrays, "_meta": np.array(json.dumps(facts))}


@next_step(NEXT_STEP)
def from_arrays(arrays: Mapping[str, NDArray[Any]], *, where: str = "prediction") -> Prediction:
    """Read what :func:`to_arrays` made. Raises ConfigError: it is not a prediction."""
    try:
        facts = json.loads(str(arrays["_meta"]))
        if facts["schema"] != SCHEMA:
            raise ConfigError(f"schema is {facts['schema']!r}, expected {SCHEMA!r}", where=where)
        groups: dict[str, dict[tuple[str, ...], Array]] = {}
        for name, values in arrays.items():
            group, *key = name.split("|")
            groups.setdefault(group, {})[tuple(key)] = np.asarray(values)
        bands = {
            (e, s): Band(mean, groups["std"][e, s], float(facts["factor"][f"{e}|{s}"]))
            for (e, s), mean in groups["mean"].items()
        }
        quantities = {
            name: Quantity(**entry, signature=_under(groups.get("signature", {}), name))
            for name, entry in facts["quantity"].items()
        }
        faults = {
            name: Fault(text, _under(groups.get("fault_mean", {}), name), _under(groups.get("fault_std", {}), name))
            for name, text in facts["fault"].items()
        }
        times = {name: t for (name,), t in groups["time"].items()}
        return Prediction(times, bands, quantities, faults, facts["facts"])
    except (KeyError, ValueError, TypeError) as error:
        if isinstance(error, ConfigError):
            raise
        raise ConfigError(f"is no prediction: {error}", where=where) from error


def _under(group: Mapping[tuple[str, ...], Array], name: str) -> dict[tuple[str, str], Array]:
    return {(key[1], key[2]): values for key, values in group.items() if key[0] == name}
