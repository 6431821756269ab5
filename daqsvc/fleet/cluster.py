"""The cluster that judges: one of this computer's processes, or one that somebody has started."""

from __future__ import annotations

import contextlib
import logging
import re
import tempfile
from typing import TYPE_CHECKING, Any

from daqsvc.fleet import FleetError

if TYPE_CHECKING:
    from collections.abc import Iterator

CONNECT_S = 15.0
"""How long a scheduler, and then its first worker, is waited for."""
_LOCAL = re.compile(r"local(?::([1-9][0-9]{0,2}))?")
_REMOTE = re.compile(r"(tcp|tls|ws|wss|ucx)://[^/\s]+")


def cluster_problem(name: str) -> str:
    """What is wrong with the name of a cluster; empty if nothing is."""
    if _LOCAL.fullmatch(name) or _REMOTE.fullmatch(name):
        return ""
    return f"{name!r} is no cluster; write local, local:N with up to 999 workers, or tcp://scheduler:8786"


@contextlib.contextmanager
def connected(name: str, cores: int) -> Iterator[Any]:
    """A client of the cluster, for as long as it is needed.

    Args:
        name: ``local``, ``local:N`` with N workers, or the address of a scheduler.
        cores: workers of ``local``.

    Raises:
        FleetError: there is no scheduler, or it has no workers.
    """
    local = _LOCAL.fullmatch(name)
    if local is None:
        with _remote(name) as client:
            yield client
        return
    with _local(int(local[1] or cores)) as client:
        yield client


@contextlib.contextmanager
def _local(workers: int) -> Iterator[Any]:
    """Processes that only this one can talk to: on loopback, by their own certificates."""
    import dask  # noqa: PLC0415 - of the extra
    from distributed import Client, LocalCluster  # noqa: PLC0415

    with (
        # Who starts a worker again is itself given up if that takes longer, as on a busy computer.
        dask.config.set({"distributed.deploy.lost-worker-timeout": "10 minutes"}),
        tempfile.TemporaryDirectory(prefix="daqsvc-fleet-", ignore_cleanup_errors=True) as folder,
        LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            processes=True,
            host="127.0.0.1",
            dashboard_address="127.0.0.1:0",
            worker_dashboard_address=None,
            local_directory=folder,
            security=True,
            silence_logs="CRITICAL",
        ) as cluster,
        Client(cluster, set_as_default=False) as client,
    ):
        yield client


@contextlib.contextmanager
def _remote(address: str) -> Iterator[Any]:
    from distributed import Client  # noqa: PLC0415 - of the extra

    with _silent(), _client(Client, address) as client:
        try:
            client.wait_for_workers(1, timeout=CONNECT_S)
        except TimeoutError:
            raise FleetError(
                f"the scheduler at {address} has no worker; start one: dask worker {address} --nthreads 1"
            ) from None
        yield client


def _client(make: Any, address: str) -> Any:
    """A client of a scheduler that somebody has started.

    Raises:
        FleetError: it does not answer.
    """
    try:
        return make(address, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError, TypeError, RuntimeError) as error:
        # The libraries below give the reason in several lines; an address without a port is a TypeError.
        why = " ".join(f"{error}".split())[:200]
        raise FleetError(
            f"no Dask scheduler answers at {address} ({why}); start one there (dask scheduler), or use "
            "--cluster local"
        ) from None


@contextlib.contextmanager
def _silent() -> Iterator[None]:
    """Have Dask log nothing: the loss of a cluster is reported in one sentence."""
    with contextlib.ExitStack() as stack:
        # Some have a level and a handler of their own, so that to silence their parent is not enough.
        for name, logger in list(logging.root.manager.loggerDict.items()):
            if name.partition(".")[0] == "distributed" and isinstance(logger, logging.Logger):
                stack.callback(logger.setLevel, logger.level)
                logger.setLevel(logging.CRITICAL)
        yield
