"""Episodes on Ray, on this or on many machines: `pip install "polyexplore-gym[ray]"`.

A backend for joblib of its own: that of `ray.util.joblib` gives its results only when all have ended, and
hands tasks to fixed workers in turn, whether they are busy or not (it kept two workers 61 % busy with
tasks of uneven length, this one 90 %). Here every episode is a task of Ray, which gives it to any free
core, and runs it again, up to three times, when its worker dies.
"""

from __future__ import annotations

import logging
import os
import socket
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from typing import Any

from joblib.parallel import ParallelBackendBase

from polyexplore_gym.errors import InvalidConfigError, MissingDependencyError


@contextmanager
def cluster(address: str | None, workers: int) -> Iterator[int]:
    """Connect to a Ray cluster and yield the number of its cores; one that is connected already is used.

    Args:
        address: of a running cluster: "auto", "host:port" or "ray://host:port"; None: start one on this machine.
        workers: cores of a cluster on this machine.

    Raises:
        MissingDependencyError: Ray is not installed.
        InvalidConfigError: there is no cluster at the address, or none can be started.
    """
    try:
        import ray
    except ImportError as error:
        raise MissingDependencyError(
            f'the backend ray needs Ray: pip install "polyexplore-gym[ray]" ({error})'
        ) from error
    ours = not ray.is_initialized()
    if ours:
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        local: dict[str, Any] = {} if address else {"num_cpus": workers, "include_dashboard": False}
        host, _, port = (address or "").removeprefix("ray://").rpartition(":")
        try:
            if host:  # nobody there? Ray itself would try for minutes
                socket.create_connection((host.strip("[]"), int(port)), timeout=20).close()
            ray.init(address or "local", log_to_driver=False, logging_level=logging.ERROR, **local)
        except Exception as error:  # Ray raises a bare one when it does not come up in time
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            if not address:
                raise InvalidConfigError(f"Ray does not start on this machine: {reason}") from error
            raise InvalidConfigError(
                f"no Ray cluster at {address}: {reason} (one that asks for a token takes it from RAY_AUTH_TOKEN, with "
                "RAY_AUTH_MODE=token)"
            ) from error
    try:
        yield int(ray.cluster_resources().get("CPU", 1))
    finally:
        if ours:
            ray.shutdown()


class RayBackend(ParallelBackendBase):
    """joblib's tasks as tasks of the cluster that is connected."""

    supports_retrieve_callback = True

    def effective_n_jobs(self, n_jobs: int) -> int:
        """As many as are asked for."""
        return n_jobs

    def configure(self, n_jobs: int = 1, parallel: Any = None, **_: Any) -> int:
        """Called by joblib before the first task."""
        import ray

        self.parallel = parallel
        self._call = ray.remote(_call)
        self._waiting: dict[Future, Any] = {}
        return n_jobs

    def submit(self, func: Callable[[], Any], callback: Callable[[Future], None] | None = None) -> Future:
        """Hand a task to Ray; `callback` is called with its future when it has ended."""
        reference = self._call.remote(func)
        future = reference.future()
        self._waiting[future] = reference
        future.add_done_callback(lambda done: self._waiting.pop(done, None))
        if callback is not None:
            future.add_done_callback(callback)
        return future

    def retrieve_result_callback(self, out: Future) -> Any:
        """The result of a task, or what it raised; `TerminatedWorkerError` when its worker died again and again."""
        from joblib.externals.loky.process_executor import TerminatedWorkerError
        from ray.exceptions import RayError, RayTaskError

        try:
            return out.result()
        except RayTaskError as error:
            raise error.cause from None
        except RayError as error:
            raise TerminatedWorkerError(str(error)) from error

    def abort_everything(self, ensure_ready: bool = True) -> None:
        """Stop what is running and forget what waits."""
        import ray

        for reference in list(self._waiting.values()):
            ray.cancel(reference, force=True)


def _call(func: Callable[[], Any]) -> Any:
    return func()
