"""Tests of the Python package, with the repository's recordings and models and the program that it finds.

    PYTHONPATH=python BLINDGRASP_PROGRAM=target/release/blindgrasp python -m unittest discover python/tests
"""

import contextlib
import datetime
import importlib.util
import io
import json
import math
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import unittest
from pathlib import Path
from unittest import mock
from xml.etree import ElementTree

import blindgrasp
import numpy as np
import pandas as pd
import yaml
from blindgrasp import _recording
from mcap.reader import make_reader
from mcap.writer import Writer

REPOSITORY = Path(__file__).resolve().parents[2]
HELD_OUT = REPOSITORY / "recordings/held-out.mcap"
ORDINARY = REPOSITORY / "recordings/ordinary.mcap"
MODEL = REPOSITORY / "models/barrett-bh8-280.json"
DATAFLOW = REPOSITORY / "dataflow.yaml"

# A graph that replays as fast as it can on a busy machine.
FAST = {"recorded_source.rate": "max", "lift_arbiter.max_age_ms": 600000}


def exported(path, *topics):
    """The lines that `blindgrasp export` writes of these topics."""
    command = [blindgrasp.program(), "export", path, *(word for topic in topics for word in ("--topic", topic))]
    return list(map(json.loads, subprocess.run(command, stdout=subprocess.PIPE, check=True).stdout.splitlines()))


def fields(definition):
    """The lines of a ROS 2 message without comments."""
    return [line.split("#")[0].split() for line in definition.splitlines() if line.split("#")[0].strip()]


def unique_name():
    return f"python-{os.getpid()}-{os.urandom(4).hex()}"


class Folder(unittest.TestCase):
    def setUp(self):
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.folder = Path(folder.name)


