# SPDX-License-Identifier: MIT
"""Who does the work of a batch: this process, a pool of processes, or a Dask cluster."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from pmsmtool.errors import BusError, NotAvailable


@contextmanager
def executor(scheduler: str, workers: int | None = None) -> Iterator[Any]:
    """Open an executor with ``map``, as ``concurrent.futures``.

    Parameters
    ----------
    scheduler : str
        ``local`` (this process; None is given), ``processes``, or the address of a Dask scheduler
        (``tcp://host:8786``).
    workers : int, optional
        Processes of the pool.

    Raises
    ------
    NotAvailable
        The extra ``cluster`` is not installed.
    BusError
        The cluster does not answer.
    """
    if scheduler == "local":
        yield None
    elif scheduler == "processes":
        import concurrent.futures
        import multiprocessing

        # spawn: the parent may hold threads (a bus, a plot), which a forked child would inherit locked
        context = multiprocessing.get_context("spawn")
        with concurrent.futures.ProcessPoolExecutor(workers, mp_context=context) as pool:
            yield pool
    else:
        yield from _cluster(scheduler)


def _cluster(address: str) -> Iterator[Any]:
    try:
        Client = importlib.import_module("distributed").Client
    except ImportError:
        raise NotAvailable(
            "a Dask cluster needs the package distributed",
            where=f"--scheduler {address}",
            hint="pip install 'pmsmtool[cluster]', or --scheduler processes",
        ) from None
    try:
        client = Client(address, timeout="10s", set_as_default=False)
    except (OSError, ValueError) as error:
        raise BusError(
            f"no Dask scheduler answers: {error}",
            where=f"--scheduler {address}",
            hint="start one with `dask scheduler`, or --scheduler processes",
        ) from error
    with client:
        yield client.get_executor(pure=False, retries=3)
