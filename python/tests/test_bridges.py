"""Tests of the bridges of examples/bridges with stand-ins of the devices, written after the makers' manuals."""

import asyncio
import contextlib
import itertools
import json
import os
import pty
import select
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
import unittest
from collections import Counter
from pathlib import Path
from types import SimpleNamespace as Message

import blindgrasp
from pymodbus.framer.rtu import FramerRTU
from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice
from ruamel.yaml import YAML

PROJECT = Path(__file__).resolve().parents[2]
BRIDGES = PROJECT / "examples/bridges"
sys.path[:0] = [str(BRIDGES), str(PROJECT / "examples/blindgrasp_ros")]
import inspire_rh56dftp as inspire  # noqa: E402
import line_protocol  # noqa: E402
import robotiq_2f85_tsf85 as robotiq  # noqa: E402
from blindgrasp_ros import hand as ros_hand  # noqa: E402

DATAFLOW = """
version: 1
name: {name}
operators:
  source:
    run: tactile_source
    params: {{driver: listen, hand: {hand}, address: "unix:{socket}", zero_when_open: true}}
"""


def cells_of(hand):
    """The number of cells of each pad, as `blindgrasp info` tells it."""
    command = [blindgrasp.program(), "info", PROJECT / f"hands/{hand}.yaml", "--json"]
    cells = json.loads(subprocess.run(command, check=True, capture_output=True).stdout)
    return Counter(cell["pad"] for cell in cells)


class ReceivedFrames:
    """A graph with nothing but a source, and a bridge that feeds it."""

    def __init__(self, test, hand, script, *options):
        self.folder = tempfile.TemporaryDirectory()
        folder = Path(self.folder.name)
        address = folder / "tactile.hand"
        dataflow = folder / "dataflow.yaml"
        name = f"bridge-{hand}-{os.getpid()}"
        dataflow.write_text(DATAFLOW.format(name=name, hand=PROJECT / f"hands/{hand}.yaml", socket=address))
        self.recording = folder / "frames.mcap"
        program = str(blindgrasp.program())
        self.graph = subprocess.Popen([program, "run", dataflow, "--record", self.recording], stdout=subprocess.DEVNULL)
        command = [sys.executable, BRIDGES / script, "--address", f"unix:{address}", *options]
        self.bridge = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        for process in (self.graph, self.bridge):
            test.addCleanup(process.wait)
            test.addCleanup(process.kill)

    def end(self):
        """Ends the bridge, then the graph; returns the recorded grasps and what the bridge said."""
        self.bridge.kill()
        said = self.bridge.communicate(timeout=60)[1]
        self.graph.terminate()
        self.graph.wait(60)
        grasps = [grasp for grasp in blindgrasp.Recording(self.recording)]
        self.folder.cleanup()
        return grasps, said


def wait_until(is_true, what, secs=60):
    until = time.monotonic() + secs
    while not is_true():
        if time.monotonic() > until:
            raise AssertionError(f"{what} has not come in {secs} s")
        time.sleep(0.02)


class Hand:
    """An Inspire RH56DFTP on a server of pymodbus. Its addresses count bytes, and words lie at the addresses of their table."""

    def __init__(self):
        self.words, self.n_reads = [0] * 6000, 0
        self.set(1546, [1000] * 6)
        self.state(2)
        self.loop = asyncio.new_event_loop()
        self.is_ready = threading.Event()
        self.thread = threading.Thread(target=self.serve)
        self.thread.start()
        self.is_ready.wait()

    def set(self, address, words):
        self.words[address : address + len(words)] = [word & 0xFFFF for word in words]

    def state(self, code):
        self.set(1612, [code << 8 | code] * 3)

    async def answer(self, function, start, address, count, registers, _written):
        self.n_reads += 1
        assert function == 3, function
        registers[address - start : address - start + count] = self.words[address : address + count]

    def serve(self):
        asyncio.set_event_loop(self.loop)
        self.loop.run_until_complete(self.run())
        self.loop.close()

    async def run(self):
        registers = SimData(0, count=len(self.words), values=0, datatype=DataType.REGISTERS)
        self.server = ModbusTcpServer(SimDevice(1, simdata=[registers], action=self.answer), address=("127.0.0.1", 0))
        await self.server.listen()
        self.port = self.server.transport.sockets[0].getsockname()[1]
        self.is_ready.set()
        self.stopped = asyncio.Event()
        await self.stopped.wait()
        await self.server.shutdown()

    def stop(self):
        self.loop.call_soon_threadsafe(self.stopped.set)
        self.thread.join()


