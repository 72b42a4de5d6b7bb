#!/usr/bin/env python3
"""Feeds a running graph with frames of an Inspire RH56DFTP (right hand), read by Modbus TCP.

    blindgrasp run dataflow-live.yaml --set hand=hands/inspire-rh56dftp.yaml --set model=MODEL.json --set source.zero_when_open=true
    python3 examples/bridges/inspire_rh56dftp.py --host 192.168.11.210

It reads the angles, the state and the 17 pads of the hand, and writes nothing: another program closes the hand. The phase
comes from the state of the six drives: the hand is settled when all have rested for 0.2 s after closing, and open when its
fingers rest above 900. A drive with a fault ends the frames until it has none. So does a hand that does not answer: the
bridge connects again, and ends if it gets no answer for 10 s.

Addresses, orders and codes are those of the maker's manual (HWKV1.0.0cn); it gives no newtons for the readings of 0 to 4095,
so --newtons-per-count is assumed until you measure it. The angles of 0 to 1000 (open) are taken as parts of the joints' range.
"""

import socket
import struct
import sys
import time

import line_protocol

# Address and number of 16-bit words. An address counts bytes; the hand wants it as it stands in the table.
ANGLES, STATES = (1546, 6), (1612, 3)
FINGER = ((0, 9), (18, 96), (210, 80))
PADS = [(3000 + 370 * finger + offset, words) for finger in range(4) for offset, words in FINGER]
PADS += [(4480, 9), (4498, 96), (4690, 9), (4708, 96), (4900, 112)]
# The same words in fewer requests: a tip and the nail behind it lie side by side.
JOINED_PADS = [read for finger in range(4) for read in ((3000 + 370 * finger, 105), (3210 + 370 * finger, 80))]
JOINED_PADS += [(4480, 105), (4690, 105), (4900, 112)]
# Upper limits of the joints in the hand's order: little, ring, middle and index finger, the thumb's bend and its turn.
CLOSED_RAD = (1.4381, 1.4381, 1.4381, 1.4381, 0.5864, 1.1641)
# A drive that has reached its force holds against it.
HOLDS = 3
MOTIONS = {0: "opens", 1: "closes", 2: "rests", HOLDS: "rests", 5: "rests", 6: "rests"}
# Fingers and thumb whose angles are all above this are open.
OPEN_ANGLE = 900
# An answer that takes longer is given up, with its connection.
SILENT_SECS = 0.5
GONE_SECS = 10.0


class ModbusError(Exception):
    """The hand does not answer as it should."""


class Silence(Exception):
    """The hand does not answer: the connection is of no use any more, because an answer may still come."""


class Modbus:
    """Reads holding registers by Modbus TCP (function 3)."""

    def __init__(self, host, port, unit):
        self.place, self.unit = (host, port), unit
        self.connect()

    def connect(self):
        self.connection = socket.create_connection(self.place, timeout=SILENT_SECS)
        self.connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        # How far the numbers of the answers are behind those of the requests: the hand's firmware is one behind.
        self.number, self.lag = 0, None

    def connect_again(self):
        """Connects until the hand answers."""
        until = time.monotonic() + GONE_SECS
        while True:
            self.connection.close()
            try:
                self.connect()
                self.read(*STATES)
                return
            except (OSError, Silence, ModbusError) as error:
                if time.monotonic() > until:
                    raise ModbusError(f"no answer for {GONE_SECS:.0f} s: {error}") from error
            time.sleep(0.1)

    def receive(self, n_bytes):
        received = b""
        while len(received) < n_bytes:
            part = self.connection.recv(n_bytes - len(received))
            if not part:
                raise Silence("it closed the connection")
            received += part
        return received

    def read(self, address, n_words):
        """The bytes of the words at an address."""
        self.number = (self.number + 1) % 0x10000
        try:
            self.connection.sendall(struct.pack(">HHHBBHH", self.number, 0, 6, self.unit, 3, address, n_words))
            number, protocol, length, _unit = struct.unpack(">HHHB", self.receive(7))
            answer = self.receive(length - 1)
        except OSError as error:
            raise Silence(str(error)) from error
        # One request is under way, so each answer is to it, whatever its number; but numbers that jump show a lost answer.
        lag = (self.number - number) % 0x10000
        self.lag = lag if self.lag is None else self.lag
        if protocol != 0:
            raise Silence(f"an answer of protocol {protocol}, expected 0 (Modbus)")
        if lag != self.lag:
            raise Silence(f"answer {number} to request {self.number}, expected a number {self.lag} behind it")
        if answer[:1] == b"\x83" and len(answer) == 2:
            raise ModbusError(f"registers at {address}: exception {answer[1]}")
        if answer[:2] != bytes([3, 2 * n_words]) or len(answer) != 2 + 2 * n_words:
            raise ModbusError(f"registers at {address}: the answer {answer[:8].hex()}, expected {2 * n_words} bytes")
        return answer[2:]


