"""The parts of operators/blindgrasp_operator.py that need no running graph: python3 tests/operator_module.py"""

import struct
import sys
import tempfile
import types
import unittest
from collections import deque
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "operators"))
import blindgrasp_operator as module
from blindgrasp_messages import GraspTruth, Prediction, PredictionHead, TactileFrame, TactileFrameHead
from blindgrasp_operator import Description, Source, Stage

LEFT, RIGHT, OUT = ("left", TactileFrame), ("right", TactileFrame), ("out", Prediction)


class Descriptions(unittest.TestCase):
    def test_one_input_and_one_output_are_described_as_before(self):
        one = Description("mine", "Judges", LEFT, OUT)
        self.assertEqual(one.to_json(), Description("mine", "Judges", inputs=[LEFT], outputs=[OUT]).to_json())
        self.assertTrue(one.to_json()["answers_each"])
        self.assertNotIn("answers_each", Description("mine", "Judges", LEFT, OUT, answers_each=False).to_json())

    def test_sources_and_several_inputs_do_not_answer_each(self):
        for inputs in ([], [LEFT, RIGHT]):
            said = Description("mine", "Judges", inputs=inputs, outputs=[OUT]).to_json()
            self.assertEqual([port["name"] for port in said["inputs"]], [name for name, _ in inputs])
            self.assertNotIn("answers_each", said)

    def test_wrong_ports_are_refused(self):
        for wrong in (
            {"inputs": [LEFT], "outputs": []},
            {"inputs": [LEFT, LEFT], "outputs": [OUT]},
            {"inputs": [LEFT], "outputs": [(*OUT, "right")]},
            {"inputs": [LEFT, RIGHT], "outputs": [OUT], "answers_each": True},
            {"inputs": [], "outputs": [OUT], "answers_each": True},
            {"input": LEFT, "inputs": [LEFT], "outputs": [OUT]},
        ):
            with self.assertRaises(ValueError, msg=str(wrong)):
                Description("mine", "Judges", **wrong)


class Combinations(unittest.TestCase):
    """What cannot keep the promises is refused before a port is opened."""

    def refused(self, reason, description, work):
        with self.assertRaisesRegex(RuntimeError, reason):
            module._instance(None, description, work, {})

    def test_stages_and_sources_that_do_not_fit_their_ports_are_refused(self):
        many = Stage(answer_many=lambda heads, items: [])
        stateful = Stage(lambda head, items: None, state=bytes, restore=lambda state: None)
        self.refused("expected `answer`", Description("mine", "", inputs=[LEFT, RIGHT], outputs=[OUT]), many)
        self.refused("answers_each=False", Description("mine", "", LEFT, OUT), stateful)
        self.refused("neither", Description("mine", "", LEFT, OUT), Stage())
        self.refused("expected a Stage", Description("mine", "", LEFT, OUT), Source(lambda: None))
        self.refused("returns a Source", Description("mine", "", outputs=[OUT]), many)

    def test_a_source_goes_on_in_one_way(self):
        with self.assertRaisesRegex(ValueError, "resume"):
            Source(lambda: None, resume=lambda last: None, state=bytes, restore=lambda state: None)
        with self.assertRaisesRegex(ValueError, "both or neither"):
            Source(lambda: None, state=bytes)
        with self.assertRaisesRegex(RuntimeError, "numbers its samples itself"):
            Source(lambda: None, resume=lambda last: None).lost()


class Publisher:
    """A publisher whose readers have answered up to `answered`."""

    def __init__(self):
        self.sent, self.answered_up_to = [], None

    def last(self):
        return self.sent[-1] if self.sent else None

    def answered(self):
        return self.answered_up_to

    def answered_by_readers(self):
        return True, self.answered_up_to

    def send(self, head, raw_items):
        self.sent.append((head.header.epoch, head.header.seq))
        self.items = raw_items
        return True