class LaggingHand:
    """An Inspire RH56DFTP whose answers bear the number of the request before. An open hand; each word of the pads is its address
    behind 3000."""

    def __init__(self):
        self.is_paused, self.refused, self.angle = threading.Event(), None, 1000
        self.words_of_pads = [address - 3000 + 2 * word for address, words in inspire.PADS for word in range(words)]
        self.server = socket.create_server(("127.0.0.1", 0))
        self.port = self.server.getsockname()[1]
        self.is_over = False
        self.thread = threading.Thread(target=self.serve)
        self.thread.start()

    def serve(self):
        while True:
            connection = self.server.accept()[0]
            if self.is_over:
                return
            threading.Thread(target=self.answer, args=(connection,), daemon=True).start()

    def answer(self, connection):
        with connection, contextlib.suppress(OSError):
            while request := connection.recv(12):
                while self.is_paused.is_set():
                    time.sleep(0.01)
                number, _, _, unit, function, address, n_words = struct.unpack(">HHHBBHH", request)
                if n_words == self.refused:
                    body = bytes([function | 0x80, 3])
                else:
                    words = [self.word(address + 2 * idx) for idx in range(n_words)]
                    body = struct.pack(f">BB{n_words}H", function, 2 * n_words, *words)
                number = (number - 1) % 0x10000
                connection.sendall(struct.pack(">HHHB", number, 0, len(body) + 1, unit) + body)

    def word(self, address):
        return address if address >= 3000 else self.angle if address < 1612 else 0x0202

    def stop(self):
        self.is_over = True
        socket.create_connection(("127.0.0.1", self.port)).close()
        self.thread.join()
        self.server.close()


class Inspire(unittest.TestCase):
    def test_angles_and_states_have_their_meaning(self):
        self.assertEqual(inspire.joints_of([1000] * 6), [0.0] * 6)
        self.assertEqual(inspire.joints_of([0] * 6), [1.4381, 1.4381, 1.4381, 1.4381, 0.5864, 1.1641])
        self.assertEqual(inspire.motion_of([2, 1, 2, 3, 6, 5]), "closes")
        self.assertEqual(inspire.motion_of([2, 2, 2, 0, 2, 2]), "opens")
        self.assertEqual(inspire.motion_of([3, 3, 3, 3, 3, 0]), "closes")
        self.assertEqual(inspire.motion_of([2, 3, 6, 5, 2, 2]), "rests")
        self.assertIsNone(inspire.motion_of([2, 7, 2, 2, 2, 2]))

    def test_the_pads_are_those_of_the_layout(self):
        self.assertEqual(list(cells_of("inspire-rh56dftp").values()), [words for _, words in inspire.PADS])
        self.assertEqual((inspire.PADS[0], inspire.PADS[11], inspire.PADS[-1]), ((3000, 9), (4320, 80), (4900, 112)))
        words = [[at + 2 * idx for at, n in reads for idx in range(n)] for reads in (inspire.PADS, inspire.JOINED_PADS)]
        self.assertEqual(words[0], words[1])

    def test_a_grasp_goes_from_the_hand_to_the_graph(self):
        hand = Hand()
        self.addCleanup(hand.stop)
        options = ("--host", "127.0.0.1", "--port", str(hand.port), "--rate", "100")
        received = ReceivedFrames(self, "inspire-rh56dftp", "inspire_rh56dftp.py", *options)

        def frames(n):
            until = hand.n_reads + (2 + len(inspire.JOINED_PADS)) * n
            wait_until(lambda: hand.n_reads >= until, "the bridge's reading")

        # Readings at rest: one is above its zero, one below.
        hand.set(4120, [40])
        hand.set(3001, [-12])
        frames(60)
        hand.state(1)
        hand.set(1546, [1000, 1000, 1000, 500, 700, 1000])
        frames(5)
        # The index finger's tip has a load of 500 counts, the palm's last point one of 250.
        hand.set(4110, [500])
        hand.set(4900 + 111, [250])
        hand.state(3)
        # The hand must rest for 0.2 s, by frames that the bridge has read.
        for _ in range(3):
            frames(5)
            time.sleep(0.2)
        frames(5)
        hand.state(7)
        frames(5)
        grasps, said = received.end()
        self.assertIn("a drive has a fault", said)
        [grasp] = grasps
        self.assertEqual(set(grasp.phase), {"open", "closing", "settled"})
        settled = grasp.cells_newtons[grasp.phase == "settled"][-1]
        self.assertAlmostEqual(settled[3 * 185], 0.5, places=5)
        self.assertAlmostEqual(settled[1061], 0.25, places=5)
        self.assertEqual((settled > 0.001).sum(), 2)
        joints = grasp.joints[-1]
        self.assertAlmostEqual(joints[3], 1.4381 / 2, places=5)
        self.assertAlmostEqual(joints[4], 0.3 * 0.5864, places=5)

    def test_a_hand_that_holds_something_is_not_open(self):
        phase = line_protocol.StatusPhase()
        acts = [("rests", False), ("closes", False), ("opens", False), ("rests", True), ("closes", True), ("rests", True)]
        acts += [("closes", False), ("rests", False), ("rests", False), ("closes", False), (None, False), ("rests", False)]
        found = [phase.of(idx * 300_000_000, *act) for idx, act in enumerate(acts)]
        expected = [None, None, "open", "open", "closing", "open", "closing", "closing", "settled", "closing", None, None]
        self.assertEqual(found, expected)

    def test_a_device_that_refuses_or_goes_is_told(self):
        hand = Hand()
        modbus = inspire.Modbus("127.0.0.1", hand.port, 1)
        self.addCleanup(modbus.connection.close)
        self.assertEqual(len(modbus.read(4900, 112)), 224)
        with self.assertRaisesRegex(inspire.ModbusError, "registers at 7000: exception 2"):
            modbus.read(7000, 3)
        hand.stop()
        with self.assertRaises(inspire.Silence):
            modbus.read(4900, 112)

    def test_a_hand_whose_numbers_lag_and_that_pauses_goes_on(self):
        hand = LaggingHand()
        self.addCleanup(hand.stop)
        modbus = inspire.Modbus("127.0.0.1", hand.port, 1)
        self.addCleanup(lambda: modbus.connection.close())
        frames = inspire.frames(modbus, 0.001, 1000.0)
        found = [next(frames) for _ in range(3)]
        self.assertEqual([frame["seq"] for frame in found], [0, 1, 2])
        self.assertEqual(found[0]["cells_newtons"], [0.001 * (3000 + word) for word in hand.words_of_pads])
        hand.is_paused.set()
        self.assertIn("the hand does not answer", next(frames))
        threading.Timer(1.0, hand.is_paused.clear).start()
        self.assertEqual(next(frames)["seq"], 4)
        # A hand that refuses the joined requests is read pad by pad.
        hand.refused = 105
        refused = inspire.frames(modbus, 0.001, 1000.0)
        self.assertEqual(next(refused)["cells_newtons"], found[0]["cells_newtons"])
        # It may have closed on an object while it paused.
        hand.refused = None
        hand.is_paused.set()
        self.assertIn("the hand does not answer", next(frames))
        hand.angle = 300
        threading.Timer(0.1, hand.is_paused.clear).start()
        self.assertIn("the hand has not been open", next(frames))


