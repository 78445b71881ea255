"""A Modbus TCP device written by hand, byte by byte, which shares nothing with driver or peer."""

from __future__ import annotations

import socket
import struct
from collections import defaultdict
from collections.abc import Callable
from contextlib import suppress
from threading import Thread

Answer = Callable[[bytes], bytes | None]


class HandmadeDevice:
    """Holds registers and coils, records requests, and answers wrongly on demand.

    Attributes
    ----------
    requests : all that came, function code first, without the header.
    holding, inputs, coils : what it holds, by address.
    answers : what to answer to a function code instead: bytes after the header; b"" says nothing,
        None hangs up.
    unknown : function codes that it does not know.
    rude : hang up after every answer.
    connections : how many there were.
    """

    def __init__(self) -> None:
        self.requests: list[bytes] = []
        self.holding: dict[int, int] = defaultdict(int)
        self.inputs: dict[int, int] = defaultdict(int)
        self.coils: dict[int, bool] = {}
        self.answers: dict[int, Answer] = {}
        self.unknown: set[int] = set()
        self.rude = False
        self.connections = 0
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        self._open: list[socket.socket] = []
        self._threads = [Thread(target=self._accept, daemon=True)]
        self._threads[0].start()

    def functions(self) -> list[int]:
        return [request[0] for request in self.requests]

    def close(self) -> None:
        for end in (self._listener, *self._open):
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
            end.close()
        for thread in self._threads:
            thread.join(5)

    def hang_up(self) -> None:
        for end in self._open:
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)

    def _accept(self) -> None:
        while True:
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return
            self.connections += 1
            self._open.append(connection)
            self._threads.append(Thread(target=self._serve, args=(connection,), daemon=True))
            self._threads[-1].start()

    def _serve(self, connection: socket.socket) -> None:
        try:
            with connection, connection.makefile("rb") as stream:
                while len(header := stream.read(7)) == 7:
                    transaction, zero, length, unit = struct.unpack(">HHHB", header)
                    assert zero == 0
                    request = stream.read(length - 1)
                    self.requests.append(request)
                    answer = self.answers.get(request[0], self._answer)(request)
                    if answer is None:
                        return
                    if answer:
                        head = struct.pack(">HHHB", transaction, 0, len(answer) + 1, unit)
                        connection.sendall(head + answer)
                    if self.rude:
                        return
        except OSError:
            return

    def _answer(self, request: bytes) -> bytes:
        code = request[0]
        if code in self.unknown:
            return bytes([code | 0x80, 1])
        if code in (3, 4):
            return self._read(code, *struct.unpack(">HH", request[1:]))
        if code == 5:
            address, value = struct.unpack(">HH", request[1:])
            assert value in (0xFF00, 0)
            self.coils[address] = value == 0xFF00
            return request
        if code == 6:
            address, value = struct.unpack(">HH", request[1:])
            self.holding[address] = value
            return request
        if code == 16:
            self._write(request[1:])
            return request[:5]
        if code == 23:
            start, count = struct.unpack(">HH", request[1:5])
            self._write(request[5:])
            return self._read(23, start, count)
        return bytes([code | 0x80, 1])

    def _read(self, code: int, start: int, count: int) -> bytes:
        table = self.inputs if code == 4 else self.holding
        values = [table[start + i] for i in range(count)]
        return struct.pack(f">BB{count}H", code, 2 * count, *values)

    def _write(self, body: bytes) -> None:
        start, count, size = struct.unpack(">HHB", body[:5])
        assert size == 2 * count == len(body) - 5
        for i, value in enumerate(struct.unpack(f">{count}H", body[5:])):
            self.holding[start + i] = value