class Board:
    """The part of a board that a store uses."""

    def __init__(self):
        self.saved, self.places = None, {}

    def reserve_state(self, region):
        pass

    def save_state(self, region, content):
        self.saved = content

    def state(self, region):
        return self.saved

    def answered(self, cell):
        return self.places.get(cell, (None, [0] * 5))

    def sent(self, cell):
        return self.places.get(cell, (None,))[0]


def port(cls, name, message, **fields):
    made = object.__new__(cls)
    made.port, made.message, made.last = name, message, None
    for key, value in fields.items():
        setattr(made, key, value)
    return made


def instance(board, inputs, outputs):
    reader = lambda cell: types.SimpleNamespace(cell=cell, writer_cell=100 + cell)  # noqa: E731
    made = object.__new__(module._Instance)
    made.operator = types.SimpleNamespace(board=board, wiring={"state_region": 0}, is_to_give_way=lambda: True)
    made.inputs = [
        port(module._Input, name, TactileFrame, counts=[0] * 5, subscriber=reader(cell)) for cell, name in enumerate(inputs)
    ]
    outputs = [
        port(module._Output, name, message, publisher=publisher, saved=deque(), n_sent=0) for name, message, publisher in outputs
    ]
    made.outputs = {output.port: output for output in outputs}
    return made


class Stores(unittest.TestCase):
    def setUp(self):
        self.board, self.a, self.b = Board(), Publisher(), Publisher()

    def made(self, inputs=("left", "right"), state=None):
        made = instance(self.board, inputs, [("a", Prediction, self.a), ("b", TactileFrame, self.b)])
        return made, module._Store(made, state)

    def keep(self, made, name, seq, items=b""):
        head = made.outputs[name].message.Head()
        head.header.epoch, head.header.seq = 3, seq
        made.outputs[name].keep(head, items)

    def test_the_next_instance_sends_what_readers_lack_as_it_was(self):
        before, store = self.made(state=lambda: b"mine")
        before.inputs[0].last, before.inputs[0].counts = (3, 7), (8, 0, 0, 0, 0)
        for seq in range(4):
            self.keep(before, "a", seq)
        self.keep(before, "b", 0, struct.pack("<2d", 1.5, 2.5))
        self.assertTrue(store.save())
        # It is killed after it has sent two of them, of which readers have one.
        self.a.sent, self.a.answered_up_to = [(3, 0), (3, 1)], (3, 0)
        after, store = self.made(state=lambda: b"")
        self.assertEqual(store.restore(is_handed_over=False), (b"mine", False))
        self.assertEqual((after.inputs[0].last, list(after.inputs[0].counts)), ((3, 7), [8, 0, 0, 0, 0]))
        self.assertEqual(after.inputs[1].last, None)
        self.assertTrue(store.send())
        self.assertEqual(self.a.sent[2:], [(3, 1), (3, 2), (3, 3)])
        self.assertEqual((self.b.sent, self.b.items), ([(3, 0)], struct.pack("<2d", 1.5, 2.5)))
        self.assertEqual(module._next_key(after.outputs["a"], after.outputs.values()), (3, 4))
        # Handed over, all that was sent arrives.
        after, store = self.made()
        store.restore(is_handed_over=True)
        self.assertTrue(store.send())
        self.assertEqual(self.a.sent[5:], [])

    def test_samples_that_all_readers_have_are_saved_no_more(self):
        made, store = self.made()
        for seq in range(3):
            self.keep(made, "a", seq)
        store.save()
        store.send()
        n_bytes = len(self.board.saved)
        self.a.answered_up_to = (3, 1)
        store.save()
        self.assertEqual(len(made.outputs["a"].saved), 1)
        self.assertLess(len(self.board.saved), n_bytes)

    def test_what_does_not_fit_waits_for_readers_or_is_refused(self):
        made, store = self.made(state=lambda: bytes(64 << 10))
        with self.assertRaisesRegex(RuntimeError, "its state takes 65536 bytes"):
            store.save()
        made, store = self.made()
        made.outputs["b"].publisher.wait_limit_millis = 1000
        made.outputs["b"].publisher.board = types.SimpleNamespace(add_blocked=lambda cell, nanos: None)
        made.outputs["b"].publisher.cell = 0
        self.keep(made, "b", 0, bytes(40 << 10))
        self.assertTrue(store.save() and store.send())
        saved = self.board.saved
        self.keep(made, "b", 1, bytes(40 << 10))
        # It is asked to give way meanwhile: nothing new is saved.
        self.assertFalse(store.save())
        self.assertEqual(self.board.saved, saved)
        self.b.answered_up_to = (3, 0)
        self.assertTrue(store.save())
        self.assertNotEqual(self.board.saved, saved)

    def test_a_state_of_another_operator_does_not_count(self):
        made, store = self.made()
        made.inputs[0].last = (3, 7)
        store.save()
        # A stage without state has answered since.
        self.board.places = {0: ((3, 9), [10, 0, 0, 0, 0])}
        after, store = self.made()
        with self.assertLogs("blindgrasp"):
            self.assertEqual(store.restore(is_handed_over=True), (None, False))
        self.assertEqual((after.inputs[0].last, after.inputs[0].counts), ((3, 9), [10, 0, 0, 0, 0]))
        self.board.saved = b"of a stage in Rust"
        with self.assertRaisesRegex(RuntimeError, "another language"):
            self.made()[1].restore(is_handed_over=True)
        # A source goes on after the last sample that was sent.
        self.a.sent = [(3, 9)]
        after, store = self.made(inputs=())
        self.assertEqual(store.restore(is_handed_over=True), (None, False))
        self.assertEqual(after.outputs["a"].last, (3, 9))

    def test_the_end_of_a_source_is_saved(self):
        made, store = self.made(inputs=())
        store.save(is_done=True)
        self.assertEqual(self.made(inputs=())[1].restore(is_handed_over=False), (b"", True))


