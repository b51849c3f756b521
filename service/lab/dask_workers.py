"""Workers of a Dask cluster, of which a result counts only if its worker computes what this machine computes.

Each job carries the fingerprint of this machine (`sentinel`). A worker that has another one, or several threads,
refuses the job; it is named, and its jobs go to others. So a process that Dask starts anew is compared, too. The jobs
of a worker that dies are repeated by Dask itself.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Executor, Future
from functools import partial
from typing import Any, Final, NamedTuple

from distributed import Client, KilledWorker, Security, get_worker
from distributed.comm.core import connect

from aeroloop.protocol.runtime.host import versions
from aeroloop.service.lab.sentinel import fingerprint
from aeroloop.service.lab.workers import WorkersError

log: Final = logging.getLogger("aeroloop")

_PATIENCE_S: Final = 10.0
"""For the scheduler's answer [s]."""
_ALONE_S: Final = 10.0
"""For another worker, where only refused ones are left [s]."""
_RETRIES: Final = 2


class Answer(NamedTuple):
    """What a worker returns for a job: a result, or the reason why it has none."""

    worker: str
    result: Any = None
    refusal: str | None = None


def answer(expected: str, known: dict[str, str], work: Callable[..., Any], arguments: tuple[Any, ...]) -> Answer:
    """Do a job in a worker, if it has the expected fingerprint; `known` are the versions to compare with."""
    worker = get_worker()
    if (threads := worker.state.nthreads) > 1:  # they share an interpreter
        return Answer(worker.address, refusal=f"has {threads} threads; start it with --nthreads 1")
    if (mine := fingerprint()) == expected:
        return Answer(worker.address, work(*arguments))
    others = [f"{name} {mine} for {known.get(name)}" for name, mine in versions().items() if mine != known.get(name)]
    differs = ", ".join(others) or "another processor or C library"
    return Answer(
        worker.address, refusal=f"computes other figures than this machine: {mine} for {expected} ({differs})"
    )


async def _try(address: str) -> None:
    """Connect once: a client that fails but for want of an answer, such as for its certificate, never ends."""
    comm = await connect(address, timeout=_PATIENCE_S, **Security().get_connection_args("client"))
    await comm.close()


class DaskExecutor(Executor):
    """Dask's executor, without the results of workers that compute other figures.

    Args:
        address: Of the scheduler, such as `tcp://10.0.0.1:8786`; TLS as Dask's own configuration says.

    Raises:
        WorkersError: No scheduler answers.
    """

    def __init__(self, address: str) -> None:
        for name in ("distributed", "distributed.client"):  # what matters is raised here
            logging.getLogger(name).setLevel(logging.CRITICAL)
        self._address = address
        try:
            asyncio.run(_try(address))
            self._client = Client(address, timeout=_PATIENCE_S, set_as_default=False)
        except Exception as error:  # whatever the transport raises
            raise WorkersError(f"no Dask scheduler answers at {address}: {str(error).splitlines()[0]}") from None
        self._inner = self._client.get_executor(retries=_RETRIES, pure=False)
        self._expected, self._versions = fingerprint(), versions()
        self._allowed: frozenset[str] | None = None  # where jobs may run; None is everywhere
        self._refused = set[str]()
        self._restricted: dict[Future[Answer], frozenset[str]] = {}
        self._again: deque[tuple[Any, ...]] = deque()
        self._waits = False
        self._useful = time.monotonic()  # when there was a worker that may compute, or none at all

    def submit(self, work: Callable[..., Any], /, *arguments: Any, **_: Any) -> Future[Any]:
        """As of an executor; the future has only the result of a worker that computes what this machine does."""
        future: Future[Any] = Future()
        self._send(future, work, arguments)
        return future

    def _send(self, future: Future[Any], work: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
        where = {} if self._allowed is None else {"workers": sorted(self._allowed)}
        sent = self._inner.submit(answer, self._expected, self._versions, work, arguments, **where)
        if self._allowed is not None:
            self._restricted[sent] = self._allowed
        sent.add_done_callback(partial(self._receive, future, work, arguments))

    def _receive(
        self, future: Future[Any], work: Callable[..., Any], arguments: tuple[Any, ...], sent: Future[Answer]
    ) -> None:
        """Pass a result on, or keep the job for `watch`. Runs in Dask's thread."""
        self._restricted.pop(sent, None)
        if sent.cancelled():
            self._again.append((future, work, arguments))
        elif isinstance(error := sent.exception(), KilledWorker):
            future.set_exception(WorkersError(f"a job ended every worker that began it, at last {error.last_worker}"))
        elif error is not None:
            future.set_exception(error)
        elif (found := sent.result()).refusal is None:
            future.set_result(found.result)
        else:
            if found.worker not in self._refused:
                self._refused.add(found.worker)
                log.warning("worker %s does not count: it %s", found.worker, found.refusal)
            self._again.append((future, work, arguments))

    def watch(self) -> None:
        """Send jobs elsewhere that were refused, or that wait for workers that are gone.

        Raises:
            WorkersError: The scheduler does not answer, or only refused workers are left.
        """
        if self._client.status == "closed":  # after trying in vain to connect again
            raise WorkersError(f"the Dask scheduler at {self._address} is gone")
        if self._client.status != "running":
            return
        present = frozenset(self._client.scheduler_info()["workers"])
        if not present and not self._waits:
            log.warning("no worker at %s: waiting; `dask worker %s --nthreads 1` starts one", *(self._address,) * 2)
        self._waits = not present
        if self._refused:
            self._allowed = present - self._refused
        if not (present and self._allowed == frozenset()):
            self._useful = time.monotonic()
        elif time.monotonic() - self._useful > _ALONE_S:
            raise WorkersError(f"no worker at {self._address} is left that computes what this machine computes")
        for sent, where in list(self._restricted.items()):
            if not where & present:
                sent.cancel()
        while self._again and self._allowed != frozenset():
            self._send(*self._again.popleft())

    def abandon(self) -> None:
        """Cancel all jobs; what a worker has begun it ends, in vain."""
        if self._client.status == "running":
            self._inner.shutdown(wait=False)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:  # noqa: ARG002 - as of an executor
        """Leave the cluster, which cancels what is left."""
        self._client.close()
