"""Call functions on NumPy arrays, row by row: machine code or the CasADi VM."""

from __future__ import annotations

import ctypes
import os
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from stiffopt.arrays import Array
from stiffopt.model.codegen import Signature

_CHUNK = 4096  # rows that a thread takes at a time
_BLOCK = 256  # rows that the VM evaluates at a time
_SMALL_BLOCK = 16  # for fewer rows


class _RowMemory(NamedTuple):
    """Memory of a number of rows."""

    inputs: Sequence[Array]  # contiguous
    strides: Sequence[int]  # numbers from one row to the next, of each input; 0: it is shared
    outputs: Sequence[Array]  # each (number, r, c)
    number: int


class BatchFunction(ABC):
    """A function of matrices, called for one row or for many.

    Arguments and results are arrays (r, c), but an argument that is a column (k, 1) is given as
    (k,).  Every function may be called from several threads at once.
    """

    _targets: Sequence[Array]
    """Memory of one set of arguments; for columns (k,)."""
    _results: Sequence[Array]

    def __init__(self, signature: Signature) -> None:
        self.signature = signature
        self._lock = threading.Lock()

    def __call__(self, *arguments: Any) -> list[Array]:
        """Return the results, each (r, c), for one set of arguments."""
        with self._lock:
            for target, argument in zip(self._targets, arguments, strict=True):
                target[...] = argument
            self._evaluate_one()
            return [result.copy() for result in self._results]

    def many(self, *arguments: Array, threads: int | None = None) -> list[Array]:
        """Return the results, each (N, r, c), for N rows, on `threads` threads or all cores.

        An argument is (N, ...) or, if it is the same for all rows, without the leading axis;
        the first one must have it.
        """
        count = len(arguments[0])
        inputs: list[Array] = []
        strides: list[int] = []
        for argument, (rows, columns) in zip(arguments, self.signature.inputs, strict=True):
            size = rows * columns
            values = np.ascontiguousarray(argument, dtype=float)
            each = not inputs or not is_shared(values, (rows, columns))
            if values.size != (count * size if each else size):
                raise ValueError(
                    f"expected ({rows}, {columns}) for each of {count} rows; got {values.shape}"
                )
            inputs.append(values)
            strides.append(size if each else 0)
        outputs = [np.empty((count, *shape)) for shape in self.signature.outputs]
        if count:
            self._evaluate(_RowMemory(inputs, strides, outputs, count), threads)
        return outputs

    @abstractmethod
    def _evaluate_one(self) -> None:
        """Fill `_results` from `_targets`."""

    @abstractmethod
    def _evaluate(self, rows: _RowMemory, threads: int | None) -> None:
        """Fill the outputs of rows from their inputs."""


class CompiledFunction(BatchFunction):
    """A function in machine code."""

    def __init__(self, rows: Callable[..., int], signature: Signature) -> None:
        super().__init__(signature)
        pointer = ctypes.c_void_p
        self._rows = rows
        self._rows.argtypes = [  # type: ignore[attr-defined]
            pointer, pointer, pointer, ctypes.c_int64, ctypes.c_int64, pointer, pointer,
        ]  # fmt: skip
        self._inputs = [np.zeros(shape) for shape in signature.inputs]
        self._targets = [
            buffer[:, 0] if buffer.shape[1] == 1 else buffer for buffer in self._inputs
        ]
        self._results = [np.zeros(shape) for shape in signature.outputs]
        self._arrays = _Pointers(self._inputs, [0] * len(self._inputs), self._results)
        self._work = _Work(signature)
        self._call = (*self._arrays.addresses, 0, 1, *self._work.addresses)

    def _evaluate_one(self) -> None:
        if self._rows(*self._call):
            raise ArithmeticError("compiled code failed")

    def _evaluate(self, rows: _RowMemory, threads: int | None) -> None:
        arrays = _Pointers(rows.inputs, rows.strides, rows.outputs)
        failures: list[int] = []

        def work(starts: Iterator[int]) -> None:
            own = _Work(self.signature)
            for start in starts:
                end = min(start + _CHUNK, rows.number)
                if self._rows(*arrays.addresses, start, end, *own.addresses):
                    failures.append(start)

        in_parallel(work, range(0, rows.number, _CHUNK), threads)
        if failures:
            raise ArithmeticError("compiled code failed")


