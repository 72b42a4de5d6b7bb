#!/usr/bin/env python3
"""Feeds a running graph with frames of a Robotiq 2F-85 with tactile fingertips TSF-85.

    blindgrasp run dataflow-live.yaml --set hand=hands/robotiq-2f85-tsf85.yaml --set model=MODEL.json --set source.zero_when_open=true
    python3 examples/bridges/robotiq_2f85_tsf85.py --sensor /dev/rq_tsf85_0 --gripper /dev/ttyUSB0

The fingertips send their packets by USB; the gripper is asked for its state by Modbus RTU, and nothing is written to it:
another program closes it. Where that program holds the port, run the maker's ROS 2 drivers and
`ros2 run blindgrasp_ros hand robotiq-2f85-tsf85.yaml` in place of this bridge. The phase comes from the gripper's own word for an object (gOBJ).

Packets are those of the maker's SDK (robotiq/tactile_sensors), registers those of the gripper's manual. Neither gives newtons
for the readings, so --newtons-per-count is assumed until you measure it.
"""

import os
import select
import struct
import sys
import termios
import time
import tty

import line_protocol

N_CELLS = 28
# Kinds of a block of sensor data (the high half of its first byte) and the bytes of its values.
STATIC, SIZES = 1, {1: 2 * N_CELLS, 2: 2, 3: 6, 4: 6, 5: 6, 6: 2, 7: 8}
# Ask for the sensors, and for their data each so many milliseconds.
READ, AUTOSEND, AUTOSEND_ASYNC = 0x61, 0x58, 0x59
# gPO of the open and of the closed gripper, and the knuckle's angle when it is closed (the maker's ROS driver).
OPEN, CLOSED, CLOSED_RAD, LIMIT_RAD = 3, 230, 0.7929, 0.8
SILENT_SECS = 1.0
# The readings of both fingers in a frame are no farther apart.
APART_SECS = 0.05


class DeviceError(Exception):
    """A device does not answer as it should."""


def opened(path):
    """The file of a serial device at 115,200 baud, raw."""
    file = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    tty.setraw(file)
    modes = termios.tcgetattr(file)
    modes[4] = modes[5] = termios.B115200
    termios.tcsetattr(file, termios.TCSANOW, modes)
    return file


def received(file, secs):
    """The bytes that come within so many seconds; none if none do."""
    try:
        found = os.read(file, 4096) if select.select([file], [], [], secs)[0] else None
    except OSError as error:
        raise DeviceError(f"a device is gone: {error}") from error
    if found == b"":
        raise DeviceError("a device is gone")
    return found or b""


def send(file, data):
    try:
        os.write(file, data)
    except OSError as error:
        raise DeviceError(f"a device is gone: {error}") from error


class Fingertips:
    """Takes packets apart: 0x9A, a checksum that is not used, a command, a length, and blocks of data."""

    def __init__(self):
        self.buffer = b""

    def take(self, data):
        """The readings in the packets that are complete: pairs of finger and cells."""
        self.buffer += data
        found = []
        while (begin := self.buffer.find(b"\x9a")) >= 0:
            self.buffer = self.buffer[begin:]
            if len(self.buffer) < 4:
                return found
            command, length = self.buffer[2], self.buffer[3]
            blocks = None
            if command in (READ, AUTOSEND, AUTOSEND_ASYNC):
                # A packet has no checksum. One that lost a byte is not followed by the next packet's begin, which comes within 1 ms.
                if len(self.buffer) < 5 + length:
                    return found
                is_whole = self.buffer[4 + length] == 0x9A
                blocks = self.blocks(self.buffer[4 : 4 + length]) if is_whole else None
            if blocks is None:
                # This 0x9A was part of something else.
                self.buffer = self.buffer[1:]
            else:
                found += blocks
                self.buffer = self.buffer[4 + length :]
        self.buffer = b""
        return found

    @staticmethod
    def blocks(data):
        """The cells of each finger in a packet's data; `None` if it does not consist of blocks."""
        found = []
        while data:
            kind, finger = data[0] >> 4, data[0] >> 2 & 3
            size = SIZES.get(kind)
            if size is None or len(data) < 1 + size or finger > 1:
                return None
            if kind == STATIC:
                found.append((finger, struct.unpack(f">{N_CELLS}H", data[1 : 1 + size])))
            data = data[1 + size :]
        return found