def packet(*blocks):
    """A packet of the fingertips, after the maker's SDK."""
    data = b"".join(blocks)
    return bytes([0x9A, 0x00, 0x58, len(data)]) + data


def static(finger, counts):
    return bytes([0x10 | finger << 2]) + struct.pack(">28H", *counts)


TIME = bytes([0x70]) + struct.pack(">Q", 0x9A9A9A9A)
DYNAMIC = bytes([0x20]) + struct.pack(">h", -5)


class Gripper2F85:
    """Gripper and fingertips on two pseudo terminals."""

    def __init__(self):
        (self.sensor, sensor), (self.gripper, gripper) = pty.openpty(), pty.openpty()
        self.paths = os.ttyname(sensor), os.ttyname(gripper)
        self.held = sensor, gripper
        self.registers = bytes([0x39 | 3 << 6, 0, 0, 3, 3, 0])
        self.cells = [[0] * 28, [0] * 28]
        self.n_asked, self.is_over = 0, False
        self.thread = threading.Thread(target=self.serve)
        self.thread.start()

    def serve(self):
        asked, begun = b"", False
        while not self.is_over:
            ready = select.select([self.sensor, self.gripper], [], [], 0.005)[0]
            if self.sensor in ready:
                begun = begun or os.read(self.sensor, 64).startswith(b"\x9a\x00\x58\x01\x01")
            if self.gripper in ready:
                asked += os.read(self.gripper, 64)
                while len(asked) >= 8:
                    request, asked = asked[:8], asked[8:]
                    assert request[:6] == bytes([9, 3, 0x07, 0xD0, 0, 3]), request
                    assert FramerRTU.compute_CRC(request[:6]).to_bytes(2, "big") == request[6:], request
                    self.n_asked += 1
                    answer = bytes([9, 3, 6]) + self.registers
                    os.write(self.gripper, answer + FramerRTU.compute_CRC(answer).to_bytes(2, "big"))
            if begun:
                # A packet in two parts, with other blocks, and one without readings of cells.
                sent = packet(TIME, static(0, self.cells[0]), DYNAMIC) + packet(DYNAMIC) + packet(static(1, self.cells[1]))
                os.write(self.sensor, sent[:50])
                os.write(self.sensor, sent[50:])

    def stop(self):
        self.is_over = True
        self.thread.join()
        for file in (self.sensor, self.gripper, *self.held):
            os.close(file)


