"""The SDO server of one node: expedited and segmented transfers (CiA 301 §7.2.4.3), bytes in and bytes out."""

from __future__ import annotations

import struct
from collections.abc import Callable

from drivers.simulated.errors import SdoAbort

_HEAD = struct.Struct("<BHB")

TOGGLE_NOT_ALTERNATED = 0x05030000
UNKNOWN_COMMAND = 0x05040001


class SdoServer:
    """One SDO channel; it keeps the transfer that is under way and nothing else."""

    def __init__(self, read: Callable[[int, int], bytes], write: Callable[[int, int, bytes], None]) -> None:
        self._read = read
        self._write = write
        self._entry = (0, 0)
        self._upload: bytes | None = None
        self._download: bytearray | None = None
        self._toggle = 0

    def answer(self, request: bytes) -> bytes | None:
        """The response to a request of 8 bytes; None where the standard wants silence (an abort of the client)."""
        if len(request) < 8:
            return None
        command = request[0] >> 5
        if command == 4:
            self._upload = self._download = None
            return None
        if command in (1, 2):
            _, index, subindex = _HEAD.unpack_from(request)
            self._entry = (index, subindex)
        try:
            return self._serve(command, request)
        except SdoAbort as abort:
            self._upload = self._download = None
            return _HEAD.pack(0x80, *self._entry) + struct.pack("<I", abort.code)

    def _serve(self, command: int, request: bytes) -> bytes:
        if command == 0:
            return self._continue_download(request)
        if command == 1:
            return self._start_download(request)
        if command == 2:
            return self._start_upload()
        if command == 3:
            return self._continue_upload(request[0])
        raise SdoAbort(UNKNOWN_COMMAND)

    def _start_upload(self) -> bytes:
        data = self._read(*self._entry)
        self._upload = self._download = None
        if len(data) <= 4:
            return _HEAD.pack(0x43 | (4 - len(data)) << 2, *self._entry) + data.ljust(4, b"\0")
        self._upload, self._toggle = data, 0
        return _HEAD.pack(0x41, *self._entry) + struct.pack("<I", len(data))

    def _continue_upload(self, command: int) -> bytes:
        if self._upload is None:
            raise SdoAbort(UNKNOWN_COMMAND)
        self._check_toggle(command)
        part, self._upload = self._upload[:7], self._upload[7:]
        last = not self._upload
        answer = bytes([self._toggle | (7 - len(part)) << 1 | last]) + part.ljust(7, b"\0")
        self._toggle ^= 0x10
        if last:
            self._upload = None
        return answer

    def _start_download(self, request: bytes) -> bytes:
        self._upload = self._download = None
        if request[0] & 0x02:
            size = 4 - (request[0] >> 2 & 3) if request[0] & 0x01 else 4
            self._write(*self._entry, request[4 : 4 + size])
        else:
            self._download, self._toggle = bytearray(), 0
        return _HEAD.pack(0x60, *self._entry) + bytes(4)

    def _continue_download(self, request: bytes) -> bytes:
        if self._download is None:
            raise SdoAbort(UNKNOWN_COMMAND)
        self._check_toggle(request[0])
        self._download += request[1 : 8 - (request[0] >> 1 & 7)]
        answer = bytes([0x20 | self._toggle]) + bytes(7)
        self._toggle ^= 0x10
        if request[0] & 0x01:
            data, self._download = bytes(self._download), None
            self._write(*self._entry, data)
        return answer

    def _check_toggle(self, command: int) -> None:
        if command & 0x10 != self._toggle:
            raise SdoAbort(TOGGLE_NOT_ALTERNATED)