def crc(data):
    """The checksum of Modbus RTU."""
    value = 0xFFFF
    for byte in data:
        value ^= byte
        for _ in range(8):
            value = value >> 1 ^ (0xA001 if value & 1 else 0)
    return struct.pack("<H", value)


class Gripper:
    """Asks a gripper for its state, and finds its joint and phase."""

    REQUEST = struct.pack(">BBHH", 9, 3, 0x07D0, 3)

    def __init__(self, file):
        self.file, self.phase = file, line_protocol.StatusPhase()

    def ask(self):
        """The knuckle's angle and the phase; a sentence while there is none."""
        # The rest of an answer that came too late.
        while received(self.file, 0):
            pass
        send(self.file, self.REQUEST + crc(self.REQUEST))
        answer, until = b"", time.monotonic() + SILENT_SECS
        while len(answer) < 11:
            if time.monotonic() > until:
                raise DeviceError(f"the gripper does not answer ({len(answer)} of 11 bytes)")
            answer += received(self.file, 0.1)
        if answer[:3] != b"\x09\x03\x06" or answer[9:11] != crc(answer[:9]):
            raise DeviceError(f"the gripper answers {answer.hex()}: expected three registers and their checksum")
        return self.state(line_protocol.now_nanos(), answer[3:9])

    def state(self, stamp_nanos, registers):
        status, _, fault, requested, position, _ = registers
        is_active, goes, objects = status >> 4 & 3 == 3, bool(status & 8), status >> 6
        if not is_active or fault & 0x0F >= 0x0A:
            self.phase.of(stamp_nanos, None, False)
            return "the gripper is not activated or has a fault: no frames until it is ready"
        if objects == 1 or position <= OPEN + 2 or (objects == 0 and goes and requested < position):
            motion = "opens"
        elif objects == 0 and goes and requested > position:
            motion = "closes"
        else:
            motion = "rests" if objects else "closes"
        phase = self.phase.of(stamp_nanos, motion, position <= OPEN + 2)
        if phase is None:
            return "the gripper has not been open: no frames until it opens"
        closed = min(max((position - OPEN) / (CLOSED - OPEN), 0.0), LIMIT_RAD / CLOSED_RAD)
        return closed * CLOSED_RAD, phase


def frames(sensor, gripper, newtons_per_count):
    """Yields a frame for the newest readings of both fingers; a sentence in place of one while the gripper is not ready."""
    fingertips, cells, seq = Fingertips(), {}, 0
    came = [time.monotonic()] * 2
    send(sensor, bytes([0x9A, 0, AUTOSEND, 1, 1]))
    while True:
        # All that has come, of which the newest counts: while the gripper answered, readings may have waited.
        data = received(sensor, SILENT_SECS)
        while more := received(sensor, 0):
            data += more
        stamp_nanos = line_protocol.now_nanos()
        for finger, counts in fingertips.take(data):
            cells[finger], came[finger] = counts, time.monotonic()
        if len(cells) == 2 and abs(came[0] - came[1]) <= APART_SECS:
            state = gripper.ask()
            if isinstance(state, str):
                yield state
            else:
                yield {
                    "joints": [state[0]],
                    "cells_newtons": [count * newtons_per_count for finger in (0, 1) for count in cells[finger]],
                    "phase": state[1],
                    "seq": seq,
                    "stamp_nanos": stamp_nanos,
                }
            seq, cells = seq + 1, {}
        for finger in (0, 1):
            if time.monotonic() - came[finger] > SILENT_SECS:
                raise DeviceError(f"no cells of finger {finger} have come for {SILENT_SECS:g} s")


def main():
    options = line_protocol.options(__doc__)
    options.add_argument("--sensor", required=True, help="the fingertips' USB device, like /dev/rq_tsf85_0")
    options.add_argument("--gripper", required=True, help="the gripper's serial device, like /dev/ttyUSB0")
    options.add_argument("--newtons-per-count", type=float, default=0.02, help="assumed: %(default)s")
    arguments = options.parse_args()
    try:
        sensor, gripper = opened(arguments.sensor), Gripper(opened(arguments.gripper))
    except (OSError, termios.error) as error:
        sys.exit(f"{error}; expected two serial devices (--sensor, --gripper)")
    source = line_protocol.Source(arguments.address, 1, 2 * N_CELLS, arguments.hand)
    try:
        source.send_all(frames(sensor, gripper, arguments.newtons_per_count))
    except DeviceError as error:
        sys.exit(f"{error}; start the bridge again")


if __name__ == "__main__":
    line_protocol.run(main)