class InterpretedFunction(BatchFunction):
    """A function in the CasADi VM, without the overhead of CasADi's own calls."""

    def __init__(self, function: ca.Function) -> None:
        super().__init__(Signature.of(function))
        self._function = function
        single = Buffer(function, 1)
        self._targets, self._results = single.targets, single.results
        self._single, self._blocks = single, dict[int, Buffer]()

    def _evaluate_one(self) -> None:
        self._single.evaluate()

    def _evaluate(self, rows: _RowMemory, threads: int | None) -> None:
        inputs, strides, outputs, count = rows
        with self._lock:
            size = _BLOCK if count >= _BLOCK else _SMALL_BLOCK
            if size not in self._blocks:
                self._blocks[size] = Buffer(self._function, size)
            block = self._blocks[size]
            shapes = self.signature.inputs
            for start in range(0, count, size):
                filled = min(size, count - start)
                for buffer, values, stride, shape in zip(
                    block.targets, inputs, strides, shapes, strict=True
                ):
                    if stride:
                        whole = values.reshape(count, *_own(shape))
                        buffer[:filled] = whole[start : start + filled]
                    elif start == 0:
                        buffer[...] = values.reshape(_own(shape))
                block.evaluate()
                for output, result in zip(outputs, block.results, strict=True):
                    output[start : start + filled] = result[:filled]


class Buffer:
    """A CasADi function, mapped over a number of rows, with its own memory.

    Parameters
    ----------
    function, rows : the function, and the number of rows.
    before : a buffer whose results are the first arguments: both share their memory.

    Attributes
    ----------
    targets, results : views (rows, r, c) of arguments and results, without the leading axis for one
        row; arguments that are columns lack the last axis. Arguments from `before` are left out.
    """

    def __init__(self, function: ca.Function, rows: int, before: Buffer | None = None) -> None:
        mapped = function if rows == 1 else function.map(rows)
        buffer, self.evaluate = mapped.buffer()
        self._keep: list[Any] = [mapped, buffer]
        self.targets: list[Array] = []
        self.results: list[Array] = []
        shared = [] if before is None else before.results
        for k, result in enumerate(shared):
            assert function.size_in(k) == result.shape[-2:]  # CasADi would read on
            if result.size:  # its memory is by columns
                buffer.set_arg(k, result.swapaxes(-1, -2).reshape(-1).data)
        self._keep.append(before)
        for k in range(len(shared), function.n_in()):
            view = self._memory(rows, function.size_in(k), buffer.set_arg, k)
            self.targets.append(view[..., 0] if view.shape[-1] == 1 else view)
        for k in range(function.n_out()):
            self.results.append(self._memory(rows, function.size_out(k), buffer.set_res, k))

    def _memory(
        self, rows: int, shape: tuple[int, int], register: Callable[..., None], index: int
    ) -> Array:
        memory = np.zeros((rows, shape[1], shape[0]))  # CasADi stores matrices by columns
        if memory.size:
            register(index, memory.reshape(-1).data)
        self._keep.append(memory)
        view = memory.swapaxes(1, 2)
        return view[0] if rows == 1 else view


class _Pointers:
    """Addresses of arrays and their strides, as the loops in C take them."""

    def __init__(
        self, inputs: Sequence[Array], strides: Sequence[int], outputs: Sequence[Array]
    ) -> None:
        self._keep = (
            np.array([array.ctypes.data for array in inputs] or [0], dtype=np.uint64),
            np.array(strides or [0], dtype=np.int64),
            np.array([array.ctypes.data for array in outputs] or [0], dtype=np.uint64),
        )
        self.addresses = tuple(array.ctypes.data for array in self._keep)


class _Work:
    """Work memory of one thread."""

    def __init__(self, signature: Signature) -> None:
        self._keep = (np.zeros(signature.sz_w + 1), np.zeros(signature.sz_iw + 1, dtype=np.int64))
        self.addresses = tuple(array.ctypes.data for array in self._keep)


def in_parallel(
    work: Callable[[Iterator[int]], None], items: Sequence[int], threads: int | None = None
) -> None:
    """Run `work` in several threads, which take items one by one from a shared iterator.

    The calling thread is one of them.  An exception in any thread is raised here; the others then
    stop after their current item.
    """
    count = min(available_cores() if threads is None else max(1, threads), len(items))
    if count <= 1:
        work(iter(items))
        return
    queue, lock, stop = iter(items), threading.Lock(), threading.Event()

    def taken() -> Iterator[int]:
        while not stop.is_set():
            with lock:
                item = next(queue, None)
            if item is None:
                return
            yield item

    def guarded() -> None:
        try:
            work(taken())
        except BaseException:
            stop.set()
            raise

    with ThreadPoolExecutor(count - 1) as pool:
        helpers = [pool.submit(guarded) for _ in range(count - 1)]
        guarded()
    for helper in helpers:
        helper.result()


def available_cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def is_shared(argument: Array, shape: tuple[int, int]) -> bool:
    """Return whether an argument of `BatchFunction.many` is the same for all rows."""
    return argument.ndim <= (1 if shape[1] == 1 else 2)


def _own(shape: tuple[int, int]) -> tuple[int, ...]:
    return shape[:1] if shape[1] == 1 else shape
