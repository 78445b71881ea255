"""Workers that evaluate the blocks of a plan: threads of this process, or a Dask cluster.

Results come in the order of the blocks, each exactly once, even if its evaluation had to be
repeated; the number of blocks in progress is bounded.
"""

import itertools
import os
import pickle
import queue
import threading
import uuid
from collections import Counter, OrderedDict
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, ThreadPoolExecutor
from contextlib import AbstractContextManager
from time import monotonic
from typing import Any, Self

from stiffopt.errors import InputError, StiffoptError, require_package
from stiffopt.workspace.plan import TUNING, MapPlan
from stiffopt.workspace.table import MapPart

_POLL = 0.2  # s


class ClusterError(StiffoptError):
    """The cluster cannot be reached, or failed; what was done so far is kept."""


class ResultLostError(ClusterError):
    """The worker that had a result was lost before it had been fetched."""


def results(
    workers: "Threads | Cluster", blocks: range, poll: Callable[[], None] = lambda: None
) -> Iterator[MapPart]:
    """Yield the results of blocks in order; `poll` is called now and then while waiting.

    A block whose result is lost is computed again, a few times.
    """
    finished: queue.SimpleQueue[tuple[int, Any]] = queue.SimpleQueue()
    ready: dict[int, MapPart] = {}
    lost: Counter[int] = Counter()
    following = blocks.start

    def submit(number: int) -> None:
        workers.submit(number, lambda index, future: finished.put((index, future)))

    for index in blocks:
        while index not in ready:
            while following < min(blocks.stop, index + workers.width):
                submit(following)
                following += 1
            try:
                number, future = finished.get(timeout=_POLL)
            except queue.Empty:
                poll()
                workers.check()
                continue
            try:
                ready[number] = workers.result(future)
            except ResultLostError:
                lost[number] += 1
                if lost[number] > TUNING.retries:
                    raise
                submit(number)
        yield ready.pop(index)


class Threads(AbstractContextManager["Threads"]):
    """Threads of this process.

    By default there is one for each core.  For an arm with loads there is only one, as its
    equilibria are computed in Python, which would not run faster in several threads.
    """

    def __init__(self, plan: MapPlan, count: int | None = None) -> None:
        self._plan = plan
        plan.prepare()
        self._count = count or (1 if plan.robot.is_loaded else os.cpu_count() or 1)
        self._pool = ThreadPoolExecutor(self._count, thread_name_prefix="map")

    def __exit__(self, *_: object) -> None:
        self._pool.shutdown(wait=True, cancel_futures=True)

    @property
    def width(self) -> int:
        """Largest number of blocks in progress."""
        return 2 * self._count

    def submit(self, index: int, done: Callable[[int, Any], None]) -> None:
        """Start a block; `done` is called with its number and future, from any thread."""
        future = self._pool.submit(self._plan.evaluate, index)
        future.add_done_callback(lambda finished: done(index, finished))

    def result(self, future: Any) -> MapPart:
        """Return the result of a future that is done."""
        return future.result()

    def check(self) -> None:
        """Do nothing: threads do not get lost."""


class Cluster(AbstractContextManager["Cluster"]):
    """Workers of a Dask cluster; stiffopt must be installed there in the same version."""

    def __init__(self, plan: MapPlan, address: str) -> None:
        self._client = _client(address)
        try:
            self._payload = pickle.dumps(plan)
            self._token = plan.token
            self._run = uuid.uuid4().hex  # distinguishes the results of runs
            self._futures: set[Any] = set()
            self._serial = itertools.count()
            self._seen = monotonic()
            self._threads = self._count_threads(wait=TUNING.cluster_patience)
        except BaseException:
            self._client.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        try:
            self._client.cancel(list(self._futures), force=True)
        except Exception:  # the cluster may be gone
            pass
        finally:
            self._futures.clear()
            self._client.close(timeout=5)

    @property
    def width(self) -> int:
        """Largest number of blocks in progress."""
        return 3 * self._threads + 2

    def submit(self, index: int, done: Callable[[int, Any], None]) -> None:
        """Start a block; see `Threads.submit`."""
        future = self._client.submit(
            _evaluate_on_worker, self._token, self._payload, index,
            key=f"stiffopt-map-{self._run}-{index}-{next(self._serial)}", pure=False,
            retries=TUNING.retries,
        )  # fmt: skip
        self._futures.add(future)
        future.add_done_callback(lambda finished: done(index, finished))

    def result(self, future: Any) -> MapPart:
        """Return a done future's result; `ClusterError` if it is lost or the cluster gave up."""
        self._futures.discard(future)
        try:
            token, block = future.result(timeout=TUNING.cluster_patience)
        except StiffoptError:
            raise
        except TimeoutError as error:  # it was done, so nothing but its transfer can take long
            raise ResultLostError("the cluster has lost a finished result") from error
        except (Exception, CancelledError) as error:
            raise ClusterError(
                f"the cluster failed: {type(error).__name__}: {str(error) or 'no reason given'}"
            ) from error
        if token != self._token:
            raise ClusterError(
                "the cluster's workers interpret the map differently from this process; "
                "install the same version of stiffopt everywhere"
            )
        self._seen = monotonic()
        return block

    def check(self) -> None:
        """Raise `ClusterError` if no result can come any more; distributed first reconnects."""
        if self._client.status != "running" and monotonic() - self._seen > TUNING.cluster_patience:
            raise ClusterError("the connection to the scheduler is lost")
        if monotonic() - self._seen > TUNING.cluster_patience:
            self._threads = self._count_threads(wait=0.0)
            self._seen = monotonic()

    def _count_threads(self, wait: float) -> int:
        """Return the number of threads of all workers; wait for the first worker."""
        try:
            if wait:
                self._client.wait_for_workers(1, timeout=wait)
            count = int(sum(self._client.nthreads().values()))
        except (OSError, TimeoutError, RuntimeError) as error:
            raise ClusterError(
                f"the scheduler has no workers: {error}; start some and run again"
            ) from None
        if not count:
            raise ClusterError("the scheduler has lost all its workers; start some and run again")
        return count


def _client(address: str) -> Any:
    require_package("distributed", "dask")
    import distributed

    connect: Any = distributed.Client
    try:
        return connect(
            address, timeout=TUNING.cluster_patience, set_as_default=False, name="stiffopt-map"
        )
    except ValueError as error:
        raise InputError(
            f"'{address}' is not the address of a scheduler ({error}); "
            "expected one such as tcp://10.0.0.5:8786"
        ) from None
    except (OSError, TimeoutError) as error:
        raise ClusterError(
            f"no scheduler answers at {address}: {str(error).splitlines()[0] if str(error) else ''}"
        ) from None


_plans: OrderedDict[str, MapPlan] = OrderedDict()
_plans_lock = threading.Lock()
_PLANS_KEPT = 4


def _evaluate_on_worker(token: str, payload: bytes, index: int) -> tuple[str, MapPart]:
    """Return the plan's token, as computed on this worker, and the result of a block.

    The plan and its compiled functions are cached for the next block.
    """
    with _plans_lock:
        if token not in _plans:
            plan = pickle.loads(payload)
            plan.prepare()
            _plans[token] = plan
            while len(_plans) > _PLANS_KEPT:
                _plans.popitem(last=False)
        plan = _plans[token]
    return plan.token, plan.evaluate(index)
