"""operators/blindgrasp_operator.py without a running graph: python3 tests/operator_module.py"""

import ctypes
import json
import os
import struct
import subprocess
import sys
import unittest
from pathlib import Path

OPERATORS = Path(__file__).resolve().parent.parent / "operators"
sys.path.insert(0, str(OPERATORS))
import blindgrasp_operator as module
from blindgrasp_messages import Prediction, PredictionHead, TactileFrame, TactileFrameHead
from blindgrasp_operator import Description, Source, Stage

LEFT, RIGHT, OUT = ("left", TactileFrame), ("right", TactileFrame), ("out", Prediction)


class Descriptions(unittest.TestCase):
    def test_one_input_and_one_output_are_described_as_lists_of_one(self):
        one = Description("mine", "Judges", LEFT, OUT)
        self.assertEqual(one.to_json(), Description("mine", "Judges", inputs=[LEFT], outputs=[OUT]).to_json())
        self.assertTrue(one.to_json()["answers_each"] and one.to_json()["hosted"])
        self.assertFalse(Description("mine", "Judges", LEFT, OUT, answers_each=False).to_json()["answers_each"])

    def test_sources_and_several_inputs_do_not_answer_each(self):
        for inputs in ([], [LEFT, RIGHT], [(*LEFT, "feedback")]):
            said = Description("mine", "Judges", inputs=inputs, outputs=[OUT]).to_json()
            self.assertEqual([port["name"] for port in said["inputs"]], [port[0] for port in inputs])
            self.assertFalse(said["answers_each"])
        self.assertFalse(Description("mine", "Judges", LEFT).to_json()["answers_each"])
        partner = Description("mine", "Judges", inputs=[LEFT, (*RIGHT, "partner", "optional")], output=OUT).to_json()
        self.assertTrue(partner["answers_each"])
        self.assertEqual(partner["inputs"][1], {"name": "right", "type": TactileFrame.TYPE_NAME, "partner": True, "optional": True})

    def test_wrong_ports_are_refused(self):
        for wrong in (
            {"inputs": [LEFT, LEFT], "outputs": [OUT]},
            {"inputs": [(*LEFT, "feedbakc")], "outputs": [OUT]},
            {"inputs": [LEFT], "outputs": [(*OUT, "right")]},
            {"inputs": [LEFT, RIGHT], "outputs": [OUT], "answers_each": True},
            {"inputs": [], "outputs": [OUT], "answers_each": True},
            {"input": LEFT, "inputs": [LEFT], "outputs": [OUT]},
        ):
            with self.assertRaises(ValueError, msg=str(wrong)):
                Description("mine", "Judges", **wrong)


class Combinations(unittest.TestCase):
    """Others are refused by the host: crates/operator/src/host/mod.rs."""

    def test_a_stage_has_one_function_and_a_whole_state(self):
        for wrong in ({}, {"answer": print, "answer_many": print}, {"answer": print, "state": bytes}):
            with self.assertRaisesRegex(ValueError, "expected"):
                Stage(**wrong)

    def test_a_source_goes_on_in_one_way(self):
        with self.assertRaisesRegex(ValueError, "resume"):
            Source(lambda: None, resume=lambda last: None, state=bytes, restore=lambda state: None)
        with self.assertRaisesRegex(ValueError, "both or neither"):
            Source(lambda: None, state=bytes)
        with self.assertRaisesRegex(RuntimeError, "numbers its samples itself"):
            Source(lambda: None, resume=lambda last: None).lost()


class Frames(unittest.TestCase):
    """The lists of a frame, with and without numpy."""

    def frames(self):
        values = [0.5, 0.7, 0.0, 0.0, 9.8, 0.3]
        kinds = [(ctypes.c_double * 6)(*values)]
        if (numpy := module._numpy()) is not None:
            kinds.append(numpy.array(values))
        for items in kinds:
            frame = TactileFrameHead(n_joints=2, has_senses=0b001)
            frame.items = items
            yield frame

    def test_gravity_is_not_touch(self):
        for frame in self.frames():
            self.assertEqual((list(frame.joints), list(frame.cells)), ([0.5, 0.7], [0.3]))
            senses = {name: list(values) for name, values in frame.senses.items()}
            self.assertEqual(senses, {"gravity_m_per_s2": [0.0, 0.0, 9.8]})

    def test_lists_are_set_whether_or_not_their_length_changes(self):
        for frame in self.frames():
            frame.cells = [1.0]
            frame.joints = [0.1, 0.2]
            self.assertEqual(list(frame.items), [0.1, 0.2, 0.0, 0.0, 9.8, 1.0])
            frame.senses = {"joint_torques": [3.0, 4.0]}
            frame.cells = [5.0, 6.0]
            self.assertEqual(list(frame.items), [0.1, 0.2, 3.0, 4.0, 5.0, 6.0])
            self.assertEqual((frame.n_joints, frame.has_senses), (2, 0b100))

    def test_senses_that_cannot_be_are_refused(self):
        for frame in self.frames():
            for senses, said in (({"joint_torques": [1.0]}, "has 1 values: expected 2"), ({"torques": [1.0]}, "no such sense")):
                with self.assertRaisesRegex(ValueError, said):
                    frame.senses = senses

    def test_a_frame_that_says_too_much_is_refused(self):
        frame = TactileFrameHead(n_joints=5)
        frame.items = [0.7]
        with self.assertRaisesRegex(ValueError, "expected at most as many"):
            frame.cells


