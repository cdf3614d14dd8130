"""A stand-in for the controller of a UR: RTDE, the script server and the dashboard, on their usual ports.

It speaks the Real-Time Data Exchange protocol, version 2, as Universal Robots publish it, and does what the control
script of ur_rtde does: it waits for a command in integer register 0 and takes its numbers from the double registers.
"""

import contextlib
import json
import os
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

HOST: Final = "127.0.0.1"
DASHBOARD, SCRIPT, RTDE = 29999, 30003, 30004
HZ: Final = 250.0

NO_COMMAND, MOVEJ, SERVOJ, STOP_SCRIPT = 0, 1, 11, 255
_READY, _DONE = 1, 2
_STOPPED, _PLAYING = 1, 2
_POWERED = 0b11
_NORMAL, _PROTECTIVE_STOP = 0b1, 0b100
_FORMATS: Final = {"DOUBLE": ">d", "VECTOR6D": ">6d", "UINT32": ">I", "INT32": ">i", "UINT64": ">Q", "UINT8": ">B"}


def _type(name: str) -> str:
    if name.startswith(("output_int_register", "input_int_register")) or name in ("robot_mode", "safety_mode"):
        return "INT32"
    if name.endswith("_bits") and "digital" in name:
        return "UINT64"
    if name.endswith(("_status", "_bits", "_state")) or name in ("speed_slider_mask",):
        return "UINT32"
    if name.endswith(("_digital_output_mask", "_digital_output", "_mask", "_type")):
        return "UINT8"
    if name.startswith(("actual_q", "target_q", "actual_TCP", "target_TCP", "joint_", "tcp_offset")):
        return "VECTOR6D"
    return "DOUBLE"


class Controller:
    """The controller; use it in a ``with`` block.

    Attributes:
        joints: where the arm stands (6,) [rad].
        commands: every command, with its time [s] and numbers.
        scripts: how many were sent to the script server.
        connections: how often RTDE was connected to.
    """

    def __init__(self, joints: Sequence[float], fault_after: int, vanish_after: int) -> None:
        self.joints = list(joints)
        self.commands: list[tuple[float, int, list[float]]] = []
        self.scripts = self.connections = 0
        self._fault_after, self._vanish_after, self._streamed = fault_after, vanish_after, 0
        self._state, self._playing = _READY, False
        self._open = True
        self._sockets: list[socket.socket] = []

    def __enter__(self) -> "Controller":
        for port, serve in ((DASHBOARD, self._dashboard), (SCRIPT, self._script), (RTDE, self._rtde)):
            listening = socket.create_server((HOST, port), reuse_port=True)
            self._sockets.append(listening)
            threading.Thread(target=self._accept, args=(listening, serve), daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._open = False
        for each in self._sockets:
            with contextlib.suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)
            each.close()

    def _accept(self, listening: socket.socket, serve: Callable[[socket.socket], None]) -> None:
        while self._open:
            try:
                connected, _ = listening.accept()
            except OSError:
                return
            self._sockets.append(connected)
            threading.Thread(target=self._serve, args=(connected, serve), daemon=True).start()

    @staticmethod
    def _serve(connected: socket.socket, serve: Callable[[socket.socket], None]) -> None:
        with contextlib.suppress(OSError, struct.error), connected:
            serve(connected)

    def _dashboard(self, connected: socket.socket) -> None:
        connected.sendall(b"Connected: Universal Robots Dashboard Server\n")
        answers = {
            "polyscopeversion": "URSoftware 3.15.8.106339 (Mar 02 2022)",
            "is in remote control": "true",
            "get serial number": "20163500001",
        }
        for line in connected.makefile("r", encoding="utf-8"):
            connected.sendall(answers.get(line.strip().lower(), "Stopped").encode() + b"\n")

    def _script(self, connected: socket.socket) -> None:
        text = ""
        while part := connected.recv(1 << 16):
            text += part.decode(errors="replace")
            if text.rstrip().endswith("end"):
                self.scripts += 1
                text, self._playing, self._state = "", True, _READY

    def _rtde(self, connected: socket.socket) -> None:
        self.connections += 1
        recipes: list[list[str]] = []
        outputs: list[str] = []
        hertz, sending = HZ, False
        stream = connected.makefile("rb")
        while head := stream.read(3):
            size, kind = struct.unpack(">HB", head)
            body = stream.read(size - 3)
            if kind == ord("V"):
                answer = b"\1"
            elif kind == ord("v"):
                answer = struct.pack(">4I", 3, 15, 8, 0)
            elif kind == ord("O"):
                hertz = struct.unpack(">d", body[:8])[0]
                outputs = body[8:].decode().strip(",").split(",")
                answer = b"\1" + ",".join(map(_type, outputs)).encode()
            elif kind == ord("I"):
                recipes.append(body.decode().strip(",").split(","))
                answer = bytes([len(recipes)]) + ",".join(map(_type, recipes[-1])).encode()
            elif kind == ord("U"):
                self._obey(recipes[body[0] - 1], body[1:])
                continue
            else:
                answer = b"\1"
            connected.sendall(struct.pack(">HB", 3 + len(answer), kind) + answer)
            if kind == ord("S") and not sending:
                sending = True
                threading.Thread(target=self._report, args=(connected, outputs, hertz), daemon=True).start()

    def _obey(self, names: list[str], body: bytes) -> None:
        numbers: list[float] = []
        command = None
        for name in names:
            shape = _FORMATS[_type(name)]
            size = struct.calcsize(shape)
            if len(body) < size:
                break
            (value,) = struct.unpack(shape, body[:size])
            body = body[size:]
            if name == "input_int_register_0":
                command = int(value)
            else:
                numbers.append(value)
        if command is None:
            return
        if command == NO_COMMAND:
            self._state = _READY
            return
        self.commands.append((time.monotonic(), command, numbers))
        if command in (MOVEJ, SERVOJ):
            self.joints = numbers[:6]
        if command == STOP_SCRIPT:
            self._playing = False
        elif command != SERVOJ:
            self._state = _DONE
        self._streamed += command == SERVOJ
        if 0 < self._vanish_after <= self._streamed:
            os._exit(0)

    def _report(self, connected: socket.socket, outputs: list[str], hertz: float) -> None:
        begun = time.monotonic()
        with contextlib.suppress(OSError):
            while self._open:
                body = b"\1"
                for name in outputs:
                    shape = _FORMATS[_type(name)]
                    body += struct.pack(shape, *self._value(name, time.monotonic() - begun, len(shape) > 2))
                connected.sendall(struct.pack(">HB", 3 + len(body), ord("U")) + body)
                time.sleep(1.0 / hertz)

    def _fault(self) -> bool:
        return 0 < self._fault_after <= self._streamed

    def _value(self, name: str, seconds: float, vector: bool) -> Sequence[float]:
        if name in ("actual_q", "target_q"):
            return self.joints
        known = {
            "timestamp": seconds,
            "runtime_state": _PLAYING if self._playing else _STOPPED,
            "robot_status_bits": _POWERED,
            "safety_status_bits": _PROTECTIVE_STOP if self._fault() else _NORMAL,
            "output_int_register_0": self._state,
            "robot_mode": 7,
            "safety_mode": 1,
            "speed_scaling": 1.0,
            "target_speed_fraction": 1.0,
        }
        return [0.0] * 6 if vector else [known.get(name, 0)]