class Recordings(Folder):
    def compare(self, path):
        """Compares each number of each grasp with the program's export."""
        grasps = blindgrasp.read(path)
        frames = [(grasp, idx) for grasp in grasps for idx in range(len(grasp.seq))]
        lines = exported(path, "/tactile")
        self.assertEqual(len(frames), len(lines))
        for (grasp, idx), line in zip(frames, lines):
            data = line["data"]
            self.assertEqual((grasp.grasp_id, grasp.phase[idx]), (data["grasp_id"], data["phase"]))
            self.assertEqual((grasp.seq[idx], grasp.stamp_nanos[idx]), (line["seq"], line["stamp_nanos"]))
            lists = {"joints": grasp.joints, "cells_newtons": grasp.cells_newtons} | grasp.senses
            self.assertLessEqual({name for name, value in data.items() if value and isinstance(value, list)}, lists.keys())
            for name, rows in lists.items():
                row = rows[idx]
                # NaN is null in JSON.
                np.testing.assert_array_equal(row[: len(data[name])], np.array(data[name], float))
                self.assertTrue(np.isnan(row[len(data[name]) :]).all())
        by_topic = {topic: {} for topic in ("/truth", "/decision") if topic in blindgrasp.Recording(path).topics}
        for line in exported(path, *by_topic):
            by_topic[line["topic"]][line["data"]["grasp_id"]] = line
        for grasp in grasps:
            label, decision = (by_topic.get(topic, {}).get(grasp.grasp_id) for topic in ("/truth", "/decision"))
            self.assertEqual(grasp.label, label and blindgrasp.Label.from_json(label["data"]))
            if decision is None:
                self.assertIsNone(grasp.decision)
                continue
            found = (grasp.decision.action, grasp.decision.reason, grasp.decision.probability_stable)
            data = decision["data"]
            self.assertEqual(found, (data["action"], data["reason"], data["probability_stable"]))
            found = (grasp.decision.seq, grasp.decision.stamp_nanos)
            self.assertEqual(found, (decision["seq"], decision["stamp_nanos"]))
        return grasps

    def test_grasps_are_those_of_export(self):
        grasps = self.compare(HELD_OUT)
        self.assertEqual(len(grasps), 240)
        self.assertEqual(grasps[0].cells_newtons.shape, (14, 96))
        self.assertEqual(grasps[0].joints.shape, (14, 7))
        self.assertEqual(grasps[0].senses, {})
        self.assertEqual(sum(grasp.label.is_stable for grasp in grasps), 115)
        self.assertEqual((grasps[0].label.object_id, grasps[0].label.object_class), ("vase-20", "vase"))
        self.assertIsNone(grasps[0].decision)

    def test_recordings_of_graphs_and_faults_are_read_and_have_the_messages_of_the_package(self):
        paths = sorted((REPOSITORY / "recordings").glob("*.mcap"))
        self.assertGreater(len(paths), 5)
        for path in paths:
            with self.subTest(path.name):
                if path != HELD_OUT:
                    self.assertTrue(all(grasp.decision for grasp in self.compare(path)))
                with open(path, "rb") as stream:
                    schemas = make_reader(stream).get_summary().schemas.values()
                for schema in schemas:
                    package, _, name = schema.name.split("/")
                    message = REPOSITORY / "examples" / package / "msg" / f"{name}.msg"
                    definition = schema.data.decode().split("=====")[0]
                    self.assertEqual(fields(definition), fields(message.read_text()), schema.name)

    def test_a_recording_of_an_earlier_version_is_read(self):
        earlier = self.folder / "earlier.mcap"
        with open(ORDINARY, "rb") as stream, open(earlier, "wb") as target:
            reader, writer = make_reader(stream), Writer(target)
            writer.start()
            for metadata in reader.iter_metadata():
                writer.add_metadata(metadata.name, metadata.metadata)
            channels, n_renamed = {}, 0
            for schema, channel, message in reader.iter_messages(log_time_order=False):
                if channel.id not in channels:
                    definition = schema.data.replace(b"string object_class\n", b"string class\n")
                    n_renamed += definition != schema.data
                    of = writer.register_schema(schema.name, schema.encoding, definition)
                    channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, of)
                of = channels[channel.id]
                writer.add_message(of, message.log_time, message.data, message.publish_time, message.sequence)
            writer.finish()
        self.assertEqual(n_renamed, 1)
        self.assertNotEqual(self.compare(earlier)[0].label.object_class, "")

    def test_frames_that_lack_cells_end_with_nan(self):
        grasps = blindgrasp.read(REPOSITORY / "recordings/drop-outs.mcap")
        missing = [np.isnan(grasp.cells_newtons).sum(axis=1) for grasp in grasps]
        # Some frames have 90 of 96 cells, and in others one cell is NaN.
        self.assertEqual(set(np.concatenate(missing)), {0, 1, 6})

    def test_a_recording_is_read_again_and_in_part(self):
        recording = blindgrasp.Recording(ORDINARY)
        self.assertEqual(recording.hand, "barrett-bh8-280")
        self.assertEqual(next(iter(recording)).grasp_id, 0)
        self.assertEqual([grasp.grasp_id for grasp in recording], list(range(12)))
        self.assertEqual(recording.topics["/tactile"], sum(len(grasp.seq) for grasp in recording))

    def test_a_recording_has_a_length_and_places(self):
        recording, grasps = blindgrasp.Recording(ORDINARY), blindgrasp.read(ORDINARY)
        self.assertEqual([recording[place].grasp_id for place in (0, 3, -1, np.int64(-12))], [0, 3, 11, 0])
        np.testing.assert_array_equal(recording[3].cells_newtons, grasps[3].cells_newtons)
        self.assertEqual(len(recording), 12)
        for part in (slice(2, 5), slice(-2, None), slice(9, 2, -3), slice(20, None), slice(None, None, 4)):
            self.assertEqual([grasp.grasp_id for grasp in recording[part]], list(range(12))[part], part)
        for place in (12, -13):
            with self.assertRaisesRegex(IndexError, f"12 grasps: there is none at the place {place}"):
                recording[place]
        with self.assertRaises(TypeError):
            recording["3"]
        self.assertLess(len(repr(grasps[3])), 120)
        self.assertEqual(
            repr(grasps[3]),
            "Grasp(3: 14 frames of 7 joints and 96 cells, label stable (bowl-02), decision lift (stable))",
        )

    def test_the_length_is_read_once_and_not_by_read(self):
        recording = blindgrasp.Recording(ORDINARY)
        with mock.patch.object(recording, "_frames_of_grasps", wraps=recording._frames_of_grasps) as reads:
            self.assertEqual((len(list(recording)), len(recording)), (12, 12))
            self.assertEqual(reads.call_count, 2)
        with mock.patch.object(blindgrasp.Recording, "__len__", side_effect=AssertionError):
            self.assertEqual(len(blindgrasp.read(ORDINARY)), 12)

    def test_a_table_has_the_settled_means_the_label_and_the_decision_of_each_grasp(self):
        grasps = blindgrasp.read(ORDINARY)
        table = blindgrasp.Recording(ORDINARY).to_frame()
        self.assertEqual(table["grasp_id"].tolist(), list(range(12)))
        self.assertEqual(table["n_frames"].tolist(), [14] * 12)
        for grasp, (_, row) in zip(grasps, table.iterrows(), strict=True):
            settled = grasp.phase == "settled"
            cells = row.filter(like="cell_").to_numpy(float)
            np.testing.assert_allclose(cells, grasp.cells_newtons[settled].mean(axis=0), atol=1e-12)
            np.testing.assert_allclose(row.filter(like="joint_").to_numpy(float), grasp.joints[settled].mean(axis=0))
            label, decision = grasp.label, grasp.decision
            found = (row["stable"], row["object"], row["object_class"], row["epsilon"], row["volume"])
            self.assertEqual(found, (label.is_stable, label.object_id, label.object_class, label.epsilon, label.volume))
            found = (row["action"], row["reason"], row["probability_stable"])
            self.assertEqual(found, (decision.action, decision.reason, decision.probability_stable))
        self.assertEqual(table["stable"].dtype, bool)
        self.assertTrue(blindgrasp.Recording(HELD_OUT).to_frame()["action"].isna().all())
        path = self.folder / "grasps.parquet"
        table.to_parquet(path)
        pd.testing.assert_frame_equal(pd.read_parquet(path), table)

    def with_an_outcome(self):
        """A copy of ORDINARY with an outcome of grasp 11."""
        golden = json.loads((REPOSITORY / "crates/messages/golden.json").read_text())
        outcome = next(message for message in golden if message["topic"] == "/outcome")
        data = bytearray(b"\x00\x01\x00\x00" + bytes.fromhex(outcome["cdr"]))
        # The header's epoch is that of the recording.
        data[20:28] = bytes(8)
        path = self.folder / "outcome.mcap"
        with ORDINARY.open("rb") as stream, path.open("wb") as copy:
            reader, writer = make_reader(stream), Writer(copy)
            writer.start("ros2")
            for metadata in reader.iter_metadata():
                writer.add_metadata(metadata.name, metadata.metadata)
            writer.add_metadata("graph", {"models": "[one]"})
            channels = {}

            def add(name, definition, topic, message):
                if topic not in channels:
                    schema = writer.register_schema(name, "ros2msg", definition)
                    channels[topic] = writer.register_channel(topic, "cdr", schema)
                writer.add_message(channels[topic], message.log_time, message.data, message.publish_time)

            for schema, channel, message in reader.iter_messages(log_time_order=False):
                add(schema.name, schema.data, channel.topic, message)
            message.data = bytes(data)
            add("blindgrasp_msgs/msg/LiftOutcome", "\n".join(outcome["definition"]).encode(), "/outcome", message)
            writer.finish()
        return path, outcome["json"]

    def test_all_frames_go_to_parquet_and_come_back(self):
        recording, outcome = self.with_an_outcome()
        path = self.folder / "frames.parquet"
        blindgrasp.to_parquet(recording, path, hand="barrett-bh8-280")
        frames, grasps = pd.read_parquet(path), blindgrasp.read(recording)
        self.assertEqual(frames["cell_finger_1_3"].tolist(), [cell for grasp in grasps for cell in grasp.cells_newtons[:, 27]])
        self.assertEqual(frames["seq"].tolist(), [seq for grasp in grasps for seq in grasp.seq])
        found = {line["seq"]: line["data"] for line in exported(recording, "/prediction")}
        known = [np.nan if data["fault"] != "none" else data["probability_stable"] for data in found.values()]
        np.testing.assert_array_equal(frames.sort_values("seq")["predicted"], known)
        last = frames[frames["grasp_id"] == 11].iloc[0]
        self.assertEqual((last["model"], last["day"], last["outcome_slip_m"]), ("[one]", 0, outcome["slip_m"]))
        self.assertEqual((last["outcome_lifted"], last["outcome_held"]), (outcome["lifted"], outcome["held"]))
        self.assertEqual(grasps[11].outcome, outcome)
        self.assertTrue(frames[frames["grasp_id"] < 11]["outcome_lifted"].isna().all())
        [again] = blindgrasp.from_parquet(path, self.folder / "again")
        self.assert_same(grasps, again)
        with self.assertRaisesRegex(FileExistsError, "overwrite=True"):
            blindgrasp.from_parquet(path, self.folder / "again")
        # pandas makes floats of booleans beside missing ones.
        frames = frames.assign(outcome_lifted=frames["outcome_lifted"].astype(float), stable=frames["stable"].astype(float))
        frames.to_parquet(path)
        [again] = blindgrasp.from_parquet(path, self.folder / "again", overwrite=True)
        self.assert_same(grasps, again)
        with self.assertRaisesRegex(FileExistsError, "overwrite=True"):
            blindgrasp.to_parquet(recording, path)
        with self.assertRaisesRegex(ValueError, "outcome.mcap is an input: writing there would destroy it"):
            blindgrasp.to_parquet(self.folder, recording, overwrite=True)
        frames.assign(recording=None).to_parquet(path)
        with self.assertRaisesRegex(ValueError, "names of different files in the column recording, found None"):
            blindgrasp.from_parquet(path, self.folder / "nameless")
        self.assertFalse((self.folder / "nameless").exists())
        for edited, says in (
            ({"stable": frames["stable"].map({1.0: "yes", 0.0: "no"})}, r"grasp \d+: the column stable has '\w+', expected true, false or"),
            ({"outcome_held": frames["outcome_held"].map(str)}, "the column outcome_held has 'False', expected true"),
            ({"grasp": 0}, "grasp_id changes from 0 to 1 within the grasp"),
            ({"seq": frames["seq"] + 0.5}, "the column seq has 0.5, expected a whole number"),
            ({"phase": "setled"}, "the column phase has 'setled', expected one of open"),
            ({"cell_palm_0": np.inf}, r"outcome.mcap, grasp 0 \(/tactile\): "),
            ({"label": "foo"}, r"outcome.mcap, grasp 0 \(/truth\): "),
        ):
            with self.subTest(says=says):
                frames.assign(**edited).to_parquet(path)
                with self.assertRaisesRegex(ValueError, says):
                    blindgrasp.from_parquet(path, self.folder / "refused")
                self.assertFalse((self.folder / "refused").exists())
        frames.sort_values(["grasp", "seq"], ascending=[True, False]).to_parquet(path)
        with self.assertWarnsRegex(UserWarning, "frame 12 comes after frame 13"):
            blindgrasp.from_parquet(path, self.folder / "reversed")
        # Only what is read back must be there.
        needless = ["action", "reason", "probability_stable", "predicted", "model", "day", "object_class", *frames.filter(like="outcome_")]
        frames.drop(columns=needless).to_parquet(path)
        [again] = blindgrasp.from_parquet(path, self.folder / "less")
        self.assertEqual([grasp.label.is_stable for grasp in again], [grasp.label.is_stable for grasp in grasps])

    def test_what_stable_means_comes_back(self):
        blindgrasp.to_parquet(HELD_OUT, self.folder / "frames.parquet")
        blindgrasp.to_lerobot(HELD_OUT, self.folder / "dataset")
        for source in ("frames.parquet", "dataset"):
            [again] = blindgrasp.from_parquet(self.folder / source, self.folder / f"again-{source}")
            self.assertEqual((blindgrasp.Recording(HELD_OUT).label_kind, again.label_kind), ("wrench-space", "wrench-space"))
        # Half a dataset, as after a download that was interrupted.
        [data] = (self.folder / "dataset").glob("data/*/*.parquet")
        table = pd.read_parquet(data)
        table[table["episode_index"] < 3].to_parquet(data)
        with self.assertRaisesRegex(ValueError, "expected 240 episodes with 3360 frames, found 240 with 42"):
            blindgrasp.from_parquet(self.folder / "dataset", self.folder / "half")

    def assert_same(self, grasps, again):
        """All but decisions and predictions."""
        for grasp, copied in zip(grasps, again, strict=True):
            for name in ("seq", "stamp_nanos", "joints", "cells_newtons", "phase"):
                np.testing.assert_array_equal(getattr(copied, name), getattr(grasp, name))
            self.assertEqual(copied.senses.keys(), grasp.senses.keys())
            for name, values in grasp.senses.items():
                np.testing.assert_array_equal(copied.senses[name], values)
            for name in ("grasp_id", "epoch", "hand_id", "day", "outcome"):
                self.assertEqual(getattr(copied, name), getattr(grasp, name))
            np.testing.assert_equal(vars(copied.label) if copied.label else None, vars(grasp.label) if grasp.label else None)

    def test_grasps_with_lost_cells_other_senses_one_label_or_none_come_back(self):
        own = self.folder / "own.jsonl"
        lines = [line for line in exported(ORDINARY, "/tactile", "/truth") if line["data"]["grasp_id"] in (0, 1)]
        stable = next(line for line in lines if line["topic"] == "/truth" and line["data"]["stable"])
        kept = [line for line in lines if line["topic"] == "/tactile"] + [stable]
        for line in kept[:14]:
            line["data"]["cells_newtons"][3] = None
            line["data"] |= {"gravity_m_per_s2": [0.5, 0.0, -9.8], "day": 20261124}
        # The source began anew, with the same numbers.
        kept += [line | {"epoch": 7} for line in kept]
        own.write_text("\n".join(map(json.dumps, kept)))
        path, recording = self.folder / "frames.parquet", self.folder / "own.mcap"
        words = ["--lines", "--hand", "barrett-bh8-280", "--out"]
        subprocess.run([str(blindgrasp.program()), "import", str(own), *words, str(recording)], check=True, capture_output=True)
        grasps = blindgrasp.read(recording)
        self.assertTrue(np.isnan(grasps[0].cells_newtons[0, 3]))
        self.assertEqual([(grasp.epoch, grasp.label is None) for grasp in grasps].count((7, True)), 1)
        self.assertEqual(len(grasps), 4)
        blindgrasp.to_parquet(recording, path)
        blindgrasp.to_lerobot(recording, self.folder / "dataset")
        for source in (path, self.folder / "dataset"):
            [again] = blindgrasp.from_parquet(source, self.folder / f"again-{source.name}")
            self.assert_same(grasps, again)
        copied = self.folder / "copied" / recording.name
        copied.parent.mkdir()
        copied.write_bytes(recording.read_bytes())
        blindgrasp.to_parquet([recording, copied], path, overwrite=True)
        both = blindgrasp.from_parquet(path, self.folder / "both")
        self.assertEqual([again.path.relative_to(self.folder / "both").as_posix() for again in both], ["own.mcap", "copied/own.mcap"])
        for again in both:
            self.assert_same(grasps, again)
        with self.assertRaisesRegex(ValueError, "expected different recordings, found own.mcap twice"):
            blindgrasp.to_parquet([recording, recording], path, overwrite=True)
        # pandas adds an index, and a user columns.
        blindgrasp.to_parquet(recording, path, hand="barrett-bh8-280", overwrite=True)
        table = pd.read_parquet(path)
        table = table[sorted(table.columns)][table["grasp_id"] == 1].assign(note="text", weight_kg=0.5)
        table.to_parquet(path)
        [again] = blindgrasp.from_parquet(path, self.folder / "edited")
        self.assert_same([grasp for grasp in grasps if grasp.grasp_id == 1], again)
        for edited, says in ((table.head(0), "expected frames, found none"), (table.drop(columns="cell_palm_3"), "no 'cell_palm_3'")):
            edited.to_parquet(path)
            with self.assertRaisesRegex(ValueError, says):
                blindgrasp.from_parquet(path, self.folder / "refused")

    def test_grasps_of_two_recordings_come_back_unmerged(self):
        recording, _ = self.with_an_outcome()
        copied = self.folder / "other.mcap"
        copied.write_bytes(recording.read_bytes())
        path, again = self.folder / "frames.parquet", self.folder / "again.mcap"
        blindgrasp.to_parquet([recording, copied], path)
        columns = {"grasp_column": "grasp", "phase_column": "phase"}
        frames = pd.read_parquet(path)
        # The grasps of both recordings have the same numbers, and may follow each other.
        frames = frames.sort_values(["grasp_id", "grasp"], kind="stable")
        copied = blindgrasp.from_table(frames, again, hand="barrett-bh8-280", **columns)
        self.assertEqual([len(grasp.seq) for grasp in copied], [len(grasp.seq) for grasp in blindgrasp.read(recording) for _ in range(2)])

    def test_recordings_of_two_hands_are_no_data_set(self):
        with self.assertRaisesRegex(ValueError, "expected recordings of one hand, found"):
            blindgrasp.to_parquet([ORDINARY, REPOSITORY / "recordings/other-hand.mcap"], self.folder / "frames.parquet")
        with self.assertRaisesRegex(blindgrasp.ProgramError, "there is no recording in this folder"):
            blindgrasp.to_parquet(self.folder, self.folder / "frames.parquet")
        self.assertEqual(list(self.folder.iterdir()), [])
        # A folder with a compressed recording is refused, as by the commands.
        copied = self.folder / "one.mcap"
        copied.write_bytes(ORDINARY.read_bytes())
        compressed = self.folder / "two.mcap.zstd"
        compressed.touch()
        with self.assertRaisesRegex(blindgrasp.ProgramError, "two.mcap.zstd is compressed: unpack it"):
            blindgrasp.to_lerobot(self.folder, self.folder / "dataset")
        compressed.unlink()
        blindgrasp.to_lerobot([self.folder], self.folder / "dataset")
        with self.assertRaisesRegex(FileExistsError, "dataset exists: name another folder"):
            blindgrasp.to_lerobot(self.folder, self.folder / "dataset")

    def test_the_cells_of_a_table_have_the_names_of_the_pads(self):
        recording = blindgrasp.Recording(ORDINARY)
        numbered = recording.to_frame().filter(like="cell_")
        self.assertEqual(numbered.columns.tolist(), [f"cell_{idx}" for idx in range(96)])
        for hand in ("barrett-bh8-280", REPOSITORY / "hands/barrett-bh8-280.yaml"):
            named = recording.to_frame(hand=hand).filter(like="cell_")
            pads = ("palm", "finger_1", "finger_2", "finger_3")
            self.assertEqual(named.columns.tolist(), [f"cell_{pad}_{idx}" for pad in pads for idx in range(24)])
            np.testing.assert_array_equal(named.to_numpy(), numbered.to_numpy())
        with self.assertRaisesRegex(ValueError, "96 cells and the hand parallel-gripper has"):
            recording.to_frame(hand="parallel-gripper")
        with self.assertRaisesRegex(ValueError, "is no hand"):
            recording.to_frame(hand=ORDINARY)

    def test_the_order_of_a_tables_columns_does_not_matter(self):
        model = blindgrasp.Model(MODEL)
        for hand in (None, "barrett-bh8-280"):
            table = blindgrasp.Recording(HELD_OUT).to_frame(hand=hand).head(12)
            shuffled = table[sorted(table.columns, reverse=True)]
            expected = model.predict(table).probability_stable
            self.assertTrue(np.array_equal(model.predict(shuffled).probability_stable, expected))
        with self.assertRaisesRegex(ValueError, "not numbered from 0"):
            model.predict(blindgrasp.Recording(HELD_OUT).to_frame().head(2).drop(columns="cell_3"))
        with self.assertRaisesRegex(ValueError, "not those of the model's hand"):
            model.predict(table.rename(columns={"cell_palm_0": "cell_plam_0"}))

    def test_the_labels_of_a_table_are_those_of_its_predictions(self):
        table = blindgrasp.Recording(HELD_OUT).to_frame().head(12)
        model = blindgrasp.Model(MODEL)
        labels = [grasp.label for grasp in blindgrasp.Recording(HELD_OUT)][:12]
        self.assertEqual(model.predict(table).labels, labels)
        table["stable"] = table["stable"].astype("boolean").mask(table.index == 3)
        self.assertEqual(model.predict(table).labels, [*labels[:3], None, *labels[4:]])
        self.assertFalse(model.predict(table.drop(columns="stable")).is_labelled.any())

    def test_a_row_that_is_not_finite_is_held(self):
        table = blindgrasp.Recording(HELD_OUT).to_frame().head(2)
        table.loc[0, "cell_0"] = np.nan
        predictions = blindgrasp.Model(MODEL).predict(table.head(1))
        self.assertEqual([predictions.action[0], predictions.reason[0]], ["hold", "invalid"])

    def test_what_is_not_known_is_missing_in_a_table(self):
        nan = math.nan
        rows = np.array([[1.0, nan, nan], [3.0, 5.0, nan]])
        np.testing.assert_array_equal(_recording.mean_of_rows(rows), [2.0, 5.0, nan])
        np.testing.assert_array_equal(_recording.mean_of_rows(rows[:0]), [nan] * 3)
        columns = pd.DataFrame(_recording.label_columns([blindgrasp.Label(True, object_id="mug-02"), None]))
        self.assertEqual(columns["stable"].isna().tolist(), [False, True])
        self.assertEqual(columns["object"].isna().tolist(), [False, True])
        self.assertTrue(columns[["object_class", "epsilon"]].isna().all(axis=None))

    def test_a_table_without_pandas_is_refused_in_words(self):
        with mock.patch.dict(sys.modules, pandas=None):
            with self.assertRaisesRegex(ModuleNotFoundError, "pip install pandas"):
                blindgrasp.Recording(ORDINARY).to_frame()
            with self.assertRaisesRegex(ModuleNotFoundError, "pip install pandas"):
                blindgrasp.Model(MODEL).predict(ORDINARY).to_frame()

    def test_codes_are_those_of_the_messages(self):
        path = REPOSITORY / "operators/blindgrasp_messages.py"
        spec = importlib.util.spec_from_file_location("blindgrasp_messages", path)
        messages = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(messages)
        for name in ("Phase", "Action", "Reason"):
            words = getattr(_recording, f"{name.upper()}S")
            found = words if isinstance(words, dict) else dict(enumerate(words))
            self.assertEqual(found, {code.value: code.name.lower() for code in getattr(messages, name)})

    def test_what_cannot_be_read_is_said(self):
        with self.assertRaises(FileNotFoundError):
            blindgrasp.read(self.folder / "none.mcap")
        whole = HELD_OUT.read_bytes()
        end_changed = bytearray(whole)
        end_changed[-300] ^= 1
        chunk_changed = bytearray(whole)
        chunk_changed[300_000] ^= 1
        for content, words in (
            (b"", "is not a recording: expected an MCAP file"),
            (b"no recording", "is not a recording: expected an MCAP file"),
            (whole[:5], "is not a recording: expected an MCAP file"),
            (whole[:8], "was cut off or is damaged"),
            (whole[:300_000], "was cut off or is damaged"),
            (end_changed, "its summary has a wrong checksum"),
            (chunk_changed, "was cut off or is damaged"),
        ):
            path = self.folder / "file.mcap"
            path.write_bytes(content)
            with self.assertRaisesRegex(blindgrasp.RecordingError, words):
                blindgrasp.read(path)
        for topic in ("/touch", "/truth"):
            with self.assertRaisesRegex(blindgrasp.RecordingError, f"the topic {topic}: topics with frames: /tactile"):
                blindgrasp.Recording(HELD_OUT, topic=topic)

    def test_a_cut_recording_is_read_after_its_repair(self):
        path = self.folder / "cut.mcap"
        path.write_bytes(HELD_OUT.read_bytes()[:500_000])
        with self.assertRaises(blindgrasp.RecordingError) as raised:
            blindgrasp.read(path)
        command = re.search("`blindgrasp (.*)`", str(raised.exception))[1].split()
        self.assertEqual(subprocess.run([blindgrasp.program(), *command], capture_output=True).returncode, 3)
        n_grasps = len(blindgrasp.read(self.folder / "cut.repaired.mcap"))
        self.assertTrue(0 < n_grasps < 240, n_grasps)