PROGRAM = """
import sys
sys.path.insert(0, sys.argv[1])
from blindgrasp_messages import Prediction, PredictionHead, TactileFrame
from blindgrasp_operator import Description, Param, Stage, counted, run

def start(params):
    def answer_many(heads, items):
        print("hello")
        if any(head.grasp_id == 13 for head in heads):
            raise ValueError("an unlucky grasp")
        return [PredictionHead(grasp_id=head.grasp_id, decision_value=float(sum(head.cells)) + params["more"]) for head in heads]
    def check(params):
        if params["more"] < 0:
            raise ValueError("more is less")
    counted(n_started=1)
    return Stage(answer_many=answer_many, set=check, max_items=0)

run(Description("p", "", ("tactile", TactileFrame), ("out", Prediction), [Param("more", "number", live=True)]), start)
"""


class Pipes(unittest.TestCase):
    """A program, and this test as its host."""

    def setUp(self):
        (its_input, self.to), (self.input, its_output) = os.pipe(), os.pipe()
        environment = {**os.environ, module.PIPES_VARIABLE: f"{its_input},{its_output}"}
        command = [sys.executable, "-B", "-c", PROGRAM, str(OPERATORS)]
        self.program = subprocess.Popen(command, env=environment, pass_fds=(its_input, its_output), stdout=subprocess.PIPE)
        os.close(its_input)
        os.close(its_output)
        self.input = open(self.input, "rb")
        self.send(module.START, json.dumps({"version": 1, "params": {"more": 1.0}}).encode())
        self.assertEqual(self.receive(), (module.COUNTS, b'{"n_started": 1}'))
        kind, body = self.receive()
        self.assertEqual((kind, json.loads(body)["batch"], json.loads(body)["max_items"]), (module.READY, 32, {"out": 0}))

    def tearDown(self):
        os.close(self.to)
        self.program.wait()
        self.program.stdout.close()
        self.input.close()

    def send(self, kind, body):
        os.write(self.to, struct.pack("=II", len(body), kind) + body)

    def receive(self):
        n_bytes, kind = struct.unpack("=II", self.input.read(8))
        return kind, self.input.read(n_bytes)

    def ask(self, grasp_id, flags=0):
        head, items = bytes(TactileFrameHead(grasp_id=grasp_id, n_joints=1)), struct.pack("=3d", 9.0, 0.5, 0.25)
        self.send(module.SAMPLE, struct.pack("=QII4I", 0, flags, 0, 0, 0, len(head), len(items)) + head + items)

    def answered(self):
        kind, body = self.receive()
        self.assertEqual(kind, module.DONE)
        head = PredictionHead.from_buffer_copy(body, 16 + 16)
        return head.grasp_id, head.decision_value

    def test_samples_are_answered_together_and_params_change(self):
        self.ask(1, module.MORE)
        self.ask(2)
        self.assertEqual([self.answered(), self.answered()], [(1, 1.75), (2, 1.75)])
        self.send(module.SET, b'{"more": -1}')
        self.assertEqual(self.receive(), (module.REFUSED, b"ValueError: more is less"))
        self.send(module.SET, b'{"more": 2}')
        self.assertEqual(self.receive()[0], module.DONE)
        self.ask(3)
        self.assertEqual(self.answered(), (3, 2.75))

    def test_a_sample_that_fails_is_found_and_its_reason_told(self):
        self.ask(1, module.MORE)
        self.ask(13)
        self.assertEqual(self.receive()[0], module.ONE_BY_ONE)
        self.ask(13)
        kind, line = self.receive()
        self.assertEqual(kind, module.LOG)
        self.assertIn("in answer_many", json.loads(line)["message"])
        self.assertEqual(self.receive(), (module.FAILED, b"ValueError: an unlucky grasp"))
        self.assertEqual(self.program.wait(), 1)

    def test_the_program_ends_with_its_host(self):
        os.close(self.to)
        self.assertEqual(self.program.wait(), 0)
        self.to = os.open(os.devnull, os.O_RDONLY)


class Answers(unittest.TestCase):
    def packed(self, outputs, said):
        description = Description("mine", "", LEFT, outputs=outputs)
        return module._Operator(None, description, Stage(print), {}).packed(said)

    def test_a_dict_has_an_answer_by_output(self):
        outputs = [("a", Prediction), ("b", TactileFrame)]
        packed = self.packed(outputs, {"b": (TactileFrameHead(n_joints=1), [1.5]), "a": None})
        self.assertEqual(struct.unpack("=4I", packed[0]), (1, 0, ctypes.sizeof(TactileFrameHead), 8))
        self.assertEqual(packed[2], struct.pack("=d", 1.5))

    def test_wrong_answers_are_refused(self):
        outputs = [("a", Prediction), ("b", TactileFrame)]
        for wrong, reason in (
            (PredictionHead(), "expected a dict"),
            ({"c": PredictionHead()}, "expected one of a, b"),
            ({"a": TactileFrameHead()}, "expected PredictionHead"),
        ):
            with self.assertRaisesRegex(RuntimeError, reason):
                self.packed(outputs, wrong)

    def test_a_source_leaves_out_numbers_before_the_next_sample_of_each_output(self):
        source = Source(print)
        operator = module._Operator(None, Description("mine", "", outputs=[("a", Prediction), ("b", Prediction)]), source, {})
        source.lost(2)
        source.lost(1, "b")
        lost = lambda said: [struct.unpack("=4I", part)[1] for part in operator.packed(said)[::3]]  # noqa: E731
        self.assertEqual(lost({"a": PredictionHead()}), [2])
        self.assertEqual(lost({"a": PredictionHead(), "b": PredictionHead()}), [0, 3])


if __name__ == "__main__":
    unittest.main()