_NOTHING: Final = '{"commands": [], "scripts": 0, "connections": 0}'


@dataclass
class Log:
    """What a controller was told; it is filled when its block ends."""

    commands: list[tuple[float, int, list[float]]] = field(default_factory=list)
    scripts: int = 0
    connections: int = 0

    @property
    def kinds(self) -> list[int]:
        """The commands but servoj, in order."""
        return [kind for _, kind, _ in self.commands if kind != SERVOJ]

    @property
    def streamed(self) -> list[list[float]]:
        """The joint angles (N, 6) [rad] that servoj was given."""
        return [numbers[:6] for _, kind, numbers in self.commands if kind == SERVOJ]


@contextlib.contextmanager
def controller(joints: Sequence[float], fault_after: int = 0, vanish_after: int = 0) -> Iterator[Log]:
    """Run a controller in a process of its own, since ur_rtde waits for it without letting other threads run.

    Args:
        joints: where its arm stands (6,) [rad].
        fault_after: servoj commands after which it reports a protective stop; 0 never.
        vanish_after: servoj commands after which it is gone, and what it was told with it; 0 never.
    """
    command = [sys.executable, __file__, str(fault_after), str(vanish_after), *map(str, joints)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        log = Log()
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        try:
            yield log
        finally:
            told: dict[str, Any] = json.loads(process.communicate("")[0] or _NOTHING)
            log.commands, log.scripts, log.connections = told["commands"], told["scripts"], told["connections"]


def main(fault_after: str, vanish_after: str, *joints: str) -> None:
    """Serve until standard input ends, then write what was told."""
    with Controller([float(angle) for angle in joints], int(fault_after), int(vanish_after)) as served:
        print("ready", flush=True)
        sys.stdin.read()
        told = {"commands": served.commands, "scripts": served.scripts, "connections": served.connections}
    print(json.dumps(told), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