class Models(Folder):
    def test_a_model_is_described(self):
        model = blindgrasp.Model(MODEL)
        self.assertEqual((model.hand, model.recipe, model.threshold_probability), ("barrett-bh8-280", "boosted", 0.5))
        self.assertEqual(model.hand_id, blindgrasp.Recording(HELD_OUT).hand_id)
        self.assertEqual(len(model.objects), 480)
        with self.assertRaises(FileNotFoundError):
            blindgrasp.Model(self.folder / "none.json")
        (self.folder / "none.json").write_text("{}")
        with self.assertRaises(blindgrasp.ProgramError) as raised:
            blindgrasp.Model(self.folder / "none.json")
        self.assertEqual(raised.exception.exit_code, 1)
        self.assertIn("none.json", str(raised.exception))

    def check_predictions(self, model):
        """Predicts a recording in each form that `predict` takes, and compares them."""
        recording = blindgrasp.Recording(ORDINARY)
        grasps = list(recording)
        of_path = model.predict(ORDINARY)
        self.assertEqual(of_path.grasp_id.tolist(), list(range(12)))
        self.assertEqual(set(of_path.file), {str(ORDINARY)})
        self.assertTrue(((of_path.probability_stable >= 0) & (of_path.probability_stable <= 1)).all())
        self.assertEqual(of_path.is_stable.tolist(), [grasp.label.is_stable for grasp in grasps])
        self.assertEqual([label.object_id for label in of_path.labels], [grasp.label.object_id for grasp in grasps])
        self.assertTrue(of_path.is_labelled.all())
        self.assertEqual(of_path.is_lifted.tolist(), [action == "lift" for action in of_path.action])
        for source in (str(ORDINARY), recording, grasps, iter(grasps)):
            other = model.predict(source)
            for name in ("grasp_id", "probability_stable", "action", "reason", "is_stable"):
                np.testing.assert_array_equal(getattr(other, name), getattr(of_path, name), name)
        self.assertEqual(len(model.predict(grasps[3])), 1)
        self.assertEqual(model.predict(grasps[3]).action[0], of_path.action[3])
        self.assertEqual(len(model.predict([ORDINARY, ORDINARY])), 24)
        self.assertEqual(len(model.predict([])), 0)
        with self.assertRaises(TypeError):
            model.predict([ORDINARY, grasps[0]])
        with self.assertRaisesRegex(blindgrasp.ProgramError, "none.mcap"):
            model.predict(self.folder / "none.mcap")
        return of_path

    def test_predictions_are_a_sequence_and_a_table(self):
        found = blindgrasp.Model(MODEL).predict(HELD_OUT)
        n_lifted = int(found.is_lifted.sum())
        accuracy = np.mean(found.is_lifted == found.is_stable)
        self.assertEqual(
            repr(found),
            f"Predictions(240 grasps, {n_lifted} lifted, {240 - n_lifted} held, "
            f"accuracy {accuracy:.1%} of 240 labelled)",
        )
        self.assertAlmostEqual(found.accuracy, accuracy)
        self.assertEqual(found.false_positives, np.sum(found.is_lifted & ~found.is_stable))
        rows = list(found)
        self.assertEqual(rows[-1], found[-1])
        self.assertEqual([row.grasp_id for row in rows], found.grasp_id.tolist())
        row = found[np.int64(3)]
        self.assertEqual((row.grasp_id, row.label, row.is_lifted), (3, found.labels[3], found.is_lifted[3]))
        for name in ("file", "probability_stable", "action", "reason"):
            self.assertEqual(getattr(row, name), getattr(found, name)[3])
        with self.assertRaises(IndexError):
            found[240]
        self.assertEqual(found[5:2:-1].grasp_id.tolist(), [5, 4, 3])
        self.assertEqual(found[[7, 1]].labels, [found.labels[7], found.labels[1]])
        wrong = found[found.is_lifted & ~found.is_stable]
        self.assertEqual((len(wrong), wrong.accuracy), (found.false_positives, 0.0))
        table = found.to_frame()
        for name in ("file", "grasp_id", "probability_stable", "action", "reason"):
            self.assertEqual(table[name].tolist(), getattr(found, name).tolist())
        self.assertEqual(table["stable"].tolist(), found.is_stable.tolist())
        self.assertEqual(table["object"].tolist(), [label.object_id for label in found.labels])
        none = found[:0]
        self.assertEqual((none.accuracy, none.false_positives, len(none.to_frame())), (None, None, 0))
        self.assertEqual(repr(none), "Predictions(0 grasps, 0 lifted, 0 held)")

    def test_probabilities_are_those_that_decided(self):
        model = blindgrasp.Model(MODEL)
        found, probabilities = model.predict(HELD_OUT), model.predict_proba(HELD_OUT)
        self.assertEqual(probabilities.shape, (240, 2))
        is_decided = np.isin(found.reason, ["stable", "unstable", "unsure"])
        self.assertTrue(0 < is_decided.sum() < 240)
        np.testing.assert_array_equal(probabilities[is_decided, 1], found.probability_stable[is_decided])
        np.testing.assert_allclose(probabilities[is_decided].sum(axis=1), 1.0)
        self.assertTrue(np.isnan(probabilities[~is_decided]).all())
        np.testing.assert_array_equal(
            probabilities[is_decided, 1] >= model.threshold_probability, found.is_lifted[is_decided]
        )
        np.testing.assert_array_equal(model.predict_proba(blindgrasp.read(HELD_OUT)), probabilities)
        with_layout = blindgrasp.Model(MODEL, hand=REPOSITORY / "hands/barrett-bh8-280.yaml")
        np.testing.assert_array_equal(with_layout.predict_proba(HELD_OUT), probabilities)

    def test_arrays_and_tables_are_settled_frames(self):
        model, grasps = blindgrasp.Model(MODEL), blindgrasp.read(HELD_OUT)[:20]
        probabilities = model.predict_proba(grasps)
        settled = [grasp.phase == "settled" for grasp in grasps]
        joints = np.array([grasp.joints[rows] for grasp, rows in zip(grasps, settled)])
        cells = np.array([grasp.cells_newtons[rows] for grasp, rows in zip(grasps, settled)])
        self.assertEqual(cells.shape, (20, 6, 96))
        np.testing.assert_array_equal(model.predict_proba(joints, cells), probabilities)
        # A frame alone votes as often as is needed, and the lowest probability of three frames, if none is filtered, decides.
        alone = np.array([model.predict_proba(joints[:, idx], cells[:, idx])[:, 1] for idx in range(3)])
        with tempfile.TemporaryDirectory() as folder:
            shutil.copy(REPOSITORY / "hands/barrett-bh8-280.urdf", folder)
            layout = Path(folder) / "unfiltered.yaml"
            layout.write_text((REPOSITORY / "hands/barrett-bh8-280.yaml").read_text() + "median_filter: false\n")
            unfiltered = blindgrasp.Model(MODEL, hand=layout)
            is_one_sided = np.isin(unfiltered.predict(grasps).reason, ["stable", "unstable"])
            lowest = alone.min(axis=0)[is_one_sided]
            np.testing.assert_array_equal(lowest, unfiltered.predict_proba(grasps)[is_one_sided, 1])
        np.testing.assert_array_equal(model.predict_proba(joints[:, :1], cells[:, :1])[:, 1], alone[0])
        table = blindgrasp.Recording(HELD_OUT).to_frame()[:20]
        of_means = model.predict_proba(joints.mean(axis=1), cells.mean(axis=1))
        np.testing.assert_allclose(model.predict_proba(table), of_means)
        named = blindgrasp.Recording(HELD_OUT).to_frame(hand="barrett-bh8-280")[:20]
        np.testing.assert_array_equal(model.predict_proba(named), model.predict_proba(table))
        self.assertEqual(model.predict(table).grasp_id.tolist(), list(range(20)))
        self.assertEqual(model.predict_proba(joints[:0], cells[:0]).shape, (0, 2))

    def test_arrays_of_another_size_are_refused(self):
        model, joints, cells = blindgrasp.Model(MODEL), np.zeros((4, 7)), np.ones((4, 96))
        for given, words in (
            ((joints, cells[:, :90]), r"7 joints and 90 cells\): expected as many as the hand barrett"),
            ((joints, cells[:3]), r"in each array, found joints \(4, 7\), cells_newtons \(3, 96\)"),
            ((joints[0], cells[0]), "as many grasps and frames in each array"),
            ((joints[:, np.newaxis][:, :0], cells[:, np.newaxis][:, :0]), "nothing to decide on"),
            ((pd.DataFrame({"stable": [True]}),), "no columns joint_0"),
        ):
            with self.assertRaisesRegex(ValueError, words):
                model.predict_proba(*given)
        with self.assertRaisesRegex(TypeError, "expected two, the joints and the cells"):
            model.predict(joints)

    def test_the_program_predicts(self):
        found = self.check_predictions(blindgrasp.Model(MODEL))
        recorded = [grasp.decision for grasp in blindgrasp.Recording(ORDINARY)]
        self.assertEqual(found.action.tolist(), [decision.action for decision in recorded])