class Robotiq(unittest.TestCase):
    def test_packets_are_taken_apart(self):
        counts = list(range(0x9A00, 0x9A00 + 28))
        sent = b"\x9a\x00" + packet(TIME, static(1, counts)) + packet(DYNAMIC, static(0, [7] * 28))
        sent += b"\x9a"
        expected = [(1, tuple(counts)), (0, (7,) * 28)]
        self.assertEqual(robotiq.Fingertips().take(sent), expected)
        fingertips = robotiq.Fingertips()
        self.assertEqual([found for byte in sent for found in fingertips.take(bytes([byte]))], expected)

    def test_a_packet_that_lost_a_byte_is_none(self):
        whole = packet(static(0, [24] * 28))
        for lost in range(4, len(whole)):
            found = robotiq.Fingertips().take(whole[:lost] + whole[lost + 1 :] + whole + b"\x9a")
            self.assertEqual(found, [(0, (24,) * 28)], lost)

    def test_states_have_their_meaning(self):
        gripper, clock = robotiq.Gripper(None), itertools.count(0, 300_000_000)
        # gOBJ, gGTO and activation; the position that was asked for, and that of the gripper.
        state = lambda objects, requested, position, status=0x39: gripper.state(next(clock), [status & 0x3F | objects << 6, 0, 0, requested, position, 0])
        self.assertIn("has not been open", state(2, 255, 116))
        self.assertEqual(state(3, 3, 3), (0.0, "open"))
        self.assertEqual(state(0, 255, 100)[1], "closing")
        self.assertEqual(state(2, 255, 116)[1], "closing")
        knuckle, phase = state(2, 255, 116)
        self.assertAlmostEqual(knuckle, 0.7929 * 113 / 227)
        self.assertEqual(phase, "settled")
        self.assertEqual(state(0, 0, 100)[1], "open")
        self.assertIn("not activated", state(0, 0, 0, status=0x00))

    def test_a_grasp_goes_from_the_gripper_to_the_graph(self):
        device = Gripper2F85()
        self.addCleanup(device.stop)
        options = ("--sensor", device.paths[0], "--gripper", device.paths[1])
        received = ReceivedFrames(self, "robotiq-2f85-tsf85", "robotiq_2f85_tsf85.py", *options)

        def frames(n):
            until = device.n_asked + n
            wait_until(lambda: device.n_asked >= until, "the bridge's question")

        device.cells = [[24] * 28, [10] * 28]
        frames(80)
        device.registers = bytes([0x39, 0, 0, 255, 60, 0])
        frames(30)
        device.cells = [[24] * 27 + [124], [60] + [10] * 27]
        device.registers = bytes([0x39 | 2 << 6, 0, 0, 255, 116, 0])
        for _ in range(3):
            frames(20)
            time.sleep(0.2)
        frames(20)
        grasps, _ = received.end()
        [grasp] = grasps
        self.assertEqual(set(grasp.phase), {"open", "closing", "settled"})
        settled = grasp.cells_newtons[-1]
        self.assertAlmostEqual(settled[27], 2.0, places=4)
        self.assertAlmostEqual(settled[28], 1.0, places=4)
        self.assertEqual((settled > 0.001).sum(), 2)
        self.assertAlmostEqual(grasp.joints[-1][0], 0.7929 * 113 / 227, places=5)


class Tables(unittest.TestCase):
    """The tables for ROS 2 fit the layouts."""

    def test_joints_and_cells(self):
        pads = lambda n, size, **parts: [Message(**{name: [of_cell] * size for name, of_cell in parts.items()})] * n
        messages = {
            "unitree-dex3-1": Message(press_sensor_state=pads(9, 12, pressure=110_000.0)),
            "uskin": Message(sensors=pads(2, 16, taxels=Message(z=1000))),
            "robotiq-2f85-tsf85": Message(taxels=pads(2, 28, values=50)),
        }
        for hand, message in messages.items():
            layout = YAML(typ="safe").load(PROJECT / f"hands/{hand}.yaml")
            table = YAML(typ="safe").load(BRIDGES / f"{hand}.yaml")
            # An unknown joint is an error.
            frames = ros_hand.Frames(table, {"joints": layout["joints"]})
            frames.take_cells(0, message, 1)
            [(cells, _)] = frames.cells
            n_cells = cells_of(hand).total()
            self.assertEqual((len(cells), set(cells)), (n_cells, {2.0} if hand == "unitree-dex3-1" else {1.0}), hand)
            [entry] = table["cells"]
            self.assertEqual(len(set(entry.get("order", range(n_cells)))), n_cells, hand)


if __name__ == "__main__":
    unittest.main()