class Answers(unittest.TestCase):
    def setUp(self):
        self.made = instance(Board(), ["left"], [("a", Prediction, None), ("b", TactileFrame, None)])

    def test_a_dict_has_an_answer_by_output(self):
        head = PredictionHead(grasp_id=4)
        said = self.made.by_output({"a": head, "b": None})
        self.assertEqual([(output.port, copy.grasp_id) for output, copy, _ in said], [("a", 4)])
        said[0][1].grasp_id = 5
        self.assertEqual(head.grasp_id, 4, "a copy")
        self.assertEqual(self.made.by_output({"b": (TactileFrameHead(), [1.0, 2.0])})[0][2], struct.pack("<2d", 1, 2))

    def test_wrong_answers_are_refused(self):
        for wrong, reason in (
            (PredictionHead(), "expected a dict"),
            ({"c": PredictionHead()}, "expected one of a, b"),
            ({"a": TactileFrameHead()}, "expected PredictionHead"),
        ):
            with self.assertRaisesRegex(RuntimeError, reason):
                self.made.by_output(wrong)


class Boards(unittest.TestCase):
    def test_a_board_keeps_whole_records_and_states(self):
        with tempfile.NamedTemporaryFile() as file:
            n_cells = 8
            end = -(-(4096 + n_cells * 128) // 4096) * 4096
            file.write(struct.pack("=4Q", module._Board.MAGIC, module._Board.LAYOUT, n_cells, 1))
            file.truncate(end + module._Board.REGION_BYTES)
            file.flush()
            board = module._Board(file.name)
            self.addCleanup(board.file.close)
            self.assertEqual(board.answered(1), (None, [0] * 5))
            board.commit_answered(1, (2, 0), (1, 0, 0, 0, 0))
            self.assertEqual(board.answered(1), ((2, 0), [1, 0, 0, 0, 0]))
            board.count_sent(2, (2, 0))
            board.count_sent(2, (2, 0))
            self.assertEqual(board.sent(2), (2, 0))
            self.assertIsNone(board.state(0))
            board.save_state(0, b"first")
            board.save_state(0, b"second")
            self.assertEqual(board.state(0), b"second")


if __name__ == "__main__":
    unittest.main()