class Graphs(Folder):
    def test_a_graph_that_has_ended_before_it_is_seen_running_is_read(self):
        # It is never seen running; its decisions are read all the same.
        with mock.patch("blindgrasp._graph.answer_of", return_value={"graphs": []}):
            with blindgrasp.run(DATAFLOW, set=FAST, name=unique_name()) as graph:
                self.assertEqual(len(list(graph)), 240)
        self.assertIsNone(graph.name)

    def test_a_graph_is_run_to_its_end_and_recorded(self):
        recorded = self.folder / "run.mcap"
        with blindgrasp.run(DATAFLOW, set=FAST, name=unique_name(), recording=recorded) as graph:
            decisions = list(graph)
        self.assertEqual([decision.grasp_id for decision in decisions], list(range(240)))
        self.assertEqual((graph.summary["grasps"], graph.summary["samples_lost"]), (240, 0))
        n_right = sum((decision.action == "lift") == decision.label.is_stable for decision in decisions)
        self.assertAlmostEqual(n_right / 240, graph.summary["accuracy"])
        grasps = blindgrasp.read(recorded)
        for grasp, decision in zip(grasps, decisions, strict=True):
            self.assertEqual(grasp.label, decision.label)
            found = (grasp.decision.action, grasp.decision.reason, grasp.decision.probability_stable)
            self.assertEqual(found, (decision.action, decision.reason, decision.probability_stable))

    def test_lift_trials_have_outcomes_senses_and_several_decisions_of_a_grasp(self):
        recorded, given = self.folder / "trials.mcap", {"source.trials": 2, "lift_arbiter.max_age_ms": 600000}
        flow = REPOSITORY / "dataflow-live.yaml"
        running = blindgrasp.run(flow, set=given, name=unique_name(), recording=recorded)
        with mock.patch.dict(os.environ, SOURCE="simulated_hand"), running as graph:
            decisions = list(graph)
        grasps = blindgrasp.read(recorded)
        of_grasps = [decision for grasp in grasps for decision in grasp.decisions]
        words = lambda decision: (decision.grasp_id, decision.action, decision.reason)  # noqa: E731
        self.assertEqual([words(decision) for decision in of_grasps], [words(decision) for decision in decisions])
        self.assertIn("test_lift", [decision.action for decision in decisions])
        self.assertEqual([outcome["grasp_id"] for outcome in graph.outcomes], [grasp.grasp_id for grasp in grasps])
        for grasp, outcome in zip(grasps, graph.outcomes, strict=True):
            self.assertEqual(outcome["lifted"], grasp.decision.action == "lift")
            self.assertEqual(grasp.label and grasp.label.is_stable, outcome["held"] if outcome["lifted"] else None)
            n_values = {name: rows.shape[1] for name, rows in grasp.senses.items()}
            n_joints = grasp.joints.shape[1]
            self.assertEqual(n_values, {"gravity_m_per_s2": 3, "wrist_wrench": 6, "joint_torques": n_joints})
            self.assertAlmostEqual(np.linalg.norm(grasp.senses["gravity_m_per_s2"][0]), 9.81, delta=0.5)

    def test_a_graph_is_ended_with_its_block(self):
        forever = {"recorded_source.repeat": "forever", "lift_arbiter.max_age_ms": 600000}
        name = unique_name()
        with blindgrasp.run(DATAFLOW, set=forever, name=name) as graph:
            self.assertEqual(graph.name, name)
            self.assertEqual(len(list(blindgrasp.echo(graph.name, "classifier/prediction", samples=30))), 30)
            topics = set()
            for sample in blindgrasp.echo(graph.name, "lift_arbiter/decision", "classifier/prediction"):
                topics.add(sample["topic"])
                if topics == {"/decision", "/prediction"}:
                    break
            decision = next(iter(graph))
            self.assertEqual((decision.grasp_id, decision.action), (0, "lift"))
            for sample in blindgrasp.echo(graph.name, "recorded_source/tactile"):
                self.assertEqual(len(sample["data"]["cells_newtons"]), 96)
                break
            with self.assertRaisesRegex(blindgrasp.ProgramError, "no_node"):
                list(blindgrasp.echo(graph.name, "no_node/decision"))
        self.assertEqual(graph.summary["samples_lost"], 0)
        self.assertIn(name, graph.stderr)
        with self.assertRaisesRegex(blindgrasp.ProgramError, name):
            list(blindgrasp.echo(name))

    def test_an_exception_ends_the_graph(self):
        name = unique_name()
        with self.assertRaisesRegex(ZeroDivisionError, "mine"):
            with blindgrasp.run(DATAFLOW, name=name, set={"recorded_source.repeat": "forever"}):
                raise ZeroDivisionError("mine")
        with self.assertRaisesRegex(blindgrasp.ProgramError, name):
            list(blindgrasp.echo(name))

    def test_a_graph_that_does_not_start_raises_what_the_program_said(self):
        for dataflow, given, words in (
            (self.folder / "none.yaml", {}, "none.yaml: cannot read the file"),
            (DATAFLOW, {"lift_arbiter.votes": -1}, "votes"),
        ):
            with self.assertRaisesRegex(blindgrasp.ProgramError, words) as raised:
                with blindgrasp.run(dataflow, set=given, name=unique_name()):
                    self.fail("the graph runs")
            self.assertGreater(raised.exception.exit_code, 0)

    def test_a_graph_that_fails_raises(self):
        flow = self.folder / "dataflow.yaml"
        text = DATAFLOW.read_text()
        for folder in ("recordings", "models", "hands"):
            text = text.replace(f": {folder}/", f": {REPOSITORY}/{folder}/")
        flow.write_text(text.replace("  classifier:\n", "  classifier:\n    restart: never\n"))
        with self.assertRaisesRegex(blindgrasp.ProgramError, "classifier"):
            with blindgrasp.run(flow, name=unique_name(), set={"recorded_source.repeat": "forever"}) as graph:
                shown = subprocess.run(
                    [blindgrasp.program(), "ps", graph.name, "--json"], stdout=subprocess.PIPE, check=True
                )
                nodes = json.loads(shown.stdout)["graphs"][0]["nodes"]
                os.kill(next(node["pid"] for node in nodes if node["node"] == "classifier"), 9)
                list(graph)

    def test_a_replay_gives_the_decision_of_each_grasp(self):
        decisions = blindgrasp.replay(ORDINARY, DATAFLOW)
        grasps = blindgrasp.read(ORDINARY)
        self.assertEqual(list(decisions), [grasp.grasp_id for grasp in grasps])
        for grasp in grasps:
            found = decisions[grasp.grasp_id]
            self.assertEqual((found.action, found.reason), (grasp.decision.action, grasp.decision.reason))
            self.assertEqual(found.label, grasp.label)
        is_lifted = np.array([decision.action == "lift" for decision in decisions.values()])
        is_stable = np.array([grasp.label.is_stable for grasp in grasps])
        self.assertAlmostEqual(decisions.accuracy, np.mean(is_lifted == is_stable))
        self.assertEqual(decisions.false_positives, np.sum(is_lifted & ~is_stable))
        self.assertRegex(repr(decisions), r"^ReplayedDecisions\(12 grasps, \d+ lifted, \d+ held, accuracy .*\)$")
        self.assertEqual(decisions.summary["samples_lost"], 0)
        self.assertNotIn(12, decisions)
        strict = blindgrasp.replay(ORDINARY, DATAFLOW, set={"lift_arbiter.min_probability_stable": 1}, grasps=[1, 3])
        self.assertEqual([(key, decision.action) for key, decision in strict.items()], [(1, "hold"), (3, "hold")])
        with self.assertRaisesRegex(blindgrasp.ProgramError, "none.mcap"):
            blindgrasp.replay(self.folder / "none.mcap", DATAFLOW)

    def test_what_comes_while_the_arm_lifts_is_no_decision_about_the_lift(self):
        line = {"grasp_id": 4, "reason": "stable", "probability_stable": 0.9, "seq": 0, "stamp_nanos": 0}
        actions = ("test_lift", "lift", "set_down")
        every = [blindgrasp.Decision.from_json(line | {"action": action}) for action in actions]
        summary = {"accuracy": None, "false_positives": 0, "with_truth": 0}
        decisions = blindgrasp.ReplayedDecisions(every, summary, "")
        self.assertEqual((len(decisions), decisions[4].action, len(decisions.every)), (1, "lift", 3))
        # Without labels, a test of false positives must not pass.
        self.assertEqual((decisions.accuracy, decisions.false_positives), (None, None))
        self.assertEqual(repr(decisions), "ReplayedDecisions(1 grasps, 1 lifted, 0 held)")

    def test_only_a_live_lift_may_be_acted_upon(self):
        live = {"grasp_id": 1, "action": "lift", "reason": "stable", "probability_stable": 0.9}
        live |= {"seq": 1, "stamp_nanos": 2}
        far = {"valid_until_nanos": 1 << 62}
        self.assertTrue(blindgrasp.Decision.from_json(live | far).may_lift())
        self.assertFalse(blindgrasp.Decision.from_json(live | far | {"action": "squeeze"}).may_lift())
        self.assertFalse(blindgrasp.Decision.from_json(live | {"valid_until_nanos": 1}).may_lift())
        self.assertFalse(blindgrasp.Decision.from_json(live).may_lift())
        label = blindgrasp.Decision.from_json(live | {"truth": {"stable": True, "epsilon": None}}).label
        self.assertTrue(label.is_stable and math.isnan(label.epsilon) and label.object_id == "")