def joints_of(angles):
    """The joints, radians, of angles from 0 (closed) to 1000 (open)."""
    return [closed * (1.0 - min(max(angle, 0), 1000) / 1000.0) for closed, angle in zip(CLOSED_RAD, angles)]


def motion_of(states):
    """The motion of the hand, `None` if a drive has a fault. A hand of which one drive opens while another one holds against a
    force still closes on something: it is not open."""
    motions = [MOTIONS.get(state) for state in states]
    if None in motions:
        return None
    if "closes" in motions or ("opens" in motions and HOLDS in states):
        return "closes"
    return "opens" if "opens" in motions else "rests"


def requests_of_pads(modbus):
    """The requests that read all pads: the fewer ones, unless the hand refuses them."""
    try:
        for request in JOINED_PADS:
            modbus.read(*request)
        return JOINED_PADS
    except ModbusError:
        return PADS


def frames(modbus, newtons_per_count, rate):
    """Yields the hand's frames, `rate` a second; a sentence in place of one that a fault or a pause of the hand has cost."""
    phase = line_protocol.StatusPhase()
    seq, begin, requests = 0, time.monotonic(), None
    while True:
        try:
            requests = requests or requests_of_pads(modbus)
            stamp_nanos = line_protocol.now_nanos()
            states = modbus.read(*STATES)
            angles = struct.unpack(">6h", modbus.read(*ANGLES))
            counts = [count for pad in requests for count in struct.unpack(f">{pad[1]}h", modbus.read(*pad))]
        except Silence as silence:
            yield f"the hand does not answer ({silence}): no frames until it does"
            modbus.connect_again()
            # The hand may have closed meanwhile, and one that holds an object must not count as open.
            phase.of(line_protocol.now_nanos(), None, False)
            # The missing number holds the grasp that the pause was in.
            seq += 1
            continue
        motion = motion_of(states)
        phase_word = phase.of(stamp_nanos, motion, min(angles[:5]) > OPEN_ANGLE)
        if motion is None:
            yield "a drive has a fault: no frames until it is cleared"
        elif phase_word is None:
            yield "the hand has not been open: no frames until it opens"
        else:
            yield {
                "joints": joints_of(angles),
                "cells_newtons": [count * newtons_per_count for count in counts],
                "phase": phase_word,
                "seq": seq,
                "stamp_nanos": stamp_nanos,
            }
        seq += 1
        # Of a hand that is slower than the rate, no frame is skipped.
        begin = max(begin + 1.0 / rate, time.monotonic() - 1.0 / rate)
        time.sleep(max(0.0, begin - time.monotonic()))


def main():
    options = line_protocol.options(__doc__)
    options.add_argument("--host", default="192.168.11.210", help="of the hand (%(default)s)")
    options.add_argument("--port", type=int, default=6000, help="(%(default)s)")
    options.add_argument("--unit", type=int, default=1, help="Modbus unit (%(default)s)")
    options.add_argument("--rate", type=float, default=50.0, help="frames a second (%(default)s)")
    options.add_argument("--newtons-per-count", type=float, default=0.001, help="assumed: %(default)s")
    arguments = options.parse_args()
    if not arguments.rate > 0:
        options.error("--rate: expected more than 0 frames a second")
    try:
        modbus = Modbus(arguments.host, arguments.port, arguments.unit)
    except OSError as error:
        sys.exit(f"{arguments.host}:{arguments.port}: {error}; expected the hand's Modbus TCP server (--host, --port)")
    source = line_protocol.Source(arguments.address, len(CLOSED_RAD), sum(words for _, words in PADS), arguments.hand)
    try:
        source.send_all(frames(modbus, arguments.newtons_per_count, arguments.rate))
    except ModbusError as error:
        sys.exit(f"{arguments.host}:{arguments.port}: {error}; start the bridge again")


if __name__ == "__main__":
    line_protocol.run(main)
