"""Runs units on a Dask cluster, using dask.distributed, an optional dependency.

If a worker is lost, Dask runs its unit again on another worker.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

from skinnode.errors import ConfigError, Shown, SkinError
from skinnode.process.closing import Closing
from skinnode.resolve import identity as identity_module
from skinnode.resolve.identity import difference, identity
from skinnode.resolve.processes import one_line_of
from skinnode.resolve.units import Unit, refused, run_unit
from skinnode.resolve.workers import MOST_DEATHS

_CONNECT_S: Final = 10.0
_GONE_S: Final = 20.0
"""Time without a connection to the scheduler after which the cluster is considered lost, in s."""


def require_dask() -> None:
    """Raise ConfigError if dask.distributed is not installed."""
    if find_spec("distributed") is None:
        allowed = "the package of the cluster extra (install: sh install.sh cluster)"
        raise ConfigError("--scheduler", Shown("no package distributed"), allowed)


class Cluster(Closing):
    """Workers of a Dask cluster. All workers must have this version of skinnode and access to the same files.

    Args:
        address: Address of the scheduler.
        folder: The work folder.

    Raises:
        ConfigError: dask.distributed is not installed, or no scheduler answers at the address.
        SkinError: A worker has different software, or there are no workers.
    """

    def __init__(self, address: str, folder: Path) -> None:
        require_dask()
        import cloudpickle
        from distributed import Client

        self._address, self._folder = address, folder
        self._futures: dict[Any, Unit] = {}
        self._gone_s = 0.0
        try:
            self._client = Client(address, timeout=_CONNECT_S)
        except (OSError, ValueError, TimeoutError) as error:
            allowed = "the address of a running Dask scheduler, such as tcp://host:8786"
            raise ConfigError("--scheduler", address, f"{allowed} ({one_line_of(error)[:80]})") from None
        self._identity = identity()
        try:
            cloudpickle.register_pickle_by_value(identity_module)  # a worker may lack this module
            try:
                found = self._client.run(identity, on_error="return")
            finally:
                cloudpickle.unregister_pickle_by_value(identity_module)
            self._check(found)
            self._count = sum(self._client.nthreads().values())
        except BaseException:
            self.close()
            raise

    def _check(self, found: dict[str, Any]) -> None:
        if not found:
            raise SkinError(f"--scheduler: the cluster at {self._address} has no workers; start some")
        for worker, theirs in found.items():
            if isinstance(theirs, BaseException):
                raise SkinError(f"worker {worker}: does not answer ({one_line_of(Exception(theirs))})")
            other = difference(self._identity, theirs)
            if other is not None:
                raise refused(worker, other)

    @property
    def count(self) -> int:
        """Number of units that can run at the same time."""
        return int(self._count)

    def submit(self, unit: Unit) -> None:
        """Run a unit as soon as a worker is free."""
        folder = str(self._folder)
        # another command on this cluster may run the same unit, but for its own work folder
        key = f"skinnode-{unit.key}-{hashlib.sha256(folder.encode()).hexdigest()[:8]}"
        future = self._client.submit(_run_here, unit, folder, self._identity, key=key, pure=False)
        self._futures[future] = unit

    def finished(self, timeout_s: float) -> Sequence[str]:
        """Wait for finished units; see :meth:`Workers.finished`."""
        from distributed import wait
        from distributed.client import FuturesCancelledError

        if not self._futures:
            return []
        try:
            wait(list(self._futures), timeout=timeout_s, return_when="FIRST_COMPLETED")
        except TimeoutError:
            pass
        except FuturesCancelledError:
            raise self._gone() from None
        self._require_connection(timeout_s)
        done = [future for future in self._futures if future.done()]
        return [self._result(future, self._futures.pop(future)) for future in done]

    def _require_connection(self, timeout_s: float) -> None:
        self._gone_s = 0.0 if self._client.status == "running" else self._gone_s + timeout_s
        if self._client.status == "closed" or self._gone_s >= _GONE_S:
            raise self._gone()

    def _result(self, future: Any, unit: Unit) -> str:
        from distributed.client import FutureCancelledError
        from distributed.comm.core import CommClosedError
        from distributed.scheduler import KilledWorker

        try:
            return str(future.result(timeout=_CONNECT_S))
        except SkinError as error:
            raise SkinError(f"{unit}: {error}") from None
        except KilledWorker:
            raise SkinError(
                f"{unit}: its worker ended {MOST_DEATHS} times; if memory is short, use fewer threads"
            ) from None
        except (FutureCancelledError, CommClosedError, TimeoutError):
            raise self._gone() from None
        except Exception as error:
            raise SkinError(f"{unit}: {one_line_of(error)}") from error

    def _gone(self) -> SkinError:
        return SkinError(
            f"--scheduler: the cluster at {self._address} is gone; "
            "start it and run the same command again to continue"
        )

    def close(self) -> None:
        """Cancel the units and close the connection; the cluster keeps running."""
        with suppress(Exception):  # the cluster may be gone
            self._client.cancel(list(self._futures))
        with suppress(Exception):
            self._client.close(timeout=2)


def _run_here(unit: Unit, folder: str, expected: dict[str, str]) -> str:
    """Run a unit on a Dask worker."""
    from distributed import get_worker

    return run_unit(unit, folder, expected, str(get_worker().address))