MJCF = """<mujoco model="hand"><compiler angle="radian"/>
<asset><mesh name="tip" vertex="0 0 0 .01 0 0 0 .01 0 0 0 .01"/></asset>
<worldbody><body name="palm" pos="0 0 .3" quat=".7071 0 .7071 0"><geom type="box" size=".04 .04 .01"/>
  <body name="f1" pos=".05 0 .01"><joint name="j1" axis="0 -1 0" range="-.4 1.2" pos="0 0 -.005"/>
    <geom type="capsule" size=".008 .03" pos="0 0 .03"/>
    <body name="f2" pos="0 0 .06" euler="0 .1 .2"><joint name="j2" axis="0 -1 0" range="0 1.5"/>
      <geom type="mesh" mesh="tip"/><geom type="ellipsoid" size=".01 .008 .012" contype="0" conaffinity="0"/></body></body>
  <body name="t" pos="-.05 0 .01"><joint name="a" axis="0 0 1" range="-1 1"/>
    <joint name="b" axis="0 1 0" range="-.4 1.2" pos="0 .002 0"/><geom type="sphere" size=".01" pos="0 0 .05"/></body>
</body></worldbody>
<equality><joint joint1="j2" joint2="j1" polycoef="0.1 0.8 0 0 0"/></equality>
<actuator><position joint="j1"/><position joint="a"/><position joint="b"/></actuator></mujoco>"""


def urdf_shapes(root, values):
    """Where the collision shapes of each link of a URDF are, for the values of its joints."""

    def pose(element):
        (roll, pitch, yaw), matrix = map(float, element.get("rpy").split()), np.eye(4)
        turns = [turn([0, 0, 1], yaw), turn([0, 1, 0], pitch), turn([1, 0, 0], roll)]
        matrix[:3, :3] = turns[0] @ turns[1] @ turns[2]
        matrix[:3, 3] = list(map(float, element.get("xyz").split()))
        return matrix

    def turn(axis, angle):
        x, y, z = np.array(axis) / np.linalg.norm(axis)
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        return np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross

    links = {"world": np.eye(4)}
    for joint in root.iter("joint"):
        motion = np.eye(4)
        if joint.get("type") != "fixed":
            motion[:3, :3] = turn(list(map(float, joint.find("axis").get("xyz").split())), values[joint.get("name")])
        above = links[joint.find("parent").get("link")]
        links[joint.find("child").get("link")] = above @ pose(joint.find("origin")) @ motion
    shapes = {link.get("name"): link.findall("collision") for link in root.iter("link")}
    return {name: [links[name] @ pose(shape.find("origin")) for shape in found] for name, found in shapes.items()}


@unittest.skipUnless(importlib.util.find_spec("mujoco"), "the package mujoco is not installed")
class Mjcf(Folder):
    def assert_ros_reads(self, root):
        """ROS's own parser asks for more than others do."""
        for joint in root.iter("joint"):
            if joint.get("type") in ("revolute", "prismatic"):
                self.assertLessEqual({"lower", "upper", "effort", "velocity"}, set(joint.find("limit").keys()))
        shapes = {shape.tag for geometry in root.iter("geometry") for shape in geometry}
        self.assertLessEqual(shapes, {"box", "cylinder", "sphere", "mesh"})

    def test_ros_reads_the_built_in_hands(self):
        hands = sorted((Path(__file__).parents[2] / "hands").glob("*.urdf"))
        self.assertGreater(len(hands), 5)
        for hand in hands:
            with self.subTest(hand.name):
                self.assert_ros_reads(ElementTree.parse(hand).getroot())

    def test_a_mujoco_model_becomes_a_urdf_of_the_same_motion(self):
        import mujoco
        from blindgrasp.mjcf import urdf_of

        path, urdf = self.folder / "hand.xml", self.folder / "urdf/hand.urdf"
        path.write_text(MJCF)
        self.assertEqual(urdf_of(path, urdf), [])
        root = ElementTree.parse(urdf).getroot()
        model = mujoco.MjModel.from_xml_path(str(path))
        data = mujoco.MjData(model)
        for j1, a, b in [(0, 0, 0), (1.1, -0.9, 0.7), (-0.4, 0.5, 1.2)]:
            values = {"j1": j1, "j2": 0.8 * j1 + 0.1, "a": a, "b": b}
            for name, value in values.items():
                data.joint(name).qpos = value
            mujoco.mj_kinematics(model, data)
            shapes = urdf_shapes(root, values)
            for geom in range(model.ngeom):
                if model.geom_contype[geom]:
                    link = shapes[model.body(model.geom_bodyid[geom]).name]
                    np.testing.assert_allclose(link[0][:3, 3], data.geom_xpos[geom], atol=1e-7)
                    np.testing.assert_allclose(link[0][:3, :3], data.geom_xmat[geom].reshape(3, 3), atol=1e-7)
        # The capsule is a cylinder and two balls at its ends.
        ends = [pose[:3, 3] for pose in shapes["f1"][1:3]]
        np.testing.assert_allclose(np.mean(ends, axis=0), shapes["f1"][0][:3, 3], atol=1e-7)
        np.testing.assert_allclose(ends[0] - ends[1], 0.06 * shapes["f1"][0][:3, 2], atol=1e-7)
        self.assertEqual(sum(map(len, shapes.values())), 6)
        self.assert_ros_reads(root)
        listed = subprocess.run(
            [blindgrasp.program(), "new", "hand", str(self.folder / "mine"), "--urdf", str(urdf)],
            stdout=subprocess.PIPE, text=True, check=True,
        ).stdout
        self.assertIn("revolute", listed)

    def test_jaws_that_one_tendon_pulls_move_against_each_other(self):
        from blindgrasp.mjcf import urdf_of

        path, urdf = self.folder / "hand.xml", self.folder / "hand.urdf"
        tendon = "<tendon><fixed name='t'><joint joint='j1' coef='1'/><joint joint='b' coef='-1'/></fixed></tendon>"
        path.write_text(re.sub("<equality>.*</mujoco>", f"{tendon}<actuator><motor tendon='t'/></actuator></mujoco>", MJCF, flags=re.S))
        self.assertEqual(urdf_of(path, urdf), [])
        mimic = ElementTree.parse(urdf).find("joint[@name='b']/mimic")
        self.assertEqual((mimic.get("joint"), float(mimic.get("multiplier"))), ("j1", -1.0))

    def test_radians_that_a_fragment_leaves_to_be_read_as_degrees_are_told(self):
        from blindgrasp.mjcf import urdf_of

        path = self.folder / "hand.xml"
        for angle, n_told in [("", 1), ('<compiler angle="radian"/>', 0)]:
            joint = '<joint range="0 0.8" limited="true"/>'
            path.write_text(f'<mujoco>{angle}<worldbody><body>{joint}<geom size="0.01"/></body></worldbody></mujoco>')
            told = urdf_of(path, self.folder / "hand.urdf")
            self.assertEqual(len(told), n_told, told)
        path.write_text(path.read_text().replace("0 0.8", "-40 40").replace("radian", "degree"))
        self.assertEqual(urdf_of(path, self.folder / "hand.urdf"), [])

    def test_a_loop_is_told(self):
        from blindgrasp.mjcf import urdf_of

        path = self.folder / "hand.xml"
        path.write_text(MJCF.replace("<equality>", '<equality><connect body1="f2" body2="t" anchor="0 0 0"/>'))
        told = urdf_of(path, self.folder / "hand.urdf")
        self.assertEqual(len(told), 1)
        self.assertIn("'f2' and 't' make a loop (connect)", told[0])
        # The same loop between sites, as onshape-to-robot writes it, and shapes that touch nothing.
        sites = MJCF.replace("<equality>", '<equality><connect site1="s1" site2="s2"/>')
        for body, site in (("f2", "s1"), ("t", "s2")):
            sites = re.sub(f"(<body name=['\"]{body}['\"][^>]*>)", rf'\1<site name="{site}"/>', sites)
        path.write_text(sites)
        self.assertIn("'f2' and 't' make a loop (connect)", urdf_of(path, self.folder / "hand.urdf")[0])
        path.write_text(re.sub("<geom ", '<geom contype="0" conaffinity="0" ', re.sub(" con(type|affinity)=.[01].", "", MJCF)))
        self.assertIn("shapes can touch others", urdf_of(path, self.folder / "hand.urdf")[0])
        path.write_text("<mujocoinclude/>")
        with self.assertRaisesRegex(ValueError, "expected a whole model .*convert the file that includes it"):
            urdf_of(path, self.folder / "hand.urdf")
        path.write_text("<mujoco><nothing/></mujoco>")
        with self.assertRaises(ValueError):
            urdf_of(path, self.folder / "hand.urdf")


# A test as users write it. The last two of its tests fail.
REPLAYING_TEST = """
def test_it_lifts(replay):
    decisions = replay("recordings/ordinary.mcap", "../dataflow.yaml", set={"model": "model.json"})
    assert decisions[3].action == "lift" and decisions[3].label.is_stable
    assert decisions.accuracy > 0.8

def test_it_is_careful(replay):
    decisions = replay("recordings/ordinary.mcap", "../dataflow.yaml", set={"min_probability_stable": 1})
    assert decisions.false_positives == 0

def test_it_always_lifts(replay):
    decisions = replay("recordings/no-contact.mcap", "../dataflow.yaml")
    assert decisions[0].action == "lift"

def test_there_is_a_recording(replay):
    replay("recordings/none.mcap", "../dataflow.yaml")
"""


class Pytest(Folder):
    def test_the_fixture_replays_recordings_beside_the_test(self):
        tests = self.folder / "tests"
        tests.mkdir()
        for name in ("models", "hands"):
            (self.folder / name).symlink_to(REPOSITORY / name)
        (tests / "recordings").symlink_to(REPOSITORY / "recordings")
        (tests / "model.json").symlink_to(MODEL)
        (self.folder / "dataflow.yaml").write_text(DATAFLOW.read_text())
        (self.folder / "recordings").symlink_to(REPOSITORY / "recordings")
        (tests / "test_grasps.py").write_text(REPLAYING_TEST)
        plugins = ["-p", "blindgrasp.pytest_plugin", "-p", "no:cacheprovider"]
        command = [sys.executable, "-m", "pytest", *plugins, str(tests)]
        package = str(Path(blindgrasp.__file__).parents[1])
        # The entry point of an installed package would load the fixture a second time.
        environment = os.environ | {"PYTHONPATH": package, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
        environment["BLINDGRASP_PROGRAM"] = str(blindgrasp.program())
        done = subprocess.run(command, cwd=self.folder, env=environment, capture_output=True, text=True)
        self.assertEqual(done.returncode, 1, done.stdout + done.stderr)
        self.assertIn("2 failed, 2 passed", done.stdout)
        self.assertIn("AssertionError: assert 'hold' == 'lift'", done.stdout)
        self.assertIn("recordings/none.mcap: No such file", done.stdout)


class Tables(Folder):
    """Tables for the gripper of two jaws with 12 cells each, and one joint."""

    def columns(self):
        cells = {f"c{idx}": [idx / 8, 0.0, 0.5] for idx in range(24)}
        return {"jaw": [0.01, 0.02, 0.03], "thing": ["mug", "can, big", "Bücher"], "held": [True, False, True], **cells}

    def from_table(self, table, **more):
        words = {"cells": "c*", "joint_columns": ["jaw"], "label": "held", "group": "thing", "hand": "parallel-gripper"}
        return blindgrasp.from_table(table, self.folder / "out.mcap", **(words | more))

    def test_a_table_of_each_form_is_the_same_recording(self):
        columns = self.columns()
        rows = [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
        arrays = {name: np.array(values) for name, values in columns.items()}
        # As HDF5 and MATLAB have names.
        stored = columns | {"thing": [columns["thing"][0].encode(), *(np.array([name]) for name in columns["thing"][1:])]}
        for table in (columns, arrays, rows, iter(rows), pd.DataFrame(columns), stored, pd.DataFrame(stored)):
            grasps = list(self.from_table(table, overwrite=True))
            self.assertEqual([grasp.label.object_id for grasp in grasps], columns["thing"])
            self.assertEqual([grasp.label.is_stable for grasp in grasps], columns["held"])
            for idx, grasp in enumerate(grasps):
                self.assertEqual(grasp.joints.tolist(), [[columns["jaw"][idx]]] * 3)
                self.assertEqual(grasp.cells_newtons[0].tolist(), [values[idx] for name, values in columns.items() if name[0] == "c"])

    def test_rows_may_be_frames_and_the_posture_one_for_all(self):
        table = pd.DataFrame(self.columns()).assign(nth=[7, 7, 8], what=["closing", "settled", "settled"])
        table["thing"], table["held"] = ["a", "a", "b"], [0, 0, 1]
        more = {"grasp_column": "nth", "phase_column": "what", "stable_value": 1, "grasp_id_start": 40, "day": "2026-11-28"}
        first, second = self.from_table(table, joints={"jaw": 0.015}, **more)
        self.assertEqual((first.grasp_id, first.phase.tolist(), first.label.is_stable), (40, ["closing", "settled"], False))
        self.assertEqual((second.grasp_id, second.joints.tolist(), second.label.is_stable), (41, [[0.015]], True))

    def test_a_day_is_one_session_in_each_form(self):
        days = ["2026-11-24", "2026-11-24 10:00:01", datetime.date(2026, 11, 24), pd.Timestamp("2026-11-24"), 20261124.0]
        for day in [*days, np.datetime64("2026-11-24", "ns")]:
            with self.subTest(day=day):
                columns = self.columns() | {"when": [day] * 3}
                for table in (columns, pd.DataFrame(columns)):
                    found = self.from_table(table, day_column="when", overwrite=True)
                    self.assertEqual({grasp.day for grasp in found}, {20261124})
                found = self.from_table(self.columns(), day=day, overwrite=True)
                self.assertEqual({grasp.day for grasp in found}, {20261124})

    def test_what_is_missing_is_no_name_and_no_number(self):
        for missing in (None, math.nan, np.float32("nan"), pd.NA, pd.NaT):
            for name, problem in (("thing", "expected a name, found nothing"), ("c3", "expected a number .*, found nothing")):
                columns = self.columns()
                columns[name][1] = missing
                for table in (columns, pd.DataFrame(columns)):
                    with self.assertRaisesRegex(blindgrasp.ProgramError, f"line 3: column '{name}': {problem}"):
                        self.from_table(table)
        self.assertEqual(list(self.folder.iterdir()), [])

    def test_what_is_no_table_is_refused_and_what_is_odd_is_told(self):
        with self.assertRaisesRegex(TypeError, "found rows that are int"):
            self.from_table([1, 2])
        with self.assertRaisesRegex(ValueError, "equally long; found lengths .*'jaw': 1"):
            self.from_table(self.columns() | {"jaw": [0.01]})
        with self.assertRaisesRegex(TypeError, r"expected one value in each column of a row, found \[1, 2\]"):
            self.from_table(self.columns() | {"jaw": [[1, 2]] * 3})
        with self.assertRaisesRegex(blindgrasp.ProgramError, "a value is required for '--day"):
            self.from_table(self.columns(), day="")
        with self.assertRaisesRegex(blindgrasp.ProgramError, "table.csv: the table is empty|there is no row"):
            self.from_table([])
        self.from_table(self.columns())
        with self.assertRaisesRegex(blindgrasp.ProgramError, "--overwrite"):
            self.from_table(self.columns())
        with self.assertWarnsRegex(UserWarning, "the largest reading of a cell is 900 N"):
            self.from_table(self.columns() | {"c0": [900, 1, 2]}, overwrite=True)


class Program(Folder):
    def test_the_version_is_that_of_the_program(self):
        done = subprocess.run([blindgrasp.program(), "--version"], stdout=subprocess.PIPE, text=True, check=True)
        self.assertEqual(f"blindgrasp {blindgrasp.__version__}", done.stdout.strip())

    def test_the_program_is_found_or_missed_in_words(self):
        there = str(blindgrasp.program())
        self.assertTrue(os.access(there, os.X_OK))
        with mock.patch.dict(os.environ, BLINDGRASP_PROGRAM=str(self.folder / "none")):
            with self.assertRaisesRegex(blindgrasp.ProgramNotFoundError, "BLINDGRASP_PROGRAM is .*none"):
                blindgrasp.program()
        with mock.patch.dict(os.environ, PATH=str(self.folder)):
            os.environ.pop("BLINDGRASP_PROGRAM", None)
            package = Path(blindgrasp.__file__).parent
            if not (package / "bin/blindgrasp").exists():
                with self.assertRaisesRegex(blindgrasp.ProgramNotFoundError, "not on PATH"):
                    blindgrasp.program()
                (self.folder / "blindgrasp").symlink_to(there)
                self.assertEqual(blindgrasp.program(), self.folder / "blindgrasp")


class Files(unittest.TestCase):
    def test_all_yaml_files_load_in_pyyaml(self):
        listed = ["git", "ls-files", "*.yaml", "*.yml"]
        paths = subprocess.run(listed, cwd=REPOSITORY, capture_output=True, text=True, check=True).stdout.split()
        self.assertIn("dataflow-live.yaml", paths)
        for path in paths:
            with self.subTest(path):
                self.assertIsNotNone(yaml.safe_load((REPOSITORY / path).read_text()))


class Pages(Folder):
    def test_the_examples_of_the_page_run_as_they_stand(self):
        for name in ("recordings", "models", "hands", "dataflow.yaml"):
            (self.folder / name).symlink_to(REPOSITORY / name)
        page = (REPOSITORY / "docs/python.md").read_text()
        codes = re.findall("^```python\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
        self.assertGreater(len(codes), 6)
        commands = re.findall("^blindgrasp export .*$", page, re.MULTILINE)
        self.assertEqual(len(commands), 1)
        names, printed = {"__name__": "__main__"}, io.StringIO()
        with contextlib.chdir(self.folder), contextlib.redirect_stdout(printed):
            for idx, code in enumerate(codes):
                exec(compile(code.replace('"mine"', repr(unique_name())), f"python.md, block {idx}", "exec"), names)
            for command in commands:
                words = shlex.split(command)[1:]
                subprocess.run([blindgrasp.program(), *words], stdout=subprocess.DEVNULL, check=True)
        self.assertIn("Predictions(240 grasps", printed.getvalue())
        self.assertIn("2 2100.5 Label(", printed.getvalue())
        features = pd.read_csv(self.folder / "features.csv")
        self.assertLessEqual({"stable", "object"}, set(features.columns))
        # The dataset has become a recording again.
        table, again = names["table"], blindgrasp.Recording(self.folder / "again-dataset/held-out.mcap").to_frame()
        self.assertEqual(again["stable"].tolist(), table["stable"].tolist())
        self.assertEqual(again["object_class"].tolist(), table["object_class"].tolist())
        cells = [frame.filter(like="cell_").to_numpy() for frame in (table, again)]
        np.testing.assert_allclose(cells[1], cells[0], atol=1e-12)


class Notebook(Folder):
    def test_the_notebook_runs(self):
        path = REPOSITORY / "docs/notebook.ipynb"
        self.assertLess(path.stat().st_size, 100_000)
        cells = json.loads(path.read_text())["cells"]
        codes = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
        self.assertGreater(len(codes), 3)
        self.assertTrue(all(cell["outputs"] == [] for cell in cells if cell["cell_type"] == "code"))
        names, printed = {"__name__": "__main__"}, io.StringIO()
        with contextlib.ExitStack() as stack:
            stack.enter_context(contextlib.chdir(path.parent))
            stack.enter_context(contextlib.redirect_stdout(printed))
            stack.enter_context(mock.patch.dict(os.environ, MPLBACKEND="agg"))
            for idx, code in enumerate(codes):
                exec(compile(code, f"{path.name}, code cell {idx}", "exec"), names)
        self.assertIn("240 grasps", printed.getvalue())
        self.assertIn("accuracy", printed.getvalue())


if __name__ == "__main__":
    unittest.main()
